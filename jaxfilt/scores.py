"""What a study says of a filter: plain NumPy arrays and numbers, computed from the sums over its runs."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxfilt import consistency, metrics
from jaxfilt.consistency import Consistency
from jaxfilt.metrics import Whiteness
from jaxfilt.tally import COVERAGES, ERROR_EDGES, NEES_EDGES, Moments, Sums
from jaxfilt.types import Status

STATE = "state"
"""The name of the whole tangent space among the blocks of a NEES."""


class Estimate(NamedTuple):
    """A Monte Carlo estimate and its standard ``error`` (one sigma): numbers, or arrays with leading axis T."""

    value: Any
    error: Any


class Histogram(NamedTuple):
    """Counts (..., K) between ``edges`` (K + 1,); what is beyond them is counted in the outermost bins."""

    edges: np.ndarray
    counts: np.ndarray


class Worst(NamedTuple):
    """The largest error of all: its length, and the run that made it."""

    value: float
    run: int


class Fault(NamedTuple):
    """The first update that went wrong: ``run``, ``step`` (row), ``sensor`` and `Status`; ``runs`` that have any."""

    run: int
    step: int
    sensor: str
    status: Status
    runs: int


class Diverged(NamedTuple):
    """How many runs diverged (see `jaxfilt.metrics.diverged`), and the numbers of the first of them."""

    runs: int
    first: tuple[int, ...]


class Scores(NamedTuple):
    """How one filter did over a set of runs: leading axis T over time, ``_total`` over runs and time.

    The standard error and the bounds of a total take each run's average over time as one observation, since errors are
    correlated in time. ``runs`` in the set.

    By block of the state: ``rmse``, ``rmse_total``; ``claimed`` (T,), the root mean square error that the filter itself
    expects, ``sqrt(mean(trace P))``; ``worst``, the largest error. In the tangent space: ``bias`` (T, n), the mean
    error; ``mse`` (T, n, n), the mean of ``e e'``; ``normalised_error`` (n,), the mean of ``e_i / sqrt(P_ii)`` over
    runs and time, 0 if unbiased.

    ``nees`` and ``nees_total``: by block, and "state" for all of it. ``coverage`` and ``coverage_total``: by
    probability, the share of the errors inside the credible ellipsoid of that probability. ``log_score`` and
    ``log_score_total``: the mean of ``log N(e; 0, P)``, larger is better. ``noncredibility`` and ``inclination``,
    decibels, see `jaxfilt.credibility`, of the first runs only and NaN but at some rows (`Study.sample`).

    By sensor: ``nis``, ``nis_total``, ``refused`` (readings that a gate refused), ``whiteness`` of the innovations.
    ``histogram`` of ``e_i / sqrt(P_ii)``, counts (n, bins), standard normal if consistent; ``run_nees`` of the runs'
    own average NEES over n, the spread between runs.
    """

    runs: int
    rmse: dict[str, Estimate]
    rmse_total: dict[str, Estimate]
    claimed: dict[str, np.ndarray]
    worst: dict[str, Worst]
    bias: Estimate
    mse: np.ndarray
    normalised_error: Consistency
    nees: dict[str, Consistency]
    nees_total: dict[str, Consistency]
    coverage: dict[float, Consistency]
    coverage_total: dict[float, Consistency]
    log_score: Estimate
    log_score_total: Estimate
    noncredibility: np.ndarray
    inclination: np.ndarray
    nis: dict[str, Consistency]
    nis_total: dict[str, Consistency]
    refused: dict[str, int]
    whiteness: dict[str, Whiteness]
    histogram: Histogram
    run_nees: Histogram


class Paired(NamedTuple):
    """Two filters on the same truths and readings: the first's score minus the second's, over runs that neither lost.

    ``square`` by block: mean squared error (unit squared), negative where the first is better; ``log_score``: positive
    where the first is better. Each with the standard error of the difference, far smaller than that of either score
    since the noise is common.
    """

    runs: int
    square: dict[str, Estimate]
    log_score: Estimate


def scores(
    sums: Sums, blocks: metrics.Blocks, dim: int, confidence: float, worst: dict[str, Worst], credible: tuple
) -> Scores:
    """What the sums of one filter (no leading axis) say.

    Args:
        sums: in float64, over all runs of the set.
        blocks: name -> (indices, unit).
        dim: n.
        confidence: probability of all two-sided bounds.
        worst: the largest errors, which are no sums.
        credible: noncredibility index and inclination (T,).
    """
    sensors, names = sorted(sums.dots), list(blocks)
    row, whole = sums.rows, sums.averages
    square, square_total = _estimate(row["square"]), _estimate(whole["square"])
    index = [list(at) for at, _ in blocks.values()]
    variance = consistency.ratio(row["variance"].first, row["variance"].number)
    nees, nees_total = {}, {}
    for k, (name, n) in enumerate([(STATE, dim), *zip(names, map(len, index), strict=True)]):
        total, count = row["nees"].first[:, k], row["nees"].number[:, k]
        nees[name] = consistency.mean_of_squares(total, n * count, count, confidence)
        nees_total[name] = _nees_total(whole, k, n, confidence)
    coverage, coverage_total = {}, {}
    for k, level in enumerate(COVERAGES):
        hits, count = row["covered"].first[:, k], row["nees"].number[:, 0]
        coverage[level] = consistency.coverage(hits, count, level, confidence)
        coverage_total[level] = consistency.coverage_total(*_between(whole["covered"], k), level, confidence)
    error = whole["normalised"]
    normalised = [consistency.mean_error(*_between(error, i), confidence) for i in range(dim)]
    log_score, log_score_total = _estimate(row["log_score"]), _estimate(whole["log_score"])
    nis, nis_total, white = {}, {}, {}
    for name in sensors:
        total, dof, used = (row[f"{what} {name}"].first[:, 0] for what in ("nis", "dof", "used"))
        nis[name] = consistency.mean_of_squares(total, dof, used, confidence)
        overall = consistency.mean_of_squares(total.sum(), dof.sum(), used.sum(), confidence)
        nis_total[name] = Consistency(*map(float, overall))
        white[name] = metrics.whiteness_of_sums(sums.dots[name], sums.pairs[name], total.sum(), dof.sum(), confidence)
    counted = np.maximum(row["error"].number[:, :1], 1)
    return Scores(
        runs=int(sums.runs),
        rmse={name: _root(square, k) for k, name in enumerate(names)},
        rmse_total={name: _root(square_total, k) for k, name in enumerate(names)},
        claimed={name: np.sqrt(variance[:, i].sum(1)) for name, i in zip(names, index, strict=True)},
        worst=worst,
        bias=_estimate(row["error"]),
        mse=sums.outer / counted[:, :, None],
        normalised_error=Consistency(*(np.array(a, float) for a in zip(*normalised, strict=True))),
        nees=nees,
        nees_total=nees_total,
        coverage=coverage,
        coverage_total=coverage_total,
        log_score=Estimate(log_score.value[:, 0], log_score.error[:, 0]),
        log_score_total=Estimate(float(log_score_total.value[0]), float(log_score_total.error[0])),
        noncredibility=credible[0],
        inclination=credible[1],
        nis=nis,
        nis_total=nis_total,
        refused={name: int(row[f"refused {name}"].first.sum()) for name in sensors},
        whiteness=white,
        histogram=Histogram(ERROR_EDGES, sums.errors.astype(np.int64)),
        run_nees=Histogram(NEES_EDGES, sums.run_nees.astype(np.int64)),
    )


def paired(sums: Moments, blocks: metrics.Blocks) -> Paired:
    """The comparison of two filters from the sums (B + 1,) of the differences of their averages over time."""
    value, error = _estimate(sums)
    square = {name: Estimate(float(value[k]), float(error[k])) for k, name in enumerate(blocks)}
    return Paired(int(sums.number[0]), square, Estimate(float(value[-1]), float(error[-1])))


def _estimate(sums: Moments) -> Estimate:
    """The mean with its standard error, of any shape."""
    mean = consistency.ratio(sums.first, sums.number)
    spread = consistency.ratio(sums.second, sums.number) - mean**2
    return Estimate(mean, np.sqrt(np.maximum(consistency.ratio(spread, sums.number - 1), 0.0)))


def _root(square: Estimate, k: int) -> Estimate:
    """The root of a mean square: ``d sqrt(s) = ds / (2 sqrt(s))``."""
    value, error = square.value[..., k], square.error[..., k]
    root = np.sqrt(value)
    estimate = root, consistency.ratio(0.5 * error, root)
    return Estimate(*(float(a) if np.ndim(a) == 0 else a for a in estimate))


def _between(sums: Moments, k: int) -> tuple[int, float, float]:
    """Number, mean, and variance (ddof = 1) of the runs' own averages."""
    count = int(sums.number[k])
    mean, error = (float(a[k]) for a in _estimate(sums))
    return count, mean, error**2 * count


def _nees_total(whole: dict[str, Moments], k: int, dim: int, confidence: float) -> Consistency:
    runs, mean, between = _between(whole["nees"], k)
    square = float(_estimate(whole["nees_square"]).value[k])
    return consistency.anees_total(runs, mean, between, square, dim, confidence)
