"""The posterior Cramer-Rao bound, against the Kalman filter, Tichavsky's formula as printed, and filters that try."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt.bound import cramer_rao, efficiency

KEY = jax.random.key(0)

# --- linear models: the Kalman filter, in plain NumPy -----------------------------------------------------------------

A = np.array([[0.95, 0.2, 0.0], [-0.15, 0.9, 0.1], [0.05, 0.0, 0.8]])
B = np.array([0.5, -0.2, 1.0])
WIDE = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -0.3]])
R_WIDE = np.array([[0.5, 0.2], [0.2, 0.3]])
PUSH = np.array([0.1, -0.3, 0.7])
P_FULL = np.array([[4.0, 0.5, -0.3], [0.5, 1.0, 0.1], [-0.3, 0.1, 0.25]])
STEPS = 40


def linear_model(theta):
    """Rank-1 process noise; "wide" loses components; the row and the noise of "arm" come with the reading."""
    F, G, H, R, L = (jnp.asarray(M, theta["q"].dtype) for M in (A, B, WIDE, R_WIDE, PUSH))
    wide = jf.Sensor(lambda x, c: H @ x, jf.const(R), jf.vector(2))
    arm = jf.Sensor(lambda x, c: c["row"] @ x, lambda x, c: c["var"][None, None], jf.scalar)
    Q = jf.const(theta["q"] * jnp.outer(L, L))
    return jf.Model(lambda x, u, dt: F @ x + G * u, Q, jf.vector(3), {"wide": wide, "arm": arm})


def linear_log():
    rng = np.random.default_rng(0)
    dt = np.where(rng.random(STEPS) < 0.2, 0.0, rng.uniform(0.5, 1.5, STEPS))
    c = {"arm": {"row": rng.normal(size=(STEPS, 3)), "var": rng.uniform(0.01, 1.0, STEPS)}}
    z = {"wide": np.zeros((STEPS, 2)), "arm": np.zeros(STEPS)}
    valid = {"wide": rng.random((STEPS, 2)) < 0.6, "arm": rng.random(STEPS) < 0.7}
    return jf.Log(dt, rng.normal(size=STEPS), z, c, valid)


def kalman(P, q, log):
    """The textbook's covariances, ``P - P H' (H P H' + R)^-1 H P``, sensors stacked, what was not seen struck out."""
    covs = []
    for k in range(STEPS):
        if log.dt[k] > 0:
            P = A @ P @ A.T + q * np.outer(PUSH, PUSH)
        seen = np.r_[log.valid["wide"][k], log.valid["arm"][k]]
        H = np.vstack([WIDE, log.c["arm"]["row"][k]])[seen]
        R = np.zeros((3, 3))
        R[:2, :2], R[2, 2] = R_WIDE, log.c["arm"]["var"][k]
        P = P - P @ H.T @ np.linalg.inv(H @ P @ H.T + R[np.ix_(seen, seen)]) @ H @ P
        covs.append(P)
    return np.stack(covs)


def linear_start(theta):
    return jf.Gaussian(jnp.ones(3, theta["P"].dtype), theta["P"])


@pytest.mark.parametrize("P", [P_FULL, np.zeros((3, 3)), np.outer(PUSH, PUSH)], ids=["unknown", "known", "a line"])
def test_of_a_linear_model_it_is_the_kalman_filter(P):
    log, theta = linear_log(), {"q": jnp.asarray(0.04), "P": jnp.asarray(P)}
    assert ((log.dt == 0) & log.valid["arm"]).any()
    bound = cramer_rao(linear_model, linear_start, log, KEY, theta=theta, runs=5)
    expected = kalman(P, 0.04, log)
    size = np.sqrt(np.einsum("ti,tj->tij", *[np.diagonal(expected, axis1=1, axis2=2)] * 2))
    assert (np.abs(bound.cov - expected) < 1e-10 * np.maximum(size, 1e-6)).all()
    np.testing.assert_allclose(bound.linearised, expected, rtol=1e-8, atol=1e-12)
    assert bound.exact
    assert bound.kind == "exact: dynamics and sensors are linear, and a Kalman filter attains it"


def test_an_input_that_follows_the_truth_changes_nothing_in_a_linear_model():
    log, theta = linear_log(), {"q": jnp.asarray(0.04), "P": jnp.asarray(P_FULL)}
    steered = cramer_rao(linear_model, linear_start, log, KEY, theta=theta, runs=5, control=lambda x, u: u - x[0])
    np.testing.assert_allclose(steered.cov, kalman(P_FULL, 0.04, log), rtol=1e-9, atol=1e-12)
    assert steered.exact


def test_other_parameters_compile_nothing():
    traced = []

    def model(theta):
        traced.append(isinstance(theta["q"], jax.core.Tracer))
        return linear_model(theta)

    log = linear_log()
    for q in (0.04, 0.09):
        theta = {"q": jnp.asarray(q), "P": jnp.asarray(P_FULL)}
        bound = cramer_rao(model, linear_start, log, KEY, theta=theta, runs=5)
        np.testing.assert_allclose(bound.cov, kalman(P_FULL, q, log), rtol=1e-9, atol=1e-12)
    assert sum(traced) == 1


def test_single_precision():
    theta = {"q": jnp.float32(0.04), "P": jnp.asarray(P_FULL, np.float32)}
    log = jax.tree.map(lambda a: a.astype(np.float32) if a.dtype == float else a, linear_log())
    bound = cramer_rao(linear_model, linear_start, log, KEY, theta=theta, runs=5)
    expected = kalman(P_FULL, 0.04, linear_log())
    np.testing.assert_allclose(bound.cov, expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(bound.linearised, expected, rtol=1e-4, atol=1e-5)
    assert bound.exact


# --- nonlinear models: the recursion as printed, over truths of NumPy's own -----------------------------------------


def printed(D, J):
    """Tichavsky et al. (1998), eq. 21: rows of (D11, D12, D22 with the readings' information)."""
    covs = []
    for D11, D12, D22 in D:
        J = D22 - D12.T @ np.linalg.inv(J + D11) @ D12
        covs.append(np.linalg.inv(J))
    return np.stack(covs)


def bend(theta):
    """A scalar that turns over, read through a cubic."""
    cubic = jf.Sensor(lambda x, c: x + 0.3 * x**3, jf.const(theta["r"] ** 2 * jnp.eye(1)), jf.scalar)
    turn = lambda x, u, dt: 0.8 * x + jnp.sin(x)  # noqa: E731
    return jf.Model(turn, jf.const(theta["q"] ** 2 * jnp.eye(1)), jf.scalar, {"z": cubic})


def bend_start(theta):
    return jf.Gaussian(jnp.asarray(0.5), theta["p"] ** 2 * jnp.eye(1))


BEND = {"q": jnp.asarray(0.3), "r": jnp.asarray(0.5), "p": jnp.asarray(0.4)}


def test_of_a_scalar_it_is_the_mean_curvature_of_the_log_density():
    """D11, D12 and D22 by finite differences of log p(x' | x) and log p(z | x): no Jacobian, no formula in F."""
    bound = cramer_rao(bend, bend_start, jf.schedule(bend(BEND), 8, 1.0), KEY, theta=BEND, runs=20_000)
    q, r, p, h = 0.3, 0.5, 0.4, 1e-3
    rng = np.random.default_rng(1)
    move = lambda y, x: -0.5 * ((y - 0.8 * x - np.sin(x)) / q) ** 2  # noqa: E731
    read = lambda z, x: -0.5 * ((z - x - 0.3 * x**3) / r) ** 2  # noqa: E731
    x, D = rng.normal(0.5, p, 40_000), []
    for _ in range(8):
        y = 0.8 * x + np.sin(x) + rng.normal(0, q, x.shape)
        z = y + 0.3 * y**3 + rng.normal(0, r, x.shape)
        D11 = -(move(y, x + h) - 2 * move(y, x) + move(y, x - h)) / h**2
        D12 = -(move(y + h, x + h) - move(y + h, x - h) - move(y - h, x + h) + move(y - h, x - h)) / (4 * h**2)
        D22 = -(move(y + h, x) - 2 * move(y, x) + move(y - h, x)) / h**2
        D22 -= (read(z, y + h) - 2 * read(z, y) + read(z, y - h)) / h**2
        D.append([np.array([[d.mean()]]) for d in (D11, D12, D22)])
        x = y
    np.testing.assert_allclose(bound.cov, printed(D, np.eye(1) / p**2), rtol=0.02)
    assert bound.exact
    assert bound.kind.startswith("exact, up to the mean over 20000 truths: no filter's mean squared error is smaller")


ALONG = np.array([0.6, 0.8])
ACROSS = np.array([[0.9, 0.3], [-0.2, 0.9]])


def drag(theta):
    """The nonlinear part pushes along the noise, which has one direction, and that is no axis."""
    push = lambda x: 1.5 * jnp.tanh(x[0] - x[1])  # noqa: E731
    f = lambda x, u, dt: jnp.asarray(ACROSS) @ x + jnp.asarray(ALONG) * push(x)  # noqa: E731
    Q = jf.const(0.09 * jnp.asarray(np.outer(ALONG, ALONG)) + theta * jnp.eye(2))
    return jf.Model(f, Q, jf.vector(2), {"z": jf.Sensor(lambda x, c: x[0], jf.const(0.04 * jnp.eye(1)), jf.scalar)})


def drag_start(theta):
    return jf.Gaussian(jnp.zeros(2), 0.5 * jnp.eye(2))


def test_singular_noise_along_which_the_dynamics_bend_is_the_limit_of_regular_noise():
    log = jf.schedule(drag(0.0), 8, 1.0)
    bound = cramer_rao(drag, drag_start, log, KEY, theta=jnp.asarray(0.0), runs=20_000)
    assert bound.exact

    rng, eps = np.random.default_rng(1), 1e-8
    weight = np.linalg.inv(0.09 * np.outer(ALONG, ALONG) + eps * np.eye(2))
    information = np.diag([1 / 0.04, 0.0])
    x, D = rng.normal(0, np.sqrt(0.5), (40_000, 2)), []
    for _ in range(8):
        slope = 1.5 / np.cosh(x[:, 0] - x[:, 1]) ** 2
        F = ACROSS + slope[:, None, None] * np.outer(ALONG, [1.0, -1.0])
        D.append((np.mean(F.transpose(0, 2, 1) @ weight @ F, axis=0), -F.mean(0).T @ weight, weight + information))
        push = 1.5 * np.tanh(x[:, 0] - x[:, 1]) + rng.normal(0, 0.3, len(x))
        x = x @ ACROSS.T + push[:, None] * ALONG + rng.normal(0, np.sqrt(eps), x.shape)
    expected = printed(D, np.eye(2) / 0.5)
    size = np.diagonal(expected, axis1=1, axis2=2)
    assert (np.abs(bound.cov - expected) < 0.02 * np.sqrt(size[:, :, None] * size[:, None, :])).all()
    # The spread along the noise counts: without it the answer would be another.
    assert bound.linearised[0, 1, 1] > 2 * bound.cov[0, 1, 1]


# --- the noise does not reach: approximate ----------------------------------------------------------------------------


def cart(theta):
    """A position that integrates the sine of a heading; noise on the heading, and theta["eps"] on the position."""
    f = lambda x, u, dt: jnp.stack([x[0] + jnp.sin(x[1]), x[1]])  # noqa: E731
    Q = jf.const(jnp.diag(jnp.stack([theta["eps"], (0.2 * theta["size"]) ** 2])))
    gnss = jf.Sensor(lambda x, c: x[0], jf.const((0.5 * theta["size"])[None, None] ** 2), jf.scalar)
    return jf.Model(f, Q, jf.vector(2), {"gnss": gnss})


def cart_start(theta):
    return jf.Gaussian(jnp.array([0.0, 0.8]), theta["size"] ** 2 * jnp.diag(jnp.array([0.25, 0.09])))


def cart_bound(size, eps=0.0, runs=2000):
    theta = {"size": jnp.asarray(size), "eps": jnp.asarray(eps)}
    return cramer_rao(cart, cart_start, jf.schedule(cart(theta), 6, 1.0), KEY, theta=theta, runs=runs)


def noise_coordinates(size, steps=6, runs=20_000):
    """Van Trees' bound with the start and the noises as unknowns: ``E[G] (E[I])^-1 E[G]'``, a bound for any Q."""
    rng = np.random.default_rng(2)
    std = size * np.r_[0.5, 0.3, np.full(steps, 0.2)]
    w = rng.normal(size=(runs, 2 + steps)) * std
    x, G = np.array([0.0, 0.8]) + w[:, :2], np.zeros((runs, 2, 2 + steps))
    G[:, 0, 0] = G[:, 1, 1] = 1.0
    information, covs = np.diag(1 / std**2), []
    for k in range(steps):
        G[:, 0] += np.cos(x[:, 1])[:, None] * G[:, 1]
        G[:, 1, 2 + k] += 1.0
        x = np.stack([x[:, 0] + np.sin(x[:, 1]), x[:, 1] + w[:, 2 + k]], axis=1)
        information = information + np.mean(G[:, 0, :, None] * G[:, 0, None, :], axis=0) / (0.5 * size) ** 2
        covs.append(G.mean(0) @ np.linalg.inv(information) @ G.mean(0).T)
    return np.stack(covs)


def test_where_noise_does_not_reach_it_is_approximate_and_meets_a_bound_in_the_limit():
    gaps = []
    for size in (0.05, 0.2, 0.8):
        found, least = cart_bound(size), noise_coordinates(size)
        assert not found.exact
        assert found.kind == (
            "approximate: the noise does not reach every direction in which the nonlinear dynamics act, so each truth "
            "is linearised by itself, which will do for small errors"
        )
        np.testing.assert_array_equal(found.cov, found.linearised)
        scale = np.sqrt(np.diagonal(least, axis1=1, axis2=2))
        gap = np.linalg.eigvalsh((found.cov - least) / (scale[:, :, None] * scale[:, None, :]))
        assert gap.min() > -0.02, "Jensen: never below the bound, but for the two Monte Carlo means"
        gaps.append(gap.max())
    assert gaps[0] < 0.02 < 0.1 < gaps[2]


def test_nearly_singular_noise_agrees_until_it_is_too_small_to_say_anything():
    """On the way to the limit the exact bound meets the approximate one, and goes on: it ends with nothing known."""
    approximate = cart_bound(0.05).cov
    near, far = cart_bound(0.05, eps=1e-5), cart_bound(0.05, eps=1e-12)
    assert near.exact
    assert far.exact
    np.testing.assert_allclose(near.cov[:, 0, 0], approximate[:, 0, 0], rtol=0.05)
    np.testing.assert_allclose(near.cov[:, 1, 1], approximate[:, 1, 1], rtol=0.05)
    np.testing.assert_allclose(far.linearised, approximate, rtol=1e-3)
    assert (far.cov[:, 1, 1] <= 1.001 * (0.2 * 0.05) ** 2).all(), "all that it leaves is the last step's noise"
    assert (approximate[:, 1, 1] > 1.5 * (0.2 * 0.05) ** 2).all()


def labelled(change):
    def model(theta):
        robot = bend(theta)
        return change(robot)

    return cramer_rao(model, bend_start, jf.schedule(bend(BEND), 3, 1.0), KEY, theta=BEND, runs=20)


def with_R(R):
    return lambda robot: robot._replace(sensors={"z": robot.sensors["z"]._replace(R=R)})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda robot: robot._replace(Q=lambda x, u, dt: (0.1 + x**2)[None, None]), "Q differs from truth to truth"),
        (with_R(lambda x, c: (0.1 + x**2)[None, None]), "R of sensor 'z' differs from truth to truth"),
        (with_R(lambda x, c: jnp.zeros((1, 1))), "R of sensor 'z' is singular"),
    ],
)
def test_noise_for_which_the_formula_does_not_hold_is_named(change, words):
    bound = labelled(change)
    assert not bound.exact
    assert bound.kind.startswith("approximate: " + words + ", so each truth")
    np.testing.assert_array_equal(bound.cov, bound.linearised)


