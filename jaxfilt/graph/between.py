"""Factors between two instants of a trajectory: relative poses, loop closures."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors
from jaxfilt.models.parts import rotated
from jaxfilt.models.wheeled import Pose
from jaxfilt.noise import const
from jaxfilt.spaces import angle, product, quaternion_conjugate, quaternion_product, rotate_back, so3, vector
from jaxfilt.types import Array, Model, PyTree, Space


class Between(NamedTuple):
    """K readings that tell of two instants: ``z = h(a, b, c) + v``, ``v ~ N(0, R(a, b, c))``, on ``space``.

    a and b are the states after the rows ``rows`` (K, 2) of the log; -1 is the state before the first row. ``z`` and
    ``c`` have a leading axis K. ``robust``: as in `optimise`, for these readings.
    """

    rows: Array
    z: PyTree
    h: Callable[[PyTree, PyTree, PyTree], PyTree]
    R: Callable[[PyTree, PyTree, PyTree], Array]
    space: Space
    c: PyTree = ()
    robust: float | None = None


class Placement(NamedTuple):
    """One pose in space, seen from another."""

    pos: Array
    """(3,) m, in the body frame of the first."""
    att: Array
    """(4,) quaternion: the second body frame to the first."""


PLANE = product(Pose(vector(2), angle))
SPACE = product(Placement(vector(3), so3))


def planar(rows: Array, z: Pose, R: Array, robust: float | None = None) -> Between:
    """Relative poses in the plane: where the robot of the second row stands, as seen from the first.

    ``z = (Rot(yaw_a)' (pos_b - pos_a), yaw_b - yaw_a)``, for states with fields ``pos`` (2,) and ``yaw``.

    Args:
        rows: (K, 2), rows of the log.
        z: `jaxfilt.models.wheeled.Pose` with leading axis K: m, forward and left; rad.
        R: (3, 3) covariance, m^2, m rad, rad^2.
        robust: as in `optimise`.

    Example: two metres ahead, facing back.
        >>> import math, jax.numpy as jnp
        >>> tie = planar([[0, 1]], Pose(jnp.zeros((1, 2)), jnp.zeros(1)), jnp.eye(3))
        >>> a = Pose(jnp.array([1.0, 0.0]), jnp.asarray(math.pi / 2))
        >>> seen = tie.h(a, Pose(jnp.array([1.0, 2.0]), jnp.asarray(-math.pi / 2)), ())
        >>> (seen.pos.round(4) + 0.0).tolist(), round(abs(float(seen.yaw)), 4)
        ([2.0, 0.0], 3.1416)

    Source: G. Grisetti, R. Kummerle, C. Stachniss, W. Burgard, A tutorial on graph-based SLAM (2010), eq. 30.
    """

    def h(a: PyTree, b: PyTree, c: PyTree) -> Pose:
        return Pose(rotated(-a.yaw, b.pos - a.pos), angle.minus(b.yaw, a.yaw)[0])

    return Between(np.asarray(rows), z, h, _noise(R), PLANE, robust=robust)


def spatial(rows: Array, z: Placement, R: Array, robust: float | None = None) -> Between:
    """Relative poses in space: ``z = (R(att_a)' (pos_b - pos_a), att_a* att_b)``.

    For states with fields ``pos`` (3,) and ``att`` (4,).

    Args:
        rows: (K, 2), rows of the log.
        z: `Placement` with leading axis K.
        R: (6, 6) covariance of position (m^2) and attitude (rad^2).
        robust: as in `optimise`.
    """

    def h(a: PyTree, b: PyTree, c: PyTree) -> Placement:
        turn = quaternion_product(quaternion_conjugate(a.att), b.att)
        return Placement(rotate_back(a.att, b.pos - a.pos), turn)

    return Between(np.asarray(rows), z, h, _noise(R), SPACE, robust=robust)


def _noise(R: Array) -> Callable:
    of = const(np.asarray(R))
    return lambda a, b, c: jnp.asarray(of(), a.pos.dtype)


def check(k: int, tie: Between, length: int, model: Model, dtype: jnp.dtype) -> Between:
    """The factor as arrays, checked: complaints name ``between[k]``."""
    name = f"between[{k}]"
    doors.instance(name, tie, Between)
    rows = jnp.asarray(tie.rows)
    if rows.ndim != 2 or rows.shape[1] != 2 or not len(rows) or not jnp.issubdtype(rows.dtype, jnp.integer):
        raise ValueError(f"{name}.rows: expected pairs of rows, (K, 2) integers, K >= 1, got {doors.describe(rows)}")
    if doors.is_concrete(tie.rows):
        listed = np.asarray(tie.rows)
        outside = (listed < -1) | (listed >= length)
        if outside.any():
            raise ValueError(f"{name}.rows: expected rows -1 to {length - 1}, got {listed[outside][0]}")
        if (listed[:, 0] == listed[:, 1]).any():
            same = listed[listed[:, 0] == listed[:, 1]][0, 0]
            raise ValueError(f"{name}.rows: expected two different rows, got {same} twice")
    doors.point(f"{name}.z", tie.z, tie.space, leading=(len(rows),))
    doors.finite(f"{name}.z", tie.z)
    doors.leading(f"{name}.c", tie.c, len(rows))
    doors.finite(f"{name}.c", tie.c)
    doors.same_dtype(dtype, **{f"{name}.z": tie.z, f"{name}.c": tie.c})
    z = jax.tree.map(lambda a: jnp.asarray(a, dtype), tie.z)
    return tie._replace(rows=rows + 1, z=z, c=jax.tree.map(jnp.asarray, tie.c))
