"""Inertial (strapdown) navigation: an IMU as input, its biases as states, and whatever else is there as sensors.

Frames: the world is z up (east, north, up); the body is that of the IMU, x forward, y left, z up. Attitude is a unit
quaternion (w, x, y, z), body to world. The earth is flat and does not turn: good for minutes and kilometres with
sensors of a few grams. Parameters ``theta`` are natural logarithms of noise densities, as data sheets have them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors
from jaxfilt.models.control import GRAVITY
from jaxfilt.models.sensors import positioning
from jaxfilt.spaces import product, rotate, so3, vector
from jaxfilt.types import Array, Model, PyTree, Sensor, Space

DENSITIES = ("gyro", "accelerometer", "gyro_walk", "accelerometer_walk")
"""What `inertial` reads of theta."""


class Navigation(NamedTuple):
    """Where a vehicle is, how it moves, and how far its sensors are off: the state of `inertial`."""

    pos: Array
    """(3,) m, world: the place of the IMU."""
    vel: Array
    """(3,) m/s, world."""
    att: Array
    """(4,) quaternion, body to world."""
    gyro_bias: Array
    """(3,) rad/s, body."""
    accelerometer_bias: Array
    """(3,) m/s^2, body."""
    extra: PyTree = ()
    """What else wanders, name -> point: a barometer's drift, a beacon's bias, a lever arm; see `Wander`. Of a model
    that remembers, ``extra["imu"]`` is the last `Imu`."""


class Imu(NamedTuple):
    """What an IMU reads, held over the interval: the input of `inertial`."""

    gyro: Array
    """(3,) rad/s, body."""
    accelerometer: Array
    """(3,) m/s^2, body: specific force, +9.81 upwards at rest."""


class Wander(NamedTuple):
    """A state that wanders slowly: a random walk, or, with a ``time``, a first-order Gauss-Markov process.

    ``b' = exp(-dt/time) b + w``, ``Var w = density^2 time/2 (1 - exp(-2 dt/time))``; without a time ``density^2 dt``.
    """

    space: Space
    """Where it lives: a flat space."""
    density: Array | float
    """() or (dim,), its unit over sqrt(s); 0 for a constant."""
    time: Array | float | None = None
    """s, the correlation time."""


def data_sheet(gyro: float, accelerometer: float, gyro_walk: float, accelerometer_walk: float) -> dict[str, float]:
    """``theta`` of an IMU from the densities in its data sheet.

    Args:
        gyro: (rad/s)/sqrt(Hz), the angle random walk; a data sheet's deg/s/sqrt(Hz) times pi/180, its deg/sqrt(h) times
            pi/180/60.
        accelerometer: (m/s^2)/sqrt(Hz), the velocity random walk; a data sheet's ug/sqrt(Hz) times 9.80665e-6.
        gyro_walk: (rad/s)/sqrt(s), how the gyroscope's bias walks.
        accelerometer_walk: (m/s^2)/sqrt(s), how the accelerometer's bias walks.
    """
    return {
        "gyro": math.log(gyro),
        "accelerometer": math.log(accelerometer),
        "gyro_walk": math.log(gyro_walk),
        "accelerometer_walk": math.log(accelerometer_walk),
    }


ADIS16448 = data_sheet(1.7e-4, 2.0e-3, 1.9e-5, 3.0e-3)
"""An industrial MEMS IMU, as the authors of the EuRoC data set measured theirs."""

BMI088 = data_sheet(math.radians(0.014), 175 * 9.80665e-6, 2e-5, 1e-3)
"""A MEMS IMU of small flight controllers; white noise by its data sheet, bias walks chosen."""


MEMORY = Space(
    0, lambda u, d: u, lambda a, b: jnp.zeros(0, a.gyro.dtype), Imu(gyro=np.zeros(3), accelerometer=np.zeros(3)), True
)
"""Where a remembered `Imu` lives: of no dimension, for what was read is known."""


def navigation_space(extra: Mapping[str, Wander] | None = None, remember: bool = False) -> Space:
    """The space of a `Navigation` with these extra states: 15 dimensions (position, velocity, attitude about the body
    axes, gyroscope bias, accelerometer bias), then the extra states in the order of their sorted names; and, to
    remember, a ``extra["imu"]`` of no dimension."""
    more: Any = {name: wander.space for name, wander in (extra or {}).items()} | ({"imu": MEMORY} if remember else {})
    return product(Navigation(vector(3), vector(3), so3, vector(3), vector(3), more or ()))


def strapdown(x: Navigation, u: Imu, dt: Array, gravity: float = GRAVITY) -> Navigation:
    """Where inertial readings lead: dead reckoning over dt seconds, which may be negative.

    ``q' = q Exp(dt (gyro - b_g))``, ``a = R(q Exp(dt/2 (gyro - b_g))) (accelerometer - b_a) - g e_z``,
    ``v' = v + dt a``, ``p' = p + dt v + dt^2/2 a``: second order in dt, biases and extra states unchanged.
    (Lectures differentiate the accelerometer, or forget to take gravity off: here it is turned, freed of gravity and
    integrated.)

    Args:
        x: the state.
        u: the readings, held over dt.
        dt: () s.
        gravity: m/s^2 at the place.

    Example: at rest.
        >>> import jax.numpy as jnp
        >>> x = Navigation(jnp.zeros(3), jnp.zeros(3), jnp.array([1.0, 0, 0, 0]), jnp.zeros(3), jnp.zeros(3))
        >>> strapdown(x, Imu(jnp.zeros(3), jnp.array([0.0, 0.0, 9.81])), 1.0).vel.tolist()
        [0.0, 0.0, 0.0]

    Source: P. D. Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems (2013), sec. 5.4
    without the earth's rotation; D. Titterton, J. Weston, Strapdown Inertial Navigation Technology (2004), ch. 11.
    """
    turn = dt * (u.gyro - x.gyro_bias)
    force = rotate(so3.plus(x.att, 0.5 * turn), u.accelerometer - x.accelerometer_bias)
    acc = force - jnp.asarray([0.0, 0.0, gravity], force.dtype)
    return x._replace(pos=x.pos + dt * x.vel + 0.5 * dt**2 * acc, vel=x.vel + dt * acc, att=so3.plus(x.att, turn))


def inertial(
    theta: PyTree,
    sensors: Mapping[str, Sensor],
    extra: Mapping[str, Wander] | None = None,
    gravity: float = GRAVITY,
    remember: bool = False,
) -> Model:
    """Inertial navigation: `strapdown` with the noise of the IMU's data sheet, biases that walk, and your sensors.

    Q is the integral of that white noise over dt, exact for an attitude and a specific force that hold over dt, so it
    fits irregular rows: see `strapdown_noise`.

    Args:
        theta: logarithms of gyro ((rad/s)/sqrt(Hz)), accelerometer ((m/s^2)/sqrt(Hz)), gyro_walk ((rad/s)/sqrt(s)),
            accelerometer_walk ((m/s^2)/sqrt(s)), each a number or (3,) for the axes; `data_sheet` makes it. Other keys
            are yours.
        sensors: name -> sensor of a `Navigation`, see `jaxfilt.models.sensors`.
        extra: name -> `Wander`, more states, found as ``x.extra[name]``.
        gravity: m/s^2 at the place.
        remember: whether the state keeps the last reading, as ``x.extra["imu"]``, for sensors that need it (optical
            flow, a velocity with a lever arm, a late one); it adds no dimension. Otherwise give it as their context.

    Returns:
        A model on `Navigation` (15 dimensions and those of extra) with input `Imu`.

    Raises:
        KeyError: a parameter that is missing in theta. ValueError: one that is neither a number nor (3,), an extra
            space that is not flat, an extra state called "imu" beside the remembered one.
        TypeError: what is no `Wander` in extra, or no `Sensor` in sensors.

    Example: a drone with GNSS.
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> from jaxfilt.models.sensors import gnss_position
        >>> model = inertial(BMI088, {"gnss": gnss_position(jnp.eye(3))})
        >>> model.space.dim
        15
    """
    more = dict(sorted(extra.items())) if extra else {}
    _check(theta, sensors, more, remember)

    def f(x: Navigation, u: Imu, dt: Array) -> Navigation:
        y = strapdown(x, u, dt, gravity)
        kept: dict[str, PyTree] = {name: _faded(wander, x.extra[name], dt) for name, wander in more.items()}
        return y._replace(extra=kept | ({"imu": u} if remember else {}) or ())

    def Q(x: Navigation, u: Imu, dt: Array) -> Array:
        own = strapdown_noise(theta, x, u, dt)
        if not more:
            return own
        return jax.scipy.linalg.block_diag(own, *[jnp.diag(_spread(wander, dt)) for wander in more.values()])

    return Model(f, Q, navigation_space(more, remember), dict(sensors))


def strapdown_noise(theta: PyTree, x: Navigation, u: Imu, dt: Array) -> jax.Array:
    """What the IMU's noise adds to the covariance (15, 15) over dt, integrated exactly.

    The errors obey ``p' = v``, ``v' = -S th - R b_a - R n_a``, ``th' = -b_g - n_g``, ``b_g' = n_wg``, ``b_a' = n_wa``
    with ``S = R [f]x``; R and the specific force f hold over dt, and the turn of th by the body rates is left out. That
    system is nilpotent, so its integral is a polynomial in dt, positive semidefinite for any dt.

    Args:
        theta: as in `inertial`.
        x: the state at the start.
        u: the readings.
        dt: () s.

    Source: J. Sola, Quaternion kinematics for the error-state Kalman filter, arXiv:1711.02508 (2017), eqs. 236 to 238
    (the error dynamics), integrated here.
    """
    g, a, wg, wa = (jnp.exp(2 * jnp.broadcast_to(jnp.asarray(theta[name]), (1, 3))) for name in DENSITIES)
    R = jnp.stack([rotate(x.att, axis) for axis in jnp.eye(3, dtype=x.att.dtype)], axis=1)
    force = u.accelerometer - x.accelerometer_bias
    S = jnp.stack([jnp.cross(row, force) for row in R])  # R [f]x, row by row: r' [f]x = (r x f)'
    B, V, U = S * g, S * wg, R * wa
    A, RA, W, RW = B @ S.T, (R * a) @ R.T, V @ S.T, U @ R.T
    G, Wg, Wa, none = jnp.diag(g[0]), jnp.diag(wg[0]), jnp.diag(wa[0]), jnp.zeros_like(R)
    pp = dt**3 / 3 * RA + dt**5 / 20 * (A + RW) + dt**7 / 252 * W
    pv = dt**2 / 2 * RA + dt**4 / 8 * (A + RW) + dt**6 / 72 * W
    vv = dt * RA + dt**3 / 3 * (A + RW) + dt**5 / 20 * W
    pt, vt, tt = -(dt**3) / 6 * B - dt**5 / 30 * V, -(dt**2) / 2 * B - dt**4 / 8 * V, dt * G + dt**3 / 3 * Wg
    pg, vg, tg = dt**4 / 24 * V, dt**3 / 6 * V, -(dt**2) / 2 * Wg
    pa, va = -(dt**3) / 6 * U, -(dt**2) / 2 * U
    return jnp.block(
        [
            [pp, pv, pt, pg, pa],
            [pv.T, vv, vt, vg, va],
            [pt.T, vt.T, tt, tg, none],
            [pg.T, vg.T, tg.T, dt * Wg, none],
            [pa.T, va.T, none, none, dt * Wa],
        ]
    )


def remembered(x: Navigation, c: PyTree) -> tuple[Imu, PyTree]:
    """For `late`: the IMU's reading in the state of a model that remembers, and the whole context."""
    return x.extra["imu"], c


