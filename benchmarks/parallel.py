"""Row by row or parallel in time: ``python -m benchmarks.parallel`` times both, and says from where on parallel wins.

Kalman filters and their smoothers of dense linear systems, float64, means and covariances of all rows; whole programs
under `jax.jit`, compilation apart. Runs are batched by `jax.vmap`, row by row and parallel alike. Some minutes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import jaxfilt as jf
from benchmarks import machine
from benchmarks.limits import dense
from jaxfilt.smooth import smooth


def timed(function: Callable, *arguments: Any, repeats: int = 7) -> tuple[float, float]:
    """Seconds to trace, compile and run once, less those of a run; and the quickest of the runs."""
    began = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    jax.block_until_ready(program(*arguments))
    first, calls = time.perf_counter() - began, []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(program(*arguments))
        calls.append(time.perf_counter() - began)
    run = min(calls)
    return max(0.0, first - run), run


def programs(n: int, steps: int) -> dict[str, tuple[Callable, Callable]]:
    """The filter alone, and filter and smoother: (function of the readings (T, m), whether parallel)."""
    filt = jf.kf(dense(n, n // 2))
    start = jf.Gaussian(jnp.zeros(n), jnp.eye(n))

    def log(z: jax.Array) -> jf.Log:
        return jf.Log(jnp.ones(steps), (), {"z": z}, {}, {})

    def filtered(parallel: bool) -> Callable:
        return lambda z: jf.scan(filt, start, log(z), lambda b, info: b, parallel=parallel)

    def smoothed(parallel: bool) -> Callable:
        def both(z: jax.Array) -> Any:
            track = jf.scan(filt, start, log(z), parallel=parallel)
            return smooth(filt, track, log(z), parallel=parallel).belief

        return both

    return {"filter": (filtered(False), filtered(True)), "smoother": (smoothed(False), smoothed(True))}


def difference(a: Any, b: Any) -> float:
    """Largest, relative to the largest number of each array."""
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return max(float(jnp.abs(x - y).max() / jnp.abs(x).max()) for x, y in leaves)


def main() -> None:
    """Print the table."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--states", type=int, nargs="*", default=[2, 4, 8])
    asked.add_argument("--runs", type=int, nargs="*", default=[1, 16])
    asked.add_argument("--steps", type=int, nargs="*", default=[100, 300, 1000, 3000, 10000])
    asked.add_argument("--what", nargs="*", default=["filter", "smoother"])
    a = asked.parse_args()
    jax.config.update("jax_enable_x64", True)
    use = machine.Use.now()
    print("| | states | runs | rows | row by row: compile s, run ms | parallel, likewise | as fast, times | off |")
    print("|---|---|---|---|---|---|---|---|")
    wins: dict[tuple, int] = {}
    for what in a.what:
        for n in a.states:
            for runs in a.runs:
                for steps in a.steps:
                    z = jax.random.normal(jax.random.key(0), (runs, steps, n // 2))
                    one, other = (jax.vmap(program) for program in programs(n, steps)[what])
                    times = [timed(one, z), timed(other, z)]
                    ratio = times[0][1] / times[1][1]
                    if ratio > 1:
                        wins.setdefault((what, n, runs), steps)
                    else:
                        wins.pop((what, n, runs), None)
                    cells = " | ".join(f"{compiled:.1f}, {run * 1e3:,.2f}" for compiled, run in times)
                    off = difference(jax.jit(one)(z), jax.jit(other)(z))
                    print(f"| {what} | {n} | {runs} | {steps:,} | {cells} | {ratio:.2g} | {off:.0e} |", flush=True)
    print()
    for (what, n, runs), steps in wins.items():
        print(f"{what}, {n} states, {runs} runs: parallel wins from {steps:,} rows on, of those tried")
    print(
        f"\n{jax.default_backend()}, {machine.facts()['cores']} cores; others used {use.others():.2f} cores meanwhile"
    )


if __name__ == "__main__":
    main()
