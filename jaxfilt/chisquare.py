"""Quantiles of the chi-square distribution, for gates and consistency bounds."""

from __future__ import annotations

import numpy as np


def quantile(probability: float, dof: int | np.ndarray) -> np.ndarray:
    """The value below which a chi-square variable with ``dof`` degrees of freedom falls with this probability.

    Example:
        >>> round(float(quantile(0.95, 2)), 4)
        5.9915
    """
    from scipy.special import chdtri  # scipy comes with jax; imported where it is used, to keep `import jaxfilt` quick

    if not 0 < probability < 1:
        raise ValueError(f"probability: expected a number between 0 and 1, got {probability}")
    return np.asarray(chdtri(dof, 1 - probability))


def bounds(confidence: float, dof: int | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two-sided interval that a chi-square variable falls into with this probability: equal tails.

    Example: the mean of 50 independent NEES of a 2-state filter, which is 1.5 and 2.6 in the textbooks.
        >>> [round(float(b) / 50, 2) for b in bounds(0.95, 50 * 2)]
        [1.48, 2.59]
    """
    tail = 0.5 * (1 - confidence)
    return quantile(tail, dof), quantile(1 - tail, dof)
