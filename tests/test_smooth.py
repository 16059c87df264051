"""Smoothers against the dense joint posterior, against loops as the books print them, and against their own laws."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import scipy.linalg
from systems import FILTERS, SYSTEMS, B, H, book_covariance, cast

import jaxfilt as jf
from jaxfilt.smooth import Smoothed, Window, fixed_lag, sample_trajectories, smooth

system = functools.cache(lambda name: SYSTEMS[name]())


@functools.cache
def smoothed(name, filter):
    """Track and smoothed beliefs of one system."""
    s = system(name)

    @jax.jit
    def run(theta, belief, log):
        filt = FILTERS[filter](s.model(theta))
        track = jf.scan(filt, belief, log)
        return track, smooth(filt, track, log)

    return jax.tree.map(np.asarray, run(s.theta, s.belief, s.log))


# --- linear: one big Gaussian -----------------------------------------------------------------------------------------


def dense(start, P, moves, readings):
    """Mean and covariance (T n, T n) of the states after all rows given all readings, by one conditioning.

    ``moves`` (F, offset, Q) by row, ``readings`` (row, z, H, R).
    """
    n, rows = len(start), len(moves)
    M, offset = np.eye(n, n * (1 + rows)), start.copy()
    maps, offsets, noise = [], [], [P]
    for k, (F, b, Q) in enumerate(moves):
        M, offset = F @ M, F @ offset + b
        M[:, n * (k + 1) : n * (k + 2)] += np.eye(n)
        noise.append(Q)
        maps.append(M)
        offsets.append(offset)
    prior = scipy.linalg.block_diag(*noise)
    X, mean = np.vstack(maps), np.concatenate(offsets)
    seen = np.vstack([H @ maps[k] for k, _, H, _ in readings])
    r = np.concatenate([z - H @ offsets[k] for k, z, H, _ in readings])
    S = seen @ prior @ seen.T + scipy.linalg.block_diag(*[R for *_, R in readings])
    gain = np.linalg.solve(S, seen @ prior @ X.T).T
    return mean + gain @ r, X @ prior @ X.T - gain @ seen @ prior @ X.T


@functools.cache
def dense_linear():
    """That of the linear system: rows of dt = 0, and components that are missing."""
    s = system("linear")
    book, rows = s.book(s.theta), oracles.rows_of(s.log, s.book(s.theta))
    F, Q, n = s.theta["A"], book.Q(None, None, None), 3
    moves = [(F, B @ row.u, Q) if row.dt > 0 else (np.eye(n), np.zeros(n), np.zeros((n, n))) for row in rows]
    readings = [
        (k, z[seen], H[name][seen], book.sensors[name].R(None, None)[np.ix_(seen, seen)])
        for k, row in enumerate(rows)
        for name, (z, _, seen) in row.readings.items()
    ]
    mean, cov = dense(s.start, s.belief.cov, moves, readings)
    T = len(rows)
    return mean.reshape(T, n), cov.reshape(T, n, T, n)


@pytest.mark.parametrize("filter", ["kf", "ukf 0.5", "ckf", "gauss_hermite"])
def test_is_the_dense_posterior(filter):
    mean, cov = dense_linear()
    _, got = smoothed("linear", filter)
    k = np.arange(len(mean))
    np.testing.assert_allclose(got.belief.mean, mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(got.belief.cov, cov[k, :, k], rtol=0, atol=1e-9)
    np.testing.assert_allclose(got.cross, cov[k[:-1], :, k[1:]], rtol=0, atol=1e-9)


def drifting():
    """Position and velocity, white acceleration, position seen; F and Q by the interval."""

    def f(x, u, dt):
        return jnp.stack([x[0] + dt * x[1], x[1]])

    def Q(x, u, dt):
        return 0.3 * jnp.stack([jnp.stack([dt**3 / 3, dt**2 / 2]), jnp.stack([dt**2 / 2, dt])])

    sensor = jf.Sensor(lambda x, c: x[0], jf.const(jnp.full((1, 1), 0.2)), jf.scalar)
    return jf.Model(f, Q, jf.vector(2), {"z": sensor})


def test_irregular_intervals():
    rng = np.random.default_rng(3)
    steps = 60
    dt = rng.uniform(0.001, 3.0, steps) * (rng.random(steps) < 0.8)
    z, valid = rng.normal(0, 2, steps), rng.random(steps) < 0.6
    moves = [
        (np.array([[1, d], [0, 1]]), np.zeros(2), 0.3 * np.array([[d**3 / 3, d**2 / 2], [d**2 / 2, d]])) for d in dt
    ]
    readings = [(k, z[k : k + 1], np.eye(1, 2), np.array([[0.2]])) for k in np.flatnonzero(valid)]
    P = book_covariance(np.log([2.0, 0.5]), 7)
    mean, cov = dense(np.array([1.0, -1.0]), P, moves, readings)
    filt, log = jf.kf(drifting()), jf.Log(dt, (), {"z": z}, {}, {"z": valid})
    got = smooth(filt, jf.scan(filt, jf.Gaussian(np.array([1.0, -1.0]), P), log), log)
    k = np.arange(steps)
    np.testing.assert_allclose(got.belief.mean, mean.reshape(steps, 2), rtol=0, atol=1e-9)
    np.testing.assert_allclose(got.belief.cov, cov.reshape(steps, 2, steps, 2)[k, :, k], rtol=0, atol=1e-9)


def test_what_is_known_and_what_is_said_twice():
    """A state without variance, and one that is the sum of two others: P' is singular, the answer is not."""
    A = np.array([[0.9, 0.1, 0.3, 0.0], [0.0, 0.8, 0.2, 0.0], [0.0, 0.0, 1.0, 0.0], [0.9, 0.9, 0.5, 0.0]])
    G = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0], [1.0, 1.0]])
    Q, R, map = G @ np.diag([0.3, 0.1]) @ G.T, np.array([[0.2]]), np.array([[1.0, 0.0, 0.0, 0.0]])
    P, start, steps = np.diag([1.0, 2.0, 0.0, 0.0]), np.array([1.0, 2.0, 3.0, 4.0]), 12
    z = np.random.default_rng(5).normal(size=(steps, 1))
    moves = [(A, np.zeros(4), Q)] * steps
    mean, cov = dense(start, P, moves, [(k, z[k], map, R) for k in range(steps)])
    filt, log = jf.kf(jf.linear(A, map, Q, R)), jf.Log(np.ones(steps), (), {"z": z}, {}, {})

    @jax.jit
    def run(z):
        rows = log._replace(z={"z": z})
        return smooth(filt, jf.scan(filt, jf.Gaussian(start, P), rows), rows)

    got, k = run(z), np.arange(steps)
    np.testing.assert_allclose(got.belief.mean, mean.reshape(steps, 4), rtol=0, atol=1e-9)
    np.testing.assert_allclose(got.belief.cov, cov.reshape(steps, 4, steps, 4)[k, :, k], rtol=0, atol=1e-9)
    slope = jax.jit(jax.grad(lambda z: run(z).belief.mean[0, 1]))(z)
    assert np.isfinite(slope).all()
    assert np.abs(slope[:3]).min() > 1e-3


