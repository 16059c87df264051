"""The workloads from end to end, on jaxfilt's own car (`benchmarks.studies`, `benchmarks.recovery`)."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import peers, recovery, studies
from benchmarks.contestants import Entry
from benchmarks.workloads import Problem

FEW = 2
"""Runs of filterpy's loop."""


def nothing(found: Any, k: int) -> tuple:
    """There is nothing to compare: the scores are of other runs."""
    return ()


def ours(problem: Problem, name: str) -> Entry:
    """jaxfilt's `study`, both filters and all scores; or `tune`, from a factor of 10 off to within 1 % of the least
    loss, compilation and all."""
    if problem.kind == "study":
        return Entry(
            lambda: studies.studied(problem.steps, problem.runs, backend=name),
            nothing,
            clock=lambda timing: (timing.compile, timing.run),
        )
    return Entry(
        lambda: recovery.timed(problem.runs, problem.steps, backend=name),
        nothing,
        note="compilation and all, to within 1 % of the least loss",
        clock=lambda arrival: (0.0, arrival.near),
    )


def dynamax(problem: Problem) -> Entry:
    """jaxfilt's simulation, dynamax's EKF and UKF, the sums of squared errors: one program for a batch of runs."""
    steps = problem.steps
    simulate = studies.simulator(steps, jit=False)
    filters = [studies.dynamax(name, steps) for name in studies.FILTERS]
    size = min(studies.BATCH, problem.runs)

    @jax.jit
    def batch(numbers: jax.Array) -> list[jax.Array]:
        found = simulate(numbers)
        return [studies.squares(found.truth, jax.vmap(means)(*found[1:])) for means in filters]

    def run() -> list[Any]:
        return [jax.device_get(batch(jnp.arange(done, done + size))) for done in range(0, problem.runs, size)]

    return Entry(run, nothing, -(-problem.runs // size) * size, note="RMSE for scores")


def filterpy(problem: Problem) -> Entry:
    """jaxfilt's simulation, a loop of filterpy's EKF and UKF, and the sums of squared errors."""
    simulate, reads = studies.simulator(problem.steps), studies.CAR.schedule(problem.steps).valid["gnss"]
    runs = min(FEW, problem.runs)

    def run() -> list[np.ndarray]:
        few = jax.device_get(simulate(jnp.arange(runs)))
        return [np.asarray(studies.squares(few.truth, peers.filterpy(n, few, reads))) for n in studies.FILTERS]

    return Entry(run, nothing, runs, note="RMSE for scores")
