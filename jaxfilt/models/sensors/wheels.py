"""What wheels tell: their speeds, by the vehicle's speed and turn, and that they neither slip nor fly."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxfilt.models.sensors.options import Option, chosen
from jaxfilt.noise import const
from jaxfilt.spaces import rotate_back, vector
from jaxfilt.types import Array, PyTree, Sensor


def wheel_speeds(speed: Array, rate: Array, radius: Array | float, track: Array | float) -> jax.Array:
    """Left and right wheel (2,) rad/s of a differential drive: ``(v -+ rate track/2) / radius``.

    Also of the rear wheels of a car, whose rate of turn comes from its steering: `ackermann_rate`. Lives on
    ``vector(2)``. Usual rate: 50-100 Hz.

    Args:
        speed: () m/s, forward, of the middle of the axle.
        rate: () rad/s, of the yaw, to the left.
        radius: m, of the wheels.
        track: m, from wheel to wheel.

    Example: turning left on the spot.
        >>> import jax.numpy as jnp
        >>> wheel_speeds(jnp.asarray(0.0), jnp.asarray(1.0), radius=0.25, track=1.0).tolist()
        [-2.0, 2.0]

    Source: R. Siegwart, I. R. Nourbakhsh, Introduction to Autonomous Mobile Robots (2004), section 3.2.2, solved for
    the wheels.
    """
    half = 0.5 * track * rate
    return jnp.stack([speed - half, speed + half]) / radius


def ackermann_rate(speed: Array, steering: Array, wheel_base: Array | float) -> jax.Array:
    """Rate of turn () rad/s of a car: ``speed tan(steering) / wheel_base``.

    Args:
        speed: () m/s, forward, of the rear axle.
        steering: () rad, of the front wheel of the equivalent bicycle, positive to the left, within +-pi/2.
        wheel_base: m, from the rear to the front axle.

    Example: a front wheel at 45 deg, so that the radius is the wheel base.
        >>> import math, jax.numpy as jnp
        >>> round(float(ackermann_rate(jnp.asarray(2.7), jnp.asarray(math.pi / 4), wheel_base=2.7)), 4)
        1.0

    Source: R. Rajamani, Vehicle Dynamics and Control (2012), section 2.2, with the rear axle as reference point.
    """
    return speed * jnp.tan(steering) / wheel_base


def body_velocity(vel: Array, att: Array, rates: Array | float = 0.0, arm: Array | None = None) -> jax.Array:
    """Velocity (3,) m/s, body (forward, left, up), of a point of the body: ``R' vel + rates x arm``.

    Its first component is what an odometer reads. The others are 0 at the rear axle of a vehicle that does not slip: a
    reading of zeros, and R as large as it slips.

    Args:
        vel: (3,) m/s, world.
        att: (4,) quaternion.
        rates: (3,) rad/s, body.
        arm: (3,) m, body: to the middle of the rear axle.

    Source: G. Dissanayake, S. Sukkarieh, E. Nebot, H. Durrant-Whyte, The aiding of a low-cost strapdown inertial
    measurement unit using vehicle model constraints for land vehicle applications (2001), section III.
    """
    own = rotate_back(att, vel)
    return own if arm is None else own + jnp.cross(jnp.asarray(rates), arm)


def wheel_encoders(
    R: Array,
    radius: Option,
    track: Option,
    speed: Callable[[PyTree], Array] = lambda x: x.speed,
    rate: Callable[[PyTree], Array] = lambda x: x.rate,
) -> Sensor:
    """Left and right wheel (2,) rad/s of a state with fields ``speed`` and ``rate``. Usual rate: 50-100 Hz.

    Args:
        R: (2, 2) (rad/s)^2.
        radius: m; or a function of the state.
        track: m; or a function of the state.
        speed: function of the state, () m/s, where it has no such field: ``lambda x: x.vel[0]``.
        rate: function of the state, () rad/s.
    """

    def h(x: PyTree, c: PyTree) -> Array:
        v = speed(x)
        return wheel_speeds(v, rate(x), chosen(radius, x, v), chosen(track, x, v))

    return Sensor(h, const(R), vector(2))


def no_slip(
    R: Array, arm: Option | None = None, rates: Callable[[PyTree, PyTree], Array] = lambda x, c: x.rates
) -> Sensor:
    """Odometer, and no motion sideways or upwards: velocity (3,) m/s, body, of a state with ``vel`` and ``att``.

    The readings are (speed, 0, 0); without an odometer mask the first component. Usual rate: 10-100 Hz.

    Args:
        R: (3, 3) (m/s)^2.
        arm: (3,) m, body: to the middle of the rear axle; or a function of the state. Default: none.
        rates: function (x, c) -> (3,) rad/s, body, used with an arm; for an inertial state with the gyroscope's reading
            as context: ``lambda x, c: c - x.gyro_bias``.
    """

    def h(x: PyTree, c: PyTree) -> Array:
        if arm is None:
            return body_velocity(x.vel, x.att)
        return body_velocity(x.vel, x.att, rates(x, c), chosen(arm, x, x.vel))

    return Sensor(h, const(R), vector(3))