# --- badly scaled -----------------------------------------------------------------------------------------------------

GYRO = {"start": (1e-4, 1e-6), "walk": 1e-6, "drift": 1e-9, "compass": 3e-4}
"""rad, rad/s; rad/sqrt(s), rad/s/sqrt(s); rad."""


def gyro_log(steps=200):
    rng = np.random.default_rng(8)
    dt = np.where(np.arange(steps) % 7 == 3, 0.0, rng.uniform(0.05, 0.15, steps))
    return jf.Log(dt, (), {"z": rng.normal(0, 3e-4, (steps, 1))}, {}, {"z": np.arange(steps) % 5 == 0})


def gyro_filter():
    """Heading and gyroscope bias: variances of 1e-8 and 1e-12."""
    q = np.square([GYRO["walk"], GYRO["drift"]])
    sensor = jf.Sensor(lambda x, c: x[:1], jf.const(jnp.full((1, 1), GYRO["compass"] ** 2)), jf.vector(1))
    f = lambda x, u, dt: jnp.stack([x[0] - dt * x[1], x[1]])  # noqa: E731
    return jf.kf(jf.Model(f, lambda x, u, dt: dt * jnp.diag(jnp.asarray(q)), jf.vector(2), {"z": sensor}))


def gyro_exactly(log, jitter=0.0):
    """Filter and smoother in 60 digits; a jitter is added to P' before it is inverted."""
    mpmath = pytest.importorskip("mpmath")
    with mpmath.workdps(60):
        m, P = mpmath.matrix([0, 0]), mpmath.diag([mpmath.mpf(s) ** 2 for s in GYRO["start"]])
        q = mpmath.diag([mpmath.mpf(GYRO["walk"]) ** 2, mpmath.mpf(GYRO["drift"]) ** 2])
        R = mpmath.mpf(GYRO["compass"]) ** 2
        kept = []
        for dt, z, valid in zip(log.dt, log.z["z"][:, 0], log.valid["z"], strict=True):
            F = mpmath.matrix([[1, -mpmath.mpf(dt)], [0, 1]])
            ahead = F * m, F * P * F.T + mpmath.mpf(dt) * q
            kept.append([F, ahead])
            m, P = ahead
            if valid:
                K = P[:, 0] / (P[0, 0] + R)
                m, P = m + K * (mpmath.mpf(z) - m[0]), P - K * P[0, :]
            kept[-1].append((m, P))
        covs = [P]
        for (F, ahead, _), (*_, (_, P)) in zip(kept[:0:-1], kept[-2::-1], strict=True):
            G = P * F.T * (ahead[1] + mpmath.mpf(jitter) * mpmath.eye(2)) ** -1
            covs.append(P + G * (covs[-1] - ahead[1]) * G.T)
        return np.array([[[float(P[i, j]) for j in range(2)] for i in range(2)] for P in covs[::-1]])


