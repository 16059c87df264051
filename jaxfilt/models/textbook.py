"""The first examples of every lecture: voltmeter, pendulum, horizontal drone, GPS with accelerometer.

One function an example, the lecture's numbers as defaults; where a lecture errs, the physics is here and the docstring
says so. Parameters ``theta`` are natural logarithms of standard deviations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.integrate import rk4
from jaxfilt.log import schedule
from jaxfilt.models.linear import linear
from jaxfilt.models.parts import start, white_acceleration
from jaxfilt.noise import const, diagonal, white
from jaxfilt.spaces import angle, product, scalar, vector
from jaxfilt.types import Array, Gaussian, Log, Model, PyTree, Scenario, Sensor

VOLTMETER = {"walk": math.log(2.0), "reading": math.log(2.0)}
"""V per step, V: Q = 4 and R = 4, from the lecture."""


def voltmeter(theta: PyTree = VOLTMETER) -> Model:
    """A voltage that wanders, read by a noisy meter: ``x' = x + w``, ``z = x + v``, sensor "z".

    The lecture's truth is constant, 12 V, while its filter assumes this random walk: the filter is then too cautious
    (its NEES is 0.72 in place of 1). On its own model it is consistent.

    Example: the variance that it settles at, ``(sqrt(Q^2 + 4 Q R) - Q) / 2``.
        >>> import jaxfilt as jf
        >>> log = jf.schedule(voltmeter(), steps=20, dt=1.0)
        >>> track = jf.scan(jf.kf(voltmeter()), voltmeter_start(), log)
        >>> round(float(track.belief.cov[-1, 0, 0]), 4)
        2.4721
    """
    std = jax.tree.map(jnp.exp, theta)
    one = jnp.ones((1, 1), std["walk"].dtype)
    return linear(A=one, H=one, Q=diagonal(std["walk"]), R=diagonal(std["reading"]))


def voltmeter_start(theta: PyTree = VOLTMETER, first: Array = 12.0) -> Gaussian:
    """The first reading, () V, makes the start, with the meter's own variance; go on with the second reading."""
    return start(jnp.atleast_1d(first), jnp.exp(theta["reading"]))


def voltmeter_scenario() -> Scenario:
    """A voltage that wanders about 12 V, read once a second."""
    blocks = {"voltage": ((0,), "V")}
    return Scenario(voltmeter, voltmeter_start, VOLTMETER, lambda steps: schedule(voltmeter(), steps, 1.0), blocks)


class Pendulum(NamedTuple):
    """The state of `pendulum`."""

    angle: Array
    """() rad, from hanging."""
    rate: Array
    """() rad/s."""


GRAVITY = 9.81
"""m/s^2."""

PENDULUM = {
    "length": 0.0,  # log of 1 m
    "push": math.log(0.1),  # (rad/s)/sqrt(s): white angular acceleration of density 0.01 rad^2/s^3
    "reading": 0.5 * math.log(0.1),  # R = 0.1
    "start": (math.log(0.1), math.log(0.1)),  # rad, rad/s
}
"""After Sarkka's example: ``theta`` of `pendulum`."""


def pendulum(theta: PyTree = PENDULUM) -> Model:
    """The textbook's first nonlinear example: ``angle'' = -(g / length) sin(angle) + w``, sensor "z" = sin(angle).

    Integrated by Runge-Kutta; the textbook's Euler step gains energy.

    Args:
        theta: logarithms of length (m), of the noise density push ((rad/s)/sqrt(s)), and of the standard deviation
            reading (1, sin of the angle). See `PENDULUM`.

    Example: hanging still.
        >>> import jax.numpy as jnp
        >>> [float(a) for a in pendulum().f(Pendulum(*jnp.zeros(2)), (), 0.1)]
        [0.0, 0.0]

    Source: S. Sarkka, Bayesian Filtering and Smoothing (2013), example 3.7.
    """
    std = jax.tree.map(jnp.exp, theta)
    space = product(Pendulum(angle, scalar))

    def rate(x: Pendulum, u: PyTree) -> Pendulum:
        return Pendulum(x.rate, -GRAVITY / std["length"] * jnp.sin(x.angle))

    def Q(x: Pendulum, u: PyTree, dt: Array) -> Array:
        return std["push"] ** 2 * white_acceleration(dt)

    sine = Sensor(lambda x, c: jnp.sin(x.angle), const(diagonal(std["reading"])), scalar)
    return Model(rk4(rate, space), Q, space, {"z": sine})


