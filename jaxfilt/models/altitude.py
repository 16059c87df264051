"""Drones without attitude: the vertical one over floor and table, and the seven-state one with yaw.

World frame: z up. Body frame of the seven-state drone: x forward, y left, z up, level (roll and pitch are taken out
before). Parameters ``theta`` are natural logarithms of standard deviations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.elementary import wrap
from jaxfilt.log import schedule
from jaxfilt.models.parts import rotated, start, white_acceleration
from jaxfilt.noise import const, diagonal
from jaxfilt.spaces import angle, product, scalar, vector
from jaxfilt.types import Array, Gaussian, Log, Model, PyTree, Scenario, Sensor

GRAVITY = 9.81
"""m/s^2."""


class Vertical(NamedTuple):
    """A drone that goes up and down: the state of `vertical_drone` and `table_drone`."""

    height: Array
    """() m, world."""
    climb: Array
    """() m/s, upwards."""


VERTICAL_DRONE = {
    "acceleration": math.log(0.1),  # (m/s)/sqrt(s): chosen, vibration leaves far more than an accelerometer's own noise
    "range": math.log(0.02),  # m: the laser of crazyflie_uwb, robust sd 0.013 to 0.024 m against Vicon
    "start": (math.log(0.1), math.log(0.1)),  # m, m/s
}
"""A small drone with a downward laser: ``theta`` of `vertical_drone` and `table_drone`."""


def vertical_drone(theta: PyTree = VERTICAL_DRONE) -> Model:
    """Height from vertical acceleration and a range finder: ``z' = z + c dt + a dt^2/2``, ``c' = c + a dt``.

    (One lecture prints ``x = v dt + a dt^2`` and ``B = [dt^2, dt]``: the half is missing.)

    Args:
        theta: logarithms of the noise density acceleration ((m/s)/sqrt(s)) and of the standard deviation range (m). See
            `VERTICAL_DRONE`.

    Returns:
        A model on `Vertical` (2 dimensions), its input the upward acceleration, () m/s^2, gravity taken out, with the
        sensor "range" (() m to the floor at height 0).

    Example: one second at 2 m/s^2.
        >>> import jax.numpy as jnp
        >>> [float(a) for a in vertical_drone().f(Vertical(*jnp.zeros(2)), 2.0, 1.0)]
        [1.0, 2.0]
    """
    return _vertical(theta, lambda x, c: x.height)


def table_drone(theta: PyTree = VERTICAL_DRONE) -> Model:
    """`vertical_drone` above furniture of known height: ``range = height - c``, c () m the height of what is below.

    Example:
        >>> import jax.numpy as jnp
        >>> float(table_drone().sensors["range"].h(Vertical(*jnp.array([2.0, 0.0])), 0.75))
        1.25
    """
    return _vertical(theta, lambda x, c: x.height - c)


def _vertical(theta: PyTree, distance: Callable[[Vertical, PyTree], Array]) -> Model:
    std = jax.tree.map(jnp.exp, theta)

    def f(x: Vertical, u: Array, dt: Array) -> Vertical:
        return Vertical(x.height + (x.climb + 0.5 * u * dt) * dt, x.climb + u * dt)

    def Q(x: Vertical, u: Array, dt: Array) -> Array:
        return std["acceleration"] ** 2 * white_acceleration(dt)

    laser = Sensor(distance, const(diagonal(std["range"])), scalar)
    return Model(f, Q, product(Vertical(scalar, scalar)), {"range": laser})


def vertical_drone_start(theta: PyTree = VERTICAL_DRONE) -> Gaussian:
    """Hovering at 1.5 m, with the standard deviations ``theta["start"]`` (m, m/s)."""
    return start(Vertical(1.5, 0.0), *map(jnp.exp, theta["start"]))


VERTICAL_BLOCKS = {"height": ((0,), "m"), "climb": ((1,), "m/s")}

VERTICAL_DT = 1 / 120
"""s: the accelerometer's interval; the range finder reads each fourth time, at 30 Hz."""


def vertical_drone_scenario() -> Scenario:
    """Up and down by 0.3 m every 4 s, held there by a controller; range at 30 Hz."""

    def fly(steps: int) -> Log:
        return schedule(vertical_drone(), steps, VERTICAL_DT, every={"range": 4}, u=_bobbing(steps))

    return Scenario(
        vertical_drone, vertical_drone_start, VERTICAL_DRONE, fly, VERTICAL_BLOCKS, control=vertical_control
    )


def table_drone_scenario() -> Scenario:
    """The same flight, with a table of 0.75 m below in the second half of every 4 s; range at 30 Hz."""

    def fly(steps: int) -> Log:
        over = VERTICAL_DT * np.arange(steps) % 4 >= 2
        c = {"range": np.where(over, 0.75, 0.0)}
        return schedule(table_drone(), steps, VERTICAL_DT, every={"range": 4}, u=_bobbing(steps), c=c)

    return Scenario(table_drone, vertical_drone_start, VERTICAL_DRONE, fly, VERTICAL_BLOCKS, control=vertical_control)


def _bobbing(steps: int) -> Vertical:
    phase, rate = 2 * np.pi / 4 * VERTICAL_DT * np.arange(steps), 2 * np.pi / 4
    return Vertical(1.5 + 0.3 * np.sin(phase), 0.3 * rate * np.cos(phase))


def vertical_control(x: Vertical, wanted: Vertical) -> Array:
    """Upward acceleration, () m/s^2: ``4 (height error) + 4 (climb error)``, a double pole at 2/s."""
    return 4.0 * (wanted.height - x.height) + 4.0 * (wanted.climb - x.climb)


