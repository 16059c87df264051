"""The mean of one correlated series, and how sure it is: the circular block bootstrap; host side, float64.

For the NEES of one recorded drive: there are no other runs whose spread could tell.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from jaxfilt.consistency import CONFIDENCE, Consistency
from jaxfilt.types import Array

AT_ONCE = 2_000_000
"""Block starts drawn at once, to bound the memory."""


class Interval(NamedTuple):
    """Two-sided interval ``low`` to ``high`` around an estimate."""

    low: float
    high: float


def block_bootstrap(
    values: Array,
    confidence: float = CONFIDENCE,
    block: int | None = None,
    samples: int = 2000,
    seed: int = 0,
) -> Interval:
    """Interval around the mean of a correlated stationary series, by the circular block bootstrap.

    The series is closed to a ring and resampled in blocks, which keep the correlation within them; the interval is
    between the quantiles of the resampled means, stretched about the mean by Student's quantile over the normal one
    for T / block - 1 degrees of freedom, since long blocks leave few to draw from.

    Args:
        values: (T,); what is not finite is left out.
        confidence: probability that the interval covers the mean of the process. Bounds of 99.9 % want some 20,000
            samples.
        block: length of the blocks, in steps; None: `block_length`. 1 is the ordinary bootstrap, which is wrong here.
        samples: how many series are drawn.
        seed: of the generator.

    Returns:
        Interval; NaN with less than two blocks to draw from.

    Example:
        >>> import numpy as np
        >>> low, high = block_bootstrap(np.random.default_rng(0).chisquare(3, 1000), confidence=0.95)
        >>> round(low, 1), round(high, 1)
        (2.9, 3.2)

    Source: Politis, Romano, A circular block-resampling procedure for stationary data, in Exploring the Limits of
    Bootstrap (1992).
    """
    from scipy.special import ndtri, stdtrit

    values, block = _prepared(values, block)
    if len(values) < 2 * block:
        return Interval(math.nan, math.nan)
    mean, tail = values.mean(), 0.5 - 0.5 * confidence
    stretch = float(stdtrit(len(values) / block - 1, tail) / ndtri(tail))
    low, high = np.quantile(_resampled_means(values, block, samples, seed), [tail, 1 - tail])
    return Interval(float(mean + stretch * (low - mean)), float(mean + stretch * (high - mean)))


def anees_of_one_run(
    values: Array,
    dim: int,
    confidence: float = CONFIDENCE,
    block: int | None = None,
    samples: int = 2000,
    seed: int = 0,
) -> Consistency:
    """Average over time of the NEES of one run, such as a recorded drive, with bounds that know of its correlation.

    The logarithm of the mean is as good as normal, its standard deviation is that of the resampled means of
    `block_bootstrap`, and ``log(mean / n)`` over it is compared with Student's t of T / block - 1 degrees of freedom.

    Args:
        values: (T,) from `jaxfilt.metrics.nees`; what is not finite is left out.
        dim: n.
        confidence: probability of the two-sided bounds around n.
        block, samples, seed: as in `block_bootstrap`.

    Returns:
        Consistency with numbers; bounds and p NaN with less than two blocks.

    Example:
        >>> import numpy as np
        >>> mean, expected, low, high, p = anees_of_one_run(np.random.default_rng(0).chisquare(3, 1000), dim=3)
        >>> bool(low < mean < high)
        True
    """
    from scipy.special import stdtr, stdtrit

    values, block = _prepared(values, block)
    mean = float(values.mean()) if len(values) else math.nan
    nothing = Consistency(mean, float(dim), math.nan, math.nan, math.nan)
    if len(values) < 2 * block or mean <= 0:
        return nothing
    error = float(np.log(_resampled_means(values, block, samples, seed)).std())
    if not error > 0:
        return nothing
    dof = len(values) / block - 1
    reach = float(stdtrit(dof, 0.5 + 0.5 * confidence)) * error
    p = 2 * float(stdtr(dof, -abs(math.log(mean / dim)) / error))
    # Beyond a factor of e^700 doubles end.
    return Consistency(mean, float(dim), dim * math.exp(-reach), dim * math.exp(min(reach, 700.0)), p)


def block_length(values: Array) -> int:
    """Length of blocks, in steps, that makes the variance of the resampled mean most accurate.

    ``b = (3/2 (G / g)^2 T)^(1/3)`` with ``g = sum_k R(k)``, ``G = sum_k |k| R(k)`` over lags of both signs, R the
    sample autocovariance, tapered by a flat-top window that ends at twice the lag after which it is insignificant;
    at most a third of the series and ``3 sqrt(T)``.

    Args:
        values: (T,), finite.

    Example: the more correlated, the longer.
        >>> import numpy as np
        >>> white = np.random.default_rng(0).normal(size=1000)
        >>> block_length(white) < block_length(np.convolve(white, np.ones(10)))
        True

    Source: Politis, White, Automatic block-length selection for the dependent bootstrap, Econometric Reviews 23 (2004),
    section 3.2, with the correction by Patton, Politis, White, Econometric Reviews 28 (2009).
    """
    x = np.asarray(values, np.float64)
    x, T = x - np.mean(x), len(x)
    longest = max(1, math.ceil(min(3 * math.sqrt(T), T / 3)))
    window = max(5, math.ceil(math.sqrt(math.log10(T))))
    last = min(math.ceil(math.sqrt(T)) + window, T - 1)
    R = np.array([x[: T - k] @ x[k:] for k in range(last + window + 1)]) / T
    if R[0] <= 0:
        return 1
    small = np.abs(R[1:]) < 2 * math.sqrt(math.log10(T) / T) * R[0]
    quiet = [m for m in range(last) if small[m : m + window].all()]
    M = min(2 * max(quiet[0] if quiet else last, 1), last)
    k = np.arange(M + 1)
    tapered = np.minimum(1.0, 2 * (1 - k / M)) * R[: M + 1]
    g, G = tapered[0] + 2 * tapered[1:].sum(), 2 * (k * tapered).sum()
    return min(longest, max(1, math.ceil((1.5 * (G / g) ** 2 * T) ** (1 / 3)))) if g > 0 else longest


def _prepared(values: Array, block: int | None) -> tuple[np.ndarray, int]:
    values = np.asarray(values, np.float64)
    values = values[np.isfinite(values)]
    if block is None:
        block = block_length(values) if len(values) > 1 else 1
    return values, block


def _resampled_means(values: np.ndarray, block: int, samples: int, seed: int) -> np.ndarray:
    """Means of ``samples`` series made of blocks of the ring; as many whole blocks as make T steps or just more."""
    rng, T = np.random.default_rng(seed), len(values)
    ring = np.cumsum(np.concatenate([[0.0], values, values[: block - 1]]))
    sums = ring[block:] - ring[:T]
    number = -(-T // block)
    batch = max(1, AT_ONCE // number)
    parts = [
        sums[rng.integers(T, size=(min(batch, samples - i), number))].mean(1) / block for i in range(0, samples, batch)
    ]
    return np.concatenate(parts)
