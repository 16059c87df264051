"""Parallel in time: the same answers as row by row, and nothing else let in."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import dense_posterior, rows_of
from systems import H, book_covariance, linear_system, pendulum_system

import jaxfilt as jf
from jaxfilt.parallel.affine import grade
from jaxfilt.parallel.filtering import Passage, composed
from jaxfilt.smooth import smooth

WALK = {"A": jnp.eye(1), "H": jnp.eye(1), "Q": jnp.eye(1), "R": jnp.eye(1)}
START = jf.Gaussian(jnp.zeros(1), jnp.eye(1))


def walk_log(steps: int = 6) -> jf.Log:
    return jf.Log(jnp.ones(steps), (), {"z": jnp.arange(steps, dtype=float)[:, None]}, {}, {})


def off(a: Any, b: Any) -> float:
    """Largest difference of two trees, relative to the largest entry of each array; integers must be the same."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    worst = 0.0
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        x, y = np.asarray(x), np.asarray(y)
        assert (x.shape, x.dtype) == (y.shape, y.dtype)
        if x.dtype.kind == "f":
            size = np.abs(x).max(initial=0.0)
            worst = max(worst, float(np.abs(x - y).max(initial=0.0) / (size if size > 0 else 1.0)))
        else:
            np.testing.assert_array_equal(x, y)
    return worst


def both(filter: jf.Filter, belief: jf.Gaussian, log: jf.Log, segment: int | None = None) -> tuple[Any, Any]:
    row_by_row = jax.jit(lambda b, log: jf.scan(filter, b, log))(belief, log)
    return row_by_row, jax.jit(lambda b, log: jf.scan(filter, b, log, segment=segment, parallel=True))(belief, log)


@pytest.mark.parametrize(("steps", "segment"), [(41, None), (40, 1), (1, None)])
def test_the_same_as_row_by_row_with_inputs_silences_and_lost_components(steps: int, segment: int | None):
    system = linear_system(steps)
    one, other = both(jf.kf(system.model(system.theta)), system.belief, system.log, segment)
    assert off(one, other) < 1e-12


