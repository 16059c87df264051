"""Is the claimed covariance the actual one? The noncredibility index, in decibels; host side, float64."""

from __future__ import annotations

import numpy as np

from jaxfilt.types import Array


def noncredibility(error: Array, nees: Array, mse: Array) -> tuple[np.ndarray, np.ndarray]:
    """Noncredibility index and inclination of an estimator at each step, decibels: 0 for a credible one.

    ``NCI = 10 mean_i |log10 a_i - log10 b_i|``, ``inclination = 10 mean_i (log10 a_i - log10 b_i)``, where ``a_i`` is
    the NEES of run i by the covariance that the filter claims and ``b_i = e_i' mse^-1 e_i`` that by the actual mean
    squared error. Inclination above 0: the filter is optimistic, its covariance too small; below: pessimistic.
    Claims that err in both directions show in the index only.

    Args:
        error: (N, T, n) from `jaxfilt.metrics.errors`, of N runs.
        nees: (N, T) from `jaxfilt.metrics.nees`; what is not finite and positive does not count.
        mse: (T, n, n), the mean of ``e e'``, from these runs or many more.

    Returns:
        ((T,), (T,)); NaN where mse is singular, as it is with fewer than n runs, or no run counts.

    Example: errors ten times as large, squared, as the filter claims.
        >>> import numpy as np
        >>> e = np.random.default_rng(0).normal(size=(20, 1, 2))
        >>> nees = 10 * (e**2).sum(-1)
        >>> index, inclination = noncredibility(e, nees, np.eye(2)[None])
        >>> round(float(index[0]), 6), round(float(inclination[0]), 6)
        (10.0, 10.0)

    Source: Li, Zhao, Jilkov, Estimator's credibility and its measures, IFAC World Congress (2002); Li, Zhao, Measuring
    estimator's credibility: noncredibility index, Int. Conf. Information Fusion (2006).
    """
    error, nees, mse = (np.asarray(a, np.float64) for a in (error, nees, mse))
    n = error.shape[-1]
    sound = np.isfinite(mse).all((1, 2))
    safe = np.where(sound[:, None, None], mse, np.eye(n))
    # Singular is judged with each component in units of its own spread: metres beside radians are no defect.
    size = np.sqrt(np.diagonal(safe, axis1=1, axis2=2))
    sound &= (size > 0).all(1)
    size = np.where(sound[:, None], size, 1.0)
    correlation = np.where(sound[:, None, None], safe / (size[:, :, None] * size[:, None, :]), np.eye(n))
    sound &= np.linalg.eigvalsh(correlation)[:, 0] > n * np.finfo(float).eps
    precision = np.linalg.inv(np.where(sound[:, None, None], correlation, np.eye(n)))
    scaled = error / size
    actual = np.einsum("rti,tij,rtj->rt", scaled, precision, scaled)
    counts = sound & np.isfinite(nees) & (nees > 0) & np.isfinite(actual) & (actual > 0)
    difference = 10 * (np.log10(np.where(counts, nees, 1.0)) - np.log10(np.where(counts, actual, 1.0)))
    number = counts.sum(0)
    known = np.where(number > 0, number, np.nan)
    return np.abs(difference).sum(0) / known, difference.sum(0) / known
