"""Inertial navigation against scipy's rotations, fine integration, Monte Carlo, and an error-state EKF by hand."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from oracles import Book, BookSensor, no_carry
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from systems import add, cast, right_jacobian, skew, subtract

import jaxfilt as jf
from jaxfilt import consistency
from jaxfilt.models import inertial_flight, sensors
from jaxfilt.models.inertial import (
    ADIS16448,
    BMI088,
    Imu,
    Navigation,
    Wander,
    data_sheet,
    inertial,
    late,
    navigation_space,
    remembered,
    strapdown,
    strapdown_noise,
)

G = np.array([0.0, 0.0, 9.81])
SPACE = navigation_space()
THETA = {
    "gyro": np.log([0.02, 0.03, 0.01]),
    "accelerometer": np.log([0.3, 0.1, 0.2]),
    "gyro_walk": math.log(0.004),
    "accelerometer_walk": np.log([0.05, 0.02, 0.03]),
}
TURNED = Rotation.from_euler("ZYX", [2.0, -0.5, 0.3])
X = Navigation(
    np.array([1.0, -2.0, 3.0]),
    np.array([3.0, 1.0, -0.5]),
    np.roll(TURNED.as_quat(), 1),
    np.array([0.02, -0.03, 0.05]),
    np.array([0.3, -0.2, 0.1]),
)
U = Imu(np.array([0.9, -0.6, 1.5]), np.array([1.0, -2.0, 9.0]))


def rotation(att: Any) -> Rotation:
    """scipy's, which wants the scalar last."""
    return Rotation.from_quat(np.roll(np.asarray(att), -1, axis=-1))


# --- the motion ----------------------------------------------------------------------------------------------------


def by_fine_steps(x: Navigation, u: Imu, t: float, steps: int = 4000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity and rotation matrix after t s: scipy's rotations, forces summed by the trapezoid."""
    times = np.linspace(0, t, steps + 1)
    turns = rotation(x.att) * Rotation.from_rotvec(times[:, None] * (u.gyro - x.gyro_bias))
    acc = turns.apply(u.accelerometer - x.accelerometer_bias) - G
    h = t / steps
    vel = x.vel + np.r_[np.zeros((1, 3)), np.cumsum(0.5 * h * (acc[1:] + acc[:-1]), axis=0)]
    pos = x.pos + (0.5 * h * (vel[1:] + vel[:-1])).sum(0)
    return pos, vel[-1], turns[-1].as_matrix()


def test_strapdown_is_the_integral_to_second_order():
    pos, vel, R = by_fine_steps(X, U, 0.4)
    errors = []
    for steps in (20, 40):
        x = X
        for _ in range(steps):
            x = strapdown(x, U, 0.4 / steps)
        np.testing.assert_allclose(rotation(x.att).as_matrix(), R, atol=1e-12)
        errors.append(max(np.abs(x.pos - pos).max(), np.abs(x.vel - vel).max()))
        for name in ("gyro_bias", "accelerometer_bias"):
            np.testing.assert_array_equal(getattr(x, name), getattr(X, name))
    assert errors[0] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)


def test_a_negative_interval_leads_back():
    there = strapdown(X, U, 0.3, gravity=9.7)
    assert np.linalg.norm(SPACE.minus(there, X)) > 1
    np.testing.assert_allclose(SPACE.minus(strapdown(there, U, -0.3, gravity=9.7), X), 0, atol=1e-12)


def test_free_fall_and_rest():
    fallen = strapdown(X, Imu(X.gyro_bias, X.accelerometer_bias), 2.0)
    np.testing.assert_allclose(fallen.pos, X.pos + 2 * X.vel - 2 * G, atol=1e-12)
    resting = X._replace(vel=np.zeros(3))
    felt = TURNED.inv().apply(G) + X.accelerometer_bias
    np.testing.assert_allclose(SPACE.minus(strapdown(resting, Imu(X.gyro_bias, felt), 5.0), resting), 0, atol=1e-12)


# --- its noise -----------------------------------------------------------------------------------------------------


