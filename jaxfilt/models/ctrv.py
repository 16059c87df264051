"""Constant turn rate and velocity (CTRV): a vehicle tracked from outside, by lidar and radar.

World frame: x, y in m, z up, the sensors at the origin. Yaw from the world's x axis to the direction of travel,
positive to the left. Parameters ``theta`` are natural logarithms of standard deviations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.elementary import bearing, norm
from jaxfilt.log import schedule
from jaxfilt.models.parts import arc, rotated, start, white_acceleration
from jaxfilt.noise import const, diagonal
from jaxfilt.spaces import angle, product, scalar, vector
from jaxfilt.types import Array, Gaussian, Log, Model, PyTree, Scenario, Sensor


class Ctrv(NamedTuple):
    """A vehicle that keeps its speed and its rate of turn: the state of `ctrv`."""

    pos: Array
    """(2,) m, world."""
    yaw: Array
    """() rad, direction of travel."""
    speed: Array
    """() m/s."""
    rate: Array
    """() rad/s, of the yaw."""


class Radar(NamedTuple):
    """A radar's reading, from the origin."""

    range: Array
    """() m."""
    bearing: Array
    """() rad, from the world's x axis."""
    range_rate: Array
    """() m/s, positive outwards."""


BICYCLIST = {
    "slip": math.log(0.02),  # m/sqrt(s): chosen, small
    "acceleration": math.log(0.2),  # (m/s)/sqrt(s): within the 0.2 to 2 m/s^2 that the course's solutions use per step
    "turn": math.log(0.1),  # (rad/s)/sqrt(s): likewise 0.3 to 0.6 rad/s^2
    "lidar": math.log(0.15),  # m: the values handed out with the udacity recording
    "radar": (math.log(0.3), math.log(0.03), math.log(0.3)),  # m, rad, m/s: likewise
    "start": (math.log(0.5), math.log(0.5), math.log(0.1), math.log(0.5), math.log(0.05)),  # m, m, rad, m/s, rad/s
}
"""A bicycle among cars, seen by a car's lidar and radar: ``theta`` of `ctrv`."""


def ctrv(theta: PyTree = BICYCLIST) -> Model:
    """Constant turn rate and velocity, disturbed by white longitudinal and yaw acceleration.

    ``pos`` rolls ``speed dt`` along an arc of ``rate dt``; written with the chord, values and derivatives are finite
    and continuous at zero turn rate. ``Q``: white acceleration along the heading on (position, speed), the same on
    (yaw, rate), and slip in both directions, which keeps it positive definite.

    Args:
        theta: logarithms of the noise densities slip (m/sqrt(s)), acceleration ((m/s)/sqrt(s)), turn
            ((rad/s)/sqrt(s)), and of the standard deviations lidar (m), radar (m, rad, m/s). See `BICYCLIST`. A
            standard deviation of a per dt, held over each step dt, is a density ``a sqrt(dt)``.

    Returns:
        A model on `Ctrv` (5 dimensions), no input, with sensors "lidar" (position, (2,) m) and "radar" (`Radar`).

    Example: straight on at zero turn rate.
        >>> import jax.numpy as jnp
        >>> x = Ctrv(jnp.zeros(2), jnp.asarray(0.0), jnp.asarray(5.0), jnp.asarray(0.0))
        >>> ctrv().f(x, (), 2.0).pos.tolist()
        [10.0, 0.0]

    Source: Schubert, Richter, Wanielik, Comparison and evaluation of advanced motion models for vehicle tracking
    (2008), the CTRV model, with the chord in place of its quotients.
    """
    std = jax.tree.map(jnp.exp, theta)

    def f(x: Ctrv, u: PyTree, dt: Array) -> Ctrv:
        pos, yaw = arc(x.pos, x.yaw, x.speed * dt, x.rate * dt)
        return Ctrv(pos, yaw, x.speed, x.rate)

    def Q(x: Ctrv, u: PyTree, dt: Array) -> Array:
        drift = white_acceleration(dt)
        noise = jax.scipy.linalg.block_diag(std["acceleration"] ** 2 * drift, std["turn"] ** 2 * drift)
        unit, heading = jnp.eye(5, dtype=x.yaw.dtype), jnp.stack([jnp.cos(x.yaw), jnp.sin(x.yaw)])
        along, yaw, speed, rate = heading @ unit[:2], unit[2], unit[3], unit[4]
        G = jnp.stack([along, speed, yaw, rate], axis=1)
        return G @ noise @ G.T + dt * jnp.diag(std["slip"] ** 2 * (unit[0] + unit[1]))

    sensors = {
        "lidar": Sensor(lambda x, c: x.pos, const(diagonal(std["lidar"], std["lidar"])), vector(2)),
        "radar": Sensor(
            lambda x, c: radar(x.pos, velocity(x)),
            const(diagonal(*std["radar"])),
            product(Radar(scalar, angle, scalar)),
        ),
    }
    return Model(f, Q, product(Ctrv(vector(2), angle, scalar, scalar)), sensors)


def velocity(x: Ctrv) -> Array:
    """(2,) m/s, world: the velocity of a `Ctrv`, which is what most recordings know of it."""
    return rotated(x.yaw, jnp.stack([x.speed, jnp.zeros_like(x.speed)]))


def radar(pos: Array, vel: Array) -> Radar:
    """What a radar at the origin reports: ``(|p|, atan2(p_y, p_x), p'v / |p|)``, and zeros at zero distance.

    Args:
        pos: (2,) m, world.
        vel: (2,) m/s, world.

    Example:
        >>> import jax.numpy as jnp
        >>> [round(float(a), 2) for a in radar(jnp.array([3.0, 4.0]), jnp.array([5.0, 0.0]))]
        [5.0, 0.93, 3.0]
    """
    distance = norm(pos)
    outwards = pos / jnp.where(distance > 0, distance, 1.0)
    return Radar(distance, bearing(pos), outwards @ vel)


def ctrv_start(theta: PyTree = BICYCLIST) -> Gaussian:
    """60 m in front, to the left at 5 m/s, on a circle of 25 m; ``theta["start"]`` in m, m, rad, m/s, rad/s."""
    return start(Ctrv(np.array([60.0, 0.0]), math.pi / 2, 5.0, 0.2), *map(jnp.exp, theta["start"]))


def ctrv_scenario() -> Scenario:
    """Lidar at 20 Hz and radar at 10 Hz follow a bicyclist who circles 60 m away. Mild: EKF and UKF are consistent."""

    def watch(steps: int) -> Log:
        return schedule(ctrv(), steps, 0.05, every={"radar": 2})

    blocks = {"position": ((0, 1), "m"), "yaw": ((2,), "rad"), "speed": ((3,), "m/s"), "rate": ((4,), "rad/s")}
    return Scenario(ctrv, ctrv_start, BICYCLIST, watch, blocks)