def test_heading_and_gyro_bias():
    log, filt = gyro_log(), gyro_filter()
    start = jf.Gaussian(np.zeros(2), np.diag(np.square(GYRO["start"])))
    got = smooth(filt, jf.scan(filt, start, log), log).belief.cov
    want = gyro_exactly(log)
    std = np.sqrt(np.einsum("tii->ti", want))
    assert 1e-9 < want[0, 0, 0] < 1e-7
    assert 1e-13 < want[0, 1, 1] < 2e-12
    np.testing.assert_allclose(got / (std[:, :, None] * std[:, None, :]), want / (std[:, :, None] * std[:, None, :]),
                               rtol=0, atol=1e-9)  # fmt: skip
    others = gyro_exactly(log, jitter=1e-8)
    assert np.abs(np.einsum("tii->ti", others) / std**2 - 1).max() > 0.9


# --- nonlinear, and on manifolds --------------------------------------------------------------------------------------


def sigma_transition(rule):
    """Mean and covariance predicted, and the covariance of the state before with it: Sarkka (2013), eqs. 9.17, 9.18."""

    def transition(book, x, P, u, dt):
        points, wm, wc = rule(len(P))
        spread = points @ np.linalg.cholesky(P).T
        images = [book.f(book.plus(x, d), u, dt) for d in spread]
        mean = oracles.mean_of(images, wm, book.f(x, u, dt), book.plus, book.minus)
        away = np.array([book.minus(y, mean) for y in images])
        cov = sum(w * np.outer(a, a) for w, a in zip(wc, away, strict=True)) + book.Q(x, u, dt)
        return mean, cov, sum(w * np.outer(d, a) for w, d, a in zip(wc, spread, away, strict=True))

    return transition


