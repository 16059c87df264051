"""A drone in a hall that hears nothing but its distances to four radio anchors, nearly all at one height."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np

from jaxfilt.datasets import Dataset
from jaxfilt.log import align, merge
from jaxfilt.models.parts import start
from jaxfilt.models.sensors import range_to
from jaxfilt.noise import const, diagonal
from jaxfilt.recordings.indoor import Moving, moving
from jaxfilt.spaces import scalar, vector
from jaxfilt.types import Gaussian, Model, PyTree, Replay, Sensor

ANCHORS = 4

# Round numbers. The bias is that of the set's README, 0.19 to 0.26 m on both flights, so it is not held out.
ANCHORED = {
    "acceleration": (math.log(1.0), math.log(0.3)),  # (m/s)/sqrt(s): each horizontal axis, the vertical one
    "range": math.log(0.1),  # m
    "bias": 0.2,  # m, no logarithm: of all anchors
    "start": (math.log(2.0), math.log(0.2), math.log(0.1)),  # m horizontally, m vertically, m/s
}
"""``theta`` of `anchored_drone`: natural logarithms, but for bias."""

FIRST_HEIGHTS = {"sequence3": 0.1, "sequence6": 1.8}
"""m: on the floor; and in the air, for that recording was cut. From the truth, to 0.1 m."""


def anchored_drone(theta: PyTree = ANCHORED) -> Model:
    """A point with white acceleration, ranged from four anchors with one bias: ``range_k = |pos - anchor_k| + bias``.

    Anchors in one plane leave the side of it open: a height and its mirror image have the same ranges, and near the
    plane, where ``d range / d height`` vanishes, a range says next to nothing of the height. So the side must be known
    at the start, and a flight through the plane can come out on the wrong one.

    Args:
        theta: logarithms of acceleration (horizontal, vertical; (m/s)/sqrt(s)) and range (m); as it is bias (m).

    Returns:
        A model on `jaxfilt.recordings.indoor.Moving` (6 dimensions), no input, with the sensors "range_1" ...
        "range_4", () m, their context the anchor's place (3,) m.

    Example:
        >>> import jax.numpy as jnp
        >>> x = Moving(jnp.array([3.0, 4.0, 1.5]), jnp.zeros(3))
        >>> round(float(anchored_drone().sensors["range_1"].h(x, jnp.array([0.0, 0.0, 1.5]))), 4)
        5.2
    """
    anchor = Sensor(lambda x, c: range_to(x.pos, c, theta["bias"]), const(diagonal(jnp.exp(theta["range"]))), scalar)
    return moving(theta, {f"range_{k + 1}": anchor for k in range(ANCHORS)})


def rcv_uwb_drone(data: Dataset) -> Replay:
    """A drone indoors and four ultra-wideband ranges, 0.2 m too long, some off by metres: a gate, or robust.

    It starts at rest 2 m (one standard deviation) about the middle of the anchors, and at a height that is told from
    the truth to 0.1 m (0.2 m, one standard deviation): ranges to anchors nearly in one plane do not tell the side, see
    `anchored_drone`. Judge it by the block "horizontal"; "height" shows what the geometry leaves.
    """

    def belief(theta: PyTree) -> Gaussian:
        across, up, vel = map(jnp.exp, theta["start"])
        middle = np.append(data.constants["anchors"][:, :2].mean(0), FIRST_HEIGHTS[data.sequence])
        return start(Moving(middle, np.zeros(3)), across, across, up, vel, vel, vel)

    recording = merge(anchored_drone(ANCHORED), data.streams)
    truth = align(recording.t, data.truth["pos"], vector(3), gap=0.5)
    blocks = {"horizontal": ((0, 1), "m"), "height": ((2,), "m")}
    return Replay(anchored_drone, belief, ANCHORED, recording, truth, vector(3), lambda x: x.pos, blocks)
