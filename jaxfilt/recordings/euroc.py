"""A hexacopter in a machine hall and in a room: an inertial sensor, and a position or a pose measured from outside."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.datasets import Dataset
from jaxfilt.log import align, merge
from jaxfilt.models.attitude import inclination_and_heading
from jaxfilt.models.inertial import Navigation, Wander, data_sheet, inertial, late
from jaxfilt.models.sensors import gnss_position, mocap_pose
from jaxfilt.noise import diagonal
from jaxfilt.recordings.alignment import about, most_likely
from jaxfilt.recordings.imu import imu_at, imu_input, level
from jaxfilt.spaces import product, quaternion_conjugate, quaternion_product, so3, vector
from jaxfilt.types import Array, Gaussian, Model, PyTree, Recording, Replay, Stream

Blocks = dict[str, tuple[tuple[int, ...], str]]


class Pose(NamedTuple):
    """What the truth of MH_01_easy knows of a `Navigation`."""

    pos: Array
    """(3,) m, world: the place of the IMU."""
    att: Array
    """(4,) quaternion, body to world."""


# Densities of the IMU: 12 and 25 times those of its data sheet, which hold at rest; in flight the rotors shake it. The
# likelihood of the readings of all three flights chose these round numbers from a grid (none was held out) on which
# the inclination stayed below 0.7 degrees throughout: gyroscope 0.0005 to 0.01, accelerometer 0.02 to 0.1. The walk of
# the accelerometer's bias is a third of what the authors give. The Vicon's noise was tripled after a look at
# the ANEES of its flight.
EUROC = {
    **data_sheet(gyro=2e-3, accelerometer=5e-2, gyro_walk=2e-5, accelerometer_walk=1e-3),
    "position": math.log(0.005),  # m, each axis: of the Leica
    "attitude": math.log(0.03),  # rad, each axis: of the Vicon, the only sensor that measures it
    "arm": (0.0, 0.0, 0.0),  # m, no logarithm: the measured point in the body frame; each flight has its own
    "late": 0.0,  # s, no logarithm: by how much the stamps come after the reading
    "start": tuple(map(math.log, (0.15, 0.5, 0.1, 0.1, 0.3, 0.4, 0.05))),
    # m, m/s, rad of tilt, rad/s, m/s^2 of biases, rad of heading, rad of the markers' mount
}
"""``theta`` of `positioned_hexacopter` and `watched_hexacopter`: logarithms, but for arm and late."""

MADE_FIXES = {"every": 20, "std": 0.05, "seed": 0}
"""Of V1_02_medium: every so many samples of the truth (10 Hz), m of white noise in each axis, its seed."""

HEADINGS = 8
"""Starts that are tried where nobody knows the heading."""

PATIENCE = 15.0
"""s of readings by which they are judged: MH_01_easy is shaken by hand meanwhile, V1_02_medium takes off after 5 s."""


def positioned_hexacopter(theta: PyTree) -> Model:
    """`inertial` with the sensor "position", (3,) m, of a point ``theta["arm"]`` in the body, stamped ``late``.

    The context of a reading is the pair (`jaxfilt.models.inertial.Imu` over the interval that ends there, ()).
    """
    std = jnp.exp(theta["position"])
    point = gnss_position(diagonal(std, std, std), arm=theta["arm"])
    return inertial(theta, {"position": late(point, theta["late"])})


def watched_hexacopter(theta: PyTree) -> Model:
    """`inertial` with the sensor "pose" of markers on it, (position (3,) m, attitude (4,)), and their mount.

    The turn from the markers' frame to the body is that of the calibration and ``Exp(x.extra["mount"])``, a constant
    (3,) rad that is estimated. Context as in `positioned_hexacopter`.
    """
    p, a = jnp.exp(theta["position"]), jnp.exp(theta["attitude"])

    def turn(x: Navigation) -> Array:
        return so3.plus(jnp.asarray(VICON_TURN, x.att.dtype), x.extra["mount"])

    markers = mocap_pose(diagonal(p, p, p, a, a, a), arm=theta["arm"], turn=turn)
    return inertial(theta, {"pose": late(markers, theta["late"])}, {"mount": Wander(vector(3), 0.0)})


VICON_TURN = (-0.00143026, 0.81742771, -0.01170402, 0.5759105)
"""Vicon body to body, as the authors calibrated it. It is 3.6 degrees off what the flight says."""


def euroc_mav(data: Dataset) -> Replay:
    """A hexacopter with a 200 Hz IMU as input, from the first row of a recording to its last; scored on attitude too.

    - MH_01_easy: the position of a prism by a Leica, 20 Hz, and nothing else. It starts level by the mean of the first
      second of the accelerometer (a hand shakes it meanwhile), with the heading, of `HEADINGS` all around, that makes
      the first `PATIENCE` seconds of readings most likely: a filter online would know it that much later.
    - V1_02_medium: no sensor from outside; positions are *made from the truth*, `MADE_FIXES`. Starts likewise.
    - V2_03_difficult: the pose of markers by a Vicon, 100 Hz. It starts with the attitude of the first reading. The
      authors' calibration of the markers' mount is 3.6 degrees off, so the mount is three more states.

    Clock offsets are taken off the stamps by the reader of the set. The truth is the authors' batch estimate, over IMU
    and the same Leica or Vicon: it is not independent of what the filter hears, so errors in position say little, and
    an ANEES below 1 is to be expected where the truth errs as the filter does. For MH_01_easy it knows pose only.
    """
    imu = imu_input(data.inputs["gyro"], data.inputs["accelerometer"])
    name, stream = _outside(data)
    heard = (stream.t >= imu[0][0]) & (stream.t <= data.inputs["gyro"][0][-1])
    t, z = stream.t[heard], jax.tree.map(lambda a: a[heard], stream.z)
    theta = EUROC | {"arm": tuple(map(float, data.constants.get("lever_arm", np.zeros(3))))}
    theta |= {"position": math.log(_STD[data.sequence])}
    model = watched_hexacopter if name == "pose" else positioned_hexacopter
    recording = merge(model(theta), {name: Stream(t, z, (imu_at(t, imu), ()))}, imu)

    if name == "pose":
        pos, att = z[0][0], np.asarray(_unturned(z[1][0]))
    else:
        pos, att = z[0], _headed(recording, theta, z[0], imu[1].accelerometer[imu[0] < imu[0][0] + 1.0].mean(0))

    def belief(theta: PyTree) -> Gaussian:
        *stds, yaw, mount = map(jnp.exp, theta["start"])
        return about(pos, att, stds, yaw, {"mount": jnp.stack([mount] * 3)} if name == "pose" else None)

    known = {quantity: values for quantity, (_, values) in data.truth.items()}
    blocks: Blocks = {"position": ((0, 1, 2), "m")}
    if "vel" in known:
        point = Navigation(*(known[_QUANTITY.get(field, field)] for field in Navigation._fields[:5]))
        space = product(Navigation(vector(3), vector(3), inclination_and_heading, vector(3), vector(3), ()))
        blocks |= {"velocity": ((3, 4, 5), "m/s"), "inclination": ((6, 7), "rad"), "heading": ((8,), "rad")}
        blocks |= {"gyro_bias": ((9, 10, 11), "rad/s"), "accelerometer_bias": ((12, 13, 14), "m/s^2")}
    else:
        point = Pose(known["pos"], known["attitude"])
        space = product(Pose(vector(3), inclination_and_heading))
        blocks |= {"inclination": ((3, 4), "rad"), "heading": ((5,), "rad")}
    truth = align(recording.t, (data.truth["pos"][0], point), space)
    view = _estimate if "vel" in known else _pose
    return Replay(model, belief, theta, recording, truth, space, view, blocks)


_STD = {"MH_01_easy": 0.005, "V1_02_medium": MADE_FIXES["std"], "V2_03_difficult": 0.03}
"""m: what the Leica repeats to, what we made, and twice what the Vicon errs: its errors last, and are not white."""

_QUANTITY = {"att": "attitude"}


def _estimate(x: Navigation) -> Navigation:
    return x._replace(extra=())


def _pose(x: Navigation) -> Pose:
    return Pose(x.pos, x.att)


def _outside(data: Dataset) -> tuple[str, Stream]:
    """What measures it from outside: the sensor's name, and its readings or those made from the truth."""
    if "vicon" in data.streams:
        return "pose", data.streams["vicon"]
    if "leica" in data.streams:
        return "position", data.streams["leica"]
    t, pos = (a[:: MADE_FIXES["every"]] for a in data.truth["pos"])
    noise = np.random.default_rng(MADE_FIXES["seed"]).normal(0.0, MADE_FIXES["std"], pos.shape)
    return "position", Stream(t, pos + noise)


def _unturned(att: np.ndarray) -> Array:
    """The body's attitude by that of the markers."""
    return quaternion_product(jnp.asarray(att), quaternion_conjugate(jnp.asarray(VICON_TURN, jnp.asarray(att).dtype)))


def _headed(recording: Recording, theta: PyTree, pos: np.ndarray, force: np.ndarray) -> np.ndarray:
    """The attitude at the start, with the heading that explains the first readings best."""
    *stds, yaw, _ = (jnp.exp(jnp.asarray(a)) for a in theta["start"])
    ways = [level(force, k * 2 * math.pi / HEADINGS) for k in range(HEADINGS)]
    rows = int(np.searchsorted(recording.t, recording.t[0] + PATIENCE))
    first = jax.tree.map(lambda a: a[:rows], recording.log)
    return ways[most_likely(positioned_hexacopter(theta), [about(pos, way, stds, yaw) for way in ways], first)]
