"""jaxfilt, by its two back ends: one loop compiled for the lanes of the processor, or XLA."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from benchmarks.contestants import Entry, batch, whole
from benchmarks.workloads import SPREAD, Problem

FILTERS = {"kf": jf.kf, "ekf": jf.ekf, "gradient": jf.ekf, "online": jf.ekf, "ukf": lambda m: jf.ukf(m, **SPREAD)}


def model(problem: Problem, Q: Any, R: Any) -> jf.Model:
    """The system as a `jaxfilt.Model`."""
    f, h = batch.functions(problem)
    n, m = problem.system.n, len(problem.system.seen)
    sensor = jf.Sensor(lambda x, c: h(x), jf.const(R), jf.vector(m))
    return jf.Model(lambda x, u, dt: f(x, u), jf.const(Q), jf.vector(n), {"z": sensor})


def mean_and_variance(belief: jf.Gaussian, info: dict[str, jf.Info]) -> tuple:
    """What all contestants return."""
    return belief.mean, jnp.diagonal(belief.cov)


def prepare(problem: Problem, variant: str) -> Entry:
    """See `benchmarks.contestants`."""
    if problem.kind in ("study", "tuning"):
        return whole.ours(problem, variant)
    build, u, dt = FILTERS[problem.kind], jnp.asarray(problem.u), jnp.ones(problem.steps, problem.dtype)
    Q, R = batch.noise(problem)
    if problem.kind == "online":
        return online(build(model(problem, Q, R)), problem)
    readings = (problem.z, problem.x0, problem.P0)

    backend: Any = variant

    def all_runs(Q: Any, R: Any, z: jax.Array, x0: jax.Array, P0: jax.Array) -> tuple:
        filter, log = build(model(problem, Q, R)), jf.Log(dt, u, {"z": z}, {}, {})
        return jf.scan_runs(filter, jf.Gaussian(x0, P0), log, ("z",), mean_and_variance, backend=backend)

    if problem.kind == "gradient":
        return batch.differentiated(problem, lambda q, r, *rest: all_runs(jnp.diag(q), jnp.diag(r), *rest)[0], readings)
    return batch.filtered(lambda *readings: all_runs(Q, R, *readings), readings)


def online(filter: jf.Filter, problem: Problem) -> Entry:
    """Row by row, each estimate in NumPy before the next row is read."""
    dt = np.ones((), problem.dtype)

    @jax.jit
    def step(belief: jf.Gaussian, row: jf.Log) -> tuple:
        belief, _ = filter.step(belief, row)
        return belief, jnp.diagonal(belief.cov)

    def run() -> tuple:
        belief, means, variances = jf.Gaussian(problem.x0[0], problem.P0[0]), [], []
        for u, z in zip(problem.u, problem.z[0], strict=True):
            belief, spread = step(belief, jf.Log(dt, u, {"z": z}, {}, {}))
            means.append(np.asarray(belief.mean))
            variances.append(np.asarray(spread))
        return np.stack(means)[None], np.stack(variances)[None]

    return Entry(run, lambda found, k: found)
