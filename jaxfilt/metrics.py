"""Scores of an estimate: the only room that knows the truth.

A filter is *consistent* if its errors are as large as its covariances say. With the truth known, the normalised
estimation error squared (NEES) tells; without it, the normalised innovation squared (NIS) and the whiteness of the
innovations. Source of all three: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation
(2001), section 5.4.2.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import chisquare, doors, linalg
from jaxfilt.types import Array, Info, PyTree, Space, Status

CONFIDENCE = 0.999
"""Probability with which a consistent filter's mean falls within its bounds, unless told otherwise."""

DIVERGED = 1e-9
"""A run has diverged if its last NEES is one that a consistent filter exceeds with this probability."""

Blocks = Mapping[str, tuple[tuple[int, ...], str]]


class Consistency(NamedTuple):
    """A mean of normalised squares beside what theory expects: numbers, or arrays with leading axis T.

    ``mean``, ``expected`` (its expectation if the filter is consistent), ``low`` and ``high`` (two-sided bounds around
    that expectation). Above the bounds the filter believes too much in itself, below too little. NaN where there was
    nothing to average, and for bounds that one run alone cannot give.
    """

    mean: Any
    expected: Any
    low: Any
    high: Any


class Whiteness(NamedTuple):
    """Autocorrelation of a sensor's normalised innovations at ``lags`` (L,), in readings, and its ``bound`` (L,)."""

    lags: np.ndarray
    autocorrelation: np.ndarray
    bound: np.ndarray


def errors(space: Space, truth: PyTree, mean: PyTree) -> jax.Array:
    """Estimation errors ``minus(truth, mean)`` in the tangent space at the mean, where the covariance lives.

    Args:
        space: of the state.
        truth, mean: points, both with the same leading axes (none, (T,), (runs, T), ...).

    Returns:
        (..., n), each component in its own unit.

    Example: on a circle, 350 deg is 20 deg short of 10 deg.
        >>> import math, jax.numpy as jnp, jaxfilt as jf
        >>> e = errors(jf.angle, jnp.array([math.radians(10)]), jnp.array([math.radians(350)]))
        >>> round(math.degrees(float(e[0, 0])), 3)
        20.0
    """
    minus = space.minus
    for _ in range(jnp.ndim(jax.tree.leaves(mean)[0]) - np.ndim(jax.tree.leaves(space.origin)[0])):
        minus = jax.vmap(minus)
    return minus(truth, mean)


def nees(error: Array, cov: Array) -> jax.Array:
    """Normalised estimation error squared ``e' P^-1 e``: chi-square with n degrees of freedom if consistent.

    Args:
        error: (..., n) from `errors`.
        cov: (..., n, n) with the same leading axes.

    Returns:
        (...,); NaN where P is not positive definite.

    Example:
        >>> import jax.numpy as jnp
        >>> float(nees(jnp.array([2.0, 3.0]), jnp.diag(jnp.array([4.0, 9.0]))))
        2.0
    """

    def one(e: Array, P: Array) -> jax.Array:
        w = linalg.forward_solve(linalg.cholesky(P), e)
        return w @ w

    return jnp.vectorize(one, signature="(n),(n,n)->()")(error, cov)


def rmse(error: Array, blocks: Blocks, mask: Array | None = None) -> dict[str, float]:
    """Root mean square of the length of the error, per block: ``sqrt(mean(sum over the block of e_i^2))``.

    Args:
        error: (..., n) from `errors`; the mean is over all leading axes.
        blocks: name -> (indices of the tangent vector, unit).
        mask: (...,) bool, False where it does not count.

    Example:
        >>> import numpy as np
        >>> rmse(np.array([[3.0, 4.0, 0.1]]), {"position": ((0, 1), "m"), "yaw": ((2,), "rad")})
        {'position': 5.0, 'yaw': 0.1}
    """
    error = np.asarray(error, np.float64)
    counted = error.reshape(-1, error.shape[-1]) if mask is None else error[np.asarray(mask)]
    square = _ratio((counted**2).sum(0), np.full(error.shape[-1], len(counted)))
    return {name: float(np.sqrt(square[list(index)].sum())) for name, (index, _) in blocks.items()}


