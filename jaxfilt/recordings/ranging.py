"""Robots on wheels that hear nothing but their distance to a beacon, one at a time, and the distances are too long."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.datasets import Dataset
from jaxfilt.log import align, merge
from jaxfilt.models.parts import start
from jaxfilt.models.sensors import range_to
from jaxfilt.models.wheeled import Odometry, odometry
from jaxfilt.noise import const, diagonal
from jaxfilt.recordings.wheels import Rolling, rolling
from jaxfilt.spaces import product, scalar, vector
from jaxfilt.types import Array, Gaussian, Model, PyTree, Replay, Sensor


class Ranger(NamedTuple):
    """A robot on wheels and what is wrong with its ranges: the state of `ranging_robot`."""

    robot: PyTree
    """`Rolling`: where it is, and the scale of its odometry."""
    bias: Array
    """() m, by which every range is too long."""
    stretch: Array
    """() reported over true distance, but for the bias."""


def ranging_robot(theta: PyTree) -> Model:
    """`rolling` with the sensor "range" to the point ``c``: ``z = stretch |pos - c| + bias``.

    Bias and stretch are constants that nobody knows: only the start's covariance makes states of them.

    Args:
        theta: as in `rolling`, and the logarithm of range (m).

    Returns:
        A model on `Ranger` (7 dimensions) with input `Odometry` and the sensor "range", () m, ``c`` (2,) m.

    Example: 50 m, read as 13 m more.
        >>> import jax.numpy as jnp
        >>> x = Ranger(Rolling(jnp.zeros(2), jnp.asarray(0.0), jnp.ones(2)), jnp.asarray(0.5), jnp.asarray(1.25))
        >>> float(ranging_robot(MOWER).sensors["range"].h(x, jnp.array([30.0, 40.0])))
        63.0

    Source: J. Djugash, S. Singh, A robust method of localization and mapping using only range, ISER (2008), for ranges
    from odometry in the plane; unknown constants as states: Bar-Shalom, Li, Kirubarajan (2001), section 11.9.
    """
    plain = rolling(theta, {})

    def f(x: Ranger, u: Odometry, dt: Array) -> Ranger:
        return x._replace(robot=plain.f(x.robot, u, dt))

    def Q(x: Ranger, u: Odometry, dt: Array) -> Array:
        return jax.scipy.linalg.block_diag(plain.Q(x.robot, u, dt), jnp.zeros((2, 2), x.bias.dtype))

    noise = const(diagonal(jnp.exp(theta["range"])))
    sensor = Sensor(lambda x, c: x.stretch * range_to(x.robot.pos, c) + x.bias, noise, scalar)
    return Model(f, Q, product(Ranger(plain.space, scalar, scalar)), {"range": sensor})


def _replay(theta: PyTree, data: Dataset, u: tuple[np.ndarray, Odometry], yaw: float) -> Replay:
    """A replay that starts at the true position with this heading."""
    recording = merge(ranging_robot(theta), {"range": data.streams["range"]}, u=u)
    truth = align(recording.t, data.truth["pos"], vector(2), gap=0.5)
    begin = data.truth["pos"][1][0]

    def belief(theta: PyTree) -> Gaussian:
        pos, turned, scale, bias, stretch = map(jnp.exp, theta["start"])
        mean = Ranger(Rolling(begin, yaw, np.ones(2)), 0.0, 1.0)
        return start(mean, pos, pos, turned, scale, scale, bias, stretch)

    def view(x: Ranger) -> Array:
        return x.robot.pos

    return Replay(ranging_robot, belief, theta, recording, truth, vector(2), view, {"position": ((0, 1), "m")})


# Round values. What ranges err by, 0.5 m and white once their scale is known, was seen on all of the run; the
# odometry's noises are first guesses for a fibre-optic gyroscope and encoders on grass.
MOWER = {
    "slip": math.log(0.01),  # m/sqrt(s)
    "along": math.log(0.03),  # 1/sqrt(Hz), of the speed
    "turn": math.log(0.003),  # rad/sqrt(s)
    "spin": math.log(0.01),  # 1/sqrt(Hz), of the turn rate
    "drift": math.log(0.0001),  # 1/sqrt(s), of the scale
    "range": math.log(0.6),  # m
    # m, rad, of the scale of odometry, m of bias, of the stretch
    "start": (math.log(0.1), math.log(0.1), math.log(0.02), math.log(3.0), math.log(0.1)),
}
"""``theta`` of a robot lawn-mower: natural logarithms."""


def plaza_range(data: Dataset) -> Replay:
    """A robot lawn-mower, half an hour: distance and turn at 5 Hz as input, a range to one of four beacons at 2 Hz.

    The ranges are 2.9 m too long on average, which is not a bias but a scale: 7 % of the distance. Both are states.
    It starts at its true pose; the truth's heading is odometry as well, so that only the position is scored.
    """
    t, moved = data.inputs["odometry"]
    interval = np.diff(t)
    # A row says how far it went since the row before.
    u = (t[:-1], Odometry(moved[1:, 0] / interval, moved[1:, 1] / interval))
    return _replay(MOWER, data, u, float(data.truth["yaw"][1][0]))


# Round values: the ranges' noise by the authors, the rest first guesses. None was held out: it is 30 s.
LABYRINTH = {
    "slip": math.log(0.01),  # m/sqrt(s)
    "along": math.log(0.05),  # 1/sqrt(Hz), of the speed
    "turn": math.log(0.05),  # rad/sqrt(s)
    "spin": math.log(0.1),  # 1/sqrt(Hz), of the turn rate
    "drift": math.log(0.0001),  # 1/sqrt(s), of the scale
    "range": math.log(0.1),  # m
    # m, rad, of the scale of odometry, m of bias, of the stretch: at 2 m it cannot be told from a bias
    "start": (math.log(0.1), math.log(0.3), math.log(0.05), math.log(0.3), math.log(0.001)),
}
"""``theta`` of a small robot in a labyrinth: natural logarithms."""


def uwb_labyrinth(data: Dataset) -> Replay:
    """A small robot, 30 s: two wheels as input, 8 Hz, and with each row a range to one of four UWB modules.

    The ranges are 0.1 m too long: a bias is a state. In the world of the modules, the first wheel of the file is the
    *left* one, and ``track_width`` is the distance from the middle to a wheel: with the names as they are in the file
    the robot would turn the other way, twice as fast. Seen on the truth's course. It starts at its true pose, the
    heading that of the truth's first 0.2 m.
    """
    t, wheels = data.inputs["wheels"]
    pos = data.truth["pos"][1]
    way = pos - pos[0]
    first = way[np.argmax(np.hypot(*way.T) > 0.2)]
    u = (t, odometry(wheels[:, 0], wheels[:, 1], 2 * data.constants["track_width"]))
    return _replay(LABYRINTH, data, u, float(np.arctan2(first[1], first[0])))
