"""The right answer: the same filters in NumPy's long double (64 bits of mantissa on x86), batched over runs.

Nothing is shared with any contestant: Jacobians by complex steps, the factorization written here, covariances in the
textbook's form. Where long double is no wider than float64 it is a reference among equals.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.systems import System, moved

WIDE = np.longdouble


def jacobian(f: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """df/dx (N, n, n) at states (N, n): ``Im f(x + i h e_j) / h``, exact to rounding for so small an h.

    Source: W. Squire, G. Trapp, Using complex variables to estimate derivatives of real functions (1998), eq. 6.
    """
    h = WIDE(1e-30)
    n = x.shape[1]
    points = x[:, None, :] + 1j * h * np.eye(n, dtype=WIDE)
    return np.swapaxes(np.imag(f(points)) / h, 1, 2)


def cholesky(A: np.ndarray) -> np.ndarray:
    """L (N, n, n) with ``L L' = A``: `numpy.linalg` knows no long double."""
    n, A = A.shape[-1], A.copy()
    L = np.zeros_like(A)
    for j in range(n):
        L[:, j:, j] = A[:, j:, j] / np.sqrt(A[:, j, j])[:, None]
        A[:, j:, j:] -= L[:, j:, None, j] * L[:, None, j:, j]
    return L


def solve(S: np.ndarray, B: np.ndarray) -> np.ndarray:
    """S^-1 B for positive definite S (N, m, m) and B (N, m, k)."""
    L, X = cholesky(S), B.copy()
    m = S.shape[-1]
    for i in range(m):
        X[:, i] = (X[:, i] - np.einsum("nk,nkj->nj", L[:, i, :i], X[:, :i])) / L[:, i, i, None]
    for i in reversed(range(m)):
        X[:, i] = (X[:, i] - np.einsum("nk,nkj->nj", L[:, i + 1 :, i], X[:, i + 1 :])) / L[:, i, i, None]
    return X


def ekf(
    system: System, u: np.ndarray, z: np.ndarray, x0: np.ndarray, P0: np.ndarray, Q: object = None, R: object = None
) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances (N, T, n). Source: S. Sarkka, Bayesian Filtering and Smoothing (2013), algorithm 5.4."""
    u, z, x, P, H = (a.astype(WIDE) for a in (u, z, x0, P0, system.H))
    Q, R = (np.asarray(own if given is None else given, WIDE) for given, own in ((Q, system.Q), (R, system.R)))
    means, variances = (np.empty((len(z), len(u), system.n), WIDE) for _ in range(2))
    for t in range(len(u)):

        def f(s: np.ndarray, row: np.ndarray = u[t]) -> np.ndarray:
            return moved(system, s, row)

        F = jacobian(f, x)
        x, P = f(x), F @ P @ np.swapaxes(F, 1, 2) + Q
        cross = P @ H.T
        K = np.swapaxes(solve(H @ cross + R, np.swapaxes(cross, 1, 2)), 1, 2)
        x = x + (K @ (z[:, t] - x @ H.T)[..., None])[..., 0]
        P = P - K @ np.swapaxes(cross, 1, 2)
        P = (P + np.swapaxes(P, 1, 2)) / 2
        means[:, t], variances[:, t] = x, np.diagonal(P, axis1=1, axis2=2)
    return means, variances


class Points:
    """The scaled sigma points. Source: Wan, van der Merwe, The unscented Kalman filter (2000), eqs. 15-18."""

    def __init__(self, n: int, alpha: float, beta: float, kappa: float) -> None:
        spread = WIDE(alpha) ** 2 * (n + WIDE(kappa))
        self.reach = np.sqrt(spread)
        self.mean = np.full(2 * n + 1, 1 / (2 * spread))
        self.mean[0] = 1 - n / spread
        self.cov = self.mean.copy()
        self.cov[0] += 1 - WIDE(alpha) ** 2 + WIDE(beta)

    def at(self, x: np.ndarray, P: np.ndarray) -> np.ndarray:
        """(N, 2n + 1, n) about x (N, n)."""
        columns = self.reach * np.swapaxes(cholesky(P), 1, 2)
        return np.concatenate([x[:, None], x[:, None] + columns, x[:, None] - columns], axis=1)

    def covariance(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Of deviations (N, 2n + 1, p) and (N, 2n + 1, q)."""
        return np.swapaxes(a, 1, 2) @ (self.cov[:, None] * b)

    def predicted(self, f: Callable, x: np.ndarray, P: np.ndarray, Q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance of ``f(x) + w``."""
        images = f(self.at(x, P))
        mean = np.einsum("s,nsi->ni", self.mean, images)
        off = images - mean[:, None]
        return mean, self.covariance(off, off) + Q


def ukf(
    system: System, u: np.ndarray, z: np.ndarray, x0: np.ndarray, P0: np.ndarray, **spread: float
) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances (N, T, n). Source: S. Sarkka, Bayesian Filtering and Smoothing (2013), algorithm 5.14."""
    u, z, x, P, Q, R = (a.astype(WIDE) for a in (u, z, x0, P0, system.Q, system.R))
    points = Points(system.n, **spread)
    means, variances = (np.empty((len(z), len(u), system.n), WIDE) for _ in range(2))
    for t in range(len(u)):
        x, P = points.predicted(lambda s, row=u[t]: moved(system, s, row), x, P, Q)
        drawn = points.at(x, P)
        seen = drawn[..., list(system.seen)]
        expected = np.einsum("s,nsi->ni", points.mean, seen)
        off = seen - expected[:, None]
        S = points.covariance(off, off) + R
        K = np.swapaxes(solve(S, points.covariance(off, drawn - x[:, None])), 1, 2)
        x = x + (K @ (z[:, t] - expected)[..., None])[..., 0]
        P = P - K @ S @ np.swapaxes(K, 1, 2)
        P = (P + np.swapaxes(P, 1, 2)) / 2
        means[:, t], variances[:, t] = x, np.diagonal(P, axis1=1, axis2=2)
    return means, variances


def value_and_gradient(
    system: System, u: np.ndarray, z: np.ndarray, x0: np.ndarray, P0: np.ndarray, truth: np.ndarray
) -> tuple[float, np.ndarray]:
    """The sum of the squared errors of an EKF's means over all runs, rows and components, and its gradient (n + m,) in
    the logarithms of the diagonals of Q and R: central differences with Richardson's extrapolation, in long double good
    to 12 digits."""
    at = np.log(np.concatenate([np.diag(system.Q), np.diag(system.R)]).astype(WIDE))

    def loss(at: np.ndarray) -> np.longdouble:
        noise = np.exp(at)
        means, _ = ekf(system, u, z, x0, P0, np.diag(noise[: system.n]), np.diag(noise[system.n :]))
        return ((means - truth) ** 2).sum()

    def slope(i: int, h: float) -> np.longdouble:
        step = np.zeros_like(at)
        step[i] = h
        return (loss(at + step) - loss(at - step)) / (2 * WIDE(h))

    h = 2.0**-12
    gradient = [(4 * slope(i, h) - slope(i, 2 * h)) / 3 for i in range(len(at))]
    return float(loss(at)), np.array(gradient, float)