def error_dynamics(theta: dict, x: Navigation, u: Imu) -> tuple[np.ndarray, np.ndarray]:
    """A and the density of the errors' white noise, from the book."""
    R = rotation(x.att).as_matrix()
    A, density = np.zeros((15, 15)), np.zeros((15, 15))
    A[:3, 3:6], A[6:9, 9:12], A[3:6, 12:] = np.eye(3), -np.eye(3), -R
    A[3:6, 6:9] = -R @ skew(u.accelerometer - x.accelerometer_bias)
    squares = {name: np.exp(2 * np.broadcast_to(log_std, 3)) for name, log_std in theta.items()}
    density[3:6, 3:6] = R @ np.diag(squares["accelerometer"]) @ R.T
    for start, name in ((6, "gyro"), (9, "gyro_walk"), (12, "accelerometer_walk")):
        density[start : start + 3, start : start + 3] = np.diag(squares[name])
    return A, density


def integrated(A: np.ndarray, density: np.ndarray, dt: float) -> np.ndarray:
    """Van Loan's integral by scipy."""
    n = len(A)
    M = expm(dt * np.block([[-A, density], [np.zeros_like(A), A.T]]))
    return M[n:, n:].T @ M[:n, n:]


def scaled(P: Any, like: Any) -> np.ndarray:
    """A covariance in units of the standard deviations of another."""
    size = np.sqrt(np.diag(like))
    return P / np.outer(size, size)


STEADY = Imu(X.gyro_bias, U.accelerometer)  # no turn


def test_noise_is_the_integral_of_the_error_dynamics():
    A, density = error_dynamics(THETA, X, STEADY)
    small = 1e-6
    F = jax.jacfwd(lambda d: SPACE.minus(strapdown(SPACE.plus(X, d), STEADY, small), strapdown(X, STEADY, small)))
    np.testing.assert_allclose((F(np.zeros(15)) - np.eye(15)) / small, A, atol=2e-5)
    for dt in (0.004, 0.1, 1.3):
        want = integrated(A, density, dt)
        np.testing.assert_allclose(scaled(strapdown_noise(THETA, X, STEADY, dt), want), scaled(want, want), atol=1e-9)


def test_noise_of_two_half_steps_is_that_of_one():
    A, _ = error_dynamics(THETA, X, STEADY)
    for dt in (0.01, 0.7):
        half, F = strapdown_noise(THETA, X, STEADY, dt / 2), expm(0.5 * dt * A)
        whole = strapdown_noise(THETA, X, STEADY, dt)
        np.testing.assert_allclose(scaled(F @ half @ F.T + half, whole), scaled(whole, whole), atol=1e-10)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_noise_is_a_covariance_for_any_interval(dtype):
    noise = jax.jit(lambda x, u, dt: strapdown_noise(cast(THETA, dtype), x, u, dt))
    x, u = cast((X, U), dtype)
    for dt in np.logspace(-5, 1.3, 25):
        Q = np.asarray(noise(x, u, dtype(dt)))
        assert Q.dtype == dtype
        lowest = np.linalg.eigvalsh(scaled(Q, Q).astype(float))[0]
        assert lowest > -100 * np.finfo(dtype).eps


def test_units_by_monte_carlo():
    """White noise is sampled at 200 Hz with density sqrt(200), a walk steps by density / sqrt(200); 2 s at rest."""
    rng, runs, rate, steps = np.random.default_rng(3), 3000, 200, 400
    gyro, force, gyro_walk, force_walk = 0.004, 0.05, 0.01, 0.1
    theta = data_sheet(gyro, force, gyro_walk, force_walk)
    pos, vel, bg, ba = (np.zeros((runs, 3)) for _ in range(4))
    att = Rotation.identity(runs)
    for _ in range(steps):
        force_read = G + force * math.sqrt(rate) * rng.normal(size=(runs, 3))
        rate_read = gyro * math.sqrt(rate) * rng.normal(size=(runs, 3))
        acc = att.apply(force_read - ba) - G
        pos, vel = pos + vel / rate + 0.5 * acc / rate**2, vel + acc / rate
        att = att * Rotation.from_rotvec((rate_read - bg) / rate)
        bg = bg + gyro_walk / math.sqrt(rate) * rng.normal(size=(runs, 3))
        ba = ba + force_walk / math.sqrt(rate) * rng.normal(size=(runs, 3))
    found = np.concatenate([pos, vel, att.as_rotvec(), bg, ba], axis=1)
    level = Navigation(np.zeros(3), np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros(3), np.zeros(3))
    want = np.asarray(strapdown_noise(theta, level, Imu(np.zeros(3), G), 2.0))
    ratio = scaled(found.T @ found / runs, want)
    # Four standard deviations of a variance, of a correlation.
    np.testing.assert_allclose(np.diag(ratio), 1, atol=4 * math.sqrt(2 / runs))
    np.testing.assert_allclose(ratio, scaled(want, want), atol=4 * math.sqrt(2 / runs))


