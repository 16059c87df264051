"""Closed-form rules against plain reverse mode through the textbook's step: `jnp.linalg.solve`, ``P - K S K'``.

Gradients are of a loss of everything that a filter returns, with respect to full Q, R, P0, to the dynamics and to the
readings. The references share no code with the library: Jacobians by hand, missing components struck out of H and R,
sigma points from `jnp.linalg.cholesky`, attitude as a rotation matrix.
"""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt.loop import checkpointed

STEPS = 5
DT = 0.5
PI = np.pi


def covariance(std, seed):
    """A full covariance with these standard deviations."""
    A = np.random.default_rng(seed).normal(size=(len(std), len(std))) + 1.5 * np.eye(len(std))
    A /= np.linalg.norm(A, axis=1, keepdims=True)
    return np.outer(std, std) * (A @ A.T)


def skew(v):
    zero = jnp.zeros(())
    return jnp.stack([jnp.stack(r) for r in ((zero, -v[2], v[1]), (v[2], zero, -v[0]), (-v[1], v[0], zero))])


def turned(a):
    return jnp.arctan2(jnp.sin(a), jnp.cos(a))


# --- the robots ----------------------------------------------------------------------------------------------------

POST = np.array([-6.0, 0.3])
"""Behind the rover: its bearing crosses the seam."""
WEIGHT = np.random.default_rng(7).normal(size=(3, 3))


def rover(theta):
    """x, y, yaw, driven at a speed to be tuned; "gnss" x and y, "post" range and bearing."""

    def f(x, u, dt):
        along = jnp.stack([jnp.cos(x["yaw"]), jnp.sin(x["yaw"])])
        return {"pos": x["pos"] + dt * theta["a"] * along, "yaw": x["yaw"] + u * dt}

    def post(x, c):
        d = jnp.asarray(POST, x["pos"].dtype) - x["pos"]
        return jnp.sqrt(d @ d), jnp.arctan2(d[1], d[0]) - x["yaw"]

    sensors = {
        "gnss": jf.Sensor(lambda x, c: x["pos"], jf.const(theta["R"]["gnss"]), jf.vector(2)),
        "post": jf.Sensor(post, jf.const(theta["R"]["post"]), jf.product((jf.scalar, jf.angle))),
    }
    return jf.Model(f, jf.white(theta["Q"]), jf.product({"pos": jf.vector(2), "yaw": jf.angle}), sensors)


def rover_f(theta, x, u):
    x, c, s = jnp.asarray(x), jnp.cos(x[2]), jnp.sin(x[2])
    F = jnp.eye(3).at[0, 2].set(-DT * theta["a"] * s).at[1, 2].set(DT * theta["a"] * c)
    return x + jnp.stack([DT * theta["a"] * c, DT * theta["a"] * s, u * DT]), F


def rover_h(theta, name, x):
    if name == "gnss":
        return x[:2], jnp.eye(2, 3)
    dx, dy = POST[0] - x[0], POST[1] - x[1]
    r = jnp.sqrt(dx**2 + dy**2)
    rows = jnp.stack([-dx / r, -dy / r, 0 * r]), jnp.stack([dy / r**2, -dx / r**2, -1.0 + 0 * r])
    return jnp.stack([r, jnp.arctan2(dy, dx) - x[2]]), jnp.stack(rows)


def line(theta):
    """A linear system of three states; "gnss" sees two of them, "post" two others."""
    maps = {name: jnp.asarray(H) for name, H in MAPS.items()}
    return jf.linear(theta["a"] * jnp.asarray(A), maps, DT * theta["Q"], theta["R"])


A = np.array([[0.9, 0.3, 0.0], [-0.2, 0.8, 0.1], [0.1, 0.0, 0.7]])
MAPS = {"gnss": np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -0.3]]), "post": np.array([[0.2, 0.0, 1.0], [0.0, 1.0, 1.0]])}


def line_f(theta, x, u):
    return theta["a"] * A @ x, theta["a"] * A


def line_h(theta, name, x):
    return MAPS[name] @ x, MAPS[name]


# --- the textbook's steps ------------------------------------------------------------------------------------------


