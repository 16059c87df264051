"""The sums that leave a chunk of runs: all that a study says of a filter is computed from them.

Inside the program they are taken over the runs of a chunk, on the host added up over chunks in float64: what is kept
does not grow with the number of runs.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import chisquare, linalg, metrics
from jaxfilt.types import Array, Info, Status

COVERAGES = (0.5, 0.9, 0.99)
"""Probabilities of the credible ellipsoids whose coverage is counted."""

ERROR_EDGES = np.linspace(-4.0, 4.0, 65)
"""Of the histogram of normalised errors."""

NEES_EDGES = np.exp2(np.linspace(-5.0, 7.0, 97))
"""Of the histogram of the runs' own average NEES, over its expectation."""

SOME_ROWS = 100
"""Histograms and samples are taken at about so many rows: neighbours in time say the same again."""

Blocks = tuple[tuple[int, ...], ...]
"""Indices of the tangent vector, by block."""


class Moments(NamedTuple):
    """Over runs: how many values were finite, their sum, and the sum of their squares."""

    number: Array
    first: Array
    second: Array


class Sums(NamedTuple):
    """What is added up over runs, for each filter (leading axis F).

    ``rows`` (F, T, K) at each row and ``averages`` (F, K) of the runs' own averages over time, columns as in
    `columns`; ``runs`` (F,) in the sums; ``outer`` (F, T, n, n) of ``e e'``; ``errors`` (F, n, bins) and ``run_nees``
    (F, bins) histograms; ``dots`` and ``pairs`` (F, L) by sensor, the products of normalised innovations at each lag
    and their number; ``paired`` (pairs of filters, B + 1) of the differences of two filters' averages: squared error
    by block, log score.
    """

    runs: Array
    rows: Moments
    averages: Moments
    outer: Array
    errors: Array
    run_nees: Array
    dots: dict[str, Array]
    pairs: dict[str, Array]
    paired: Moments


def columns(dim: int, blocks: int, sensors: list[str]) -> dict[str, slice]:
    """Where each score lies in a row's vector (K,): one array in place of many keeps the program small."""
    sizes = {
        "error": dim,
        "variance": dim,
        "normalised": dim,
        "square": blocks,
        "nees": 1 + blocks,
        "nees_square": 1 + blocks,
        "log_score": 1,
        "covered": len(COVERAGES),
    }
    for sensor in sensors:
        sizes |= {f"{what} {sensor}": 1 for what in ("nis", "dof", "used", "refused")}
    ends = np.cumsum(list(sizes.values()))
    return {name: slice(int(end) - size, int(end)) for (name, size), end in zip(sizes.items(), ends, strict=True)}


def score(blocks: Blocks, error: Array, cov: Array, info: dict[str, Info]) -> tuple[jax.Array, dict[str, jax.Array]]:
    """One filter at one row: the vector (K,) of `columns`, and by sensor the normalised innovation ``L^-1 r`` (m,)."""
    n = len(error)
    L = linalg.cholesky(cov)
    w = linalg.forward_solve(L, error)
    state, variance = w @ w, jnp.diagonal(cov)
    by_block = [state if len(b) == n else metrics.nees(error[b,], cov[np.ix_(b, b)]) for b in blocks]
    levels = jnp.asarray([float(chisquare.quantile(level, n)) for level in COVERAGES], error.dtype)
    covered = jnp.where(jnp.isfinite(state), (state <= levels).astype(error.dtype), jnp.nan)
    log_score = -0.5 * (state + linalg.log_determinant(L) + n * float(np.log(2 * np.pi)))
    values = [error, variance, error / jnp.sqrt(variance), jnp.stack([jnp.square(error[b,]).sum() for b in blocks])]
    nees = jnp.stack([state, *by_block])
    values += [nees, jnp.square(nees), log_score[None], covered]
    white = {}
    for name, i in info.items():
        nis, dof = metrics.used(i)
        marks = jnp.stack([a.astype(error.dtype) for a in (dof, dof > 0, i.status == Status.GATED)])
        values += [nis[None], marks]
        S = jnp.where(dof > 0, i.S, jnp.eye(len(i.S), dtype=i.S.dtype))  # where it was silent S is 0: no root
        whitened = linalg.forward_solve(linalg.cholesky(S), i.innovation)
        white[name] = jnp.where(dof > 0, whitened, 0.0)
    return jnp.concatenate(values), white


def moments(values: Array, there: Array, axis: int) -> Moments:
    """Sums along an axis of what is there."""
    kept = jnp.where(there, values, 0.0)
    return Moments(there.sum(axis), kept.sum(axis), jnp.square(kept).sum(axis))


def histogram(values: Array, there: Array, edges: np.ndarray) -> jax.Array:
    """Counts (bins,) between the edges; what is beyond them falls into the outermost bins."""
    inner = jnp.asarray(edges[1:-1], values.dtype).reshape((1,) * values.ndim + (-1,))
    below = (values[..., None] < inner) & there[..., None]
    cumulative = below.reshape(-1, len(edges) - 2).sum(0)
    return jnp.diff(cumulative, prepend=0, append=there.sum())


def every(steps: int) -> int:
    """Each so manieth row of a run is among the `SOME_ROWS`."""
    return max(1, steps // SOME_ROWS)


def error_histogram(normalised: Array, weights: Array) -> jax.Array:
    """Counts (n, bins) of the normalised errors (T, R, n) of runs with weights (R,) True, at some rows."""
    step = every(len(normalised))
    some = jnp.moveaxis(normalised[step - 1 :: step], -1, 0)
    return jax.vmap(histogram, in_axes=(0, 0, None))(some, jnp.isfinite(some) & weights[None, None], ERROR_EDGES)


def lagged(white: Array, order: Array, lags: int) -> tuple[jax.Array, jax.Array]:
    """Of normalised innovations (T, R, m) that are 1, 2, ... readings apart: sums (lags,) of products, their number.

    What was not used is exactly 0 in ``white``, and what was used never is: the noise is continuous.
    """
    ordered = white[order]
    later = jnp.concatenate([ordered, jnp.zeros((lags, *ordered.shape[1:]), ordered.dtype)])

    def at(lag: Array) -> tuple[jax.Array, jax.Array]:
        product = ordered * jax.lax.dynamic_slice_in_dim(later, lag, len(ordered))
        return product.sum(), (product != 0).sum()

    return jax.lax.map(at, jnp.arange(1, lags + 1))
