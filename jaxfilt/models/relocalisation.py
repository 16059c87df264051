"""A drone that does not know where it is, above ground whose height it knows: the ground beneath its way tells.

World frame: x, y in m, z up. Parameters ``theta`` are natural logarithms of standard deviations.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.log import schedule
from jaxfilt.models.parts import start
from jaxfilt.models.sensors.ranging import Terrain, height_map
from jaxfilt.noise import const, diagonal, white
from jaxfilt.spaces import scalar, vector
from jaxfilt.types import Array, Gaussian, Log, Model, PyTree, Scenario, Sensor

EXTENT, SPACING, ALTITUDE = 400.0, 20.0, 60.0
"""m: chosen. The map is a square from the origin on; its nodes; and where the drone flies, above sea level."""

LOST_DRONE = {
    "drift": math.log(0.3),  # m/sqrt(s): chosen, visual odometry: 3 m in 100 s
    "range": math.log(0.5),  # m: chosen, a laser range finder and what the map does not show
    "start": math.log(120.0),  # m: anywhere on the map
}
"""``theta`` of `relocalisation`."""


def hills() -> np.ndarray:
    """Made-up ground, (21, 21) m at nodes 20 m apart: sums of waves along many directions.

    Example:
        >>> ground = hills()
        >>> ground.shape, bool(-8 < ground.min() < ground.max() < 30)
        ((21, 21), True)
    """
    x, y = np.meshgrid(*[np.arange(0.0, EXTENT + 1, SPACING)] * 2, indexing="ij")
    waves = [(0.021, 0.3, 1.0), (0.034, 1.9, 2.1), (0.047, 2.7, 0.4), (0.058, 0.9, 4.0), (0.071, 1.4, 5.2)]
    height = sum(np.sin(k * (np.cos(a) * x + np.sin(a) * y) + shift) for k, a, shift in waves)
    return 10.0 + 4.0 * np.asarray(height)


def relocalisation(theta: PyTree = LOST_DRONE, ground: Terrain | None = None) -> Model:
    """A drone at a known altitude: ``x' = x + u dt`` by its odometry, and the range to the ground straight below.

    ``range = altitude - ground(x)``. One reading leaves all places of that height, a flight hardly any but its own.

    Args:
        theta: logarithms of the density drift (m/sqrt(s)) and of the standard deviation range (m). See `LOST_DRONE`.
        ground: function (2,) m -> () m, see `jaxfilt.models.sensors.height_map`; default `hills`.

    Returns:
        A model on ``jaxfilt.vector(2)``, m, world, with input velocity (2,) m/s, world, and the sensor "range" () m.

    Example:
        >>> import jax.numpy as jnp
        >>> flat = relocalisation(ground=lambda place: 12.0 + 0.0 * place[0])
        >>> float(flat.sensors["range"].h(jnp.zeros(2), ()))
        48.0

    Source: the problem is that of terrain-aided navigation: Bergman, Recursive Bayesian Estimation: Navigation and
    Tracking Applications (1999), chapter 7.
    """
    terrain = height_map(hills(), spacing=SPACING) if ground is None else ground
    std = jax.tree.map(jnp.exp, theta)
    laser = Sensor(lambda x, c: ALTITUDE - terrain(x), const(diagonal(std["range"])), scalar)
    return Model(lambda x, u, dt: x + u * dt, white(diagonal(std["drift"], std["drift"])), vector(2), {"range": laser})


def relocalisation_start(theta: PyTree = LOST_DRONE) -> Gaussian:
    """The middle of the map, with the standard deviation ``theta["start"]`` m: anywhere."""
    return start(np.full(2, 0.5 * EXTENT), jnp.exp(theta["start"]), jnp.exp(theta["start"]))


def relocalisation_scenario() -> Scenario:
    """A drone that may be anywhere above known hills flies round, and finds out where by the ground below.

    Harsh: the belief has as many peaks as there are places like this one. Particles find the drone, an EKF does not.
    The drone turns about the middle of the map at 8 m/s; the reference in the log is the point that it is to be at.
    """

    def fly(steps: int) -> Log:
        t = np.arange(1, steps + 1)[:, None] / 80.0
        return schedule(
            relocalisation(), steps, 1.0, u=0.5 * EXTENT + 120.0 * np.concatenate([np.cos(t), np.sin(t)], 1)
        )

    def towards(x: Array, goal: Array) -> Array:
        away = goal - x
        return 8.0 * away / jnp.sqrt(away @ away + 64.0)

    blocks = {"position": ((0, 1), "m")}
    return Scenario(relocalisation, relocalisation_start, LOST_DRONE, fly, blocks, towards)
