"""Running a filter over a log: one run, many runs, and the likelihood of what was measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxfilt import doors
from jaxfilt import log as logs
from jaxfilt.loop import Backend, Kept, checkpointed, loop
from jaxfilt.parallel import filtered
from jaxfilt.prediction import dtype_of
from jaxfilt.types import Array, Filter, Gaussian, Info, Log, PyTree, Track


def scan(
    filter: Filter,
    belief: Any,
    log: Log,
    store: Callable[[Any, dict[str, Info]], PyTree] = Track,
    segment: int | None = None,
    parallel: bool = False,
) -> Any:
    """Run a filter over a log: ``belief_k = step(belief_{k-1}, row_k)``, under `jax.lax.scan`.

    Not jitted: wrap it, or the function of your parameters that calls it, in `jax.jit`, `jax.vmap`, `jax.grad`.

    Args:
        filter: from `kf`, `ekf`, `ukf`, ...
        belief: before the first row predicts: a Gaussian, or what else the filter carries (its `begin` makes it).
        log: T rows.
        store: function of (belief, info) after each row; what it returns is stored, T times. `mean_and_std` and
            `mean_only` are ready-made.
        segment: rows between the beliefs that reverse mode keeps, see `checkpointed`: with the square root of T, memory
            for 2 sqrt(T) beliefs, not for T, and one more forward pass. The result does not depend on it.
        parallel: all segments (by default about sqrt(T) of as many rows) at once, what they start with from an
            associative scan; the same to rounding. For a `kf` or `ekf` without gate and robust, of a model
            that is linear in x, its readings' noise positive definite.

    Returns:
        What ``store`` returned, leading axis T; by default `Track` (belief, info).

    Raises:
        ValueError, TypeError, KeyError: at the door, where the belief or the log do not fit the model; with
            ``parallel`` also another filter or model than those.

    Example:
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> log = jf.Log(dt=jnp.ones(3), u=(), z={"z": jnp.ones((3, 1))}, c={}, valid={})
        >>> track = jf.scan(jf.kf(walk), jf.Gaussian(jnp.zeros(1), jnp.eye(1)), log)
        >>> track.belief.mean.shape, track.info["z"].nis.shape
        ((3, 1), (3,))

    Source of the parallel form: S. Sarkka, A. F. Garcia-Fernandez, Temporal parallelization of Bayesian smoothers, IEEE
    Trans. Automatic Control 66(1) (2021).
    """
    doors.instance("filter", filter, Filter)
    belief, log = _checked(filter, belief, log)
    if parallel:
        return filtered(filter, belief, log, store, segment)

    def body(b: PyTree, row: Log) -> tuple[PyTree, PyTree]:
        b, info = filter.step(b, row)
        return b, store(b, info)

    return checkpointed(body, belief, log, segment)[1]


def _checked(filter: Filter, belief: Any, log: Log) -> tuple[Any, Log]:
    """The belief and the log as arrays, the belief in one dtype."""
    belief = filter.begin(belief)
    logs.validate(filter.model, log, dtype_of(belief))
    return belief, jax.tree.map(jnp.asarray, log)


def scan_runs(
    filter: Filter,
    belief: Any,
    log: Log,
    batched: Sequence[str] = Log._fields,
    store: Callable[[Any, dict[str, Info]], PyTree] = Track,
    segment: int | None = None,
    backend: Backend = "auto",
) -> Any:
    """Run a filter over many logs at once: `scan` under `jax.vmap`, with the run as leading axis.

    What all runs share is computed once: with ``batched=("z",)`` an absent sensor costs nothing, and XLA computes the
    covariances of a linear model for one run, whatever the number of runs.

    On a CPU with llvmlite (``pip install 'jaxfilt[fast]'``) long batches are compiled to lanes: the step becomes one
    loop of vector instructions over a register of runs, tens of times as fast as XLA. Call it inside `jax.jit`, so
    that it is traced and compiled once; what is not an argument there is compiled in as a constant.

    Args:
        filter: from `kf`, `ekf`, `ukf`, ...
        belief: shared by all runs, or with a leading run axis on every leaf. What is drawn has one: ``jax.vmap(lambda
            key: filter.begin(belief, key))(keys)``.
        log: the logs, with a leading run axis on the fields named in ``batched``.
        batched: fields of the log that differ by run; all by default, as `stack` returns them.
        store, segment: as in `scan`.
        backend: "lanes"; "xla": `jax.lax.scan` under `jax.vmap`, on any platform and twice differentiable; "auto":
            lanes where they are to be had, can compute the filter and have enough to do, XLA otherwise. A reason other
            than the last is logged once. The answers are the same to rounding.

    Raises:
        ValueError: an unknown field, an unknown back end, or lanes where they are not to be had.
        jaxfilt.lanes.Unsupported: with "lanes", an operation of the filter that they cannot compute, by name.

    Example:
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> log = jf.Log(dt=jnp.ones(3), u=(), z={"z": jnp.ones((500, 3, 1))}, c={}, valid={})
        >>> tracks = jf.scan_runs(jf.kf(walk), jf.Gaussian(jnp.zeros(1), jnp.eye(1)), log, batched=("z",))
        >>> tracks.belief.mean.shape
        (500, 3, 1)
    """
    doors.instance("filter", filter, Filter)
    unknown = [name for name in batched if name not in Log._fields]
    if unknown:
        raise ValueError(f"batched: expected fields of {Log._fields}, got {unknown}")
    belief_axis = 0 if _is_batch(filter, belief) else None
    axes: Any = Log._make(0 if name in batched else None for name in Log._fields)
    differ = [leaf for name in batched for leaf in jax.tree.leaves(getattr(log, name))]
    if belief_axis is None and not differ:
        raise ValueError(f"batched: expected a belief or fields of the log that differ by run, got {tuple(batched)}")
    runs = len(jax.tree.leaves(belief)[0] if belief_axis == 0 else differ[0])
    look = jax.vmap(lambda b, *fields: _checked(filter, b, Log(*fields)), (belief_axis, *axes), (belief_axis, axes))
    belief, log = look(belief, *log)

    def body(_: PyTree, b: PyTree, row: Log) -> tuple[PyTree, tuple]:
        b, info = filter.step(b, row)
        return b, (store(b, info),)

    options: dict[str, Any] = {"runs": runs, "axes": (None, belief_axis, axes), "segment": segment, "backend": backend}
    _, (stored,) = loop(body, (), belief, log, outputs=[Kept()], **options)
    return stored


def _is_batch(filter: Filter, belief: Any) -> bool:
    """Whether each run has its own: one more axis than what the filter would carry of one run."""
    if isinstance(belief, Gaussian):
        return jnp.ndim(belief.cov) == 3
    origin = Gaussian(filter.model.space.origin, jnp.eye(filter.model.space.dim))
    one = jax.eval_shape(lambda: filter.begin(origin, jax.random.key(0)))
    return jnp.ndim(jax.tree.leaves(belief)[0]) > jnp.ndim(jax.tree.leaves(one)[0])


def log_likelihood(
    filter: Filter, belief: Any, log: Log, segment: int | None = None, parallel: bool = False
) -> jax.Array:
    """log p(z_1 ... z_T): the sum of the log densities of the innovations, ``sum_k log N(r_k; 0, S_k)``.

    Exact for a `kf` on a linear model, also with missing components. A reading that a gate refused adds nothing.

    Args:
        filter, belief, log, segment, parallel: as in `scan`.

    Returns:
        A scalar, differentiable in everything.

    Source: S. Sarkka, Bayesian Filtering and Smoothing (2013), eq. 12.38.
    """
    return scan(filter, belief, log, lambda b, info: sum(i.loglik for i in info.values()), segment, parallel).sum()


def mean_only(belief: Gaussian, info: dict[str, Info]) -> PyTree:
    """For ``store``: the mean alone."""
    return belief.mean


def mean_and_std(belief: Gaussian, info: dict[str, Info]) -> tuple[PyTree, Array]:
    """For ``store``: the mean, and the standard deviations (n,) of the tangent space."""
    return belief.mean, jnp.sqrt(jnp.diagonal(belief.cov))