def test_presets_are_in_si_units():
    assert math.exp(ADIS16448["gyro"]) == pytest.approx(1.7e-4)
    assert math.degrees(math.exp(BMI088["gyro"])) == pytest.approx(0.014)
    assert math.exp(BMI088["accelerometer"]) == pytest.approx(175 * 9.80665e-6)


def test_what_wanders():
    """A Gauss-Markov process stays as wide as it is, and tends to it; a walk's variance grows evenly."""
    time, density = 20.0, 0.3
    extra = {"b": Wander(jf.vector(2), jnp.array([density, 2 * density]), time), "a": Wander(jf.scalar, density)}
    model = inertial(THETA, {}, extra)
    x = X._replace(extra={"a": np.array(1.0), "b": np.array([1.0, 2.0])})
    assert model.space.dim == 18
    for dt in (0.01, 3.0, 500.0):
        y, Q = model.f(x, U, dt), np.asarray(model.Q(x, U, dt))
        faded = math.exp(-dt / time)
        np.testing.assert_allclose(y.extra["b"], faded * x.extra["b"], rtol=1e-12)
        assert y.extra["a"] == 1.0
        assert Q[15, 15] == pytest.approx(density**2 * dt)
        wide = np.array([density, 2 * density]) ** 2 * time / 2
        np.testing.assert_allclose(faded**2 * wide + np.diag(Q)[16:], wide, rtol=1e-12)
        assert not (Q[15:] - np.diag(np.diag(Q))[15:]).any()
        np.testing.assert_array_equal(Q[:15, :15], strapdown_noise(THETA, x, U, dt))


# --- filters -------------------------------------------------------------------------------------------------------

ARM, FIELD = np.array([0.3, -0.2, 0.5]), np.array([0.2, 1.0, -1.8])
STDS = {"gnss": np.array([0.5, 0.4, 0.8]), "field": np.array([0.05, 0.04, 0.06]), "baro": np.array([0.2])}
START_STD = np.repeat([0.5, 0.2, 0.1, 0.02, 0.2], 3).tolist() + [1.0]


def small_model(theta: Any = THETA) -> jf.Model:
    R = {name: jnp.diag(jnp.asarray(std, theta["gyro"].dtype) ** 2) for name, std in STDS.items()}
    own = {
        "field": sensors.magnetometer(R["field"], FIELD),
        "gnss": sensors.gnss_position(R["gnss"], ARM),
        "baro": sensors.barometer(R["baro"], lambda x: x.extra["drift"]),
    }
    return inertial(theta, own, {"drift": Wander(jf.scalar, 0.1, 30.0)})