def late(
    sensor: Sensor,
    seconds: Array | float,
    gravity: float = GRAVITY,
    imu: Callable[[Navigation, PyTree], tuple[Imu, PyTree]] = lambda x, c: c,
) -> Sensor:
    """A sensor whose stamps come ``seconds`` after what they tell of: ``h(strapdown(x, imu, -seconds), c)``.

    Differentiable in seconds, so that an offset can be tuned; a known one is better taken off the stamps, by
    `jaxfilt.merge`. The last reading is held over those seconds, and their noise is left out: for offsets that are
    short beside the vehicle's manoeuvres.

    Args:
        sensor: as it would read in time.
        seconds: () s, positive where the stamps are late, negative where they are early.
        gravity: m/s^2 at the place.
        imu: (x, c) -> (`Imu` held over the row, context of ``sensor``). Default: the context of the late sensor is that
            pair; `remembered` for a model that remembers.

    Example: GNSS that tells of where the drone was 0.1 s ago.
        >>> import jax.numpy as jnp
        >>> from jaxfilt.models.sensors import GNSS_CONSUMER, gnss_position
        >>> slow = late(gnss_position(GNSS_CONSUMER.R()), 0.1)
        >>> level, still = jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3)
        >>> x = Navigation(still, jnp.array([10.0, 0.0, 0.0]), level, still, still)
        >>> slow.h(x, (Imu(still, jnp.array([0.0, 0.0, 9.81])), ())).tolist()
        [-1.0, 0.0, 0.0]
    """

    def ahead(x: Navigation, c: PyTree, dt: Array) -> tuple[Navigation, PyTree]:
        u, inner = imu(x, c)
        return strapdown(x, u, dt, gravity), inner

    return positioning.late(sensor, seconds, ahead)


