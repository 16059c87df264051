"""The sums that leave a chunk of runs: all that a study says of a filter is computed from them.

Inside the program they are taken over the runs of a chunk, on the host added up over chunks in float64: what is kept
does not grow with the number of runs.
"""

from __future__ import annotations

from collections.abc import Sequence
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
    """Over runs: how many values were finite, their sum, and the sum of their squares; None: nobody asks for it."""

    number: Array
    first: Array
    second: Array


class Sums(NamedTuple):
    """What is added up over runs, for each filter (leading axis F).

    By score, see `columns`: ``rows`` (F, T, k) at each row, ``averages`` (F, k) of the runs' own averages over time.
    ``runs`` (F,) in the sums; ``outer`` (F, T, n, n) of ``e e'``; ``errors`` (F, n, bins) and ``run_nees`` (F, bins)
    histograms; ``dots`` and ``pairs`` (F, L) by sensor, the products of normalised innovations at each lag and their
    number; ``paired`` (pairs of filters, B + 1) of the differences of two filters' averages: squared error by block,
    log score.
    """

    runs: Array
    rows: dict[str, Moments]
    averages: dict[str, Moments]
    outer: Array
    errors: Array
    run_nees: Array
    dots: dict[str, Array]
    pairs: dict[str, Array]
    paired: Moments


class Columns(NamedTuple):
    """Where each score lies ``at`` in a row's vector (K,): one array in place of many keeps the program small.

    Parts of it are ``summed`` over runs at each row, ``counted`` there, ``squared`` there, or ``averaged`` over time.
    """

    at: dict[str, slice]
    summed: slice
    counted: slice
    squared: slice
    averaged: slice

    def named(self, part: slice, values: Array) -> dict[str, Array]:
        """By score, what a part (..., k) holds of it."""
        inside = {name: at for name, at in self.at.items() if part.start <= at.start and at.stop <= part.stop}
        return {name: values[..., at.start - part.start : at.stop - part.start] for name, at in inside.items()}


def columns(dim: int, blocks: int, sensors: Sequence[str]) -> Columns:
    """Those of n = ``dim`` and so many blocks, in an order that makes each part one slice."""
    sizes = {f"{what} {sensor}": 1 for sensor in sensors for what in ("nis", "dof", "used", "refused")}
    sizes |= {"variance": dim, "error": dim, "square": blocks, "log_score": 1, "nees": 1 + blocks}
    sizes |= {"covered": len(COVERAGES), "normalised": dim, "nees_square": 1 + blocks}
    ends = np.cumsum(list(sizes.values()))
    at = {name: slice(int(end) - size, int(end)) for (name, size), end in zip(sizes.items(), ends, strict=True)}
    return Columns(
        at,
        summed=slice(0, at["covered"].stop),
        counted=slice(at["variance"].start, at["nees"].stop),
        squared=slice(at["error"].start, at["log_score"].stop),
        averaged=slice(at["square"].start, at["nees_square"].stop),
    )


def score(
    place: Columns, blocks: Blocks, error: Array, cov: Array, info: dict[str, Info]
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """One filter at one row: the vector (K,) of `columns`, and by sensor the normalised innovation ``L^-1 r`` (m,)."""
    n = len(error)
    L = linalg.cholesky(cov)
    w = linalg.forward_solve(L, error)
    state, variance = w @ w, jnp.diagonal(cov)
    nees = jnp.stack([state, *(_block_nees(b, w, error, cov) for b in blocks)])
    levels = jnp.asarray([float(chisquare.quantile(level, n)) for level in COVERAGES], error.dtype)
    values = {
        "variance": variance,
        "error": error,
        "square": jnp.stack([sum(jnp.square(error[i]) for i in b) for b in blocks]),
        "log_score": -0.5 * (state + linalg.log_determinant(L) + n * float(np.log(2 * np.pi)))[None],
        "nees": nees,
        "covered": jnp.where(jnp.isfinite(state), (state <= levels).astype(error.dtype), jnp.nan),
        "normalised": error / jnp.sqrt(variance),
        "nees_square": jnp.square(nees),
    }
    white = {}
    for name, i in info.items():
        nis, dof = metrics.used(i)
        marks = {"dof": dof, "used": dof > 0, "refused": i.status == Status.GATED}
        values |= {f"{what} {name}": mark.astype(error.dtype)[None] for what, mark in marks.items()}
        values[f"nis {name}"] = nis[None]
        S = jnp.where(dof > 0, i.S, jnp.eye(len(i.S), dtype=i.S.dtype))  # where it was silent S is 0: no root
        whitened = linalg.forward_solve(linalg.cholesky(S), i.innovation)
        white[name] = jnp.where(dof > 0, whitened, 0.0)
    return jnp.concatenate([values[name] for name in place.at]), white


def _block_nees(block: tuple[int, ...], w: Array, error: Array, cov: Array) -> jax.Array:
    """The NEES of some components; ``w = L^-1 e`` of all of them has that of the first few, whose factor is in L."""
    k = len(block)
    if sorted(block) == list(range(k)):
        return w[:k] @ w[:k]
    picked = jnp.stack([jnp.stack([cov[i, j] for j in block]) for i in block])
    return metrics.nees(jnp.stack([error[i] for i in block]), picked)


def moments(values: Array, there: Array, axis: int) -> Moments:
    """Sums along an axis of what is there."""
    kept = jnp.where(there, values, 0.0)
    return Moments(there.sum(axis), kept.sum(axis), jnp.square(kept).sum(axis))


def histogram(values: Array, there: Array, edges: np.ndarray) -> jax.Array:
    """Counts (bins,) between the edges; what is beyond them falls into the outermost bins."""
    # One edge after the other: all at once would need memory for each value and edge.
    below = jax.lax.map(lambda edge: ((values < edge) & there).sum(), jnp.asarray(edges[1:-1], values.dtype))
    return jnp.diff(below, prepend=0, append=there.sum())


def every(steps: int) -> int:
    """Each so manieth row of a run is among the `SOME_ROWS`."""
    return max(1, steps // SOME_ROWS)


def error_histogram(normalised: Array, weights: Array) -> jax.Array:
    """Counts (n, bins) of the normalised errors (R, rows, n) of runs with weights (R,) True."""
    errors = jnp.moveaxis(normalised, -1, 0)
    return jax.vmap(histogram, in_axes=(0, 0, None))(errors, jnp.isfinite(errors) & weights[None, :, None], ERROR_EDGES)
