"""Means beside what theory expects of them, with exact bounds and p-values: plain NumPy, from counts and sums.

Steps of one run are correlated, runs are not. So a mean over runs at one step has the bounds of its distribution
(chi-square, binomial), while a mean over runs *and* time takes each run's average over time as one observation.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxfilt import chisquare
from jaxfilt.types import Array

CONFIDENCE = 0.999
"""Probability with which a consistent filter's mean falls within its bounds, unless told otherwise."""

FURTHEST = 37.0
"""Standard deviations beyond which a normal tail is no double any more: what is further out counts as this far."""


class Consistency(NamedTuple):
    """A mean beside what theory expects, of normalised squares mostly: numbers, or arrays with leading axis T.

    ``mean``, ``expected`` (its expectation if the filter is consistent), ``low`` and ``high`` (two-sided bounds around
    that expectation), ``p`` (two-sided p-value: the probability that a consistent filter is as far off). Normalised
    squares above the bounds: the filter believes too much in itself; below: too little. NaN where there was nothing to
    average, and for bounds and p that one run alone cannot give.
    """

    mean: Any
    expected: Any
    low: Any
    high: Any
    p: Any = np.nan


def mean_of_squares(total: Array, dof: Array, count: Array, confidence: float = CONFIDENCE) -> Consistency:
    """``total / count`` for a total that is chi-square with ``dof`` degrees of freedom; NaN where count is 0.

    Args:
        total: sum of ``count`` independent normalised squares, a number or (T,).
        dof: sum of their degrees of freedom.
        count: how many there are.
        confidence: probability of the two-sided bounds.

    Example: 50 NEES of a 2-state filter.
        >>> [round(float(x), 3) for x in mean_of_squares(130.0, 100, 50, confidence=0.95)]
        [2.6, 2.0, 1.484, 2.591, 0.047]
    """
    from scipy.special import chdtr, chdtrc  # scipy comes with jax; imported where it is used, as in chisquare

    total, dof, count = np.asarray(total, np.float64), np.asarray(dof), np.asarray(count)
    safe = np.where(dof > 0, dof, 1)
    low, high = chisquare.bounds(confidence, safe)
    p = np.minimum(1.0, 2 * np.minimum(chdtr(safe, total), chdtrc(safe, total)))
    share = [ratio(a, count) for a in (total, dof, low, high)]
    return Consistency(share[0], share[1], share[2], share[3], np.where(count > 0, p, np.nan))


