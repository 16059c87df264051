"""Which way is up, and which way is north: magnetometer, accelerometer, compass, gyroscope."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.elementary import bearing, wrap
from jaxfilt.models.control import GRAVITY
from jaxfilt.models.sensors.options import Option, chosen
from jaxfilt.noise import const
from jaxfilt.spaces import angle, rotate, rotate_back, vector
from jaxfilt.types import Array, Sensor


def earth_field(declination: float, inclination: float, strength: float = 1.0) -> np.ndarray:
    """The earth's magnetic field (3,), east, north, up: ``B (cos I sin D, cos I cos D, -sin I)``.

    Args:
        declination: rad, from true north to magnetic north, positive to the east.
        inclination: rad, how far it points down: positive in the north.
        strength: in any unit, the one of the readings; 25e-6 to 65e-6 T.

    Example: where it points straight down.
        >>> import math
        >>> (earth_field(0.0, math.pi / 2).round(4) + 0.0).tolist()
        [0.0, 0.0, -1.0]

    Source: NOAA, The US/UK World Magnetic Model for 2020-2025 (2020), eq. 19, turned from north-east-down.
    """
    level = math.cos(inclination)
    return strength * np.array([level * math.sin(declination), level * math.cos(declination), -math.sin(inclination)])


def body_field(att: Array, field: Array, bias: Array | float = 0.0) -> jax.Array:
    """What a magnetometer reads (3,), body: ``R' field + bias``, in the field's unit.

    Args:
        att: (4,) quaternion.
        field: (3,) world; see `earth_field`.
        bias: (3,) body: the hard iron, magnetised parts that turn with the vehicle.

    Source: J. L. Crassidis, K.-L. Lai, R. R. Harman, Real-time attitude-independent three-axis magnetometer calibration
    (2005), eq. 1, without scale factors.
    """
    return rotate_back(att, field) + bias


def specific_force(
    att: Array, acc: Array | float = 0.0, bias: Array | float = 0.0, gravity: float = GRAVITY
) -> jax.Array:
    """What an accelerometer reads (3,) m/s^2, body: ``R' (acc + g e_z) + bias``, +9.81 upwards at rest.

    Args:
        att: (4,) quaternion.
        acc: (3,) m/s^2, world: of the vehicle.
        bias: (3,) m/s^2, body.
        gravity: m/s^2 at the place.

    Example: on its right side, the support is felt along the left.
        >>> import math, jax.numpy as jnp, jaxfilt as jf
        >>> [round(float(a), 3) + 0.0 for a in specific_force(jf.so3_exp(jnp.array([math.pi / 2, 0.0, 0.0])))]
        [0.0, 9.81, 0.0]

    Source: P. D. Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems (2013), sec. 4.1.
    """
    return rotate_back(att, acc + jnp.asarray([0.0, 0.0, gravity], att.dtype)) + bias


def yaw_of(att: Array) -> jax.Array:
    """Yaw () rad, of the body's x axis, from the world's x axis (east) to the left; 0 where that axis is vertical.

    Example:
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> round(float(yaw_of(jf.so3_exp(jnp.array([0.0, 0.0, 0.5])))), 4)
        0.5
    """
    return bearing(rotate(att, jnp.asarray([1.0, 0.0, 0.0], att.dtype))[:2])


def compass_yaw(reading: Array, declination: Array | float = 0.0) -> jax.Array:
    """The yaw (rad, from east to the left) of a compass reading (rad, from magnetic north to the right).

    ``pi/2 - (reading + declination)``, wrapped.

    Args:
        reading: () rad.
        declination: rad, from true north to magnetic north, positive to the east.

    Example: heading north.
        >>> round(float(compass_yaw(0.0)), 4)
        1.5708
    """
    return wrap(0.5 * math.pi - (reading + declination))


def magnetometer(R: Array, field: Option, bias: Option = 0.0) -> Sensor:
    """Magnetic field (3,), body, of a state with a field ``att``; unit of ``field``. Usual rate: 10-100 Hz.

    It tells a heading only where the field has a level part, and motors disturb it: a gate, or a large R.

    Args:
        R: (3, 3), the unit of the field squared; of the order of (0.01-0.05)^2 of the field's strength.
        field: (3,) world, see `earth_field`; or a function of the state.
        bias: (3,) body, hard iron; or a function of the state that wanders: ``lambda x: x.extra["hard_iron"]``.

    Example:
        >>> import jax.numpy as jnp
        >>> from jaxfilt.models.sensors import MAGNETOMETER
        >>> sensor = magnetometer(MAGNETOMETER.R(), earth_field(0.05, 1.1, 48e-6))
    """
    return Sensor(lambda x, c: body_field(x.att, chosen(field, x, x.att), chosen(bias, x, x.att)), const(R), vector(3))


def accelerometer(R: Array, bias: Option = 0.0, acc: Option = 0.0, gravity: float = GRAVITY) -> Sensor:
    """Specific force (3,) m/s^2, body, of a state with a field ``att``: a tilt sensor. Usual rate: 50-500 Hz.

    It feels gravity and what the vehicle accelerates by: with ``acc`` unknown, R must make room for that, or a gate.
    Not for a state that has the accelerometer as input: the same reading would be used twice.

    Args:
        R: (3, 3) (m/s^2)^2; of the order of (0.05 m/s^2)^2 at rest, of (1 m/s^2)^2 in flight.
        bias: (3,) m/s^2, body; or a function of the state.
        acc: (3,) m/s^2, world, of the vehicle; or a function of the state.
        gravity: m/s^2 at the place.
    """
    return Sensor(
        lambda x, c: specific_force(x.att, chosen(acc, x, x.att), chosen(bias, x, x.att), gravity),
        const(R),
        vector(3),
    )


def compass(R: Array) -> Sensor:
    """Yaw () rad, from east to the left, of a state with a field ``att``: see `compass_yaw`. Usual rate: 10-50 Hz.

    Args:
        R: (1, 1) rad^2; of the order of (2-5 deg)^2.
    """
    return Sensor(lambda x, c: yaw_of(x.att), const(R), angle)


def gyroscope(R: Array, bias: Option = 0.0) -> Sensor:
    """Angular velocity (3,) rad/s, body, of a state with a field ``rates``. Usual rate: 100-1,000 Hz.

    Args:
        R: (3, 3) (rad/s)^2.
        bias: (3,) rad/s, body; or a function of the state.
    """
    return Sensor(lambda x, c: x.rates + chosen(bias, x, x.rates), const(R), vector(3))
