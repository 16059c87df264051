"""Factors and solves against numpy's, on both sides of the size where they stop being written out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilt import linalg

DTYPES = pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=["float32", "float64"])
SIZES = [(n, np.float64) for n in (1, 2, 3, 5, linalg.WRITTEN_OUT, linalg.WRITTEN_OUT + 1, 20)]
SIZES += [(n, np.float32) for n in (1, 6, 20)]
BOTH_WAYS = pytest.mark.parametrize("n", [4, linalg.WRITTEN_OUT + 1], ids=["written_out", "by_columns"])

cholesky = jax.jit(linalg.cholesky)
semidefinite = jax.jit(linalg.semidefinite_cholesky)


def positive_definite(n: int, seed: int = 0) -> np.ndarray:
    """With standard deviations from 1e-2 to 1e2, as units bring about."""
    rng = np.random.default_rng(seed + n)
    B = rng.normal(size=(n, 2 * n)) * np.geomspace(1e-2, 1e2, n)[:, None]
    return B @ B.T


def rounding(A: np.ndarray, dtype) -> np.ndarray:
    """Of the elements of A, relative to their own standard deviations."""
    std = np.sqrt(np.diag(A).astype(float))
    return 10 * len(A) * np.finfo(dtype).eps * np.outer(std, std)


@pytest.mark.parametrize(("n", "dtype"), SIZES)
def test_factors_and_solves(n, dtype):
    A = positive_definite(n).astype(dtype)
    A = (A + A.T) / 2
    wide = A.astype(float)
    C = np.random.default_rng(n).normal(size=(3, n)).astype(dtype)

    @jax.jit
    def everything(A, C):
        L = linalg.cholesky(A)
        solved = linalg.forward_solve(L, C.T), linalg.backward_solve(L, C[0]), linalg.gain(C, L)
        return L, linalg.semidefinite_cholesky(A), linalg.log_determinant(L), *solved

    L, also_L, log_determinant, forward, backward, gain = map(np.asarray, everything(A, C))
    assert {a.dtype for a in (L, also_L, log_determinant, gain)} == {np.dtype(dtype)}
    for factor in (L, also_L):
        assert (np.triu(factor, 1) == 0).all()
        assert (np.abs(factor.astype(float) @ factor.T.astype(float) - wide) <= rounding(A, dtype)).all()
    rtol = 2e-3 if dtype == np.float32 else 1e-10
    np.testing.assert_allclose(L, np.linalg.cholesky(wide), rtol=rtol, atol=1e-4 if dtype == np.float32 else 1e-12)
    np.testing.assert_allclose(log_determinant, np.linalg.slogdet(wide)[1], rtol=rtol)
    np.testing.assert_allclose(L.astype(float) @ forward, C.T, atol=rtol)
    np.testing.assert_allclose(L.T.astype(float) @ backward, C[0], atol=rtol)
    want = np.linalg.solve(wide, C.T.astype(float)).T
    scale = np.abs(want).max(0)
    np.testing.assert_allclose(gain / scale, want / scale, atol=rtol)


@DTYPES
@BOTH_WAYS
def test_singular_matrices_have_a_semidefinite_factor(n, dtype):
    rng = np.random.default_rng(2)
    b, B = rng.normal(size=n), rng.normal(size=(n, n - 2))
    zero_block = np.zeros((n, n))
    zero_block[1 : n - 1, 1 : n - 1] = positive_definite(n - 2)
    one_zero = positive_definite(n)
    one_zero[0] = one_zero[:, 0] = 0
    matrices = [np.outer(b, b), B @ B.T, zero_block, one_zero, np.zeros((n, n)), np.ones((n, n))]
    matrices = np.stack(matrices).astype(dtype)
    L = np.asarray(jax.jit(jax.vmap(linalg.semidefinite_cholesky))(matrices), float)
    assert np.isfinite(L).all()
    assert (L[4] == 0).all()
    scale = np.abs(matrices).max((1, 2), initial=1.0, keepdims=True)

    np.testing.assert_allclose(L @ L.transpose(0, 2, 1) / scale, matrices / scale, atol=40 * n * np.finfo(dtype).eps)


@BOTH_WAYS
def test_not_positive_is_nan_and_not_something_else(n):
    A = positive_definite(n)
    negative, indefinite, singular = A.copy(), A.copy(), np.ones((n, n))
    negative[1, 1] = -1.0
    indefinite[0, n - 1] = indefinite[n - 1, 0] = 1.1 * np.sqrt(A[0, 0] * A[n - 1, n - 1])
    for bad in (negative, indefinite, -A):
        assert np.isnan(cholesky(bad)).any()
        assert np.isnan(semidefinite(bad)).any()
    assert np.isnan(cholesky(singular)).any()
    assert np.isnan(cholesky(np.zeros((n, n)))).any()
    assert np.isnan(cholesky(np.full((n, n), np.nan))).any()


@DTYPES
@BOTH_WAYS
def test_scaling_by_a_power_of_four_is_exact(n, dtype):
    """Nothing absolute is added or compared."""
    A = positive_definite(n).astype(dtype)
    b = np.random.default_rng(1).normal(size=n).astype(dtype)
    small = dtype(2.0**-40)
    np.testing.assert_array_equal(cholesky(A * small), cholesky(A) * dtype(2.0**-20))
    for matrix in (A, np.outer(b, b)):
        np.testing.assert_array_equal(semidefinite(matrix * small), semidefinite(matrix) * dtype(2.0**-20))


@BOTH_WAYS
def test_gradients(n):
    """Reverse mode along a symmetric direction equals a finite difference; through singular matrices it is finite."""
    rng = np.random.default_rng(5)
    A, C = rng.normal(size=(n, 2 * n)), rng.normal(size=(3, n))
    A = A @ A.T / n
    D = rng.normal(size=(n, n))
    D = D + D.T
    W = rng.normal(size=(n, n))

    @jax.jit
    @jax.value_and_grad
    def f(A):
        L = linalg.cholesky(A)
        return (
            jnp.sum(jnp.sin(linalg.gain(C, L)))
            + linalg.log_determinant(L)
            + jnp.sum(W * linalg.semidefinite_cholesky(A))
        )

    h = 1e-6
    difference = (f(A + h * D)[0] - f(A - h * D)[0]) / (2 * h)
    assert np.sum(f(A)[1] * D) == pytest.approx(float(difference), rel=1e-6)
    slope = jax.jit(jax.grad(lambda A: jnp.sum(W * linalg.semidefinite_cholesky(A))))
    for singular in (np.zeros((n, n)), np.ones((n, n)), np.diag(np.arange(n) * 1.0)):
        assert np.isfinite(slope(singular)).all()


@BOTH_WAYS
def test_a_batch_is_its_members(n):
    A = np.stack([positive_definite(n, seed) for seed in range(3)])
    C = np.random.default_rng(0).normal(size=(3, 2, n))

    def solve(A, C):
        return linalg.gain(C, linalg.cholesky(A))

    np.testing.assert_allclose(
        jax.jit(jax.vmap(solve))(A, C), np.linalg.solve(A, C.swapaxes(1, 2)).swapaxes(1, 2), rtol=1e-8
    )


def test_symmetrize():
    P = np.arange(9.0).reshape(3, 3)
    np.testing.assert_array_equal(linalg.symmetrize(jnp.asarray(P)), np.tril(P) + np.tril(P, -1).T)
