"""Tuning on real recordings, held out: ``python -m benchmarks.tuning [--only NAME]`` prints
the README's table.

Each recording is split by sequence: `jaxfilt.tune` sees some, the table shows the others, which nothing was chosen on.
Needs the recordings at ``$JAXFILT_DATA``. Computes in float64; ``--float32`` does it in float32. An hour on two cores.

A gate makes a jump of the loss wherever a reading crosses it, and line searches end at jumps; and a filter that may
refuse what it cannot explain is rewarded for believing too much. So the gate decides once, at the parameters "before",
which readings to learn from; tuning has no gate; and the held-out runs are filtered with the gate again. No truth
enters that choice.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from jaxfilt import datasets, metrics, recordings
from jaxfilt.fold import Objective
from jaxfilt.objectives import log_score
from jaxfilt.recordings.indoor import INDOOR_DRONE
from jaxfilt.tune import tune
from jaxfilt.tuning.split import Split
from jaxfilt.types import Array, Gaussian, Log, PyTree, Replay, Status, Truth

STAGES = ("before", "noise estimation", "tuned")


class Task(NamedTuple):
    """What is tuned on a recording, and how.

    ``theta`` to begin with, in round numbers that were not fitted to these data; ``rotations``, (training, test)
    sequences; ``begin(replay, row)``, theta -> the belief in which a piece starts; ``pieces`` (how many from each run,
    rows of each) to learn from, None: whole runs; ``burn_in`` s of each that do not count. ``pull``: the loss grows by
    half of it, nats per row, where one logarithm is off its beginning by 1. Errors of neighbouring rows are alike, so
    that a short recording says less of its noises than its number of rows would have it.
    """

    name: str
    theta: PyTree
    rotations: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...]
    gate: float | None
    begin: Callable[[Replay, int], Callable[[PyTree], Gaussian]]
    pieces: tuple[int, int] | None = None
    burn_in: float = 0.0
    steps: int = 40
    frozen: tuple[str, ...] = ("start",)
    pull: float = 0.0


class Score(NamedTuple):
    """Of the position on held-out runs: RMSE and mean error (m); ANEES over its dimension, 1 if consistent."""

    rmse: float
    mean: float
    anees: float


def known(replay: Replay) -> Truth:
    """The truth of a replay that has one."""
    assert replay.truth is not None
    return replay.truth


def each_in_turn(name: str) -> tuple[tuple[tuple[str, ...], tuple[str, ...]], ...]:
    """Learn from all sequences but one, test on that one: each of them in turn."""
    every = datasets.sequences(name)
    return tuple((tuple(s for s in every if s != test), (test,)) for test in every)


NEWCOMER_CAMPUS = {
    "deviation": (0.0,) * 5,  # rad: a compass that does not deviate
    "walk": math.log(0.1),
    "along": math.log(0.1),
    "across": math.log(0.1),
    "offset": math.log(0.1),  # rad
    "offset_time": math.log(100.0),  # s
    "drift": math.log(0.001),
    "wander": math.log(3.0),  # m
    "wander_time": math.log(60.0),  # s
    "gps": math.log(5.0),  # m: consumer GPS
    "start": (math.log(1.0), math.log(0.1)),
    "scale": 1.0,  # of the wheels, no logarithm: the mean of the first belief
}


def on_campus(replay: Replay, row: int) -> Callable[[PyTree], Gaussian]:
    """The replay's first belief, but with a scale of the wheels that is a parameter."""

    def belief(theta: PyTree) -> Gaussian:
        mean, cov = replay.belief(theta)
        return Gaussian(mean._replace(scale=jnp.asarray(theta["scale"], cov.dtype)), cov)

    return belief


LOGARITHMS = (
    *("walk", "along", "across", "offset", "offset_time", "drift", "wander", "wander_time", "gps"),
    *("acceleration", "range", "height"),
)
"""What is pulled towards its beginning: of nclt_1hz, of crazyflie_uwb."""

NEWCOMER_ROBOT = {
    "slip": math.log(0.01),
    "along": math.log(0.1),
    "turn": math.log(0.1),
    "spin": math.log(0.1),
    "drift": math.log(0.001),
    "range": math.log(0.1),  # m
    "range_share": math.log(0.01),
    "bearing": math.log(0.02),  # rad
    "start": (math.log(0.02), math.log(0.02), math.log(0.1)),
}

