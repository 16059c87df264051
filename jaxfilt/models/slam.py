"""Simultaneous localisation and mapping: any robot that sees landmarks, with the landmarks' places in its state.

World frame: x, y in m, z up; it is that of the robot's start, for nothing else ties a map down. Parameters ``theta``
are natural logarithms of standard deviations.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors
from jaxfilt.log import schedule
from jaxfilt.models.parts import start
from jaxfilt.models.wheeled import INDOOR_ROBOT, Odometry, Pose, unicycle
from jaxfilt.spaces import product
from jaxfilt.types import Array, Gaussian, Law, Log, Model, PyTree, Scenario, Sensor, Space


class World(NamedTuple):
    """A robot and the landmarks about it: the state of `with_landmarks`."""

    robot: PyTree
    """A point of the robot's own space."""
    landmarks: Array
    """(N, 2) m, world."""


def with_landmarks(robot: Model, count: int, sightings: Collection[str] = ("landmark",)) -> Model:
    """The model of a robot on a known map, with the map in its state: landmarks stand still, and nobody knows where.

    ``f``, ``Q`` and the sensors are the robot's; a sensor of landmarks, whose context was a landmark's place, has the
    number of the landmark for context.

    Args:
        robot: whose sensors of landmarks take a place (2,), m, world, for context.
        count: N, of landmarks; more than there are does no harm but time.
        sightings: the names of these sensors.

    Returns:
        A model on `World`, of the robot's dimension and 2 N more.

    Raises:
        KeyError: a sensor that the robot lacks.
        ValueError: a count below 1.

    Example:
        >>> import jax.numpy as jnp
        >>> model, landmarks = slam(landmarks=2), jnp.array([[3.0, 0.0], [0.0, 2.0]])
        >>> x = World(Pose(jnp.zeros(2), jnp.asarray(0.0)), landmarks)
        >>> [round(float(a), 4) for a in model.sensors["landmark"].h(x, jnp.asarray(1))]
        [2.0, 1.5708]
    """
    doors.instance("robot", robot, Model)
    if count < 1:
        raise ValueError(f"count: expected at least 1 landmark, got {count}")
    for name in sightings:
        doors.sensor(robot, name)
    points = Space(
        2 * count,
        lambda x, d: x + d.reshape(count, 2),
        lambda a, b: (a - b).reshape(2 * count),
        np.zeros((count, 2)),
        flat=True,
    )
    r = robot.space.dim

    def f(x: World, u: PyTree, dt: Array) -> World:
        return World(robot.f(x.robot, u, dt), x.landmarks)

    def Q(x: World, u: PyTree, dt: Array) -> jax.Array:
        moving = jnp.asarray(robot.Q(x.robot, u, dt))
        return jnp.zeros((r + 2 * count, r + 2 * count), moving.dtype).at[:r, :r].set(moving)

    def context(x: World, c: PyTree, name: str) -> PyTree:
        return landmark_of(x.landmarks, c) if name in sightings else c

    def seen(name: str, sensor: Sensor) -> Sensor:
        law = sensor.law
        mapped = law and Law(
            lambda z, x, c: law.log_density(z, x.robot, context(x, c, name)),
            lambda x, c, key: law.draw(x.robot, context(x, c, name), key),
        )
        return Sensor(
            lambda x, c: sensor.h(x.robot, context(x, c, name)),
            lambda x, c: sensor.R(x.robot, context(x, c, name)),
            sensor.space,
            mapped,
        )

    sensors = {name: seen(name, sensor) for name, sensor in robot.sensors.items()}
    return Model(f, Q, product(World(robot.space, points)), sensors)


def landmark_of(landmarks: Array, number: Array) -> jax.Array:
    """The place (2,) of the landmark of this number, NaN where there is none."""
    if not jnp.issubdtype(jnp.result_type(number), jnp.integer) or jnp.ndim(number):
        raise TypeError(f"c: expected the number of a landmark, one integer, got {doors.describe(number)}")
    return jnp.asarray(landmarks).at[number].get(mode="fill", fill_value=jnp.nan, wrap_negative_indices=False)


def placed(robot: PyTree, z: tuple[Array, Array]) -> jax.Array:
    """Where a landmark stands that a robot sees: ``pos + range [cos, sin](yaw + bearing)``, (2,) m, world.

    Args:
        robot: a state with ``pos`` (2,) m and ``yaw`` () rad.
        z: range m and bearing rad.

    Example:
        >>> import math, jax.numpy as jnp
        >>> placed(Pose(jnp.array([1.0, 0.0]), jnp.asarray(0.0)), (2.0, math.pi / 2)).round(4).tolist()
        [1.0, 2.0]

    Source: Thrun, Burgard, Fox, Probabilistic Robotics (2005), table 10.1, line 10.
    """
    direction = robot.yaw + z[1]
    return robot.pos + z[0] * jnp.stack([jnp.cos(direction), jnp.sin(direction)])