def book() -> Book:
    """The error-state EKF of the same; a point is (position, velocity, rotation matrix, biases, drift)."""

    def f(x: tuple, u: Imu, dt: float) -> tuple:
        p, v, R, bg, ba, d = x
        turn = dt * (u.gyro - bg)
        acc = R @ Rotation.from_rotvec(turn / 2).as_matrix() @ (u.accelerometer - ba) - G
        R = R @ Rotation.from_rotvec(turn).as_matrix()
        return p + dt * v + dt**2 / 2 * acc, v + dt * acc, R, bg, ba, math.exp(-dt / 30.0) * d

    def F(x: tuple, u: Imu, dt: float) -> np.ndarray:
        _, _, R, bg, ba, _ = x
        turn, force = dt * (u.gyro - bg), u.accelerometer - ba
        half = Rotation.from_rotvec(turn / 2).as_matrix()
        by = np.zeros((3, 16))  # how the acceleration answers
        by[:, 6:9] = -R @ skew(half @ force)
        by[:, 9:12] = dt / 2 * R @ half @ skew(force) @ right_jacobian(turn / 2)
        by[:, 12:15] = -R @ half
        J = np.eye(16)
        J[:3, 3:6] = dt * np.eye(3)
        J[:3] += dt**2 / 2 * by
        J[3:6] += dt * by
        J[6:9, 6:9], J[6:9, 9:12] = Rotation.from_rotvec(-turn).as_matrix(), -dt * right_jacobian(turn)
        J[15, 15] = math.exp(-dt / 30.0)
        return J

    def Q(x: tuple, u: Imu, dt: float) -> np.ndarray:
        at = Navigation(x[0], x[1], np.roll(Rotation.from_matrix(x[2]).as_quat(), 1), x[3], x[4])
        noise = np.zeros((16, 16))
        noise[:15, :15] = integrated(*error_dynamics(THETA, at, u), dt)
        noise[15, 15] = 0.01 * 15.0 * (1 - math.exp(-2 * dt / 30.0))
        return noise

    def plus(x: tuple, d: np.ndarray) -> tuple:
        R = x[2] @ Rotation.from_rotvec(d[6:9]).as_matrix()
        return x[0] + d[:3], x[1] + d[3:6], R, x[3] + d[9:12], x[4] + d[12:15], x[5] + d[15]

    def minus(a: tuple, b: tuple) -> np.ndarray:
        turn = Rotation.from_matrix(b[2].T @ a[2]).as_rotvec()
        return np.r_[a[0] - b[0], a[1] - b[1], turn, a[3] - b[3], a[4] - b[4], a[5] - b[5]]

    def carry(d: np.ndarray) -> np.ndarray:
        J = no_carry(d)
        J[6:9, 6:9] = right_jacobian(d[6:9])
        return J

    def row(**parts: np.ndarray) -> np.ndarray:
        where = {"p": slice(0, 3), "th": slice(6, 9), "d": slice(15, 16)}
        H = np.zeros((len(next(iter(parts.values()))), 16))
        for name, part in parts.items():
            H[:, where[name]] = part
        return H

    up, one = np.array([[0.0, 0.0, 1.0]]), np.ones((1, 1))
    looks = {
        "field": (lambda x, c: x[2].T @ FIELD, lambda x, c: row(th=skew(x[2].T @ FIELD))),
        "gnss": (lambda x, c: x[0] + x[2] @ ARM, lambda x, c: row(p=np.eye(3), th=-x[2] @ skew(ARM))),
        "baro": (lambda x, c: x[0][2:] + x[5], lambda x, c: row(p=up, d=one)),
    }
    book_sensors = {
        name: BookSensor(h, H, lambda x, c, R=np.diag(STDS[name] ** 2): R, add, subtract, at_row)
        for name, (h, H) in looks.items()
    }
    return Book(f, F, Q, plus, minus, carry, book_sensors)


def at_row(z: np.ndarray, k: int) -> np.ndarray:
    return np.atleast_1d(z[k])


@functools.cache
def tracked(dtype: Any) -> jf.Track:
    """The EKF over the small log, from a start that is off."""
    start, log = small_log()
    arguments = THETA, jf.Gaussian(off(start), np.diag(np.square(START_STD))), log
    run = jax.jit(lambda theta, b, log: jf.scan(jf.ekf(small_model(theta)), b, log))
    return run(*cast(arguments, dtype))


@functools.cache
def small_log() -> tuple[Navigation, jf.Log]:
    """40 rows of irregular intervals, some of them 0; each sensor speaks now and then."""
    rng = np.random.default_rng(8)
    steps = 40
    dt = rng.uniform(0.02, 0.2, steps)
    dt[rng.integers(0, steps, 5)] = 0.0
    u = Imu(U.gyro + rng.normal(0, 0.5, (steps, 3)), U.accelerometer + rng.normal(0, 1.0, (steps, 3)))
    start = X._replace(extra={"drift": np.array(0.4)})
    z = {
        "field": np.broadcast_to(TURNED.inv().apply(FIELD), (steps, 3)).copy(),
        "gnss": np.zeros((steps, 3)),
        "baro": np.zeros(steps),
    }
    x = X
    for k in range(steps):
        x = strapdown(x, Imu(u.gyro[k], u.accelerometer[k]), dt[k])
        R = rotation(x.att)
        z["field"][k] = R.inv().apply(FIELD) + STDS["field"] * rng.normal(size=3)
        z["gnss"][k] = x.pos + R.apply(ARM) + STDS["gnss"] * rng.normal(size=3)
        z["baro"][k] = x.pos[2] + 0.4 + STDS["baro"][0] * rng.normal()
    valid = {name: rng.random(steps) < 0.6 for name in z}
    return start, jf.Log(dt, u, z, {}, valid)


