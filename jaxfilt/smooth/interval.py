"""Fixed interval: the smoother of a whole log, and what it may be run on."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxfilt import doors
from jaxfilt import log as logs
from jaxfilt.smooth.links import back, link, with_transition
from jaxfilt.smooth.parallel import smoothed
from jaxfilt.types import Array, Filter, Gaussian, Log, PyTree, Track


class Smoothed(NamedTuple):
    """What a smoother returns: the ``belief`` after each row given all rows, leading axis T.

    ``cross`` (T - 1, n, n) is the covariance of each row's state with the next row's, as the M step of expectation
    maximisation needs it; on a curved space in the tangent spaces at the two smoothed means.
    """

    belief: Gaussian
    cross: Array


def smooth(filter: Filter, track: Track, log: Log, parallel: bool = False) -> Smoothed:
    """Rauch-Tung-Striebel smoother of any Kalman filter: the belief after each row, given the whole log.

    Exact for a `kf` on a linear model; for others the smoother of the same transform (extended, unscented, cubature).
    Gates and robust updates count as they went when filtering. Not jitted, like `scan`; for many runs
    ``jax.vmap(lambda track, log: smooth(filter, track, log))``. Differentiable, also through the filter.

    To smooth the belief before the first row too, begin the log with a row of ``dt = 0`` and no reading.

    Args:
        filter: from `kf`, `ekf`, `iekf`, `ukf`, `ckf`, `build`.
        track: what `scan` returned for this filter and log.
        log: T rows.
        parallel: all rows at once, by `jax.lax.associative_scan`; the same to rounding. For states on a flat space.

    Returns:
        Smoothed(belief, cross). A row after which no time passes has the next row's belief, without ``parallel`` to the
        bit.

    Raises:
        TypeError, ValueError: a filter without a transition, a track or a log that does not fit; where values can be
            seen, a belief that is not finite, which would spoil all rows before it; ``parallel`` on a curved space.

    Example: a walk seen twice; the second reading says something of the first instant too.
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> log = jf.Log(dt=jnp.ones(2), u=(), z={"z": jnp.array([[0.0], [3.0]])}, c={}, valid={})
        >>> track = jf.scan(jf.kf(walk), jf.Gaussian(jnp.zeros(1), jnp.eye(1)), log)
        >>> smoothed = smooth(jf.kf(walk), track, log)
        >>> [[round(float(m), 3) for m in b.mean[:, 0]] for b in (track.belief, smoothed.belief)]
        [[0.0, 1.875], [0.75, 1.875]]

    Source: S. Sarkka, Bayesian Filtering and Smoothing (2013), algorithms 8.1, 9.1 and 10.1; the covariance as a
    product as in G. J. Bierman, Fixed interval smoothing with discrete measurements (1973).
    """
    beliefs, log = checked(filter, track, log)
    space = filter.model.space
    if parallel:
        return Smoothed(*smoothed(filter, beliefs, log))

    def body(after: Gaussian, row: tuple) -> tuple[Gaussian, Smoothed]:
        before, u, dt = row
        belief, cross = back(space, before, link(filter, before, u, dt), after)
        return belief, Smoothed(belief, cross)

    last = at(beliefs, -1)
    _, rest = jax.lax.scan(body, last, intervals(beliefs, log), reverse=True)
    belief = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), rest.belief, last)
    return Smoothed(belief, rest.cross)


def checked(filter: Filter, track: Track, log: Log) -> tuple[Gaussian, Log]:
    """The track's beliefs and the log, as arrays of one dtype."""
    with_transition(filter)
    doors.instance("track", track, Track)
    beliefs, space = track.belief, filter.model.space
    doors.instance("track.belief", beliefs, Gaussian)
    doors.array("track.belief.cov", beliefs.cov)
    dtype = jax.dtypes.canonicalize_dtype(beliefs.cov.dtype)
    logs.validate(filter.model, log, dtype)
    steps = len(log.dt)
    doors.point("track.belief.mean", beliefs.mean, space, (steps,))
    if beliefs.cov.shape != (steps, space.dim, space.dim):
        expected = (steps, space.dim, space.dim)
        raise ValueError(f"track.belief.cov: expected shape {expected}, got {beliefs.cov.shape}")
    doors.same_dtype(dtype, **{"track.belief.mean": beliefs.mean})
    doors.finite("track.belief.mean", beliefs.mean)
    doors.finite("track.belief.cov", beliefs.cov)
    return jax.tree.map(lambda a: jnp.asarray(a, dtype), beliefs), jax.tree.map(jnp.asarray, log)


def intervals(beliefs: Gaussian, log: Log) -> tuple[Gaussian, PyTree, Array]:
    """What lies between rows: the belief before, the input, and the time that passes; leading axis T - 1."""
    return jax.tree.map(lambda a: a[:-1], beliefs), jax.tree.map(lambda a: a[1:], log.u), log.dt[1:]


def at(tree: PyTree, k: int) -> PyTree:
    return jax.tree.map(lambda a: a[k], tree)
