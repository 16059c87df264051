"""Many runs at once are the runs one by one; a second call compiles nothing; what all runs share is computed once."""

import contextlib
import functools
import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import FILTERS, SYSTEMS

import jaxfilt as jf

RUNS, STEPS = 5, 12
system = functools.cache(lambda name: SYSTEMS[name](STEPS))


@functools.cache
def scan(name, filter):
    """A jitted scan of a system, with nothing baked in."""
    s = system(name)
    return jax.jit(lambda theta, b, log: jf.scan(FILTERS[filter](s.model(theta)), b, log))


@functools.cache
def scan_runs(name, filter, batched):
    """A jitted scan over many runs."""
    s = system(name)
    return jax.jit(lambda theta, b, log: jf.scan_runs(FILTERS[filter](s.model(theta)), b, log, batched))


def noisy(tree, rng):
    return jax.tree.map(lambda a: a + 0.05 * rng.normal(size=np.shape(a)) if a.dtype.kind == "f" else a, tree)


def batch_of_logs(s, batched):
    """The system's log with the named fields different in every run; quaternions keep to their sphere by rounding."""
    rng = np.random.default_rng(2)
    logs = []
    for k in range(RUNS):
        order = rng.permutation(STEPS)
        other = jf.Log(
            np.abs(s.log.dt * rng.uniform(0.5, 1.5, STEPS))[order],
            noisy(s.log.u, rng),
            noisy(s.log.z, rng),
            noisy(s.log.c, rng),
            {name: valid[order] for name, valid in s.log.valid.items()},
        )
        logs.append(s.log._replace(**{field: getattr(other, field) for field in batched}) if k else s.log)
    stacked = jax.tree.map(lambda *a: np.stack(a), *logs)
    return logs, s.log._replace(**{field: getattr(stacked, field) for field in batched})


def same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-10)


ALL = jf.Log._fields
CASES = [
    ("linear", "kf", ALL),
    ("linear", "kf", ("z",)),
    ("car", "ekf", ALL),
    ("car", "ekf", ("z",)),
    ("pendulum", "ckf", ("z", "dt", "valid")),
]


@pytest.mark.parametrize(("name", "filter", "batched"), CASES)
def test_a_batch_is_its_runs(name, filter, batched):
    s = system(name)
    logs, batch = batch_of_logs(s, batched)
    tracks = scan_runs(name, filter, batched)(s.theta, s.belief, batch)
    for k, log in enumerate(logs):
        same(jax.tree.map(lambda a, k=k: a[k], tracks), scan(name, filter)(s.theta, s.belief, log))


def test_a_batch_may_start_from_many_beliefs_and_is_a_plain_vmap():
    s = system("linear")
    _, batch = batch_of_logs(s, ("z",))
    wider = np.linspace(1.0, 3.0, RUNS)
    beliefs = jf.Gaussian(wider[:, None] * s.belief.mean, wider[:, None, None] * s.belief.cov)
    run = scan("linear", "kf")
    plain = jax.vmap(lambda b, z: run(s.theta, b, batch._replace(z=z)))(beliefs, batch.z)
    same(scan_runs("linear", "kf", ("z",))(s.theta, beliefs, batch), plain)
    for k in range(RUNS):
        row = lambda a, k=k: a[k]  # noqa: E731
        log = batch._replace(z=jax.tree.map(row, batch.z))
        same(jax.tree.map(row, plain), run(s.theta, jax.tree.map(row, beliefs), log))


def test_padding_adds_nothing():
    """Stacked with a longer log, a run's beliefs stay at its last and its likelihood is the same."""
    s = system("car")
    short = jax.tree.map(lambda a: np.asarray(a)[:7], s.log)
    tracks = scan_runs("car", "ekf", ALL)(s.theta, s.belief, jf.stack([s.log, short]))
    track = scan("car", "ekf")(s.theta, s.belief, short)
    same(jax.tree.map(lambda a: a[1, :7], tracks), track)
    for leaf in jax.tree.leaves(jax.tree.map(lambda a: a[1], tracks.belief)):
        np.testing.assert_array_equal(leaf[7:], np.broadcast_to(leaf[6], leaf[7:].shape))
    assert not any(np.asarray(info.loglik)[1, 7:].any() for info in tracks.info.values())


# --- one Riccati recursion for all --------------------------------------------------------------------------------


def equations(jaxpr):
    """Every equation of a program, with those of the programs within."""
    for equation in jaxpr.eqns:
        yield equation
        for value in equation.params.values():
            for inner in value if isinstance(value, (tuple, list)) else (value,):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from equations(inner)


def body_of_scan(name, filter, batched, gate=None):
    """The equations of one row of a batched scan. RUNS is no dimension of the systems, nor a number of sigma points."""
    s = system(name)
    _, batch = batch_of_logs(s, batched)
    filt = FILTERS[filter](s.model(s.theta)) if gate is None else jf.kf(s.model(s.theta), gate=gate)
    program = jax.make_jaxpr(lambda b, log: jf.scan_runs(filt, b, log, batched))(s.belief, batch)
    (body,) = [e for e in equations(program.jaxpr) if e.primitive.name == "scan" and e.params["length"] == STEPS]
    return list(equations(body.params["jaxpr"].jaxpr))


