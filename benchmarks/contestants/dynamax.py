"""dynamax: its own filters under jit and vmap.

They begin with an update, so they are given the first prediction. Only means and variances leave the program, so that
XLA may drop the rest.
"""

from __future__ import annotations

import importlib
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.contestants import Entry, batch, whole
from benchmarks.workloads import SPREAD, Problem, first_prediction

FIELDS = ["filtered_means", "filtered_covariances"]


def prepare(problem: Problem, variant: str) -> Entry:
    """See `benchmarks.contestants`."""
    if problem.kind == "study":
        return whole.dynamax(problem)
    ssm: Any = importlib.import_module("dynamax.nonlinear_gaussian_ssm")
    lgssm: Any = importlib.import_module("dynamax.linear_gaussian_ssm.inference")
    f, h = batch.functions(problem)
    Q, R = batch.noise(problem)
    u = jnp.asarray(problem.u)

    def extended(mean: jax.Array, cov: jax.Array, Q: Any, R: Any, z: jax.Array) -> Any:
        params = ssm.ParamsNLGSSM(mean, cov, f, Q, lambda x, u: h(x), R)
        return ssm.extended_kalman_filter(params, z, inputs=u, output_fields=FIELDS)

    if problem.kind == "gradient":

        def means(q: jax.Array, r: jax.Array, z: jax.Array, x: jax.Array, P: jax.Array) -> jax.Array:
            F = jax.jacfwd(f)(x, u[0])
            return extended(f(x, u[0]), F @ P @ F.T + jnp.diag(q), jnp.diag(q), jnp.diag(r), z).filtered_means

        return batch.differentiated(
            problem, jax.vmap(means, (None, None, 0, 0, 0)), (problem.z, problem.x0, problem.P0)
        )

    def one(z: jax.Array, mean: jax.Array, cov: jax.Array) -> tuple:
        if problem.kind == "kf":
            F, H = jax.jacfwd(f)(mean, u[0]), jax.jacfwd(h)(mean)
            found = lgssm.lgssm_filter(lgssm.make_lgssm_params(mean, cov, F, Q, H, R), z)
        elif problem.kind == "ekf":
            found = extended(mean, cov, Q, R, z)
        else:
            params = ssm.ParamsNLGSSM(mean, cov, f, Q, lambda x, u: h(x), R)
            spread = ssm.UKFHyperParams(**SPREAD)
            found = ssm.unscented_kalman_filter(params, z, spread, inputs=u, output_fields=FIELDS)
        return found.filtered_means, jnp.diagonal(found.filtered_covariances, axis1=-2, axis2=-1)

    arrays = (problem.z, *first_prediction(problem))
    return batch.filtered(jax.vmap(one), arrays, "adds 1e-9 to the variances of innovations")
