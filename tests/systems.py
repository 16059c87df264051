"""The systems of the tests, each twice: as a jaxfilt model, and as a book with its Jacobians worked out by hand.

Every P0, Q and R is full and far from isotropic. Rows have irregular dt, some of them 0; sensors fall silent, and
single components go missing. The order of the sensors is never the alphabet's. ``theta`` holds log-standard-deviations
and the parameters of the dynamics.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from oracles import Book, BookSensor, no_carry, simulate
from scipy.spatial.transform import Rotation

import jaxfilt as jf


class System(NamedTuple):
    """A robot as jaxfilt has it (``model``, ``belief``, ``log``) and as a book has it (``book``, ``start``, ``P0``).

    ``flat`` writes a mean with any leading axes as one vector, ``book_flat`` a book's point as the same vector.
    """

    model: Callable[[Any], jf.Model]
    belief: jf.Gaussian
    theta: dict[str, np.ndarray]
    log: jf.Log
    book: Callable[[Any], Book]
    start: Any
    flat: Callable[[Any], np.ndarray]
    book_flat: Callable[[Any], np.ndarray]


def correlation(n: int, seed: int) -> np.ndarray:
    """A full correlation matrix (n, n)."""
    A = np.random.default_rng(seed).normal(size=(n, n)) + 1.5 * np.eye(n)
    A /= np.linalg.norm(A, axis=1, keepdims=True)
    return A @ A.T


def covariance(log_std: Any, seed: int) -> jax.Array:
    """A full covariance from log-standard-deviations, in JAX."""
    std = jnp.exp(log_std)
    return std[:, None] * jnp.asarray(correlation(std.shape[0], seed), std.dtype) * std[None, :]


def book_covariance(log_std: np.ndarray, seed: int) -> np.ndarray:
    """The same covariance in NumPy."""
    D = np.diag(np.exp(log_std))
    return D @ correlation(len(D), seed) @ D


def cast(tree: Any, dtype: Any) -> Any:
    """Every floating leaf as an array of this dtype."""
    return jax.tree.map(lambda a: np.asarray(a, dtype if np.asarray(a).dtype.kind == "f" else None), tree)


def scaled(model: jf.Model, s: Any) -> jf.Model:
    """The model with Q and every R multiplied by s."""
    sensors = {
        name: jf.Sensor(sensor.h, lambda x, c, R=sensor.R: s * R(x, c), sensor.space)
        for name, sensor in model.sensors.items()
    }
    return jf.Model(model.f, lambda x, u, dt: s * model.Q(x, u, dt), model.space, sensors)


def add(x: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Plus of a vector."""
    return x + d


