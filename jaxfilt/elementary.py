"""Elementary functions with finite, right derivatives where the textbook form divides by zero.

`jnp.where` picks a value but differentiates both branches, so each function guards the *inputs* of the branch
that it does not take. Near the removable singularity a power series replaces the quotient, far enough out that
the quotient's derivatives have not yet lost their digits in float32.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp


def wrap(angle: jax.Array) -> jax.Array:
    """The same angle (rad) in [-pi, pi]; its derivative is 1 everywhere."""
    return angle - 2 * math.pi * jnp.round(angle / (2 * math.pi))


def norm(v: jax.Array) -> jax.Array:
    """Euclidean length of a vector (n,); at zero its derivative is 0, not NaN."""
    square = v @ v
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def bearing(p: jax.Array) -> jax.Array:
    """Direction atan2(y, x) of a point (2,) (m), rad; at zero distance it is 0 with derivative 0."""
    somewhere = p @ p > 0  # not p != 0: the derivative divides by this square, which underflows earlier
    return jnp.where(somewhere, jnp.arctan2(p[1], jnp.where(somewhere, p[0], 1.0)), 0.0)


def _series(coefficients: list[float], y: jax.Array) -> jax.Array:
    total = jnp.zeros_like(y)
    for a in reversed(coefficients):
        total = total * y + a
    return total


_SINC = [(-1) ** k / math.factorial(2 * k + 1) for k in range(8)]
_COSC = [(-1) ** k / math.factorial(2 * k + 2) for k in range(8)]
_ATANC = [(-1) ** k / (2 * k + 1) for k in range(10)]


def sinc(x: jax.Array) -> jax.Array:
    """sin(x) / x, 1 at zero."""
    small = jnp.abs(x) < 0.5
    far = jnp.where(small, 1.0, x)
    return jnp.where(small, _series(_SINC, x * x), jnp.sin(far) / far)


def cosc(x: jax.Array) -> jax.Array:
    """(1 - cos(x)) / x, 0 at zero."""
    small = jnp.abs(x) < 0.5
    far = jnp.where(small, 1.0, x)
    return jnp.where(small, x * _series(_COSC, x * x), (1 - jnp.cos(far)) / far)


def cos_and_sinc_of_root(y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(cos r, sin(r) / r) with r = sqrt(y), y >= 0: smooth in y, so that a zero rotation vector is no corner."""
    small = y < 0.25
    r = jnp.sqrt(jnp.where(small, 1.0, y))
    near = [(-1) ** k / math.factorial(2 * k) for k in range(8)]
    return jnp.where(small, _series(near, y), jnp.cos(r)), jnp.where(small, _series(_SINC, y), jnp.sin(r) / r)


def atan_ratio(s2: jax.Array, c: jax.Array) -> jax.Array:
    """atan2(s, c) / s with s = sqrt(s2) >= 0 and c >= 0 not both zero; smooth in s2 at zero."""
    small = s2 < 0.02 * c * c
    s = jnp.sqrt(jnp.where(small, 1.0, s2))
    near = jnp.where(small, c, 1.0)
    return jnp.where(small, _series(_ATANC, s2 / (near * near)) / near, jnp.arctan2(s, c) / s)
