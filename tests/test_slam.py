"""Filters that draw a map, against a loop in NumPy with hand-written Jacobians, and against what must hold of any."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from benchmarks.slam import pose_nees
from jaxfilt.models.slam import World, slam, slam_scenario, slam_start, with_landmarks
from jaxfilt.models.wheeled import Pose, unicycle
from jaxfilt.slam import Chart, Swarm, ekf_slam, fast_slam, laid_upon, map_error

SCENARIO = slam_scenario()
MODEL = SCENARIO.model(SCENARIO.theta)
ROBOT = unicycle()
START = SCENARIO.belief(SCENARIO.theta)
EARLY = START._replace(cov=START.cov + jnp.eye(43) * jnp.where(jnp.arange(43) < 3, 1e-4, 0.0)[:, None])
"""The pose is not known exactly either, so that no covariance is singular."""


@functools.cache
def drive(steps=120, seed=0):
    return jf.simulate(MODEL, EARLY, SCENARIO.schedule(steps), jax.random.key(seed))


def first(log, steps):
    return jax.tree.map(lambda a: a[:steps], log)


def wrapped(a):
    return (a + np.pi) % (2 * np.pi) - np.pi


class Book:
    """EKF-SLAM as in Thrun, Burgard, Fox (2005), table 10.1, on a state that grows: [x, y, yaw, m_a, m_b, ...]."""

    def __init__(self, mean, cov, theta):
        self.x, self.P, self.at = np.array(mean), np.array(cov), {}
        self.along, self.across, self.turn = (np.exp(theta[name]) for name in ("along", "across", "turn"))
        self.R = np.diag(np.exp(theta["mark"]) ** 2)
        self.loglik = 0.0

    def move(self, v, w, dt):
        yaw, n = self.x[2], len(self.x)
        middle, half = yaw + 0.5 * w * dt, 0.5 * w * dt
        chord = v * dt * np.sin(half) / half
        F = np.eye(n)
        F[:2, 2] = chord * np.array([-np.sin(middle), np.cos(middle)])
        c, s = np.cos(yaw), np.sin(yaw)
        G = np.array([[c * self.along, -s * self.across, 0], [s * self.along, c * self.across, 0], [0, 0, self.turn]])
        self.x[:2] += chord * np.array([np.cos(middle), np.sin(middle)])
        self.x[2] = wrapped(yaw + w * dt)
        self.P = F @ self.P @ F.T
        self.P[:3, :3] += dt * G @ G.T

    def see(self, reach, bearing, j):
        n = len(self.x)
        if j not in self.at:
            a = self.x[2] + bearing
            self.at[j] = n
            Gx = np.array([[1, 0, -reach * np.sin(a)], [0, 1, reach * np.cos(a)]])
            Gz = np.array([[np.cos(a), -reach * np.sin(a)], [np.sin(a), reach * np.cos(a)]])
            grow = np.vstack([np.eye(n), np.hstack([Gx, np.zeros((2, n - 3))])])
            self.P = grow @ self.P @ grow.T
            self.P[n:, n:] += Gz @ self.R @ Gz.T
            self.x = np.r_[self.x, self.x[:2] + reach * np.array([np.cos(a), np.sin(a)])]
            return
        k = self.at[j]
        dx, dy = self.x[k : k + 2] - self.x[:2]
        q = dx * dx + dy * dy
        r = np.sqrt(q)
        H = np.zeros((2, n))
        H[:, :3] = [[-dx / r, -dy / r, 0], [dy / q, -dx / q, -1]]
        H[:, k : k + 2] = [[dx / r, dy / r], [-dy / q, dx / q]]
        e = np.array([reach - r, wrapped(bearing - np.arctan2(dy, dx) + self.x[2])])
        S = H @ self.P @ H.T + self.R
        K = self.P @ H.T @ np.linalg.inv(S)
        self.x = self.x + K @ e
        self.x[2] = wrapped(self.x[2])
        self.P = self.P - K @ S @ K.T
        self.loglik += -0.5 * (e @ np.linalg.solve(S, e) + np.log(np.linalg.det(2 * np.pi * S)))


def booked(log, steps):
    book = Book([0.0, 0.0, 0.0], np.asarray(EARLY.cov)[:3, :3], SCENARIO.theta)
    there = log.valid["landmark"]
    for k in range(steps):
        book.move(float(log.u.speed[k]), float(log.u.rate[k]), float(log.dt[k]))
        if there[k]:
            reach, bearing = (float(a[k]) for a in log.z["landmark"])
            book.see(reach, bearing, int(log.c["landmark"][k]))
    return book


@functools.cache
def ekf_run(steps=120, **options):
    filt = ekf_slam(MODEL, **options)
    return jax.jit(lambda log: jf.scan(filt, EARLY, log))(first(drive().log, steps))


def test_ekf_slam_is_the_books():
    """Pose, landmarks, every covariance between them, and the likelihood of what was not a first sighting."""
    track, book = ekf_run(), booked(drive().log, 120)
    seen = np.flatnonzero(track.belief.seen[-1])
    assert set(seen) == set(book.at)
    assert len(seen) > 5
    rows = np.r_[0:3, *[[3 + 2 * j, 4 + 2 * j] for j in seen]]
    order = np.r_[0:3, *[[book.at[j], book.at[j] + 1] for j in seen]]
    mean, cov = jax.tree.map(lambda a: np.asarray(a[-1]), track.belief.belief)
    got = np.r_[mean.robot.pos, mean.robot.yaw, mean.landmarks[seen].ravel()]
    np.testing.assert_allclose(got, book.x[order], atol=1e-11)
    np.testing.assert_allclose(cov[np.ix_(rows, rows)], book.P[np.ix_(order, order)], atol=1e-12)
    np.testing.assert_allclose(track.info["landmark"].loglik.sum(), book.loglik, rtol=1e-10)


def test_on_a_map_that_is_given_it_is_the_ekf():
    """With all landmarks seen beforehand nothing is placed: prior and all."""
    log = first(drive().log, 40)
    want = jf.scan(jf.ekf(MODEL), EARLY, log)
    got = jf.scan(ekf_slam(MODEL), Chart(EARLY, np.ones(20, bool)), log)
    for a, b in zip(jax.tree.leaves((got.belief.belief, got.info)), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-11)


def test_a_first_sighting_is_the_limit_of_a_prior_that_knows_nothing():
    """Of all else and their covariances; linear at the place itself, or the wide prior would linearise elsewhere."""
    filt, chart = ekf_slam(MODEL), jax.tree.map(lambda a: a[49], ekf_run().belief)
    new = int(np.argmin(chart.seen))
    z = (jnp.asarray(4.0), jnp.asarray(0.3))
    got, info = filt.update(chart, z, "landmark", new)
    assert (int(info.status), int(info.dof), float(info.loglik)) == (jf.Status.OK, 0, 0.0)
    at = 3 + 2 * new
    wide = chart.belief.cov.at[at, at].set(1e8).at[at + 1, at + 1].set(1e8)
    prior = jf.Gaussian(chart.belief.mean._replace(landmarks=got.belief.mean.landmarks), wide)
    want, _ = jf.ekf(MODEL).update(prior, z, "landmark", jnp.asarray(new))
    np.testing.assert_allclose(got.belief.cov, want.cov, atol=1e-6)
    for a, b in zip(jax.tree.leaves(got.belief.mean), jax.tree.leaves(want.mean), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


@functools.cache
def laps():
    """Covariances (T, 43, 43) of two laps, and which landmarks were seen."""
    truth, log = drive(1260, 3)
    filt = ekf_slam(MODEL)
    chart = jax.jit(lambda log: jf.scan(filt, EARLY, log, store=lambda b, _: b))(log)
    return jax.tree.map(np.asarray, (chart, truth)), log


def test_the_joint_covariance_stays_one():
    (chart, _), _ = laps()
    cov = chart.belief.cov[::20]
    np.testing.assert_array_equal(cov, cov.transpose(0, 2, 1))
    lowest = np.linalg.eigvalsh(cov)[:, 0]
    assert (lowest > 0).all()


def test_a_landmark_never_becomes_less_certain():
    """Landmarks stand still: the determinant of each block, once seen, only falls."""
    (chart, _), _ = laps()
    for j in range(20):
        block = chart.belief.cov[:, 3 + 2 * j : 5 + 2 * j, 3 + 2 * j : 5 + 2 * j]
        size = np.linalg.det(block)[chart.seen[:, j]]
        assert (np.diff(size) <= 1e-9 * size[:-1]).all()


def test_closing_a_loop_shrinks_every_landmark():
    """Also those that are not seen then."""
    (chart, _), log = laps()
    before, after = 500, 620
    var = np.diagonal(chart.belief.cov, axis1=1, axis2=2)[:, 3:].reshape(-1, 20, 2).sum(-1)
    known = np.flatnonzero(chart.seen[before])
    assert len(known) > 15
    assert (var[after] < var[before])[known].all()
    far = [j for j in known if j not in set(np.asarray(log.c["landmark"])[before:after].tolist())]
    assert len(far) > 5
    assert (var[after] / var[before])[far].min() < 0.8


def test_the_way_and_the_map_are_found():
    (chart, truth), _ = laps()
    assert chart.seen[-1].all()
    mean = chart.belief.mean
    laid = laid_upon(mean.landmarks[-1], truth.landmarks[-1], mean.robot.pos[-300:])
    assert np.hypot(*(laid - truth.robot.pos[-300:]).T).max() < 0.4
    assert map_error(mean.landmarks[-1], truth.landmarks[-1]) < 0.15


def test_the_pose_becomes_too_certain_in_the_long_run():
    """NEES over 3: with a tenth of the noise it stays about 1, the filter being all but linear; with much, it grows."""
    small, _ = pose_nees(slam_scenario(), 24, 400, scale=0.1)
    large, end = pose_nees(slam_scenario(harsh=True), 24, 400)
    early, late = slice(0, 5), slice(300, 400)
    for nees in (small[:, early], small[:, late], large[:, early]):
        assert 0.5 < nees.mean() / 3 < 1.6
    assert large[:, late].mean() / 3 > 1.9
    assert end.mean() / 40 > 1.2


def test_nearest_is_known_where_nothing_is_confused():
    """Numbers in order of first sight, of which nothing is told."""
    log = first(drive().log, 120)
    blind = log._replace(c={})
    track = jax.jit(lambda log: jf.scan(ekf_slam(MODEL, gate=0.999, association="nearest"), EARLY, log))(blind)
    known = ekf_run()
    seen = np.asarray(known.belief.seen)
    first_row = np.where(seen.any(0), seen.argmax(0), len(seen))
    order = np.argsort(first_row, kind="stable")[: seen[-1].sum()]
    assert track.belief.seen[-1].tolist() == [True] * len(order) + [False] * (20 - len(order))
    mean = track.belief.belief.mean.landmarks[-1, : len(order)]
    np.testing.assert_allclose(mean, known.belief.belief.mean.landmarks[-1][order], atol=1e-9)


def test_nearest_refuses_what_is_neither_known_nor_new():
    chart = jax.tree.map(lambda a: a[49], ekf_run().belief)
    filt, j = ekf_slam(MODEL, gate=0.99, association="nearest", fresh=1 - 1e-9), int(np.argmax(chart.seen))
    mean = MODEL.sensors["landmark"].h(chart.belief.mean, jnp.asarray(j))
    _, info = filt.update(chart, mean, "landmark")
    assert (int(info.status), int(info.dof)) == (jf.Status.OK, 2)
    shift = jnp.linalg.cholesky(info.S) @ jnp.array([0.0, 4.5])  # NIS 20.25: the gate is 9.2, a new one from 41 on
    between, info = filt.update(chart, MODEL.sensors["landmark"].space.plus(mean, shift), "landmark")
    assert info.status == jf.Status.GATED
    assert not (np.asarray(between.seen) != np.asarray(chart.seen)).any()
    np.testing.assert_array_equal(between.belief.cov, chart.belief.cov)
    far, _ = filt.update(chart, (jnp.asarray(80.0), jnp.asarray(0.0)), "landmark")
    assert int(far.seen.sum()) == int(chart.seen.sum()) + 1
    full = chart._replace(seen=jnp.ones(20, bool))
    _, info = filt.update(full, (jnp.asarray(80.0), jnp.asarray(0.0)), "landmark")
    assert info.status == jf.Status.GATED


def test_gradients_equal_differences():
    log = first(drive().log, 30)

    @jax.jit
    @jax.value_and_grad
    def value(theta):
        return jf.log_likelihood(ekf_slam(slam(theta)), EARLY, log)

    theta = jax.tree.map(jnp.asarray, SCENARIO.theta)
    gradient = value(theta)[1]
    for name in ("along", "turn"):
        up, down = (value(theta | {name: theta[name] + h})[0] for h in (1e-5, -1e-5))
        np.testing.assert_allclose(gradient[name], (up - down) / 2e-5, rtol=1e-6)
    assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(gradient))


def test_what_is_missing_places_nothing():
    chart = ekf_slam(MODEL).begin(EARLY)
    for filt, carried in ((ekf_slam(MODEL), chart), (SMALL_SWARM, SMALL_SWARM.begin(EARLY, jax.random.key(0)))):
        after, info = filt.update(carried, (3.0, 0.1), "landmark", 2, np.array([True, False]))
        assert info.status == jf.Status.ABSENT
        assert not after.seen.any()
        after, info = filt.update(carried, (3.0, 0.1), "landmark", 2, np.array([True, True]))
        assert info.status == jf.Status.OK
        _, info = filt.update(after, (3.0, 9.0), "landmark", 2, np.array([True, False]))
        assert (int(info.dof), int(info.status)) == (1, jf.Status.OK)
        assert abs(float(info.innovation[0])) < 0.1
        assert float(info.innovation[1]) == 0.0


SMALL_SWARM = fast_slam(MODEL, 20)


@pytest.mark.parametrize("filt", [ekf_slam(MODEL), SMALL_SWARM], ids=["ekf_slam", "fast_slam"])
def test_bad_input_is_named(filt):
    carried = filt.begin(EARLY, jax.random.key(0))
    with pytest.raises(TypeError, match=r"c\['landmark'\]: expected the number of a landmark, one integer"):
        filt.update(carried, (3.0, 0.0), "landmark", 1.0)
    with pytest.raises(ValueError, match=r"c\['landmark'\]: expected a landmark's number, 0 to 19, got 20"):
        filt.update(carried, (3.0, 0.0), "landmark", 20)
    with pytest.raises(TypeError, match=r"belief: expected a Gaussian or a (Chart|Swarm), got tuple"):
        filt.begin((1, 2))
    with pytest.raises(ValueError, match="seen: expected bool"):
        filt.predict(carried._replace(seen=np.ones(3, bool)))
    see = jax.jit(lambda carried, z, c: filt.update(carried, z, "landmark", c))
    z = (jnp.asarray(3.0), jnp.asarray(0.0))
    assert see(carried, z, 20)[1].status == jf.Status.BAD_MEASUREMENT
    nan = (jnp.asarray(jnp.nan), jnp.asarray(0.0))
    after, info = see(carried, nan, 1)
    assert info.status == jf.Status.BAD_MEASUREMENT
    assert see(after, z, 1)[1].status == jf.Status.BAD_BELIEF


def test_bad_arguments_are_named():
    with pytest.raises(TypeError, match=r"model: expected a state World\(robot, landmarks\)"):
        ekf_slam(jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1)))
    with pytest.raises(KeyError, match="camera"):
        ekf_slam(MODEL, sightings={"camera": lambda x, z: x.pos})
    with pytest.raises(ValueError, match="gate: expected one for 'landmark'"):
        ekf_slam(MODEL, association="nearest")
    with pytest.raises(ValueError, match="fresh: expected a probability above the gate's"):
        ekf_slam(MODEL, association="nearest", gate=0.99, fresh=0.9)
    with pytest.raises(ValueError, match="association: expected 'known' or 'nearest'"):
        ekf_slam(MODEL, association="guess")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="particles: expected at least 1, got 0"):
        fast_slam(MODEL, 0)
    with pytest.raises(ValueError, match=r"threshold: expected 0 to 1, got 1\.5"):
        fast_slam(MODEL, threshold=1.5)
    with pytest.raises(ValueError, match=r"key: expected a key of jax\.random, got None"):
        fast_slam(MODEL).begin(EARLY)


def test_with_a_path_that_is_known_landmarks_are_filtered_one_by_one():
    """No noise of the motion, no doubt of the start: each landmark is an EKF of two numbers, here in NumPy."""
    still = with_landmarks(
        jf.Model(
            lambda x, u, dt: Pose(x.pos + jnp.asarray(dt) * jnp.array([1.0, 0.5]), x.yaw),
            jf.const(jnp.zeros((3, 3))),
            ROBOT.space,
            {"landmark": ROBOT.sensors["mark"]},
        ),
        2,
    )
    filt = fast_slam(still, 7)
    start = slam_start(landmarks=np.zeros((2, 2)))
    swarm = filt.begin(start, jax.random.key(0))
    R = np.diag(np.exp(SCENARIO.theta["mark"]) ** 2)
    rng, pos, want = np.random.default_rng(1), np.zeros(2), {}
    total = expected = 0.0
    for k in range(12):
        swarm, pos = filt.predict(swarm, (), 0.4), pos + 0.4 * np.array([1.0, 0.5])
        j = k % 2
        d = np.array([[5.0, 1.0], [2.0, 7.0]])[j] - pos
        z = np.array([np.hypot(*d), np.arctan2(d[1], d[0])]) + rng.normal(size=2) * np.sqrt(np.diag(R))
        swarm, info = filt.update(swarm, (z[0], z[1]), "landmark", j)
        total += float(info.loglik)
        if j not in want:
            c, s = np.cos(z[1]), np.sin(z[1])
            G = np.array([[c, -z[0] * s], [s, z[0] * c]])
            want[j] = pos + z[0] * np.array([c, s]), G @ R @ G.T
            continue
        m, C = want[j]
        dx, dy = m - pos
        q = dx * dx + dy * dy
        H = np.array([[dx / np.sqrt(q), dy / np.sqrt(q)], [-dy / q, dx / q]])
        e, S = z - np.array([np.sqrt(q), np.arctan2(dy, dx)]), H @ C @ H.T + R
        K = C @ H.T @ np.linalg.inv(S)
        want[j] = m + K @ e, C - K @ S @ K.T
        expected += -0.5 * (e @ np.linalg.solve(S, e) + np.log(np.linalg.det(2 * np.pi * S)))
    np.testing.assert_allclose(total, expected, rtol=1e-10)
    for j, (m, C) in want.items():
        for k in range(7):
            np.testing.assert_allclose(swarm.places[k, j], m, rtol=1e-11)
            np.testing.assert_allclose(swarm.covs[k, j], C, atol=1e-14)


def drifting(q):
    """A point whose landmarks are seen as vectors: linear, so that EKF-SLAM is exact."""
    relative = jf.Sensor(lambda x, c: c - x, jf.const(0.25 * jnp.eye(2)), jf.vector(2))
    gnss = jf.Sensor(lambda x, c: x, jf.const(4.0 * jnp.eye(2)), jf.vector(2))
    sensors = {"landmark": relative, "gnss": gnss}
    return with_landmarks(jf.Model(lambda x, u, dt: x, jf.white(q * jnp.eye(2)), jf.vector(2), sensors), 2)


SEES = {"landmark": lambda x, z: x + z}


@functools.cache
def drifted():
    model = drifting(0.5)
    start = jf.Gaussian(World(jnp.zeros(2), jnp.array([[4.0, 0.0], [0.0, 3.0]])), 0.01 * jnp.eye(6))
    plan = jf.schedule(model, 10, 1.0, every={"gnss": 4}, c={"landmark": np.arange(10, dtype=np.int32) % 2})
    log = jf.simulate(model, start, plan, jax.random.key(4)).log
    return start, log


@pytest.mark.parametrize("informed", [True, False])
def test_the_likelihood_is_unbiased_and_the_mean_the_exact_one(informed):
    """Mean of p over many runs, over the exact p, is 1; that of another noise is not. With a sensor of the robot."""
    start, log = drifted()
    filt = fast_slam(drifting(0.5), 30, sightings=SEES, informed=informed)

    def run(key):
        def body(b, row):
            b, info = filt.step(b, row)
            return b, info["landmark"].loglik + info["gnss"].loglik

        last, loglik = jax.lax.scan(body, filt.begin(start, key), jax.tree.map(jnp.asarray, log))
        return loglik.sum(), filt.gaussian(last)

    loglik, last = jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(2), 2000))
    exact = {q: jf.scan(ekf_slam(drifting(q), sightings=SEES), start, log) for q in (0.5, 0.2)}
    total = {q: sum(float(i.loglik.sum()) for i in track.info.values()) for q, track in exact.items()}
    ratio = np.exp(np.asarray(loglik) - total[0.5])
    error = ratio.std() / np.sqrt(2000)
    assert error < 0.1
    assert abs(ratio.mean() - 1) < 4 * error
    other = np.exp(np.asarray(loglik) - total[0.2])
    assert abs(other.mean() - 1) > 4 * other.std() / np.sqrt(2000)
    # Weighted by their likelihoods, the runs are one large swarm.
    w = ratio / ratio.sum()
    mean = np.concatenate([np.asarray(last.mean.robot), np.asarray(last.mean.landmarks).reshape(-1, 4)], 1)
    spread = np.asarray(last.cov) + np.einsum("ki,kj->kij", mean - w @ mean, mean - w @ mean)
    want = jax.tree.map(lambda a: np.asarray(a[-1]), exact[0.5].belief.belief)
    sd = np.sqrt(np.diag(want.cov))
    np.testing.assert_allclose((w @ mean - np.r_[want.mean.robot, want.mean.landmarks.ravel()]) / sd, 0, atol=0.1)
    np.testing.assert_allclose(
        np.einsum("k,kij->ij", w, spread) / np.outer(sd, sd), want.cov / np.outer(sd, sd), atol=0.15
    )


def test_fast_slam_finds_its_way_beside_the_ekf():
    """A third of a lap, before any loop closes: the same map, and the likelihood within a few units."""
    filt, log = fast_slam(MODEL, 200, gate=0.999999), first(drive().log, 120)
    track = jax.jit(lambda log: jf.scan(filt, filt.begin(EARLY, jax.random.key(0)), log))(log)
    last = filt.gaussian(jax.tree.map(lambda a: a[-1], track.belief))
    want = jax.tree.map(lambda a: a[-1], ekf_run().belief)
    seen = np.asarray(want.seen)
    np.testing.assert_array_equal(track.belief.seen[-1], seen)
    away = np.asarray(last.mean.landmarks - want.belief.mean.landmarks)[seen]
    sd = np.sqrt(np.diagonal(want.belief.cov)[3:].reshape(20, 2)[seen])
    assert np.abs(away / sd).max() < 1.0
    loglik = [float(info["landmark"].loglik.sum()) for info in (track.info, ekf_run().info)]
    assert abs(loglik[0] - loglik[1]) < 5
    assert np.linalg.eigvalsh(last.cov)[0] > 0
    np.testing.assert_allclose(np.exp(track.belief.log_weights).sum(1), 1, rtol=1e-12)


def test_a_gate_refuses_what_no_particle_expects():
    filt = fast_slam(MODEL, 20, gate=0.999)
    swarm, _ = filt.update(filt.begin(EARLY, jax.random.key(0)), (5.0, 0.0), "landmark", 3)
    after, info = filt.update(swarm, (9.0, 2.0), "landmark", 3)
    assert (int(info.status), int(info.dof), float(info.loglik)) == (jf.Status.GATED, 0, 0.0)
    assert info.ratio > 1
    np.testing.assert_array_equal(after.places, swarm.places)
    np.testing.assert_array_equal(after.log_weights, swarm.log_weights)
    _, info = filt.update(swarm, (5.05, 0.005), "landmark", 3)
    assert (int(info.status), int(info.dof)) == (jf.Status.OK, 2)


@pytest.mark.parametrize("build", [ekf_slam, lambda model: fast_slam(model, 10)], ids=["ekf_slam", "fast_slam"])
def test_float32_stays_float32(build):
    cast = lambda tree: jax.tree.map(  # noqa: E731
        lambda a: np.asarray(a, np.float32) if np.asarray(a).dtype == np.float64 else np.asarray(a), tree
    )
    theta, log = cast((SCENARIO.theta, first(drive().log, 20)))
    filt = build(slam(theta))
    carried = filt.begin(cast(EARLY), jax.random.key(0))
    track = jf.scan(filt, carried, log)
    assert isinstance(track.belief, (Chart, Swarm))
    floats = [a for a in jax.tree.leaves(track) if jnp.issubdtype(a.dtype, jnp.floating)]
    assert {a.dtype for a in floats} == {np.dtype(np.float32)}
    assert all(np.isfinite(a).all() for a in floats)


def test_a_map_laid_upon_another():
    rng = np.random.default_rng(0)
    a, angle = rng.normal(size=(9, 2)), 2.5
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    b = a @ R.T + np.array([3.0, -7.0])
    np.testing.assert_allclose(laid_upon(a, b), b, atol=1e-13)
    np.testing.assert_allclose(laid_upon(a, b, a[:2]), b[:2], atol=1e-13)
    noisy = b + 0.3 * rng.normal(size=b.shape)
    turns = np.linspace(-np.pi, np.pi, 20001)
    centred = a - a.mean(0)
    tries = []
    for t in turns:
        turned = centred @ np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]])
        tries.append(np.sqrt(((turned + noisy.mean(0) - noisy) ** 2).sum(1).mean()))
    np.testing.assert_allclose(map_error(a, noisy), min(tries), rtol=1e-6)
    with pytest.raises(ValueError, match=r"points: expected two sets of shape \(N, 2\)"):
        laid_upon(a, b[:3])