def innovation(name, z, predicted, angles):
    r = z - predicted
    return r.at[1].set(turned(r[1])) if angles and name == "post" else r


def corrected(x, P, r, S, C):
    K = jnp.linalg.solve(S, C.T).T
    loglik = -0.5 * (r @ jnp.linalg.solve(S, r) + jnp.linalg.slogdet(2 * PI * S)[1])
    return x + K @ r, P - K @ S @ K.T, loglik


def extended(f, h, angles):
    """Sarkka (2013), algorithm 5.4, as predict(theta, x, P, u) and correct(theta, x, P, name, z, seen)."""

    def predict(theta, x, P, u):
        x, F = f(theta, x, u)
        return x, F @ P @ F.T + DT * theta["Q"]

    def correct(theta, x, P, name, z, seen):
        y, H = h(theta, name, x)
        r, H, R = innovation(name, z, y, angles)[seen], H[seen], theta["R"][name][np.ix_(seen, seen)]
        return corrected(x, P, r, H @ P @ H.T + R, P @ H.T)

    return predict, correct


def unscented(f, h, angles):
    """Sarkka (2013), algorithm 5.14, with alpha = 0.8, beta = 2, kappa = 1."""
    n, alpha = 3, 0.8
    spread = alpha**2 * (n + 1)
    wm = np.r_[1 - n / spread, np.full(2 * n, 0.5 / spread)]
    wc = wm + np.r_[3 - alpha**2, np.zeros(2 * n)]

    def points(x, P):
        L = np.sqrt(spread) * jnp.linalg.cholesky(P)
        return jnp.concatenate([x[None], x[None] + L.T, x[None] - L.T])

    def predict(theta, x, P, u):
        images = jax.vmap(lambda p: f(theta, p, u)[0])(points(x, P))
        x = wm @ images
        return x, (images - x[None]).T @ np.diag(wc) @ (images - x[None]) + DT * theta["Q"]

    def correct(theta, x, P, name, z, seen):
        X = points(x, P)
        Y = jax.vmap(lambda p: h(theta, name, p)[0])(X)
        y = wm @ Y  # the bearing itself is continuous behind the rover: it is not wrapped here
        S = ((Y - y[None]).T @ np.diag(wc) @ (Y - y[None]) + theta["R"][name])[np.ix_(seen, seen)]
        C = ((X - x[None]).T @ np.diag(wc) @ (Y - y[None]))[:, seen]
        return corrected(x, P, innovation(name, z, y, angles)[seen], S, C)

    return predict, correct


def textbook(f, h, angles, steps):
    """The loss of the textbook's filter, row after row."""
    predict, correct = steps(f, h, angles)

    def loss(theta, z, s):
        x, P, total = jnp.asarray(s.x0), theta["P0"], 0.0
        for k in range(STEPS):
            x, P = predict(theta, x, P, s.u[k])
            for name in ("gnss", "post"):
                seen = np.broadcast_to(s.valid[name][k], 2)
                if seen.any():
                    x, P, loglik = correct(theta, x, P, name, z[name][k], seen)
                    total = total - loglik
            e = x - s.x0
            total = total + 0.1 * (jnp.sin(e) @ jnp.sin(e)) + jnp.sum(WEIGHT * P)
        return total

    return loss


# --- the library's -------------------------------------------------------------------------------------------------


def library(model, build, flat, **options):
    def loss(theta, z, s):
        m = model(theta)
        mean = m.space.plus(jax.tree.map(lambda a: jnp.asarray(a, theta["P0"].dtype), m.space.origin), s.x0)
        readings = z if flat else {"gnss": z["gnss"], "post": (z["post"][:, 0], z["post"][:, 1])}
        log = jf.Log(np.full(STEPS, DT, s.u.dtype), () if flat else s.u, readings, {}, s.valid)

        def store(b, info):
            e = m.space.minus(b.mean, mean)
            logliks = sum(i.loglik for i in info.values())
            return 0.1 * (jnp.sin(e) @ jnp.sin(e)) + jnp.sum(s.weight * b.cov) - logliks

        return jf.scan(build(m), jf.Gaussian(mean, theta["P0"]), log, store, **options).sum()

    return loss


