"""Every factorization and solve of the library; nobody else calls cholesky, solve, qr or eigh.

LAPACK is called once per run of a batch, which under `vmap` costs more than the rest of a filter's step.
The matrices of a robot are small, so their factors are written out element by element: straight-line code that
batches, fuses and differentiates. Above `WRITTEN_OUT` rows a loop over columns takes over.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

WRITTEN_OUT = 12
"""Largest matrix whose factor is written out; beyond it the time to compile outgrows what is saved."""

CLOSED_FORM = 7
"""Smallest matrix whose factor is differentiated as a whole, not element by element: at 12 rows that compiles in a
third of the time and runs in a fifth (measured, reverse mode on a CPU), at 4 it is slower."""


def cholesky(A: jax.Array) -> jax.Array:
    """Lower L with L L' = A for a positive definite A (n, n); NaN from the first pivot that is not positive."""
    return _factor(A, semidefinite=False)


def semidefinite_cholesky(A: jax.Array) -> jax.Array:
    """Lower L with L L' = A for a positive *semi*definite A (n, n): a square root for singular covariances too.

    A pivot that is zero to rounding, relative to its own diagonal element (n eps), gives a zero column; a
    negative one gives NaN. Nothing absolute is added or compared, so the factor scales with A.
    """
    return _factor(A, semidefinite=True)


def _factor(A: jax.Array, semidefinite: bool) -> jax.Array:
    n = A.shape[0]
    slack = n * float(jnp.finfo(A.dtype).eps) if semidefinite else None
    return _eliminated(A, slack) if n < CLOSED_FORM else _in_closed_form(A, slack)


def _eliminated(A: jax.Array, slack: float | None) -> jax.Array:
    return _written_out(A, slack) if A.shape[0] <= WRITTEN_OUT else _by_columns(A, slack)


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def _in_closed_form(A: jax.Array, slack: float | None) -> jax.Array:
    """`_eliminated`, differentiated by ``dL = L Phi(L^-1 dA L'^-1)``: Phi takes the lower triangle, half the diagonal.

    Columns that are zero stay so, and with a unit pivot in their place leave the others as they are.

    Source: I. Murray, Differentiation of the Cholesky decomposition (2016), eq. 8.
    """
    return _eliminated(A, slack)


