"""Cars with an inertial unit: one with precise fixes far between, one with a phone on the windscreen."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.datasets import Dataset
from jaxfilt.log import align, merge
from jaxfilt.models.inertial import Imu, Navigation, Wander, data_sheet, inertial
from jaxfilt.models.parts import start
from jaxfilt.models.sensors import gnss_position
from jaxfilt.noise import const, diagonal
from jaxfilt.recordings.imu import imu_input, level
from jaxfilt.spaces import product, quaternion_product, rotate_back, scalar, so3, so3_exp, vector
from jaxfilt.types import Array, Gaussian, Model, PyTree, Replay, Sensor, Stream

# The white noises are ten and more times the authors' figures, in place of vibration and of all that the strapdown of
# 10 ms leaves out; the rest is round, and was chosen with the scores of the whole drive in sight.
PASSAT = data_sheet(1e-3, 3e-2, 3e-6, 3e-4) | {
    "gnss": (math.log(0.05), math.log(0.1)),  # m: horizontally, vertically
    "road": (math.log(0.3), math.log(0.3)),  # m/s: sideways, upwards
    # m, m/s, rad of tilt, rad of heading, rad/s, m/s^2
    "start": tuple(map(math.log, (0.1, 1.0, 0.05, 0.1, 0.001, 0.3))),
}
"""``theta`` of a car with a good inertial unit and RTK: natural logarithms."""


def fixed_car(theta: PyTree) -> Model:
    """`inertial` with the sensors "gnss", (3,) m, and "road", (2,) m/s, whose reading is always 0.

    ``road``: the velocity sideways and upwards in the body. A car on its wheels has next to none: a reading that
    nobody makes. Its noise is white and the slip in a turn is not, for which it is set high.

    Args:
        theta: as in `inertial`, and the logarithms of gnss (m: horizontally, vertically) and road (m/s: sideways,
            upwards).

    Source: G. Dissanayake, S. Sukkarieh, E. Nebot, H. Durrant-Whyte, The aiding of a low-cost strapdown inertial
    measurement unit using vehicle model constraints for land vehicle applications (2001), eq. 18.
    """
    across, up = map(jnp.exp, theta["gnss"])
    slip = diagonal(*map(jnp.exp, theta["road"]))
    road = Sensor(lambda x, c: rotate_back(x.att, x.vel)[1:], const(slip), vector(2))
    return inertial(theta, {"gnss": gnss_position(diagonal(across, across, up)), "road": road})


def _beginning(mean: Navigation, theta: PyTree, *extra: Array) -> Gaussian:
    pos, vel, tilt, heading, gyro, force = map(jnp.exp, theta["start"][:6])
    return start(mean, *[pos] * 3, *[vel] * 3, tilt, tilt, heading, *[gyro] * 3, *[force] * 3, *extra)


def _with_rows_at(stamps: np.ndarray, u: tuple[np.ndarray, Imu]) -> tuple[np.ndarray, Imu]:
    """The same input, cut also at these stamps, so that a log has rows there."""
    t = np.union1d(u[0], stamps[stamps >= u[0][0]])
    held = np.searchsorted(u[0], t, side="right") - 1
    return t, jax.tree.map(lambda a: a[held], u[1])


def kitti_imu_gps(data: Dataset, every: int = 5) -> Replay:
    """A car in a town, 8 minutes: IMU at 100 Hz as input, RTK fixes of which the filter gets one in five: one in 5 s.

    There is no truth but the other fixes, by which it is scored; from 150 to 310 s the receiver is not that good
    itself, decimetres that wander and a jump of 4 m. It starts at the second fix (before it the IMU has a gap of 2 s)
    with the course and speed between the fixes around it, the later one of which is withheld; level as its first
    second of accelerometer says, though it is on the way.

    Args:
        data: the recording.
        every: seconds from fix to fix; 10 makes it one outage after the other.
    """
    fixes, (t, gyro) = data.streams["gnss"], data.inputs["gyro"]
    since = t >= fixes.t[1]
    t, gyro, force = t[since], gyro[since], data.inputs["accelerometer"][1][since]
    after = np.arange(1, len(fixes.t))
    given, withheld = after[(after - 1) % every == 0], after[(after - 1) % every > 0]
    streams = {
        "gnss": Stream(fixes.t[given], fixes.z[given]),
        "road": Stream(t[10::10], np.zeros((len(t[10::10]), 2))),
    }
    u = _with_rows_at(fixes.t[withheld], imu_input((t, gyro), (t, force)))
    recording = merge(fixed_car(PASSAT), streams, u=u)
    # The gap masks all rows but those at a withheld fix.
    truth = align(recording.t, (fixes.t[withheld], fixes.z[withheld]), vector(3), gap=0.5)

    vel = (fixes.z[2] - fixes.z[0]) / (fixes.t[2] - fixes.t[0])
    att = level(force[:100].mean(0), float(np.arctan2(vel[1], vel[0])))
    mean = Navigation(fixes.z[1], vel, att, np.zeros(3), np.zeros(3))
    blocks = {"position": ((0, 1), "m"), "height": ((2,), "m")}
    view = _position
    return Replay(fixed_car, lambda theta: _beginning(mean, theta), PASSAT, recording, truth, vector(3), view, blocks)


def _position(x: Navigation) -> Array:
    return x.pos


# Round values for a phone and a consumer's receiver, of which errors are alike for seconds: noises are set high in
# place of a model of that. First guesses, but for late: see there.
HIGHWAY = data_sheet(1e-3, 3e-2, 1e-5, 1e-3) | {
    "gnss": (math.log(1.5), math.log(3.0)),  # m: horizontally, vertically
    "wheels": (math.log(0.1), math.log(0.2), math.log(0.2)),  # m/s: forward, sideways, upwards
    # m, m/s, rad of tilt, rad of heading, rad/s, m/s^2, rad of the mount, of the scale
    "start": tuple(map(math.log, (1.5, 0.5, 0.05, 0.05, 0.003, 0.2, 0.1, 0.02))),
}
"""``theta`` of a car with a phone on its windscreen: natural logarithms."""

HIGHWAY_DELAY = 0.1
"""s by which the receiver's stamps are late: the best match with the truth, and, barely, the largest likelihood."""