def taylor_transition(book, x, P, u, dt):
    """Sarkka (2013), eq. 9.4."""
    F = book.F(x, u, dt)
    return book.f(x, u, dt), F @ P @ F.T + book.Q(x, u, dt), P @ F.T


TRANSITIONS = {
    "ekf": taylor_transition,
    "iekf": taylor_transition,
    "ukf 0.5": sigma_transition(lambda n: oracles.unscented_rule(n, 0.5)),
    "ckf": sigma_transition(oracles.cubature_rule),
    "gauss_hermite": sigma_transition(lambda n: oracles.gauss_hermite_rule(n, 3)),
}


def rts(book, result, rows, transition):
    """The book's smoother, covariance by the difference; errors are carried between tangent spaces by hand."""
    x, P = result.means[-1], result.covs[-1]
    means, covs, crosses = [x], [P], []
    for k in range(len(rows) - 2, -1, -1):
        m, cov, row = result.means[k], result.covs[k], rows[k + 1]
        if row.dt > 0:
            ahead, P_ahead, C = transition(book, m, cov, row.u, row.dt)
            G = C @ np.linalg.inv(P_ahead)
            d = book.minus(x, ahead)
            back = np.linalg.inv(book.carry(d))
            there = back @ P @ back.T
            on = book.carry(G @ d)
            crosses.append(on @ G @ back @ P)
            x, P = book.plus(m, G @ d), on @ (cov + G @ (there - P_ahead) @ G.T) @ on.T
        else:
            crosses.append(P)
        means.append(x)
        covs.append(P)
    return means[::-1], np.array(covs[::-1]), np.array(crosses[::-1])


LOOPS = [("pendulum", f) for f in TRANSITIONS] + [("car", "ukf 0.5")]
LOOPS += [("body", f) for f in ("ekf", "ckf")]


@pytest.mark.parametrize(("name", "filter"), LOOPS)
def test_is_the_loop_of_the_books(name, filter):
    s = system(name)
    book = s.book(s.theta)
    rows = oracles.rows_of(s.log, book)
    result = oracles.loop(book, s.start, s.belief.cov, rows, *oracles.filters(iterations=3)[filter])
    means, covs, crosses = rts(book, result, rows, TRANSITIONS[filter])
    _, got = smoothed(name, filter)
    np.testing.assert_allclose(s.flat(got.belief.mean), [s.book_flat(x) for x in means], rtol=0, atol=1e-8)
    np.testing.assert_allclose(got.belief.cov, covs, rtol=0, atol=1e-9)
    np.testing.assert_allclose(got.cross, crosses, rtol=0, atol=1e-9)


FLAT = [("linear", "kf"), ("linear", "ckf"), ("pendulum", "ekf"), ("pendulum", "ukf 0.5"), ("car", "ukf 0.5")]


@pytest.mark.parametrize(("name", "filter"), FLAT)
def test_never_knows_less_than_the_filter(name, filter):
    track, got = smoothed(name, filter)
    gained = np.linalg.eigvalsh(track.belief.cov - got.belief.cov)
    assert gained.min() > -1e-12
    assert gained[:-1, -1].min() > 0
    np.testing.assert_array_equal(got.belief.cov, np.swapaxes(got.belief.cov, 1, 2))
    assert np.linalg.eigvalsh(got.belief.cov).min() > 0


@pytest.mark.parametrize(("name", "filter"), [("linear", "kf"), ("car", "ukf 0.5"), ("body", "ekf")])
def test_in_no_time_a_row_is_the_next(name, filter):
    s, (track, got) = system(name), smoothed(name, filter)
    still = np.flatnonzero(s.log.dt[1:] == 0)
    assert len(still) > 3
    for leaf in jax.tree.leaves(got.belief):
        np.testing.assert_array_equal(leaf[still], leaf[still + 1])
    np.testing.assert_array_equal(got.cross[still], got.belief.cov[still])
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[-1], b[-1]), track.belief, got.belief)


