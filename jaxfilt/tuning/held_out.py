"""How well parameters do on each part of the data: the scores that a tuning reports."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import metrics
from jaxfilt.bootstrap import anees_of_one_run, block_bootstrap
from jaxfilt.consistency import CONFIDENCE, Consistency, anees_total, mean_of_squares
from jaxfilt.fit import PartScores
from jaxfilt.fold import Seen, by_row
from jaxfilt.metrics import Blocks
from jaxfilt.scores import Estimate
from jaxfilt.tuning.loss import Problem, compiled, started
from jaxfilt.tuning.split import Case, apart, over_runs
from jaxfilt.types import Array, PyTree

ONE_SIGMA = 0.6827
"""Probability within one standard deviation of a normal mean."""


class Rows(NamedTuple):
    """What one setting of the parameters does to each row of each run: ``terms`` of the objective (R, T, ...); with a
    truth ``error`` (R, T, d), ``nees`` and ``log_score`` (R, T), NaN where it is unknown, else None; ``nis`` and
    ``dof`` by sensor (R, T); and the ``mean`` (R, T, ...) of the belief."""

    terms: dict[str, np.ndarray]
    error: np.ndarray | None
    nees: np.ndarray | None
    log_score: np.ndarray | None
    nis: dict[str, np.ndarray]
    dof: dict[str, np.ndarray]
    mean: PyTree


def scorer(problem: Problem, case: Case, theta: PyTree) -> Callable[[PyTree], Rows]:
    """The function theta -> `Rows` over all the data, compiled; all thetas are to be as this one is."""
    data, axes = apart(case)
    objective, truth = problem.objective, case.truth is not None

    def taken(seen: Seen) -> dict[str, Array]:
        used = {name: metrics.used(info) for name, info in seen.info.items()}
        found = {f"nis {name}": nis for name, (nis, _) in used.items()}
        found |= {f"dof {name}": dof for name, (_, dof) in used.items()}
        mean = seen.filter.gaussian(seen.belief).mean
        found |= {f"mean {i}": leaf for i, leaf in enumerate(jax.tree.leaves(mean))}
        if truth:
            found |= {
                "error": jnp.where(seen.known, seen.error, jnp.nan),
                "nees": jnp.where(seen.known, metrics.nees(seen.error, seen.cov), jnp.nan),
                "log score": jnp.where(seen.known, metrics.log_score(seen.error, seen.cov), jnp.nan),
            }
        return found

    def both(seen: Seen) -> dict[str, Array]:
        return taken(seen) | own(seen)

    def own(seen: Seen) -> dict[str, Array]:
        return {f"term {name}": a for name, a in objective.row(seen).items()}

    # An objective that keeps readings from the filter looks at another pass than the scores do.
    passes = (taken, own) if objective.held else (both,)

    def one(theta: PyTree, case: Case) -> dict[str, Array]:
        robot = problem.filter(theta), started(problem, theta, case), case.log, case.truth, problem.space, problem.view
        found = {}
        for row in passes:
            held = objective.held if row is own else {}
            needs_truth = objective.needs_truth if row is own else truth
            found |= by_row(objective._replace(row=row, held=held, needs_truth=needs_truth), *robot)
        return found

    def every(theta: PyTree, data: Case) -> dict[str, Array]:
        return over_runs(lambda case: one(theta, case), data, axes)()

    program = compiled(every, theta, data)

    def rows(theta: PyTree) -> Rows:
        found = jax.device_get(program(theta, data))
        kinds = ("nis ", "dof ", "term ")
        nis, dof, terms = ({n.removeprefix(k): a for n, a in found.items() if n.startswith(k)} for k in kinds)
        leaves = [found[f"mean {i}"] for i in range(len(found)) if f"mean {i}" in found]
        mean = jax.tree.unflatten(jax.tree.structure(problem.filter(theta).model.space.origin), leaves)
        return Rows(terms, found.get("error"), found.get("nees"), found.get("log score"), nis, dof, mean)

    return rows


def part_scores(problem: Problem, rows: Rows, weight: np.ndarray, blocks: Blocks | None) -> PartScores:
    """The scores over the rows (R, T) of this weight, as far as they are finite."""
    runs = np.flatnonzero(weight.any(1))
    sums = {name: jnp.asarray(a[weight].sum(0)) for name, a in rows.terms.items()}
    nis = {name: _nis(a[weight], rows.dof[name][weight]) for name, a in rows.nis.items()}
    shared: dict[str, Any] = {"loss": float(jax.jit(problem.objective.loss)(sums)), "runs": len(runs), "nis": nis}
    if rows.error is None or rows.nees is None or rows.log_score is None:
        finite = _finite(rows)
        return PartScores(
            rows=int(weight.sum()), rmse=None, log_score=None, nees=None, diverged=int((~finite[runs]).sum()), **shared
        )
    counted = weight & np.isfinite(rows.nees)
    nees = np.where(weight, rows.nees, np.nan)
    dim = rows.error.shape[-1]
    blocks = {f"x[{i}]": ((i,), "") for i in range(dim)} if blocks is None else blocks
    return PartScores(
        rows=int(counted.sum()),
        rmse=metrics.rmse(rows.error, blocks, counted),
        log_score=mean_over_runs(np.where(weight, rows.log_score, np.nan)[runs]),
        nees=_nees(nees[runs], dim),
        diverged=int(_diverged(rows, nees, dim)[runs].sum()),
        **shared,
    )


def mean_over_runs(values: np.ndarray) -> Estimate:
    """Mean of values (R, T), each row alike, with its standard error: from the spread of the runs' means, or, of one
    run, from blocks of time. What is not finite does not count."""
    finite = np.isfinite(values)
    count = finite.sum(1)
    if not count.any():
        return Estimate(np.nan, np.nan)
    filled = np.where(finite, values, 0.0)
    mean = float(filled.sum() / count.sum())
    if len(values) == 1:
        low, high = block_bootstrap(values[0], confidence=ONE_SIGMA)
        return Estimate(mean, 0.5 * (high - low))
    # A ratio of sums over runs; what one run adds to it is its sum of deviations.
    deviations = np.where(finite, values - mean, 0.0).sum(1)
    with np.errstate(over="ignore"):  # of a run that has diverged
        square = len(values) / (len(values) - 1) * (deviations**2).sum()
    return Estimate(mean, float(np.sqrt(square) / count.sum()))


def _nees(values: np.ndarray, dim: int) -> Consistency:
    """Average over runs (R, T) and time, with bounds that know that it is correlated in time."""
    if len(values) == 1:
        return anees_of_one_run(values[0], dim, CONFIDENCE)
    there = values[np.isfinite(values).any(1)]
    if len(there) < 2:
        return anees_of_one_run(there.ravel(), dim, CONFIDENCE)
    with np.errstate(over="ignore", invalid="ignore"):  # of a run that has diverged
        means, squares = np.nanmean(there, 1), np.nanmean(there**2, 1)
        between = means.var(ddof=1)
    return anees_total(len(there), means.mean(), between, squares.mean(), dim, CONFIDENCE)


def _nis(values: np.ndarray, dof: np.ndarray) -> Consistency:
    count = (dof > 0).sum()
    total = mean_of_squares(np.asarray(np.nansum(values)), np.asarray(dof.sum()), np.asarray(count), CONFIDENCE)
    return Consistency(*map(float, total))


def _diverged(rows: Rows, nees: np.ndarray, dim: int) -> np.ndarray:
    """Which runs (R,) are not finite somewhere, or lost at the end."""
    assert rows.error is not None
    last = np.array([own[np.isfinite(own)][-1] if np.isfinite(own).any() else 0.0 for own in nees])
    return metrics.diverged(last, _finite(rows), dim)


def _finite(rows: Rows) -> np.ndarray:
    """Which runs (R,) are finite everywhere."""
    return np.all([np.isfinite(a).all(1) for a in rows.nis.values()], axis=0)
