"""Attitude and gyroscope bias from a gyroscope as input, an accelerometer as tilt sensor and a magnetometer.

Frames: the world is z up, x east, y north; the body is that of the sensors. Attitude is a unit quaternion (w, x, y, z),
body to world. Parameters ``theta`` are natural logarithms, but for the magnetic field.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.elementary import bearing, norm, wrap
from jaxfilt.log import schedule
from jaxfilt.models.control import GRAVITY
from jaxfilt.models.sensors import body_field, specific_force
from jaxfilt.noise import const, diagonal
from jaxfilt.spaces import (
    angle,
    product,
    quaternion_conjugate,
    quaternion_product,
    rotate,
    rotate_back,
    so3,
    so3_exp,
    so3_log,
    vector,
)
from jaxfilt.types import Array, Gaussian, Log, Model, PyTree, Scenario, Sensor, Space


class Attitude(NamedTuple):
    """How a body is turned, and how far its gyroscope is off: the state of `attitude`."""

    att: Array
    """(4,) quaternion, body to world."""
    gyro_bias: Array
    """(3,) rad/s, body."""


STATE = product(Attitude(so3, vector(3)))
BLOCKS = {"attitude": ((0, 1, 2), "rad"), "gyro bias": ((3, 4, 5), "rad/s")}

HAND_HELD = {
    "gyro": math.log(math.radians(0.014)),  # (rad/s)/sqrt(Hz): a small MEMS gyroscope, by its data sheet
    "gyro_walk": math.log(2e-5),  # (rad/s)/sqrt(s), chosen
    "accelerometer": math.log(0.5),  # m/s^2: what a hand accelerates, far more than the sensor's noise
    "magnetometer": math.log(1.0),  # uT
    "field": (49.0, 1.17, 0.07),  # uT, rad down, rad east of north; no logarithms: central Europe
    "start": (math.log(0.05), math.log(0.1), math.log(math.radians(1.0))),  # rad inclination, rad heading, rad/s
}
"""``theta`` of `attitude`: a small inertial and magnetic sensor in a hand."""


def attitude(theta: PyTree = HAND_HELD, gravity: float = GRAVITY) -> Model:
    """Attitude and gyroscope bias: ``q' = q Exp(dt (u - b))``, and two vectors of the world seen in the body.

    ``f = R(q)' g e_z + v``: an accelerometer at rest, so that v holds what the body accelerates, and its standard
    deviation is that of the motion. (A variance that grows with ``(|f| - g)^2``, as many have it, did not help in real
    fast motion: half of what a body accelerates does not show in the length.)

    ``m = R(q)' (B cos dip sin decl, B cos dip cos decl, -B sin dip) + v``: a magnetometer. Instead of it "heading" uses
    only in which direction of the compass the reading points, turned by the estimated attitude: iron that changes the
    dip or the strength of the field then changes nothing, and what turns the field acts on the heading first. It is 0
    at all times, ``wrap(bearing(R(q) m) - bearing(field))``, and m its context.

    The noise of the gyroscope and the walk of its bias are integrated over dt, as in
    `jaxfilt.models.inertial.strapdown_noise`: ``Q = [[dt N + dt^3/3 W, -dt^2/2 W], [-dt^2/2 W, dt W]]``. Without bias
    estimation: a ``gyro_walk`` and a start of the bias of, say, 1e-9.

    Args:
        theta: logarithms of gyro ((rad/s)/sqrt(Hz)), gyro_walk ((rad/s)/sqrt(s)), accelerometer (m/s^2),
            magnetometer (the unit of the field), each a number or (3,) for the body's axes; and ``field``, no
            logarithms: strength (any unit, that of the readings), dip (rad, down), declination (rad, east of north; 0:
            y is magnetic north).
        gravity: m/s^2 at the place.

    Returns:
        A model on `Attitude` (6 dimensions: attitude about the body axes, gyroscope bias) with the gyroscope's reading
        (3,) rad/s, held over dt, as input, and the sensors "accelerometer" (3,) m/s^2, "magnetometer" (3,), "heading"
        () rad.

    Example: nose up by 90 degrees, x feels the support.
        >>> import math, jax.numpy as jnp, jaxfilt as jf
        >>> x = Attitude(jf.so3_exp(jnp.array([0.0, -math.pi / 2, 0.0])), jnp.zeros(3))
        >>> [round(float(a), 3) + 0.0 for a in attitude().sensors["accelerometer"].h(x, ())]
        [9.81, 0.0, 0.0]

    Source: F. L. Markley, Attitude error representations for Kalman filtering, J. Guidance, Control, and Dynamics 26(2)
    (2003), sections 5 and 6.
    """
    north = field(theta)
    motion = jnp.exp(jnp.broadcast_to(jnp.asarray(theta["accelerometer"]), (3,)))
    magnetic = jnp.exp(jnp.broadcast_to(jnp.asarray(theta["magnetometer"]), (3,)))

    def f(x: Attitude, u: Array, dt: Array) -> Attitude:
        return Attitude(so3.plus(x.att, dt * (u - x.gyro_bias)), x.gyro_bias)

    def Q(x: Attitude, u: Array, dt: Array) -> Array:
        white, walk = (jnp.exp(2 * jnp.broadcast_to(jnp.asarray(theta[k]), (3,))) for k in ("gyro", "gyro_walk"))
        W = jnp.diag(walk)
        both = -(dt**2) / 2 * W
        return jnp.block([[jnp.diag(dt * white) + dt**3 / 3 * W, both], [both, dt * W]])

    def up(x: Attitude, c: PyTree) -> Array:
        return specific_force(x.att, gravity=gravity)

    def compass(x: Attitude, c: Array) -> Array:
        return wrap(bearing(rotate(x.att, c)[:2]) - bearing(north[:2]))

    across = jnp.sqrt(jnp.mean(jnp.square(magnetic))) / norm(north[:2])
    sensors = {
        "accelerometer": Sensor(up, const(diagonal(*motion)), vector(3)),
        "magnetometer": Sensor(
            lambda x, c: body_field(x.att, north.astype(x.att.dtype)), const(diagonal(*magnetic)), vector(3)
        ),
        "heading": Sensor(compass, const(diagonal(across)), angle),
    }
    return Model(f, Q, STATE, sensors)


def field(theta: PyTree) -> jax.Array:
    """The earth's magnetic field (3,) in the world: ``theta["field"]`` = strength, dip (rad), declination (rad).

    Example: 65 degrees down, and as much to the east as to the north.
        >>> import math
        >>> [round(float(a), 2) for a in field({"field": (50.0, math.radians(65), math.pi / 4)})]
        [14.94, 14.94, -45.32]
    """
    strength, dip, declination = (jnp.asarray(a) for a in theta["field"])
    level = jnp.cos(dip)
    return strength * jnp.stack([level * jnp.sin(declination), level * jnp.cos(declination), -jnp.sin(dip)])


def attitude_start(theta: PyTree, att: Array, gyro_bias: Array | None = None) -> Gaussian:
    """A belief about this attitude (4,) and bias (3,) rad/s, 0 by default, with the standard deviations
    ``theta["start"]``: of the inclination about each horizontal axis (rad), of the heading (rad), of the bias (rad/s).
    """
    tilt, heading, bias = (jnp.exp(jnp.asarray(log_std)) for log_std in theta["start"])
    att = jnp.asarray(att, tilt.dtype)
    cov = jax.scipy.linalg.block_diag(attitude_spread(att, tilt, heading), diagonal(bias, bias, bias))
    return Gaussian(Attitude(att, jnp.asarray(np.zeros(3) if gyro_bias is None else gyro_bias, tilt.dtype)), cov)


def attitude_spread(att: Array, tilt: Array, heading: Array) -> jax.Array:
    """Covariance (3, 3) rad^2 about the body's axes of an attitude (4,) that errs about those of the world: by a
    standard deviation ``tilt`` (rad) about each horizontal one, and ``heading`` (rad) about the vertical."""
    turn = jnp.stack([rotate_back(att, axis) for axis in jnp.eye(3, dtype=att.dtype)], axis=1)
    return turn @ diagonal(tilt, tilt, heading) @ turn.T


def _swing_and_turn(q: Array) -> tuple[jax.Array, jax.Array]:
    """Rotation vectors (3,), (3,) with ``q = Exp(swing) Exp(turn)``: about a level axis, about the vertical."""
    square = q[0] ** 2 + q[3] ** 2
    upright = square > 0  # upside down no turn is the smallest
    size = jnp.sqrt(jnp.where(upright, square, 1.0))
    still = jnp.zeros_like(size)
    turn = jnp.stack([jnp.where(upright, q[0] / size, 1.0), still, still, q[3] / size])
    return so3_log(quaternion_product(q, quaternion_conjugate(turn))), so3_log(turn)


def _inclined(q: Array, d: Array) -> jax.Array:
    still = jnp.zeros_like(d[0])
    turned = quaternion_product(so3_exp(jnp.stack([still, still, d[2]])), q)
    p = quaternion_product(so3_exp(jnp.stack([d[0], d[1], still])), turned)
    return p / jnp.sqrt(p @ p)


def _inclination_and_turn(a: Array, b: Array) -> jax.Array:
    swing, turn = _swing_and_turn(quaternion_product(a, quaternion_conjugate(b)))
    return jnp.stack([swing[0], swing[1], turn[2]])


inclination_and_heading = Space(3, _inclined, _inclination_and_turn, np.array([1.0, 0, 0, 0]), flat=False)
"""A rotation as a unit quaternion (4,) with the tangent (3,) rad in the world: a tilt about east and north, a turn of
the heading; ``plus(q, d) = Exp(d_x, d_y, 0) Exp(0, 0, d_z) q``. Lengths are those of `heading_and_inclination`."""

ERRORS = {"inclination": ((0, 1), "rad"), "heading": ((2,), "rad")}
"""Its blocks."""


def heading_and_inclination(att: Array, true: Array) -> tuple[jax.Array, jax.Array]:
    """The angles (rad) by which an attitude is off, about the vertical and away from it: heading and inclination.

    ``q = att true*`` in the world; ``heading = 2 atan |q_z/q_w|``, ``inclination = 2 acos sqrt(q_w^2 + q_z^2)``, and
    the angle of all of it is ``2 acos(cos(heading/2) cos(inclination/2))``.

    Args:
        att, true: (4,) quaternions.

    Example: 30 degrees of heading.
        >>> import math, jax.numpy as jnp, jaxfilt as jf
        >>> turn = jf.so3_exp(jnp.array([0.0, 0.0, math.pi / 6]))
        >>> [round(math.degrees(a), 3) for a in heading_and_inclination(turn, jnp.array([1.0, 0.0, 0.0, 0.0]))]
        [30.0, 0.0]

    Source: D. Laidig, M. Caruso, A. Cereatti, T. Seel, BROAD - a benchmark for robust inertial orientation estimation,
    Data 6(7):72 (2021), section 4.
    """
    swing, turn = _swing_and_turn(quaternion_product(att, quaternion_conjugate(true)))
    return jnp.abs(turn[2]), norm(swing)


DT = 0.01
"""s: 100 Hz."""


def waving(steps: int, dt: float = DT) -> np.ndarray:
    """What a gyroscope reads in a hand that turns it every way, (steps, 3) rad/s: three slow swings, no two in step."""
    t = dt * np.arange(1, steps + 1)
    return np.stack(
        [
            1.5 * np.sin(0.9 * t) + 0.5 * np.sin(4.1 * t),
            2.0 * np.sin(0.63 * t + 1.0),
            1.2 * np.cos(0.47 * t) + 0.8 * np.sin(2.3 * t),
        ],
        axis=1,
    )


def hand_held_start(theta: PyTree = HAND_HELD) -> Gaussian:
    """Level, the nose to the east, with the standard deviations ``theta["start"]``."""
    return attitude_start(theta, so3.origin)


def scenario() -> Scenario:
    """A sensor waved about in a hand, through every attitude: gyroscope 100 Hz, accelerometer 50 Hz, compass 20 Hz."""

    def wave(steps: int) -> Log:
        every = {"accelerometer": 2, "magnetometer": 5, "heading": 0}
        return schedule(attitude(HAND_HELD), steps, DT, every=every, u=waving(steps))

    return Scenario(attitude, hand_held_start, HAND_HELD, wave, BLOCKS)