def anees_total(
    runs: int,
    mean: Array,
    variance_between: Array,
    mean_square: Array,
    dim: int,
    confidence: float = CONFIDENCE,
) -> Consistency:
    """Average NEES over runs *and* time, with bounds that know that the NEES of one run is correlated in time.

    N runs of T steps are not worth N T independent NEES, but ``w = N V / B``: V is the variance of all of them, B that
    of the runs' own averages, so V / B lies between 1 (a run is as good as one step) and T. The mean times w is
    compared with chi-square of n w degrees of freedom. Since B is known from N runs only, what that makes a normal
    deviate z is taken for one of Student's with N - 1 degrees of freedom: ``p = 2 P(t > |z|)``, and the bounds are
    where p = 1 - confidence. A z beyond 37, where doubles end, counts as 37: with two runs p stays above 0.017,
    with three above 7e-4, whatever the mean.

    Args:
        runs: N.
        mean: mean over runs of each run's average NEES over time; a number, or an array of any shape.
        variance_between: variance of these averages between the runs (ddof = 1): B.
        mean_square: mean over runs of each run's average over time of its NEES squared; V is it less mean squared.
        dim: n.
        confidence: probability of the two-sided bounds.

    Returns:
        Consistency with numbers (or arrays like ``mean``); bounds and p NaN with fewer than two runs.

    Example: 100 runs whose NEES does not change over time.
        >>> import numpy as np
        >>> a = np.random.default_rng(0).chisquare(2, 100)
        >>> total = anees_total(100, a.mean(), a.var(ddof=1), (a**2).mean(), dim=2, confidence=0.95)
        >>> [round(x, 2) for x in total]
        [2.36, 2.0, 1.62, 2.42, 0.08]

    Source: the idea of an effective number of independent samples, e.g. Wilks, Statistical Methods in the Atmospheric
    Sciences (2011), section 5.2.4.
    """
    from scipy.special import chdtr, chdtrc, gammainccinv, gammaincinv, ndtr, ndtri, stdtr, stdtrit

    mean, B, square = (np.asarray(a, np.float64) for a in (mean, variance_between, mean_square))
    expected = np.full(mean.shape, float(dim))
    if runs < 2:
        nothing = np.full(mean.shape, np.nan)
        return _plain(nothing if runs == 0 else mean, expected, nothing, nothing, nothing)
    with np.errstate(over="ignore", invalid="ignore"):  # a mean that is not finite: each run is worth one step
        spread = (square - mean**2) / np.where(B > 0, B, np.nan)
    worth = runs * np.fmax(1.0, spread)
    dof, total = dim * worth, mean * worth
    below, above = chdtr(dof, total), chdtrc(dof, total)
    # The smaller tail of the two keeps its digits.
    z = np.clip(np.where(below < above, ndtri(below), -ndtri(above)), -FURTHEST, FURTHEST)
    tail = ndtr(-min(float(stdtrit(runs - 1, 0.5 + 0.5 * confidence)), FURTHEST + 1))
    low, high = (2 * inverse(0.5 * dof, tail) / worth for inverse in (gammaincinv, gammainccinv))
    return _plain(mean, expected, low, high, 2 * stdtr(runs - 1, -np.abs(z)))


def mean_error(runs: int, mean: Array, variance_between: Array, confidence: float = CONFIDENCE) -> Consistency:
    """Mean over runs and time of ``e_i / sqrt(P_ii)``: 0 if unbiased. Bounds and p of Student's t over the runs.

    Args:
        runs: N.
        mean: (n,), mean over runs of each run's average over time.
        variance_between: (n,), variance of these averages between the runs (ddof = 1).
        confidence: probability of the two-sided bounds.

    Returns:
        Consistency with arrays like ``mean``; bounds and p NaN with fewer than two runs.

    Example: 25 runs, whose averages have a mean of half their standard deviation.
        >>> import numpy as np
        >>> [round(float(x[0]), 3) for x in mean_error(25, np.array([0.5]), np.array([1.0]), confidence=0.95)]
        [0.5, 0.0, -0.413, 0.413, 0.02]

    Source: Bar-Shalom, Li, Kirubarajan (2001), section 5.4.2 (normalised mean estimation error), with the spread
    between the runs in place of the claimed one.
    """
    return _student(runs, np.asarray(mean, np.float64), variance_between, 0.0, confidence)


def coverage(hits: Array, count: Array, probability: float, confidence: float = CONFIDENCE) -> Consistency:
    """Share of independent errors inside the credible ellipsoid of this probability, with exact binomial bounds.

    Args:
        hits, count: (T,) or numbers, how many errors were inside, of how many.
        probability: of the ellipsoid.
        confidence: probability of the two-sided bounds, at least: a count is discrete.

    Example: 43 of 50 errors inside the 90 % ellipsoids.
        >>> [round(float(x), 3) for x in coverage(43, 50, 0.9, confidence=0.95)]
        [0.86, 0.9, 0.82, 0.98, 0.46]
    """
    from scipy.stats import binom

    hits, count = np.asarray(hits), np.asarray(count)
    safe, tail = np.where(count > 0, count, 1), 0.5 * (1 - confidence)
    low, high = binom.ppf(tail, safe, probability), binom.ppf(1 - tail, safe, probability)
    p = np.minimum(1.0, 2 * np.minimum(binom.cdf(hits, safe, probability), binom.sf(hits - 1, safe, probability)))
    share = [ratio(a, count) for a in (hits, probability * count, low, high)]
    return Consistency(share[0], share[1], share[2], share[3], np.where(count > 0, p, np.nan))


