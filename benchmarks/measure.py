"""One measurement, in a process of its own: ``python -m benchmarks.measure WORKLOAD CONTESTANT ...`` prints it as JSON.

So compile time, peak memory and settings of one contestant do not touch another's.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
import traceback
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import machine
from benchmarks.contestants import REGISTRY, Contestant, Entry, Unable, versions
from benchmarks.workloads import CHECKED, Problem, problem

ROOT = Path(__file__).resolve().parent.parent
MARK = "measured: "
MOST_REPEATS = 200

Record = dict[str, Any]
"""Of one measurement: see `timed` and `deviation`; or ``unable``, why there is none."""


def timed(entry: Entry, problem: Problem, repeats: int, seconds: float) -> tuple[Record, Any]:
    """The record, and what the last run returned.

    ``compile``: the first call less the median. ``run``, ``least``, ``most``: seconds of the median, the quickest and
    the slowest of ``repeats`` calls, of more while they are short, of fewer once they took ``seconds``. ``cores`` that
    it kept busy; ``load``: cores that others did meanwhile.
    """
    begun = machine.Use.now()
    found = entry.run()
    first = time.perf_counter() - begun.clock
    if entry.clock:
        compiled, run = entry.clock(found)
        times = [run]
    else:
        times = [] if entry.compiled else [first]
        begun = begun if times else machine.Use.now()
        while not _enough(times, repeats, seconds):
            found = None  # the last result's memory is free for the next
            start = time.perf_counter()
            found = entry.run()
            times.append(time.perf_counter() - start)
        compiled = max(0.0, first - statistics.median(times)) if entry.compiled else 0.0
    done = entry.runs or problem.runs
    scale = problem.runs / done
    record = {
        "compile": compiled,
        "run": statistics.median(times) * scale,
        "least": min(times) * scale,
        "most": max(times) * scale,
        "repeats": len(times),
        "runs_done": done,
        "cores": begun.cores(),
        "load": begun.others(),
        "peak_memory": machine.peak_memory(),
        "note": entry.note,
    }
    return record, found


def _enough(times: list[float], repeats: int, seconds: float) -> bool:
    if not times:
        return False
    return sum(times) >= seconds or len(times) >= MOST_REPEATS or (len(times) >= repeats and sum(times) >= 1.0)


def deviation(entry: Entry, problem: Problem, found: Any) -> Record:
    """``mean_off``: of the means, largest, in standard deviations of the posterior; ``variance_off``: of the variances,
    largest, relative. Or ``value_off``, ``gradient_off``, relative.
    """
    if problem.value is not None and problem.gradient is not None:
        value, gradient = entry.fetch(found, 0)
        return {
            "value_off": abs(float(value) / problem.value - 1),
            "gradient_off": float(np.abs(gradient - problem.gradient).max() / np.abs(problem.gradient).max()),
        }
    if problem.means is None or problem.variances is None or problem.kind in ("study", "tuning"):
        return {}
    k = min(CHECKED, entry.runs or problem.runs, problem.runs)
    means, variances = (np.asarray(a, float) for a in entry.fetch(found, k))
    if means.shape != problem.means[:k].shape:
        raise ValueError(f"means: expected shape {problem.means[:k].shape}, got {means.shape}")
    return {
        "mean_off": float((np.abs(means - problem.means[:k]) / np.sqrt(problem.variances[:k])).max()),
        "variance_off": float(np.abs(variances / problem.variances[:k] - 1).max()),
    }


def measured(contestant: Contestant, problem: Problem, repeats: int, seconds: float) -> Record:
    """Prepare, time and check a contestant, in this process."""
    try:
        entry = contestant.prepare(problem)
    except Unable as reason:
        return {"unable": str(reason)}
    record, found = timed(entry, problem, repeats, seconds)
    return record | deviation(entry, problem, found) | {"versions": versions(contestant)}


def in_a_new_process(
    work: str, name: str, runs: int, steps: int, dtype: str, repeats: int, seconds: float, limit: float
) -> Record:
    """`measured` by a fresh interpreter, given up after ``limit`` seconds."""
    contestant = REGISTRY[name]
    which = {"workload": work, "contestant": name, "runs": runs, "steps": steps, "dtype": dtype}
    reason = contestant.missing()
    if dtype == "float32" and not contestant.narrow:
        reason = "computes in float64"
    if reason:
        return which | {"unable": reason}
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_X64": str(int(dtype == "float64"))}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    if contestant.xla:
        environment["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {contestant.xla}".strip()
    command = [sys.executable, "-W", "ignore", "-m", "benchmarks.measure", work, name, *map(str, (runs, steps, dtype))]
    command += ["--repeats", str(repeats), "--seconds", str(seconds)]
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return which | {"unable": f"not done in {limit:.0f} s"}
    for line in done.stdout.splitlines():
        if line.startswith(MARK):
            return which | json.loads(line.removeprefix(MARK))
    tail = done.stderr.strip().splitlines() or ["no output"]
    return which | {"unable": f"fails: {tail[-1][:200]}"}


def main() -> None:
    """Measure and print."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("workload")
    asked.add_argument("contestant")
    asked.add_argument("runs", type=int)
    asked.add_argument("steps", type=int)
    asked.add_argument("dtype")
    asked.add_argument("--repeats", type=int, default=5)
    asked.add_argument("--seconds", type=float, default=20.0)
    a = asked.parse_args()
    try:
        found = problem(a.workload, a.runs, a.steps, a.dtype)
        record = measured(REGISTRY[a.contestant], found, a.repeats, a.seconds)
    except Exception as error:
        traceback.print_exc()
        record = {"unable": f"fails: {type(error).__name__}: {str(error).strip()[:200]}"}
    print(MARK + json.dumps(record))


if __name__ == "__main__":
    main()