def mine(model):
    return jf.ukf(model, alpha=0.8, kappa=1.0)


CASES = {
    "kf": (library(line, jf.kf, True), textbook(line_f, line_h, False, extended)),
    "ekf": (library(rover, jf.ekf, False), textbook(rover_f, rover_h, True, extended)),
    "ukf": (library(rover, mine, False), textbook(rover_f, rover_h, True, unscented)),
}


@functools.cache
def setting(linear):
    """Parameters, readings and the rest. Bearings lie on both sides of the seam; what is not seen is nonsense."""
    rng = np.random.default_rng(3)
    theta = {
        "Q": covariance([0.2, 0.3, 0.05], 1),
        "R": {"gnss": covariance([0.5, 0.4], 2), "post": covariance([0.3, 0.1], 4)},
        "P0": covariance([0.5, 0.8, 0.2], 5),
        "a": np.asarray(0.9),
    }
    bearing = np.array([3.1, -3.1, 3.12, 3.0, -3.12])
    z = {"gnss": rng.normal(size=(STEPS, 2)), "post": np.stack([6 + rng.normal(size=STEPS), bearing], 1)}
    valid = {"gnss": rng.random((STEPS, 2)) < 0.6, "post": np.array([True, True, False, True, True])}
    z["post"][2] = 50.0, 1.0
    x0 = np.array([0.4, -0.2, 0.05])
    return theta, z, SimpleNamespace(u=0.05 * rng.normal(size=STEPS), x0=x0, valid=valid, weight=WEIGHT)


def symmetric(tree):
    """The derivative with respect to a symmetric matrix; readings and numbers as they are."""
    return jax.tree.map(lambda a: np.asarray(a + a.T) / 2 if np.shape(a) in ((2, 2), (3, 3)) else np.asarray(a), tree)


def dot(a, b):
    return sum(float(np.sum(x * y)) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def direction(at, seed):
    rng = np.random.default_rng(seed)
    return symmetric(jax.tree.map(lambda a: 0.1 * np.abs(a) * rng.normal(size=np.shape(a)), at))


def along(at, v, h):
    return jax.tree.map(lambda a, d: a + h * d, at, v)


@functools.cache
def compiled(case):
    """Function of ((theta, z), v): value and gradient, and both once more along v: forward over reverse mode."""
    loss, s = CASES[case][0], setting(case == "kf")[2]

    @jax.jit
    def both(at, v):
        return jax.jvp(jax.value_and_grad(lambda at: loss(at[0], at[1], s)), (at,), (v,))

    return both


def close(got, want, rtol):
    """Every array within rtol of its own largest element."""
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * np.abs(b).max())


@pytest.mark.parametrize("case", CASES)
def test_rules_are_plain_reverse_mode_and_differences(case):
    theta, z, s = setting(case == "kf")
    at = (theta, z)
    v = direction(at, 5)
    (value, gradient), (slope, curved) = compiled(case)(at, v)
    reference = jax.jit(jax.value_and_grad(lambda at: CASES[case][1](at[0], at[1], s)))
    want, want_gradient = reference(at)
    np.testing.assert_allclose(value, want, rtol=1e-11)
    close(symmetric(gradient), symmetric(want_gradient), 1e-9)
    assert all(np.abs(g).max() > 1e-3 for g in jax.tree.leaves(gradient)), "a gradient that nothing tests"
    np.testing.assert_array_equal(np.asarray(gradient[1]["gnss"])[~s.valid["gnss"]], 0.0)
    np.testing.assert_allclose(slope, dot(gradient, v), rtol=1e-11)

    h = 1e-5
    (above, gradient_above), _ = compiled(case)(along(at, v, h), v)
    (below, gradient_below), _ = compiled(case)(along(at, v, -h), v)
    np.testing.assert_allclose((above - below) / (2 * h), slope, rtol=1e-6)
    difference = jax.tree.map(lambda a, b: (a - b) / (2 * h), gradient_above, gradient_below)
    close(symmetric(curved), symmetric(difference), 1e-5)


