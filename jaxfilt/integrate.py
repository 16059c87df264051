"""From continuous dynamics to one step of length dt, on any space."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxfilt.types import Array, PyTree, Space

Rate = Callable[[PyTree, PyTree], PyTree]


def euler(rate: Rate, space: Space) -> Callable[[PyTree, PyTree, Array], PyTree]:
    """Explicit Euler: ``x' = plus(x, dt rate(x, u))``, first order.

    Args:
        rate: function of (x, u); the tangent velocity as a vector (dim,), or a pytree whose leaves, in order, make
            it up (for an attitude: the angular velocity (3,) in the body frame, rad/s).
        space: the state's space.

    Returns:
        ``f(x, u, dt)`` for a `Model`.
    """
    velocity = _tangent(rate, space)
    return lambda x, u, dt: space.plus(x, dt * velocity(x, u))


def rk4(rate: Rate, space: Space, substeps: int = 1) -> Callable[[PyTree, PyTree, Array], PyTree]:
    """Classical Runge-Kutta, fourth order on curved spaces too, the input held over the step.

    Solves for the tangent vector d(t) with ``x(t) = plus(x0, d(t))``: ``d' = D minus(plus(plus(x0, d), e), x0) rate``,
    the derivative with respect to e at 0, which is the identity where the space is flat.

    Args:
        rate: as in `euler`.
        space: the state's space.
        substeps: equal steps within dt.

    Example: a quarter turn at constant body rate is exact.
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> f = jf.rk4(lambda q, u: u, jf.so3)
        >>> q = f(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, jnp.pi / 2]), 1.0)
        >>> [round(float(a), 4) for a in q]
        [0.7071, 0.0, 0.0, 0.7071]

    Source: Hairer, Lubich, Wanner, Geometric Numerical Integration (2006), section IV.8, in the chart of plus.
    """
    if substeps < 1:
        raise ValueError(f"rk4(substeps): expected at least 1, got {substeps}")
    velocity = _tangent(rate, space)

    def one(x0: PyTree, u: PyTree, dt: Array) -> PyTree:
        def slope(d: Array) -> Array:
            x = space.plus(x0, d)
            v = velocity(x, u)
            if space.flat:
                return v
            return jax.jvp(lambda e: space.minus(space.plus(x, e), x0), (jnp.zeros_like(d),), (v,))[1]

        k1 = velocity(x0, u)
        k2 = slope(0.5 * dt * k1)
        k3 = slope(0.5 * dt * k2)
        k4 = slope(dt * k3)
        return space.plus(x0, dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4))

    def f(x: PyTree, u: PyTree, dt: Array) -> PyTree:
        for _ in range(substeps):
            x = one(x, u, dt / substeps)
        return x

    return f


def _tangent(rate: Rate, space: Space) -> Rate:
    def velocity(x: PyTree, u: PyTree) -> Array:
        leaves = [jnp.atleast_1d(leaf) for leaf in jax.tree.leaves(rate(x, u))]
        v = leaves[0] if len(leaves) == 1 else jnp.concatenate(leaves)
        if v.shape != (space.dim,):
            raise ValueError(f"rate(x, u): expected leaves that make up a tangent vector ({space.dim},), got {v.shape}")
        return v

    return velocity
