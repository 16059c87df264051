"""A bicycle that passes in front of a lidar and a radar."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np

from jaxfilt.datasets import Dataset
from jaxfilt.log import align, merge
from jaxfilt.models.ctrv import BICYCLIST, Ctrv, Radar, ctrv, velocity
from jaxfilt.models.parts import start
from jaxfilt.spaces import product, vector
from jaxfilt.types import Gaussian, PyTree, Replay, Stream

FIRST_SEEN = BICYCLIST | {
    "start": (math.log(10.0), math.log(10.0), math.log(1.0), math.log(3.0), math.log(0.3)),  # m, m, rad, m/s, rad/s
}
"""`BICYCLIST`, of which nothing is known but that it is near and slow."""


def udacity_ctrv(data: Dataset) -> Replay:
    """A *simulated* bicycle seen by lidar and radar: `ctrv` with the noises handed out with the file; no gate.

    It starts at rest at the origin, give or take 10 m and 3 m/s. It does 5 m/s: the error of the first half second is
    most of the RMSE of the velocity over the whole run, as it is in the course's solutions, which begin alike.
    """

    def belief(theta: PyTree) -> Gaussian:
        return start(Ctrv(np.zeros(2), 0.0, 0.0, 0.0), *map(jnp.exp, theta["start"]))

    radar = data.streams["radar"]
    recording = merge(ctrv(FIRST_SEEN), {"lidar": data.streams["lidar"], "radar": Stream(radar.t, Radar(*radar.z))})
    space = product((vector(2), vector(2)))
    t, pos = data.truth["pos"]
    truth = align(recording.t, (t, (pos, data.truth["vel"][1])), space)
    blocks = {"px": ((0,), "m"), "py": ((1,), "m"), "vx": ((2,), "m/s"), "vy": ((3,), "m/s")}
    return Replay(ctrv, belief, FIRST_SEEN, recording, truth, space, lambda x: (x.pos, velocity(x)), blocks)
