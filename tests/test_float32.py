"""The same laws in float32, JAX's default: a covariance never goes indefinite, whatever the scale and however long."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from systems import FILTERS, SYSTEMS, cast, scaled

import jaxfilt as jf

F32 = np.float32
system = functools.cache(lambda name: SYSTEMS[name]())


@pytest.fixture(scope="module", autouse=True)
def _as_users_compile():
    """Which digits are lost in single precision depends on what the compiler makes of the code."""
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", True)


@pytest.fixture(scope="module")
def track32():
    """The track of a system and filter, all of it float32."""

    @functools.cache
    def run(name, filter):
        s = system(name)
        theta, belief, log = (cast(tree, F32) for tree in (s.theta, s.belief, s.log))
        return jax.jit(lambda theta, b, log: jf.scan(FILTERS[filter](s.model(theta)), b, log))(theta, belief, log)

    return run


CASES = [("linear", "kf"), ("car", "iekf"), ("car", "ukf 0.5"), ("body", "ekf")]


@pytest.mark.parametrize(("name", "filter"), CASES)
def test_stays_float32_and_near_the_book(track32, name, filter):
    s, track = system(name), track32(name, filter)
    for leaf in jax.tree.leaves(track):
        assert leaf.dtype in (F32, np.int32)
    book = s.book(s.theta)
    predict, correct = oracles.filters(iterations=3)["ekf" if filter == "kf" else filter]
    want = oracles.loop(book, s.start, s.belief.cov, oracles.rows_of(s.log, book), predict, correct)
    means, covs = s.flat(track.belief.mean), np.asarray(track.belief.cov)
    assert np.abs(means - np.array([s.book_flat(x) for x in want.means])).max() < 2e-4 * np.abs(means).max()
    size = np.sqrt(np.einsum("tii->ti", want.covs))
    assert np.abs((covs - want.covs) / (size[:, :, None] * size[:, None, :])).max() < 1e-3
    loglik = sum(float(info.loglik.sum()) for info in track.info.values())
    assert abs(loglik - want.logliks.sum()) < 1e-3 * np.abs(want.logliks).sum()


@pytest.mark.parametrize(("name", "factory"), [("linear", jf.kf), ("car", jf.ekf)])
def test_scale_is_free(name, factory):
    """P0, Q, R times a power of two: the same means to the bit; times 1e-12: to float32's rounding."""
    s = system(name)
    theta, belief, log = (cast(tree, F32) for tree in (s.theta, s.belief, s.log))

    @jax.jit
    def run(scale):
        start = jf.Gaussian(jax.tree.map(jnp.asarray, belief.mean), scale * belief.cov)
        return jf.scan(factory(scaled(s.model(theta), scale)), start, jax.tree.map(jnp.asarray, log))

    whole, halved, tiny = (run(jnp.asarray(scale, F32)) for scale in (1.0, 2.0**-30, 1e-12))
    jax.tree.map(np.testing.assert_array_equal, whole.belief.mean, halved.belief.mean)
    np.testing.assert_array_equal(F32(2.0**-30) * whole.belief.cov, halved.belief.cov)
    means = s.flat(whole.belief.mean)
    assert np.abs(means - s.flat(tiny.belief.mean)).max() < 1e-4 * np.abs(means).max()
    size = np.sqrt(np.einsum("tii->ti", whole.belief.cov))
    off = (1e12 * np.asarray(tiny.belief.cov, float) - np.asarray(whole.belief.cov)) / (
        size[:, :, None] * size[:, None, :]
    )
    assert np.abs(off).max() < 1e-3


def indefinite(cov):
    """Whether a covariance (n, n) has a direction of no or negative variance: a Cholesky pivot says so."""
    return ~jnp.isfinite(jnp.linalg.cholesky(cov)).all()


def differences(g, belief, space_in, space_out):
    """`taylor`, its remainder multiplied out: the same algebra, no longer positive semidefinite by construction."""
    m = jf.taylor(g, belief, space_in, space_out)
    return m._replace(remainder=lambda K: belief.cov - m.cross @ K.T - K @ m.cross.T + K @ m.cov @ K.T)