def test_an_input_that_follows_the_truth_is_named_where_it_tells_of_the_state():
    log = jf.schedule(bend(BEND), 3, 1.0, u=np.zeros(3))
    bound = cramer_rao(bend, bend_start, log, KEY, theta=BEND, runs=20, control=lambda x, u: u - x)
    assert not bound.exact
    assert bound.kind == "approximate: the inputs follow the true state, and what they tell of it is left out"


def test_on_a_curved_space_it_is_a_small_error_bound():
    """A turn at a constant rate, isotropic noises: the covariance of each axis is a scalar Kalman filter's."""

    def spin(theta):
        f = lambda q, u, dt: jf.so3.plus(q, dt * jnp.array([0.3, -0.5, 1.0]))  # noqa: E731
        att = jf.Sensor(lambda q, c: q, jf.const(theta["r"] * jnp.eye(3)), jf.so3)
        return jf.Model(f, jf.const(theta["q"] * jnp.eye(3)), jf.so3, {"att": att})

    start = lambda theta: jf.Gaussian(jnp.array([1.0, 0, 0, 0]), theta["q"] * jnp.eye(3))  # noqa: E731
    theta = {"q": jnp.asarray(1e-4), "r": jnp.asarray(4e-4)}
    bound = cramer_rao(spin, start, jf.schedule(spin(theta), 5, 0.1), KEY, theta=theta, runs=10)
    assert not bound.exact
    assert bound.kind == "approximate: the space is curved, and its tangent will do for small errors"
    p = 1e-4
    for cov in bound.cov:
        p = 1 / (1 / (p + 1e-4) + 1 / 4e-4)
        np.testing.assert_allclose(cov, p * np.eye(3), rtol=1e-9, atol=1e-15)