# --- attitude ------------------------------------------------------------------------------------------------------

FIELD = np.array([0.2, -0.5, 0.8])


def body(theta):
    """An attitude that turns at u rad/s and sees a field of the world in its own axes."""
    sensor = jf.Sensor(lambda x, c: jf.rotate_back(x, jnp.asarray(FIELD)), jf.const(theta["R"]), jf.vector(3))
    f = lambda x, u, dt: jf.so3.plus(x, theta["a"] * u * dt)  # noqa: E731
    return jf.Model(f, jf.white(theta["Q"]), jf.so3, {"field": sensor})


def rotation(d):
    """Rodrigues' formula, and the right Jacobian of SO(3); Sola et al. (2018), eqs. 132 and 143."""
    a = jnp.sqrt(d @ d)
    X, eye = skew(d), jnp.eye(3)
    R = eye + jnp.sin(a) / a * X + (1 - jnp.cos(a)) / a**2 * X @ X
    return R, eye - (1 - jnp.cos(a)) / a**2 * X + (a - jnp.sin(a)) / a**3 * X @ X


def attitude_by_the_book(theta, z, u):
    R, P, total = jnp.eye(3), theta["P0"], 0.0
    for k in range(len(u)):
        turn = rotation(theta["a"] * u[k] * DT)[0]
        R, P = R @ turn, turn.T @ P @ turn + DT * theta["Q"]
        h = R.T @ FIELD
        H = skew(h)
        S = H @ P @ H.T + theta["R"]
        d, P, loglik = corrected(jnp.zeros(3), P, z[k] - h, S, P @ H.T)
        turn, G = rotation(d)
        R, P = R @ turn, G @ P @ G.T
        total = total - loglik + jnp.sum(WEIGHT * P) + jnp.sum(WEIGHT * R)
    return total


def attitude(theta, z, u):
    belief = jf.Gaussian(jnp.asarray([1.0, 0.0, 0.0, 0.0]), theta["P0"])
    log = jf.Log(np.full(len(u), DT), u, {"field": z}, {}, {})

    def store(b, info):
        R = jax.vmap(lambda e: jf.rotate(b.mean, e), out_axes=1)(jnp.eye(3))
        return jnp.sum(WEIGHT * b.cov) + jnp.sum(WEIGHT * R) - info["field"].loglik

    return jf.scan(jf.ekf(body(theta)), belief, log, store).sum()


def test_attitude():
    rng = np.random.default_rng(9)
    theta = {
        "Q": covariance([0.1, 0.2, 0.1], 1),
        "R": covariance([0.1, 0.2, 0.3], 2),
        "P0": covariance([0.4, 0.3, 0.5], 3),
        "a": np.asarray(0.9),
    }
    args = theta, FIELD + 0.3 * rng.normal(size=(2, 3)), rng.normal(size=(2, 3))
    value, gradient = jax.jit(jax.value_and_grad(attitude, argnums=(0, 1)))(*args)
    want, want_gradient = jax.jit(jax.value_and_grad(attitude_by_the_book, argnums=(0, 1)))(*args)
    np.testing.assert_allclose(value, want, rtol=1e-11)
    close(symmetric(gradient[0]), symmetric(want_gradient[0]), 1e-9)
    close(gradient[1], want_gradient[1], 1e-9)


# --- identities, segments, float32 ---------------------------------------------------------------------------------


@functools.cache
def weighed(case, segment=None):
    """Function of (theta, z, s, weights (2,)): gradient of a weighed sum of squared error and minus log-likelihood; and
    the sum of ``dof - NIS``."""
    model, build = {"kf": (line, jf.kf), "ekf": (rover, jf.ekf)}[case]

    def store(space, start):
        def row(b, info):
            e = space.minus(b.mean, start)
            excess = sum(i.dof.astype(i.nis.dtype) - i.nis for i in info.values())
            return e @ e, -sum(i.loglik for i in info.values()), excess

        return row

    def loss(theta, z, u, x0, weights):
        m, valid = model(theta), setting(True)[2].valid
        start = m.space.plus(jax.tree.map(lambda a: jnp.asarray(a, x0.dtype), m.space.origin), x0)
        if case == "ekf":
            z = {"gnss": z["gnss"], "post": (z["post"][:, 0], z["post"][:, 1])}
        log = jf.Log(jnp.full(STEPS, DT, x0.dtype), u if case == "ekf" else (), z, {}, valid)
        rows = jf.scan(build(m), jf.Gaussian(start, theta["P0"]), log, store(m.space, start), segment=segment)
        return weights[0] * rows[0].sum() + weights[1] * rows[1].sum(), rows[2].sum()

    return jax.jit(jax.value_and_grad(loss, has_aux=True))