def off(start: Navigation) -> Navigation:
    """A start that is wrong by a standard deviation or so."""
    d = np.asarray(START_STD) * np.random.default_rng(4).normal(size=16)
    space = small_model().space
    return jax.tree.map(np.asarray, space.plus(start, d))


def test_the_error_state_filter_of_the_book():
    start, log = small_log()
    x0, P0 = off(start), np.diag(np.square(START_STD))
    track, by_book = tracked(np.float64), book()
    begun = x0.pos, x0.vel, rotation(x0.att).as_matrix(), x0.gyro_bias, x0.accelerometer_bias, x0.extra["drift"]
    rows = []
    for k in range(len(log.dt)):
        u = jax.tree.map(lambda a, k=k: a[k], log.u)
        said = {n: (np.atleast_1d(log.z[n][k]), (), np.ones(len(STDS[n]), bool)) for n in log.z if log.valid[n][k]}
        rows.append(oracles.Row(log.dt[k], u, said))
    want = oracles.loop(by_book, begun, P0, rows, oracles.ekf_predict, oracles.ekf_correct)
    got = track.belief
    for k, x in enumerate(want.means):
        mine = jax.tree.map(lambda a, k=k: np.asarray(a[k]), got.mean)
        point = (
            mine.pos,
            mine.vel,
            rotation(mine.att).as_matrix(),
            mine.gyro_bias,
            mine.accelerometer_bias,
            mine.extra["drift"],
        )
        np.testing.assert_allclose(by_book.minus(point, x), 0, atol=1e-9)
    size = np.sqrt(np.einsum("tii->ti", want.covs))
    np.testing.assert_allclose((got.cov - want.covs) / (size[:, :, None] * size[:, None, :]), 0, atol=1e-9)
    loglik = sum(np.asarray(info.loglik) for info in track.info.values())
    np.testing.assert_allclose(loglik, want.logliks, atol=1e-8)


def test_single_precision_is_near_double():
    wide, narrow = tracked(np.float64), tracked(np.float32)
    assert {a.dtype for a in jax.tree.leaves(narrow)} == {np.dtype(np.float32), np.dtype(np.int32)}
    std = np.sqrt(np.einsum("tii->ti", wide.belief.cov))
    away = jax.vmap(small_model().space.minus)(cast(narrow.belief.mean, np.float64), wide.belief.mean)
    assert np.abs(away / std).max() < 5e-3


def test_ukf_and_ekf_agree_on_small_covariances():
    start, log = small_log()
    row = jax.tree.map(lambda a: jnp.asarray(a[7]), log)._replace(valid={}, dt=jnp.asarray(0.05))
    tiny = 1e-4
    model = small_model({name: value + math.log(tiny) for name, value in THETA.items()})
    weak = {n: s._replace(R=lambda x, c, R=s.R: tiny**2 * R(x, c)) for n, s in model.sensors.items()}
    model = model._replace(sensors=weak)
    belief = jf.Gaussian(start, tiny**2 * np.diag(np.square(START_STD)))
    near = jf.simulate(model, belief, jax.tree.map(lambda a: jnp.asarray(a)[None], row), jax.random.key(0)).log
    row = jax.tree.map(lambda a: a[0], near)
    (a, _), (b, _) = (jax.jit(make(model).step)(belief, row) for make in (jf.ekf, jf.ukf))
    std = np.sqrt(np.diag(a.cov))
    assert np.abs(model.space.minus(a.mean, b.mean) / std).max() < 1e-3
    np.testing.assert_allclose((a.cov - b.cov) / np.outer(std, std), 0, atol=1e-5)


def test_dead_reckoning_without_readings():
    model = small_model()
    start, log = small_log()
    silent = log._replace(z={}, valid={})
    P0 = np.diag(np.square(START_STD))
    track = jax.jit(lambda log: jf.scan(jf.ekf(model), jf.Gaussian(start, P0), log))(silent)
    assert track.info == {}
    x = start
    for k in range(len(log.dt)):
        x = strapdown(x, Imu(log.u.gyro[k], log.u.accelerometer[k]), log.dt[k])
    end = jax.tree.map(lambda a: a[-1], track.belief)
    np.testing.assert_allclose(end.mean.pos, x.pos, atol=1e-9)
    np.testing.assert_allclose(rotation(end.mean.att).as_matrix(), rotation(x.att).as_matrix(), atol=1e-12)
    assert np.sqrt(end.cov[0, 0]) > 3 * START_STD[0]


