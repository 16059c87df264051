"""Scores of an estimate: the only room that knows the truth.

A filter is *consistent* if its errors are as large as its covariances say. With the truth known, the normalised
estimation error squared (NEES) tells; without it, the normalised innovation squared (NIS) and the whiteness of the
innovations. Source of all three: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation
(2001), section 5.4.2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import chisquare, doors, linalg
from jaxfilt.consistency import CONFIDENCE, Consistency, mean_of_squares, ratio
from jaxfilt.types import Array, Info, PyTree, Space, Status

DIVERGED = 1e-9
"""A run has diverged if its last NEES is one that a consistent filter exceeds with this probability."""

Blocks = Mapping[str, tuple[tuple[int, ...], str]]


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
        return _score(e, P)[0]

    return jnp.vectorize(one, signature="(n),(n,n)->()")(error, cov)


def log_score(error: Array, cov: Array) -> jax.Array:
    """Logarithm of the density that the belief gives to the truth, ``log N(e; 0, P)``: larger is better.

    Unlike the NEES it rewards a small covariance as well as an honest one, so it ranks filters: its expectation is
    largest for the true covariance.

    Args:
        error: (..., n) from `errors`.
        cov: (..., n, n) with the same leading axes.

    Returns:
        (...,); NaN where P is not positive definite.

    Example: no error, standard deviations of 2 and 3.
        >>> import jax.numpy as jnp
        >>> round(float(log_score(jnp.zeros(2), jnp.diag(jnp.array([4.0, 9.0])))), 4)
        -3.6296

    Source: Gneiting, Raftery, Strictly proper scoring rules, prediction, and estimation, JASA 102 (2007), section 4.1.
    """

    def one(e: Array, P: Array) -> jax.Array:
        square, log_determinant = _score(e, P)
        return -0.5 * (square + log_determinant + len(e) * math.log(2 * math.pi))

    return jnp.vectorize(one, signature="(n),(n,n)->()")(error, cov)


def _score(e: Array, P: Array) -> tuple[jax.Array, jax.Array]:
    """``e' P^-1 e`` and ``log |P|``."""
    return linalg.score(P, linalg.cholesky(P), e)


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
    square = ratio((counted**2).sum(0), np.full(error.shape[-1], len(counted)))
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
        >>> [round(float(x[0]), 2) for x in average[:4]]
        [2.0, 2.0, 1.48, 2.59]
    """
    values = np.asarray(values, np.float64)
    finite = np.isfinite(values)
    count = finite.sum(0)
    return mean_of_squares(np.where(finite, values, 0.0).sum(0), dim * count, count, confidence)


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
        >>> mean, expected, low, high, p = anis(jf.scan(jf.kf(walk), start, log).info["z"])
        >>> expected, bool(low < mean < high)
        (1.0, True)
    """
    value, dof = used(info)
    count = int((np.asarray(dof) > 0).sum())
    total = mean_of_squares(np.asarray(value, np.float64).sum(), np.asarray(dof).sum(), np.asarray(count), confidence)
    return Consistency(*map(float, total))


def divergence_threshold(dim: int) -> float:
    """The NEES of ``dim`` components that a consistent filter exceeds with probability `DIVERGED`.

    Example:
        >>> round(divergence_threshold(2), 1)
        41.4
    """
    return float(chisquare.quantile(1 - DIVERGED, dim))


def diverged(last_nees: Array, sound: Array, dim: int) -> np.ndarray:
    """Which runs have diverged: not finite or faulty somewhere, or lost at the end.

    Lost is a last NEES beyond the ``1 - 1e-9`` quantile of chi-square with n degrees of freedom, 41 for n = 2
    (`divergence_threshold`).

    Args:
        last_nees: (runs,) at the last step.
        sound: (runs,) whether all estimates were finite, and no status was `Status.BAD_BELIEF` or worse.
        dim: n.

    Returns:
        (runs,) bool.
    """
    return ~np.asarray(sound) | (np.asarray(last_nees) > divergence_threshold(dim))


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
        rho.append(ratio((a * b).sum(), np.sqrt((a * a).sum() * (b * b).sum())))
        pairs.append(np.minimum(dof[:-lag], dof[lag:]).sum())
    bound = float(ndtri(0.5 + 0.5 * confidence)) / np.sqrt(np.array(pairs, float))
    return Whiteness(np.arange(1, len(rho) + 1), np.array(rho), bound)


def whiteness_of_sums(dots: Array, pairs: Array, nis: float, dof: float, confidence: float = CONFIDENCE) -> Whiteness:
    """Autocorrelation of a sensor's normalised innovations over many runs, from sums: see `whiteness`.

    ``rho(l) = (dots(l) / pairs(l)) / (nis / dof)``. The innovations of a consistent filter are independent within a
    run and between runs, so that rho is approximately ``N(0, 1 / pairs)``.

    Args:
        dots: (L,), the sum over runs and time of ``e_k' e_(k+l)`` at lags l = 1 ... L, in readings.
        pairs: (L,), how many products of components are in it.
        nis, dof: sum over runs and time of the NIS and of its degrees of freedom.
        confidence: probability that one lag is within its bound.

    Returns:
        Whiteness with arrays (L,); NaN at lags that no pair has.

    Example: a tenth of each innovation is left in the next one.
        >>> import numpy as np
        >>> white = whiteness_of_sums(np.array([100.0]), np.array([1000]), nis=1010.0, dof=1010)
        >>> float(white.autocorrelation[0]), round(float(white.bound[0]), 3)
        (0.1, 0.104)
    """
    from scipy.special import ndtri

    pairs = np.asarray(pairs)
    variance = ratio(np.asarray(nis, np.float64), np.asarray(dof))
    autocorrelation = ratio(np.asarray(dots, np.float64), pairs) / np.where(variance > 0, variance, np.nan)
    bound = ndtri(0.5 + 0.5 * confidence) * np.sqrt(ratio(np.ones(pairs.shape), pairs))
    return Whiteness(np.arange(1, len(pairs) + 1), autocorrelation, bound)


@jax.jit
@jax.vmap
def _normalised(r: Array, S: Array) -> jax.Array:
    return linalg.forward_solve(linalg.cholesky(S), r)
