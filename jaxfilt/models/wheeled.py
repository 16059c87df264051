"""Robots that know how their wheels turn: the unicycle with odometry as input, and the lecture's two-wheeled robot.

World frame: x, y in m, z up. Yaw from the world's x axis to the robot's, positive to the left. Parameters ``theta``
are natural logarithms of standard deviations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.elementary import wrap
from jaxfilt.log import schedule
from jaxfilt.models.parts import arc, start
from jaxfilt.models.sensors import range_bearing
from jaxfilt.noise import const, diagonal
from jaxfilt.spaces import angle, product, scalar, vector
from jaxfilt.types import Array, Gaussian, Log, Model, PyTree, Scenario, Sensor


class Pose(NamedTuple):
    """Where a robot stands in the plane: the state of `unicycle`."""

    pos: Array
    """(2,) m, world: the middle between the wheels."""
    yaw: Array
    """() rad."""


class Odometry(NamedTuple):
    """What the wheels did over a row's interval: the input of `unicycle`."""

    speed: Array
    """() m/s, forward."""
    rate: Array
    """() rad/s, of the yaw."""


def odometry(left: Array, right: Array, track: float) -> Odometry:
    """Speed and yaw rate from the speeds of two wheels: ``((left + right) / 2, (right - left) / track)``.

    Args:
        left, right: m/s over ground, any shape.
        track: m, between the wheels.

    Example: on the spot, to the left.
        >>> odometry(-0.1, 0.1, track=0.4)
        Odometry(speed=0.0, rate=0.5)
    """
    return Odometry(0.5 * (left + right), (right - left) / track)


INDOOR_ROBOT = {
    "along": math.log(0.02),  # m/sqrt(s): chosen; the utias robots drift 2 to 4 m in 15 minutes of driving
    "across": math.log(0.005),  # m/sqrt(s): chosen, wheels hardly slip sideways
    "turn": math.log(0.03),  # rad/sqrt(s): chosen, 2 deg in a second of driving
    "gnss": math.log(1.0),  # m: a consumer's receiver in the open
    "mark": (math.log(0.15), math.log(0.01)),  # m, rad: barcodes seen by the cameras of utias, five robots' mean
    "start": (math.log(0.2), math.log(0.2), math.log(0.1)),  # m, m, rad
}
"""A vacuum cleaner among landmarks: ``theta`` of `unicycle`."""


def unicycle(theta: PyTree = INDOOR_ROBOT) -> Model:
    """Unicycle with odometry as input: without measurements, dead reckoning.

    ``pos`` rolls ``speed dt`` along an arc of ``rate dt``. ``Q = diag(Rot(yaw) diag(along^2, across^2) Rot(yaw)',
    turn^2) dt``: the wheels err along the track, hardly across.

    Args:
        theta: logarithms of the noise densities along, across (m/sqrt(s)), turn (rad/sqrt(s)), and of the standard
            deviations gnss (m), mark (m, rad). See `INDOOR_ROBOT`.

    Returns:
        A model on `Pose` (3 dimensions) with input `Odometry` and sensors "gnss" (position, (2,) m) and "mark" (range
        m and bearing rad to the landmark at ``c``, (2,) m).

    Example: half a circle of radius 1 m.
        >>> import math, jax.numpy as jnp
        >>> pose = unicycle().f(Pose(jnp.zeros(2), jnp.asarray(0.0)), Odometry(1.0, 1.0), math.pi)
        >>> (pose.pos.round(4) + 0.0).tolist()
        [0.0, 2.0]

    Source: Thrun, Burgard, Fox, Probabilistic Robotics (2005), eq. 5.9, written with the chord.
    """
    std = jax.tree.map(jnp.exp, theta)

    def f(x: Pose, u: Odometry, dt: Array) -> Pose:
        return Pose(*arc(x.pos, x.yaw, u.speed * dt, u.rate * dt))

    def Q(x: Pose, u: Odometry, dt: Array) -> Array:
        unit, heading = jnp.eye(3, dtype=x.yaw.dtype), jnp.stack([jnp.cos(x.yaw), jnp.sin(x.yaw)])
        left = jnp.stack([-heading[1], heading[0]])
        G = jnp.stack(
            [std["along"] * heading @ unit[:2], std["across"] * left @ unit[:2], std["turn"] * unit[2]], axis=1
        )
        return dt * G @ G.T

    sensors = {
        "gnss": Sensor(lambda x, c: x.pos, const(diagonal(std["gnss"], std["gnss"])), vector(2)),
        "mark": Sensor(
            lambda x, c: range_bearing(x.pos, x.yaw, c), const(diagonal(*std["mark"])), product((scalar, angle))
        ),
    }
    return Model(f, Q, product(Pose(vector(2), angle)), sensors)


def unicycle_start(theta: PyTree = INDOOR_ROBOT) -> Gaussian:
    """At the origin, facing along x, with the standard deviations ``theta["start"]`` (m, m, rad)."""
    return start(Pose(np.zeros(2), 0.0), *map(jnp.exp, theta["start"]))


