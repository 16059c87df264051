"""A linear chain of Gaussian offsets with loose ends tied: the sparse least-squares problem inside Gauss-Newton.

``d_0 ~ N(g_0, Q_0)``, ``d_k = F_k d_{k-1} + g_k + N(0, Q_k)``, readings ``r_k = H_k d_k + N(0, I)`` and ties
``r_l = A_l d_i + B_l d_j + N(0, I)``. The chain alone is a Kalman filter and a Rauch-Tung-Striebel smoother, which is
block elimination of its block tridiagonal normal equations, in the form that no covariance is inverted in: static
states and instants that coincide (Q_k singular or 0) are nothing special. Ties come on top by a low-rank correction.

Source: B. M. Bell, The iterated Kalman smoother as a Gauss-Newton method (1994); the correction: G. H. Golub, C. F. Van
Loan, Matrix Computations (2013), eq. 2.1.4.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxfilt import linalg
from jaxfilt.types import Array

AT_ONCE = 128
"""Columns of ties that are carried through the chain together: memory for so many trajectories."""


class Chain(NamedTuple):
    """Leading axis T, but for the start, that of the offset before the first row: ``g0`` (n,) and ``Q0`` (n, n)."""

    g0: Array
    Q0: Array
    F: Array
    g: Array
    Q: Array
    H: Array
    r: Array
    moves: Array
    """(T,) bool: whether time passes; where not, F is I, g 0 and Q 0."""


class Ties(NamedTuple):
    """L whitened rows, each between two offsets, 0 (before the first row) to T: ``r = A d[i] + B d[j] + N(0, 1)``."""

    i: Array
    j: Array
    A: Array
    B: Array
    r: Array


class Gains(NamedTuple):
    """What the passes over a chain need: filtered covariances P (T, n, n), Kalman gains K, smoother gains G."""

    P: Array
    K: Array
    G: Array


def gains(chain: Chain) -> Gains:
    """The covariances of the filter, and the gains of both passes."""
    eye = jnp.eye(len(chain.g0), dtype=chain.F.dtype)

    def body(P: jax.Array, row: tuple) -> tuple[jax.Array, Gains]:
        F, Q, H, moves = row
        before = linalg.symmetrize(F @ P @ F.T + Q)
        G = jnp.where(moves, _regression(P @ F.T, before), eye)
        cross = before @ H.T
        S = linalg.symmetrize(H @ cross) + jnp.eye(len(H), dtype=H.dtype)
        K = linalg.gain(cross, linalg.cholesky(S))
        E = eye - K @ H
        after = linalg.symmetrize(E @ before @ E.T + K @ K.T)
        return after, Gains(after, K, G)

    return jax.lax.scan(body, chain.Q0, (chain.F, chain.Q, chain.H, chain.moves))[1]


def _regression(cross: jax.Array, cov: jax.Array) -> jax.Array:
    """C P^- for cross C and a covariance P that may be singular: P^- any inverse of it on its range."""
    L = linalg.semidefinite_cholesky(cov)
    empty = jnp.diagonal(L) == 0
    L = L + jnp.diag(jnp.where(empty, 1.0, 0.0).astype(L.dtype))
    # What is left of a row without a pivot is rounding: in the range of P it is 0.
    y = jnp.where(empty[:, None], 0.0, linalg.forward_solve(L, cross.T))
    return linalg.backward_solve(L, y).T


def solution(chain: Chain, gains: Gains) -> jax.Array:
    """The offsets (T + 1, n) of least squares, without ties."""
    corrections = jax.vmap(jnp.matmul)(gains.K, chain.r)
    return _passes(chain, gains, chain.g0, chain.g, corrections)


def covariance_times(chain: Chain, gains: Gains, b: jax.Array) -> jax.Array:
    """C b (T + 1, n) for the covariance C of all offsets given the readings, and b (T + 1, n)."""
    corrections = jax.vmap(jnp.matmul)(gains.P, b[1:])
    return _passes(chain, gains, chain.Q0 @ b[0], jnp.zeros_like(chain.g), corrections)


def _passes(chain: Chain, gains: Gains, d0: jax.Array, g: jax.Array, corrections: jax.Array) -> jax.Array:
    """``d = before - K H before + correction`` forwards, the smoother backwards."""

    def forwards(d: jax.Array, row: tuple) -> tuple[jax.Array, tuple]:
        F, g, K, H, correction = row
        before = F @ d + g
        after = before - K @ (H @ before) + correction
        return after, (before, after)

    last, (before, after) = jax.lax.scan(forwards, d0, (chain.F, g, gains.K, chain.H, corrections))
    earlier = jnp.concatenate([d0[None], after[:-1]])

    def backwards(later: jax.Array, row: tuple) -> tuple[jax.Array, jax.Array]:
        d, before, G = row
        d = d + G @ (later - before)
        return d, d

    smoothed = jax.lax.scan(backwards, last, (earlier, before, gains.G), reverse=True)[1]
    return jnp.concatenate([smoothed, last[None]])


def covariances(chain: Chain, gains: Gains) -> jax.Array:
    """Marginal covariances (T + 1, n, n) without ties: ``(I - G F) P (I - G F)' + G (Q + P_s) G'``, a product."""
    earlier = jnp.concatenate([chain.Q0[None], gains.P[:-1]])
    eye = jnp.eye(len(chain.g0), dtype=chain.F.dtype)

    def body(later: jax.Array, row: tuple) -> tuple[jax.Array, jax.Array]:
        P, F, Q, G, moves = row
        E = eye - G @ F
        P = linalg.symmetrize(E @ P @ E.T + G @ (Q + later) @ G.T)
        P = jnp.where(moves, P, later)
        return P, P

    rows = (earlier, chain.F, chain.Q, gains.G, chain.moves)
    smoothed = jax.lax.scan(body, gains.P[-1], rows, reverse=True)[1]
    return jnp.concatenate([smoothed, gains.P[-1:]])


def across(ties: Ties, d: jax.Array) -> jax.Array:
    """A d[i] + B d[j] (L,), for offsets d (T + 1, n)."""
    return jnp.sum(ties.A * d[ties.i] + ties.B * d[ties.j], axis=1)


def _pull(ties: Ties, weights: jax.Array, shape: tuple) -> jax.Array:
    """The transpose of `across`, applied to weights (L,)."""
    nothing = jnp.zeros(shape, weights.dtype)
    return nothing.at[ties.i].add(weights[:, None] * ties.A).at[ties.j].add(weights[:, None] * ties.B)


def tied_factor(chain: Chain, gains: Gains, ties: Ties) -> tuple[jax.Array, jax.Array]:
    """M (L, L), the covariance of the ties' innovations given the chain, and its Cholesky factor."""
    shape, eye = (len(chain.F) + 1, len(chain.g0)), jnp.eye(len(ties.r), dtype=chain.F.dtype)

    def column(weights: jax.Array) -> jax.Array:
        return across(ties, covariance_times(chain, gains, _pull(ties, weights, shape)))

    M = linalg.symmetrize(jax.lax.map(column, eye, batch_size=AT_ONCE)) + eye
    return M, linalg.cholesky(M)