def arguments(case, dtype: type = np.float64):
    theta, z, s = setting(case == "kf")
    return jax.tree.map(lambda a: np.asarray(a, dtype), (theta, z, s.u, s.x0))


@pytest.mark.parametrize("case", ["kf", "ekf"])
def test_what_scaling_all_covariances_together_does(case):
    """Means do not move, and the likelihood's slope is half of what the NIS exceed their number by."""
    args = arguments(case)
    noises = {name: args[0][name] for name in ("P0", "Q", "R")}
    for weights in ((1.0, 0.0), (0.0, 1.0)):
        (_, excess), gradient = weighed(case)(*args, np.array(weights))
        slopes = {name: gradient[name] for name in noises}
        parts = jax.tree.leaves(jax.tree.map(lambda g, a: float(np.sum(g * a)), slopes, noises))
        assert max(map(abs, parts)) > 0.1
        want = 0.5 * float(excess) * weights[1]
        np.testing.assert_allclose(sum(parts), want, rtol=1e-10, atol=1e-10 * max(map(abs, parts)))


def test_segments_change_nothing():
    args, weights = arguments("ekf"), np.array([0.3, 1.0])
    (value, _), gradient = weighed("ekf")(*args, weights)
    (in_segments, _), also_gradient = weighed("ekf", 2)(*args, weights)
    np.testing.assert_allclose(in_segments, value, rtol=1e-13)
    close(also_gradient, gradient, 1e-12)
    xs, body = jnp.arange(7.0), lambda c, x: (c + x, c * x)
    want = jax.lax.scan(body, 0.5, xs)
    for segment in (1, 3, 7, 10):
        got = jax.tree.leaves(checkpointed(body, 0.5, xs, segment))
        for a, b in zip(got, jax.tree.leaves(want), strict=True):
            np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match="segment: expected at least one row, got 0"):
        checkpointed(body, 0.5, xs, 0)


def test_float32():
    weights = np.array([0.3, 1.0])
    _, gradient = weighed("ekf")(*arguments("ekf"), weights)
    _, single = weighed("ekf")(*arguments("ekf", np.float32), weights.astype(np.float32))
    assert {leaf.dtype for leaf in jax.tree.leaves(single)} == {np.dtype(np.float32)}
    close(single, gradient, 1e-3)


def test_every_order_of_modes_gives_one_hessian():
    """Reverse over reverse and forward over reverse do not take the same ways through the rules."""
    one = jnp.eye(1)

    def level(theta):
        return jf.linear(one, one, Q=jnp.exp(2 * theta[0]) * one, R=jnp.exp(2 * theta[1]) * one)

    at, start = jnp.array([0.0, 0.3]), jf.Gaussian(jnp.zeros(1), one)
    log = jf.Log(jnp.ones(30), (), {"z": jax.random.normal(jax.random.key(0), (30, 1))}, {}, {})
    loss = lambda theta: jf.log_likelihood(jf.kf(level(theta)), start, log)  # noqa: E731
    gradient, h = jax.jit(jax.grad(loss)), 1e-5
    want = jnp.stack([(gradient(at + h * e) - gradient(at - h * e)) / (2 * h) for e in jnp.eye(2)])
    for outer in (jax.jacfwd, jax.jacrev):
        for inner in (jax.jacfwd, jax.jacrev):
            np.testing.assert_allclose(jax.jit(outer(inner(loss)))(at), want, rtol=1e-7)