@pytest.mark.parametrize(
    ("transform", "sound"),
    [(jf.taylor, True), (jf.cubature, True), (jf.unscented(0.6), True), (differences, False)],
    ids=["taylor", "cubature", "unscented", "differences"],
)
def test_a_fix_of_a_centimetre_on_a_prior_of_100_metres(transform, sound):
    """2,000 rows at constant velocity from each of 20 priors; by P - K S K' some of them go indefinite."""
    dt, steps = 0.1, 2000
    A = jnp.array([[1.0, dt], [0.0, 1.0]], F32)
    Q = 0.01 * jnp.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], F32)
    model = jf.linear(A, jnp.array([[1.0, 0.0]], F32), Q, jnp.array([[0.01**2]], F32))
    z = (0.1 * dt * np.arange(1, 1 + steps, dtype=F32))[:, None]
    log = jf.Log(np.full(steps, dt, F32), (), {"z": z}, {}, {})

    def run(std):
        belief = jf.Gaussian(jnp.zeros(2, F32), jnp.diag(jnp.stack([std, 0.1 * std]) ** 2))
        track = jf.scan(jf.build(transform, model), belief, log)
        return jax.vmap(indefinite)(track.belief.cov), track.belief.mean[-1], track.info["z"].status

    bad, mean, status = jax.jit(jax.vmap(run))(np.linspace(100.0, 200.0, 20, dtype=F32))
    assert bad.any() == (not sound)
    if sound:
        assert not status.any()
        np.testing.assert_allclose(mean, np.tile([z[-1, 0], 0.1], (20, 1)), atol=0.02)


# --- 100,000 steps -----------------------------------------------------------------------------------------------


def long_log(s, steps, **every):
    """The system's rows over and over; a sensor in ``every`` reads in each so many rows, in all its components."""
    k = np.arange(steps) % len(s.log.dt)
    log = jax.tree.map(lambda a: a[k], s.log)
    valid = {name: np.arange(steps) % n == 0 for name, n in every.items()}
    return cast(log._replace(valid=valid), F32)


@pytest.mark.long
@pytest.mark.parametrize(("name", "factory"), [("car", jf.ekf), ("car", jf.ukf), ("body", jf.ekf), ("body", jf.ukf)])
def test_100_000_steps_without_an_indefinite_covariance(name, factory):
    """Filtering simulated readings of a robot that drives, or turns, on and on."""
    s, steps = system(name), 100_000
    theta, belief = cast(s.theta, F32), cast(s.belief, F32)
    every = {"car": {"mark": 7, "gnss": 3}, "body": {"compass": 2, "camera": 10}}[name]
    schedule = long_log(s, steps, **every)
    if name == "body":  # a torque that brakes, so that the rates stay those of a body and not of a turbine
        control = lambda x, u: u - F32(0.05) * x.rate  # noqa: E731
    else:
        control = lambda x, u: jnp.stack([u[0] + F32(0.5) * (5 - x.speed), u[1]])  # noqa: E731

    def store(b, info):
        statuses = jnp.stack([i.status for i in info.values()])
        return indefinite(b.cov) | (statuses >= jf.Status.BAD_BELIEF).any(), b.mean

    @jax.jit
    def run(theta, belief, log, key):
        model = s.model(theta)
        truth, log = jf.simulate(model, belief, log, key, control)
        bad, means = jf.scan(factory(model), belief, log, store=store)
        return bad, jax.vmap(model.space.minus)(truth, means), truth

    bad, errors, truth = run(theta, belief, schedule, jax.random.key(0))
    assert np.flatnonzero(bad).size == 0
    assert np.all(np.isfinite(errors))
    # It was filtering all along: the last tenth is no worse than the first.
    worst = np.sqrt((np.asarray(errors) ** 2).reshape(10, -1, errors.shape[1]).mean(axis=1))
    assert np.all(worst[-1] < 2 * worst[0])
    for leaf in jax.tree.leaves(truth):
        assert leaf.dtype == F32