@functools.cache
def body_runs():
    """NEES of filter and smoother (runs, T) of a tumbling body, readings drawn from its own model."""
    s = system("body")
    filt, runs = jf.ekf(s.model(s.theta)), 150
    start = s.belief._replace(cov=0.05 * s.belief.cov)

    def one(key):
        truth, log = jf.simulate(filt.model, start, s.log, key)
        track = jf.scan(filt, start, log)

        def nees(x, b):
            e = filt.model.space.minus(x, b.mean)
            return e @ jnp.linalg.solve(b.cov, e), e @ e

        return [jax.vmap(nees)(truth, b) for b in (track.belief, smooth(filt, track, log).belief)]

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(4), runs)))


def test_is_consistent_and_better_than_the_filter_on_rotations():
    (filtered, e_filter), (after, e_smooth) = body_runs()
    # 150 runs of 6 degrees of freedom: the mean of a row is 6 +- 0.28.
    assert np.abs(filtered.mean(0) - 6).max() < 1.6
    assert np.abs(after.mean(0) - 6).max() < 1.6
    assert np.abs(after.mean() - 6) < 0.5
    assert e_smooth.mean() < 0.75 * e_filter.mean()


# --- fixed lag --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "filter", "lag"), [("linear", "kf", 5), ("body", "ekf", 3), ("linear", "ckf", 0)])
def test_fixed_lag_is_the_smoother_of_what_is_known_so_far(name, filter, lag):
    s = system(name)

    @jax.jit
    def run(theta, belief, log):
        late = fixed_lag(FILTERS[filter](s.model(theta)), lag)
        return jf.scan(late, belief, log, lambda carried, info: (late.gaussian(carried), info))

    @jax.jit
    def up_to(theta, belief, log, k):
        """A log whose rows after k are dt = 0 and silent ends at k."""
        late = np.arange(len(log.dt)) > k
        silent = {name: ~late.reshape(-1, *[1] * (v.ndim - 1)) & v for name, v in log.valid.items()}
        log = log._replace(dt=jnp.where(late, 0.0, log.dt), valid=silent)
        filt = FILTERS[filter](s.model(theta))
        return smooth(filt, jf.scan(filt, belief, log), log).belief

    got, info = run(s.theta, s.belief, s.log)
    jax.tree.map(np.testing.assert_array_equal, info, smoothed(name, filter)[0].info)
    for k in (lag, lag + 1, 20, 39):
        want = up_to(s.theta, s.belief, s.log, k)
        for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
            np.testing.assert_allclose(a[k], b[k - lag], rtol=0, atol=1e-11)


def test_fixed_lag_before_as_many_rows_is_the_start_smoothed():
    s = system("linear")
    filt = jf.kf(s.model(s.theta))
    first = jax.tree.map(lambda a: a[:4], s.log)
    late = fixed_lag(filt, 10)
    said = jf.scan(late, s.belief, first, lambda carried, info: late.gaussian(carried))
    begun = jax.tree.map(lambda a: np.concatenate([np.zeros_like(a[:1]), a]), first)
    whole = smooth(filt, jf.scan(filt, s.belief, begun), begun).belief
    np.testing.assert_allclose(said.mean[-1], whole.mean[0], atol=1e-12)
    np.testing.assert_allclose(said.cov[-1], whole.cov[0], atol=1e-12)


def test_fixed_lag_goes_on_from_what_it_carried():
    s = system("linear")
    late = fixed_lag(jf.kf(s.model(s.theta)), 4)
    halves = [jax.tree.map(lambda a, part=part: a[part], s.log) for part in (slice(0, 15), slice(15, None))]
    store = lambda carried, info: carried  # noqa: E731
    first = jf.scan(late, s.belief, halves[0], store)
    second = jf.scan(late, jax.tree.map(lambda a: a[-1], first), halves[1], store)
    whole = jf.scan(late, s.belief, s.log, store)
    assert isinstance(second, Window)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b[15:], rtol=0, atol=1e-12), second, whole)


