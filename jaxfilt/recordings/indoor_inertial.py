"""The small drone in a hall as inertial navigation: IMU as input, ranges to anchors, a laser's height, optical flow."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np

from jaxfilt.datasets import Dataset
from jaxfilt.log import align, merge
from jaxfilt.models.inertial import Imu, Navigation, inertial
from jaxfilt.models.parts import start
from jaxfilt.models.sensors import ground_flow, tilt_range
from jaxfilt.noise import const, diagonal
from jaxfilt.recordings.imu import imu_at, imu_input, level
from jaxfilt.recordings.indoor import INDOOR_DRONE, ranges_to_anchors
from jaxfilt.spaces import scalar, vector
from jaxfilt.types import Array, Gaussian, Model, Replay, Sensor, Stream

IMU_LATE = 0.06
"""s by which the stamps of the IMU come late: of the set's README, from the best match with Vicon on all flights."""

LOWEST = 0.1
"""m: the least distance to the ground that optical flow is computed with; on the floor it would divide by zero."""

# Ranges, height and late are those of `INDOOR_DRONE`: a newcomer's. Flow and its scale are rounded from a regression
# against Vicon on all five flights: not held out. The densities are round guesses, far above the data sheet's: single
# readings are logged at 30 to 50 Hz, so that the rotors' vibration is folded into them.
INERTIAL_DRONE = {name: INDOOR_DRONE[name] for name in ("range", "bias", "height", "late")} | {
    "gyro": math.log(0.01),  # (rad/s)/sqrt(Hz)
    "accelerometer": math.log(0.1),  # (m/s^2)/sqrt(Hz)
    "gyro_walk": math.log(1e-4),  # (rad/s)/sqrt(s)
    "accelerometer_walk": math.log(0.01),  # (m/s^2)/sqrt(s)
    "flow": math.log(3.0),  # pixels per log interval
    "flow_scale": math.log(4.0),  # pixels per log interval over rad/s
    # m horizontally, m vertically, m/s, rad of roll and pitch, rad of yaw, rad/s, m/s^2
    "start": tuple(math.log(std) for std in (2.0, 0.1, 0.1, 0.05, 0.1, 0.02, 0.3)),
}
"""``theta`` of `inertial_drone`: natural logarithms, but for bias and late."""


def inertial_drone(theta: dict = INERTIAL_DRONE) -> Model:
    """`inertial` with the sensors of an indoor drone; readings whose stamps are late tell of where it was.

    ``range_k = |pos - late vel - anchor_k| + bias_k``, ``height = (z - late climb) / cos tilt``,
    ``flow = -scale ground_flow(vel, att, gyro - gyro bias, height)``: the picture's axes point against the body's.

    Args:
        theta: as in `inertial`; logarithms of range (8 numbers, m), height (m), flow (pixels per log interval),
            flow_scale (that over rad/s); as they are bias (8 numbers, m) and late (of ranges, of height; s).

    Returns:
        A model on `Navigation` (15 dimensions) with input `Imu` and the sensors "range_1" ... "range_8", () m, their
        context the anchor's place (3,) m; "height", () m; "flow", (2,) pixels per log interval, its context the `Imu`
        of that instant.

    Example: at rest, 2 m up and level.
        >>> import jax.numpy as jnp
        >>> x = Navigation(jnp.array([0, 0, 2.0]), jnp.zeros(3), jnp.array([1.0, 0, 0, 0]), jnp.zeros(3), jnp.zeros(3))
        >>> float(inertial_drone().sensors["height"].h(x, ()))
        2.0
    """

    def height(x: Navigation, c: tuple) -> Array:
        return tilt_range(x.pos[2] - theta["late"][1] * x.vel[2], x.att)

    def flow(x: Navigation, c: Imu) -> Array:
        distance = jnp.maximum(tilt_range(x.pos[2], x.att), LOWEST)
        return -jnp.exp(theta["flow_scale"]) * ground_flow(x.vel, x.att, c.gyro - x.gyro_bias, distance)

    pixels = jnp.exp(theta["flow"])
    sensors = ranges_to_anchors(theta) | {
        "height": Sensor(height, const(diagonal(jnp.exp(theta["height"]))), scalar),
        "flow": Sensor(flow, const(diagonal(pixels, pixels)), vector(2)),
    }
    return inertial(theta, sensors)


def crazyflie_uwb_inertial(data: Dataset) -> Replay:
    """A small drone indoors: IMU, eight ultra-wideband ranges, a laser's height and optical flow.

    It starts at rest on the floor, 2 m (one standard deviation) about the middle of the anchors, level by what its
    accelerometer reads, with a yaw of 0 give or take 0.1 rad: it is held near 0 in all flights, says the set's README.
    The truth is for scoring, but for what was measured with it on all flights: that the IMU's stamps are 0.06 s late,
    the scale of the flow and its noise. A share of the ranges to some anchors is off by metres: robust, or a gate.
    """
    gyro, accelerometer = data.inputs["gyro"], data.inputs["accelerometer"]
    stamps, readings = imu_input(gyro, accelerometer)
    attitude = level(accelerometer[1][:20].mean(0))
    middle = np.append(data.constants["anchors"][:, :2].mean(0), 0.0)

    def belief(theta: dict) -> Gaussian:
        across, up, vel, tilt, yaw, gyro_bias, accelerometer_bias = map(jnp.exp, theta["start"])
        mean = Navigation(middle, np.zeros(3), attitude, np.zeros(3), np.zeros(3))
        biases = *(gyro_bias,) * 3, *(accelerometer_bias,) * 3
        return start(mean, across, across, up, vel, vel, vel, tilt, tilt, yaw, *biases)

    flow = data.streams["flow"]
    seen = Stream(flow.t, flow.z, imu_at(flow.t, (stamps, readings)))
    u = (stamps - IMU_LATE, readings)
    recording = merge(inertial_drone(INERTIAL_DRONE), {**data.streams, "flow": seen}, u=u)
    truth = align(recording.t, data.truth["pos"], vector(3))
    blocks = {"position": ((0, 1, 2), "m")}
    return Replay(inertial_drone, belief, INERTIAL_DRONE, recording, truth, vector(3), lambda x: x.pos, blocks)
