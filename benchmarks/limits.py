"""Where compiled lanes may not pay: ``python -m benchmarks.limits`` times both back ends there.

One run alone, one row alone, and Kalman filters of growing, fully dense systems whose covariances differ by run.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf


def dense(n: int, m: int) -> jf.Model:
    """A stable linear system without a single zero."""
    generator = np.random.default_rng(n)
    A = generator.standard_normal((n, n))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    H = generator.standard_normal((m, n))
    return jf.linear(*(jnp.asarray(a) for a in (A, H)), Q=jnp.eye(n) + 0.1, R=jnp.eye(m) + 0.1)


def timed(model: jf.Model, runs: int, steps: int, backend: Any) -> tuple[float, float]:
    """Seconds to trace and compile, and of the fastest of three calls."""
    n, m = model.space.dim, model.sensors["z"].space.dim
    z = jax.random.normal(jax.random.key(0), (runs, steps, m), jnp.float64)
    P = jnp.eye(n) * jnp.linspace(1.0, 2.0, runs)[:, None, None]
    start, dt = jf.Gaussian(jnp.zeros((runs, n)), P), jnp.ones(steps)

    def filtered(start: jf.Gaussian, z: jax.Array) -> Any:
        log = jf.Log(dt, (), {"z": z}, {}, {})
        return jf.scan_runs(jf.kf(model), start, log, ("z",), jf.mean_and_std, backend=backend)

    began = time.perf_counter()
    program = jax.jit(filtered).lower(start, z).compile()
    jax.block_until_ready(program(start, z))
    first, calls = time.perf_counter() - began, []
    for _ in range(3):
        began = time.perf_counter()
        jax.block_until_ready(program(start, z))
        calls.append(time.perf_counter() - began)
    return first - min(calls), min(calls)


def main() -> None:
    """Print the table."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--states", type=int, nargs="*", default=[6, 12, 18, 24], help="of the dense systems")
    asked.add_argument("--runs", type=int, default=1000)
    asked.add_argument("--steps", type=int, default=200)
    a = asked.parse_args()
    jax.config.update("jax_enable_x64", True)
    cases = [(f"one run alone, {n} states", n, 1, a.runs * 10) for n in (4, 12)]
    cases += [("one row alone, 12 states", 12, a.runs, 1)]
    cases += [(f"dense, {n} states", n, a.runs, a.steps) for n in a.states]
    print("| | runs x rows | lanes: compile, run (ms) | XLA: compile, run (ms) | lanes are as fast, times |")
    print("|---|---|---|---|---|")
    for name, n, runs, steps in cases:
        model = dense(n, n // 2)
        both = [timed(model, runs, steps, backend) for backend in ("lanes", "xla")]
        cells = [f"{first * 1e3:,.0f}, {run * 1e3:,.1f}" for first, run in both]
        ratio = both[1][1] / both[0][1]
        print(f"| {name} | {runs:,} x {steps:,} | {cells[0]} | {cells[1]} | {ratio:.2g} |", flush=True)


if __name__ == "__main__":
    main()