class LevelDrone(NamedTuple):
    """A drone without roll and pitch: the state of `level_drone`."""

    pos: Array
    """(3,) m, world."""
    vel: Array
    """(3,) m/s, world."""
    yaw: Array
    """() rad, positive to the left."""


class LevelImu(NamedTuple):
    """What its inertial sensors say: the input of `level_drone`, held over a row's interval."""

    accel: Array
    """(3,) m/s^2, level body frame: specific force, (0, 0, g) in hover."""
    rate: Array
    """() rad/s, of the yaw."""


LEVEL_DRONE = {
    "acceleration": math.log(0.1),  # (m/s)/sqrt(s): chosen, as above
    "yaw": math.log(0.01),  # rad/sqrt(s): chosen, tilt that leaks into the yaw rate
    "gnss": (math.log(1.0), math.log(1.5)),  # m horizontal, vertical: a consumer's receiver
    "velocity": math.log(0.1),  # m/s: the same receiver's Doppler velocity
    "compass": math.log(0.05),  # rad: magnetometer between motors
    "start": (math.log(1.0), math.log(0.2), math.log(0.1)),  # m, m/s, rad
}
"""A drone outdoors: ``theta`` of `level_drone`."""


def level_drone(theta: PyTree = LEVEL_DRONE) -> Model:
    """Seven states [x y z vx vy vz yaw], the body's acceleration as input.

    ``a = Rot_z(yaw) accel - (0, 0, g)``, ``p' = p + v dt + a dt^2/2``, ``v' = v + a dt``, ``yaw' = yaw + rate dt``.
    Body to world: one drone's code rotates by the inverse, which is right only at yaw 0 and pi.

    Args:
        theta: logarithms of the noise densities acceleration ((m/s)/sqrt(s)) and yaw (rad/sqrt(s)), and of the standard
            deviations gnss (m horizontal, m vertical), velocity (m/s), compass (rad). See `LEVEL_DRONE`.

    Returns:
        A model on `LevelDrone` (7 dimensions) with input `LevelImu` and sensors "gnss" (position, (3,) m), "velocity"
        ((3,) m/s, world), "compass" (yaw, () rad).

    Example: hover is an equilibrium.
        >>> import jax.numpy as jnp
        >>> x = LevelDrone(jnp.zeros(3), jnp.zeros(3), jnp.asarray(1.0))
        >>> level_drone().f(x, LevelImu(jnp.array([0.0, 0.0, 9.81]), 0.0), 0.5).pos.tolist()
        [0.0, 0.0, 0.0]
    """
    std = jax.tree.map(jnp.exp, theta)

    def f(x: LevelDrone, u: LevelImu, dt: Array) -> LevelDrone:
        a = jnp.concatenate([rotated(x.yaw, u.accel[:2]), u.accel[2:] - GRAVITY])
        return LevelDrone(x.pos + x.vel * dt + 0.5 * a * dt**2, x.vel + a * dt, wrap(x.yaw + u.rate * dt))

    def Q(x: LevelDrone, u: LevelImu, dt: Array) -> Array:
        motion = jnp.kron(std["acceleration"] ** 2 * white_acceleration(dt), jnp.eye(3, dtype=x.yaw.dtype))
        return jax.scipy.linalg.block_diag(motion, std["yaw"] ** 2 * dt)

    horizontal, up = std["gnss"]
    sensors = {
        "gnss": Sensor(lambda x, c: x.pos, const(diagonal(horizontal, horizontal, up)), vector(3)),
        "velocity": Sensor(lambda x, c: x.vel, const(diagonal(*[std["velocity"]] * 3)), vector(3)),
        "compass": Sensor(lambda x, c: x.yaw, const(diagonal(std["compass"])), angle),
    }
    return Model(f, Q, product(LevelDrone(vector(3), vector(3), angle)), sensors)


def level_drone_start(theta: PyTree = LEVEL_DRONE) -> Gaussian:
    """On the circle, 10 m up, at 2 m/s, with the standard deviations ``theta["start"]`` (m, m/s, rad)."""
    pos, vel, yaw = map(jnp.exp, theta["start"])
    mean = LevelDrone(np.array([5.0, 0.0, 10.0]), np.array([0.0, 2.0, 0.0]), 0.0)
    return start(mean, *[pos] * 3, *[vel] * 3, yaw)


def level_drone_scenario() -> Scenario:
    """A circle of 5 m at 2 m/s, yawing on the way; steps at 50 Hz, GNSS and velocity at 10 Hz, compass at 25 Hz."""

    def fly(steps: int) -> Log:
        t, rate = 0.02 * np.arange(steps), 0.4
        circle = np.stack([5 * np.cos(rate * t), 5 * np.sin(rate * t), np.full(steps, 10.0)], axis=1)
        along = np.stack([-2 * np.sin(rate * t), 2 * np.cos(rate * t), np.zeros(steps)], axis=1)
        every = {"gnss": 5, "velocity": 5, "compass": 2}
        return schedule(level_drone(), steps, 0.02, every=every, u=LevelDrone(circle, along, 0.3 * np.sin(0.5 * t)))

    blocks = {"position": ((0, 1, 2), "m"), "velocity": ((3, 4, 5), "m/s"), "yaw": ((6,), "rad")}
    return Scenario(level_drone, level_drone_start, LEVEL_DRONE, fly, blocks, control=level_drone_control)


def level_drone_control(x: LevelDrone, wanted: LevelDrone) -> LevelImu:
    """Specific force and yaw rate that bring the drone where it should be: a double pole at 1/s, yaw at 1/s."""
    a = (wanted.pos - x.pos) + 2.0 * (wanted.vel - x.vel)
    accel = jnp.concatenate([rotated(-x.yaw, a[:2]), a[2:] + GRAVITY])
    return LevelImu(accel, wrap(wanted.yaw - x.yaw))
