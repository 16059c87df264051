"""What each estimator costs beside an EKF: ``python -m benchmarks.estimators [NAME ...]`` prints the table.

One run, float64, under `jax.jit`; each row of the table in a process of its own, so that its memory is its own. Times
are of whole programs, readings in and means and covariances (or what else is scored) of all rows out, waited for;
compilation apart. An estimator is compared with the `jaxfilt.ekf` of the same model on the same log. What is not
installed is left out, and said so. Ten minutes.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from benchmarks import machine
from benchmarks.limits import dense
from benchmarks.parallel import timed
from jaxfilt.grid import grid
from jaxfilt.models.corridor import CORRIDOR_LENGTH, corridor_scenario
from jaxfilt.models.slam import MAPPING_ROBOT, in_sight, slam, slam_start
from jaxfilt.models.wheeled import Odometry
from jaxfilt.particle import particle
from jaxfilt.scenarios import scenario
from jaxfilt.slam import ekf_slam, fast_slam
from jaxfilt.smooth import fixed_lag, smooth
from jaxfilt.types import Filter, Gaussian, Log, Model, Scenario

ROOT = Path(__file__).resolve().parent.parent
MARK = "measured: "


class Work(NamedTuple):
    """A model, a belief and a log of ``steps`` rows."""

    model: Model
    start: Gaussian
    log: Log
    steps: int


Run = Callable[[Log], Any]


def simulated(found: Scenario, steps: int) -> Work:
    """A scenario of jaxfilt."""
    model, start = found.model(found.theta), found.belief(found.theta)
    _, log = jax.jit(lambda key: jf.simulate(model, start, found.schedule(steps), key, found.control))(
        jax.random.key(0)
    )
    return Work(model, start, log, steps)


def linear() -> Work:
    """A dense linear system of four states, two of them measured."""
    steps, model = 1000, dense(4, 2)
    z = jax.random.normal(jax.random.key(0), (steps, 2))
    return Work(model, Gaussian(jnp.zeros(4), jnp.eye(4)), Log(jnp.ones(steps), (), {"z": z}, {}, {}), steps)


def mapping(count: int) -> Work:
    """A robot on a circle among landmarks, one of them seen in each row."""
    steps, ring = 200, np.arange(count) * 2 * np.pi / count
    places = 12.0 * np.stack([np.cos(ring), np.sin(ring)], 1) + np.array([0.0, 10.0])
    theta = jax.tree.map(jnp.asarray, MAPPING_ROBOT)
    model, start = slam(theta, count), slam_start(theta, places)
    turned = np.arange(1, steps + 1) * 0.01
    pos = 10.0 * np.stack([np.sin(turned), 1 - np.cos(turned)], 1)
    u = Odometry(np.ones(steps), np.full(steps, 0.1))
    plan = jf.schedule(model, steps, 0.1, every={"gnss": 0}, u=u, c={"landmark": in_sight(pos, places, 30.0)})
    _, log = jax.jit(lambda key: jf.simulate(model, start, plan, key))(jax.random.key(0))
    return Work(model, start, log, steps)


WORKS: dict[str, Callable[[], Work]] = {
    "linear, 4 states": linear,
    "car, 4 states": lambda: simulated(scenario("car"), 1000),
    "attitude, 6 states": lambda: simulated(scenario("attitude"), 1000),
    "corridor, 1 state": lambda: simulated(corridor_scenario(), 500),
    "SLAM, 10 landmarks": lambda: mapping(10),
    "SLAM, 100 landmarks": lambda: mapping(100),
}


def scanned(build: Callable[[Model], Filter], **options: Any) -> Callable[[Work], Run]:
    """Mean and covariance of each row."""

    def prepared(work: Work) -> Run:
        filt = build(work.model)
        carried = filt.begin(work.start, jax.random.key(1))
        return lambda log: jf.scan(filt, carried, log, lambda b, info: filt.gaussian(b), **options)

    return prepared


def pathed(build: Callable[[Model], Filter]) -> Callable[[Work], Run]:
    """Of a robot with a map: its path, and what it carries after the last row. A covariance of all landmarks for each
    row would be most of the memory."""

    def prepared(work: Work) -> Run:
        filt = build(work.model)
        carried = filt.begin(work.start, jax.random.key(1))

        def run(log: Log) -> Any:
            def body(b: Any, row: Log) -> tuple[Any, Any]:
                b, info = filt.step(b, row)
                return b, info["landmark"].nis

            return jax.lax.scan(body, carried, jax.tree.map(jnp.asarray, log))

        return run

    return prepared


def smoothed(build: Callable[[Model], Filter], parallel: bool = False) -> Callable[[Work], Run]:
    """Filter and smoother."""

    def prepared(work: Work) -> Run:
        filt = build(work.model)

        def run(log: Log) -> Any:
            track = jf.scan(filt, work.start, log, parallel=parallel)
            return smooth(filt, track, log, parallel=parallel).belief

        return run

    return prepared


def graph(work: Work) -> Run:
    """The trajectory of highest probability, with covariances."""
    from jaxfilt.graph import optimise

    return lambda log: optimise(jf.ekf(work.model), work.start, log).belief


def complementary(model: Model) -> Filter:
    """Of the accelerometer and the magnetometer, with a bias."""
    share = {"accelerometer": 0.01, "magnetometer": 0.01}
    return jf.complementary(model, share, {name: 0.1 * each for name, each in share.items()})


def drawn(particles: int) -> Callable[[Model], Filter]:
    """So many particles."""
    return lambda model: particle(model, particles)


def cells(count: int) -> Callable[[Model], Filter]:
    """A corridor in so many cells."""
    return lambda model: grid(model, jnp.linspace(0.0, CORRIDOR_LENGTH, count))


def fast(model: Model) -> Filter:
    """FastSLAM of a hundred particles."""
    return fast_slam(model, 100)


def of_two_minds(model: jf.Model) -> jf.Filter:
    """Calm, or a hundred times as restless."""
    return jf.imm([jf.ekf(model), jf.ekf(jf.scaled(model, Q=100.0))], jnp.array([[0.98, 0.02], [0.1, 0.9]]))


ROWS: dict[str, tuple[str, Callable[[Work], Run]]] = {
    "KF (the EKF)": ("linear, 4 states", scanned(jf.kf)),
    "KF, parallel in time": ("linear, 4 states", scanned(jf.kf, parallel=True)),
    "KF and smoother": ("linear, 4 states", smoothed(jf.kf)),
    "KF and smoother, parallel in time": ("linear, 4 states", smoothed(jf.kf, parallel=True)),
    "EKF": ("car, 4 states", scanned(jf.ekf)),
    "IEKF, 4 iterations": ("car, 4 states", scanned(jf.iekf)),
    "UKF": ("car, 4 states", scanned(jf.ukf)),
    "CKF": ("car, 4 states", scanned(jf.ckf)),
    "Gauss-Hermite, 81 points": ("car, 4 states", scanned(lambda model: jf.build(jf.gauss_hermite(3), model))),
    "dead reckoning": ("car, 4 states", scanned(jf.dead_reckoning)),
    "IMM of two EKFs": ("car, 4 states", scanned(of_two_minds)),
    "EKF and smoother": ("car, 4 states", smoothed(jf.ekf)),
    "UKF and smoother": ("car, 4 states", smoothed(jf.ukf)),
    "EKF, fixed lag of 10 rows": ("car, 4 states", scanned(lambda model: fixed_lag(jf.ekf(model), 10))),
    "factor graph": ("car, 4 states", graph),
    **{f"particles, {k:,}": ("car, 4 states", scanned(drawn(k))) for k in (100, 1000, 10000)},
    "EKF, corridor": ("corridor, 1 state", scanned(jf.ekf)),
    "grid of 200 cells": ("corridor, 1 state", scanned(cells(200))),
    "particles in the corridor, 1,000": ("corridor, 1 state", scanned(drawn(1000))),
    "EKF, attitude": ("attitude, 6 states", scanned(jf.ekf)),
    "UKF, attitude": ("attitude, 6 states", scanned(jf.ukf)),
    "complementary": ("attitude, 6 states", scanned(complementary)),
    "EKF, 10 landmarks": ("SLAM, 10 landmarks", pathed(jf.ekf)),
    "EKF-SLAM, 10 landmarks": ("SLAM, 10 landmarks", pathed(ekf_slam)),
    "FastSLAM, 100 particles, 10 landmarks": ("SLAM, 10 landmarks", pathed(fast)),
    "EKF, 100 landmarks": ("SLAM, 100 landmarks", pathed(jf.ekf)),
    "EKF-SLAM, 100 landmarks": ("SLAM, 100 landmarks", pathed(ekf_slam)),
    "FastSLAM, 100 particles, 100 landmarks": ("SLAM, 100 landmarks", pathed(fast)),
}
"""Estimator -> what it is run on, and how. The EKF of each model comes before what is compared with it."""


def measured(name: str) -> dict[str, Any]:
    """Seconds to compile, microseconds a row, MiB at most, and cores that others used."""
    jax.config.update("jax_enable_x64", True)
    which, prepare = ROWS[name]
    work = WORKS[which]()
    use, before = machine.Use.now(), machine.peak_memory()
    compiled, run = timed(prepare(work), work.log)
    each = 1e6 * run / work.steps
    memory = machine.peak_memory()
    return {"compile": compiled, "row": each, "memory": memory, "more": memory - before, "load": use.others()}


def main() -> None:
    """Print the table, or the record of one row."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(ROWS)}; default all")
    asked.add_argument("--one", action="store_true", help="in this process, as JSON")
    a = asked.parse_args()
    for name in a.names:
        if name not in ROWS:
            asked.error(f"expected one of {', '.join(ROWS)}, got {name!r}")
    if a.one:
        for name in a.names:
            print(MARK + json.dumps(measured(name)))
        return
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    print("| estimator | on | compile s | us a row | EKFs | peak MiB (of which compiling and running) | load |")
    print("|---|---|---|---|---|---|---|")
    ekf: dict[str, float] = {}
    for name in a.names or ROWS:
        command = [sys.executable, "-W", "ignore", "-m", "benchmarks.estimators", "--one", name]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=ROOT)
        found = [line for line in done.stdout.splitlines() if line.startswith(MARK)]
        which = ROWS[name][0]
        if not found:
            tail = (done.stderr.strip().splitlines() or ["no output"])[-1]
            print(f"| {name} | {which} | {tail[:100]} |", flush=True)
            continue
        record = json.loads(found[0].removeprefix(MARK))
        ratio = record["row"] / ekf.setdefault(which, record["row"])
        memory = f"{record['memory']:,.0f} ({record['more']:,.0f})"
        cells = f"{record['compile']:.1f} | {record['row']:,.2f} | {ratio:.2g} | {memory} | {record['load']:.2f}"
        print(f"| {name} | {which} | {cells} |", flush=True)
    facts = machine.facts()
    print(f"\n{facts['processor']}, {facts['cores']} cores, {facts['day']}; load: cores that others used meanwhile")


if __name__ == "__main__":
    main()
