"""Simulated flights by inertial navigation: every sensor of a small multirotor, or GNSS, compass and barometer alone.

What a scenario simulates is what `jaxfilt.models.inertial.inertial` says: the IMU's reading is the input, made from the
true state so that the vehicle follows its path, the true biases included; what the IMU gets wrong beside them moves the
truth away from the reading, as white noise of the density in theta.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.elementary import norm, wrap
from jaxfilt.log import schedule
from jaxfilt.models import sensors as kinds
from jaxfilt.models.control import GRAVITY, Reference
from jaxfilt.models.inertial import Imu, Navigation, Wander, data_sheet, inertial, late, remembered
from jaxfilt.models.parts import start
from jaxfilt.noise import const, diagonal
from jaxfilt.spaces import product, rotate, rotate_back, scalar, so3, vector
from jaxfilt.types import Gaussian, Log, Model, PyTree, Scenario, Sensor

DT = 0.01
"""s: an IMU at 100 Hz."""

BEACONS = ((6.0, 6.0, 0.3), (-6.0, 6.0, 3.0), (-6.0, -6.0, 0.3), (6.0, -6.0, 3.0))
"""m, world: of the radio beacons."""

LANDMARK = (8.0, 1.0, 1.5)
"""m, world: what the camera knows."""

FIELD = kinds.earth_field(math.radians(4.0), math.radians(66.0), 49e-6)
"""T, world: the earth's magnetic field in the middle of Europe."""

ALOFT = data_sheet(1e-3, 0.02, 5e-5, 1e-3)
"""A MEMS IMU among spinning rotors: several times the noise of its data sheet."""

GNSS_FLIGHT: dict[str, Any] = ALOFT | {
    "gnss": (math.log(0.5), math.log(0.5), math.log(1.0)),  # m: a consumer's receiver in the open, bias left out
    "doppler": math.log(0.1),  # m/s
    "barometer": math.log(0.15),  # m
    "drift": math.log(0.05),  # m/sqrt(s): weather and warmth
    "magnetometer": math.log(1e-6),  # T
    "arm": (0.1, -0.05, 0.15),  # m, body: the antenna; no logarithm
    "late": 0.0,  # s by which the receiver's stamps are late; no logarithm
    "start": (math.log(0.3), math.log(0.1), math.log(0.03), math.log(0.01), math.log(0.1), math.log(1.0)),
}
"""``theta`` of `gnss_flight`: logarithms of standard deviations and densities, but for the arm (m) and lateness (s).

``start``: m, m/s, rad, rad/s, m/s^2, and m of the barometer's drift.
"""

FLIGHT: dict[str, Any] = GNSS_FLIGHT | {
    "finder": math.log(0.03),  # m
    "flow": math.log(0.1),  # rad/s
    "range": math.log(0.1),  # m: ultra-wideband radio
    "bias": (math.log(0.002), math.log(0.2)),  # m/sqrt(s), m: how a beacon's bias wanders, how large it is
    "camera": math.log(0.005),  # of the focal length
    "start": (math.log(0.1), math.log(0.1), math.log(0.03), math.log(0.01), math.log(0.1), math.log(1.0)),
}
"""``theta`` of `flight`: that of `GNSS_FLIGHT` and its own; ``bias``: m/sqrt(s), m."""


def gnss_flight(theta: PyTree = GNSS_FLIGHT) -> Model:
    """Inertial navigation by GNSS with a lever arm, magnetometer and barometer.

    Args:
        theta: see `GNSS_FLIGHT`.

    Returns:
        A model on `Navigation` that remembers the last reading, with the barometer's "drift" () m in extra (16
        dimensions), input `Imu`, sensors "gnss" (position and velocity of the antenna, (3,) m and (3,) m/s),
        "magnetometer", "barometer".
    """
    return inertial(theta, _outdoors(theta), {"drift": _drift(theta)}, remember=True)


def flight(theta: PyTree = FLIGHT) -> Model:
    """Inertial navigation by all that a small multirotor can carry.

    Args:
        theta: see `FLIGHT`.

    Returns:
        A model as `gnss_flight` with the biases of four beacons in extra, "beacons" (4,) m (20 dimensions), and, beside
        its sensors, "finder" (downward range), "flow" (optical flow), "ranges" (to the beacons, (4,) m), "camera"
        (where it sees a landmark).
    """
    theta = jax.tree.map(jnp.asarray, theta)
    biases = Wander(vector(len(BEACONS)), jnp.exp(theta["bias"][0]))
    flow, sight = jnp.exp(theta["flow"]), jnp.exp(theta["camera"])
    more = {
        "finder": kinds.range_finder(diagonal(jnp.exp(theta["finder"]))),
        "flow": kinds.optical_flow(diagonal(flow, flow), lambda x, c: x.extra["imu"].gyro - x.gyro_bias),
        "ranges": Sensor(_ranges, const(diagonal(*[jnp.exp(theta["range"])] * len(BEACONS))), biases.space),
        "camera": kinds.camera(diagonal(sight, sight), point=LANDMARK),
    }
    return inertial(theta, _outdoors(theta) | more, {"drift": _drift(theta), "beacons": biases}, remember=True)


def _drift(theta: PyTree) -> Wander:
    return Wander(scalar, jnp.exp(theta["drift"]))


