"""Gradients: of the likelihood and of a squared error, with respect to noises, dynamics, start and readings.

Reverse mode against central differences and against forward mode, in float64, on rows with dt = 0, silent sensors and
missing components; and finite where the textbook's formulas are not: at zero angle, at half a turn, at zero distance.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from systems import SYSTEMS, Body, Car

import jaxfilt as jf

STEPS = 12
CASES = {
    "linear kf": ("linear", jf.kf, ["wide", "arm"]),
    "pendulum gauss_hermite": ("pendulum", lambda model: jf.build(jf.gauss_hermite(3), model), ["side"]),
    "car ekf": ("car", jf.ekf, ["gnss", "mark"]),
    "car iekf": ("car", lambda model: jf.iekf(model, iterations=2), ["mark"]),
    "car ukf": ("car", lambda model: jf.ukf(model, alpha=0.6), ["mark"]),
    "body ekf": ("body", jf.ekf, ["camera"]),
}
SLOW = {"body ekf"}
PARAMETERS = [pytest.param(case, marks=pytest.mark.long if case in SLOW else ()) for case in CASES]


def loss(system, factory, parameters, belief, log):
    """Minus the log-likelihood, plus the squared distance of the means to where they began."""
    model = system.model(parameters["theta"])
    start = belief._replace(cov=jnp.exp(parameters["P0"]) * belief.cov)

    def store(b, info):
        away = model.space.minus(b.mean, belief.mean)
        return 0.1 * away @ away - sum(i.loglik for i in info.values())

    return jf.scan(factory(model), start, log._replace(z=parameters["z"]), store=store).sum()


def only(log, sensors):
    """The log with these sensors alone."""
    return log._replace(
        **{field: {n: v for n, v in getattr(log, field).items() if n in sensors} for field in ("z", "c", "valid")}
    )


@functools.cache
def compiled(case):
    """(system, parameters, value and reverse gradient, derivative along a direction): the functions jitted."""
    name, factory, sensors = CASES[case]
    s = SYSTEMS[name](STEPS)
    s = s._replace(log=only(s.log, sensors))
    value_and_grad = jax.jit(jax.value_and_grad(functools.partial(loss, s, factory)))

    @jax.jit
    def along(parameters, direction, belief, log):
        return jax.jvp(lambda p: loss(s, factory, p, belief, log), (parameters,), (direction,))

    return s, {"theta": s.theta, "z": s.log.z, "P0": np.array(0.1)}, value_and_grad, along


def numbers(tree):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])


def unflatten(like, x):
    leaves, structure = jax.tree.flatten(like)
    parts = np.split(x, np.cumsum([np.size(leaf) for leaf in leaves])[:-1])
    return structure.unflatten([part.reshape(np.shape(leaf)) for part, leaf in zip(parts, leaves, strict=True)])


@pytest.mark.parametrize("case", PARAMETERS)
def test_equal_central_differences(case):
    s, parameters, value_and_grad, _ = compiled(case)
    x = numbers(parameters)
    gradient = numbers(value_and_grad(parameters, s.belief, s.log)[1])
    scale, step = np.abs(gradient).max(), 1e-5
    assert scale > 1e-2
    for i in range(len(x)):
        at = [
            value_and_grad(unflatten(parameters, x + h * np.eye(len(x))[i]), s.belief, s.log)[0] for h in (step, -step)
        ]
        # A value of size V carries rounding V eps, which the difference divides by the step.
        rounding = 100 * np.finfo(float).eps * abs(at[0]) / step
        np.testing.assert_allclose(gradient[i], (at[0] - at[1]) / (2 * step), rtol=1e-6, atol=1e-7 * scale + rounding)


@pytest.mark.parametrize("case", PARAMETERS)
def test_forward_mode_is_reverse_mode(case):
    s, parameters, value_and_grad, along = compiled(case)
    value, gradient = value_and_grad(parameters, s.belief, s.log)
    rng = np.random.default_rng(8)
    for _ in range(3):
        direction = unflatten(parameters, rng.normal(size=numbers(parameters).shape))
        there, slope = along(parameters, direction, s.belief, s.log)
        np.testing.assert_allclose(there, value, rtol=1e-12)
        np.testing.assert_allclose(slope, numbers(gradient) @ numbers(direction), rtol=1e-10)


@pytest.mark.parametrize("case", PARAMETERS)
def test_what_was_not_seen_has_no_gradient(case):
    s, parameters, value_and_grad, _ = compiled(case)
    gradient = value_and_grad(parameters, s.belief, s.log)[1]["z"]
    for name, valid in s.log.valid.items():
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(gradient[name])]
        assert not valid.all()
        for leaf in leaves:
            unseen = ~(valid if valid.shape == leaf.shape else valid.reshape(len(valid), -1).any(axis=1))
            np.testing.assert_array_equal(leaf[unseen], 0.0)
        assert any(leaf.any() for leaf in leaves)


# --- special points: the same programs, other numbers --------------------------------------------------------------


def every_row(s, belief, z, u=None, c=None):
    """The system's arguments with the same reading in every row, everything seen."""
    repeat = lambda tree: jax.tree.map(lambda a: np.repeat(np.asarray(a, float)[None], STEPS, 0), tree)  # noqa: E731
    valid = {name: np.ones_like(v) for name, v in s.log.valid.items()}
    log = s.log._replace(u=np.zeros_like(s.log.u), c=repeat(c or {}), valid=valid)
    return belief, log, repeat(z)


