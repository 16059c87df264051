"""kalman-py: the functions of its JAX back end under jit and vmap, or its classes run after run in NumPy.

It knows no inputs: the number of the row goes in place of the time step, and f looks its input up.
"""

from __future__ import annotations

import importlib
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.contestants import Entry, batch
from benchmarks.systems import transition
from benchmarks.workloads import SPREAD, Problem

FEW = 2
"""Runs of the loop in NumPy."""


def prepare(problem: Problem, variant: str) -> Entry:
    """See `benchmarks.contestants`."""
    return _in_jax(problem) if variant == "jax" else _in_numpy(problem)


def _in_jax(problem: Problem) -> Entry:
    backend: Any = importlib.import_module("kalman_py.backends.jax_backend")
    f, h = batch.functions(problem)
    system, dtype = problem.system, problem.dtype
    Q, R, H = (a.astype(dtype) for a in (system.Q, system.R, system.H))
    u, rows, readings = jnp.asarray(problem.u), np.arange(problem.steps), (problem.z, problem.x0, problem.P0)

    def with_input(x: jax.Array, row: jax.Array) -> jax.Array:
        return f(x, u[row.astype(int)])

    def extended(Q: Any, R: Any, z: jax.Array, x: jax.Array, P: jax.Array) -> Any:
        return backend.ekf_filter(Q, R, x, P, z, rows, with_input, h, None, None, None)

    if problem.kind == "gradient":

        def means(q: jax.Array, r: jax.Array, *run: jax.Array) -> jax.Array:
            return extended(jnp.diag(q), jnp.diag(r), *run).means

        return batch.differentiated(problem, jax.vmap(means, (None, None, 0, 0, 0)), readings)
    weights = backend.sigma_weights(system.n, *SPREAD.values(), dtype)

    def one(z: jax.Array, x: jax.Array, P: jax.Array) -> tuple:
        if problem.kind == "kf":
            F = transition(system, np.zeros(system.n), []).astype(dtype)
            found = backend.kalman_filter(F, H, Q, R, x, P, z)
        elif problem.kind == "ekf":
            found = extended(Q, R, z, x, P)
        else:  # the public one tests a traced flag in Python, which vmap forbids
            found = backend._ukf_filter(
                jnp.asarray(Q), jnp.asarray(R), x, P, z, jnp.asarray(rows, dtype), jnp.asarray(weights.mean),
                jnp.asarray(weights.cov), jnp.asarray(weights.gamma, dtype), f=with_input, h=h, residual=None,
                square_root=False, vectorized=False, center_sign=1.0 if weights.cov[0] >= 0 else -1.0,
            )[0]  # fmt: skip
        return found.means, jnp.diagonal(found.covs, axis1=-2, axis2=-1)

    note = "its private UKF" if problem.kind == "ukf" else ""
    return batch.filtered(jax.vmap(one), readings, note)


def _in_numpy(problem: Problem) -> Entry:
    package: Any = importlib.import_module("kalman_py")
    system, u, rows = problem.system, problem.u.tolist(), np.arange(problem.steps, dtype=problem.dtype)
    seen, runs = list(system.seen), min(problem.runs, FEW)

    def f(x: np.ndarray, row: float) -> np.ndarray:
        return np.array(system.f(x.tolist(), u[int(row)], math))

    def h(x: np.ndarray) -> np.ndarray:
        return x[seen]

    def one(i: int) -> tuple:
        start = (system.Q, system.R, problem.x0[i], problem.P0[i])
        if problem.kind == "kf":
            F = transition(system, np.zeros(system.n), [])
            found = package.KalmanFilter(F, system.H, *start).filter(problem.z[i], backend="numpy")
        elif problem.kind == "ekf":
            jacobians = {
                "jac_f": lambda x, row: transition(system, x, u[int(row)], math),
                "jac_h": lambda x: system.H,
            }
            found = package.ExtendedKalmanFilter(f, h, *start, **jacobians).filter(problem.z[i], rows, backend="numpy")
        else:
            found = package.UnscentedKalmanFilter(f, h, *start, **SPREAD).filter(problem.z[i], rows, backend="numpy")
        return np.asarray(found.means), np.diagonal(np.asarray(found.covs), axis1=-2, axis2=-1)

    def fetch(found: list, k: int) -> tuple:
        return tuple(np.stack([run[i] for run in found[:k]]) for i in range(2))

    return Entry(lambda: [one(i) for i in range(runs)], fetch, runs, compiled=False)
