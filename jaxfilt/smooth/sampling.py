"""Trajectories drawn from what a smoother knows."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxfilt import linalg
from jaxfilt.smooth.interval import at, checked, intervals
from jaxfilt.smooth.links import link
from jaxfilt.types import Array, Filter, Log, PyTree, Track


def sample_trajectories(filter: Filter, track: Track, log: Log, key: Array, n: int) -> PyTree:
    """Trajectories drawn from the smoothed posterior: what may have happened, given the whole log.

    Drawn backwards: the last state from its belief, each before it given the one after it. On a linear model their
    joint distribution over all rows is the posterior, which the covariances of `smooth` alone do not determine.

    Args:
        filter, track, log: as in `smooth`.
        key: of `jax.random`.
        n: how many, >= 1.

    Returns:
        States with leading axes (n, T). Over an interval of ``dt = 0`` a state stays as it is.

    Raises:
        as `smooth`; ValueError: n below 1.

    Example:
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> log = jf.Log(dt=jnp.ones(3), u=(), z={"z": jnp.ones((3, 1))}, c={}, valid={})
        >>> track = jf.scan(jf.kf(walk), jf.Gaussian(jnp.zeros(1), jnp.eye(1)), log)
        >>> sample_trajectories(jf.kf(walk), track, log, jax.random.key(0), 100).shape
        (100, 3, 1)

    Source: S. Godsill, A. Doucet, M. West, Monte Carlo smoothing for nonlinear time series (2004), section 2, with a
    Gaussian in the place of the particles.
    """
    if n < 1:
        raise ValueError(f"n: expected at least one trajectory, got {n}")
    beliefs, log = checked(filter, track, log)
    space, steps = filter.model.space, len(log.dt)
    last = at(beliefs, -1)
    w = jax.random.normal(key, (steps, n, space.dim), last.cov.dtype)
    spread = jax.vmap(space.plus, (None, 0))
    end = spread(last.mean, w[-1] @ _root(last.cov).T)

    def body(after: PyTree, row: tuple) -> tuple[PyTree, PyTree]:
        (before, u, dt), w = row
        found = link(filter, before, u, dt)
        offset = jax.vmap(space.minus, (0, None))(after, found.mean) @ found.gain.T
        drawn = spread(before.mean, offset + w @ _root(found.rest).T)
        drawn = jax.tree.map(lambda a, b: jnp.where(found.moves, a, b), drawn, after)
        return drawn, drawn

    _, rest = jax.lax.scan(body, end, (intervals(beliefs, log), w[:-1]), reverse=True)
    return jax.tree.map(lambda a, b: jnp.moveaxis(jnp.concatenate([a, b[None]]), 0, 1), rest, end)


def _root(P: Array) -> Array:
    """L with ``L L' = P``, its variances raised by some units of rounding, for P may be singular and round below."""
    slack = 8 * len(P) * float(jnp.finfo(P.dtype).eps)
    return linalg.semidefinite_cholesky(P + slack * jnp.diag(jnp.diagonal(P)))
