"""filterpy: a loop over runs and rows, Jacobians by hand, plain `math` in f."""

from __future__ import annotations

import importlib
import math
from typing import Any

import numpy as np

from benchmarks.contestants import Entry, whole
from benchmarks.systems import transition
from benchmarks.workloads import SPREAD, Problem

FEW = 2
"""Runs; the time is brought up in proportion."""


def prepare(problem: Problem, variant: str) -> Entry:
    """See `benchmarks.contestants`."""
    if problem.kind == "study":
        return whole.filterpy(problem)
    kalman: Any = importlib.import_module("filterpy.kalman")
    system, inputs = problem.system, problem.u.tolist()
    n, m, H, runs = system.n, len(system.seen), system.H, min(problem.runs, FEW)
    seen = list(system.seen)

    def f(x: np.ndarray, u: list[float]) -> np.ndarray:
        return np.array(system.f(x.tolist(), u, math))

    def started(filter: Any, i: int) -> Any:
        filter.x, filter.P, filter.Q, filter.R = problem.x0[i].copy(), problem.P0[i].copy(), system.Q, system.R
        return filter

    class Extended(kalman.ExtendedKalmanFilter):
        def predict_x(self, u: Any = 0) -> None:
            self.F = transition(system, self.x, u, math)
            self.x = f(self.x, u)

    def linear(i: int) -> tuple:
        filter = started(kalman.KalmanFilter(n, m), i)
        filter.F, filter.H = transition(system, np.zeros(n), []), H
        means, covs, _, _ = filter.batch_filter(problem.z[i])
        return means, np.diagonal(covs, axis1=1, axis2=2)

    def extended(i: int) -> tuple:
        filter = started(Extended(n, m), i)
        return looped(
            filter, lambda u: filter.predict(u), lambda z: filter.update(z, lambda x: H, lambda x: x[seen]), i
        )

    def unscented(i: int) -> tuple:
        points = kalman.MerweScaledSigmaPoints(n, **SPREAD)
        made = kalman.UnscentedKalmanFilter(n, m, 1.0, lambda x: x[seen], lambda x, dt, u: f(x, u), points)
        filter = started(made, i)
        return looped(filter, lambda u: filter.predict(u=u), filter.update, i)

    def looped(filter: Any, predict: Any, update: Any, i: int) -> tuple:
        means, variances = np.empty((problem.steps, n)), np.empty((problem.steps, n))
        for t, u in enumerate(inputs):
            predict(u)
            update(problem.z[i, t])
            means[t], variances[t] = filter.x, np.diagonal(filter.P)
        return means, variances

    one = {"kf": linear, "ekf": extended, "online": extended, "ukf": unscented}[problem.kind]

    def fetch(found: list, k: int) -> tuple:
        return tuple(np.stack([run[i] for run in found[:k]]) for i in range(2))

    return Entry(lambda: [one(i) for i in range(runs)], fetch, runs, compiled=False)