def _outdoors(theta: PyTree) -> dict[str, Sensor]:
    theta = jax.tree.map(jnp.asarray, theta)
    fix, speed = jnp.exp(jnp.stack(theta["gnss"])), jnp.exp(theta["doppler"])
    field = diagonal(*[jnp.exp(theta["magnetometer"])] * 3)
    arm = jnp.stack(theta["arm"])

    def receiver(x: Navigation, c: PyTree) -> tuple[jax.Array, jax.Array]:
        rates = x.extra["imu"].gyro - x.gyro_bias
        return kinds.antenna_position(x.pos, x.att, arm), kinds.antenna_velocity(x.vel, x.att, rates, arm)

    gnss = Sensor(receiver, const(diagonal(fix, speed, speed, speed)), product((vector(3), vector(3))))
    return {
        "gnss": late(gnss, theta["late"], imu=remembered),
        "magnetometer": kinds.magnetometer(field, FIELD),
        "barometer": kinds.barometer(diagonal(jnp.exp(theta["barometer"])), lambda x: x.extra["drift"]),
    }


def _ranges(x: Navigation, c: PyTree) -> jax.Array:
    points = jnp.asarray(BEACONS, x.pos.dtype)
    return jnp.stack([kinds.range_to(x.pos, point) for point in points]) + x.extra["beacons"]


def path(steps: int, dt: float = DT) -> Reference:
    """A figure eight of 3 m by 1.5 m in 8 s, up and down by 0.5 m about 1.5 m, the nose swinging by 1 rad."""
    t = dt * np.arange(steps)

    def swing(amplitude: float, period: float, phase: float = 0.0) -> tuple[np.ndarray, ...]:
        w = 2 * np.pi / period
        s, c = np.sin(w * t + phase), np.cos(w * t + phase)
        return amplitude * s, amplitude * w * c, -amplitude * w**2 * s

    axes = np.stack([swing(3.0, 8.0), swing(1.5, 4.0), swing(0.5, 11.0)], axis=-1)  # (derivative, T, axis)
    return Reference(axes[0] + [0.0, 0.0, 1.5], axes[1], axes[2], swing(1.0, 10.0)[0])


def steer(x: Navigation, reference: Reference) -> Imu:
    """What the IMU of a multirotor reads that follows a path: `Scenario.control`.

    It is steered by its true state: ``a = acc + 2 (pos_ref - pos) + 2.5 (vel_ref - vel) + g e_z``, the body's z turns
    towards a and its nose towards the yaw, with time constants of 0.12 s and 0.5 s; the thrust along z has the part of
    a that falls on it, and the rotors drag by 0.2 1/s across. The true biases come on top.
    """
    dtype = x.pos.dtype
    up = jnp.asarray([0.0, 0.0, 1.0], dtype)
    a = reference.acc + 2.0 * (reference.pos - x.pos) + 2.5 * (reference.vel - x.vel) + GRAVITY * up
    z = rotate(x.att, up)
    tilt = rotate_back(x.att, jnp.cross(z, a / norm(a)))
    turn = wrap(reference.yaw - kinds.yaw_of(x.att))
    across = rotate_back(x.att, x.vel) * jnp.asarray([1.0, 1.0, 0.0], dtype)
    gyro = jnp.stack([8.0 * tilt[0], 8.0 * tilt[1], 2.0 * turn])
    return Imu(gyro + x.gyro_bias, (a @ z) * up - 0.2 * across + x.accelerometer_bias)


def flight_start(theta: PyTree = FLIGHT) -> Gaussian:
    """Level on the path with its velocity, biases unknown: with the standard deviations ``theta["start"]``."""
    pos, vel, att, gyro, accelerometer, drift = (jnp.exp(jnp.asarray(log_std)) for log_std in theta["start"])
    first, still = path(1), np.zeros(3)
    extra: dict[str, Any] = {"drift": 0.0, "imu": Imu(still, np.array([0.0, 0.0, GRAVITY]))}
    stds = [std for std in (pos, vel, att, gyro, accelerometer) for _ in range(3)]
    if "bias" in theta:
        extra["beacons"] = np.zeros(len(BEACONS))
        stds += [jnp.exp(jnp.asarray(theta["bias"][1]))] * len(BEACONS)
    return start(Navigation(first.pos[0], first.vel[0], so3.origin, still, still, extra), *stds, drift)


NAVIGATION_BLOCKS = {
    "position": ((0, 1, 2), "m"),
    "velocity": ((3, 4, 5), "m/s"),
    "attitude": ((6, 7, 8), "rad"),
    "gyro bias": ((9, 10, 11), "rad/s"),
    "accelerometer bias": ((12, 13, 14), "m/s^2"),
}
"""Of every `Navigation`: parts of its tangent vector, which extra states follow."""


def inertial_scenario() -> Scenario:
    """A flight of a figure eight up and down by inertial navigation at 100 Hz, with every sensor on at its rate.

    GNSS position and velocity at 5 Hz with a lever arm, magnetometer and barometer (which drifts) at 25 Hz, downward
    range at 20 Hz, optical flow at 50 Hz, ranges to four beacons with unknown biases at 10 Hz, a camera's view of a
    landmark at 20 Hz. Mild: EKF and UKF are both consistent.
    """
    every = {"finder": 5, "flow": 2, "ranges": 10, "camera": 5}
    extra = {"beacons": ((15, 16, 17, 18), "m"), "drift": ((19,), "m")}
    return _flown(flight, FLIGHT, every, extra)


def inertial_gnss_scenario() -> Scenario:
    """The same flight by GNSS with a lever arm, magnetometer and barometer alone: what a drone has outdoors."""
    return _flown(gnss_flight, GNSS_FLIGHT, {}, {"drift": ((15,), "m")})


def _flown(model: Callable[[PyTree], Model], theta: PyTree, every: Mapping[str, int], extra: dict) -> Scenario:
    usual = {"gnss": 20, "magnetometer": 4, "barometer": 4}

    def fly(steps: int) -> Log:
        return schedule(model(theta), steps, DT, every=usual | dict(every), u=path(steps))

    return Scenario(model, flight_start, theta, fly, NAVIGATION_BLOCKS | extra, steer)