# --- filters try ------------------------------------------------------------------------------------------------------

RUNS = 4000


@pytest.fixture(scope="module")
def errors():
    """Mean squared errors (T, 1, 1) of two filters on `bend`, one program for all sizes of the noise."""
    log = jf.schedule(bend(BEND), 10, 1.0)

    @jax.jit
    def mse(theta):
        def one(key):
            truth, seen = jf.simulate(bend(theta), bend_start(theta), log, key)
            filters = {"ekf": jf.ekf(bend(theta)), "ukf": jf.ukf(bend(theta))}
            means = {n: jf.scan(filt, bend_start(theta), seen, jf.mean_only) for n, filt in filters.items()}
            return jax.tree.map(lambda m: (truth - m) ** 2, means)

        squares = jax.vmap(one)(jax.random.split(jax.random.key(7), RUNS))
        return jax.tree.map(lambda s: s.mean(0)[:, None, None], squares)

    def at(size):
        theta = jax.tree.map(lambda a: size * a, BEND)
        bound = cramer_rao(bend, bend_start, log, KEY, theta=theta, runs=2000)
        assert bound.exact
        blocks = {"x": ((0,), "m")}
        return {name: efficiency(bound.cov, np.asarray(e), blocks)["x"] for name, e in mse(theta).items()}

    return at


