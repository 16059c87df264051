"""A multirotor flown through loops: the nose passes 90 degrees of pitch, where Euler angles end and SO(3) does not.

Frames as in `jaxfilt.models.multirotor`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.elementary import norm
from jaxfilt.log import schedule
from jaxfilt.models.control import GRAVITY, Gains
from jaxfilt.models.multirotor import BLOCKS, DT, EulerBody, RigidBody, multirotor, parameters
from jaxfilt.models.parts import start
from jaxfilt.models.rotors import Airframe, allocation, hummingbird, mixer
from jaxfilt.spaces import rotate, rotate_back, so3
from jaxfilt.types import Array, Gaussian, Log, PyTree, Scenario

RADIUS = 1.5
"""m."""

ROUND = 1.8
"""s: at the top 0.9 g towards the ground, so that the rotors push all the way."""

LOOP = parameters(hummingbird(), gust=0.1, shake=0.15) | {
    "position": (math.log(0.02), math.log(0.03)),  # m: RTK
    "start": (math.log(0.1), math.log(0.1), math.log(0.02), math.log(0.1)),  # m, m/s, rad, rad/s
}
"""The quadrotor on a calm day with a good receiver: ``theta`` of `jaxfilt.models.multirotor.multirotor`."""


class Loop(NamedTuple):
    """Where to be in a loop at one instant: ``pos`` m, ``vel`` m/s, ``acc`` m/s^2, world; ``rates`` rad/s, body; (3,).
    As the input of a schedule every leaf has a leading axis T."""

    pos: Array
    vel: Array
    acc: Array
    rates: Array


def looping(steps: int, dt: float = DT, radius: float = RADIUS, period: float = ROUND) -> Loop:
    """Loops in the plane of x and z, one in ``period`` s, from their lowest point on, forward and then up.

    ``pos = radius (sin a, 0, 1 - cos a)``. The rotors push along ``acc + g e_z``, which turns about -y by
    ``a_dot c (c + g cos a) / |acc + g e_z|^2``, ``c = radius a_dot^2``.
    """
    w = 2 * np.pi / period
    a = w * dt * np.arange(steps)
    s, c, still = np.sin(a), np.cos(a), np.zeros(steps)
    pull = radius * w**2
    turn = w * pull * (pull + GRAVITY * c) / (pull**2 + 2 * pull * GRAVITY * c + GRAVITY**2)
    return Loop(
        pos=radius * np.stack([s, still, 1 - c], axis=1),
        vel=radius * w * np.stack([c, still, s], axis=1),
        acc=pull * np.stack([-s, still, c], axis=1),
        rates=np.stack([still, -turn, still], axis=1),
    )


def loop_controller(airframe: Airframe, gains: Gains = Gains()) -> Callable[[PyTree, Loop], jax.Array]:
    """`jaxfilt.models.control.controller` without a limit to the tilt, with the rates fed forward, and the left side to
    world y in place of a yaw, which a loop does not have.

    Source: Lee, Leok, McClamroch, Geometric tracking control of a quadrotor UAV on SE(3) (2010), eqs. 8-16, without the
    angular acceleration.
    """

    def control(x: PyTree, to: Loop) -> jax.Array:
        dtype = x.pos.dtype
        J = jnp.asarray(airframe.inertia, dtype)
        A, inverse = allocation(airframe.rotors).astype(dtype), mixer(airframe.rotors).astype(dtype)
        a = to.acc + gains.pos * (to.pos - x.pos) + gains.vel * (to.vel - x.vel)
        a = a + jnp.asarray([0.0, 0.0, GRAVITY], dtype)
        body = [rotate(x.att, axis) for axis in jnp.eye(3, dtype=dtype)]
        up = a / norm(a)
        left = jnp.asarray([0.0, 1.0, 0.0], dtype)
        left = left - (left @ up) * up
        left = left / norm(left)
        wanted = [jnp.cross(left, up), left, up]
        crosses = jnp.stack([jnp.cross(d, b) for d, b in zip(wanted, body, strict=True)])
        error = rotate_back(x.att, 0.5 * crosses.sum(0))
        spin_up = -(jnp.asarray(gains.att, dtype) * error + jnp.asarray(gains.rates, dtype) * (x.rates - to.rates))
        moment = J * spin_up + jnp.cross(x.rates, J * x.rates)
        thrusts = inverse @ jnp.concatenate([(airframe.mass * (a @ body[2]))[None], moment])
        return A @ jnp.clip(thrusts, 0.0, airframe.max_thrust)

    return control


def _bottom() -> tuple[Array, Array, Array]:
    path = looping(1)
    return path.pos[0], path.vel[0], path.rates[0]


def _stds(theta: PyTree) -> list[Array]:
    return [jnp.exp(jnp.asarray(log_std)) for log_std in theta["start"] for _ in range(3)]


def loop_start(theta: PyTree = LOOP) -> Gaussian:
    """At the lowest point of a loop, at its speed, with the standard deviations ``theta["start"]``."""
    pos, vel, rates = _bottom()
    return start(RigidBody(pos, vel, so3.origin, rates), *_stds(theta))


def euler_loop_start(theta: PyTree = LOOP) -> Gaussian:
    """`loop_start` with Euler angles."""
    pos, vel, rates = _bottom()
    return start(EulerBody(pos, vel, np.zeros(3), rates), *_stds(theta))


def loop_scenario() -> Scenario:
    """Loops of 3 m in 1.8 s each, upside down at the top: RTK position and velocity at 20 Hz, gyroscope at 100 Hz."""

    def fly(steps: int) -> Log:
        every = {"position": 5, "velocity": 5, "pose": 0}
        return schedule(multirotor(LOOP), steps, DT, every=every, u=looping(steps))

    return Scenario(multirotor, loop_start, LOOP, fly, BLOCKS, loop_controller(hummingbird()))
