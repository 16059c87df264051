"""What sensors report: functions of position, attitude and the like, and whole sensors for states that have them.

Frames: the world is z up (east, north, up); the body is x forward, y left, z up; an attitude is a unit quaternion
(w, x, y, z), body to world. SI units. A function is the body of a ``Sensor.h``, the model picks the parts of its own
state; the functions that return a `Sensor` fit every state with the fields that they name::

    jf.Sensor(lambda x, c: range_bearing(x.pos, x.yaw, c), jf.const(R), jf.product((jf.scalar, jf.angle)))
    gnss_position(R)        # of a state with a field pos (3,)
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxfilt.elementary import bearing, norm, wrap
from jaxfilt.noise import const
from jaxfilt.spaces import product, rotate, so3, vector
from jaxfilt.types import Array, Sensor

STEEPEST = 0.1
"""Least cosine of the tilt at which a downward beam is taken to meet the ground: 84 degrees."""


def range_bearing(pos: Array, yaw: Array, point: Array) -> tuple[jax.Array, jax.Array]:
    """Range (m) and bearing (rad, relative to the heading, left positive) of a point in the plane.

    ``d = point - pos``, ``(|d|, wrap(atan2(d_y, d_x) - yaw))``, finite derivatives also where ``d = 0``. Lives on
    ``product((scalar, angle))``. Usual rate: 1-20 Hz (lidar, camera with known landmarks).

    Args:
        pos: (2,) m, world.
        yaw: () rad.
        point: (2,) m, world.

    Example:
        >>> import jax.numpy as jnp
        >>> r, b = range_bearing(jnp.zeros(2), jnp.asarray(0.0), jnp.array([0.0, 2.0]))
        >>> float(r), round(float(b), 4)
        (2.0, 1.5708)

    Source: Thrun, Burgard, Fox, Probabilistic Robotics (2005), eq. 6.40.
    """
    d = point - pos
    return norm(d), wrap(bearing(d) - yaw)


def range_to(pos: Array, point: Array, bias: Array | float = 0.0) -> jax.Array:
    """Range (m) to a known point: ultrasound or radio beacon, ``|point - pos| + bias``.

    Lives on ``scalar``; its derivative at the point itself is 0. Usual rate: 5-50 Hz.

    Args:
        pos: (n,) m, world.
        point: (n,) m, world.
        bias: () m, what the beacon's clock or the air adds.

    Example:
        >>> import jax.numpy as jnp
        >>> float(range_to(jnp.array([3.0, 0.0]), jnp.array([0.0, 4.0]), bias=0.5))
        5.5
    """
    return norm(point - pos) + bias


def tilt_range(height: Array, att: Array, terrain: Array | float = 0.0) -> jax.Array:
    """Range (m) of a downward range finder fixed to the body: ``(height - terrain) / (cos roll cos pitch)``.

    The cosine of the tilt is R33 of the attitude's rotation matrix. The tilt belongs here or in the reading, once: a
    lecture compensates both. Beyond 84 degrees, where no beam returns, the cosine is held at 0.1. Lives on
    ``scalar``. Usual rate: 20-50 Hz.

    Args:
        height: () m, world z of the range finder.
        att: (4,) quaternion.
        terrain: () m, world z of the ground (or the table) below.

    Example: 2 m up, rolled by 60 degrees.
        >>> import math, jax.numpy as jnp, jaxfilt as jf
        >>> round(float(tilt_range(jnp.asarray(2.0), jf.so3_exp(jnp.array([math.pi / 3, 0.0, 0.0])))), 4)
        4.0
    """
    up = jnp.asarray([0.0, 0.0, 1.0], att.dtype)
    return (height - terrain) / jnp.maximum(rotate(att, up)[2], STEEPEST)


def gnss_position(R: Array) -> Sensor:
    """Position (3,) m, world, of a state with a field ``pos``. Usual rate: 10 Hz.

    Args:
        R: (3, 3) m^2; of the order of (1-3 m)^2, of (0.02 m)^2 with RTK, the height twice as bad.
    """
    return Sensor(lambda x, c: x.pos, const(R), vector(3))


def gnss_velocity(R: Array) -> Sensor:
    """Velocity (3,) m/s, world, of a state with a field ``vel``: the receiver's Doppler. Usual rate: 10 Hz.

    Args:
        R: (3, 3) (m/s)^2; of the order of (0.1 m/s)^2.
    """
    return Sensor(lambda x, c: x.vel, const(R), vector(3))


def mocap_pose(R: Array) -> Sensor:
    """Position (3,) m, world, and attitude (4,) of a state with fields ``pos`` and ``att``. Usual rate: 200 Hz.

    Args:
        R: (6, 6) m^2 and rad^2: position in the world frame, then attitude about the body axes.
    """
    return Sensor(lambda x, c: (x.pos, x.att), const(R), product((vector(3), so3)))


def gyroscope(R: Array) -> Sensor:
    """Angular velocity (3,) rad/s, body, of a state with a field ``rates``; without bias. Usual rate: 100-1,000 Hz.

    Args:
        R: (3, 3) (rad/s)^2.
    """
    return Sensor(lambda x, c: x.rates, const(R), vector(3))