def test_fixed_lag_of_many_runs():
    s = system("linear")
    late = fixed_lag(jf.kf(s.model(s.theta)), 2)
    store = lambda carried, info: late.gaussian(carried)  # noqa: E731
    z = {name: np.stack([a, a + 1]) for name, a in s.log.z.items()}
    many = jf.scan_runs(late, s.belief, s.log._replace(z=z), ("z",), store)
    for run in range(2):
        one = jf.scan(late, s.belief, s.log._replace(z=jax.tree.map(lambda a, run=run: a[run], z)), store)
        np.testing.assert_allclose(many.mean[run], one.mean, rtol=0, atol=1e-12)


# --- drawn trajectories -----------------------------------------------------------------------------------------------


def moments_of(drawn):
    """Mean (T n,) and covariance of trajectories."""
    flat = np.asarray(drawn).reshape(len(drawn), -1)
    return flat.mean(0), np.cov(flat.T)


def off(drawn, mean, cov):
    """The largest deviations of a sample's mean and covariance from their own, in standard deviations of the sample."""
    m, C = moments_of(drawn)
    std = np.sqrt(np.diag(cov))
    at_mean = np.abs(m - mean) / std * np.sqrt(len(drawn))
    rho = cov / np.outer(std, std)
    at_cov = np.abs(C / np.outer(std, std) - rho) / np.sqrt((1 + rho**2) / len(drawn))
    return at_mean.max(), at_cov.max()


def test_trajectories_are_jointly_distributed_as_the_posterior():
    s, n = system("linear"), 20_000
    filt = jf.kf(s.model(s.theta))
    track, _ = smoothed("linear", "kf")
    drawn = sample_trajectories(filt, track, s.log, jax.random.key(1), n)
    mean, cov = dense_linear()
    size = mean.size
    assert drawn.shape == (n, *mean.shape)
    still = np.flatnonzero(s.log.dt[1:] == 0)
    np.testing.assert_array_equal(drawn[:, still], drawn[:, still + 1])
    at_mean, at_cov = off(drawn, mean.ravel(), cov.reshape(size, size))
    assert at_mean < 4.5  # of 120 components
    assert at_cov < 5.5  # of 7,260
    shuffled = np.stack([np.random.default_rng(k).permutation(np.asarray(drawn)[:, k]) for k in range(40)], 1)
    at_mean, at_cov = off(shuffled, mean.ravel(), cov.reshape(size, size))
    assert at_mean < 4.5
    assert at_cov > 50  # each row's belief alone is not the posterior


def test_trajectories_of_a_rotation_have_the_smoothed_moments():
    """With little noise, where first order is enough: each row's mean and covariance, and the next row's covariance."""
    s = system("body")
    theta = s.theta | {name: s.theta[name] - 3 for name in ("q", "compass", "camera")}
    n, start = 3000, s.belief._replace(cov=np.exp(-6) * s.belief.cov)

    @jax.jit
    def run(theta, start):
        filt = jf.ekf(s.model(theta))
        _, log = jf.simulate(filt.model, start, s.log, jax.random.key(2))
        track = jf.scan(filt, start, log)
        got = smooth(filt, track, log)
        drawn = sample_trajectories(filt, track, log, jax.random.key(3), n)
        return got, jax.vmap(jax.vmap(filt.model.space.minus), (0, None))(drawn, got.belief.mean)

    got, errors = jax.tree.map(np.asarray, run(theta, start))
    size = np.sqrt(np.einsum("tii->ti", got.belief.cov))
    assert np.abs(errors.mean(0) / size).max() < 5 / np.sqrt(n)
    products = np.einsum("nti,ntj->tij", errors, errors) / n
    np.testing.assert_allclose(products / (size[:, :, None] * size[:, None]),
                               got.belief.cov / (size[:, :, None] * size[:, None]), rtol=0, atol=0.12)  # fmt: skip
    products = np.einsum("nti,ntj->tij", errors[:, :-1], errors[:, 1:]) / n
    scale = size[:-1, :, None] * size[1:, None]
    np.testing.assert_allclose(products / scale, got.cross / scale, rtol=0, atol=0.12)


