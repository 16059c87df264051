"""A simple controller and some paths, so that simulated multirotors fly somewhere.

Frames: the world is z up (east, north, up); the body is x forward, y left, z up; an attitude is a unit quaternion
(w, x, y, z), body to world.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.elementary import norm
from jaxfilt.models.rotors import Airframe, allocation, mixer
from jaxfilt.spaces import rotate, rotate_back
from jaxfilt.types import Array, PyTree

GRAVITY = 9.81
"""m/s^2."""


class Reference(NamedTuple):
    """Where to be at one instant: ``pos`` (3,) m, ``vel`` (3,) m/s, ``acc`` (3,) m/s^2, all world; ``yaw`` () rad.

    As the input of a schedule every leaf has a leading axis T; a row's reference is that of the start of its interval.
    """

    pos: Array
    vel: Array
    acc: Array
    yaw: Array


def hover(steps: int, point: tuple[float, float, float] = (0.0, 0.0, 1.5), yaw: float = 0.0) -> Reference:
    """Stay at a point (m), for ``steps`` rows."""
    still = np.zeros((steps, 3))
    return Reference(still + np.asarray(point), still, still, np.full(steps, yaw))


def circle(steps: int, dt: float, radius: float = 1.5, period: float = 8.0, height: float = 1.5) -> Reference:
    """A level circle about the origin, counterclockwise, one round in ``period`` s, the nose along world x.

    Example: the speed of a circle of radius 1 m in 2 pi s.
        >>> import math
        >>> round(float(circle(10, dt=0.01, radius=1.0, period=2 * math.pi).vel[0, 1]), 4)
        1.0
    """
    w = 2 * np.pi / period
    phase = w * dt * np.arange(steps)
    c, s, still = np.cos(phase), np.sin(phase), np.zeros(steps)
    return Reference(
        pos=np.stack([radius * c, radius * s, still + height], axis=1),
        vel=radius * w * np.stack([-s, c, still], axis=1),
        acc=radius * w**2 * np.stack([-c, -s, still], axis=1),
        yaw=still,
    )


def figure_eight(steps: int, dt: float, size: float = 2.0, period: float = 8.0, height: float = 1.5) -> Reference:
    """A level figure eight through the origin, ``(size sin a, size sin(2a)/2)``, once in ``period`` s, nose along x.

    Source: the lemniscate of Gerono.
    """
    w = 2 * np.pi / period
    phase = w * dt * np.arange(steps)
    s1, c1, s2, c2, still = np.sin(phase), np.cos(phase), np.sin(2 * phase), np.cos(2 * phase), np.zeros(steps)
    return Reference(
        pos=np.stack([size * s1, 0.5 * size * s2, still + height], axis=1),
        vel=size * w * np.stack([c1, c2, still], axis=1),
        acc=size * w**2 * np.stack([-s1, -2 * s2, still], axis=1),
        yaw=still,
    )


class Gains(NamedTuple):
    """How hard to steer; all but the tilt are per unit of mass or inertia, so they fit airframes of any size.

    ``pos`` 1/s^2, ``vel`` 1/s: acceleration per metre and per m/s of error. ``att`` (3,) 1/s^2, ``rates`` (3,) 1/s:
    angular acceleration per rad and per rad/s about body x, y, z; little about z, where rotors can do little.
    ``max_tilt`` rad: the steepest attitude to ask for.
    """

    pos: float = 6.0
    vel: float = 4.0
    att: tuple[float, float, float] = (150.0, 150.0, 10.0)
    rates: tuple[float, float, float] = (20.0, 20.0, 5.0)
    max_tilt: float = 1.0


def controller(airframe: Airframe, gains: Gains = Gains()) -> Callable[[PyTree, Reference], jax.Array]:
    """A cascade: position errors ask for an acceleration, that for an attitude, attitude errors for moments.

    ``a = acc + k_pos (pos_ref - pos) + k_vel (vel_ref - vel) + g e_z``; thrust ``m a . R e_z``; the wanted attitude
    R_d has its z along a and its nose towards yaw; ``M = J (-k_att e - k_rates w) + w x J w`` with
    ``e = vee(R_d' R - R' R_d) / 2``. Thrusts are clipped to what the rotors can do.

    Args:
        airframe: what the controller believes that it flies.
        gains: of the cascade.

    Returns:
        ``control(x, reference) -> wrench`` (4,), N and N m, for a state with fields pos, vel, att and rates.

    Example: hovering at the place where it should be takes the weight.
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> from jaxfilt.models.multirotor import RigidBody
        >>> from jaxfilt.models.rotors import hummingbird
        >>> still = RigidBody(jnp.zeros(3), jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))
        >>> here = jax.tree.map(lambda a: jnp.asarray(a[0]), hover(1, point=(0.0, 0.0, 0.0)))
        >>> [round(float(a), 4) + 0.0 for a in controller(hummingbird())(still, here)]
        [7.024, 0.0, 0.0, 0.0]

    Source: Lee, Leok, McClamroch, Geometric tracking control of a quadrotor UAV on SE(3) (2010), eqs. 8-16, without
    the feed-forward of angular rates.
    """

    def control(x: PyTree, reference: Reference) -> jax.Array:
        dtype = x.pos.dtype
        J = jnp.asarray(airframe.inertia, dtype)
        A, inverse = allocation(airframe.rotors).astype(dtype), mixer(airframe.rotors).astype(dtype)
        a = reference.acc + gains.pos * (reference.pos - x.pos) + gains.vel * (reference.vel - x.vel)
        a = _upright(a + jnp.asarray([0.0, 0.0, GRAVITY], dtype), gains.max_tilt)
        body = [rotate(x.att, axis) for axis in jnp.eye(3, dtype=dtype)]
        wanted = _axes(a, reference.yaw)
        crosses = jnp.stack([jnp.cross(d, b) for d, b in zip(wanted, body, strict=True)])
        error = rotate_back(x.att, 0.5 * crosses.sum(0))
        spin_up = -(jnp.asarray(gains.att, dtype) * error + jnp.asarray(gains.rates, dtype) * x.rates)
        moment = J * spin_up + jnp.cross(x.rates, J * x.rates)
        thrust = airframe.mass * (a @ body[2])
        thrusts = inverse @ jnp.concatenate([thrust[None], moment])
        return A @ jnp.clip(thrusts, 0.0, airframe.max_thrust)

    return control


def _upright(a: jax.Array, max_tilt: float) -> jax.Array:
    """The acceleration (3,), at least a third of gravity up, its horizontal part cut to the steepest tilt."""
    vertical = jnp.maximum(a[2], GRAVITY / 3)
    horizontal = norm(a[:2])
    most = math.tan(max_tilt) * vertical
    scale = jnp.where(horizontal > most, most / jnp.where(horizontal > most, horizontal, 1.0), 1.0)
    return jnp.concatenate([scale * a[:2], vertical[None]])


def _axes(a: jax.Array, yaw: jax.Array) -> list[jax.Array]:
    """The body axes, in the world, of an attitude with z along a and x as near to the direction yaw as that allows."""
    z = a / norm(a)
    nose = jnp.stack([jnp.cos(yaw), jnp.sin(yaw), jnp.zeros_like(yaw)])
    y = jnp.cross(z, nose)
    y = y / norm(y)
    return [jnp.cross(y, z), y, z]