def test_no_filter_beats_it(errors):
    for size in (0.3, 1.0):
        for name, e in errors(size).items():
            assert (e < 1 + 4 * np.sqrt(2 / RUNS)).all(), f"{name} at {size}: {e}"


def test_small_noise_makes_a_filter_efficient(errors):
    small, large = errors(0.02)["ekf"], errors(1.0)["ekf"]
    assert (np.abs(small - 1) < 4 * np.sqrt(2 / RUNS)).all()
    assert large.mean() < 0.9


# --- efficiency -------------------------------------------------------------------------------------------------------


def test_efficiency_by_block_and_in_total():
    bound = np.array([np.diag([1.0, 1.0, 4.0]), np.diag([1.0, 2.0, 0.0])])
    mse = np.array([np.diag([2.0, 4.0, 4.0]), np.diag([1.0, 2.0, 0.0])])
    found = efficiency(bound, mse, {"position": ((0, 1), "m"), "speed": ((2,), "m/s")})
    np.testing.assert_allclose(found["position"], [1 / 3, 1.0])
    np.testing.assert_allclose(found["speed"], [1.0, np.nan])
    np.testing.assert_allclose(found["total"], [(0.5 + 0.25 + 1.0) / 3, 1.0])


@pytest.mark.parametrize(
    ("bound", "mse", "blocks", "text"),
    [
        ((3, 2, 2), (4, 2, 2), {}, r"expected bound and mse of one shape \(T, n, n\), got \(3, 2, 2\), \(4, 2, 2\)"),
        ((3, 2), (3, 2), {}, r"expected bound and mse of one shape"),
        ((3, 2, 2), (3, 2, 2), {"yaw": ((2,), "rad")}, r"blocks: expected indices from 0 to 1 .*, got 'yaw': \(2,\)"),
        ((3, 2, 2), (3, 2, 2), {"total": ((0,), "")}, "no name 'total'"),
    ],
)
def test_efficiency_names_what_is_wrong(bound, mse, blocks, text):
    with pytest.raises(ValueError, match=text):
        efficiency(np.ones(bound), np.ones(mse), blocks)


