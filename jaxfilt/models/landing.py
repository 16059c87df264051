"""A drone that is to land on a moving car, and sees it now and then.

World frame: x, y in m, z up. Body frames: x forward, y left, z up. Parameters ``theta`` are natural logarithms, all of
them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.elementary import bearing
from jaxfilt.log import schedule
from jaxfilt.models.car import GROUND_ROBOT, CarLike, car_like
from jaxfilt.models.parts import start
from jaxfilt.models.sensors import DOWNWARD_CAMERA, image_point, in_camera
from jaxfilt.noise import diagonal
from jaxfilt.spaces import angle, product, vector
from jaxfilt.types import Array, Filter, Gaussian, Log, Model, PyTree, Scenario, Sensor

ROOF = 0.6
"""m: height of the car's roof, known, with two marks on it."""
LENGTH = 0.8
"""m: from the mark in front to the one at the back, the car's position half way between."""


class Chase(NamedTuple):
    """A car and the drone above it: the state of `chase`."""

    car: PyTree
    """`CarLike`: what nobody tells us."""
    drone: Array
    """(3,) m, world: known to what the drone's own navigation is good for."""


ABOVE_A_ROBOT = {name: GROUND_ROBOT[name] for name in ("slip", "vel", "yaw")} | {
    "rate": math.log(0.05),  # (rad/s)/sqrt(s): chosen, half of the ground robot's: it keeps to a road
    "pixel": math.log(0.004),  # of the focal length: chosen, 2 px at 500 px
    "tilt": math.log(0.01),  # rad: chosen, error of the drone's own attitude
    "drone": math.log(0.03),  # m: chosen, error of the drone's own position, as with RTK
    # m, m/s, rad, rad/s: chosen, told by radio
    "start": (math.log(1.0), math.log(0.3), math.log(0.1), math.log(0.05)),
}
"""A drone with RTK above a ground robot that drives at 2 m/s: ``theta`` of `chase`."""


def chase(theta: PyTree = ABOVE_A_ROBOT) -> Model:
    """A car that keeps going, seen by a camera that looks down from a drone whose own pose is nearly known.

    The car moves as `car_like` does; the drone is where its navigation says, ``drone' = u + w``, ``w`` white. The
    height of the roof is known, so that a direction is a position: its error is that of the pixels and of the drone's
    attitude times the distance, and of the drone's position. The error of the attitude is part of R, white from one
    reading to the next; a real one stays for seconds.

    Args:
        theta: logarithms of the noise densities slip (m/sqrt(s)), vel ((m/s)/sqrt(s)), yaw (rad/sqrt(s)), rate
            ((rad/s)/sqrt(s)), and of the standard deviations pixel (of the focal length), tilt (rad), drone (m). See
            `ABOVE_A_ROBOT`.

    Returns:
        A model on `Chase` (9 dimensions: the car's 6, the drone's 3) with the drone's position (3,) m as input, and the
        sensors "camera" (the roof's middle in the picture, `image_point`, (2,)) and "marks" (rad, the direction from
        the back mark to the front one in the picture, from right to down), their context the drone's attitude (4,).

    Example: 2 m above the roof, which is 1 m in front and so in the upper half of the picture.
        >>> import jax.numpy as jnp
        >>> car = CarLike(jnp.array([1.0, 0.0]), jnp.array([2.0, 0.0]), jnp.asarray(0.0), jnp.asarray(0.0))
        >>> x, level = Chase(car, jnp.array([0.0, 0.0, 2.6])), jnp.array([1.0, 0.0, 0.0, 0.0])
        >>> [round(float(a), 3) + 0.0 for a in chase().sensors["camera"].h(x, level)]
        [0.0, -0.5]
    """
    std = jax.tree.map(jnp.exp, theta)
    car = car_like(GROUND_ROBOT | theta)

    def f(x: Chase, u: Array, dt: Array) -> Chase:
        return Chase(car.f(x.car, (), dt), u)

    def Q(x: Chase, u: Array, dt: Array) -> Array:
        return jax.scipy.linalg.block_diag(car.Q(x.car, (), dt), diagonal(*3 * (std["drone"],)))

    def roof(x: Chase, along: float = 0.0) -> Array:
        heading = jnp.stack([jnp.cos(x.car.yaw), jnp.sin(x.car.yaw)])
        return jnp.append(x.car.pos + along * heading, ROOF)

    def seen(x: Chase, att: Array, along: float = 0.0) -> Array:
        return image_point(x.drone, att, roof(x, along), _mount(att))

    def direction(x: Chase, att: Array) -> Array:
        return bearing(seen(x, att, 0.5 * LENGTH) - seen(x, att, -0.5 * LENGTH))

    def in_picture(x: Chase, att: Array) -> Array:
        """Standard deviation of a point: pixels, and the tilt, which moves the edge of a picture more."""
        at = seen(x, att)
        return jnp.hypot(std["pixel"], std["tilt"] * (1 + at @ at))

    def apart(x: Chase, att: Array) -> Array:
        """Standard deviation (rad) of the direction between two marks: pixels over their distance, and the tilt."""
        depth = in_camera(x.drone, att, roof(x), _mount(att))[2]
        return jnp.hypot(math.sqrt(2.0) * std["pixel"] * depth / LENGTH, std["tilt"])

    sensors = {
        "camera": Sensor(seen, lambda x, c: diagonal(*2 * (in_picture(x, c),)), vector(2)),
        "marks": Sensor(direction, lambda x, c: diagonal(apart(x, c)), angle),
    }
    return Model(f, Q, product(Chase(car.space, vector(3))), sensors)


