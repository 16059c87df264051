"""A small drone in a hall, located by its distances to radio anchors and to the floor."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxfilt.datasets import Dataset
from jaxfilt.log import align, merge
from jaxfilt.models.parts import start, white_acceleration
from jaxfilt.models.sensors import range_to
from jaxfilt.noise import const, diagonal
from jaxfilt.spaces import product, scalar, vector
from jaxfilt.types import Array, Gaussian, Model, PyTree, Replay, Sensor

ANCHORS = 8


class Moving(NamedTuple):
    """A point that moves: the state of `ranging_drone`."""

    pos: Array
    """(3,) m, world, z up, the floor at 0."""
    vel: Array
    """(3,) m/s."""


# What a newcomer would write down: one noise for all anchors, three times the 0.1 m that such radios are sold with, and
# no bias. Nothing here was fitted to the flights; `jaxfilt.tune` finds better: ``python -m benchmarks.tuning``.
INDOOR_DRONE = {
    "acceleration": (math.log(1.0), math.log(1.0)),  # (m/s)/sqrt(s): each horizontal axis, the vertical one
    "range": (math.log(0.3),) * ANCHORS,  # m
    "bias": (0.0,) * ANCHORS,  # m, no logarithm
    "height": math.log(0.05),  # m
    "late": (0.0, 0.0),  # s, no logarithm: by how much the stamps of ranges and height come after the reading
    "start": (math.log(2.0), math.log(0.1), math.log(0.1)),  # m horizontally, m vertically, m/s
}
"""``theta`` of `ranging_drone`: natural logarithms, but for bias and late."""


def ranging_drone(theta: PyTree = INDOOR_DRONE) -> Model:
    """A point with white acceleration, ranged from eight anchors, each with a noise and a bias of its own.

    ``range_k = |pos - late vel - anchor_k| + bias_k``, ``height = z - late climb``: a reading whose stamp is late tells
    of where the drone was. The acceleration is white, of one density along each horizontal axis and another upwards.

    Args:
        theta: logarithms of acceleration (horizontal, vertical; (m/s)/sqrt(s)), range (8 numbers, m), height (m); as
            they are bias (8 numbers, m) and late (of the ranges, of the height; s).

    Returns:
        A model on `Moving` (6 dimensions), no input, with the sensors "range_1" ... "range_8", () m, their context the
        anchor's place (3,) m, and "height", () m, a laser's distance to the floor.

    Example:
        >>> import jax.numpy as jnp
        >>> x = Moving(jnp.array([3.0, 4.0, 1.5]), jnp.zeros(3))
        >>> model = ranging_drone()
        >>> float(model.sensors["range_8"].h(x, jnp.array([0.0, 0.0, 1.5]))), float(model.sensors["height"].h(x, ()))
        (5.0, 1.5)
    """
    late = theta["late"][1]

    height = Sensor(lambda x, c: x.pos[2] - late * x.vel[2], const(diagonal(jnp.exp(theta["height"]))), scalar)
    return moving(theta, {**ranges_to_anchors(theta), "height": height})


def moving(theta: PyTree, sensors: dict[str, Sensor]) -> Model:
    """A point with white acceleration of one density along each horizontal axis and another upwards, on `Moving`.

    Args:
        theta: logarithms of acceleration (horizontal, vertical; (m/s)/sqrt(s)).
        sensors: whatever measures it.
    """
    horizontal, vertical = map(jnp.exp, theta["acceleration"])

    def f(x: Moving, u: PyTree, dt: Array) -> Moving:
        return Moving(x.pos + dt * x.vel, x.vel)

    def Q(x: Moving, u: PyTree, dt: Array) -> Array:
        return jnp.kron(white_acceleration(dt), diagonal(horizontal, horizontal, vertical))

    return Model(f, Q, product(Moving(vector(3), vector(3))), sensors)


def ranges_to_anchors(theta: PyTree) -> dict[str, Sensor]:
    """The sensors "range_1" ... "range_8" of a state with fields pos and vel, and of a theta as `ranging_drone`'s."""

    def anchor(k: int) -> Sensor:
        bias, late = theta["bias"][k], theta["late"][0]
        noise = const(diagonal(jnp.exp(theta["range"][k])))
        return Sensor(lambda x, c: range_to(x.pos - late * x.vel, c, bias), noise, scalar)

    return {f"range_{k + 1}": anchor(k) for k in range(ANCHORS)}


def crazyflie_uwb(data: Dataset) -> Replay:
    """A small drone indoors: eight ultra-wideband ranges and a laser's height, of which the stamps are late.

    It starts at rest on the floor, 2 m (one standard deviation) about the middle of the anchors: the truth is for
    scoring only. A share of the ranges to some anchors is off by metres: a gate. Accelerometer, gyroscope and optical
    flow of the set are not used.
    """

    def belief(theta: PyTree) -> Gaussian:
        across, up, vel = map(jnp.exp, theta["start"])
        middle = np.append(data.constants["anchors"][:, :2].mean(0), 0.0)
        return start(Moving(middle, np.zeros(3)), across, across, up, vel, vel, vel)

    streams = {name: stream for name, stream in data.streams.items() if name != "flow"}
    recording = merge(ranging_drone(INDOOR_DRONE), streams)
    truth = align(recording.t, data.truth["pos"], vector(3))
    blocks = {"position": ((0, 1, 2), "m")}
    return Replay(ranging_drone, belief, INDOOR_DRONE, recording, truth, vector(3), lambda x: x.pos, blocks)