FORWARD_RIGHT_DOWN = np.array([0.0, 1.0, 0.0, 0.0])
"""The quaternion (4,) between a body of axes forward, right, down and one of forward, left, up: half a turn about x."""


def phone_car(theta: PyTree) -> Model:
    """`inertial` with "gnss", (3,) m, and "wheels", (3,) m/s: the speed, and 0 sideways and upwards.

    The body is the phone; how it looks along the car, the rotation ``Exp(0, mount)``, is an extra state, as is the
    speedometer's error: ``wheels = diag(1 + scale, 1, 1) Exp(0, mount)' R' vel``.

    Args:
        theta: as in `inertial`, and the logarithms of gnss (m: horizontally, vertically) and wheels (m/s: forward,
            sideways, upwards).

    Source: as `fixed_car`.
    """
    across, up = map(jnp.exp, theta["gnss"])

    def wheels(x: Navigation, c: PyTree) -> Array:
        mount = so3_exp(jnp.concatenate([jnp.zeros(1, x.vel.dtype), x.extra["mount"]]))
        v = rotate_back(mount, rotate_back(x.att, x.vel))
        return jnp.concatenate([(1 + x.extra["scale"]) * v[:1], v[1:]])

    sensors = {
        "gnss": gnss_position(diagonal(across, across, up)),
        "wheels": Sensor(wheels, const(diagonal(*map(jnp.exp, theta["wheels"]))), vector(3)),
    }
    return inertial(theta, sensors, {"mount": Wander(vector(2), 0.0), "scale": Wander(scalar, 0.0)})


def comma2k19(data: Dataset) -> Replay:
    """A car on a highway, a minute: the IMU of a phone as input, a consumer's GNSS at 10 Hz, the car's speed at 10 Hz.

    Readings and truth come with the phone's axes forward, right, down; here they are turned to forward, left, up. The
    receiver's stamps are set back by `HIGHWAY_DELAY`. It starts at the first fix, with the course and speed of its
    first second of fixes, level as the first second of accelerometer says. The truth shares the receiver's raw data.
    """
    flip = np.array([1.0, -1.0, -1.0])
    (t, gyro), (t_force, force) = data.inputs["gyro"], data.inputs["accelerometer"]
    fixes, speed = data.streams["gnss"], data.streams["speed"]
    t_fix = fixes.t - HIGHWAY_DELAY
    there = t_fix >= t[0]
    t_fix, z = t_fix[there], fixes.z[there]
    tenth = slice(8, None, 8)
    streams = {
        "gnss": Stream(t_fix, z),
        "wheels": Stream(speed.t[tenth], speed.z[tenth, None] * np.array([1.0, 0.0, 0.0])),
    }
    recording = merge(phone_car(HIGHWAY), streams, u=imu_input((t, gyro * flip), (t_force, force * flip)))
    space = product((vector(3), vector(3), so3))
    t_truth, att = data.truth["attitude"]
    turned = np.asarray(jax.vmap(quaternion_product, (0, None))(jnp.asarray(att), jnp.asarray(FORWARD_RIGHT_DOWN)))
    truth = align(recording.t, (t_truth, (data.truth["pos"][1], data.truth["vel"][1], turned)), space)

    vel = (z[10] - z[0]) / (t_fix[10] - t_fix[0]) * np.array([1.0, 1.0, 0.0])
    att0 = level((force * flip)[:100].mean(0), float(np.arctan2(vel[1], vel[0])))
    mean = Navigation(z[0], vel, att0, np.zeros(3), np.zeros(3), {"mount": np.zeros(2), "scale": 0.0})

    def belief(theta: PyTree) -> Gaussian:
        mount, scale = map(jnp.exp, theta["start"][6:])
        return _beginning(mean, theta, mount, mount, scale)

    blocks = {
        "position": ((0, 1), "m"),
        "height": ((2,), "m"),
        "velocity": ((3, 4, 5), "m/s"),
        "tilt": ((6, 7), "rad"),
        "heading": ((8,), "rad"),
    }
    return Replay(phone_car, belief, HIGHWAY, recording, truth, space, lambda x: (x.pos, x.vel, x.att), blocks)