def tied_solution(chain: Chain, gains: Gains, ties: Ties | None) -> jax.Array:
    """The offsets (T + 1, n) of least squares."""
    d = solution(chain, gains)
    if ties is None:
        return d
    M, L = tied_factor(chain, gains, ties)
    multipliers = linalg.solve(M, L, ties.r - across(ties, d))
    return d + covariance_times(chain, gains, _pull(ties, multipliers, d.shape))


def tied_covariances(chain: Chain, gains: Gains, ties: Ties | None) -> jax.Array:
    """Marginal covariances (T + 1, n, n): those of the chain less what each tie, decorrelated, tells."""
    P = covariances(chain, gains)
    if ties is None:
        return P
    _, L = tied_factor(chain, gains, ties)
    shape = P.shape[:2]

    columns = jax.vmap(lambda e: covariance_times(chain, gains, _pull(ties, linalg.backward_solve(L, e), shape)))

    def less(P: jax.Array, e: jax.Array) -> tuple[jax.Array, None]:
        v = columns(e)
        return P - jnp.einsum("lti,ltj->tij", v, v), None

    batch = min(AT_ONCE, len(L))
    units = jnp.eye(-(-len(L) // batch) * batch, len(L), dtype=L.dtype)  # rows of 0, which change nothing, to the end
    return jax.lax.scan(less, P, units.reshape(-1, batch, len(L)))[0]
