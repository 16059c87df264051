"""A board with inertial and magnetic sensors, turned by hand."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.datasets import Dataset
from jaxfilt.log import align, merge
from jaxfilt.models.attitude import ERRORS, attitude, attitude_start, field, inclination_and_heading
from jaxfilt.recordings.imu import level
from jaxfilt.spaces import quaternion_product, rotate, so3_exp
from jaxfilt.types import Array, Gaussian, Model, PyTree, Replay

REST = 10.0
"""s at the beginning in which the board surely lies still."""

BEGIN = 1.0
"""s whose mean readings tell the first attitude."""

GAP = 0.02
"""s between two samples of the truth, 3.5 ms apart elsewhere, from which on there is no truth between them."""

GRAVITY = 9.813
"""m/s^2 in Berlin."""

# Chosen on the trial 21_undisturbed_fast_combined, the best of 40 at random by its total error, rounded; of the other
# trial only the field, which both have, and which the board at rest reads. White noises stand for what is not white:
# the accelerometer's for what a hand accelerates over a second, the magnetometer's for iron in the floor, the
# gyroscope's, 70 times that at rest, for its scale.
BOARD = {
    "gyro": math.log(7e-3),  # (rad/s)/sqrt(Hz)
    "gyro_walk": math.log(5e-6),  # (rad/s)/sqrt(s)
    "accelerometer": math.log(17.0),  # m/s^2, each reading at 286 Hz
    "magnetometer": math.log(57.0),  # uT, likewise
    "field": (43.8, math.radians(69.1), 0.0),  # uT, rad, rad; no logarithms
    "start": (math.log(math.radians(1.0)), math.log(math.radians(1.0)), math.log(math.radians(0.5))),
}
"""``theta`` of `board`."""


def board(theta: PyTree = BOARD) -> Model:
    """`jaxfilt.models.attitude.attitude` where the recordings were made."""
    return attitude(theta, GRAVITY)


def broad(data: Dataset) -> Replay:
    """A board turned by hand: attitude and gyroscope bias, scored where the authors score, in motion.

    The gyroscope's reading is that of the interval that ends at its stamp. It starts as accelerometer and magnetometer
    tell in the first second, at rest, its bias unknown to 0.5 deg/s. The world's y is magnetic north. The truth's z is
    up, its heading has an origin of its own: the truth is turned about z by one angle, so that its mean heading over
    the first 10 s, at rest, is that of the mean accelerometer and magnetometer readings there. Nothing else of it is
    used but for scoring. The space of the errors is `jaxfilt.models.attitude.inclination_and_heading`.
    """
    force, magnetic = data.streams["accelerometer"], data.streams["magnetometer"]
    north = np.asarray(field(BOARD))

    def at_rest(until: float) -> np.ndarray:
        return pointed(force.z[force.t < until].mean(0), magnetic.z[magnetic.t < until].mean(0), north)

    first = at_rest(BEGIN)

    def belief(theta: PyTree) -> Gaussian:
        return attitude_start(theta, first)

    t, gyro = data.inputs["gyro"]
    streams = {"accelerometer": force, "magnetometer": magnetic}
    recording = merge(board(BOARD), streams, (t[:-1], gyro[1:]))
    stamps, true = data.truth["attitude"]
    turn = _offset(at_rest(REST), true[stamps < REST])
    turned = np.asarray(jax.jit(jax.vmap(lambda q: quaternion_product(turn, q)))(jnp.asarray(true)))
    truth = align(recording.t, (stamps, turned), inclination_and_heading, gap=GAP)
    moving = np.interp(recording.t, *data.truth["moving"]) > 0.5
    truth = truth._replace(mask=truth.mask & moving)
    return Replay(board, belief, BOARD, recording, truth, inclination_and_heading, lambda x: x.att, ERRORS)


def pointed(force: np.ndarray, magnetic: np.ndarray, north: np.ndarray) -> np.ndarray:
    """The attitude (4,) at rest of a body that reads this specific force (3,) and this magnetic field (3,), turned so
    that the horizontal part of the field points to where that of the world's, ``north`` (3,), does.

    Example: level, and what is magnetic north is to the left: the nose is in the east.
        >>> import numpy as np
        >>> q = pointed(np.array([0.0, 0.0, 9.81]), np.array([0.0, 20.0, -40.0]), np.array([0.0, 1.0, 0.0]))
        >>> [round(float(a), 4) + 0.0 for a in q]
        [1.0, 0.0, 0.0, 0.0]
    """
    seen = np.asarray(rotate(jnp.asarray(level(force)), jnp.asarray(magnetic)))
    return level(force, np.arctan2(north[1], north[0]) - np.arctan2(seen[1], seen[0]))


def _offset(att: np.ndarray, true: np.ndarray) -> Array:
    """The turn (4,) about z that brings the mean heading of these attitudes (K, 4) to that of one (4,)."""
    one = jnp.asarray(att)
    headings = np.asarray(jax.vmap(lambda q: inclination_and_heading.minus(one, q)[2])(jnp.asarray(true)))
    mean = np.arctan2(np.sin(headings).mean(), np.cos(headings).mean())
    return so3_exp(jnp.asarray([0.0, 0.0, mean]))