# --- memory, and what comes late -----------------------------------------------------------------------------------


def test_a_late_reading_tells_of_then():
    gnss = sensors.gnss_position(jnp.eye(3), ARM)
    x = strapdown(X, U, 0.1)
    np.testing.assert_allclose(late(gnss, 0.1).h(x, (U, ())), gnss.h(X, ()), atol=1e-12)
    np.testing.assert_allclose(late(gnss, -0.1).h(X, (U, ())), gnss.h(x, ()), atol=1e-12)
    slope = jax.jacfwd(lambda s: late(gnss, s).h(X, (U, ())))(0.0)
    swing = np.cross(U.gyro - X.gyro_bias, ARM)
    np.testing.assert_allclose(slope, -(X.vel + TURNED.apply(swing)), atol=1e-12)
    marks = late(sensors.beacon(jnp.eye(1)), 0.1)  # with a context of its own
    np.testing.assert_allclose(marks.h(x, (U, ARM)), np.linalg.norm(X.pos - ARM), atol=1e-12)
    assert late(gnss, 0.1, gravity=0.0).h(x, (U, ()))[2] != pytest.approx(float(gnss.h(X, ())[2]), abs=0.01)


@pytest.mark.parametrize("make", [jf.ekf, jf.ukf])
def test_the_last_reading_is_remembered(make):
    own = {"gnss": late(sensors.gnss_position(jnp.eye(3)), 0.1, imu=remembered)}
    model = inertial(THETA, own, {"drift": Wander(jf.scalar, 0.1)}, remember=True)
    assert model.space.dim == 16
    nothing = Imu(np.zeros(3), np.zeros(3))
    belief = jf.Gaussian(X._replace(extra={"drift": np.array(0.0), "imu": nothing}), 0.01 * np.eye(16))
    row = jf.Log(np.array(0.1), U, {"gnss": X.pos + 0.1}, {}, {})
    after, info = jax.jit(make(model).step)(belief, row)
    jax.tree.map(np.testing.assert_array_equal, after.mean.extra["imu"], U)
    if make is jf.ekf:  # one step forth and back
        np.testing.assert_allclose(info["gnss"].innovation, 0.1, atol=1e-12)


def test_what_is_wrong_is_said():
    with pytest.raises(KeyError, match=r"theta: expected logarithms named gyro, accelerometer, .* got gyros"):
        inertial({"gyros": 0.0}, {})
    with pytest.raises(KeyError, match=r"theta: expected logarithms named gyro.* got list"):
        inertial([0.0], {})
    with pytest.raises(ValueError, match=r"theta\['gyro'\]: expected a number or shape \(3,\), got shape \(2,\)"):
        inertial(THETA | {"gyro": np.zeros(2)}, {})
    with pytest.raises(ValueError, match=r"extra\['mount'\].space: expected a flat space"):
        inertial(THETA, {}, {"mount": Wander(jf.so3, 0.1)})
    with pytest.raises(TypeError, match=r"extra\['drift'\]: expected a Wander, got Space"):
        inertial(THETA, {}, {"drift": jf.scalar})  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"sensors\['gnss'\]: expected a Sensor, got function"):
        inertial(THETA, {"gnss": lambda x, c: x.pos})  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"extra\['imu'\]: expected another name"):
        inertial(THETA, {}, {"imu": Wander(jf.scalar, 0.1)}, remember=True)
    with pytest.raises(ValueError, match="expected at least one sensor, got none"):
        jf.ekf(inertial(THETA, {}))


# --- flights -------------------------------------------------------------------------------------------------------