# --- bad input --------------------------------------------------------------------------------------------------------


def test_bad_arguments_are_named():
    log = jf.schedule(bend(BEND), 3, 1.0)
    flat = lambda theta: jf.Gaussian(jnp.asarray(0.5), -jnp.eye(1))  # noqa: E731
    with pytest.raises(ValueError, match="runs: expected at least 2, got 1"):
        cramer_rao(bend, bend_start, log, KEY, theta=BEND, runs=1)
    with pytest.raises(ValueError, match=r"belief\(theta\).cov: expected variances >= 0"):
        cramer_rao(bend, flat, log, KEY, theta=BEND)
    with pytest.raises(KeyError, match="expected one of"):
        cramer_rao(bend, bend_start, log._replace(z={"sonar": np.zeros(3)}), KEY, theta=BEND)
    with pytest.raises(ValueError, match=r"Q\(x, u, dt\): expected shape \(1, 1\), got \(2, 2\)"):
        labelled(lambda robot: robot._replace(Q=jf.const(jnp.eye(2))))
    with pytest.raises(ValueError, match=r"expected finite numbers, got none from row 1: do f, Q, h and R hold"):
        labelled(lambda robot: robot._replace(f=lambda x, u, dt: jnp.sqrt(5.0 - x) + 10.0))
