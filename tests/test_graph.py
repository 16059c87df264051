"""Factor graphs against dense least squares that share no code with them, and on recordings."""

import builtins
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import Book, rows_of
from scipy.optimize import least_squares
from systems import P_LINEAR, System, body_system, book_covariance, car_system, linear_system, pendulum_system
from systems import B as INPUT
from systems import H as MAPS

import jaxfilt as jf
from jaxfilt import graph, recordings
from jaxfilt.models.wheeled import INDOOR_ROBOT, Odometry, Pose, unicycle


def joint(A: Any, Bu: Any, Q: Any, x: Any, P: Any, dt: Any, readings: list) -> tuple[np.ndarray, np.ndarray]:
    """Means (T + 1, n) and covariances of all states given every reading, by one conditioning of one big Gaussian.

    ``readings``: (rows, maps, z, R): sums of maps times the states after these rows, 0 the start.
    """
    n, T = len(x), len(dt)
    M, offset = [np.eye(n, n * (T + 1))], [x]
    for k in range(T):
        step, shift = (A, Bu[k]) if dt[k] > 0 else (np.eye(n), np.zeros(n))
        after = step @ M[-1]
        if dt[k] > 0:
            after[:, n * (k + 1) : n * (k + 2)] = np.eye(n)
        M.append(after)
        offset.append(step @ offset[-1] + shift)
    prior = np.kron(np.eye(T + 1), Q)
    prior[:n, :n] = P
    H = np.vstack([sum(D @ M[k] for k, D in zip(rows, maps, strict=True)) for rows, maps, _, _ in readings])
    r = np.concatenate(
        [z - sum(D @ offset[k] for k, D in zip(rows, maps, strict=True)) for rows, maps, z, _ in readings]
    )
    R = np.zeros((len(r), len(r)))
    end = 0
    for *_, block in readings:
        R[end : end + len(block), end : end + len(block)] = block
        end += len(block)
    M, offset = np.array(M), np.array(offset)
    gain = np.linalg.solve(H @ prior @ H.T + R, H @ prior).T
    posterior = prior - gain @ H @ prior
    return offset + M @ (gain @ r), M @ posterior @ np.swapaxes(M, 1, 2)


def solved(filt: jf.Filter, belief: Any, log: Any, between: Any = (), **options: Any) -> graph.Trajectory:
    return jax.jit(lambda b, l: graph.optimise(filt, b, l, between, **options))(belief, log)


def same(found: graph.Trajectory, means: np.ndarray, covs: np.ndarray, tolerance: float = 1e-9) -> None:
    assert found.converged
    np.testing.assert_allclose(found.start.mean, means[0], atol=tolerance)
    np.testing.assert_allclose(found.belief.mean, means[1:], atol=tolerance)
    np.testing.assert_allclose(found.start.cov, covs[0], atol=tolerance)
    np.testing.assert_allclose(found.belief.cov, covs[1:], atol=tolerance)


@pytest.fixture(scope="module")
def linear() -> tuple[System, list]:
    """Irregular rows, some of no duration, with components missing; and its readings for `joint`."""
    system = linear_system(25)
    readings = []
    for k, row in enumerate(rows_of(system.log, system.book(system.theta))):
        for i, name in enumerate(MAPS):
            if name in row.readings:
                z, _, seen = row.readings[name]
                R = book_covariance(system.theta[name], 3 + i)
                readings.append(((k + 1,), (MAPS[name][seen],), z[seen], R[np.ix_(seen, seen)]))
    return system, readings


def posterior(system: System, readings: list) -> tuple[np.ndarray, np.ndarray]:
    Bu = np.asarray(system.log.u) @ INPUT.T
    Q = book_covariance(system.theta["q"], 2)
    return joint(system.theta["A"], Bu, Q, system.start, P_LINEAR, system.log.dt, readings)


def test_on_a_linear_model_it_is_the_dense_joint_posterior(linear):
    system, readings = linear
    assert (system.log.dt == 0).any()
    found = solved(jf.kf(system.model(system.theta)), system.belief, system.log)
    same(found, *posterior(system, readings))
    track = jf.scan(jf.kf(system.model(system.theta)), system.belief, system.log)
    less = track.belief.cov - found.belief.cov
    assert np.linalg.eigvalsh(less).min() > -1e-12