def batched_matrices(body):
    """Shapes with the axis of the runs and two more."""
    shapes = [v.aval.shape for e in body for v in e.outvars]
    return [shape for shape in shapes if RUNS in shape and len(shape) > 2]


def branches(body):
    """How many branches on the schedule: those that return a belief. (JAX's choice of platform returns an array.)"""
    return sum(e.primitive.name == "cond" and len(e.outvars) > 1 for e in body)


def test_the_covariances_of_a_linear_model_are_computed_once_for_all_runs():
    assert batched_matrices(body_of_scan("linear", "kf", ("z",))) == []
    assert batched_matrices(body_of_scan("linear", "iekf", ("z",))) == []
    # What must be computed for each run is: a nonlinear model, a schedule of its own, a gate that looks at readings.
    assert batched_matrices(body_of_scan("car", "ekf", ("z",)))
    assert batched_matrices(body_of_scan("linear", "kf", ("z", "valid")))
    assert batched_matrices(body_of_scan("linear", "kf", ("z",), gate=0.99))


@pytest.mark.parametrize(("name", "filter"), [("linear", "kf"), ("car", "ekf"), ("car", "ukf 1.0")])
def test_a_branch_on_a_shared_schedule_stays_a_branch(name, filter):
    sensors = len(system(name).log.valid)  # each of which may be silent
    assert branches(body_of_scan(name, filter, ("z",))) == 1 + sensors
    assert branches(body_of_scan(name, filter, ("z", "dt"))) == sensors
    assert branches(body_of_scan(name, filter, ALL)) == 0


# --- compilation -------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def compilations():
    """The names of what JAX compiles within."""
    names = []

    class Handler(logging.Handler):
        def emit(self, record):
            if record.getMessage().startswith("Compiling "):
                names.append(record.getMessage().split()[1])

    handler = Handler()
    logger = logging.getLogger("jax")
    logger.addHandler(handler)
    try:
        with jax.log_compiles():
            yield names
    finally:
        logger.removeHandler(handler)


def test_a_second_call_compiles_nothing():
    """New numbers, same shapes: scan, scan over runs, and the three functions by hand."""
    s = system("car")
    log, other = s.log, s.log._replace(z=noisy(s.log.z, np.random.default_rng(1)))
    filt = jf.ekf(s.model(s.theta))
    predict, update, step = jax.jit(filt.predict), jax.jit(filt.update, static_argnames="sensor"), jax.jit(filt.step)
    run, many = scan("car", "ekf"), scan_runs("car", "ekf", ("z",))
    _, both = batch_of_logs(s, ("z",))

    def everything(log, both, theta):
        run(theta, s.belief, log)
        many(theta, s.belief, both)
        belief = s.belief
        for k in range(3):
            row = jax.tree.map(lambda a, k=k: a[k], log)
            belief = predict(belief, row.u, row.dt)
            belief, _ = update(belief, row.z["mark"], sensor="mark", c=row.c["mark"])
            belief, _ = step(belief, row)
        return belief

    everything(log, both, s.theta)
    with compilations() as names:
        everything(other, jax.tree.map(np.copy, both), jax.tree.map(lambda a: 0.9 * a, s.theta))
    assert names == []
    with compilations() as names:
        run(s.theta, s.belief, jax.tree.map(lambda a: a[:-1], log))
    assert names != []  # one row fewer is another program: the count does count


def test_f_is_traced_once_for_a_scan_whatever_its_length():
    calls = []

    def f(x, u, dt):
        calls.append(None)
        return x

    sensor = jf.Sensor(lambda x, c: x, jf.const(jnp.eye(1)), jf.vector(1))
    model = jf.Model(f, jf.const(jnp.eye(1)), jf.vector(1), {"z": sensor})
    belief, log = jf.Gaussian(jnp.zeros(1), jnp.eye(1)), jf.Log(jnp.ones(9), (), {}, {}, {})
    run = jax.jit(lambda z: jf.scan(jf.ekf(model), belief, log._replace(z={"z": z})))
    run(jnp.ones((9, 1)))
    first = len(calls)
    run(jnp.zeros((9, 1)))
    assert len(calls) == first <= 10


def test_jit_changes_nothing():
    """A scan outside jit, and predict and update operation by operation."""
    s = system("car")
    filt = jf.ekf(s.model(s.theta))
    track = scan("car", "ekf")(s.theta, s.belief, s.log)
    same(jf.scan(filt, s.belief, s.log), track)
    belief = s.belief
    for k in range(4):
        belief, info = filt.step(belief, jax.tree.map(lambda a, k=k: a[k], s.log))
        same((belief, info), jax.tree.map(lambda a, k=k: a[k], (track.belief, track.info)))


def test_outside_jit_a_second_row_compiles_nothing():
    """By hand and without jit, a robot's loop must not compile at every step."""
    s = system("pendulum")
    filt = jf.ekf(s.model(s.theta))
    belief = s.belief
    for k in (1, 2):
        with compilations() as names:
            belief = filt.predict(belief, (), 0.01 * k)
            belief, _ = filt.update(belief, np.array(0.1 * k), "side")
    assert names == []