NEWCOMER_CAR = {
    "slip": math.log(0.1),
    "along": math.log(0.1),
    "turn": math.log(0.1),
    "spin": math.log(0.1),
    "drift": math.log(0.01),
    "position": math.log(0.1),  # m
    "start": (math.log(0.05), math.log(0.05), math.log(0.1)),
}


def at_true_pose(replay: Replay, row: int) -> Callable[[PyTree], Gaussian]:
    """Where the robot truly is at a row, as the replay's first belief is where it is at the first."""

    def belief(theta: PyTree) -> Gaussian:
        mean, cov = replay.belief(theta)
        if row == 0:
            return Gaussian(mean, cov)
        pose = jax.tree.map(lambda a: jnp.asarray(a[row], cov.dtype), known(replay).x)
        return Gaussian(mean._replace(pos=pose.pos, yaw=pose.yaw), cov)

    return belief


def in_the_hall(replay: Replay, row: int) -> Callable[[PyTree], Gaussian]:
    """Amid the anchors: on the floor and at rest at the first row; later 0.5 m up give or take 1 m, 1 m/s."""

    def belief(theta: PyTree) -> Gaussian:
        mean, cov = replay.belief(theta)
        if row == 0:
            return Gaussian(mean, cov)
        up = jnp.asarray([0.0, 0.0, 0.5], cov.dtype)
        return Gaussian(
            mean._replace(pos=mean.pos + up), jnp.diag(jnp.asarray([4.0, 4.0, 1.0, 1.0, 1.0, 1.0], cov.dtype))
        )

    return belief


TASKS = {
    task.name: task
    for task in (
        # The pull: of 0, 0.02, 0.05 and 0.2 the best log score of each training run with the parameters of the other.
        Task("nclt_1hz", NEWCOMER_CAMPUS, each_in_turn("nclt_1hz"), 0.99, on_campus, pull=0.2),
        # The pull: of 0, 0.05, 0.2 and 0.5, on flights held out of the training flights, the best RMSE; near the best
        # log score.
        Task(
            "crazyflie_uwb",
            INDOOR_DRONE,
            each_in_turn("crazyflie_uwb"),
            recordings.GATES["crazyflie_uwb"],
            in_the_hall,
            pieces=(4, 600),
            burn_in=1.0,
            steps=25,
            pull=0.2,
        ),
        Task(
            "utias_mrclam",
            NEWCOMER_ROBOT,
            ((("1", "2", "3"), ("4", "5")),),
            recordings.GATES["utias_mrclam"],
            at_true_pose,
            pieces=(4, 6000),
            steps=25,
        ),
        Task("dart_car", NEWCOMER_CAR, each_in_turn("dart_car"), None, at_true_pose),
    )
}


def refused_left_out(task: Task, replay: Replay, theta: PyTree) -> Log:
    """The log without the readings that the gate refuses at theta."""
    log = replay.recording.log
    if task.gate is None:
        return log

    def statuses(theta: PyTree, log: Log) -> dict[str, Array]:
        filter = jf.ekf(replay.model(theta), gate=task.gate)
        start = task.begin(replay, 0)(theta)
        return jf.scan(filter, start, log, store=lambda b, info: {name: i.status for name, i in info.items()})

    found = jax.device_get(jax.jit(statuses)(theta, log))
    return log._replace(
        valid={name: np.asarray(log.valid.get(name, True)) & (s == Status.OK) for name, s in found.items()}
    )


def lessons(task: Task, replay: Replay) -> list[tuple[Log, Truth, Callable[[PyTree], Gaussian]]]:
    """What is learned from a run: the whole of it or pieces, spread evenly; each with its truth and first belief."""
    log = refused_left_out(task, replay, arrays(task.theta))
    rows = len(log.dt)
    many, length = (1, rows) if task.pieces is None else task.pieces
    found = []
    for first in np.linspace(0, rows - length, many).astype(int).tolist():
        part, truth = jax.tree.map(lambda a, first=first: a[first : first + length], (log, known(replay)))
        dt = part.dt.copy()
        dt[0] *= first == 0  # a piece starts at the stamp of its first row
        found.append((part._replace(dt=dt), truth, task.begin(replay, first)))
    return found


def arrays(theta: PyTree) -> PyTree:
    """Theta as arrays, so that a program takes it as an argument."""
    return jax.tree.map(jnp.asarray, theta)