def test_factors_between_instants_count_as_in_the_joint_posterior(linear):
    system, readings = linear
    D, rows = np.array([[1.0, 0.0, 0.5], [0.0, 0.0, 1.0]]), np.array([[2, 17], [20, 5], [-1, 24], [-1, 10]])
    z, R = np.random.default_rng(0).normal(size=(4, 2)), np.array([[0.04, 0.01], [0.01, 0.09]])
    tie = graph.Between(rows, z, lambda a, b, c: D @ b - 2 * D @ a, lambda a, b, c: jnp.asarray(R), jf.vector(2))
    found = solved(jf.kf(system.model(system.theta)), system.belief, system.log, [tie])
    tied = [((i + 1, j + 1), (-2 * D, D), z[k], R) for k, (i, j) in enumerate(rows)]
    same(found, *posterior(system, readings + tied))
    loose = posterior(system, readings)[0][1:]
    assert np.abs(loose - found.belief.mean).max() > 0.1


def test_a_robust_factor_is_as_if_its_noise_were_larger(linear):
    """Huber's weights found by iterating on the joint posterior."""
    system, readings = linear
    rows, R, limit = np.array([[2, 17], [4, 20]]), np.diag([0.04, 0.09, 0.01]), 7.814727903251178
    means = posterior(system, readings)[0]
    z = means[rows[:, 1] + 1] - means[rows[:, 0] + 1] + np.array([[3.0, -2.0, 4.0], [0.1, 0.0, -0.1]])
    tie = graph.Between(rows, z, lambda a, b, c: b - a, lambda a, b, c: jnp.asarray(R), jf.vector(3), robust=0.95)
    found = solved(jf.kf(system.model(system.theta)), system.belief, system.log, [tie])
    weights = np.ones(2)
    for _ in range(60):
        tied = [((i + 1, j + 1), (-np.eye(3), np.eye(3)), z[k], R / weights[k]) for k, (i, j) in enumerate(rows)]
        means, covs = posterior(system, readings + tied)
        e = z - (means[rows[:, 1] + 1] - means[rows[:, 0] + 1])
        weights = np.minimum(1, np.sqrt(limit / np.sum(e * np.linalg.solve(R, e.T).T, 1)))
    assert weights[0] < 0.5
    assert weights[1] == 1
    same(found, means, covs, 1e-5)


def test_states_without_noise_stay_what_they_are():
    """Position, velocity and a constant bias of the velocity's sensor: Q = B var B' of rank one, P of rank two."""
    dt, T = 0.5, 30
    A = np.array([[1.0, dt, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    b = np.array([[dt**2 / 2], [dt], [0.0]])
    Q, P = 0.3 * b @ b.T, np.diag([0.0, 1.0, 4.0])
    H, R = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]]), np.diag([0.5, 0.01])
    z = np.cumsum(np.random.default_rng(1).normal(size=(T, 2)), 0)
    model = jf.linear(*(jnp.asarray(M) for M in (A, H, Q, R)))
    log = jf.Log(np.full(T, dt), (), {"z": z}, {}, {})
    found = solved(jf.kf(model), jf.Gaussian(np.zeros(3), P), log)
    readings = [((k + 1,), (H,), z[k], R) for k in range(T)]
    same(found, *joint(A, np.zeros((T, 3)), Q, np.zeros(3), P, log.dt, readings))
    assert np.ptp(found.belief.mean[:, 2]) < 1e-12


def root(P: np.ndarray) -> np.ndarray:
    return np.linalg.cholesky(P)


def rolled(book: Book, x: Any, P: np.ndarray, rows: list, noises: np.ndarray) -> list:
    """The states that a start and a sequence of standard normal noises (T + 1, n) lead to."""
    points = [book.plus(x, root(P) @ noises[0])]
    for row, e in zip(rows, noises[1:], strict=True):
        x = points[-1]
        points.append(book.plus(book.f(x, row.u, row.dt), root(book.Q(x, row.u, row.dt)) @ e) if row.dt > 0 else x)
    return points


def huber(e: np.ndarray, limit: float | None) -> np.ndarray:
    nis = e @ e
    return e if limit is None or nis <= limit else e * np.sqrt((2 * np.sqrt(limit * nis) - limit) / nis)


