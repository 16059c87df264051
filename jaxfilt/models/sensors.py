"""What sensors report, as functions of position, velocity, attitude and rates: the bodies of ``Sensor.h``.

Frames: the world is z up (east, north, up); the body is x forward, y left, z up; attitude is a unit quaternion
(w, x, y, z), body to world. SI units. A model picks the parts of its own state::

    jf.Sensor(lambda x, c: range_bearing(x.pos, x.yaw, c), jf.const(R), jf.product((jf.scalar, jf.angle)))
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxfilt.elementary import bearing, norm, wrap
from jaxfilt.types import Array


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