def test_the_flight_follows_its_path_and_the_input_is_what_the_imu_reads():
    s = inertial_flight.inertial_gnss_scenario()
    steps = 1200
    fly = jax.jit(lambda key: jf.simulate(s.model(s.theta), s.belief(s.theta), s.schedule(steps), key, s.control))
    x, log = fly(jax.random.key(2))
    path = inertial_flight.path(steps)
    assert np.linalg.norm(x.pos - path.pos, axis=1).max() < 1.0
    yaw = rotation(x.att).as_euler("ZYX")[:, 0]
    assert np.abs(yaw - path.yaw)[100:].max() < 0.5
    assert np.ptp(yaw) > 1.0, "it should turn"
    # Differences of the truth: what the readings say, less the true biases, to the noise of a row.
    acc = np.diff(x.vel, axis=0) / 0.01
    felt = rotation(x.att[:-1]).inv().apply(acc + G) + x.accelerometer_bias[:-1]
    assert np.abs(felt - log.u.accelerometer[1:]).mean() < 0.4
    assert np.abs((felt - log.u.accelerometer[1:]).mean(0)).max() < 0.05
    turned = (rotation(x.att[:-1]).inv() * rotation(x.att[1:])).as_rotvec() / 0.01 + x.gyro_bias[:-1]
    assert np.abs((turned - log.u.gyro[1:]).mean(0)).max() < 0.002


BLOCKS = inertial_flight.NAVIGATION_BLOCKS | {"drift": ((15,), "m")}


def verdicts(s: jf.Scenario, filters: dict, theta: Any, runs: int, steps: int) -> dict[str, dict[str, str]]:
    """filter -> block -> whether its ANEES is inside its bounds; the truth flies by the scenario's own theta."""
    found = jf.study(
        s.model, filters, s.belief, s.schedule(steps), jax.random.key(1), theta=theta, truth_theta=s.theta,
        runs=runs, control=s.control, blocks=s.blocks, backend="xla",
    )  # fmt: skip
    return {
        name: {block: consistency.verdict(c) for block, c in scores.nees_total.items()}
        for name, scores in found.scores.items()
    }


@pytest.mark.long
def test_the_filter_is_consistent_outdoors_and_not_with_another_noise():
    s = inertial_flight.inertial_gnss_scenario()
    filters = {"ekf": lambda theta: jf.ekf(s.model(theta))}
    found = verdicts(s, filters, s.theta, 100, 500)["ekf"]
    assert set(found.values()) == {"inside"}, found
    assert set(found) == {"state", *BLOCKS}

    def wrong(factor: float, *names: str) -> dict:
        off = {name: jax.tree.map(lambda a: a + math.log(factor), s.theta[name]) for name in names}
        return verdicts(s, filters, s.theta | off, 100, 500)["ekf"]

    timid = wrong(2.0, "gnss", "doppler", "magnetometer", "barometer")  # R assumed 4 times as large
    assert {timid[block] for block in ("state", "position", "velocity", "attitude")} == {"below"}
    bold = wrong(0.5, "gyro", "accelerometer", "gyro_walk", "accelerometer_walk", "drift")  # Q 4 times as small
    assert bold["state"] == "above"


@pytest.mark.long
def test_every_sensor_at_once():
    """A row in which all of them speak: finite, with finite gradients in all that theta has, and believed."""
    s = inertial_flight.inertial_scenario()
    row = s.schedule(1)._replace(valid={})
    theta = jax.tree.map(jnp.asarray, s.theta)
    simulated = jax.jit(lambda key: jf.simulate(s.model(theta), s.belief(theta), row, key, s.control).log)
    row = jax.tree.map(lambda a: a[0], simulated(jax.random.key(5)))

    def loss(theta: Any) -> tuple[Any, Any]:
        belief, info = jf.ekf(s.model(theta)).step(s.belief(theta), row)
        return -sum(one.loglik for one in info.values()), (belief, info)

    (_, (belief, info)), slopes = jax.jit(jax.value_and_grad(loss, has_aux=True))(theta)
    assert set(info) == {"gnss", "magnetometer", "barometer", "finder", "flow", "ranges", "camera"}
    for name, one in info.items():
        assert one.status == jf.Status.OK
        assert one.nis < 25, name
    before = np.sqrt(np.diag(s.belief(theta).cov))
    after = np.sqrt(np.diag(belief.cov))
    assert (after[[0, 1, 2, 19]] < before[[0, 1, 2, 19]]).all()
    flat = {jax.tree_util.keystr(path): float(a) for path, a in jax.tree.leaves_with_path(slopes)}
    assert all(map(math.isfinite, flat.values())), flat
    silent = {name for name, slope in flat.items() if slope == 0}
    assert not silent, silent
