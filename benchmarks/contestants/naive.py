"""What one writes in thirty lines of JAX: the textbook's step, `jax.lax.scan` over rows, `jax.vmap` over runs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.contestants import Entry, batch
from benchmarks.workloads import SPREAD, Problem


def ekf_step(f: Callable, h: Callable, Q: Any, R: Any) -> Callable:
    """((x, P), (u, z)) -> ((x, P), (mean, variances)); a KF where f and h are linear."""

    def step(carry: tuple, row: tuple) -> tuple:
        (x, P), (u, z) = carry, row
        F = jax.jacfwd(f)(x, u)
        x, P = f(x, u), F @ P @ F.T + Q
        H = jax.jacfwd(h)(x)
        S = H @ P @ H.T + R
        K = jnp.linalg.solve(S, H @ P).T
        x, P = x + K @ (z - h(x)), (jnp.eye(len(x), dtype=x.dtype) - K @ H) @ P
        return (x, P), (x, jnp.diagonal(P))

    return step


def ukf_step(f: Callable, h: Callable, Q: Any, R: Any, alpha: float, beta: float, kappa: float) -> Callable:
    """The same by sigma points, drawn anew before the update."""

    def step(carry: tuple, row: tuple) -> tuple:
        (x, P), (u, z) = carry, row
        n = len(x)
        spread = alpha**2 * (n + kappa)
        wm = np.full(2 * n + 1, 0.5 / spread)
        wm[0] = 1 - n / spread
        wc = wm.copy()
        wc[0] += 1 - alpha**2 + beta
        wm, wc = jnp.asarray(wm, x.dtype), jnp.asarray(wc, x.dtype)

        def points(x: jax.Array, P: jax.Array) -> jax.Array:
            columns = spread**0.5 * jnp.linalg.cholesky(P).T
            return jnp.concatenate([x[None], x[None] + columns, x[None] - columns])

        Y = jax.vmap(f, (0, None))(points(x, P), u)
        x = wm @ Y
        P = (Y - x[None]).T @ (wc[:, None] * (Y - x[None])) + Q
        X = points(x, P)
        Y = jax.vmap(h)(X)
        y = wm @ Y
        weighted = wc[:, None] * (Y - y[None])
        S = (Y - y[None]).T @ weighted + R
        K = jnp.linalg.solve(S, weighted.T @ (X - x[None])).T
        x, P = x + K @ (z - y), P - K @ S @ K.T
        return (x, P), (x, jnp.diagonal(P))

    return step


def prepare(problem: Problem, variant: str) -> Entry:
    """See `benchmarks.contestants`."""
    f, h = batch.functions(problem)
    Q, R = batch.noise(problem)
    u = jnp.asarray(problem.u)
    step = ukf_step(f, h, Q, R, **SPREAD) if problem.kind == "ukf" else ekf_step(f, h, Q, R)
    if problem.kind == "online":
        return online(jax.jit(step), problem)
    readings = (problem.z, problem.x0, problem.P0)

    def all_runs(step: Callable, *readings: jax.Array) -> tuple:
        return jax.vmap(lambda z, x, P: jax.lax.scan(step, (x, P), (u, z))[1])(*readings)

    if problem.kind == "gradient":
        return batch.differentiated(
            problem, lambda q, r, *rest: all_runs(ekf_step(f, h, jnp.diag(q), jnp.diag(r)), *rest)[0], readings
        )
    return batch.filtered(lambda *readings: all_runs(step, *readings), readings)


def online(step: Callable, problem: Problem) -> Entry:
    """Row by row, each estimate in NumPy before the next row is read."""

    def run() -> tuple:
        carry, means, variances = (problem.x0[0], problem.P0[0]), [], []
        for row in zip(problem.u, problem.z[0], strict=True):
            carry, (x, P) = step(carry, row)
            means.append(np.asarray(x))
            variances.append(np.asarray(P))
        return np.stack(means)[None], np.stack(variances)[None]

    return Entry(run, lambda found, k: found)