def learned(task: Task, replays: Sequence[Replay], objective: Objective = log_score, theta: PyTree = None) -> jf.Fit:
    """The result of tuning on these runs; all of them are for training."""
    logs, truths, beliefs = zip(*[lesson for r in replays for lesson in lessons(task, r)], strict=True)
    one, counted = replays[0], sum(int(t.mask.sum()) for t in truths)

    def prior(theta: PyTree) -> Array:
        pulled = [{name: tree[name] for name in LOGARITHMS if name in tree} for tree in (theta, task.theta)]
        apart = jax.tree.map(lambda a, b: (a - b) ** 2, *pulled)
        return -0.5 * task.pull * counted * sum(jax.tree.leaves(apart))

    return tune(
        lambda theta: jf.ekf(one.model(theta)),
        beliefs,
        task.theta if theta is None else theta,
        logs,
        truths,
        objective,
        space=one.space,
        view=one.view,
        blocks=one.blocks,
        split=Split(tuple(range(len(logs))), (), ()),
        frozen=task.frozen,
        prior=prior if task.pull else None,
        burn_in=task.burn_in,
        steps=task.steps,
    )


def scored(task: Task, replay: Replay, theta: PyTree) -> Score:
    """How the filter does with the gate on a whole run, from the replay's own start."""
    whole, part = replay.model(theta).space, replay.space
    index = list(replay.blocks["position"][0])

    def store(b: Gaussian, info: dict[str, jf.Info]) -> tuple:
        x, P = jf.taylor(replay.view, b, whole, part)[:2]
        return x, P[jnp.ix_(jnp.array(index), jnp.array(index))]

    def run(theta: PyTree, log: Log, truth: PyTree) -> tuple:
        filter = jf.ekf(replay.model(theta), gate=task.gate)
        x, cov = jf.scan(filter, task.begin(replay, 0)(theta), log, store)
        error = metrics.errors(part, truth, x)[:, jnp.array(index)]
        return error, metrics.nees(error, cov)

    truth = known(replay)
    error, nees = jax.device_get(jax.jit(run)(arrays(theta), replay.recording.log, truth.x))
    length, nees = np.linalg.norm(error[truth.mask], axis=1), nees[truth.mask]
    return Score(float(np.sqrt((length**2).mean())), float(length.mean()), float(nees.mean() / len(index)))


def table(task: Task, only: str = "") -> None:
    """Print the lines of a recording, one for each sequence held out (``only`` this one)."""
    replays = {s: recordings.replay(task.name, s) for s in datasets.sequences(task.name)}
    for train, test in task.rotations:
        if only and only not in test:
            continue
        began = time.perf_counter()
        fit = learned(task, [replays[s] for s in train])
        thetas = {"before": task.theta, "noise estimation": fit.estimated, "tuned": fit.theta}
        for sequence in test:
            cells = []
            for stage in STAGES:
                if thetas[stage] is None:
                    cells.append("failed")
                    continue
                rmse, mean, anees = scored(task, replays[sequence], thetas[stage])
                cells.append(f"{rmse:.3g} ({mean:.3g}), {anees:.2f}")
            print(f"| {task.name} | {', '.join(train)} | {sequence} | {' | '.join(cells)} |", flush=True)
        print(
            f"  {fit.objective}, {len(fit.history.loss)} steps, {fit.stopped}; {time.perf_counter() - began:.0f} s",
            flush=True,
        )


def main() -> None:
    """Print the table and what its numbers are."""
    parser = argparse.ArgumentParser(description="Tune on recordings, judge on what was held out.")
    parser.add_argument("--only", choices=list(TASKS), help="one recording")
    parser.add_argument("--test", default="", help="only where this sequence is held out")
    parser.add_argument("--float32", action="store_true", help="compute in float32")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", not given.float32)
    with tempfile.TemporaryDirectory() as cache:
        # The rotations of one recording have the same programs, where their pieces have the same shapes.
        jax.config.update("jax_compilation_cache_dir", cache)
        print(f"| recording | learned from | tested on | {' | '.join(STAGES)} |")
        print(f"|{'---|' * (3 + len(STAGES))}")
        for name in TASKS if given.only is None else [given.only]:
            table(TASKS[name], given.test)
    print("\nRMSE of the position (mean error), m; then its ANEES over its dimension, 1 if consistent. EKF.")


if __name__ == "__main__":
    main()