def shooting(system: System, P: np.ndarray, limits: dict | None = None) -> tuple[np.ndarray, np.ndarray, float]:
    """SciPy's answer: least squares over start and noises, derivatives by differences. Flat means, covs, cost."""
    book = system.book(system.theta)
    rows, n = rows_of(system.log, book), len(P)

    def residuals(flat: np.ndarray) -> np.ndarray:
        noises = flat.reshape(-1, n)
        points, parts = rolled(book, system.start, P, rows, noises), [flat]
        for x, row in zip(points[1:], rows, strict=True):
            for name, (z, c, seen) in row.readings.items():
                sensor = book.sensors[name]
                e = sensor.minus(z, sensor.h(x, c))[seen]
                e = np.linalg.solve(root(sensor.R(x, c)[np.ix_(seen, seen)]), e)
                parts.append(huber(e, limits[name][len(seen)] if limits else None))
        return np.concatenate(parts)

    best = least_squares(residuals, np.zeros(n * (len(rows) + 1)), method="trf", xtol=1e-14, ftol=1e-14, gtol=1e-12)
    points, covs, tiny = rolled(book, system.start, P, rows, best.x.reshape(-1, n)), [], 1e-6
    D = np.zeros((len(points), n, len(best.x)))
    for k in range(len(best.x)):
        up, down = (
            rolled(book, system.start, P, rows, (best.x + s * tiny * np.eye(len(best.x))[k]).reshape(-1, n))
            for s in (1, -1)
        )
        D[:, :, k] = [
            (book.minus(u, x) - book.minus(d, x)) / (2 * tiny) for u, x, d in zip(up, points, down, strict=True)
        ]
    covs = D @ np.linalg.inv(best.jac.T @ best.jac) @ np.swapaxes(D, 1, 2)
    return np.array([system.book_flat(x) for x in points]), covs, best.cost