def pendulum_start(theta: PyTree = PENDULUM) -> Gaussian:
    """Let go at 0.5 rad, with the standard deviations ``theta["start"]`` (rad, rad/s)."""
    return start(Pendulum(0.5, 0.0), *map(jnp.exp, theta["start"]))


def pendulum_scenario() -> Scenario:
    """Swings of about 30 deg, the sine of the angle read each 0.01 s. Mild: EKF and UKF are consistent."""
    blocks = {"angle": ((0,), "rad"), "rate": ((1,), "rad/s")}
    return Scenario(pendulum, pendulum_start, PENDULUM, lambda steps: schedule(pendulum(), steps, 0.01), blocks)


HORIZONTAL_DRONE = {
    "drift": math.log(0.2),  # m/sqrt(s): chosen, wind
    "gnss": math.log(1.0),  # m: a consumer's receiver
    "start": (math.log(2.0), math.log(2.0)),  # m
}
"""A drone that flies as told, more or less: ``theta`` of `horizontal_drone`."""


def horizontal_drone(theta: PyTree = HORIZONTAL_DRONE) -> Model:
    """Drone with commanded velocity: ``x' = x + u dt``, x (2,) m and u (2,) m/s in the world; sensor "gnss".

    Example:
        >>> import jax.numpy as jnp
        >>> horizontal_drone().f(jnp.zeros(2), jnp.array([1.0, -2.0]), 0.5).tolist()
        [0.5, -1.0]
    """
    std = jax.tree.map(jnp.exp, theta)
    gnss = Sensor(lambda x, c: x, const(diagonal(std["gnss"], std["gnss"])), vector(2))
    return Model(lambda x, u, dt: x + dt * u, white(diagonal(std["drift"], std["drift"])), vector(2), {"gnss": gnss})


def horizontal_drone_start(theta: PyTree = HORIZONTAL_DRONE) -> Gaussian:
    """At the origin, with the standard deviations ``theta["start"]`` (m, m)."""
    return start(np.zeros(2), *map(jnp.exp, theta["start"]))


