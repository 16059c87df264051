"""The workloads: who runs what, on which readings, and what the right answer is."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks import reference
from benchmarks.systems import SYSTEMS, System, moved

SPREAD = {"alpha": 0.5, "beta": 2.0, "kappa": 0.0}
"""Of the sigma points, the same for all."""

CHECKED = 16
"""Runs whose answers are compared with the reference."""


class Workload(NamedTuple):
    """``kind``: "kf", "ekf", "ukf": filter all runs, return means and variances of all rows; "gradient": value and
    gradient of a loss; "online": one run, row by row, as a robot would; "study", "tuning": from end to end, on
    jaxfilt's own car, whatever ``system`` says. ``sizes``: numbers of runs; the last of ``quick`` are for a look."""

    title: str
    system: str
    kind: str
    sizes: tuple[int, ...]
    quick: tuple[int, ...] = (100,)


WORKLOADS = {
    "W1": Workload("KF, a target in the plane: 4 states, 2 measured", "target", "kf", (100, 1000, 10000)),
    "W2": Workload("EKF, a car: 5 states, 3 measured", "car", "ekf", (100, 1000, 10000)),
    "W3": Workload("EKF, a quadrotor: 12 states, 9 measured", "quadrotor", "ekf", (100, 1000)),
    "W4": Workload("UKF, the car of W2", "car", "ukf", (100, 1000, 10000)),
    "W5": Workload("value and gradient of a loss, 8 parameters, EKF of the car", "car", "gradient", (32, 256), (32,)),
    "W6": Workload("a study from end to end: simulation, EKF, UKF, scores", "car", "study", (1000, 10000)),
    "W7": Workload("tuning from end to end: 8 parameters of a car", "car", "tuning", (32,), (8,)),
    "W8": Workload("one filter online, row by row: EKF of the car", "car", "online", (1,), (1,)),
}


class Problem(NamedTuple):
    """A workload with its readings, in ``dtype``: z (N, T, m), u (T, k), x0 (N, n), P0 (N, n, n).

    The answer, in float64: ``means``, ``variances`` (k, T, n) of the first runs, whose ``truth`` is there too; or
    ``value`` and ``gradient`` (n + m,) of the loss, for which it takes the truth of all.
    """

    name: str
    system: System
    kind: str
    dtype: np.dtype
    u: np.ndarray
    z: np.ndarray
    x0: np.ndarray
    P0: np.ndarray
    truth: np.ndarray
    means: np.ndarray | None = None
    variances: np.ndarray | None = None
    value: float | None = None
    gradient: np.ndarray | None = None

    @property
    def runs(self) -> int:
        """N."""
        return len(self.z)

    @property
    def steps(self) -> int:
        """T."""
        return self.z.shape[1]


def problem(name: str, runs: int, steps: int, dtype: str = "float64", folder: Path | None = None) -> Problem:
    """The problem of a workload: its readings and their answer, from a file in ``folder`` if it is there already."""
    work = WORKLOADS[name]
    system = SYSTEMS[work.system]
    folder = folder or Path(tempfile.gettempdir()) / "jaxfilt-benchmarks"
    how = work.kind if work.kind in ("ukf", "gradient") else "ekf"
    path = folder / f"{system.name}-{how}-{runs}-{steps}.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}.npz")
        np.savez(part, allow_pickle=False, **_made(system, how, runs, steps))
        part.replace(path)
    with np.load(path) as file:
        arrays = dict(file)
    inputs = {key: arrays.pop(key).astype(dtype, copy=False) for key in ("z", "x0", "P0", "truth")}
    if "value" in arrays:
        arrays["value"] = float(arrays["value"])
    return Problem(name, system, work.kind, np.dtype(dtype), system.inputs(steps).astype(dtype), **inputs, **arrays)


def _made(system: System, how: str, runs: int, steps: int) -> dict[str, np.ndarray]:
    """Readings and answer."""
    truth, z, x0, P0 = simulated(system, runs, steps)
    made = {"z": z, "x0": x0, "P0": P0}
    u = system.inputs(steps)
    if how == "gradient":
        value, gradient = reference.value_and_gradient(system, u, z, x0, P0, truth)
        return made | {"truth": truth, "value": value, "gradient": gradient}
    few = slice(0, CHECKED)
    if how == "ukf":
        means, variances = reference.ukf(system, u, z[few], x0[few], P0[few], **SPREAD)
    else:
        means, variances = reference.ekf(system, u, z[few], x0[few], P0[few])
    return made | {"truth": truth[few], "means": means.astype(float), "variances": variances.astype(float)}


def simulated(system: System, runs: int, steps: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Truth (N, T, n), readings (N, T, m), and the starts (N, n), (N, n, n) that the filters are told."""
    rng = np.random.default_rng(seed)
    n, m, u = system.n, len(system.seen), system.inputs(steps)
    scale, std = np.exp(rng.uniform(-0.5, 0.5, runs)), np.sqrt(np.diag(system.P0))
    P0 = scale[:, None, None] * system.P0
    x0 = system.x0 + 0.1 * rng.standard_normal((runs, n)) * std
    x = x0 + np.sqrt(scale)[:, None] * rng.standard_normal((runs, n)) * std
    process, sensor = np.linalg.cholesky(system.Q), np.linalg.cholesky(system.R)
    truth, z = np.empty((runs, steps, n)), np.empty((runs, steps, m))
    for t in range(steps):
        x = moved(system, x, u[t]) + rng.standard_normal((runs, n)) @ process.T
        truth[:, t] = x
        z[:, t] = x[:, system.seen] + rng.standard_normal((runs, m)) @ sensor.T
    return truth, z, x0, P0


def first_prediction(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Means (N, n) and covariances (N, n, n) of the first prediction, for filters that begin with an update."""
    system, dtype = problem.system, np.longdouble
    x, P = problem.x0.astype(dtype), problem.P0.astype(dtype)
    u, Q = problem.u[0].astype(dtype), system.Q.astype(dtype)
    if problem.kind == "ukf":
        points = reference.Points(system.n, **SPREAD)
        x, P = points.predicted(lambda s: moved(system, s, u), x, P, Q)
    else:
        F = reference.jacobian(lambda s: moved(system, s, u), x)
        x, P = moved(system, x, u), F @ P @ np.swapaxes(F, 1, 2) + Q
    return x.astype(problem.dtype), P.astype(problem.dtype)