@_in_closed_form.defjvp
def _(slack: float | None, primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    L = _in_closed_form(primals[0], slack)
    eye = jnp.eye(len(L), dtype=L.dtype)
    zero = jnp.diagonal(L) == 0
    regular = L + jnp.where(zero, eye, 0.0)
    inverse = forward_solve(regular, eye)
    Y = inverse @ symmetrize(tangents[0]) @ inverse.T
    return L, jnp.where(zero, 0.0, regular @ (jnp.tril(Y) - 0.5 * eye * Y))


def _pivot(pivot: jax.Array, size: jax.Array, slack: float | None) -> tuple[jax.Array, jax.Array | bool]:
    """The root of a pivot, and whether its column is zero (where the root is 1, to divide by)."""
    if slack is None:
        return jnp.sqrt(jnp.where(pivot > 0, pivot, jnp.nan)), False
    zero = jnp.abs(pivot) <= slack * size
    return jnp.sqrt(jnp.where(zero, 1.0, pivot)), zero


def _written_out(A: jax.Array, slack: float | None) -> jax.Array:
    n = A.shape[0]
    nought = jnp.zeros((), A.dtype)
    L = [[nought] * n for _ in range(n)]
    for j in range(n):
        root, zero = _pivot(A[j, j] - sum((L[j][k] * L[j][k] for k in range(j)), nought), A[j, j], slack)
        inverse = 1 / root  # one division, not one for each row
        for i in range(j, n):
            element = root if i == j else (A[i, j] - sum((L[i][k] * L[j][k] for k in range(j)), nought)) * inverse
            L[i][j] = element if zero is False else jnp.where(zero, 0.0, element)
    return jnp.stack([jnp.stack(row) for row in L])


def _by_columns(A: jax.Array, slack: float | None) -> jax.Array:
    n = A.shape[0]
    size = jnp.diagonal(A)

    def eliminate(rest: jax.Array, j: jax.Array) -> tuple[jax.Array, jax.Array]:
        root, zero = _pivot(rest[j, j], size[j], slack)
        column = jnp.where(jnp.arange(n) < j, 0.0, rest[:, j] / root)
        column = column if zero is False else jnp.where(zero, 0.0, column)
        return rest - jnp.outer(column, column), column

    return jax.lax.scan(eliminate, A, jnp.arange(n))[1].T


def forward_solve(L: jax.Array, b: jax.Array) -> jax.Array:
    """L^-1 b for a lower triangular L (n, n) and b (n,) or (n, k)."""
    n = L.shape[0]
    if n > WRITTEN_OUT:
        return jax.scipy.linalg.solve_triangular(L, b, lower=True)
    y: list[jax.Array] = []
    for i in range(n):
        y.append((b[i] - sum((L[i, k] * y[k] for k in range(i)), jnp.zeros_like(b[i]))) * (1 / L[i, i]))
    return jnp.stack(y)


def backward_solve(L: jax.Array, b: jax.Array) -> jax.Array:
    """L'^-1 b for a lower triangular L (n, n) and b (n,) or (n, k)."""
    n = L.shape[0]
    if n > WRITTEN_OUT:
        return jax.scipy.linalg.solve_triangular(L, b, lower=True, trans=1)
    y: list[jax.Array] = []
    for i in reversed(range(n)):
        rest = b[i] - sum((L[k, i] * y[k - i - 1] for k in range(i + 1, n)), jnp.zeros_like(b[i]))
        y.insert(0, rest * (1 / L[i, i]))
    return jnp.stack(y)


def gain(cross: jax.Array, L: jax.Array) -> jax.Array:
    """C S^-1 for C (n, m) and S = L L'."""
    return backward_solve(L, forward_solve(L, cross.T)).T


@jax.custom_jvp
def solve(S: jax.Array, L: jax.Array, b: jax.Array) -> jax.Array:
    """S^-1 b for S = L L' (m, m) and b (m,) or (m, k); differentiated in S and b.

    ``dx = S^-1 (db - dS x)``: the factor's derivative, a program as long as the factor, is not taken. L must depend on
    S all the same: higher derivatives may go through the solve itself, and not by this rule.
    """
    return backward_solve(L, forward_solve(L, b))


@solve.defjvp
def _(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    S, L, b = primals
    dS, _, db = tangents
    x = solve(S, L, b)
    return x, inverse(S, L) @ (db - dS @ x)


def inverse(S: jax.Array, L: jax.Array) -> jax.Array:
    """S^-1, derivatives as in `solve`."""
    return solve(S, L, jnp.eye(len(L), dtype=L.dtype))


def general_solve(A: jax.Array, b: jax.Array) -> jax.Array:
    """A^-1 b for any regular A (n, n) and b (n,) or (n, k), by LU: a call of LAPACK for each matrix."""
    return jnp.linalg.solve(A, b)


@jax.custom_jvp
def score(S: jax.Array, L: jax.Array, r: jax.Array) -> tuple[jax.Array, jax.Array]:
    """r' S^-1 r and log |S| for S = L L' (m, m) and r (m,): what makes a Gaussian's log density.

    Differentiated as in `solve`: ``2 w' dr - w' dS w`` with ``w = S^-1 r``, and ``tr(S^-1 dS)``.
    """
    e = forward_solve(L, r)
    return e @ e, log_determinant(L)


@score.defjvp
def _(primals: tuple, tangents: tuple) -> tuple:
    S, L, r = primals
    dS, _, dr = tangents
    w = solve(S, L, r)
    return score(S, L, r), (2 * (w @ dr) - w @ dS @ w, jnp.sum(inverse(S, L) * dS))


def log_determinant(L: jax.Array) -> jax.Array:
    """log |L L'| of a lower triangular L."""
    return 2 * jnp.sum(jnp.log(jnp.diagonal(L)))


def symmetrize(P: jax.Array) -> jax.Array:
    """The symmetric matrix with the lower triangle of P: a product A P A' is symmetric only to rounding.

    Not (P + P') / 2, for which compiled lanes would have to compute both triangles.
    """
    return jnp.tril(P) + jnp.tril(P, -1).T