def _check(theta: PyTree, sensors: Mapping[str, Sensor], extra: Mapping[str, Wander], remember: bool) -> None:
    for name in DENSITIES:
        if not (isinstance(theta, Mapping) and name in theta):
            given = ", ".join(theta) if isinstance(theta, Mapping) else type(theta).__name__
            raise KeyError(f"theta: expected logarithms named {', '.join(DENSITIES)}, got {given}")
        if np.shape(theta[name]) not in ((), (3,)):
            raise ValueError(f"theta[{name!r}]: expected a number or shape (3,), got shape {np.shape(theta[name])}")
    for name, sensor in sensors.items():
        doors.instance(f"sensors[{name!r}]", sensor, Sensor)
    for name, wander in extra.items():
        doors.instance(f"extra[{name!r}]", wander, Wander)
        if not wander.space.flat:
            raise ValueError(f"extra[{name!r}].space: expected a flat space, got a curved one")
    if remember and "imu" in extra:
        raise ValueError("extra['imu']: expected another name, for the model remembers the IMU's reading by this one")


def _faded(wander: Wander, b: PyTree, dt: Array) -> PyTree:
    return b if wander.time is None else jax.tree.map(lambda a: jnp.exp(-dt / wander.time) * a, b)


def _spread(wander: Wander, dt: Array) -> jax.Array:
    """Variances (dim,) that a wandering state gains over dt."""
    time = dt if wander.time is None else -0.5 * wander.time * jnp.expm1(-2 * dt / wander.time)
    return jnp.broadcast_to(jnp.square(jnp.asarray(wander.density)) * time, (wander.space.dim,))
