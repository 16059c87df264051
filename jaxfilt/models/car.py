"""Cars in the plane: the Ackermann bicycle, and the car-like robot that a drone lands on.

World frame: x, y in m, z up. Body frame: x forward, y left. Yaw from the world's x axis to the car's, positive to
the left. Parameters ``theta`` are natural logarithms, all of them: of lengths and of standard deviations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.elementary import wrap
from jaxfilt.log import schedule
from jaxfilt.models.parts import arc, rotated, start
from jaxfilt.models.sensors import range_bearing
from jaxfilt.noise import const, diagonal, white
from jaxfilt.spaces import angle, product, scalar, vector
from jaxfilt.types import Array, Gaussian, Log, Model, PyTree, Scenario, Sensor


class Bicycle(NamedTuple):
    """A car, seen as two wheels in line: the state of `bicycle`."""

    pos: Array
    """(2,) m, world: the middle of the rear axle."""
    yaw: Array
    """() rad."""
    speed: Array
    """() m/s, forward, of the rear axle."""


class Driving(NamedTuple):
    """The input of `bicycle`, held over a row's interval."""

    acceleration: Array
    """() m/s^2, forward."""
    steering: Array
    """() rad, angle of the front wheel, positive to the left, within +-pi/2."""


CITY_CAR = {
    "wheel_base": math.log(2.7),  # m: a compact car, 2.6 to 2.8 by the makers' data sheets
    "slip": math.log(0.05),  # m/sqrt(s), sideways and along: chosen, 0.1 m in 4 s
    "turn": math.log(0.01),  # rad/sqrt(s): chosen, play of the steering, 1 deg in 3 s
    "speed": math.log(0.2),  # (m/s)/sqrt(s): chosen, error of the commanded acceleration
    "gnss": math.log(1.0),  # m: the u-blox of comma2k19 is 1.47 m off horizontally (RMS) against its truth
    "odometer": math.log(0.1),  # m/s: wheel speed on the CAN bus of comma2k19, sd 0.06 m/s, rounded up
    "mark": (math.log(0.1), math.log(0.01)),  # m, rad: lidar on a reflector post
    "start": (math.log(2.0), math.log(2.0), math.log(0.1), math.log(0.5)),  # m, m, rad, m/s
}
"""A compact car with a consumer's GNSS receiver: ``theta`` of `bicycle`."""


def bicycle(theta: PyTree = CITY_CAR) -> Model:
    """Ackermann car as a kinematic bicycle, driven by acceleration and steering angle.

    ``speed' = speed + a dt``, and the rear axle rolls ``s = speed dt + a dt^2/2`` along an arc of radius
    ``wheel_base / tan(steering)``: exact for inputs held over dt.

    Args:
        theta: logarithms of wheel_base (m), of the noise densities slip (m/sqrt(s)), turn (rad/sqrt(s)), speed
            ((m/s)/sqrt(s)), and of the standard deviations gnss (m), odometer (m/s), mark (m, rad). See `CITY_CAR`.

    Returns:
        A model on `Bicycle` (4 dimensions) with input `Driving` and sensors "gnss" (position, (2,) m), "odometer"
        (speed, () m/s), "mark" (range m and bearing rad to the landmark at ``c``, (2,) m).

    Example: a circle of radius wheel_base / tan(steering) = 2.7 m.
        >>> import math, jax.numpy as jnp, jaxfilt as jf
        >>> car = Bicycle(pos=jnp.zeros(2), yaw=jnp.asarray(0.0), speed=jnp.asarray(2.7))
        >>> half = bicycle().f(car, Driving(0.0, math.pi / 4), math.pi)
        >>> (abs(half.pos - jnp.array([0.0, 2 * 2.7])) < 1e-5).tolist()
        [True, True]

    Source: R. Rajamani, Vehicle Dynamics and Control (2012), section 2.2, with the rear axle as reference point.
    """
    std = jax.tree.map(jnp.exp, theta)

    def f(x: Bicycle, u: Driving, dt: Array) -> Bicycle:
        length = (x.speed + 0.5 * u.acceleration * dt) * dt
        pos, yaw = arc(x.pos, x.yaw, length, length * jnp.tan(u.steering) / std["wheel_base"])
        return Bicycle(pos, yaw, x.speed + u.acceleration * dt)

    density = diagonal(std["slip"], std["slip"], std["turn"], std["speed"])
    sensors = {
        "gnss": Sensor(lambda x, c: x.pos, const(diagonal(std["gnss"], std["gnss"])), vector(2)),
        "odometer": Sensor(lambda x, c: x.speed, const(diagonal(std["odometer"])), scalar),
        "mark": Sensor(
            lambda x, c: range_bearing(x.pos, x.yaw, c), const(diagonal(*std["mark"])), product((scalar, angle))
        ),
    }
    return Model(f, white(density), product(Bicycle(vector(2), angle, scalar)), sensors)


