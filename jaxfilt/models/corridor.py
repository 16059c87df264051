"""Where one of a few readings means one of many places: a robot in a corridor with doors, a drone above a landing zone.

What is read is yes or no, so the sensors have a `Law`; of it a Kalman filter knows mean and variance only. Parameters
``theta`` are natural logarithms of standard deviations, and log odds of probabilities: ``log(p / (1 - p))``.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.log import schedule
from jaxfilt.models.parts import start
from jaxfilt.noise import const, diagonal
from jaxfilt.spaces import scalar
from jaxfilt.types import Array, Gaussian, Law, Log, Model, PyTree, Scenario, Sensor


def log_odds(probability: float) -> float:
    """``log(p / (1 - p))``: a probability as a number without bounds; `jax.nn.sigmoid` takes it back.

    Example:
        >>> log_odds(0.5)
        0.0
    """
    return math.log(probability / (1 - probability))


CORRIDOR_LENGTH, DOORS, DOOR_WIDTH = 20.0, (2.0, 5.0, 12.0), 0.4
"""m, m, m: chosen. Three doors at uneven distances, as in the book; a door is seen from about its width to either side
of its middle."""

CORRIDOR_ROBOT = {
    "odometer": math.log(0.1),  # m/sqrt(s): chosen, 1 m of drift in 100 s
    "door": (log_odds(0.9), log_odds(0.05)),  # chosen: seen in front of a door, and where there is none
    "wall": math.log(0.05),  # m: an ultrasonic range finder, chosen
    "start": math.log(4.0),  # m: anywhere in the corridor
}
"""``theta`` of `corridor`."""


def corridor(theta: PyTree = CORRIDOR_ROBOT) -> Model:
    """A robot in a corridor: ``x' = x + u dt``, a camera that sees a door or does not, and the range to the far wall.

    ``p(door | x) = false + (seen - false) n(x)``, ``n(x) = 1 - prod_d (1 - exp(-(x - d)^2 / (2 width^2)))``: 1 in front
    of a door d, 0 far from all. The reading does not say which door it is.

    Args:
        theta: logarithms of the noise density odometer (m/sqrt(s)) and of the standard deviation wall (m); door: log
            odds of seeing a door where one is, and where none is. See `CORRIDOR_ROBOT`.

    Returns:
        A model on `jaxfilt.scalar`, m along the corridor, with the input speed () m/s and the sensors "door" (1 seen or
        0 not, with a law) and "wall" (() m to the wall at 20 m).

    Example:
        >>> import jax.numpy as jnp
        >>> seen = corridor().sensors["door"].h
        >>> round(float(seen(jnp.asarray(5.0), ())), 3), round(float(seen(jnp.asarray(8.5), ())), 3)
        (0.9, 0.05)

    Source: Thrun, Burgard, Fox, Probabilistic Robotics (2005), figures 1.2 and 8.1: the example, not its numbers.
    """
    seen, false = (jax.nn.sigmoid(jnp.asarray(odds)) for odds in theta["door"])

    def door(x: Array, c: PyTree) -> Array:
        away = (x - jnp.asarray(DOORS, x.dtype)) / DOOR_WIDTH
        return false + (seen - false) * (1 - jnp.prod(1 - jnp.exp(-0.5 * away * away)))

    sensors = {
        "door": yes_or_no(door),
        "wall": Sensor(lambda x, c: CORRIDOR_LENGTH - x, const(diagonal(jnp.exp(theta["wall"]))), scalar),
    }
    return Model(lambda x, u, dt: x + u * dt, _drift(jnp.exp(theta["odometer"])), scalar, sensors)


def yes_or_no(probability: Callable[[Array, PyTree], Array]) -> Sensor:
    """A sensor that reads 1 with a probability that depends on the state, and 0 otherwise.

    Args:
        probability: function of (x, c), strictly between 0 and 1: the mean of the reading, its variance ``p (1 - p)``.

    Example: a lamp that is mostly on.
        >>> import jax.numpy as jnp
        >>> lamp = yes_or_no(lambda x, c: 0.75 + 0.0 * x)
        >>> round(float(jnp.exp(lamp.law.log_density(jnp.asarray(1.0), jnp.asarray(0.0), ()))), 4)
        0.75
    """

    def R(x: PyTree, c: PyTree) -> Array:
        p = probability(x, c)
        return (p * (1 - p))[None, None]

    def log_density(z: Array, x: PyTree, c: PyTree) -> Array:
        p = probability(x, c)
        return z * jnp.log(p) + (1 - z) * jnp.log1p(-p)

    def draw(x: PyTree, c: PyTree, key: Array) -> Array:
        p = probability(x, c)
        return jax.random.bernoulli(key, p).astype(p.dtype)

    return Sensor(probability, R, scalar, Law(log_density, draw))


def _drift(density: Array) -> Callable[[PyTree, PyTree, Array], Array]:
    return lambda x, u, dt: dt * diagonal(density)


def corridor_start(theta: PyTree = CORRIDOR_ROBOT) -> Gaussian:
    """Half-way along the corridor, with the standard deviation ``theta["start"]`` m."""
    return start(0.5 * CORRIDOR_LENGTH, jnp.exp(theta["start"]))


def patrol(steps: int, dt: float = 0.2) -> np.ndarray:
    """Where the robot is to be, (steps,) m: to and fro between 1 and 19 m at 0.5 m/s, first towards the far wall.

    Example:
        >>> patrol(61)[[0, 44, -1]].round(1).tolist()
        [10.1, 14.5, 16.1]
    """
    way = 0.5 * CORRIDOR_LENGTH - 1 + 0.5 * dt * np.arange(1, steps + 1)
    reach = CORRIDOR_LENGTH - 2
    return 1 + reach - np.abs(way % (2 * reach) - reach)


def corridor_scenario() -> Scenario:
    """A robot that does not know where in a corridor it is goes to and fro, a door seen or not five times a second.

    Harsh: the belief has a peak at each door until the distances between them have told which is which, and no Gaussian
    fits. It begins as a wide one; grid and particle filters find the robot, an EKF does not. The reference in the log
    is `patrol`, which the robot follows at up to 0.7 m/s; "wall" is silent.
    """

    def wander(steps: int) -> Log:
        return schedule(corridor(), steps, 0.2, every={"wall": 0}, u=patrol(steps))

    def follow(x: Array, reference: Array) -> Array:
        return jnp.clip(reference - x, -0.7, 0.7)

    return Scenario(corridor, corridor_start, CORRIDOR_ROBOT, wander, {"position": ((0,), "m")}, follow)


LANDING_ZONE = {
    "bright": (log_odds(0.6), log_odds(0.3)),  # the lecture: P(bright | home), P(bright | not home)
}
"""``theta`` of `landing_zone`."""

ELSEWHERE, HOME = 0.0, 1.0
"""The two states of `landing_zone`: points for `jaxfilt.grid`."""


def landing_zone(theta: PyTree = LANDING_ZONE) -> Model:
    """A drone that is above its landing zone or is not, and a camera that sees a bright ground: the lecture's example.

    The state is `HOME` or `ELSEWHERE` and stays so. With P(bright | home) = 0.6, P(bright | not home) = 0.3 and an even
    start one bright image makes 2/3.

    Args:
        theta: log odds of a bright image at home and elsewhere. See `LANDING_ZONE`.

    Returns:
        A model on `jaxfilt.scalar` with input () and the sensor "bright" (1 or 0, with a law), for a grid of two cells.

    Example:
        >>> import jax.numpy as jnp
        >>> round(float(landing_zone().sensors["bright"].h(jnp.asarray(HOME), ())), 4)
        0.6
    """
    home, elsewhere = (jax.nn.sigmoid(jnp.asarray(odds)) for odds in theta["bright"])
    bright = yes_or_no(lambda x, c: elsewhere + (home - elsewhere) * x)
    return Model(lambda x, u, dt: x, lambda x, u, dt: jnp.zeros((1, 1), x.dtype), scalar, {"bright": bright})
