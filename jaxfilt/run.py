"""Running a filter over a log: one run, many runs, and the likelihood of what was measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxfilt import doors
from jaxfilt import log as logs
from jaxfilt.types import Array, Filter, Gaussian, Info, Log, PyTree, Track


def scan(
    filter: Filter,
    belief: Gaussian,
    log: Log,
    store: Callable[[Any, dict[str, Info]], PyTree] = Track,
    segment: int | None = None,
) -> Any:
    """Run a filter over a log: ``belief_k = step(belief_{k-1}, row_k)``, under `jax.lax.scan`.

    Not jitted: wrap it, or the function of your parameters that calls it, in `jax.jit`, `jax.vmap`, `jax.grad`.

    Args:
        filter: from `kf`, `ekf`, `ukf`, ...
        belief: the belief before the first row predicts.
        log: T rows.
        store: function of (belief, info) after each row; what it returns is stored, T times. `mean_and_std` and
            `mean_only` are ready-made.
        segment: rows between the beliefs that reverse mode keeps, see `checkpointed`: with the square root of T, memory
            for 2 sqrt(T) beliefs, not for T, and one more forward pass. The result does not depend on it.

    Returns:
        What ``store`` returned, leading axis T; by default `Track` (belief, info).

    Raises:
        ValueError, TypeError, KeyError: at the door, where the belief or the log do not fit the model.

    Example:
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> log = jf.Log(dt=jnp.ones(3), u=(), z={"z": jnp.ones((3, 1))}, c={}, valid={})
        >>> track = jf.scan(jf.kf(walk), jf.Gaussian(jnp.zeros(1), jnp.eye(1)), log)
        >>> track.belief.mean.shape, track.info["z"].nis.shape
        ((3, 1), (3,))
    """
    doors.instance("filter", filter, Filter)
    doors.belief("belief", belief, filter.model.space)
    logs.validate(filter.model, log, belief.cov.dtype)
    dtype = jax.dtypes.canonicalize_dtype(belief.cov.dtype)
    belief, log = jax.tree.map(jnp.asarray, (belief, log))
    belief = jax.tree.map(lambda a: a.astype(dtype), belief)

    def body(b: Gaussian, row: Log) -> tuple[Gaussian, PyTree]:
        b, info = filter.step(b, row)
        return b, store(b, info)

    return checkpointed(body, belief, log, segment)[1]


def checkpointed(body: Callable, carry: PyTree, xs: PyTree, segment: int | None = None) -> tuple[PyTree, PyTree]:
    """`jax.lax.scan` of which reverse mode keeps the carry of each row, or of each segment, and computes the rest anew.

    Args:
        body: (carry, row) -> (carry, what is stored).
        carry: before the first row.
        xs: rows, leading axis T.
        segment: rows between kept carries: then memory is for ``T / segment + segment`` of them. What is left of T by
            a segment that does not divide it is a scan, and a program to compile, of its own.

    Raises:
        ValueError: a segment below 1.

    Source: A. Griewank, Achieving logarithmic growth of temporal and spatial complexity in reverse automatic
    differentiation (1992): its scheme with two levels.
    """
    if segment is not None and segment < 1:
        raise ValueError(f"segment: expected at least one row, got {segment}")
    # A scan's body is its own fence: nothing that is computed again can be merged with what was computed before.
    row = jax.checkpoint(body, prevent_cse=False)
    steps = len(jax.tree.leaves(xs)[0])
    if segment is None or segment >= steps:
        return jax.lax.scan(row, carry, xs)
    whole = steps - steps % segment
    pieces = jax.tree.map(lambda a: a[:whole].reshape(-1, segment, *a.shape[1:]), xs)
    carry, stored = jax.lax.scan(jax.checkpoint(partial(jax.lax.scan, row), prevent_cse=False), carry, pieces)
    stored = jax.tree.map(lambda a: a.reshape(whole, *a.shape[2:]), stored)
    if whole == steps:
        return carry, stored
    carry, rest = jax.lax.scan(row, carry, jax.tree.map(lambda a: a[whole:], xs))
    return carry, jax.tree.map(lambda *parts: jnp.concatenate(parts), stored, rest)


def scan_runs(
    filter: Filter,
    belief: Gaussian,
    log: Log,
    batched: Sequence[str] = Log._fields,
    store: Callable[[Any, dict[str, Info]], PyTree] = Track,
    segment: int | None = None,
) -> Any:
    """Run a filter over many logs at once: `scan` under `jax.vmap`, with the run as leading axis.

    What all runs share is computed once: with ``batched=("z",)`` an absent sensor costs nothing, and the
    covariances of a linear model are those of one run, whatever the number of runs.

    Args:
        filter: from `kf`, `ekf`, `ukf`, ...
        belief: shared by all runs, or with a leading run axis on every leaf.
        log: the logs, with a leading run axis on the fields named in ``batched``.
        batched: fields of the log that differ by run; all by default, as `stack` returns them.
        store, segment: as in `scan`.

    Raises:
        ValueError: an unknown field.
    """
    unknown = [name for name in batched if name not in Log._fields]
    if unknown:
        raise ValueError(f"batched: expected fields of {Log._fields}, got {unknown}")
    belief_axis = 0 if jnp.ndim(belief.cov) == 3 else None
    axes = tuple(0 if name in batched else None for name in Log._fields)

    def one(b: Gaussian, *fields: PyTree) -> Any:
        return scan(filter, b, Log(*fields), store, segment)

    return jax.vmap(one, in_axes=(belief_axis, *axes))(belief, *log)


def log_likelihood(filter: Filter, belief: Gaussian, log: Log, segment: int | None = None) -> jax.Array:
    """log p(z_1 ... z_T): the sum of the log densities of the innovations, ``sum_k log N(r_k; 0, S_k)``.

    Exact for a `kf` on a linear model, also with missing components. A reading that a gate refused adds nothing.

    Args:
        filter, belief, log, segment: as in `scan`.

    Returns:
        A scalar, differentiable in everything.

    Source: S. Sarkka, Bayesian Filtering and Smoothing (2013), eq. 12.38.
    """
    return scan(filter, belief, log, lambda b, info: sum(i.loglik for i in info.values()), segment).sum()


def mean_only(belief: Gaussian, info: dict[str, Info]) -> PyTree:
    """For ``store``: the mean alone."""
    return belief.mean


def mean_and_std(belief: Gaussian, info: dict[str, Info]) -> tuple[PyTree, Array]:
    """For ``store``: the mean, and the standard deviations (n,) of the tangent space."""
    return belief.mean, jnp.sqrt(jnp.diagonal(belief.cov))
