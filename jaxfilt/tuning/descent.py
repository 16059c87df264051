"""The way down: steps of an optimizer from several starts at once, refused where a filter diverges, kept on disk.

The loss and its gradient are compiled once; what is here runs on the host, between their calls.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxfilt.tuning.batches import Batches
from jaxfilt.tuning.loss import Evaluated
from jaxfilt.tuning.parameters import covers
from jaxfilt.types import Array, PyTree

LBFGS = "lbfgs"
MEMORY = 10
"""Steps that L-BFGS remembers."""

ARMIJO, WOLFE = 1e-4, 0.9
"""Of the line search: the least decrease and the least flattening, as shares of the slope where it began."""

TRIALS = 25
"""Steps that a line search tries at most."""

REACH = 2.0
"""The furthest that one number moves in the first trial of a line search: for a logarithm, a factor of 7."""


LEAST = 1e-10
"""Gain of a step, as a share of the loss (or in its own unit, where the loss is small), at which L-BFGS has arrived."""


class Descent(NamedTuple):
    """How to go down: ``optimizer``, "lbfgs" or a transformation of optax; ``steps`` at most; ``patience``: steps
    without a better validation loss after which a start stops; ``clip``: see `jaxfilt.tune`; ``names`` of the
    parameters."""

    optimizer: Any
    steps: int
    patience: int
    clip: float | Mapping[str, float] | None
    names: tuple[str, ...]


class Way(NamedTuple):
    """Where a descent is: of S starts, from ``origin``, the vectors ``V`` (S, p) with ``loss`` (S,), ``gradient``
    (S, p) and ``lost`` (S,) runs there; the ``memory`` of the optimizer; the ``lowest`` validation losses by run
    (S, R) so far; the vectors that were kept as ``best``, their score and their step; how long each start has
    ``waited`` for better ones, and whether it is ``done``; and the history, (steps, S, ...), NaN where it is not
    written yet."""

    step: np.ndarray
    origin: np.ndarray
    V: np.ndarray
    loss: np.ndarray
    gradient: np.ndarray
    lost: np.ndarray
    memory: PyTree
    lowest: np.ndarray
    best: np.ndarray
    best_score: np.ndarray
    best_step: np.ndarray
    waited: np.ndarray
    done: np.ndarray
    losses: np.ndarray
    validations: np.ndarray
    gradients: np.ndarray
    path: np.ndarray
    refused: np.ndarray
    seconds: np.ndarray


def begun(plan: Descent, V: np.ndarray, batches: Batches, validate: Callable | None) -> Way:
    """Before the first step; ``validate``: parameters (S, p) -> validation losses by run (S, R)."""
    S, p = V.shape
    at = batches(V, 0, V)
    loss, gradient = np.asarray(at.loss), np.asarray(at.gradient)
    judged = loss[:, None] if validate is None else validate(V)
    never = np.full((plan.steps, S), np.nan)
    return Way(
        step=np.array(0),
        origin=V,
        V=V,
        loss=loss,
        gradient=gradient,
        lost=_lost(at),
        memory=jax.device_get(_memory(plan)(jnp.asarray(V))),
        lowest=judged,
        best=V,
        best_score=judged.mean(1),
        best_step=np.zeros(S, int),
        waited=np.zeros(S, int),
        done=np.zeros(S, bool),
        losses=never,
        validations=never,
        gradients=never,
        path=np.full((plan.steps, S, p), np.nan),
        refused=np.zeros((plan.steps, S), bool),
        seconds=np.full(plan.steps, np.nan),
    )


def steps(plan: Descent, way: Way, batches: Batches, validate: Callable | None) -> Iterator[Way]:
    """One `Way` after the other, until all starts are done."""
    move = _line_search_step if plan.optimizer == LBFGS else _gradient_step
    began = time.perf_counter() - (way.seconds[way.step - 1] if way.step else 0.0)
    while way.step < plan.steps and not way.done.all():
        k = int(way.step)
        after, refused, stuck = move(plan, way, batches)
        judged = after.loss[:, None] if validate is None else validate(after.V)
        score, lower = judged.mean(1), judged.mean(1) < way.lowest.mean(1)
        lowest = np.where(lower[:, None], judged, way.lowest)
        better = ~way.done & np.isfinite(score) & (lower | _as_good(judged, lowest))
        waited = np.where(better, 0, way.waited + 1)
        tired = (waited >= plan.patience) & (validate is not None or not batches.full)
        yield (
            way := after._replace(
                step=np.array(k + 1),
                lowest=np.where(way.done[:, None], way.lowest, lowest),
                best=np.where(better[:, None], after.V, way.best),
                best_score=np.where(better, score, way.best_score),
                best_step=np.where(better, k + 1, way.best_step),
                waited=waited,
                done=way.done | tired | stuck,
                losses=_written(way.losses, k, np.where(way.done, np.nan, after.loss)),
                validations=_written(way.validations, k, score if validate is not None else np.nan),
                gradients=_written(way.gradients, k, np.linalg.norm(after.gradient, axis=1)),
                path=_written(way.path, k, after.V),
                refused=_written(way.refused, k, refused),
                seconds=_written(way.seconds, k, time.perf_counter() - began),
            )
        )


def _written(history: np.ndarray, k: int, value: Any) -> np.ndarray:
    history = history.copy()
    history[k] = value
    return history


def _as_good(judged: np.ndarray, lowest: np.ndarray) -> np.ndarray:
    """Whether validation losses by run (S, R) are within a standard error of the lowest there were. A step further down
    the training loss is kept then: to stop at the lowest of a few noisy numbers would be to stop by chance."""
    runs = judged.shape[1]
    if runs < 2:
        return np.zeros(len(judged), bool)
    worse = judged - lowest
    return worse.mean(1) <= worse.std(1, ddof=1) / np.sqrt(runs)


def _anchor(way: Way, batches: Batches, step: int, V: np.ndarray) -> np.ndarray:
    """The parameters with which the epoch of a step began: V itself in its first step."""
    first = step - step % batches.each
    return V if first == step else way.origin if first == 0 else way.path[first - 1]


def _lost(at: Evaluated) -> np.ndarray:
    """How many runs of each start diverged."""
    return (~np.asarray(at.sound)).sum(1)


def _line_search_step(plan: Descent, way: Way, batches: Batches) -> tuple[Way, np.ndarray, np.ndarray]:
    """L-BFGS, with a line search for the weak Wolfe conditions by bisection. Returns the next way, which starts had a
    trial refused, and which can go no further.

    optax's own line search is traced into the program and has the filter compiled three times over; this one calls the
    program that is there, for all starts at once, and takes a trial at which a filter diverges for one that is too
    long.

    Source: Lewis, Overton, Nonsmooth optimization via quasi-Newton methods (2013), algorithm 2.6.
    """
    direction, memory = jax.device_get(_lbfgs()(way.gradient, way.memory, way.V))
    slope = (direction * way.gradient).sum(1)
    uphill = ~(slope < 0)
    direction = np.where(uphill[:, None], -way.gradient, direction)
    slope = np.where(uphill, -(way.gradient**2).sum(1), slope)
    longest = np.abs(direction).max(1)
    low, high = np.zeros(len(slope)), np.full(len(slope), np.inf)
    t = np.minimum(1.0, REACH / np.maximum(longest, np.finfo(float).tiny))
    settled = way.done | (slope == 0)
    refused = np.zeros(len(slope), bool)
    at_best = way
    for _ in range(TRIALS):
        if settled.all():
            break
        V = np.where(settled[:, None], at_best.V, way.V + (t[:, None] * direction).astype(way.V.dtype))
        at = batches(V, int(way.step), _anchor(way, batches, int(way.step), V))
        loss, gradient, lost = np.asarray(at.loss), np.asarray(at.gradient), _lost(at)
        refused |= ~settled & ((lost > way.lost) | ~np.isfinite(loss))
        sound = np.isfinite(loss) & np.isfinite(gradient).all(1)
        lower = sound & (loss <= way.loss + ARMIJO * t * slope)
        flatter = (gradient * direction).sum(1) >= WOLFE * slope
        take = ~settled & lower
        at_best = at_best._replace(
            V=np.where(take[:, None], V, at_best.V),
            loss=np.where(take, loss, at_best.loss),
            gradient=np.where(take[:, None], gradient, at_best.gradient),
            lost=np.where(take, lost, at_best.lost),
        )
        settled |= lower & flatter
        low, high = np.where(lower, t, low), np.where(lower, high, t)
        t = np.where(np.isfinite(high), 0.5 * (low + high), 2 * t)
    gained = way.loss - at_best.loss
    least = max(LEAST, 4 * float(np.finfo(way.loss.dtype).eps))
    stuck = gained <= least * np.maximum(1.0, np.abs(way.loss))
    return at_best._replace(memory=memory), refused, stuck


def _gradient_step(plan: Descent, way: Way, batches: Batches) -> tuple[Way, np.ndarray, np.ndarray]:
    """A step of an optax transformation; where it makes more runs diverge, half of it, and half of that again."""
    clipped = _clipped(plan, way.gradient)
    update, memory = jax.device_get(_transformed(plan.optimizer)(clipped, way.memory, way.V))
    update = np.where(way.done[:, None], 0.0, update).astype(way.V.dtype)
    refused = np.zeros(len(update), bool)
    trial = 0
    while True:
        V, trial = way.V + update, trial + 1
        at = batches(V, int(way.step) + 1, _anchor(way, batches, int(way.step) + 1, V))
        loss, gradient, lost = np.asarray(at.loss), np.asarray(at.gradient), _lost(at)
        bad = (lost > way.lost) | ~np.isfinite(loss) | ~np.isfinite(gradient).all(1)
        refused |= bad
        if not bad.any() or trial == TRIALS:
            break
        update = np.where(bad[:, None], 0.5 * update, update)
    stuck = bad  # nothing along the way down is sound
    keep = bad[:, None]
    after = way._replace(
        V=np.where(keep, way.V, V),
        loss=np.where(bad, way.loss, loss),
        gradient=np.where(keep, way.gradient, gradient),
        lost=np.where(bad, way.lost, lost),
        memory=memory,
    )
    return after, refused, stuck


def _clipped(plan: Descent, gradient: np.ndarray) -> np.ndarray:
    """The gradient (S, p) with its norm, or that of the numbers that a name covers, limited."""
    if plan.clip is None:
        return gradient
    limits = plan.clip if isinstance(plan.clip, Mapping) else {"": plan.clip}
    gradient = gradient.copy()
    for name, most in limits.items():
        own = np.array([not name or covers(name, n) for n in plan.names])
        norm = np.linalg.norm(gradient[:, own], axis=1, keepdims=True)
        gradient[:, own] *= np.minimum(1.0, most / np.maximum(norm, np.finfo(float).tiny)).astype(gradient.dtype)
    return gradient


def _memory(plan: Descent) -> Callable[[Array], PyTree]:
    transformation = _lbfgs_of_optax() if plan.optimizer == LBFGS else plan.optimizer
    return jax.vmap(transformation.init)


def _lbfgs_of_optax() -> optax.GradientTransformation:
    return optax.chain(optax.scale_by_lbfgs(MEMORY), optax.scale(-1.0))


@functools.lru_cache(maxsize=1)
def _lbfgs() -> Callable:
    """(gradient, memory, V) -> (direction, memory), for all starts at once."""
    return _updated(_lbfgs_of_optax())


@functools.lru_cache(maxsize=8)
def _transformed(transformation: optax.GradientTransformation) -> Callable:
    return _updated(transformation)


def _updated(transformation: optax.GradientTransformation) -> Callable:
    """Its update, compiled, for all starts at once; by JAX's ordinary rules of promotion, which optax needs, whatever
    the user has set."""

    def one(gradient: Array, memory: PyTree, v: Array) -> tuple[Any, Any]:
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            return transformation.update(gradient, memory, v)

    return jax.jit(jax.vmap(one))