def test_the_same_as_the_dense_posterior():
    system = linear_system(30)
    log = system.log
    track = jax.jit(lambda log: jf.scan(jf.kf(system.model(system.theta)), system.belief, log, parallel=True))(log)
    belief, likelihoods = track.belief, sum(info.loglik for info in track.info.values())
    Q, Rs = book_covariance(system.theta["q"], 2), {k: book_covariance(system.theta[k], 3 + i) for i, k in enumerate(H)}
    B = np.array([[0.0, 0.1], [1.0, 0.0], [0.3, -0.5]])
    rows = rows_of(log, system.book(system.theta))
    mean, cov, loglik = dense_posterior(system.theta["A"], B, Q, system.start, system.belief.cov, rows, H, Rs)
    np.testing.assert_allclose(belief.mean[-1], mean, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(belief.cov[-1], cov, rtol=1e-9, atol=1e-10)
    assert abs(float(jnp.sum(likelihoods)) - loglik) < 1e-9 * abs(loglik)


class Ship(NamedTuple):
    """A state that is no vector."""

    pos: Any  # (2,) m
    speed: Any  # () m/s
    offset: Any  # () m, of the ranges, never moves


def ship(stiff: float) -> tuple[jf.Filter, jf.Gaussian, jf.Log]:
    """Time-varying in all that may vary: u turns the speed, contexts are maps H, dt is irregular; sharp readings."""
    rng, steps = np.random.default_rng(5), 60

    def f(x: Ship, u: Any, dt: Any) -> Ship:
        return Ship(x.pos + dt * x.speed * jnp.stack([jnp.cos(u), jnp.sin(u)]), 0.9 * x.speed + 1.0, x.offset)

    space = jf.product(Ship(jf.vector(2), jf.scalar, jf.scalar))
    sensors = {
        "range": jf.Sensor(lambda x, c: c @ x.pos + x.offset, lambda x, c: stiff * (1 + c @ c)[None, None], jf.scalar),
        "log": jf.Sensor(lambda x, c: 2 * x.speed + 1.0, jf.const(jnp.array([[0.1]])), jf.scalar),
    }
    model = jf.Model(f, jf.white(jnp.diag(jnp.array([0.1, 0.2, 0.3, 0.0]))), space, sensors)
    P = jnp.diag(jnp.array([100.0, 50.0, 4.0, 1.0]))
    start = jf.Gaussian(Ship(jnp.array([1e5, -3e4]), jnp.array(2.0), jnp.array(0.0)), P)
    dt = rng.uniform(0, 1, steps) * (rng.random(steps) > 0.2)
    c = rng.normal(size=(steps, 2))
    z = {"range": c @ np.array([1e5, -3e4]) + rng.normal(size=steps), "log": 20 + rng.normal(size=steps)}
    return jf.ekf(model), start, jf.Log(dt, rng.uniform(0, 6, steps), z, {"range": c}, {"log": rng.random(steps) < 0.5})


@pytest.mark.parametrize(("stiff", "segment"), [(1.0, 7), (1e-8, 1)])
def test_time_varying_maps_on_a_state_that_is_a_tree(stiff: float, segment: int):
    one, other = both(*ship(stiff), segment)
    assert off(one, other) < 1e-9
    assert np.linalg.eigvalsh(np.asarray(other.belief.cov)).min() > -1e-12


def test_whatever_is_stored_and_the_size_of_a_segment():
    filt = jf.kf(jf.linear(**WALK))
    one, other = (
        jf.scan(filt, START, walk_log(), lambda b, info: (b.mean, info["z"].status), parallel=p) for p in (False, True)
    )
    assert off(one, other) < 1e-12
    with pytest.raises(ValueError, match="segment: expected at least one row, got 0"):
        jf.scan(filt, START, walk_log(), segment=0, parallel=True)


def moving(theta: Any) -> jf.Model:
    """Position and speed, of which a mixture is measured."""
    A = jnp.array([[1.0, 0.1], [-0.2, 0.9]], theta.dtype)
    H = jnp.array([[1.0, 0.3]], theta.dtype)
    return jf.linear(A, H, jnp.diag(jnp.exp(theta[:2])), jnp.exp(theta[2:])[:, None])


def moving_log(dtype: Any = float) -> tuple[jf.Gaussian, jf.Log]:
    rng = np.random.default_rng(3)
    log = jf.Log(np.ones(17, dtype), (), {"z": rng.normal(size=(17, 1)).astype(dtype)}, {}, {"z": rng.random(17) < 0.8})
    return jf.Gaussian(np.ones(2, dtype), np.eye(2, dtype=dtype)), log


def test_runs_parameters_and_gradients():
    belief, log = moving_log()
    z = jnp.stack([log.z["z"], 2 * log.z["z"]])

    def loss(theta: Any, parallel: bool) -> Any:
        def one(z: Any) -> Any:
            return jf.log_likelihood(jf.kf(moving(theta)), belief, log._replace(z={"z": z}), parallel=parallel)

        return jax.vmap(one)(z).sum()

    theta = jnp.array([-2.0, -1.0, 0.5])
    one, other = (jax.jit(jax.value_and_grad(lambda t, p=p: loss(t, p)))(theta) for p in (False, True))
    assert off(one, other) < 1e-9


def test_float32():
    one, other = both(jf.kf(moving(jnp.array([-2.0, -1.0, 0.5], jnp.float32))), *moving_log(np.float32))
    assert other.belief.cov.dtype == jnp.float32
    assert off(one, other) < 2e-5


def test_a_reading_that_is_nan_is_reported_where_it_came_and_after():
    log = walk_log(9)
    log = log._replace(z={"z": log.z["z"].at[4, 0].set(jnp.nan)})
    one, other = both(jf.kf(jf.linear(**WALK)), START, log, 2)
    np.testing.assert_array_equal(one.info["z"].status, other.info["z"].status)
    assert other.info["z"].status.tolist() == 4 * [jf.Status.OK] + [jf.Status.BAD_MEASUREMENT] + 4 * [
        jf.Status.BAD_BELIEF
    ]


OTHERS = {
    "gate": lambda model: jf.kf(model, gate=0.99),
    "robust": lambda model: jf.kf(model, robust=0.9),
    "iekf": jf.iekf,
    "ukf": jf.ukf,
    "ckf": jf.ckf,
    "dead reckoning": jf.dead_reckoning,
    "an ekf of another model": lambda model: jf.kf(jf.linear(**(WALK | {"R": 2 * jnp.eye(1)})))._replace(model=model),
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_filters_are_refused(name: str):
    filt = OTHERS[name](jf.linear(**WALK))
    with pytest.raises(ValueError, match="filter: expected kf or ekf without gate and robust"):
        jf.scan(filt, START, walk_log(), parallel=True)


def changed(**parts: Any) -> jf.Model:
    """A walk with something else in place of f, Q, h or R."""
    model = jf.linear(**WALK)
    sensor = model.sensors["z"]
    found = jf.Sensor(parts.get("h", sensor.h), parts.get("R", sensor.R), parts.get("readings", sensor.space))
    return jf.Model(parts.get("f", model.f), parts.get("Q", model.Q), parts.get("space", model.space), {"z": found})


NOT_LINEAR = {
    r"f\(x, u, dt\) affine in x .* sin of x": {"f": lambda x, u, dt: jnp.sin(x)},
    r"f\(x, u, dt\) affine in x .* sign of x": {"f": lambda x, u, dt: x + jnp.sign(x)},
    r"f\(x, u, dt\) affine in x .* gt of x": {"f": lambda x, u, dt: jnp.where(x > 0, x, 2 * x)},
    r"f\(x, u, dt\) affine in x .* mul of x": {"f": lambda x, u, dt: x * x},
    r"Q\(x, u, dt\) that does not depend on x": {"Q": lambda x, u, dt: jnp.eye(1) + 0 * x[None]},
    r"h\(x, c\) of sensor 'z' affine in x .* div of x": {"h": lambda x, c: 1 / x},
    r"R\(x, c\) of sensor 'z' that does not depend on x .* mul of x": {"R": lambda x, c: (x * x)[None]},
    r"plus of sensor 'z' affine in x .* round of x": {
        "readings": jf.product([jf.angle]),
        "h": lambda x, c: [x[0]],
    },
}


@pytest.mark.parametrize("complaint", NOT_LINEAR)
def test_models_that_are_not_linear_are_refused(complaint: str):
    model, log = changed(**NOT_LINEAR[complaint]), walk_log()
    if isinstance(model.sensors["z"].space.origin, list):
        log = log._replace(z={"z": [log.z["z"][:, 0]]})
    with pytest.raises(ValueError, match=complaint):
        jf.scan(jf.kf(model), START, log, parallel=True)


def test_an_angle_as_state_is_refused():
    model = changed(space=jf.product([jf.angle]), f=lambda x, u, dt: [jf.wrap(x[0])], h=lambda x, c: x[0][None])
    with pytest.raises(ValueError, match=r"plus of the state affine in x .* round of x"):
        jf.scan(jf.kf(model), jf.Gaussian([jnp.zeros(())], jnp.eye(1)), walk_log(), parallel=True)


def test_a_nonlinear_system_is_refused_under_jit_too():
    system = pendulum_system(10)
    run = jax.jit(lambda b, log: jf.scan(jf.ekf(system.model(system.theta)), b, log, parallel=True))
    with pytest.raises(ValueError, match="sin of x"):
        run(system.belief, system.log)


def looped(x: Any, times_x: bool) -> Any:
    return jax.lax.scan(lambda s, _: (s * x if times_x else s + 2 * x, ()), x, None, length=3)[0]


def late(x: Any) -> Any:
    """Constant after one turn, affine after two, a square after three."""
    body = lambda s, _: ((s[0] + x, s[1] + s[0] * s[0]), ())  # noqa: E731
    return jax.lax.scan(body, (jnp.zeros(3), jnp.zeros(3)), None, length=3)[0][1]


GRADES = {
    "constant": (lambda x: jnp.ones(3) * 2, 0),
    "its shape": (lambda x: jnp.zeros_like(x) + x.shape[0], 0),
    "affine": (lambda x: jnp.concatenate([2 * x[:1] - 1, x[::-1] / 3]).sum() + jnp.eye(3) @ x, 1),
    "picked by a constant": (lambda x: jnp.where(jnp.arange(3) > 1, x, -x), 1),
    "jit, checkpoint and indices": (lambda x: jax.checkpoint(jax.jit(lambda y: y[jnp.array([2, 0])].sum()))(x), 1),
    "written into": (lambda x: jnp.zeros(4).at[1].set(x[0]).at[2].add(x[1]), 1),
    "loop": (lambda x: looped(x, False), 1),
    "branch": (lambda x: jax.lax.cond(jnp.arange(3).sum() > 1, lambda y: y, lambda y: 2 * y, x), 1),
    "solved": (lambda x: jax.scipy.linalg.solve_triangular(jnp.eye(3), x, lower=True), 1),
    "product": (lambda x: x @ x, 2),
    "index by x": (lambda x: jnp.arange(3.0)[x[0].astype(int)], 2),
    "rounded": (lambda x: x.astype(int).astype(float), 2),
    "denominator": (lambda x: 1 / x, 2),
    "loop of products": (lambda x: looped(x, True), 2),
    "loop that squares in its second turn": (late, 2),
    "branch by x": (lambda x: jax.lax.cond(x[0] > 1, lambda y: y, lambda y: 2 * y, x), 2),
    "norm": (lambda x: jf.norm(x), 2),
    "wrapped": (lambda x: jf.wrap(x[0]), 2),
    "nothing known of": (lambda x: jax.lax.sort(x), 2),
}


@pytest.mark.parametrize("name", GRADES)
def test_grade(name: str):
    function, level = GRADES[name]
    assert grade(function, jnp.ones(3)).level == level


def test_passages_compose_associatively():
    def passage(seed: int) -> Passage:
        rng = np.random.default_rng(seed)
        A, C, J = rng.normal(size=(3, 3, 3))
        J[:, 2:] = C[:, 1:] = 0  # singular, both
        return Passage(A, rng.normal(size=3), 1e-6 * C @ C.T, rng.normal(size=3), 1e6 * J @ J.T)

    i, j, k = (jax.tree.map(jnp.asarray, passage(s)) for s in range(3))
    assert off(composed(composed(i, j), k), composed(i, composed(j, k))) < 1e-9
    still = Passage(jnp.eye(3), jnp.zeros(3), jnp.zeros((3, 3)), jnp.zeros(3), jnp.zeros((3, 3)))
    assert max(off(composed(i, still), i), off(composed(still, i), i)) < 1e-14


@pytest.mark.parametrize(("make", "name"), [(linear_system, "kf"), (pendulum_system, "ukf")])
def test_smoothing_all_rows_at_once(make: Any, name: str):
    system = make(45)
    filt = getattr(jf, name)(system.model(system.theta))
    track = jax.jit(lambda: jf.scan(filt, system.belief, system.log))()
    one, other = (jax.jit(lambda track, p=p: smooth(filt, track, system.log, p))(track) for p in (False, True))
    assert off(one, other) < 1e-9


def test_no_smoothing_at_once_on_a_curved_space():
    model = changed(space=jf.so3, f=lambda x, u, dt: x, Q=jf.const(jnp.eye(3)), h=lambda x, c: x[:1])
    beliefs = jf.Gaussian(jnp.tile(jnp.array([1.0, 0, 0, 0]), (6, 1)), jnp.tile(jnp.eye(3), (6, 1, 1)))
    with pytest.raises(ValueError, match="expected a state on a flat space"):
        smooth(jf.ekf(model), jf.Track(beliefs, {}), walk_log(), parallel=True)
