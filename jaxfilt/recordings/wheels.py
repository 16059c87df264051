"""Robots and cars on wheels whose odometry is a few percent off, which the filter finds out on the way.

Parameters ``theta`` are natural logarithms of standard deviations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.datasets import Dataset
from jaxfilt.elementary import norm
from jaxfilt.log import align, merge
from jaxfilt.models.parts import arc, start
from jaxfilt.models.sensors import range_bearing
from jaxfilt.models.wheeled import Odometry, Pose
from jaxfilt.noise import const, diagonal
from jaxfilt.spaces import angle, product, scalar, vector
from jaxfilt.types import Array, Gaussian, Model, PyTree, Replay, Sensor, Stream


class Rolling(NamedTuple):
    """A robot on wheels and the scale of its odometry: the state of `rolling`."""

    pos: Array
    """(2,) m, world: the middle of the driven axle."""
    yaw: Array
    """() rad."""
    scale: Array
    """(2,) true over reported: speed, turn rate."""


def rolling(theta: PyTree, sensors: dict[str, Sensor]) -> Model:
    """Unicycle with odometry as input and the scale of that odometry as state.

    ``pos`` rolls ``scale[0] speed dt`` along an arc of ``scale[1] rate dt``. ``Q = dt (diag(slip^2, slip^2,
    turn^2 + (spin rate)^2, drift^2, drift^2) + (along speed)^2 n n')`` with n forward.

    Args:
        theta: logarithms of slip (m/sqrt(s)), along (1/sqrt(Hz), of the speed), turn (rad/sqrt(s)), spin (1/sqrt(Hz),
            of the turn rate), drift (1/sqrt(s), of the scale).
        sensors: whatever measures it.

    Returns:
        A model on `Rolling` (5 dimensions) with input `Odometry`.

    Example: an odometer that reads double.
        >>> import jax.numpy as jnp
        >>> x = Rolling(jnp.zeros(2), jnp.asarray(0.0), jnp.array([0.5, 1.0]))
        >>> rolling(WIFIBOT, {}).f(x, Odometry(2.0, 0.0), 3.0).pos.tolist()
        [3.0, 0.0]

    Source: Thrun, Burgard, Fox, Probabilistic Robotics (2005), eqs. 5.9 and 5.10, with scale factors as states.
    """
    std = {name: jnp.exp(theta[name]) for name in ("slip", "along", "turn", "spin", "drift")}

    def f(x: Rolling, u: Odometry, dt: Array) -> Rolling:
        return Rolling(*arc(x.pos, x.yaw, x.scale[0] * u.speed * dt, x.scale[1] * u.rate * dt), x.scale)

    def Q(x: Rolling, u: Odometry, dt: Array) -> Array:
        along = std["along"] * u.speed * jnp.concatenate([forward(x.yaw), jnp.zeros(3, x.pos.dtype)])
        turn = jnp.sqrt(std["turn"] ** 2 + (std["spin"] * u.rate) ** 2)
        spread = diagonal(std["slip"], std["slip"], turn, std["drift"], std["drift"])
        return dt * (spread + along[:, None] * along[None, :])

    return Model(f, Q, product(Rolling(vector(2), angle, vector(2))), sensors)


def forward(yaw: Array) -> jax.Array:
    """The unit vector (2,) in the direction of a yaw, rad."""
    return jnp.stack([jnp.cos(yaw), jnp.sin(yaw)])


POSE = product(Pose(vector(2), angle))
POSE_BLOCKS = {"position": ((0, 1), "m"), "yaw": ((2,), "rad")}

TRUTH_GAP = 0.5
"""s: between truth samples further apart nothing is scored."""


def _replay(
    model: Callable[[PyTree], Model],
    theta: PyTree,
    data: Dataset,
    streams: dict[str, Stream],
    u: tuple[np.ndarray, Odometry],
    arm: float = 0.0,
) -> Replay:
    """A replay that starts at the true pose; the truth is that of a point ``arm`` m before the axle."""
    recording = merge(model(theta), streams, u=u)
    t, pos = data.truth["pos"]
    truth = align(recording.t, (t, Pose(pos, data.truth["yaw"][1])), POSE, gap=TRUTH_GAP)
    tracked, yaw = truth.x.pos[0], truth.x.yaw[0]
    axle = tracked - arm * np.array([np.cos(yaw), np.sin(yaw)])

    def belief(theta: PyTree) -> Gaussian:
        pos_std, yaw_std, scale_std = map(jnp.exp, theta["start"])
        return start(Rolling(axle, yaw, np.ones(2)), pos_std, pos_std, yaw_std, scale_std, scale_std)

    def view(x: Rolling) -> Pose:
        return Pose(x.pos + arm * forward(x.yaw), x.yaw)

    return Replay(model, belief, theta, recording, truth, POSE, view, POSE_BLOCKS)


# One set of round values for all five robots, chosen on this very recording: there is no other of its kind here. A
# sighting errs by 5 % of its range and by 0.01 rad, but the next sighting of the same barcode errs alike; both are
# doubled and more in place of a model of that.
CREATE_ROBOT = {
    "slip": math.log(0.01),  # m/sqrt(s)
    "along": math.log(0.05),  # 1/sqrt(Hz), of the speed
    "turn": math.log(0.03),  # rad/sqrt(s)
    "spin": math.log(0.2),  # 1/sqrt(Hz), of the turn rate, which is commanded, not measured
    "drift": math.log(0.001),  # 1/sqrt(s)
    "range": math.log(0.05),  # m
    "range_share": math.log(0.1),  # of the range
    "bearing": math.log(0.05),  # rad
    "start": (math.log(0.02), math.log(0.02), math.log(0.1)),  # m, rad, of the scale
}


def sighting_robot(theta: PyTree) -> Model:
    """`rolling` with the sensor "landmark": range (m) and bearing (rad) to the point ``c`` (2,), m, world.

    Args:
        theta: as in `rolling`, and the logarithms of range (m), range_share (of the range), bearing (rad).
    """
    std = {name: jnp.exp(theta[name]) for name in ("range", "range_share", "bearing")}

    def R(x: Rolling, c: Array) -> Array:
        far = std["range_share"] * norm(c - x.pos)
        return diagonal(jnp.sqrt(std["range"] ** 2 + far**2), std["bearing"])

    landmark = Sensor(lambda x, c: range_bearing(x.pos, x.yaw, c), R, product((scalar, angle)))
    return rolling(theta, {"landmark": landmark})


def utias_mrclam(data: Dataset) -> Replay:
    """A robot among 15 known landmarks, told apart by their barcodes; a gate for misread ones.

    Input: the commanded speed, 10-14 % too high, and turn rate, 3-6 % too high. Sightings of other robots are left out:
    each robot is on its own. It starts at its true pose. `batch` makes the five robots one batch.
    """
    t, odometry = data.inputs["odometry"]
    u = (t, Odometry(odometry[:, 0], odometry[:, 1]))
    return _replay(sighting_robot, CREATE_ROBOT, data, {"landmark": data.streams["landmark"]}, u)


class Fixes(NamedTuple):
    """Position fixes that nobody measured: the truth every so many seconds, plus white noise of a fixed seed."""

    every: float
    """s."""
    std: float
    """m, each component."""
    seed: int


def made_fixes(data: Dataset, fixes: Fixes) -> Stream:
    """The stream of such fixes, (2,) m, the first after one interval."""
    t, pos = data.truth["pos"]
    rows = np.searchsorted(t, np.arange(t[0] + fixes.every, t[-1], fixes.every))
    noise = np.random.default_rng(fixes.seed).normal(0.0, fixes.std, (len(rows), 2))
    return Stream(t[rows], pos[rows] + noise)


def positioned(theta: PyTree, arm: float) -> Model:
    """`rolling` with the sensor "position", (2,) m, of a point ``arm`` m before the axle.

    Args:
        theta: as in `rolling`, and the logarithm of position (m).
        arm: m.
    """
    std = jnp.exp(theta["position"])
    position = Sensor(lambda x, c: x.pos + arm * forward(x.yaw), const(diagonal(std, std)), vector(2))
    return rolling(theta, {"position": position})


# Round first guesses, kept after a look at all three runs: none was held out.
WIFIBOT = {
    "slip": math.log(0.01),  # m/sqrt(s)
    "along": math.log(0.05),  # 1/sqrt(Hz), of the speed
    "turn": math.log(0.02),  # rad/sqrt(s)
    "spin": math.log(0.1),  # 1/sqrt(Hz), of the turn rate
    "drift": math.log(0.002),  # 1/sqrt(s)
    "position": math.log(0.1),  # m: we made that noise
    "start": (math.log(0.05), math.log(0.05), math.log(0.1)),  # m, rad, of the scale
}

WIFIBOT_FIXES = Fixes(every=0.5, std=0.1, seed=0)
"""As in the example of the recording's authors; the seed is ours."""


def small_robot(theta: PyTree) -> Model:
    """`positioned` with the tracked point on the axle."""
    return positioned(theta, 0.0)


def wifibot(data: Dataset) -> Replay:
    """A small robot with real odometry at 50 Hz, 4-5 % too high, and fixes *made from the truth*: `WIFIBOT_FIXES`.

    It starts at its true pose.
    """
    t, odometry = data.inputs["odometry"]
    u = (t, Odometry(odometry[:, 0], odometry[:, 2]))
    return _replay(small_robot, WIFIBOT, data, {"position": made_fixes(data, WIFIBOT_FIXES)}, u)


# Round first guesses, kept after a look at all three drives, on which delay and arm were measured: none was held out.
DART = {
    "slip": math.log(0.03),  # m/sqrt(s)
    "along": math.log(0.05),  # 1/sqrt(Hz), of the speed
    "turn": math.log(0.02),  # rad/sqrt(s)
    "spin": math.log(0.05),  # 1/sqrt(Hz), of the turn rate
    "drift": math.log(0.002),  # 1/sqrt(s)
    "position": math.log(0.05),  # m: we made that noise
    "start": (math.log(0.05), math.log(0.05), math.log(0.1)),  # m, rad, of the scale
}

DART_FIXES = Fixes(every=0.5, std=0.05, seed=0)
"""An indoor beacon system at its best."""

DART_DELAY = 0.1
"""s by which encoder and gyroscope are late: their best match with the motion capture on the three drives."""

DART_ARM = 0.11
"""m from the rear axle forward to the tracked point: its sideways speed is 0.10 to 0.12 times the turn rate."""


def model_car(theta: PyTree) -> Model:
    """`positioned` with the tracked point `DART_ARM` before the rear axle."""
    return positioned(theta, DART_ARM)


def dart_car(data: Dataset) -> Replay:
    """A 1/10 car with wheel encoder and gyroscope, 10 Hz, as input, and fixes *made from the truth*: `DART_FIXES`.

    The input's stamps are set back by `DART_DELAY`; a filter online would run that much behind. It starts at its true
    pose, with the first reading. Throttle and steering are not used.
    """
    speed, rate = data.streams["speed"], data.streams["turn_rate"]
    t = speed.t - DART_DELAY
    fixes = made_fixes(data, DART_FIXES)
    since = fixes.t > t[0]
    streams = {"position": Stream(fixes.t[since], fixes.z[since])}
    return _replay(model_car, DART, data, streams, (t, Odometry(speed.z, rate.z)), DART_ARM)