def test_trajectories_with_singular_noise():
    """White acceleration over an interval at once (rank 1), a constant that is known: no NaN, and the mean is right."""
    A, G = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), np.array([[0.005], [0.1], [0.0]])
    log = jf.Log(np.ones(50), (), {"z": np.ones((50, 1))}, {}, {})
    matrices = A, np.array([[1.0, 0.0, 1.0]]), G @ G.T, np.array([[0.1]])

    @jax.jit
    def run(matrices, start, log):
        filt = jf.kf(jf.linear(*matrices))
        track = jf.scan(filt, start, log)
        return sample_trajectories(filt, track, log, jax.random.key(0), 500), smooth(filt, track, log).belief

    for dtype in (np.float32, np.float64):
        start = jf.Gaussian(np.zeros(3), np.diag([1.0, 1.0, 0.0]))
        drawn, got = jax.tree.map(np.asarray, run(*(cast(tree, dtype) for tree in (matrices, start, log))))
        assert drawn.dtype == dtype
        assert np.isfinite(drawn).all()
        assert np.abs(drawn[..., 2]).max() == 0
        size = np.sqrt(np.einsum("tii->ti", got.cov))[:, :2]
        assert (np.abs(drawn.mean(0) - got.mean)[:, :2] / size).max() < 5 / np.sqrt(500)


# --- derivatives, batches, single precision ---------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "filter"), [("linear", "ckf"), ("pendulum", "ekf")])
def test_gradients(name, filter):
    """Reverse mode against differences, in a batch, where rows of dt = 0 run both branches."""
    s = SYSTEMS[name](12)

    def loss(theta, log):
        filt = FILTERS[filter](s.model(theta))
        got = smooth(filt, jf.scan(filt, s.belief, log), log)
        origin = filt.model.space.origin
        away = jax.vmap(lambda x: filt.model.space.minus(x, origin))(got.belief.mean)
        return (away**2).sum() + jnp.log(got.belief.cov[:, 0, 0]).sum() + got.cross.sum()

    def total(theta):
        return jax.vmap(lambda dt: loss(theta, s.log._replace(dt=dt)))(np.stack([s.log.dt, s.log.dt])).sum()

    total = jax.jit(total)
    slope = jax.jit(jax.grad(total))(s.theta)
    for name, along in slope.items():
        assert np.isfinite(along).all()
        assert np.abs(along).max() > 0
        d = np.random.default_rng(1).normal(size=np.shape(along))
        h = 1e-5
        ends = [total(s.theta | {name: s.theta[name] + sign * h * d}) for sign in (1, -1)]
        np.testing.assert_allclose(np.sum(along * d), (ends[0] - ends[1]) / (2 * h), rtol=2e-5, atol=1e-6)


def test_many_runs():
    s = system("car")
    filt = jf.ekf(s.model(s.theta))
    logs = jax.tree.map(lambda a: np.stack([a, a]), s.log)
    logs.dt[1, 7:9] = 0.0
    tracks = jax.jit(lambda logs: jf.scan_runs(filt, s.belief, logs))(logs)
    many = jax.jit(jax.vmap(lambda track, log: smooth(filt, track, log)))(tracks, logs)
    for run in range(2):
        track, log = jax.tree.map(lambda a, run=run: a[run], (tracks, logs))
        one = smooth(filt, track, log)
        jax.tree.map(lambda a, b, run=run: np.testing.assert_allclose(a[run], b, rtol=0, atol=1e-10), many, one)