def _mount(att: Array) -> Array:
    return jnp.asarray(DOWNWARD_CAMERA, att.dtype)


def chase_start(theta: PyTree = ABOVE_A_ROBOT) -> Gaussian:
    """The car at the origin, 2 m/s along x, ``theta["start"]`` (m, m/s, rad, rad/s); the drone 4 m behind, 10 m up."""
    pos, vel, yaw, rate = map(jnp.exp, theta["start"])
    own = jnp.exp(theta["drone"])
    mean = Chase(CarLike(np.zeros(2), np.array([2.0, 0.0]), 0.0, 0.0), np.array([-4.0, 0.0, FIRST_HEIGHT]))
    return start(mean, pos, pos, vel, vel, yaw, rate, own, own, own)


DT = 0.05
"""s: 20 Hz, the rate of a camera and its image processing."""
FIRST_HEIGHT, LAST_HEIGHT, DESCENT = 10.0, 2.0, 0.5
"""m, m, m/s."""
SEEN, UNSEEN = 0.8, 2.4
"""s: for how long the car is found in the picture, and for how long it is lost again."""
NEAR = 8.5
"""m: from lower than this the two marks are told apart."""
LAG = 0.5
"""s, of the drone behind the car."""


def descent(steps: int) -> np.ndarray:
    """The drone's height (steps,) m at the end of each row: down to 2 m, and on behind the car."""
    return np.maximum(FIRST_HEIGHT - DESCENT * DT * (1 + np.arange(steps)), LAST_HEIGHT)


def behind(x: Chase, u: Array) -> Array:
    """The drone's place (3,) m at the end of a row: it goes for the car, half a second behind, at height ``u[2]``."""
    towards = x.car.pos - x.drone[:2]
    return jnp.append(x.drone[:2] + DT / LAG * towards, u[2])


def touchdown(filt: Filter, belief: Gaussian, seconds: float) -> Gaussian:
    """Where the car will be: the belief so many seconds on (a multiple of `DT`), without a look.

    Args:
        filt: of `chase`.
        belief: now.
        seconds: s.
    """

    def on(_: int, belief: Gaussian) -> Gaussian:
        return filt.predict(belief, belief.mean.drone, DT)

    return jax.lax.fori_loop(0, round(seconds / DT), on, jax.tree.map(jnp.asarray, belief))


def landing_scenario() -> Scenario:
    """A drone comes down on a moving car that its camera finds for 0.8 s and loses for 2.4 s: the lecture's landing.

    From 10 m, at 0.5 m/s, to 2 m above the ground, half a second behind the car; the marks that show the car's heading
    are told apart from below 8.5 m. The drone is steered by where the car really is, so that the car stays in view
    whatever the filter believes (within 45 deg of the axis, 60 deg from 2 m); the filter sees the drone's own position
    and the camera only. Each gap costs a position known to 0.05 m nearly 1 m. EKF and UKF are consistent, alike.
    """

    def fly(steps: int) -> Log:
        height = descent(steps)
        u = np.stack([np.zeros(steps), np.zeros(steps), height], axis=1)
        sway = 0.05 * np.sin(2 * np.pi * DT * np.arange(steps) / 4.0)  # rad, of the pitch in half: the drone's own
        att = np.stack([np.cos(sway), np.zeros(steps), np.sin(sway), np.zeros(steps)], axis=1)
        log = schedule(chase(), steps, DT, u=u, c={"camera": att, "marks": att})
        found = np.arange(steps) * DT % (SEEN + UNSEEN) < SEEN - 0.5 * DT
        return log._replace(valid={"camera": found, "marks": found & (height < NEAR)})

    blocks = {"position": ((0, 1), "m"), "velocity": ((2, 3), "m/s"), "yaw": ((4,), "rad"), "rate": ((5,), "rad/s")}
    return Scenario(chase, chase_start, ABOVE_A_ROBOT, fly, blocks, behind)