def unicycle_scenario() -> Scenario:
    """A circle of 2 m at 0.5 m/s with odometry at 50 Hz, one of six landmarks each 0.2 s in turn, GNSS at 1 Hz.

    Mild: the landmarks stand 5 to 9 m off, and the pose is known to centimetres. EKF and UKF are consistent.
    """
    landmarks = np.array([[6.0, 0.0], [4.0, 8.0], [-4.0, 8.0], [-7.0, 2.0], [-4.0, -5.0], [4.0, -5.0]])

    def drive(steps: int) -> Log:
        seen = landmarks[(np.arange(steps) // 10) % len(landmarks)]
        u = Odometry(np.full(steps, 0.5), np.full(steps, 0.25))
        return schedule(unicycle(), steps, 0.02, every={"gnss": 50, "mark": 10}, u=u, c={"mark": seen})

    blocks = {"position": ((0, 1), "m"), "yaw": ((2,), "rad")}
    return Scenario(unicycle, unicycle_start, INDOOR_ROBOT, drive, blocks)


class TwoWheeled(NamedTuple):
    """The lecture's robot: the state of `two_wheeled`."""

    yaw: Array
    """() rad."""
    speed: Array
    """() m/s, forward."""
    right: Array
    """() rad/s, rate of the right wheel."""
    left: Array
    """() rad/s, rate of the left wheel."""


LECTURE_ROBOT = {
    "yaw": math.log(math.radians(1.0)),  # rad per step
    "speed": math.log(0.1),  # m/s per step
    "wheel": math.log(math.radians(1.0)),  # rad/s per step
    "compass": math.log(math.radians(5.0)),  # rad
    "speedometer": math.log(0.1),  # m/s
    "encoder": math.log(math.radians(5.0)),  # rad/s
    "start": (math.log(0.1), math.log(0.1), math.log(0.1), math.log(0.1)),  # rad, m/s, rad/s, rad/s: ours
}
"""All from the lecture but the start: ``theta`` of `two_wheeled`."""

WHEEL_RADIUS, WHEEL_TRACK, TWO_WHEELED_DT = 0.25, 1.0, 0.1
"""m, m, s: the lecture's robot."""


def two_wheeled(theta: PyTree = LECTURE_ROBOT) -> Model:
    """Two-wheeled robot whose wheel rates are states: ``yaw' = yaw + (r dt/d)(w1 - w2)``, ``v' = (r/2)(w1 + w2)``.

    Wheel 1 is the right one, which turns the robot to the left; the wheel rates persist. Case 1 of the lecture is a log
    with readings of "encoders" alone: nothing measures the yaw, and its variance grows without bound. Case 2 has
    "compass" and "speedometer" too.

    Args:
        theta: logarithms of the process noise *per step* of 0.1 s: yaw (rad), speed (m/s), wheel (rad/s), and of the
            standard deviations compass (rad), speedometer (m/s), encoder (rad/s). See `LECTURE_ROBOT`.

    Returns:
        A model on `TwoWheeled` (4 dimensions), no input, with sensors "encoders" (right and left, (2,) rad/s),
        "compass" (yaw, () rad), "speedometer" (() m/s). A filter on it is exact, but for the seam of the angle.

    Example: equal wheels, straight on at r w.
        >>> import jax.numpy as jnp
        >>> x = TwoWheeled(*jnp.array([0.0, 0.0, 4.0, 4.0]))
        >>> [float(a) for a in two_wheeled().f(x, (), 0.1)]
        [0.0, 1.0, 4.0, 4.0]
    """
    std = jax.tree.map(jnp.exp, theta)

    def f(x: TwoWheeled, u: PyTree, dt: Array) -> TwoWheeled:
        yaw = wrap(x.yaw + WHEEL_RADIUS / WHEEL_TRACK * dt * (x.right - x.left))
        return TwoWheeled(yaw, 0.5 * WHEEL_RADIUS * (x.right + x.left), x.right, x.left)

    sensors = {
        "encoders": Sensor(
            lambda x, c: jnp.stack([x.right, x.left]), const(diagonal(std["encoder"], std["encoder"])), vector(2)
        ),
        "compass": Sensor(lambda x, c: x.yaw, const(diagonal(std["compass"])), angle),
        "speedometer": Sensor(lambda x, c: x.speed, const(diagonal(std["speedometer"])), scalar),
    }
    Q = const(diagonal(std["yaw"], std["speed"], std["wheel"], std["wheel"]))
    return Model(f, Q, product(TwoWheeled(angle, scalar, scalar, scalar)), sensors)


def two_wheeled_start(theta: PyTree = LECTURE_ROBOT) -> Gaussian:
    """Both wheels at 4 rad/s, 1 m/s straight on, with the standard deviations ``theta["start"]``."""
    return start(TwoWheeled(0.0, 1.0, 4.0, 4.0), *map(jnp.exp, theta["start"]))


def two_wheeled_scenario(compass: bool = True) -> Scenario:
    """The lecture's two cases: all sensors each 0.1 s (case 2), or the encoders alone (case 1, ``compass=False``)."""

    def drive(steps: int) -> Log:
        every = {} if compass else {"compass": 0, "speedometer": 0}
        return schedule(two_wheeled(), steps, TWO_WHEELED_DT, every=every)

    blocks = {"yaw": ((0,), "rad"), "speed": ((1,), "m/s"), "wheels": ((2, 3), "rad/s")}
    return Scenario(two_wheeled, two_wheeled_start, LECTURE_ROBOT, drive, blocks)
