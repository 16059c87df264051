"""The loss of many runs and its gradient, as one compiled program; a run that diverges harms no other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxfilt.devices import finished
from jaxfilt.fold import Objective, View, fold, rows_of, taken
from jaxfilt.loop import Backend, in_lanes, loop
from jaxfilt.tuning.parameters import Parameters
from jaxfilt.tuning.split import Case, over_runs
from jaxfilt.types import Array, Filter, Gaussian, PyTree, Space

PENALTY = 1e6
"""What the loss grows by if all runs diverge: more than any step could gain, and finite."""


class Problem(NamedTuple):
    """What is tuned, all but the data: functions of theta, and how its numbers become one."""

    objective: Objective
    filter: Callable[[PyTree], Filter]
    beliefs: tuple[Callable[[PyTree], Gaussian], ...]
    parameters: Parameters
    space: Space
    view: View
    prior: Callable[[PyTree], Array] | None = None
    segment: int | None = None
    backend: Backend = "auto"


class Evaluated(NamedTuple):
    """For each of S parameter vectors: the ``loss`` (S,), its ``gradient`` (S, p), the runs' sums (S, R, ...), and
    which runs were ``sound`` (S, R)."""

    loss: jax.Array
    gradient: jax.Array
    sums: dict[str, jax.Array]
    sound: jax.Array


Program = Callable[[Array, Case, Any], Evaluated]


def losses(
    problem: Problem, data: Case, axes: Case, starts: int = 1, begin: Any = None, gradient: bool = True
) -> Program:
    """The program (V (S, p), data, begin) -> `Evaluated`, compiled for data of this shape, taken `apart`.

    ``begin``: of pieces of runs, what they go on from: beliefs (S, R, ...). Without ``gradient`` it is cheaper, and
    the gradient is 0.
    """

    def every(lanes: bool) -> Callable:
        def evaluated(v: Array, data: Case, begin: PyTree) -> Evaluated:
            return _evaluated(problem, v, data, begin, axes, gradient, lanes)

        return lambda V, data, begin: jax.vmap(evaluated, in_axes=(0, None, 0))(V, data, begin)

    V = jax.ShapeDtypeStruct((starts, len(problem.parameters.start)), data.log.dt.dtype)
    return in_lanes(
        lambda lanes: compiled(every(lanes), V, data, begin), problem.backend, len(data.run) * data.weight.shape[-1]
    )


def compiled(function: Callable, *arguments: Any) -> Any:
    """A function, compiled for arguments of these shapes."""
    return finished(jax.jit(function).lower(*arguments), jax.default_backend())


def started(problem: Problem, theta: PyTree, case: Case) -> Gaussian:
    """The belief in which one run starts."""
    dtype = case.log.dt.dtype
    each = [jax.tree.map(lambda a: jnp.asarray(a, dtype), belief(theta)) for belief in problem.beliefs]
    return jax.tree.map(lambda *a: jnp.stack(a)[case.run], *each) if len(each) > 1 else each[0]


def _begun(problem: Problem, v: Array, case: Case, begin: PyTree) -> PyTree:
    """What the filter carries where one run starts, or a piece of one goes on."""
    theta = problem.parameters.tree(v)
    start = problem.filter(theta).begin(started(problem, theta, case))
    if begin is None or case.first is None:
        return start
    first = jnp.asarray(case.first)
    return jax.tree.map(lambda a, b: jnp.where(first, a, b), start, begin)


def _sums(problem: Problem, v: Array, case: Case, begin: PyTree) -> dict[str, jax.Array]:
    """Those of one run, or of a piece of one."""
    start, filter = _begun(problem, v, case, begin), problem.filter(problem.parameters.tree(v))
    truth, weight = case.truth, case.weight
    return fold(problem.objective, filter, start, case.log, truth, weight, problem.space, problem.view, problem.segment)


def _every(problem: Problem, data: Case, axes: Case, lanes: bool) -> Callable:
    """(parameters (R, p), beliefs to go on from) -> the sums of all runs."""
    if not lanes:
        return over_runs(lambda v, begin, case: _sums(problem, v, case, begin), data, axes)
    objective, dtype = problem.objective, data.log.dt.dtype

    def take(v: Array, belief: PyTree, row: tuple) -> tuple[PyTree, dict[str, Array]]:
        filter = problem.filter(problem.parameters.tree(v))
        return taken(objective, filter, problem.space, problem.view, dtype)(belief, row)

    def body(v: Array, carry: tuple, row: tuple) -> tuple:
        (belief, sums), (seen, counts) = carry, row
        belief, found = take(v, belief, seen)
        return (belief, {name: sums[name] + jnp.where(counts, a, 0.0) for name, a in found.items()}), ()

    def every(V: Array, begin: PyTree) -> dict[str, jax.Array]:
        beliefs = jax.vmap(lambda v, begin, case: _begun(problem, v, case, begin), (0, 0, axes))(V, begin, data)
        if objective.held:
            split = jax.vmap(lambda case: (rows_of(objective, case.log, case.truth), case.weight), (axes,))
            rows, along = split(data), 0
        else:
            rows, along = ((rows_of(objective, c.log, c.truth), c.weight) for c in (data, axes))
        first = jax.vmap(lambda v, b, rows: take(v, b, jax.tree.map(lambda a: a[0], rows[0]))[1], (0, 0, along))
        nothing = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(first, V, beliefs, rows))
        carry, _ = loop(
            body, V, (beliefs, nothing), rows, runs=len(V), axes=(0, 0, along), outputs=(), backend=problem.backend
        )
        return carry[1]

    return every


def _evaluated(
    problem: Problem, v: Array, data: Case, begin: PyTree, axes: Case, gradient: bool, lanes: bool
) -> Evaluated:
    runs = len(data.run)
    # Each run has parameters of its own, all alike: so its share of the gradient comes out apart, and that of a run
    # that diverged, NaN, can be left out. (A sum over runs of which one is NaN is NaN, whatever is selected before.)
    V = jnp.broadcast_to(v, (runs, len(v)))
    every = _every(problem, data, axes, lanes)
    sums, pull = jax.vjp(lambda V: every(V, begin), V) if gradient else (every(V, begin), None)
    sound = jnp.stack([jnp.isfinite(s.reshape(runs, -1)).all(1) for s in sums.values()]).all(0)
    picked = {name: jnp.where(_like(sound, s), s, 0.0) for name, s in sums.items()}
    total = {name: s.sum(0) for name, s in picked.items()}
    loss, slope = jax.value_and_grad(problem.objective.loss)(total)
    loss += PENALTY * (1 - sound.mean(dtype=loss.dtype))
    whole = jnp.zeros_like(v)
    if pull is not None:
        cotangent = {
            name: jnp.where(_like(sound, s), jnp.broadcast_to(slope[name], s.shape), 0.0) for name, s in sums.items()
        }
        (by_run,) = pull(cotangent)
        sound &= jnp.isfinite(by_run).all(1)
        whole = jnp.where(sound[:, None], by_run, 0.0).sum(0)
    prior = problem.prior
    if prior is not None:
        log_density, ascent = jax.value_and_grad(lambda v: prior(problem.parameters.tree(v)))(v)
        count = jnp.maximum(total["count"], 1.0)
        loss, whole = loss - log_density / count, whole - ascent / count
    return Evaluated(loss, whole, picked, sound)


def _like(flags: Array, array: Array) -> jax.Array:
    return flags.reshape(flags.shape + (1,) * (array.ndim - 1))
