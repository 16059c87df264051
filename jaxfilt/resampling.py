"""Drawing particles by their weights: each as often as its weight says, on average, with as little noise as may be."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def systematic(key: jax.Array, log_weights: jax.Array) -> jax.Array:
    """Indices drawn with one random number: ``n_i`` is one of the two whole numbers next to ``N w_i``, mean ``N w_i``.

    Args:
        key: of `jax.random`.
        log_weights: (N,), up to a constant.

    Returns:
        (N,) int32, in increasing order.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> systematic(jax.random.key(0), jnp.log(jnp.array([0.5, 0.0, 0.25, 0.25]))).tolist()
        [0, 0, 2, 3]

    Source: Kitagawa, Monte Carlo filter and smoother for non-Gaussian nonlinear state space models (1996), appendix.
    """
    return _chosen(jax.random.uniform(key, (), log_weights.dtype), log_weights)


def stratified(key: jax.Array, log_weights: jax.Array) -> jax.Array:
    """Indices drawn with one random number in each of N equal strata: ``n_i`` differs from ``N w_i`` by less than 2.

    Arguments and returns as of `systematic`. Source: as there.
    """
    return _chosen(jax.random.uniform(key, log_weights.shape, log_weights.dtype), log_weights)


def effective_size(log_weights: jax.Array) -> jax.Array:
    """``(sum w)^2 / sum w^2``: of how many particles of equal weight these are worth, 1 to N.

    Source: Kong, Liu, Wong, Sequential imputations and Bayesian missing data problems (1994), section 4.1.
    """
    return jnp.exp(2 * jax.nn.logsumexp(log_weights) - jax.nn.logsumexp(2 * log_weights))


def _chosen(within: jax.Array, log_weights: jax.Array) -> jax.Array:
    """For each stratum i the index at which the cumulated weights pass ``(i + within) / N``."""
    n = len(log_weights)
    passed = jnp.cumsum(jnp.exp(log_weights - log_weights.max()))
    # Strictly below the total, whatever the rounding: then nothing beyond the last that weighs something is chosen.
    at = (jnp.arange(n, dtype=passed.dtype) + within) / n * passed[-1]
    at = jnp.minimum(at, jnp.nextafter(passed[-1], jnp.zeros_like(passed[-1])))
    return jnp.searchsorted(passed, at, side="right").astype(jnp.int32)