@pytest.mark.parametrize("build", [pendulum_system, car_system, pytest.param(body_system, marks=pytest.mark.long)])
def test_it_is_where_scipy_finds_the_optimum(build):
    system = build(6)
    model, P = system.model(system.theta), np.asarray(system.belief.cov)
    found = solved(jf.ekf(model), system.belief, system.log)
    means, covs, cost = shooting(system, P)
    assert found.converged
    assert float(found.cost) == pytest.approx(cost, rel=1e-7)
    np.testing.assert_allclose(system.flat(found.belief.mean), means[1:], atol=1e-5)
    np.testing.assert_allclose(found.belief.cov, covs[1:], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(found.start.cov, covs[0], rtol=1e-4, atol=1e-6)


def test_robust_losses_are_hubers():
    system = pendulum_system(14)
    z = system.log.z["side"].copy()
    z[np.flatnonzero(system.log.valid["side"])[[2, 5, 8]]] += [1.5, -2.0, 3.0]
    system = system._replace(log=system.log._replace(z={"side": z}))
    filt = jf.ekf(system.model(system.theta), robust=0.95)
    limits = {"side": [None, 3.841458820694124]}
    means, _, cost = shooting(system, np.asarray(system.belief.cov), limits)
    found = solved(filt, system.belief, system.log, robust=0.95)
    assert found.converged
    assert float(found.cost) == pytest.approx(cost, rel=1e-6)
    np.testing.assert_allclose(found.belief.mean, means[1:], atol=2e-5)
    plain = solved(filt, system.belief, system.log)
    assert np.abs(plain.belief.mean - means[1:]).max() > 0.05


ROBOT = {**INDOOR_ROBOT, "turn": np.log(0.003)}


def laps(steps: int, lap: int, every: int) -> tuple[Any, jf.Gaussian, jf.Log, Pose, graph.Between]:
    """Circles by odometry alone, and where the robot, each time, sees itself relative to one lap ago."""
    model, rng = unicycle(ROBOT), np.random.default_rng(3)
    u = Odometry(np.full(steps, 0.5), np.full(steps, 2 * np.pi / lap))
    begin = jf.Gaussian(Pose(np.zeros(2), np.zeros(())), 1e-6 * np.eye(3))

    def drive(x: Pose, noise: Any) -> tuple[Pose, Pose]:
        held, dt = Odometry(*(jnp.asarray(a[0]) for a in u)), jnp.ones(())
        x = model.space.plus(model.f(x, held, dt), jnp.linalg.cholesky(model.Q(x, held, dt)) @ noise)
        return x, x

    truth = jax.lax.scan(drive, jax.tree.map(jnp.asarray, begin.mean), rng.normal(size=(steps, 3)))[1]
    rows = np.array([(k - lap, k) for k in range(lap + every - 1, steps, every)])
    tie = graph.planar(rows, Pose(np.zeros((len(rows), 2)), np.zeros(len(rows))), 1e-4 * np.eye(3))
    a, b = (jax.tree.map(lambda x, r=r: x[r], truth) for r in rows.T)
    z = jax.vmap(lambda a, b, d: tie.space.plus(tie.h(a, b, ()), d))(a, b, 0.01 * rng.normal(size=(len(rows), 3)))
    return jf.ekf(model), begin, jf.Log(np.ones(steps), u, {}, {}, {}), truth, tie._replace(z=z)


def distance(found: graph.Trajectory, truth: Pose) -> float:
    return float(jnp.sqrt(jnp.mean(jnp.sum((found.belief.mean.pos - truth.pos) ** 2, 1))))


def test_closing_loops_helps_and_no_variance_grows():
    filt, begin, log, truth, tie = laps(150, 50, 20)
    alone = solved(filt, begin, log)
    found = solved(filt, begin, log, [tie])
    assert found.converged
    assert distance(found, truth) < 0.7 * distance(alone, truth)
    size = lambda cov: np.trace(cov[:, :2, :2], axis1=1, axis2=2)  # noqa: E731
    assert size(found.belief.cov)[-1] < 0.5 * size(alone.belief.cov)[-1]
    assert np.linalg.eigvalsh(found.belief.cov).min() > 0


@pytest.mark.long
def test_ten_thousand_poses():
    filt, begin, log, truth, tie = laps(10_000, 400, 500)
    found = solved(filt, begin, log, [tie], rounds=1)
    assert found.converged
    assert distance(found, truth) < distance(solved(filt, begin, log, rounds=1), truth)


@pytest.mark.long
def test_poses_in_space():
    """Two bodies of which the second is seen from the first: the tie alone fixes it."""
    pose = graph.Placement(jf.vector(3), jf.so3)
    gps = jf.Sensor(lambda x, c: x.pos, jf.const(1e-8 * np.eye(3)), jf.vector(3))
    drift = jf.const(np.diag([9.0] * 3 + [1.0] * 3))
    model = jf.Model(lambda x, u, dt: x, drift, jf.product(pose), {"gps": gps})
    begin = jf.Gaussian(
        graph.Placement(np.array([1.0, 2.0, 3.0]), jf.so3_exp(jnp.array([0.3, -0.4, 1.0]))), 1e-10 * np.eye(6)
    )
    z = graph.Placement(np.array([0.5, -1.0, 0.2]), jf.so3_exp(jnp.array([0.8, 0.5, -0.6])))
    tie = graph.spatial([[-1, 1]], jax.tree.map(lambda a: a[None], z), 1e-10 * np.eye(6))
    found = solved(jf.ekf(model), begin, jf.Log(np.ones(2), (), {}, {}, {}), [tie])
    assert found.converged
    x = jax.tree.map(lambda a: a[1], found.belief.mean)
    np.testing.assert_allclose(x.pos, begin.mean.pos + jf.rotate(begin.mean.att, z.pos), atol=1e-6)
    expected = jf.so3.plus(begin.mean.att, jf.so3_log(z.att))
    np.testing.assert_allclose(jf.so3.minus(x.att, expected), 0, atol=1e-6)


def test_what_the_gate_refuses_is_left_out(linear):
    system, readings = linear
    far = system.log.z["wide"].copy()
    k = np.flatnonzero(system.log.valid["wide"].all(1))[3]
    far[k] += 1e3
    filt = jf.kf(system.model(system.theta), gate=1 - 1e-9)
    found = solved(filt, system.belief, system.log._replace(z={**system.log.z, "wide": far}))
    kept = [r for r in readings if not (r[0] == (k + 1,) and len(r[2]) == 2)]
    assert len(kept) == len(readings) - 1
    same(found, *posterior(system, kept))


def test_float32_and_many_runs(linear):
    system, readings = linear
    means, covs = posterior(system, readings)
    cast = lambda tree: jax.tree.map(  # noqa: E731
        lambda a: jnp.asarray(a, jnp.float32) if np.asarray(a).dtype.kind == "f" else jnp.asarray(a), tree
    )
    model = system.model(cast(system.theta))
    belief, log = cast(system.belief), cast(system.log)
    logs = jf.stack([log, log])
    found = jax.jit(jax.vmap(lambda l: graph.optimise(jf.kf(model), belief, l)))(logs)
    assert found.converged.all()
    assert found.belief.mean.dtype == jnp.float32
    np.testing.assert_allclose(found.belief.mean[1], means[1:], atol=1e-4)
    np.testing.assert_allclose(found.belief.cov[0], covs[1:], atol=1e-4)


def test_a_reading_is_differentiated_through():
    system = pendulum_system(10)
    filt = jf.ekf(system.model(system.theta))

    @jax.jit
    def last(z: Any) -> Any:
        return graph.optimise(filt, system.belief, system.log._replace(z={"side": z}), rounds=1).belief.mean[-1, 0]

    z = jnp.asarray(system.log.z["side"])
    k = int(np.flatnonzero(system.log.valid["side"])[-2])
    slope = jax.grad(last)(z)[k]
    tiny = 1e-3
    assert float(slope) == pytest.approx(
        float(last(z.at[k].add(tiny)) - last(z.at[k].add(-tiny))) / (2 * tiny), rel=1e-3
    )


def test_a_bad_reading_shows():
    system = linear_system(8)
    filt = jf.kf(system.model(system.theta))
    z = {**system.log.z, "arm": np.full_like(system.log.z["arm"], np.nan)}
    found = jax.jit(lambda l: graph.optimise(filt, system.belief, l))(system.log._replace(z=z))
    assert not found.converged


def test_complaints_at_the_door(linear, monkeypatch):
    system, _ = linear
    filt = jf.kf(system.model(system.theta))
    given = (system.belief, system.log)
    tie = graph.Between([[0, 1]], np.zeros((1, 3)), lambda a, b, c: b - a, lambda a, b, c: jnp.eye(3), jf.vector(3))
    for rows, text in (
        ([[0, 25]], r"between\[0\].rows: expected rows -1 to 24, got 25"),
        ([[3, 3]], r"between\[0\].rows: expected two different rows, got 3 twice"),
        ([0, 1], r"between\[0\].rows: expected pairs of rows"),
    ):
        with pytest.raises(ValueError, match=text):
            graph.optimise(filt, *given, [tie._replace(rows=rows)])
    with pytest.raises(ValueError, match=r"between\[0\].z: expected shapes \(1, 3\)"):
        graph.optimise(filt, *given, [tie._replace(z=np.zeros((2, 3)))])
    with pytest.raises(TypeError, match=r"between\[0\]: expected a Between, got tuple"):
        graph.optimise(filt, *given, [(0, 1)])
    with pytest.raises(ValueError, match="rounds: expected an integer >= 1, got 0"):
        graph.optimise(filt, *given, rounds=0)
    with pytest.raises(KeyError, match="robust: expected sensors of"):
        graph.optimise(filt, *given, robust={"nose": 0.9})
    with pytest.raises(ValueError, match="filter: expected a Kalman filter"):
        graph.optimise(filt._replace(transition=None), *given)
    with pytest.raises(ValueError, match="initial: expected shapes"):
        graph.optimise(filt, *given, initial=np.zeros((3, 3)))

    monkeypatch.delitem(sys.modules, "jaxfilt.graph.search", raising=False)
    real = builtins.__import__

    def without(name: str, *rest: Any, **more: Any) -> Any:
        if name.startswith("optimistix"):
            raise ImportError("No module named 'optimistix'", name="optimistix")
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r"pip install 'jaxfilt\[graph\]'"):
        graph.optimise(filt, *given)


@pytest.mark.data
@pytest.mark.long
@pytest.mark.usefixtures("data")
@pytest.mark.parametrize(("name", "sequence", "share"), [("utias_mrclam", "1", 0.7), ("nclt_1hz", "2013-04-05", 0.95)])
def test_it_beats_the_filter_on_recordings(name, sequence, share):
    replay = recordings.replay(name, sequence)
    filt = jf.ekf(replay.model(replay.theta), gate=recordings.GATES[name])
    begin, log = replay.belief(replay.theta), replay.recording.log
    ahead = jax.jit(lambda b, l: jf.scan(filt, b, l, store=jf.mean_only))(begin, log)
    found = jax.jit(lambda b, l: graph.optimise(filt, b, l, rounds=1))(begin, log)
    assert found.converged
    errors = [recordings.rmse(replay, x)["position"] for x in (ahead, found.belief.mean)]
    assert errors[1] < share * errors[0]