def bicycle_start(theta: PyTree = CITY_CAR) -> Gaussian:
    """At the origin, heading along x at 10 m/s, with the standard deviations ``theta["start"]`` (m, m, rad, m/s)."""
    return start(Bicycle(np.zeros(2), 0.0, 10.0), *map(jnp.exp, theta["start"]))


BICYCLE_BLOCKS = {"position": ((0, 1), "m"), "yaw": ((2,), "rad"), "speed": ((3,), "m/s")}

DT = 0.02
"""s: 50 Hz, the usual rate of a car's wheel and steering messages."""


def scenario() -> Scenario:
    """The usual drive: 10 m/s through bends to both sides, GNSS at 10 Hz, wheel odometer at 50 Hz.

    Mild: the yaw is known to 0.1 rad at the start and to 0.03 rad on the way, so that a tangent is as good as the
    curve, and EKF and UKF are both consistent.
    """

    def drive(steps: int) -> Log:
        t = DT * np.arange(steps)
        u = Driving(1.0 * np.cos(2 * np.pi * t / 8), 0.1 * np.sin(2 * np.pi * t / 10))
        return schedule(bicycle(), steps, DT, every={"gnss": 5, "mark": 0}, u=u)

    return Scenario(bicycle, bicycle_start, CITY_CAR, drive, BICYCLE_BLOCKS)


LOST_CAR = CITY_CAR | {"start": (math.log(2.0), math.log(2.0), math.log(0.5), math.log(0.5))}  # m, m, rad, m/s
"""The city car when it hardly knows its heading: 30 deg, not 6."""


def harsh_scenario() -> Scenario:
    """Lost, then one look a second at a post that the car circles past: a tangent is no longer as good as the curve.

    The heading is known to 0.5 rad at the start, the readings are good to 0.1 m and 0.01 rad, and there is nothing
    else. The EKF believes its first linearisations and stays overconfident: its mean NEES is hundreds of times the
    state's dimension, its median ten times what it should be. The UKF's median is 1.5 times too large, its mean spoilt
    by a few runs.
    """

    def drive(steps: int) -> Log:
        u = Driving(np.zeros(steps), np.full(steps, 0.25))
        post = np.broadcast_to([10.0, 10.0], (steps, 2))
        return schedule(bicycle(), steps, DT, every={"gnss": 0, "odometer": 0, "mark": 50}, u=u, c={"mark": post})

    return Scenario(bicycle, bicycle_start, LOST_CAR, drive, BICYCLE_BLOCKS)


class CarLike(NamedTuple):
    """A ground robot as the drone that lands on it sees it: the state of `car_like`."""

    pos: Array
    """(2,) m, world."""
    vel: Array
    """(2,) m/s, body: forward, left."""
    yaw: Array
    """() rad."""
    rate: Array
    """() rad/s, of the yaw."""


class CarLikeReading(NamedTuple):
    """What `car_like` measures of itself."""

    pos: Array
    """(2,) m, world."""
    vel: Array
    """(2,) m/s, body."""
    yaw: Array
    """() rad."""


class Sighting(NamedTuple):
    """The car in a drone's camera."""

    pos: Array
    """(2,) m, world axes, from the drone to the car."""
    yaw: Array
    """() rad, of the car in the world."""


