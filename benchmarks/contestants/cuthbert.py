"""cuthbert: its filters, not parallel in time, under jit and vmap; they carry square roots of covariances.

It has no unscented filter: this one is put together from cuthbertlib's quadrature and Kalman steps.
"""

from __future__ import annotations

import importlib
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.contestants import Entry, batch
from benchmarks.workloads import SPREAD, Problem


def prepare(problem: Problem, variant: str) -> Entry:
    """See `benchmarks.contestants`."""
    cuthbert: Any = importlib.import_module("cuthbert")
    f, h = batch.functions(problem)
    Q, R = batch.noise(problem)
    u, readings = jnp.asarray(problem.u), (problem.z, problem.x0, problem.P0)

    def extended(LQ: Any, LR: Any, z: jax.Array, x0: jax.Array, P0: jax.Array) -> Any:
        moments: Any = importlib.import_module("cuthbert.gaussian.moments")

        def dynamics(state: Any, row: dict) -> tuple:
            return (lambda x: (f(x, row["u"]), LQ)), state.mean

        def observation(state: Any, row: dict) -> tuple:
            return (lambda x: (h(x), LR)), state.mean, row["z"]

        filter = moments.build_filter(x0, jnp.linalg.cholesky(P0), dynamics, observation, associative=False)
        return cuthbert.filter(filter, {"u": u, "z": z}, filter.init_prepare(), parallel=False)

    if problem.kind == "gradient":

        def means(q: jax.Array, r: jax.Array, z: jax.Array, x: jax.Array, P: jax.Array) -> jax.Array:
            return extended(jnp.diag(jnp.sqrt(q)), jnp.diag(jnp.sqrt(r)), z, x, P).mean[1:]

        return batch.differentiated(problem, jax.vmap(means, (None, None, 0, 0, 0)), readings)
    if problem.kind == "ukf":
        return batch.filtered(jax.vmap(_unscented(f, h, Q, R, u)), readings, "put together from cuthbertlib")
    LQ, LR = jnp.linalg.cholesky(Q), jnp.linalg.cholesky(R)

    def one(z: jax.Array, x: jax.Array, P: jax.Array) -> tuple:
        found = extended(LQ, LR, z, x, P)
        return found.mean[1:], (found.chol_cov[1:] ** 2).sum(-1)

    return batch.filtered(jax.vmap(one), readings)


def _unscented(f: Any, h: Any, Q: Any, R: Any, u: jax.Array) -> Any:
    filtering: Any = importlib.import_module("cuthbertlib.kalman.filtering")
    unscented: Any = importlib.import_module("cuthbertlib.quadrature.unscented")
    linearize: Any = importlib.import_module("cuthbertlib.quadrature.linearize")

    def one(z: jax.Array, x: jax.Array, P: jax.Array) -> tuple:
        rule = unscented.weights(len(x), **SPREAD)
        # `functional` adds the noise times the sum of the covariances' weights, which is not 1.
        Q_, R_ = Q / rule.wc.sum(), R / rule.wc.sum()

        def step(carry: tuple, row: tuple) -> tuple:
            (x, L), (u, z) = carry, row
            A, b, C = linearize.functional(lambda s: f(s, u), Q_, x, L @ L.T, rule)
            x, L = filtering.predict(x, L, A, b, jnp.linalg.cholesky(C))
            A, b, C = linearize.functional(h, R_, x, L @ L.T, rule)
            (x, L), _ = filtering.update(x, L, A, b, jnp.linalg.cholesky(C), z)
            return (x, L), (x, (L**2).sum(-1))

        return jax.lax.scan(step, (x, jnp.linalg.cholesky(P)), (u, z))[1]

    return one