def turned(angle, axis=(0.6, 0.0, 0.8)):
    return Rotation.from_rotvec(angle * np.array(axis)).as_quat(scalar_first=True)


def at_rest(s, yaw=0.0, mark=(10.0, 0.0), bearing=0.0):
    """A car at the origin that stands still, and a landmark ahead."""
    belief = s.belief._replace(mean=Car(np.zeros(2), np.array(yaw), np.array(0.0)))
    distance = np.array(np.hypot(*mark))
    z = {"gnss": np.zeros(2), "mark": (distance, np.array(bearing))}
    return every_row(s, belief, {name: z[name] for name in s.log.z}, c={"mark": np.array(mark)})


def tilted(s, seen, believed=0.0):
    """A body that does not turn, believed at one angle and seen by the camera at another."""
    belief = s.belief._replace(mean=Body(turned(believed), np.zeros(3)))
    return every_row(s, belief, {"camera": turned(seen)})


PI = np.pi
POINTS = {
    "car": {
        "zero angle": lambda s: at_rest(s),
        "half a turn": lambda s: at_rest(s, yaw=PI, bearing=0.0),
        "nearly half a turn": lambda s: at_rest(s, bearing=PI - 1e-9),
        "just beyond half a turn": lambda s: at_rest(s, bearing=-PI + 1e-9),
        "at the landmark": lambda s: at_rest(s, mark=(0.0, 0.0)),
    },
    "body": {
        "zero angle": lambda s: tilted(s, 0.0),
        "tiny angle": lambda s: tilted(s, 1e-9),
        "nearly half a turn": lambda s: tilted(s, PI - 1e-7),
        "half a turn": lambda s: tilted(s, PI),
        "just beyond half a turn": lambda s: tilted(s, PI + 1e-7),
        "between two half turns": lambda s: tilted(s, -PI + 0.1, PI - 0.1),
    },
}
SPECIAL = [
    pytest.param(case, point, marks=pytest.mark.long if case in SLOW else ())
    for case, (name, _, _) in CASES.items()
    for point in POINTS.get(name, {})
]


@pytest.mark.parametrize(("case", "point"), SPECIAL)
def test_finite_at_special_points(case, point):
    s, parameters, value_and_grad, along = compiled(case)
    belief, log, z = POINTS[CASES[case][0]][point](s)
    parameters = dict(parameters, z=z)
    value, gradient = value_and_grad(parameters, belief, log)
    assert np.isfinite(value)
    assert np.all(np.isfinite(numbers(gradient)))
    direction = unflatten(parameters, np.random.default_rng(9).normal(size=numbers(parameters).shape))
    slope = along(parameters, direction, belief, log)[1]
    np.testing.assert_allclose(slope, numbers(gradient) @ numbers(direction), rtol=1e-7)


def test_finite_and_the_same_where_vmap_turns_branches_into_selects():
    """Over a batch with its own dt and valid, as in tuning: what is not taken is then computed and thrown away."""
    s, parameters, value_and_grad, _ = compiled("car ukf")
    rng = np.random.default_rng(4)

    def another(log):
        silent = rng.random(STEPS) < 0.5
        seen = {"mark": log.valid["mark"] & ~silent}
        # What is absent may be anything finite: here a landmark at the origin.
        c = {"mark": np.where(seen["mark"][:, None], log.c["mark"], 0.0)}
        return log._replace(dt=np.where(silent, 0.0, log.dt), c=c, valid=seen)

    logs = [another(s.log) for _ in range(3)]
    batch = jax.tree.map(lambda *a: np.stack(a), *logs)

    @jax.jit
    @jax.value_and_grad
    def total(parameters):
        return jax.vmap(lambda log: loss(s, CASES["car ukf"][1], parameters, s.belief, log))(batch).sum()

    value, gradient = total(parameters)
    singles = [value_and_grad(parameters, s.belief, log) for log in logs]
    np.testing.assert_allclose(value, sum(v for v, _ in singles), rtol=1e-11)
    got, want = numbers(gradient), sum(numbers(g) for _, g in singles)
    assert np.all(np.isfinite(got))
    np.testing.assert_allclose(got, want, rtol=1e-8, atol=1e-9 * np.abs(want).max())


def test_a_model_is_never_asked_what_happens_in_no_time():
    """Where vmap computes both branches, f and Q that divide by dt would poison the gradients of rows with dt = 0."""
    sensor = jf.Sensor(lambda x, c: x, jf.const(jnp.eye(1)), jf.vector(1))

    def loglik(q, dt):
        def f(x, u, dt):
            return x + jnp.sqrt(dt) * jnp.log(dt)

        model = jf.Model(f, lambda x, u, dt: q / dt * jnp.eye(1), jf.vector(1), {"z": sensor})
        log = jf.Log(dt, (), {"z": jnp.ones((3, 1))}, {}, {})
        return jf.log_likelihood(jf.ekf(model), jf.Gaussian(jnp.zeros(1), jnp.eye(1)), log)

    dts = np.array([[0.5, 0.0, 0.2], [0.0, 0.0, 0.1]])
    total = jax.jit(lambda q, dts: jax.vmap(loglik, in_axes=(None, 0))(q, dts).sum())
    slope, slopes = jax.jit(jax.grad(total, argnums=(0, 1)))(2.0, dts)
    assert np.all(np.isfinite(slopes))
    np.testing.assert_array_equal(np.asarray(slopes)[dts == 0], 0.0)
    np.testing.assert_allclose(slope, (total(2.0 + 1e-6, dts) - total(2.0 - 1e-6, dts)) / 2e-6, rtol=1e-6)