def anees(values: Array, dim: int, confidence: float = CONFIDENCE) -> Consistency:
    """Average NEES at each step, over independent runs, with its chi-square bounds.

    The sum of N independent NEES of a consistent filter is chi-square with N n degrees of freedom.

    Args:
        values: (runs, T) from `nees`; what is not finite does not count.
        dim: n, the dimension of the error.
        confidence: probability of the two-sided bounds.

    Returns:
        Consistency with arrays (T,).

    Example: 50 runs of a 2-state filter; the textbook's bounds at 95 % are 1.5 and 2.6.
        >>> import numpy as np
        >>> average = anees(np.full((50, 1), 2.0), dim=2, confidence=0.95)
        >>> [round(float(x[0]), 2) for x in average]
        [2.0, 2.0, 1.48, 2.59]
    """
    values = np.asarray(values, np.float64)
    finite = np.isfinite(values)
    count = finite.sum(0)
    return mean_of_squares(np.where(finite, values, 0.0).sum(0), dim * count, count, confidence)


def anees_total(run_means: Array, run_squares: Array, dim: int, confidence: float = CONFIDENCE) -> Consistency:
    """Average NEES over runs *and* time, with bounds that know that the NEES of one run is correlated in time.

    N runs of T steps are not worth N T independent NEES, but ``N V / B``: V is the variance of all of them, B that of
    the runs' own averages, so V / B lies between 1 (a run is as good as one step) and T. The bounds are chi-square's
    for so many; a factor (normal over Student's quantile)^2 allows for B being known from N runs only.

    Args:
        run_means, run_squares: (runs,) each run's average over time of its NEES and of its NEES squared; what is not
            finite does not count.
        dim: n.
        confidence: probability of the two-sided bounds.

    Returns:
        Consistency with numbers; bounds NaN with fewer than two runs.

    Example: 100 runs whose NEES does not change over time.
        >>> import numpy as np
        >>> values = np.random.default_rng(0).chisquare(2, 100)
        >>> [round(float(x), 2) for x in anees_total(values, values**2, dim=2, confidence=0.95)]
        [2.36, 2.0, 1.62, 2.42]
    """
    from scipy.special import ndtri, stdtrit  # scipy comes with jax; imported where it is used, as in chisquare

    run_means, run_squares = np.asarray(run_means, np.float64), np.asarray(run_squares, np.float64)
    finite = np.isfinite(run_means) & np.isfinite(run_squares)
    runs = int(finite.sum())
    if runs == 0:
        return Consistency(np.nan, float(dim), np.nan, np.nan)
    mean = float(run_means[finite].mean())
    if runs == 1:
        return Consistency(mean, float(dim), np.nan, np.nan)
    all_of_them, of_averages = run_squares[finite].mean() - mean**2, run_means[finite].var(ddof=1)
    tail = 0.5 + 0.5 * confidence
    steps_worth = max(1.0, all_of_them / of_averages) if of_averages > 0 else 1.0
    worth = runs * steps_worth * float(ndtri(tail) / stdtrit(runs - 1, tail)) ** 2
    low, high = chisquare.bounds(confidence, np.asarray(dim * worth))
    return Consistency(mean, float(dim), float(low / worth), float(high / worth))


def used(info: Info) -> tuple[jax.Array, jax.Array]:
    """NIS and degrees of freedom of the readings that a filter used; both 0 for what was absent, gated or broken."""
    there = (info.status == Status.OK) & (info.dof > 0)
    return jnp.where(there, info.nis, 0.0), jnp.where(there, info.dof, 0)


