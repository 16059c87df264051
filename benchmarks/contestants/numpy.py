"""A loop over rows in NumPy, the runs as leading axis of every array: what one writes without a compiler."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.contestants import Entry
from benchmarks.systems import moved, transition
from benchmarks.workloads import SPREAD, Problem


def prepare(problem: Problem, variant: str) -> Entry:
    """See `benchmarks.contestants`."""
    run = ukf if problem.kind == "ukf" else ekf

    def fetch(found: tuple, k: int) -> tuple:
        return tuple(a[:k] for a in found)

    return Entry(lambda: run(problem), fetch, compiled=False)


def ekf(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances (N, T, n)."""
    system, dtype = problem.system, problem.dtype
    H, Q, R, eye = (a.astype(dtype) for a in (system.H, system.Q, system.R, np.eye(system.n)))
    means, variances = (np.empty((problem.runs, problem.steps, system.n), dtype) for _ in range(2))
    x, P = problem.x0, problem.P0
    for t, u in enumerate(problem.u):
        F = transition(system, x[:1] if system.linear else x, u)
        x = moved(system, x, u)
        P = F @ P @ F.swapaxes(1, 2) + Q
        HP = H @ P
        K = np.linalg.solve(HP @ H.T + R, HP).swapaxes(1, 2)
        x = x + (K @ (problem.z[:, t] - x @ H.T)[..., None])[..., 0]
        P = (eye - K @ H) @ P
        P = 0.5 * (P + P.swapaxes(1, 2))
        means[:, t], variances[:, t] = x, np.diagonal(P, axis1=1, axis2=2)
    return means, variances


def _weights(n: int, alpha: float, beta: float, kappa: float) -> tuple[float, np.ndarray, np.ndarray]:
    spread = alpha**2 * (n + kappa)
    wm = np.full(2 * n + 1, 0.5 / spread)
    wm[0] = 1 - n / spread
    wc = wm.copy()
    wc[0] += 1 - alpha**2 + beta
    return spread**0.5, wm, wc


def ukf(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances (N, T, n)."""
    system, dtype = problem.system, problem.dtype
    reach, *weights = _weights(system.n, **SPREAD)
    wm, wc = (w.astype(dtype) for w in weights)
    Q, R, seen = system.Q.astype(dtype), system.R.astype(dtype), list(system.seen)
    means, variances = (np.empty((problem.runs, problem.steps, system.n), dtype) for _ in range(2))
    x, P = problem.x0, problem.P0

    def points(x: np.ndarray, P: np.ndarray) -> np.ndarray:
        columns = dtype.type(reach) * np.linalg.cholesky(P).swapaxes(1, 2)
        return np.concatenate([x[:, None], x[:, None] + columns, x[:, None] - columns], axis=1)

    def centred(f: Callable, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        images = f(points)
        mean = wm @ images
        return mean, images - mean[:, None]

    for t, u in enumerate(problem.u):
        x, off = centred(lambda s, u=u: moved(system, s, u), points(x, P))
        P = off.swapaxes(1, 2) @ (wc[:, None] * off) + Q
        drawn = points(x, P)
        expected, off = centred(lambda s: s[..., seen], drawn)
        weighted = (wc[:, None] * off).swapaxes(1, 2)
        S = weighted @ off + R
        K = np.linalg.solve(S, weighted @ (drawn - x[:, None])).swapaxes(1, 2)
        x = x + (K @ (problem.z[:, t] - expected)[..., None])[..., 0]
        P = P - K @ S @ K.swapaxes(1, 2)
        P = 0.5 * (P + P.swapaxes(1, 2))
        means[:, t], variances[:, t] = x, np.diagonal(P, axis1=1, axis2=2)
    return means, variances