def subtract(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Minus of a vector."""
    return a - b


def turn(a: Any) -> Any:
    """The same angle in (-pi, pi], by way of the unit circle."""
    return np.angle(np.exp(1j * np.asarray(a)))


def _array(z: np.ndarray, k: int) -> np.ndarray:
    return np.atleast_1d(z[k])


def _intervals(rng: np.random.Generator, steps: int, dt: float) -> np.ndarray:
    intervals = dt * rng.uniform(0.5, 1.5, steps)
    intervals[rng.integers(0, steps, steps // 5)] = 0.0
    return intervals


# --- a linear system of three states, an input and two sensors ---------------------------------------------------

A = np.array([[0.95, 0.2, 0.0], [-0.15, 0.9, 0.1], [0.05, 0.0, 0.8]])
B = np.array([[0.0, 0.1], [1.0, 0.0], [0.3, -0.5]])
H = {"wide": np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -0.3]]), "arm": np.array([[0.2, 0.0, 1.0]])}
P_LINEAR = book_covariance(np.log([2.0, 0.5, 1.0]), 1)


def linear_model(theta: Any) -> jf.Model:
    """x' = A x + B u, one step a row."""
    noise = {name: covariance(theta[name], 3 + i) for i, name in enumerate(H)}
    dtype = theta["A"].dtype
    maps = {name: jnp.asarray(M, dtype) for name, M in H.items()}
    return jf.linear(theta["A"], maps, covariance(theta["q"], 2), noise, jnp.asarray(B, dtype))


def linear_book(theta: Any) -> Book:
    """The same with its Jacobians, which are its matrices."""
    sensors = {
        name: BookSensor(
            lambda x, c, M=M: M @ x,
            lambda x, c, M=M: M,
            lambda x, c, R=book_covariance(theta[name], 3 + i): R,
            add,
            subtract,
            _array,
        )
        for i, (name, M) in enumerate(H.items())
    }
    Q = book_covariance(theta["q"], 2)
    F = np.asarray(theta["A"])
    return Book(
        lambda x, u, dt: F @ x + B @ u, lambda x, u, dt: F, lambda x, u, dt: Q, add, subtract, no_carry, sensors
    )


def linear_system(steps: int = 40) -> System:
    """Three states, two inputs; "wide" sees two components, each of which may go missing, "arm" speaks now and then."""
    rng = np.random.default_rng(11)
    theta = {"q": np.log([0.3, 0.1, 0.2]), "wide": np.log([0.5, 0.2]), "arm": np.log([0.1]), "A": A}
    book, x0 = linear_book(theta), np.array([1.0, -2.0, 0.5])
    dt, u = _intervals(rng, steps, 1.0), rng.normal(size=(steps, 2))
    _, readings = simulate(book, x0, P_LINEAR, [(dt[k], u[k], {"wide": (), "arm": ()}) for k in range(steps)], rng)
    z = {name: np.array([row[name] for row in readings]) for name in H}
    valid = {"wide": rng.random((steps, 2)) < 0.7, "arm": rng.random(steps) < 0.5}
    log = jf.Log(dt, u, z, {}, valid)
    return System(linear_model, jf.Gaussian(x0, P_LINEAR), theta, log, linear_book, x0, np.asarray, np.asarray)


# --- the pendulum, seen from the side ----------------------------------------------------------------------------

P_PENDULUM = book_covariance(np.log([0.4, 0.8]), 21)


def pendulum_model(theta: Any) -> jf.Model:
    """x = [angle, rate]; ``angle' = angle + dt rate``, ``rate' = rate - dt g/l sin(angle)``, z = sin(angle)."""
    Q, R = covariance(theta["q"], 22), covariance(theta["side"], 23)

    def f(x: Any, u: Any, dt: Any) -> Any:
        return jnp.stack([x[0] + dt * x[1], x[1] - dt * jnp.exp(theta["stiffness"]) * jnp.sin(x[0])])

    side = jf.Sensor(lambda x, c: jnp.sin(x[0]), jf.const(R), jf.scalar)
    return jf.Model(f, jf.white(Q), jf.vector(2), {"side": side})


def pendulum_book(theta: Any) -> Book:
    """The same with its Jacobians."""
    k = np.exp(theta["stiffness"])
    Q, R = book_covariance(theta["q"], 22), book_covariance(theta["side"], 23)
    side = BookSensor(
        lambda x, c: np.sin(x[:1]),
        lambda x, c: np.array([[np.cos(x[0]), 0.0]]),
        lambda x, c: R,
        add,
        subtract,
        _array,
    )
    return Book(
        lambda x, u, dt: np.array([x[0] + dt * x[1], x[1] - dt * k * np.sin(x[0])]),
        lambda x, u, dt: np.array([[1.0, dt], [-dt * k * np.cos(x[0]), 1.0]]),
        lambda x, u, dt: Q * dt,
        add,
        subtract,
        no_carry,
        {"side": side},
    )


def pendulum_system(steps: int = 40) -> System:
    """Swinging wide, no input, a scalar reading of shape () that is sometimes absent."""
    rng = np.random.default_rng(12)
    theta = {"q": np.log([0.1, 0.4]), "side": np.log([0.1]), "stiffness": np.array(np.log(9.81))}
    book, x0 = pendulum_book(theta), np.array([1.2, 0.0])
    dt = _intervals(rng, steps, 0.05)
    _, readings = simulate(book, x0, P_PENDULUM, [(dt[k], (), {"side": ()}) for k in range(steps)], rng)
    z = {"side": np.array([row["side"][0] for row in readings])}
    log = jf.Log(dt, (), z, {}, {"side": rng.random(steps) < 0.8})
    return System(pendulum_model, jf.Gaussian(x0, P_PENDULUM), theta, log, pendulum_book, x0, np.asarray, np.asarray)


# --- a car with a satellite receiver and landmarks ---------------------------------------------------------------


class Car(NamedTuple):
    """One car at one instant."""

    pos: Any  # (2,) m
    yaw: Any  # () rad
    speed: Any  # () m/s


CAR = jf.product(Car(jf.vector(2), jf.angle, jf.scalar))
RANGE_BEARING = jf.product((jf.scalar, jf.angle))
P_CAR = book_covariance(np.log([2.0, 1.0, 0.2, 0.5]), 31)
LANDMARKS = np.array([[30.0, 5.0], [-20.0, 25.0], [-5.0, -30.0]])


def car_model(theta: Any) -> jf.Model:
    """``pos' = pos + dt scale speed [cos, sin]``, ``yaw' = yaw + dt u_1``, ``speed' = speed + dt u_0``."""
    Q = covariance(theta["q"], 32)

    def f(x: Any, u: Any, dt: Any) -> Any:
        heading = jnp.stack([jnp.cos(x.yaw), jnp.sin(x.yaw)])
        travelled = dt * jnp.exp(theta["scale"]) * x.speed
        return Car(x.pos + travelled * heading, jf.wrap(x.yaw + dt * u[1]), x.speed + dt * u[0])

    def to_mark(x: Any, c: Any) -> Any:
        return jf.norm(c - x.pos), jf.wrap(jf.bearing(c - x.pos) - x.yaw)

    sensors = {
        "mark": jf.Sensor(to_mark, jf.const(covariance(theta["mark"], 33)), RANGE_BEARING),
        "gnss": jf.Sensor(lambda x, c: x.pos, jf.const(covariance(theta["gnss"], 34)), jf.vector(2)),
    }
    return jf.Model(f, jf.white(Q), CAR, sensors)


def _car_minus(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    d = a - b
    d[2] = turn(d[2])
    return d


def _mark_minus(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    d = a - b
    d[1] = turn(d[1])
    return d


def car_book(theta: Any) -> Book:
    """The same with its Jacobians; a point is [x, y, yaw, speed]."""
    s, Q = np.exp(theta["scale"]), book_covariance(theta["q"], 32)
    Rs = {name: book_covariance(theta[name], 33 + i) for i, name in enumerate(["mark", "gnss"])}

    def f(x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        rate = np.array([s * x[3] * np.cos(x[2]), s * x[3] * np.sin(x[2]), u[1], u[0]])
        return x + dt * rate

    def F(x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        J = np.eye(4)
        J[:2, 2] = dt * s * x[3] * np.array([-np.sin(x[2]), np.cos(x[2])])
        J[:2, 3] = dt * s * np.array([np.cos(x[2]), np.sin(x[2])])
        return J

    def mark(x: np.ndarray, c: np.ndarray) -> np.ndarray:
        dx, dy = c - x[:2]
        return np.array([np.hypot(dx, dy), np.arctan2(dy, dx) - x[2]])

    def mark_jacobian(x: np.ndarray, c: np.ndarray) -> np.ndarray:
        dx, dy = c - x[:2]
        r = np.hypot(dx, dy)
        return np.array([[-dx / r, -dy / r, 0, 0], [dy / r**2, -dx / r**2, -1, 0]])

    sensors = {
        "mark": BookSensor(
            mark, mark_jacobian, lambda x, c: Rs["mark"], add, _mark_minus, lambda z, k: np.array([z[0][k], z[1][k]])
        ),
        "gnss": BookSensor(
            lambda x, c: x[:2], lambda x, c: np.eye(2, 4), lambda x, c: Rs["gnss"], add, subtract, _array
        ),
    }
    return Book(f, F, lambda x, u, dt: Q * dt, add, _car_minus, no_carry, sensors)


def _car_flat(x: Car) -> np.ndarray:
    yaw = np.asarray(x.yaw)
    return np.concatenate([x.pos, np.cos(yaw)[..., None], np.sin(yaw)[..., None], np.asarray(x.speed)[..., None]], -1)


def _book_car_flat(x: np.ndarray) -> np.ndarray:
    return np.array([x[0], x[1], np.cos(x[2]), np.sin(x[2]), x[3]])


def car_system(steps: int = 40) -> System:
    """Heading west, across the seam of the yaw; the landmark seen changes by row, the receiver loses components."""
    rng = np.random.default_rng(13)
    theta = {
        "q": np.log([0.1, 0.2, 0.05, 0.3]),
        "mark": np.log([0.5, 0.05]),
        "gnss": np.log([1.5, 0.7]),
        "scale": np.array(0.05),
    }
    book, x0 = car_book(theta), np.array([0.0, 0.0, 3.0, 5.0])
    dt = _intervals(rng, steps, 0.1)
    u = np.stack([rng.normal(0, 0.5, steps), 0.2 + rng.normal(0, 0.1, steps)], 1)
    seen = LANDMARKS[rng.integers(0, 3, steps)]
    _, readings = simulate(book, x0, P_CAR, [(dt[k], u[k], {"mark": seen[k], "gnss": ()}) for k in range(steps)], rng)
    ranges, bearings = np.array([row["mark"] for row in readings]).T
    z = {"gnss": np.array([row["gnss"] for row in readings]), "mark": (ranges, turn(bearings))}
    valid = {"gnss": rng.random((steps, 2)) < 0.6, "mark": rng.random(steps) < 0.6}
    log = jf.Log(dt, u, z, {"mark": seen}, valid)
    belief = jf.Gaussian(Car(x0[:2], np.array(x0[2]), np.array(x0[3])), P_CAR)
    return System(car_model, belief, theta, log, car_book, x0, _car_flat, _book_car_flat)


# --- the attitude of a rigid body --------------------------------------------------------------------------------


class Body(NamedTuple):
    """One body at one instant."""

    att: Any  # (4,) quaternion, body to world
    rate: Any  # (3,) rad/s, body frame


BODY = jf.product(Body(jf.so3, jf.vector(3)))
P_BODY = book_covariance(np.log([0.1, 0.2, 0.3, 0.1, 0.3, 0.2]), 41)
NORTH = np.array([0.4, 0.1, -0.9])


def body_model(theta: Any) -> jf.Model:
    """``att' = att Exp(dt rate)``, ``rate' = rate + dt J^-1 (torque - rate x J rate)``; u is the torque, N m."""
    Q, J = covariance(theta["q"], 42), jnp.exp(theta["inertia"])

    def f(x: Body, u: Any, dt: Any) -> Body:
        spin = (u - jnp.cross(x.rate, J * x.rate)) / J
        return Body(jf.so3.plus(x.att, dt * x.rate), x.rate + dt * spin)

    def compass(x: Body, c: Any) -> Any:
        return jf.rotate_back(x.att, jnp.asarray(NORTH, x.att.dtype))

    sensors = {
        "compass": jf.Sensor(compass, jf.const(covariance(theta["compass"], 43)), jf.vector(3)),
        "camera": jf.Sensor(lambda x, c: x.att, jf.const(covariance(theta["camera"], 44)), jf.so3),
    }
    return jf.Model(f, jf.white(Q), BODY, sensors)


def skew(v: np.ndarray) -> np.ndarray:
    """[v]x, so that ``skew(v) @ w = v x w``."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def right_jacobian(v: np.ndarray) -> np.ndarray:
    """``Exp(v + e) = Exp(v) Exp(J_r(v) e)``: Sola (2018), A micro Lie theory, eq. 143."""
    a, V = np.linalg.norm(v), skew(v)
    if a < 1e-5:
        return np.eye(3) - V / 2 + V @ V / 6
    return np.eye(3) - (1 - np.cos(a)) / a**2 * V + (a - np.sin(a)) / a**3 * V @ V


def _exp(v: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(v).as_matrix()


def _log(M: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(M).as_rotvec()


def body_book(theta: Any) -> Book:
    """The same with its Jacobians; a point is (rotation matrix, rate), its error (rotation vector, rate)."""
    J, Q = np.diag(np.exp(theta["inertia"])), book_covariance(theta["q"], 42)
    Rs = {name: book_covariance(theta[name], 43 + i) for i, name in enumerate(["compass", "camera"])}

    def f(x: tuple, u: np.ndarray, dt: float) -> tuple:
        M, w = x
        return M @ _exp(dt * w), w + dt * np.linalg.solve(J, u - np.cross(w, J @ w))

    def F(x: tuple, u: np.ndarray, dt: float) -> np.ndarray:
        _, w = x
        spin = np.eye(3) - dt * np.linalg.solve(J, skew(w) @ J - skew(J @ w))
        return np.block([[_exp(-dt * w), dt * right_jacobian(dt * w)], [np.zeros((3, 3)), spin]])

    def carry(d: np.ndarray) -> np.ndarray:
        return np.block([[right_jacobian(d[:3]), np.zeros((3, 3))], [np.zeros((3, 3)), np.eye(3)]])

    def plus(x: tuple, d: np.ndarray) -> tuple:
        return x[0] @ _exp(d[:3]), x[1] + d[3:]

    def minus(a: tuple, b: tuple) -> np.ndarray:
        return np.concatenate([_log(b[0].T @ a[0]), a[1] - b[1]])

    zero, eye = np.zeros((3, 3)), np.eye(3)
    sensors = {
        "compass": BookSensor(
            lambda x, c: x[0].T @ NORTH,
            lambda x, c: np.hstack([skew(x[0].T @ NORTH), zero]),
            lambda x, c: Rs["compass"],
            add,
            subtract,
            _array,
        ),
        "camera": BookSensor(
            lambda x, c: x[0],
            lambda x, c: np.hstack([eye, zero]),
            lambda x, c: Rs["camera"],
            lambda M, d: M @ _exp(d),
            lambda a, b: _log(b.T @ a),
            lambda z, k: Rotation.from_quat(z[k], scalar_first=True).as_matrix(),
        ),
    }
    return Book(f, F, lambda x, u, dt: Q * dt, plus, minus, carry, sensors)


def _matrix(q: Any) -> np.ndarray:
    q = np.asarray(q)
    return Rotation.from_quat(q.reshape(-1, 4), scalar_first=True).as_matrix().reshape(*q.shape[:-1], 9)


def body_system(steps: int = 40) -> System:
    """Tumbling through half a turn; a compass with missing components, a camera now and then; no gyroscope."""
    rng = np.random.default_rng(14)
    theta = {
        "q": np.log([0.02, 0.05, 0.03, 0.2, 0.3, 0.1]),
        "compass": np.log([0.1, 0.05, 0.2]),
        "camera": np.log([0.1, 0.05, 0.15]),
        "inertia": np.log([0.02, 0.03, 0.05]),
    }
    book, start = body_book(theta), (_exp(np.array([0.3, -0.8, 1.5])), np.array([0.8, -0.5, 1.0]))
    dt, u = _intervals(rng, steps, 0.05), rng.normal(0, 0.01, (steps, 3))
    schedule = [(dt[k], u[k], {"compass": (), "camera": ()}) for k in range(steps)]
    _, readings = simulate(book, start, P_BODY, schedule, rng)
    z = {
        "compass": np.array([row["compass"] for row in readings]),
        "camera": np.array([Rotation.from_matrix(row["camera"]).as_quat(scalar_first=True) for row in readings]),
    }
    valid = {"compass": rng.random((steps, 3)) < 0.6, "camera": np.arange(steps) % 4 == 2}
    belief = jf.Gaussian(Body(Rotation.from_matrix(start[0]).as_quat(scalar_first=True), start[1]), P_BODY)
    return System(
        body_model,
        belief,
        theta,
        jf.Log(dt, u, z, {}, valid),
        body_book,
        start,
        lambda x: np.concatenate([_matrix(x.att), np.asarray(x.rate)], -1),
        lambda x: np.concatenate([x[0].ravel(), x[1]]),
    )


SYSTEMS = {"linear": linear_system, "pendulum": pendulum_system, "car": car_system, "body": body_system}

FILTERS = {
    "kf": jf.kf,
    "ekf": jf.ekf,
    "iekf": lambda model: jf.iekf(model, iterations=3),
    "ukf 0.1": lambda model: jf.ukf(model, alpha=0.1),
    "ukf 0.5": lambda model: jf.ukf(model, alpha=0.5),
    "ukf 1.0": jf.ukf,
    "ckf": jf.ckf,
    "gauss_hermite": lambda model: jf.build(jf.gauss_hermite(3), model),
}