def anis(info: Info, confidence: float = CONFIDENCE) -> Consistency:
    """Average NIS of a sensor over all its readings, with its chi-square bounds: needs no truth.

    The innovations of a consistent filter are independent in time, so the sum of their NIS is chi-square with the sum
    of their degrees of freedom. Absent readings and components do not count, nor do readings that a gate refused: a
    gate of probability p cuts the tail off, so that a mean a little below the expectation is its work.

    Args:
        info: of one sensor, any leading axes: ``track.info["gnss"]``.
        confidence: probability of the two-sided bounds.

    Returns:
        Consistency with numbers.

    Example:
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> start = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> _, log = jf.simulate(walk, start, jf.schedule(walk, steps=200, dt=1.0), jax.random.key(0))
        >>> mean, expected, low, high = anis(jf.scan(jf.kf(walk), start, log).info["z"])
        >>> expected, bool(low < mean < high)
        (1.0, True)
    """
    value, dof = used(info)
    count = int((np.asarray(dof) > 0).sum())
    total = mean_of_squares(np.asarray(value, np.float64).sum(), np.asarray(dof).sum(), np.asarray(count), confidence)
    return Consistency(*map(float, total))


def mean_of_squares(total: Array, dof: Array, count: Array, confidence: float = CONFIDENCE) -> Consistency:
    """``total / count`` for a total that is chi-square with ``dof`` degrees of freedom; NaN where count is 0."""
    low, high = chisquare.bounds(confidence, np.where(np.asarray(dof) > 0, dof, 1))
    return Consistency(*(_ratio(np.asarray(a, np.float64), np.asarray(count)) for a in (total, dof, low, high)))


def _ratio(a: np.ndarray, count: np.ndarray) -> np.ndarray:
    return np.where(count > 0, a / np.where(count > 0, count, 1), np.nan)


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


def diverged(last_nees: Array, sound: Array, dim: int) -> np.ndarray:
    """Which runs have diverged: not finite or faulty somewhere, or lost at the end.

    Lost is a last NEES beyond the ``1 - 1e-9`` quantile of chi-square with n degrees of freedom, 41 for n = 2.

    Args:
        last_nees: (runs,) at the last step.
        sound: (runs,) whether all estimates were finite, and no status was `Status.BAD_BELIEF` or worse.
        dim: n.

    Returns:
        (runs,) bool.
    """
    return ~np.asarray(sound) | (np.asarray(last_nees) > chisquare.quantile(1 - DIVERGED, dim))


def whiteness(info: Info, lags: int = 20, confidence: float = CONFIDENCE) -> Whiteness:
    """Autocorrelation of a sensor's normalised innovations: near 0 at every lag if the filter is consistent.

    ``rho(l) = sum_k e_k' e_(k+l) / sqrt(sum_k e_k' e_k  sum_k e_(k+l)' e_(k+l))``, ``e = L^-1 r``, ``S = L L'``, over
    the readings that the filter used, in order, and approximately ``N(0, 1/K)`` with K products of components in the
    sum. Slow errors that no model holds (a bias, a delay) show as correlation at all lags.

    Args:
        info: of one sensor and one run, leading axis T.
        lags: largest lag, in readings; fewer where there are not that many.
        confidence: probability that one lag is within its bound.

    Raises:
        ValueError: a leading axis that is none.

    Source: Bar-Shalom et al. (2001), section 5.4.2, the time-average autocorrelation, for innovations normalised by
    their covariance.
    """
    from scipy.special import ndtri

    if np.ndim(info.nis) != 1:
        raise ValueError(f"info: expected leading axis T, one run, got {doors.describe(info.nis)} for nis")
    keep = np.asarray(used(info)[1]) > 0
    e = np.asarray(_normalised(info.innovation, info.S), np.float64)[keep]
    dof = np.asarray(info.dof)[keep]
    rho, pairs = [], []
    for lag in range(1, min(lags, len(e) - 1) + 1):
        a, b = e[:-lag], e[lag:]
        rho.append(_ratio((a * b).sum(), np.sqrt((a * a).sum() * (b * b).sum())))
        pairs.append(np.minimum(dof[:-lag], dof[lag:]).sum())
    bound = float(ndtri(0.5 + 0.5 * confidence)) / np.sqrt(np.array(pairs, float))
    return Whiteness(np.arange(1, len(rho) + 1), np.array(rho), bound)


@jax.jit
@jax.vmap
def _normalised(r: Array, S: Array) -> jax.Array:
    return linalg.forward_solve(linalg.cholesky(S), r)
