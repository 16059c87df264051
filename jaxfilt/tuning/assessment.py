"""What a tuning is worth: how sure its parameters are, how much they gain on data they did not see; in words."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import consistency, doors
from jaxfilt.fit import BEFORE, ESTIMATED, TUNED, Covariances, Flat, PartScores
from jaxfilt.fold import Objective
from jaxfilt.scores import Estimate
from jaxfilt.tuning import curvature, identify
from jaxfilt.tuning.batches import Batches
from jaxfilt.tuning.held_out import Rows, mean_over_runs
from jaxfilt.tuning.loss import Problem, started
from jaxfilt.tuning.split import Case
from jaxfilt.types import PyTree

ENOUGH_RUNS = 10
"""So many runs, and twice as many as there are parameters, are taken for independent observations; fewer are cut into
blocks of time."""

BLOCKS = 30
"""Blocks of time at least, and three times as many as there are parameters."""

STATES = 4
"""Rows at which is looked up what a parameter acts on."""

SIGNIFICANT = 2.0
"""Standard errors by which something must be better to be called better."""


def advantage(objective: Objective, worse: Rows, better: Rows, weight: np.ndarray) -> Estimate:
    """How much smaller the loss is over the rows (R, T) of this weight, with its standard error: what each row adds to
    the difference, summed by run, or, of one run, by blocks of time."""
    losses, parts = zip(*[_influence(objective, rows, weight) for rows in (worse, better)], strict=True)
    runs, count = weight.any(1), weight.sum()
    difference = np.where(weight, parts[0] - parts[1], np.nan)[runs]
    return Estimate(float(losses[0] - losses[1]), mean_over_runs(count * difference).error)


def _influence(objective: Objective, rows: Rows, weight: np.ndarray) -> tuple[float, np.ndarray]:
    """The loss, and what each row (R, T) does to it: ``grad L . (terms of the row)``, of sum 0."""
    total = {name: jnp.asarray(a[weight].sum(0)) for name, a in rows.terms.items()}
    loss, slope = jax.jit(jax.value_and_grad(objective.loss))(total)
    slope = jax.device_get(slope)
    flat = [np.reshape(a, (*weight.shape, -1)) @ np.ravel(slope[name]) for name, a in rows.terms.items()]
    part = np.asarray(np.sum(flat, axis=0))
    return float(loss), np.where(weight, part - part[weight].mean(), 0.0)


def observations(weight: np.ndarray, parameters: int) -> tuple[np.ndarray, int, str]:
    """The rows (R, T) of this weight as independent observations: the number of each row's (-1: none), how many there
    are, and what they are, in words. Runs, where there are enough of them, else blocks of time."""
    runs, rows = int(weight.any(1).sum()), int(weight.sum())
    by_run = runs >= max(ENOUGH_RUNS, 2 * parameters)
    count = runs if by_run else max(BLOCKS, 3 * parameters)
    number = np.full(weight.shape, -1)
    if by_run:
        number[weight.any(1)] = np.arange(runs)[:, None]
        number[~weight] = -1
    else:
        number[weight] = np.arange(rows) * count // rows
    return number, count, f"{count} runs" if by_run else f"{count} blocks of time"


def _by_number(a: np.ndarray, number: np.ndarray, count: int) -> np.ndarray:
    """Sums (count, ...) of what has the same number; what has none, -1, is left out."""
    total = np.zeros((count + 1, *a.shape[2:]), np.float64)
    np.add.at(total, number.ravel(), a.reshape(-1, *a.shape[2:]))
    return total[:-1]


def matrices(problem: Problem, theta: PyTree, case: Case) -> Covariances:
    """Q, R and P0 as plain matrices: at the first belief's mean, the first row's input and contexts, the median dt."""
    first = jax.tree.map(lambda a: jnp.asarray(a[0]), case)
    model, belief = problem.filter(theta).model, started(problem, theta, first)
    dt = float(np.median(case.log.dt[case.log.dt > 0]))
    x, row = belief.mean, jax.tree.map(lambda a: a[0], first.log)
    R = {
        name: np.asarray(sensor.R(x, row.c.get(name, ())))
        for name, sensor in model.sensors.items()
        if name in first.log.z
    }
    Q = model.Q(x, row.u, jnp.asarray(dt, belief.cov.dtype))
    return Covariances(dt, np.asarray(Q), R, np.asarray(belief.cov))


def findings(
    objective: Objective,
    rows: dict[str, Rows],
    scores: dict[str, dict[str, PartScores]],
    weights: dict[str, np.ndarray],
    flat: Sequence[Flat],
    refused: int,
    lost: int,
    starts: np.ndarray,
) -> tuple[str, ...]:
    """What a reader should know first, worst first."""
    part = next(name for name in ("test", "validation", "train") if name in weights)
    where = f"on the {part} data" + (", which it learned from" if part == "train" else "")
    bad, good = [], []
    for stage in (ESTIMATED, BEFORE):
        if stage not in rows:
            continue
        gain = advantage(objective, rows[stage], rows[TUNED], weights[part])
        what = "noise estimation" if stage == ESTIMATED else "the parameters it began with"
        amount = f"by {gain.value:.3g} ± {gain.error:.1g} of the loss"
        if gain.value > SIGNIFICANT * gain.error:
            good.append(f"tuning beats {what} {where}, {amount}")
        else:
            unsure = (
                "the difference cannot be told from chance"
                if abs(gain.value) <= SIGNIFICANT * gain.error
                else "it is worse"
            )
            bad.append(f"tuning does not beat {what} {where}: {unsure} ({amount})")
    bad += [f"not determined: {one.text}" for one in flat]
    if lost:
        bad.append(f"{lost} runs of the training data diverge with the parameters that were kept; they are left out")
    own = scores[TUNED][part]
    if own.diverged:
        bad.append(f"{own.diverged} of {own.runs} runs diverge {where}")
    bad += _inconsistent(own, where)
    if refused:
        bad.append(f"{refused} steps had a trial at which a run diverged; it was refused")
    if len(starts) > 1:
        near = int((starts <= starts.min() + 1e-3 * max(1.0, abs(starts.min()))).sum())
        good.append(f"{near} of {len(starts)} starts ended at the same loss as the best, or nearly")
    return (*bad, *good)


def _inconsistent(own: PartScores, where: str) -> list[str]:
    tests: dict[str, Any] = {"NEES": own.nees} if own.nees is not None else {}
    tests |= {f"NIS of {name}": test for name, test in own.nis.items()}
    return [
        f"the mean {name} {where} is {test.mean / test.expected:.3g} times what it should be, {verdict} its bounds"
        for name, test in tests.items()
        if (verdict := consistency.verdict(test)) in ("above", "below") and math.isfinite(test.mean)
    ]


class Certainty(NamedTuple):
    """How sure the parameters are: ``errors`` (p,), standard errors, made ``by``; and the ``flat`` directions."""

    errors: np.ndarray
    by: str
    flat: tuple[Flat, ...]


def certainty(
    problem: Problem,
    batches: Batches,
    rows: Callable[[PyTree], Rows],
    seen: Rows,
    case: Case,
    weight: np.ndarray,
    v: np.ndarray,
) -> Certainty:
    """How sure the parameters v (p,) are that minimise the loss over the rows (R, T) of this weight.

    Args:
        problem: that was solved.
        batches: of all the training data.
        rows: from `jaxfilt.tuning.held_out.scorer`; ``seen`` at v.
        case: all the data.
    """

    objective, tree = problem.objective, problem.parameters.tree
    number, observed, what = observations(weight, len(v))

    def gradient(at: np.ndarray) -> np.ndarray:
        V = np.tile(np.asarray(at, v.dtype), (batches.starts, 1))
        return np.asarray(batches(V, 0, V).gradient[0])

    def sums(at: np.ndarray) -> dict[str, np.ndarray]:
        terms = rows(tree(jnp.asarray(at, v.dtype))).terms
        return {name: _by_number(a, number, observed) for name, a in terms.items()}

    count = psi = None
    if objective.likelihood:
        H, by = curvature.hessian(gradient, v), "inverse Hessian"
        count = float(seen.terms["count"][weight].sum())
    else:
        H, slopes = curvature.hessian_and_slopes(lambda at: (gradient(at), sums(at)), v)
        psi, by = curvature.influence(objective.loss, sums(v), slopes), f"sandwich over {what}"
    run = int(np.flatnonzero(weight.any(1))[0])
    some = np.linspace(0, np.flatnonzero(weight[run])[-1], STATES).astype(int)
    x = jax.tree.map(lambda a: jnp.asarray(a[run, some]), seen.mean)
    at_rows = jax.tree.map(lambda a: jnp.asarray(a[run, some]), case.log)
    effects = identify.effects(
        lambda theta: problem.filter(theta).model, problem.beliefs[0], problem.parameters, v, x, at_rows
    )
    flat = identify.flat_directions(H, effects, count=count, influence=psi, needs_truth=objective.needs_truth)
    return Certainty(curvature.standard_errors(H, count=count, influence=psi), by, flat)


def definite(name: str, found: Covariances) -> None:
    """Raise unless Q, R and P0 are symmetric, finite and positive semidefinite."""
    for what, cov in {"Q": found.Q, "P0": found.P0, **{f"R of {n!r}": R for n, R in found.R.items()}}.items():
        try:
            doors.covariance(what, cov)
        except ValueError as bad:
            raise ValueError(f"{name}: gives no covariance: {bad}") from None