def horizontal_drone_scenario() -> Scenario:
    """A square at 2 m/s, commands at 50 Hz, GNSS at 10 Hz."""

    def fly(steps: int) -> Log:
        sides = np.array([[2.0, 0.0], [0.0, 2.0], [-2.0, 0.0], [0.0, -2.0]])
        u = sides[(np.arange(steps) // 100) % 4]
        return schedule(horizontal_drone(), steps, 0.02, every={"gnss": 5}, u=u)

    blocks = {"position": ((0, 1), "m")}
    return Scenario(horizontal_drone, horizontal_drone_start, HORIZONTAL_DRONE, fly, blocks)


class Axes(NamedTuple):
    """Two axes that know nothing of each other: the state of `gps_robot` and `gps_accelerometer_robot`."""

    px: Array
    """() m, world."""
    vx: Array
    """() m/s, world."""
    py: Array
    """() m, world."""
    vy: Array
    """() m/s, world."""


GPS_ROBOT = {
    "acceleration": (math.log(1.0), math.log(1.0)),  # m/s^2: chosen, what an unknown driver does
    "gps": (math.log(2.0), math.log(2.0)),  # m: chosen
    "start": (math.log(2.0), math.log(1.0), math.log(2.0), math.log(1.0)),  # m, m/s, m, m/s
}
"""``theta`` of `gps_robot`."""

GPS_ACCELEROMETER_ROBOT = GPS_ROBOT | {"acceleration": (math.log(0.1), math.log(0.1))}
"""``theta`` of `gps_accelerometer_robot`: 0.1 m/s^2 is left of the acceleration once it is measured (chosen)."""


def gps_robot(theta: PyTree = GPS_ROBOT) -> Model:
    """GPS alone: constant velocity, and the acceleration of each axis is noise, ``Q = B diag(var) B'``.

    ``B = [dt^2/2, dt]'`` for each axis: the acceleration is constant over a step, so its variance belongs to the dt in
    use. (The lectures print ``[dt^2, dt]``, and ``F [var_x; var_y] F'``, whose shapes do not fit.)

    Args:
        theta: logarithms of the standard deviations acceleration (m/s^2, m/s^2) and gps (m, m). See `GPS_ROBOT`.

    Returns:
        A model on `Axes` (4 dimensions), no input, with the sensor "gps" (px and py, (2,) m).
    """
    return _two_axes(theta, lambda u: (0.0, 0.0))


def gps_accelerometer_robot(theta: PyTree = GPS_ACCELEROMETER_ROBOT) -> Model:
    """GPS and accelerometer: as `gps_robot`, with the measured acceleration (2,) m/s^2 as the input.

    The accelerometer is integrated, ``x' = x + v dt + a dt^2/2`` (not differentiated, as one lecture has it); its axes
    are the world's. Only its error is noise.

    Example: one second at 2 m/s^2 along x.
        >>> import jax.numpy as jnp
        >>> x = gps_accelerometer_robot().f(Axes(*jnp.zeros(4)), jnp.array([2.0, 0.0]), 1.0)
        >>> [float(a) for a in x]
        [1.0, 2.0, 0.0, 0.0]
    """
    return _two_axes(theta, lambda u: u)


def _two_axes(theta: PyTree, acceleration: Callable[[PyTree], PyTree]) -> Model:
    std = jax.tree.map(jnp.exp, theta)

    def f(x: Axes, u: PyTree, dt: Array) -> Axes:
        (ax, ay), half = acceleration(u), 0.5 * dt**2
        return Axes(x.px + x.vx * dt + ax * half, x.vx + ax * dt, x.py + x.vy * dt + ay * half, x.vy + ay * dt)

    def Q(x: Axes, u: PyTree, dt: Array) -> Array:
        B = jnp.kron(jnp.eye(2, dtype=x.px.dtype), jnp.stack([0.5 * dt**2, dt])[:, None])
        return B @ diagonal(*std["acceleration"]) @ B.T

    gps = Sensor(lambda x, c: jnp.stack([x.px, x.py]), const(diagonal(*std["gps"])), vector(2))
    return Model(f, Q, product(Axes(scalar, scalar, scalar, scalar)), {"gps": gps})


def gps_robot_start(theta: PyTree = GPS_ROBOT) -> Gaussian:
    """At rest at the origin, with the standard deviations ``theta["start"]`` (m, m/s, m, m/s)."""
    return start(Axes(0.0, 0.0, 0.0, 0.0), *map(jnp.exp, theta["start"]))


AXES_BLOCKS = {"position": ((0, 2), "m"), "velocity": ((1, 3), "m/s")}


def gps_robot_scenario() -> Scenario:
    """An unknown driver, GPS at 2 Hz alone; steps of 0.1 s."""

    def drive(steps: int) -> Log:
        return schedule(gps_robot(), steps, 0.1, every={"gps": 5})

    return Scenario(gps_robot, gps_robot_start, GPS_ROBOT, drive, AXES_BLOCKS)


def gps_accelerometer_robot_scenario() -> Scenario:
    """GPS at 2 Hz, and the driver's acceleration measured each 0.1 s."""

    def drive(steps: int) -> Log:
        t = 0.1 * np.arange(steps)
        u = np.stack([np.cos(0.5 * t), np.sin(0.5 * t)], axis=1)
        return schedule(gps_accelerometer_robot(), steps, 0.1, every={"gps": 5}, u=u)

    return Scenario(gps_accelerometer_robot, gps_robot_start, GPS_ACCELEROMETER_ROBOT, drive, AXES_BLOCKS)
