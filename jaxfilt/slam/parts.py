"""What the filters that draw a map know of their model: where the robot ends and the landmarks begin."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors
from jaxfilt.models.slam import World, placed
from jaxfilt.types import Array, Info, Model, PyTree, Sensor, Space, Status

Inverse = Callable[[PyTree, PyTree], Array]
"""(robot, reading) -> place (2,) of the landmark that was seen."""

SIGHTINGS: dict[str, Inverse] = {"landmark": placed}
"""The sensor of landmarks of a robot with ``pos`` and ``yaw``: range and bearing."""


class Anatomy(NamedTuple):
    """``robot``, the dimension of the robot; ``landmarks``, N, how many; ``inverse`` by sensor of landmarks."""

    robot: int
    landmarks: int
    inverse: dict[str, Inverse]

    def rows(self, number: Array | int) -> jax.Array:
        """The rows (2,) of a landmark in the tangent space."""
        return self.robot + 2 * jnp.asarray(number, jnp.int32) + jnp.arange(2, dtype=jnp.int32)


def anatomy(model: Model, sightings: Mapping[str, Inverse] | None) -> Anatomy:
    """The parts of a model on `World`, checked."""
    doors.instance("model", model, Model)
    origin = model.space.origin
    if not isinstance(origin, World):
        raise TypeError(f"model: expected a state World(robot, landmarks), got {doors.describe(origin)}")
    inverse = dict(SIGHTINGS if sightings is None else sightings)
    for name in inverse:
        doors.sensor(model, name)
    count = len(origin.landmarks)
    return Anatomy(model.space.dim - 2 * count, count, inverse)


def robot_alone(model: Model, parts: Anatomy) -> Model:
    """The model of the robot without its landmarks; the context of a sighting is the place (2,) of a landmark."""
    r, whole = parts.robot, model.space
    nowhere = np.asarray(whole.origin.landmarks)

    def world(x: PyTree) -> World:
        return World(x, jnp.asarray(nowhere, jnp.result_type(jax.tree.leaves(x)[0])))

    def plus(x: PyTree, d: Array) -> PyTree:
        return whole.plus(world(x), jnp.zeros(whole.dim, d.dtype).at[:r].set(d)).robot

    space = Space(r, plus, lambda a, b: whole.minus(world(a), world(b))[:r], whole.origin.robot, whole.flat)

    def sees(sensor: Sensor) -> Sensor:
        def one(x: PyTree, place: Array) -> tuple[World, Array]:
            return World(x, jnp.asarray(place)[None]), jnp.int32(0)

        return Sensor(lambda x, c: sensor.h(*one(x, c)), lambda x, c: sensor.R(*one(x, c)), sensor.space)

    def reads(sensor: Sensor) -> Sensor:
        return Sensor(lambda x, c: sensor.h(world(x), c), lambda x, c: sensor.R(world(x), c), sensor.space)

    return Model(
        lambda x, u, dt: model.f(world(x), u, dt).robot,
        lambda x, u, dt: model.Q(world(x), u, dt)[:r, :r],
        space,
        {name: sees(s) if name in parts.inverse else reads(s) for name, s in model.sensors.items()},
    )


def first_sight(m: int, dtype: jnp.dtype, z: PyTree, before: PyTree, after: PyTree) -> Info:
    """What is reported of a landmark's first sighting: nothing was expected, so nothing can be compared."""
    number, count = jnp.zeros((), dtype), jnp.zeros((), jnp.int32)
    status = jnp.int32(Status.OK)
    for tree, code in (
        (after, Status.BAD_POSTERIOR),
        (z, Status.BAD_MEASUREMENT),
        (before, Status.BAD_BELIEF),
    ):
        status = jnp.where(finite(tree), status, jnp.int32(code))
    return Info(jnp.zeros(m, dtype), jnp.zeros((m, m), dtype), number, number, count, number, status)


def finite(tree: PyTree) -> jax.Array:
    """Whether every number of a tree is finite."""
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)]).all()


def known_number(name: str, c: PyTree, count: int) -> jax.Array:
    """The context of a sighting as the number of a landmark, checked where it can be seen."""
    leaves = jax.tree.leaves(c)
    if len(leaves) != 1 or jnp.ndim(c) or not jnp.issubdtype(jnp.result_type(c), jnp.integer):
        raise TypeError(f"c[{name!r}]: expected the number of a landmark, one integer, got {doors.describe(c)}")
    if doors.is_concrete(c) and not 0 <= int(c) < count:
        raise ValueError(f"c[{name!r}]: expected a landmark's number, 0 to {count - 1}, got {int(c)}")
    return jnp.asarray(c, jnp.int32)


def of_some_landmark(z: PyTree, number: Array, count: int) -> PyTree:
    """The reading, NaN where the landmark's number is none: inside jit nobody can raise, but the status shows it."""
    inside = (number >= 0) & (number < count)
    return jax.tree.map(lambda a: jnp.where(inside, a, jnp.nan), z)