GROUND_ROBOT = {
    "slip": math.log(0.02),  # m/sqrt(s): chosen
    "vel": math.log(0.2),  # (m/s)/sqrt(s): chosen, a robot that changes its speed by 0.2 m/s in a second
    "yaw": math.log(0.01),  # rad/sqrt(s): chosen
    "rate": math.log(0.1),  # (rad/s)/sqrt(s): chosen, it turns in and out of bends within seconds
    "pose": (math.log(0.5), math.log(0.1), math.log(0.05)),  # m, m/s, rad: differential GNSS, wheels, compass
    "camera": (math.log(0.1), math.log(0.05)),  # m, rad: a marker on the roof, seen from some metres above
    "start": (math.log(1.0), math.log(0.3), math.log(0.2), math.log(0.1)),  # m, m/s, rad, rad/s
}
"""A wheeled robot of the size of a table that drives at 2 m/s: ``theta`` of `car_like`."""


def car_like(theta: PyTree = GROUND_ROBOT) -> Model:
    """Differential car-like robot that nobody tells us how it is driven: velocity and yaw rate persist.

    ``r' = r + dt Rot(yaw) v``, ``yaw' = yaw + dt rate``, ``v' = v``, ``rate' = rate``.

    Args:
        theta: logarithms of the noise densities slip (m/sqrt(s)), vel ((m/s)/sqrt(s)), yaw (rad/sqrt(s)), rate
            ((rad/s)/sqrt(s)), and of the standard deviations pose (m, m/s, rad), camera (m, rad). See `GROUND_ROBOT`.

    Returns:
        A model on `CarLike` (6 dimensions), no input, with sensors "pose" (`CarLikeReading`) and "camera"
        (`Sighting` from a drone at ``c``, (2,) m, world).

    Example:
        >>> import math, jax.numpy as jnp
        >>> north = CarLike(jnp.zeros(2), jnp.array([2.0, 0.0]), jnp.asarray(math.pi / 2), jnp.asarray(0.0))
        >>> car_like().f(north, (), 0.5).pos.round(4).tolist()
        [-0.0, 1.0]
    """
    std = jax.tree.map(jnp.exp, theta)

    def f(x: CarLike, u: PyTree, dt: Array) -> CarLike:
        return CarLike(x.pos + dt * rotated(x.yaw, x.vel), x.vel, wrap(x.yaw + dt * x.rate), x.rate)

    density = diagonal(std["slip"], std["slip"], std["vel"], std["vel"], std["yaw"], std["rate"])
    (position, velocity, heading), (marker, marker_yaw) = std["pose"], std["camera"]
    sensors = {
        "pose": Sensor(
            lambda x, c: CarLikeReading(x.pos, x.vel, x.yaw),
            const(diagonal(position, position, velocity, velocity, heading)),
            product(CarLikeReading(vector(2), vector(2), angle)),
        ),
        "camera": Sensor(
            lambda x, c: Sighting(x.pos - c, x.yaw),
            const(diagonal(marker, marker, marker_yaw)),
            product(Sighting(vector(2), angle)),
        ),
    }
    return Model(f, white(density), product(CarLike(vector(2), vector(2), angle, scalar)), sensors)


def car_like_start(theta: PyTree = GROUND_ROBOT) -> Gaussian:
    """At the origin, 2 m/s along x, with the standard deviations ``theta["start"]`` (m, m/s, rad, rad/s)."""
    pos, vel, yaw, rate = map(jnp.exp, theta["start"])
    return start(CarLike(np.zeros(2), np.array([2.0, 0.0]), 0.0, 0.0), pos, pos, vel, vel, yaw, rate)


def car_like_scenario() -> Scenario:
    """Its own sensors at 10 Hz for the first 2 s of each 8 s, a drone's camera at 5 Hz for the third 2 s; 50 Hz steps.

    The drone hovers 3 m in front of the start. In between nothing is known of the robot but that it keeps going.
    Mild: EKF and UKF are consistent.
    """

    def drive(steps: int) -> Log:
        drone = np.broadcast_to([3.0, 0.0], (steps, 2))
        log = schedule(car_like(), steps, DT, every={"pose": 5, "camera": 10}, c={"camera": drone})
        quarter = (np.arange(steps) * DT / 2.0).astype(int) % 4
        seen = {"pose": quarter == 0, "camera": quarter == 2}
        return log._replace(valid={name: log.valid[name] & seen[name] for name in seen})

    blocks = {"position": ((0, 1), "m"), "velocity": ((2, 3), "m/s"), "yaw": ((4,), "rad"), "rate": ((5,), "rad/s")}
    return Scenario(car_like, car_like_start, GROUND_ROBOT, drive, blocks)
