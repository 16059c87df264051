"""Where a vehicle is and how fast: satellites, motion capture, air pressure, and readings whose stamps are late."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxfilt.models.sensors.options import Option, chosen
from jaxfilt.noise import const
from jaxfilt.spaces import product, quaternion_product, rotate, scalar, so3, vector
from jaxfilt.types import Array, PyTree, Sensor

SEA_LEVEL = 101325.0
"""Pa: the pressure of the standard atmosphere at height 0."""


def antenna_position(pos: Array, att: Array, arm: Array) -> jax.Array:
    """Position (3,) m, world, of a point fixed to the body: ``pos + R arm``.

    Args:
        pos: (3,) m, world.
        att: (4,) quaternion.
        arm: (3,) m, body: from the vehicle's point of reference to the antenna, the lever arm.

    Example: an antenna 1 m to the front of a vehicle that heads north.
        >>> import math, jax.numpy as jnp, jaxfilt as jf
        >>> north = jf.so3_exp(jnp.array([0.0, 0.0, math.pi / 2]))
        >>> (antenna_position(jnp.zeros(3), north, jnp.array([1.0, 0.0, 0.0])).round(4) + 0.0).tolist()
        [0.0, 1.0, 0.0]

    Source: P. D. Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems (2013), sec.
    14.3.1.
    """
    return pos + rotate(att, arm)


def antenna_velocity(vel: Array, att: Array, rates: Array, arm: Array) -> jax.Array:
    """Velocity (3,) m/s, world, of a point fixed to the body: ``vel + R (rates x arm)``.

    Args:
        vel: (3,) m/s, world.
        att: (4,) quaternion.
        rates: (3,) rad/s, body: a gyroscope's reading less its bias.
        arm: (3,) m, body.

    Example: 1 m in front of a vehicle that turns left on the spot.
        >>> import jax.numpy as jnp
        >>> level, left = jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 2.0])
        >>> antenna_velocity(jnp.zeros(3), level, left, jnp.array([1.0, 0.0, 0.0])).tolist()
        [0.0, 2.0, 0.0]

    Source: Groves (2013), sec. 14.3.1, without the earth's rotation.
    """
    return vel + rotate(att, jnp.cross(rates, arm))


def marker_pose(pos: Array, att: Array, arm: Array, turn: Array) -> tuple[jax.Array, jax.Array]:
    """Position (3,) m, world, and attitude (4,) of a frame fixed to the body, such as that of markers on it.

    ``(pos + R arm, att * turn)``. Lives on ``product((vector(3), so3))``.

    Args:
        pos: (3,) m, world.
        att: (4,) quaternion.
        arm: (3,) m, body: the origin of the frame.
        turn: (4,) quaternion, from the frame to the body.
    """
    return pos + rotate(att, arm), quaternion_product(att, turn)


def pressure_height(pressure: Array, sea_level: Array | float = SEA_LEVEL) -> Array:
    """Height (m) above sea level of an air pressure (Pa), below 11 km: ``44330.8 (1 - (p/p_0)^0.190263)``.

    Its error is of the weather: 8 m for 1 hPa. What counts is its change; the rest is a barometer's drift.

    Args:
        pressure: Pa.
        sea_level: Pa, the pressure at height 0 (QNH).

    Example:
        >>> round(float(pressure_height(89874.6)))
        1000

    Source: U.S. Standard Atmosphere (1976), eqs. 19 and 33a.
    """
    return 44330.77 * (1 - (pressure / sea_level) ** 0.1902632)


def gnss_position(R: Array, arm: Option | None = None) -> Sensor:
    """Position (3,) m, world, of a state with a field ``pos``, with an arm also ``att``. Usual rate: 5-10 Hz.

    Args:
        R: (3, 3) m^2; of the order of (1-3 m)^2, of (0.02 m)^2 with RTK, the height twice as bad.
        arm: (3,) m, body, of the antenna; or a function of the state that returns it.

    Example: an antenna whose arm is a parameter, to be tuned.
        >>> import jax.numpy as jnp
        >>> from jaxfilt.models.sensors import RTK
        >>> model = lambda theta: {"gnss": gnss_position(RTK.R(), arm=theta["arm"])}
    """
    if arm is None:
        return Sensor(lambda x, c: x.pos, const(R), vector(3))
    return Sensor(lambda x, c: antenna_position(x.pos, x.att, chosen(arm, x, x.pos)), const(R), vector(3))


def gnss_velocity(
    R: Array, arm: Option | None = None, rates: Callable[[PyTree, PyTree], Array] = lambda x, c: x.rates
) -> Sensor:
    """Velocity (3,) m/s, world, of a state with a field ``vel``: the receiver's Doppler. Usual rate: 5-10 Hz.

    Args:
        R: (3, 3) (m/s)^2; of the order of (0.1 m/s)^2.
        arm: (3,) m, body, of the antenna; or a function of the state that returns it. With it the state needs ``att``.
        rates: function (x, c) -> (3,) rad/s, body, used with an arm. For an inertial state with the gyroscope's reading
            as context: ``lambda x, c: c - x.gyro_bias``.
    """
    if arm is None:
        return Sensor(lambda x, c: x.vel, const(R), vector(3))
    return Sensor(lambda x, c: antenna_velocity(x.vel, x.att, rates(x, c), chosen(arm, x, x.vel)), const(R), vector(3))


def mocap_pose(R: Array, arm: Option = (0.0, 0.0, 0.0), turn: Option | None = None) -> Sensor:
    """Position (3,) m, world, and attitude (4,) of a state with fields ``pos`` and ``att``. Usual rate: 200 Hz.

    Args:
        R: (6, 6) m^2 and rad^2: position in the world frame, then attitude about the axes of the markers' frame.
        arm: (3,) m, body: the origin of the markers' frame; or a function of the state.
        turn: (4,) quaternion from the markers' frame to the body; or a function of the state. Default: none.
    """

    def h(x: PyTree, c: PyTree) -> tuple[Array, Array]:
        if turn is None:
            return antenna_position(x.pos, x.att, chosen(arm, x, x.pos)), x.att
        return marker_pose(x.pos, x.att, chosen(arm, x, x.pos), chosen(turn, x, x.att))

    return Sensor(h, const(R), product((vector(3), so3)))


def barometer(R: Array, drift: Option = 0.0) -> Sensor:
    """Height (m) by air pressure of a state with a field ``pos``: ``pos_z + drift``. Usual rate: 10-50 Hz.

    The weather, the heat of the board and the wind make it wander by metres in minutes, so give it a state that does::

        extra = {"drift": Wander(jf.scalar, density=0.05)}
        sensors = {"baro": barometer(R, drift=lambda x: x.extra["drift"])}

    Args:
        R: (1, 1) m^2; of the order of (0.1-0.3 m)^2.
        drift: () m; or a function of the state. Where the pressure was taken as zero belongs into it.
    """
    return Sensor(lambda x, c: x.pos[2] + chosen(drift, x, x.pos), const(R), scalar)


def coast(x: PyTree, c: PyTree, dt: Array) -> tuple[PyTree, PyTree]:
    """A state with fields ``pos`` and ``vel``, dt seconds on: the position moves, all else stays."""
    return x._replace(pos=x.pos + dt * x.vel), c


def late(
    sensor: Sensor,
    seconds: Array | float,
    ahead: Callable[[PyTree, PyTree, Array], tuple[PyTree, PyTree]] = coast,
) -> Sensor:
    """A sensor whose stamps come ``seconds`` after what they tell of: ``h(x(t - seconds), c)``.

    For a small offset, a constant that is to be tuned; a known one is better taken off the stamps, by
    `jaxfilt.merge`. The present state is led back in time without noise, so that seconds must be short beside the time
    in which the noise of the process matters.

    Args:
        sensor: as it would read in time.
        seconds: () s; negative where the stamps are early.
        ahead: function (x, c, dt) -> the state dt seconds on, here called with -seconds, and the context of ``sensor``.
            Of an inertial state it is `jaxfilt.models.inertial.late` that knows how.

    Example: GNSS that tells of where the drone was 0.1 s ago.
        >>> import jax.numpy as jnp
        >>> from jaxfilt.models.sensors import GNSS_CONSUMER
        >>> from jaxfilt.models.tracking import Target
        >>> slow = late(gnss_position(GNSS_CONSUMER.R()), 0.1)
        >>> slow.h(Target(jnp.zeros(3), jnp.array([10.0, 0.0, 0.0])), ()).tolist()
        [-1.0, 0.0, 0.0]
    """
    return Sensor(
        lambda x, c: sensor.h(*ahead(x, c, -seconds)), lambda x, c: sensor.R(*ahead(x, c, -seconds)), sensor.space
    )