MAPPING_ROBOT = {
    **{name: INDOOR_ROBOT[name] for name in ("along", "across", "turn", "gnss", "mark")},
    "map": math.log(2.0),  # m: how far the landmarks of `slam_scenario` stand from where they are drawn about; chosen
}
"""The robot of `unicycle`, without a start: ``theta`` of `slam`."""

HARSH_MAPPING_ROBOT = MAPPING_ROBOT | {
    "turn": math.log(0.1),  # rad/sqrt(s): chosen, a carpet
    "mark": (math.log(0.3), math.log(0.1)),  # m, rad: chosen, a cheap camera
}
"""Noise with which the EKF's map becomes too sure of itself within a lap of `slam_scenario`."""

LANDMARKS = np.concatenate(
    [
        radius * np.stack([np.cos(a), np.sin(a)], 1) + np.array([0.0, 10.0])
        for radius, a in ((8.0, np.arange(10) * 0.2 * np.pi), (12.0, np.arange(10) * 0.2 * np.pi + 0.1 * np.pi))
    ]
)
"""(20, 2) m: two rings on either side of the drive of `slam_scenario`."""

SIGHT = 6.0
"""m: how far the robot of `slam_scenario` sees."""


def slam(theta: PyTree = MAPPING_ROBOT, landmarks: int = len(LANDMARKS)) -> Model:
    """`unicycle` among landmarks that it must find: sensors "landmark", c the landmark's number, and "gnss".

    Args:
        theta: as in `unicycle`. See `MAPPING_ROBOT`.
        landmarks: how many.

    Returns:
        A model on `World` of a `Pose` (3 + 2 N dimensions) with input `Odometry`. `jaxfilt.slam` has filters for it.
    """
    robot = unicycle(theta)
    sensors = {"landmark": robot.sensors["mark"], "gnss": robot.sensors["gnss"]}
    return with_landmarks(robot._replace(sensors=sensors), landmarks)


def slam_start(theta: PyTree = MAPPING_ROBOT, landmarks: Array = LANDMARKS) -> Gaussian:
    """At the origin, facing along x, which is known, for it is what the map is drawn from; landmarks about their
    places, with the standard deviation ``theta["map"]``, which the filters of `jaxfilt.slam` do not look at."""
    spread = jnp.exp(jnp.asarray(theta["map"]))
    mean = World(Pose(np.zeros(2), 0.0), np.asarray(landmarks))
    return start(mean, jnp.zeros(3, spread.dtype), jnp.full(np.size(landmarks), spread))


def slam_scenario(harsh: bool = False, sighting: float = 0.2) -> Scenario:
    """Laps of 63 s about a circle of 10 m at 1 m/s, odometry at 10 Hz, one of the landmarks within 6 m each 0.2 s.

    The landmarks come into sight by and by; at the end of the lap the loop closes. ``harsh``: `HARSH_MAPPING_ROBOT`.
    Which landmark is seen goes by the drive as planned, so that a schedule is known beforehand; the harsh one strays
    from its plan, for nobody steers.

    Args:
        harsh: with more noise.
        sighting: s between sightings, a multiple of 0.1 s.
    """
    theta, dt, radius = HARSH_MAPPING_ROBOT if harsh else MAPPING_ROBOT, 0.1, 10.0

    def drive(steps: int) -> Log:
        u = Odometry(np.ones(steps), np.full(steps, 1 / radius))
        turned = np.arange(1, steps + 1) * dt / radius
        pos = radius * np.stack([np.sin(turned), 1 - np.cos(turned)], 1)
        each = round(sighting / dt)
        c = {"landmark": in_sight(pos, LANDMARKS, SIGHT, each)}
        return schedule(slam(), steps, dt, every={"landmark": each, "gnss": 0}, u=u, c=c)

    blocks = {"position": ((0, 1), "m"), "yaw": ((2,), "rad"), "map": (tuple(range(3, 3 + LANDMARKS.size)), "m")}
    return Scenario(slam, slam_start, theta, drive, blocks)


def harsh_slam_scenario() -> Scenario:
    """`slam_scenario` with noise under which the EKF's map becomes too sure of itself."""
    return slam_scenario(harsh=True)


def in_sight(pos: np.ndarray, landmarks: np.ndarray, reach: float, each: int = 1) -> np.ndarray:
    """Which landmark is seen from each position: those within reach one after the other, else the nearest.

    Args:
        pos: (T, 2) m.
        landmarks: (N, 2) m.
        reach: m.
        each: positions from one landmark to the next.

    Returns:
        (T,) int32.

    Example:
        >>> import numpy as np
        >>> in_sight(np.zeros((4, 2)), np.array([[1.0, 0.0], [9.0, 0.0], [0.0, 2.0]]), 5.0).tolist()
        [0, 2, 0, 2]
    """
    far = np.hypot(*(landmarks[None] - np.asarray(pos)[:, None]).transpose(2, 0, 1))
    near = [np.flatnonzero(row <= reach) for row in far]
    chosen = [n[k // each % len(n)] if len(n) else np.argmin(far[k]) for k, n in enumerate(near)]
    return np.array(chosen, np.int32)