def coverage_total(
    runs: int, mean: Array, variance_between: Array, probability: float, confidence: float = CONFIDENCE
) -> Consistency:
    """Share of all errors inside the credible ellipsoids of this probability: Student's t over the runs.

    The bounds stay within 0 and 1. Where all runs have the same share (all of their errors inside, say) there is no
    spread to judge by, and bounds and p are NaN.

    Args:
        runs: N.
        mean: mean over runs of each run's share of steps inside.
        variance_between: variance of these shares between the runs (ddof = 1).
        probability: of the ellipsoids.
        confidence: probability of the two-sided bounds.

    Example:
        >>> [round(x, 3) for x in coverage_total(100, 0.87, 0.01, 0.9, confidence=0.95)]
        [0.87, 0.9, 0.88, 0.92, 0.003]
    """
    B = np.asarray(variance_between, np.float64)
    total = _student(runs, np.asarray(mean, np.float64), np.where(B > 0, B, np.nan), probability, confidence)
    return total._replace(low=_number(np.maximum(total.low, 0.0)), high=_number(np.minimum(total.high, 1.0)))


def _student(runs: int, mean: np.ndarray, variance: Array, expected: float, confidence: float) -> Consistency:
    from scipy.special import stdtr, stdtrit

    nothing, centre = np.full(mean.shape, np.nan), np.full(mean.shape, expected)
    if runs < 2:
        return _plain(nothing if runs == 0 else mean, centre, nothing, nothing, nothing)
    error = np.sqrt(np.asarray(variance, np.float64) / runs)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.abs(mean - expected) / error
    reach = stdtrit(runs - 1, 0.5 + 0.5 * confidence) * error
    return _plain(mean, centre, expected - reach, expected + reach, 2 * stdtr(runs - 1, -t))


def holm(p: Array, level: float) -> np.ndarray:
    """Which of many hypotheses are rejected, so that one true one is among them with probability ``level`` at most.

    The smallest of m p-values must stay below level / m, the next below level / (m - 1), and so on to the first that
    does not. Holds whatever the dependence between the tests.

    Args:
        p: p-values, any shape; NaN is no test and is never rejected.
        level: family-wise, such as 1 - confidence.

    Returns:
        bool, like p.

    Example:
        >>> holm([0.001, 0.04, 0.03, 0.02], level=0.05).tolist()
        [True, False, False, False]

    Source: Holm, A simple sequentially rejective multiple test procedure, Scand. J. Statist. 6 (1979).
    """
    p = np.asarray(p, np.float64)
    flat = p.ravel()
    order = np.argsort(flat)[: np.isfinite(flat).sum()]  # NaN sorts last
    passed = flat[order] <= level / np.arange(len(order), 0, -1)
    rejected = np.zeros(flat.shape, bool)
    rejected[order[: np.argmin(passed) if not passed.all() else len(order)]] = True
    return rejected.reshape(p.shape)


def verdict(score: Consistency) -> str:
    """``"inside"``, ``"above"`` or ``"below"`` its bounds; ``"unknown"`` where there are none."""
    if not np.isfinite([score.mean, score.low, score.high]).all():
        return "above" if np.isposinf(score.mean) else "unknown"
    if score.mean > score.high:
        return "above"
    return "below" if score.mean < score.low else "inside"


def share_inside(score: Consistency) -> float:
    """Share of the steps, of those with bounds, at which the mean was inside them."""
    known = np.isfinite(score.mean) & np.isfinite(score.low) & np.isfinite(score.high)
    inside = (score.mean >= score.low) & (score.mean <= score.high)
    return float(inside[known].mean()) if known.any() else np.nan


def ratio(a: np.ndarray, count: np.ndarray) -> np.ndarray:
    """``a / count``; NaN, and no warning, where the count is 0."""
    return np.where(count > 0, a / np.where(count > 0, count, 1), np.nan)


def _plain(*values: np.ndarray) -> Consistency:
    return Consistency(*map(_number, values))


def _number(a: np.ndarray) -> Any:
    return a.item() if np.ndim(a) == 0 else a