@pytest.mark.parametrize(("name", "filter"), [("linear", "kf"), ("body", "ekf")])
def test_single_precision(name, filter):
    s, (_, want) = system(name), smoothed(name, filter)
    theta, belief, log = (cast(tree, np.float32) for tree in (s.theta, s.belief, s.log))

    @jax.jit
    def run(theta, belief, log):
        filt = FILTERS[filter](s.model(theta))
        track = jf.scan(filt, belief, log)
        return smooth(filt, track, log), sample_trajectories(filt, track, log, jax.random.key(0), 3)

    got, drawn = run(theta, belief, log)
    for leaf in jax.tree.leaves((got, drawn)):
        assert leaf.dtype == np.float32
        assert np.isfinite(leaf).all()
    got = jax.tree.map(np.asarray, got)
    size = np.sqrt(np.einsum("tii->ti", want.belief.cov))
    assert np.abs((got.belief.cov - want.belief.cov) / (size[:, :, None] * size[:, None])).max() < 2e-3
    means = s.flat(want.belief.mean)
    assert np.abs(s.flat(got.belief.mean) - means).max() < 5e-4 * np.abs(means).max()


@pytest.mark.parametrize(("name", "filter"), [("linear", "kf"), ("car", "ukf 0.5")])
def test_all_rows_at_once(name, filter):
    s, (track, want) = system(name), smoothed(name, filter)
    got = jax.jit(lambda track, log: smooth(FILTERS[filter](s.model(s.theta)), track, log, parallel=True))(track, s.log)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-9), got, want)


# --- at the door ------------------------------------------------------------------------------------------------------


def test_bad_input_is_named():
    s = system("linear")
    filt, (track, _) = jf.kf(s.model(s.theta)), smoothed("linear", "kf")
    spoilt = track.belief.mean.copy()
    spoilt[17, 1] = np.nan
    shorter = jax.tree.map(lambda a: a[:-1], s.log)
    wrong: Any = filt.model
    cases = [
        (TypeError, "filter: expected a Filter", lambda: smooth(wrong, track, s.log)),
        (TypeError, "filter: expected one with a transition", lambda: smooth(fixed_lag(filt, 2), track, s.log)),
        (TypeError, "track: expected a Track, got Gaussian", lambda: smooth(filt, track.belief, s.log)),
        (TypeError, "track.belief: expected a Gaussian", lambda: smooth(filt, jf.Track(spoilt, {}), s.log)),
        (ValueError, r"track.belief.mean: expected shapes \(39, 3\)", lambda: smooth(filt, track, shorter)),
        (ValueError, r"track.belief.cov: expected shape \(40, 3, 3\), got \(40, 3\)",
         lambda: smooth(filt, jf.Track(jf.Gaussian(spoilt, spoilt), {}), s.log)),
        (ValueError, r"track.belief.mean: expected finite numbers, got nan at \[17, 1\]",
         lambda: smooth(filt, track._replace(belief=track.belief._replace(mean=spoilt)), s.log)),
        (KeyError, "expected one of", lambda: smooth(filt, track, s.log._replace(z={"sonar": s.log.dt}))),
        (TypeError, "expected float32", lambda: smooth(filt, cast(track, np.float32), s.log)),
        (ValueError, "n: expected at least one", lambda: sample_trajectories(filt, track, s.log, jax.random.key(0), 0)),
        (ValueError, "lag: expected at least 0 rows, got -1", lambda: fixed_lag(filt, -1)),
        (TypeError, "filter: expected one with a transition", lambda: fixed_lag(filt._replace(transition=None), 1)),
        (ValueError, "carried: expected", lambda: fixed_lag(filt, 3).begin(fixed_lag(filt, 2).begin(s.belief))),
    ]  # fmt: skip
    for kind, message, call in cases:
        with pytest.raises(kind, match=message):
            call()


def test_what_is_returned():
    _, got = smoothed("car", "ekf")
    assert isinstance(got, Smoothed)
    assert isinstance(got.belief, jf.Gaussian)
    assert got.cross.shape == (39, 4, 4)
