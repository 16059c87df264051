"""A recorded drive with its map taken away: what a robot finds out that must draw it.

Parameters ``theta`` are natural logarithms of standard deviations.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxfilt.datasets import Dataset
from jaxfilt.log import align, merge
from jaxfilt.models.parts import start
from jaxfilt.models.slam import World, with_landmarks
from jaxfilt.models.wheeled import Odometry, Pose
from jaxfilt.recordings.wheels import CREATE_ROBOT, POSE, POSE_BLOCKS, TRUTH_GAP, Rolling, sighting_robot
from jaxfilt.types import Array, Gaussian, Model, PyTree, Replay, Stream


class Hidden(NamedTuple):
    """A replay on a `World`, and the map that the robot is not told: ``places`` (N, 2) m, for scoring alone."""

    replay: Replay
    places: np.ndarray


UNKNOWN = 100.0
"""m: standard deviation of a landmark's coordinates before it is seen; the filters of `jaxfilt.slam` do not use it."""

GATE = 0.999
"""The gate that goes with it: a few barcodes are misread."""


def utias_mrclam(data: Dataset, theta: PyTree = CREATE_ROBOT) -> Hidden:
    """A robot among 15 landmarks whose places nobody tells it: by their barcodes it knows them apart, not more.

    As `jaxfilt.recordings.wheels.utias_mrclam` but for the map; the same noises, of which none was tuned for this. It
    starts at its true pose, which says no more than in which frame the map is drawn.

    Args:
        data: ``jaxfilt.datasets.load("utias_mrclam", sequence)``.
        theta: as in `sighting_robot`.

    Returns:
        Hidden(replay, places): the context of the sensor "landmark" is a number, 0 to 14, the row of ``places``.
    """
    numbers = sorted(data.constants["landmarks"])
    places = np.array([data.constants["landmarks"][k] for k in numbers])
    seen = data.streams["landmark"]
    which = np.argmin(np.abs(np.asarray(seen.c)[:, None] - places[None]).sum(-1), axis=1).astype(np.int32)
    t, odometry = data.inputs["odometry"]
    streams = {"landmark": Stream(seen.t, seen.z, which)}
    recording = merge(mapping_robot(theta), streams, u=(t, Odometry(odometry[:, 0], odometry[:, 1])))
    stamps, pos = data.truth["pos"]
    truth = align(recording.t, (stamps, Pose(pos, data.truth["yaw"][1])), POSE, gap=TRUTH_GAP)
    first = Pose(truth.x.pos[0], truth.x.yaw[0])

    def belief(theta: PyTree) -> Gaussian:
        return mapping_start(theta, first)

    return Hidden(Replay(mapping_robot, belief, theta, recording, truth, POSE, _pose, POSE_BLOCKS), places)


def mapping_robot(theta: PyTree = CREATE_ROBOT, landmarks: int = 15) -> Model:
    """`jaxfilt.recordings.wheels.sighting_robot` with its landmarks in the state: a model on `World` of a `Rolling`."""
    return with_landmarks(sighting_robot(theta), landmarks)


def mapping_start(theta: PyTree, pose: Pose, landmarks: int = 15) -> Gaussian:
    """At this pose, with the standard deviations ``theta["start"]``; of the landmarks nothing is known."""
    pos_std, yaw_std, scale_std = map(jnp.exp, theta["start"])
    mean = World(Rolling(pose.pos, pose.yaw, np.ones(2)), np.zeros((landmarks, 2)))
    unknown = jnp.full(2 * landmarks, UNKNOWN, pos_std.dtype)
    return start(mean, pos_std, pos_std, yaw_std, scale_std, scale_std, unknown)


def known_map(hidden: Hidden, theta: PyTree = CREATE_ROBOT) -> tuple[Gaussian, Array]:
    """The start of a robot that is told the map, and that all of it counts as seen: a `jaxfilt.slam.Chart` of both is
    localisation, the best that a map can do."""
    belief = hidden.replay.belief(theta)
    r = belief.cov.shape[0] - 2 * len(hidden.places)
    mean = belief.mean._replace(landmarks=jnp.asarray(hidden.places, belief.cov.dtype))
    return Gaussian(mean, belief.cov.at[r:, r:].set(0.0)), np.ones(len(hidden.places), bool)


def _pose(x: World) -> Pose:
    return Pose(x.robot.pos, x.robot.yaw)
