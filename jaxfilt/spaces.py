"""Spaces: what + and - mean for vectors, angles, rotations, and any pytree of them.

Attitude is a Hamilton quaternion (w, x, y, z), body to world, perturbed on the right: ``plus(q, d) = q * Exp(d)``
with d (3,) a rotation vector in the body frame, rad.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.elementary import atan_ratio, cos_and_sinc_of_root, wrap
from jaxfilt.types import PyTree, Space


def vector(n: int) -> Space:
    """R^n: an array (n,) with ordinary + and -.

    Example:
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> jf.vector(2).minus(jnp.array([3.0, 1.0]), jnp.array([1.0, 1.0])).tolist()
        [2.0, 0.0]
    """
    if n < 1:
        raise ValueError(f"vector(n): expected n >= 1, got {n}")
    return Space(n, lambda x, d: x + d, lambda a, b: a - b, np.zeros(n), flat=True)


scalar = Space(1, lambda x, d: x + d[0], lambda a, b: jnp.stack([a - b]), np.zeros(()), flat=True)
"""R: an array of shape (), with tangent (1,)."""

angle = Space(1, lambda x, d: wrap(x + d[0]), lambda a, b: jnp.stack([wrap(a - b)]), np.zeros(()), flat=True)
"""An angle in rad, shape (); differences are wrapped to [-pi, pi]."""


def _so2_plus(x: jax.Array, d: jax.Array) -> jax.Array:
    c, s = jnp.cos(d[0]), jnp.sin(d[0])
    y = jnp.stack([x[0] * c - x[1] * s, x[0] * s + x[1] * c])
    return y / jnp.sqrt(y @ y)


def _so2_minus(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.stack([jnp.arctan2(a[1] * b[0] - a[0] * b[1], a[0] * b[0] + a[1] * b[1])])


so2 = Space(1, _so2_plus, _so2_minus, np.array([1.0, 0.0]), flat=True)
"""A planar rotation as (cos, sin), shape (2,), with tangent (1,) rad: a heading without a seam."""


def quaternion_product(p: jax.Array, q: jax.Array) -> jax.Array:
    """Hamilton product of two quaternions (4,), (w, x, y, z)."""
    pw, px, py, pz = p[0], p[1], p[2], p[3]
    qw, qx, qy, qz = q[0], q[1], q[2], q[3]
    return jnp.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ]
    )


def quaternion_conjugate(q: jax.Array) -> jax.Array:
    """q* of a quaternion (4,): the inverse rotation."""
    return jnp.concatenate([q[:1], -q[1:]])


def rotate(q: jax.Array, v: jax.Array) -> jax.Array:
    """R(q) v: a vector (3,) of the body frame, seen in the world frame.

    Example:
        >>> import math, jax.numpy as jnp, jaxfilt as jf
        >>> quarter_turn = jf.so3_exp(jnp.array([0.0, 0.0, math.pi / 2]))
        >>> [round(float(a), 6) + 0.0 for a in jf.rotate(quarter_turn, jnp.array([1.0, 0.0, 0.0]))]
        [0.0, 1.0, 0.0]
    """
    w, r = q[0], q[1:]
    t = 2 * jnp.cross(r, v)
    return v + w * t + jnp.cross(r, t)


def rotate_back(q: jax.Array, v: jax.Array) -> jax.Array:
    """R(q)' v: a vector (3,) of the world frame, seen in the body frame."""
    return rotate(quaternion_conjugate(q), v)


def so3_exp(d: jax.Array) -> jax.Array:
    """Unit quaternion (4,) of a rotation vector d (3,), rad: ``[cos |d|/2, sin(|d|/2) d/|d|]``."""
    c, s = cos_and_sinc_of_root(0.25 * (d @ d))
    return jnp.concatenate([c[None], 0.5 * s * d])


def so3_log(q: jax.Array) -> jax.Array:
    """Rotation vector (3,), of length at most pi rad, of a unit quaternion (4,); q and -q are the same rotation."""
    q = jnp.where(q[0] < 0, -q, q)
    return 2 * atan_ratio(q[1:] @ q[1:], q[0]) * q[1:]


def _so3_plus(q: jax.Array, d: jax.Array) -> jax.Array:
    p = quaternion_product(q, so3_exp(d))
    return p / jnp.sqrt(p @ p)


so3 = Space(
    3,
    _so3_plus,
    lambda a, b: so3_log(quaternion_product(quaternion_conjugate(b), a)),
    np.array([1.0, 0, 0, 0]),
    flat=False,
)
"""A rotation in space as a unit quaternion (4,), with tangent (3,) rad in the body frame."""


def product(tree: PyTree) -> Space:
    """The product of the spaces at the leaves of any pytree; a point is the same pytree with points at its leaves.

    The tangent vector is the concatenation of the leaves' tangents in the order of ``jax.tree.leaves``.

    Args:
        tree: tuple, dict or NamedTuple of spaces, nested as you like.

    Example:
        >>> import jaxfilt as jf
        >>> pose = jf.product({"pos": jf.vector(3), "att": jf.so3})
        >>> pose.dim
        6
    """
    spaces, structure = jax.tree.flatten(tree, is_leaf=lambda s: isinstance(s, Space))
    strangers = [s for s in spaces if not isinstance(s, Space)]
    if strangers or not spaces:
        raise TypeError(f"product(tree): expected a pytree of Space at its leaves, got {strangers or tree!r}")
    ends = np.cumsum([s.dim for s in spaces]).tolist()
    starts = [end - s.dim for s, end in zip(spaces, ends, strict=True)]

    def plus(x: PyTree, d: jax.Array) -> PyTree:
        points = structure.flatten_up_to(x)
        moved = [s.plus(p, d[i:j]) for s, p, i, j in zip(spaces, points, starts, ends, strict=True)]
        return structure.unflatten(moved)

    def minus(a: PyTree, b: PyTree) -> jax.Array:
        pairs = zip(spaces, structure.flatten_up_to(a), structure.flatten_up_to(b), strict=True)
        return jnp.concatenate([s.minus(p, q) for s, p, q in pairs])

    return Space(ends[-1], plus, minus, structure.unflatten([s.origin for s in spaces]), all(s.flat for s in spaces))
