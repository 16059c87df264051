"""Particle filters against the Kalman filter, sums by hand, published errors; and robots that find themselves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import car_system

import jaxfilt as jf
from jaxfilt import resampling
from jaxfilt.models.corridor import CORRIDOR_LENGTH, corridor, corridor_start, patrol
from jaxfilt.models.growth import CALM_GROWTH, growth, growth_start
from jaxfilt.particle import Kidnapping, Particles, particle

A, H = jnp.array([[1.0, 0.3], [0.0, 0.9]]), jnp.array([[1.0, 0.0]])
LINEAR = jf.linear(A, H, jnp.array([[0.1, 0.02], [0.02, 0.2]]), jnp.array([[0.5]]))
START = jf.Gaussian(jnp.array([1.0, -0.5]), jnp.array([[1.0, 0.3], [0.3, 0.5]]))
LOG = jf.simulate(LINEAR, START, jf.schedule(LINEAR, 12, 1.0, every={"z": 2}), jax.random.key(0)).log


def ran(filt, log, key, belief=START):
    return jf.scan(filt, filt.begin(belief, key), log, lambda b, info: (filt.gaussian(b), info))


@pytest.mark.parametrize("draw", [resampling.systematic, resampling.stratified])
def test_each_is_drawn_as_often_as_it_weighs(draw):
    weights = np.random.default_rng(0).dirichlet(np.full(40, 0.3))
    counts = jax.vmap(lambda key: jnp.bincount(draw(key, jnp.log(weights) + 7.0), length=40))(
        jax.random.split(jax.random.key(1), 20_000)
    )
    counts = np.asarray(counts)
    error = counts.std(0) / np.sqrt(len(counts))
    assert np.all(np.abs(counts.mean(0) - 40 * weights) < 4.5 * error + 1e-3)
    most = 1.0 if draw is resampling.systematic else 2.0
    assert np.abs(counts - 40 * weights).max() < most
    assert (counts[:, 0] != counts[0, 0]).any() or counts.std() > 0


def test_what_weighs_nothing_is_never_drawn():
    weights = jnp.array([-jnp.inf, 0.0, -1e30, 0.0, -jnp.inf], jnp.float32)
    for seed in range(50):
        for draw in (resampling.systematic, resampling.stratified):
            assert set(draw(jax.random.key(seed), weights).tolist()) <= {1, 3}


def test_the_effective_size():
    assert np.isclose(resampling.effective_size(jnp.log(jnp.full(50, 0.02))), 50)
    w = np.array([0.7, 0.2, 0.1])
    assert np.isclose(resampling.effective_size(jnp.log(w) + 3), 1 / (w**2).sum())


@pytest.mark.parametrize("auxiliary", [False, True])
def test_many_particles_are_the_kalman_filter(auxiliary):
    want = jf.scan(jf.kf(LINEAR), START, LOG)
    filt = particle(LINEAR, 40_000, auxiliary=auxiliary)
    got, info = jax.jit(lambda key: ran(filt, LOG, key))(jax.random.key(2))
    std = np.sqrt(np.diagonal(want.belief.cov, axis1=1, axis2=2))
    assert np.abs((got.mean - want.belief.mean) / std).max() < 0.04
    assert np.abs(got.cov - want.belief.cov).max() < 0.04
    assert abs(info["z"].loglik.sum() - want.info["z"].loglik.sum()) < 0.05
    if not auxiliary:
        np.testing.assert_allclose(info["z"].S, want.info["z"].S, rtol=0.04)
        np.testing.assert_allclose(info["z"].innovation, want.info["z"].innovation, atol=0.04)


@pytest.mark.parametrize("options", [{}, {"auxiliary": True}, {"resample": "stratified", "threshold": 1.0}])
def test_the_likelihood_is_unbiased(options):
    """Of ten particles only: the mean of the estimates is the likelihood, that of their logarithms is not."""
    filt, runs = particle(LINEAR, 10, **options), 40_000
    estimates = jax.jit(jax.vmap(lambda key: jf.log_likelihood(filt, filt.begin(START, key), LOG)))(
        jax.random.split(jax.random.key(3), runs)
    )
    exact = float(jf.log_likelihood(jf.kf(LINEAR), START, LOG))
    ratio = np.exp(np.asarray(estimates) - exact)
    error = ratio.std() / np.sqrt(runs)
    assert error < 0.05
    assert abs(ratio.mean() - 1) < 4 * error
    assert np.mean(estimates) - exact < -4 * np.std(estimates) / np.sqrt(runs)


def test_growth_has_the_published_error():
    """Mean squared error about 10 with 1,000 particles, where the EKF has about 120: see `growth_scenario`."""
    model, steps, runs = growth(CALM_GROWTH), 500, 24
    plan = jf.schedule(model, steps, 1.0, u=np.cos(1.2 * np.arange(steps)))
    start, filt = growth_start(CALM_GROWTH), particle(model, 1000)

    def one(key):
        draw, key = jax.random.split(key)
        truth, log = jf.simulate(model, start, plan, draw)
        cloud = ran(filt, log, key, start)[0].mean
        ekf = jf.scan(jf.ekf(model), start, log).belief.mean
        return jnp.mean((cloud - truth) ** 2), jnp.mean((ekf - truth) ** 2)

    cloud, ekf = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(4), runs))
    assert 8.5 < cloud.mean() < 12
    assert 80 < ekf.mean() < 180


def test_angles_and_components():
    """On the car yaw is wrapped, components are missing, dt is 0 now and then: near the UKF, as far as that goes."""
    system = car_system(10)
    model = system.model(system.theta)
    filt = particle(model, 20_000)
    got, info = jax.jit(lambda key: ran(filt, system.log, key, system.belief))(jax.random.key(5))
    want = jf.scan(jf.ukf(model), system.belief, system.log)
    std = np.sqrt(np.diagonal(want.belief.cov, axis1=1, axis2=2))
    error = jax.vmap(model.space.minus)(got.mean, want.belief.mean) / std
    assert np.abs(error).max() < 0.6
    for name, one in info.items():
        np.testing.assert_array_equal(one.dof, want.info[name].dof)


def test_in_no_time_and_silence_nothing_changes():
    filt = particle(LINEAR, 50)
    cloud = filt.begin(START, jax.random.key(0))
    row = jax.tree.map(lambda a: a[0], LOG)._replace(dt=jnp.asarray(0.0), valid={"z": jnp.asarray(False)})
    for step in (filt.step, jax.jit(filt.step), particle(LINEAR, 50, auxiliary=True).step):
        same, info = step(cloud, row)
        np.testing.assert_array_equal(same.x, cloud.x)
        np.testing.assert_array_equal(same.log_weight, cloud.log_weight)
        assert info["z"].status == jf.Status.ABSENT


def test_a_batch_draws_for_each_run():
    filt = particle(LINEAR, 30)
    keys = jax.random.split(jax.random.key(6), 3)
    begun = jax.vmap(lambda key: filt.begin(START, key))(keys)
    tracks = jf.scan_runs(filt, begun, LOG, batched=())
    assert len(np.unique(np.asarray(tracks.belief.x)[:, -1, 0, 0])) == 3
    for i in range(3):
        alone = jf.scan(filt, filt.begin(START, keys[i]), LOG)
        np.testing.assert_allclose(tracks.belief.x[i], alone.belief.x, rtol=1e-12)


def test_float32_stays_float32():
    model = jf.linear(*(jnp.asarray(a, jnp.float32) for a in (A, H, 0.1 * np.eye(2), 0.5 * np.eye(1))))
    start = jf.Gaussian(*(jnp.asarray(a, jnp.float32) for a in START))
    log = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32) if a.dtype == np.float64 else a, LOG)
    for auxiliary in (False, True):
        filt = particle(model, 100, auxiliary=auxiliary)
        track = jf.scan(filt, filt.begin(start, jax.random.key(0)), log)
        assert {leaf.dtype for leaf in (track.belief.x, track.belief.log_weight)} == {jnp.dtype("float32")}
        assert track.info["z"].loglik.dtype == np.float32


def test_a_study_and_bad_news():
    filters = {"kf": lambda theta: jf.kf(LINEAR), "particle": lambda theta: particle(LINEAR, 500)}
    plan = jf.schedule(LINEAR, 30, 1.0)
    found = jf.study(lambda t: LINEAR, filters, lambda t: START, plan, jax.random.key(0), theta=(), runs=100)
    mse = {name: float(np.mean(scores.mse[..., 0, 0])) for name, scores in found.scores.items()}
    assert mse["kf"] < 1.01 * mse["particle"] < 1.1 * mse["kf"]
    filt = particle(LINEAR, 50)
    cloud, info = jax.jit(lambda c, z: filt.update(c, z, "z"))(
        filt.begin(START, jax.random.key(0)), jnp.array([np.nan])
    )
    assert info.status == jf.Status.BAD_MEASUREMENT
    broken = cloud._replace(log_weight=jnp.full(50, jnp.nan))
    assert jax.jit(lambda c: filt.update(c, jnp.zeros(1), "z"))(broken)[1].status == jf.Status.BAD_BELIEF


@pytest.mark.parametrize(
    ("what", "error", "words"),
    [
        (lambda: particle(LINEAR, 1), ValueError, "particles: expected a whole number of at least 2, got 1"),
        (lambda: particle(LINEAR, resample="dice"), ValueError, "resample: expected one of"),
        (lambda: particle(LINEAR, threshold=1.5), ValueError, "threshold: expected 0 to 1"),
        (lambda: particle(LINEAR, kidnapping=0.1), TypeError, "kidnapping"),
        (lambda: particle(LINEAR).begin(START), ValueError, "key: expected"),
        (lambda: particle(LINEAR).predict(START, (), 1.0), ValueError, "key: expected"),
        (
            lambda: particle(LINEAR, 3).begin(Particles(jnp.zeros((4, 2)), jnp.zeros(4), jax.random.key(0))),
            ValueError,
            r"belief.log_weight: expected shape \(3,\), got \(4,\)",
        ),
    ],
)
def test_wrong_use(what, error, words):
    with pytest.raises(error, match=words):
        what()


CORRIDOR, HALF = corridor(), 250
ANYWHERE = lambda key: jax.random.uniform(key, (), minval=0.0, maxval=CORRIDOR_LENGTH)  # noqa: E731


def found_in_the_corridor(filt, runs, kidnapped=False):
    """Share of runs in which the mean of the particles is within 1 m of the robot, half-way and at the end.

    In the middle of the run a kidnapped robot, by then near 3 m, is carried back to 10 m, and nobody tells it.
    """
    way = np.r_[10.0, patrol(2 * HALF)]
    speed = np.diff(way) / 0.2
    speed = np.r_[speed[:HALF], speed[:HALF]] if kidnapped else speed
    plan = jf.schedule(CORRIDOR, 2 * HALF, 0.2, every={"wall": 0}, u=speed)
    at_ten = jf.Gaussian(jnp.asarray(10.0), jnp.zeros((1, 1)))

    def one(key):
        first, second, key = jax.random.split(key, 3)
        truth, log = jf.simulate(CORRIDOR, at_ten, plan, first)
        if kidnapped:
            later, again = jf.simulate(CORRIDOR, at_ten, jax.tree.map(lambda a: a[HALF:], plan), second)
            truth = truth.at[HALF:].set(later)
            log = log._replace(z={"door": log.z["door"].at[HALF:].set(again.z["door"])})
        mean = ran(filt, log, key, corridor_start())[0].mean
        return jnp.abs(mean - truth)[jnp.array([HALF - 1, -1])] < 1.0

    return np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), runs))).mean(0)


def test_a_robot_finds_itself_in_a_corridor_and_again_when_it_was_kidnapped():
    plain = particle(CORRIDOR, 1000)
    half, end = found_in_the_corridor(plain, 40)
    assert half > 0.8
    assert end > 0.9
    assert found_in_the_corridor(plain, 40, kidnapped=True)[1] < 0.5
    watchful = particle(CORRIDOR, 1000, kidnapping=Kidnapping(0.003, ANYWHERE))
    assert found_in_the_corridor(watchful, 40, kidnapped=True)[1] > 0.8
