"""What is believed of parameters before any data: log densities, to be added up to a ``prior(theta)``.

Each is the density of the quantity it is called with, and of nothing else: `log_normal` that of a logarithm, as theta
holds it, `inverse_wishart` that of a matrix. No Jacobian is added on the way from theta to that quantity. Where a
posterior has its maximum depends on this choice.

Example: a standard deviation of about 2 m, known to a factor of 3; a rate near 0.1.
    >>> import math
    >>> def prior(theta):
    ...     return log_normal(theta["gnss"], median=2.0, factor=3.0) + normal(theta["rate"], mean=0.1, std=0.05)
    >>> round(float(prior({"gnss": math.log(6.0), "rate": 0.1})), 3)  # one factor off, and at the mean
    0.564
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors, linalg
from jaxfilt.types import Array


def normal(value: Array | float, mean: Array | float, std: Array | float) -> jax.Array:
    """Log density of independent normal numbers: ``sum_i log N(value_i; mean_i, std_i^2)``.

    Args:
        value: any shape: a bias, a lever arm, a logarithm, ...
        mean, std: numbers, or of the shape of ``value``, in its unit; std > 0.

    Returns:
        A scalar; a density in value.

    Raises:
        ValueError: std <= 0, numbers that are not finite, shapes that differ.
        TypeError: values that are no floating numbers.

    Example:
        >>> round(float(normal(2.0, mean=1.0, std=0.5)), 4)
        -2.2258
    """
    value = _floating("normal(value)", value)
    mean, std = _numbers("normal(mean)", mean, value), _numbers("normal(std)", std, value)
    if (std <= 0).any():
        raise ValueError(f"normal(std): expected numbers > 0, got {std.min():g}")
    e = (value - jnp.asarray(mean, value.dtype)) / jnp.asarray(std, value.dtype)
    return -0.5 * (e * e).sum() - _total(np.log(std) + 0.5 * math.log(2 * math.pi), value)


def log_normal(logarithm: Array | float, median: Array | float, factor: Array | float) -> jax.Array:
    """Log density of numbers known to a factor, held as logarithms: ``sum log N(log v; log median, (log factor)^2)``.

    Two times in three v is between ``median / factor`` and ``median factor``. The density is that of the logarithm,
    which is normal: its maximum is at the median, however wide it is. That of v itself, the log-normal density of the
    books, has a Jacobian 1 / v more, and its maximum at ``median exp(-(log factor)^2)``.

    Args:
        logarithm: log v, any shape, as theta holds standard deviations.
        median, factor: numbers, or of the shape of ``logarithm``; median > 0 in the unit of v, factor > 1.

    Returns:
        A scalar; a density in log v.

    Raises:
        ValueError: median <= 0, factor <= 1, numbers that are not finite, shapes that differ.
        TypeError: logarithms that are no floating numbers.

    Example: at the median.
        >>> import math
        >>> round(float(log_normal(math.log(0.2), median=0.2, factor=math.e)), 4)
        -0.9189
    """
    value = _floating("log_normal(logarithm)", logarithm)
    median, factor = _numbers("log_normal(median)", median, value), _numbers("log_normal(factor)", factor, value)
    if (median <= 0).any():
        raise ValueError(f"log_normal(median): expected numbers > 0, got {median.min():g}")
    if (factor <= 1).any():
        raise ValueError(f"log_normal(factor): expected numbers > 1, got {factor.min():g}")
    return normal(value, np.log(median), np.log(factor))


def inverse_wishart(cov: Array, dof: float, scale: Array) -> jax.Array:
    """Log density of a covariance matrix, inverse-Wishart: near ``scale / dof``, as if seen in ``dof`` samples before.

    ``(dof log |scale| - dof n log 2 - (dof + n + 1) log |cov| - tr(scale cov^-1)) / 2 - log Gamma_n(dof / 2)``. Its
    mean is ``scale / (dof - n - 1)``, its maximum at ``scale / (dof + n + 1)``. It vanishes at a singular matrix, and
    so keeps a covariance away from there.

    Args:
        cov: (n, n) positive definite: ``parametrisation.cov(theta[...])``, or what a model says.
        dof: degrees of freedom, > n - 1.
        scale: (n, n) positive definite, in the unit of ``cov``.

    Returns:
        A scalar; a density in the n (n + 1) / 2 elements of cov, not in theta. NaN where cov is not positive definite.

    Raises:
        ValueError: dof <= n - 1, matrices that are no covariances or not of one shape, a singular scale.

    Example: one variance of 2, the inverse-gamma density with shape 3/2 and scale 1/2.
        >>> import jax.numpy as jnp
        >>> round(float(inverse_wishart(jnp.array([[2.0]]), dof=3.0, scale=jnp.array([[1.0]]))), 4)
        -2.9018

    Source: Gelman et al., Bayesian Data Analysis (3rd ed., 2013), appendix A, table A.1.
    """
    doors.covariance("inverse_wishart(cov)", cov)
    n = len(cov)
    doors.covariance("inverse_wishart(scale)", scale, n)
    if not n - 1 < dof < math.inf:
        raise ValueError(f"inverse_wishart(dof): expected a finite number > {n - 1}, got {dof}")
    cov = jnp.asarray(cov)
    root, L = linalg.cholesky(jnp.asarray(scale, cov.dtype)), linalg.cholesky(cov)
    if doors.is_concrete(root) and np.isnan(root).any():
        raise ValueError("inverse_wishart(scale): expected a positive definite matrix, got a singular one")
    w = linalg.forward_solve(L, root)
    determinants = dof * linalg.log_determinant(root) - (dof + n + 1) * linalg.log_determinant(L)
    gamma = 0.25 * n * (n - 1) * math.log(math.pi) + sum(math.lgamma(0.5 * (dof - i)) for i in range(n))
    return 0.5 * (determinants - (w * w).sum() - dof * n * math.log(2)) - gamma


def _floating(name: str, value: Any) -> jax.Array:
    doors.floating(name, value)
    return jnp.asarray(value)


def _numbers(name: str, given: Any, value: jax.Array) -> np.ndarray:
    """Numbers of a prior in float64, one or as many as there are values."""
    numbers = np.asarray(given, np.float64)
    doors.finite(name, numbers)
    if numbers.shape not in ((), value.shape):
        raise ValueError(f"{name}: expected a number or shape {value.shape}, got shape {numbers.shape}")
    return numbers


def _total(each: np.ndarray, value: jax.Array) -> float:
    return float(np.broadcast_to(each, value.shape).sum())
