"""Maps and ways of robots that draw them: ``python -m benchmarks.slam [loop] [utias] [consistency] [landmarks]``.

Prints the tables of SLAM: simulated laps, the UTIAS robots without their map (needs the recordings at
``$JAXFILT_DATA``), how sure of itself EKF-SLAM becomes, and what 100 landmarks cost. In float64; a quarter of an hour.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from jaxfilt import datasets, metrics, recordings
from jaxfilt.models.slam import LANDMARKS, MAPPING_ROBOT, in_sight, slam, slam_scenario, slam_start
from jaxfilt.models.wheeled import Odometry
from jaxfilt.recordings import mapping
from jaxfilt.slam import Chart, Swarm, ekf_slam, fast_slam, laid_upon, map_error
from jaxfilt.types import Filter, Gaussian, Log, Model, Scenario

STEPS = 1260
"""Rows of a simulated run: two laps."""


class Drive(NamedTuple):
    """What is kept of a run: positions (T, 2) m, the last map (N, 2) m and what was seen of it (N,), statuses (T,)."""

    pos: Any
    landmarks: Any
    seen: Any
    status: Any


def driven(filt: Filter, carried: Any, log: Log) -> Drive:
    """A filter over a log, its map kept from the last row alone."""

    def body(b: Any, row: Log) -> tuple[Any, tuple]:
        b, info = filt.step(b, row)
        return b, (way(b), info["landmark"].status)

    last, (pos, status) = jax.lax.scan(body, carried, jax.tree.map(jnp.asarray, log))
    if isinstance(last, Chart):
        return Drive(pos, last.belief.mean.landmarks, last.seen, status)
    return Drive(pos, jnp.tensordot(jnp.exp(last.log_weights), last.places, axes=1), last.seen, status)


def way(carried: Chart | Swarm) -> jax.Array:
    """The position (2,) m of the robot."""
    if isinstance(carried, Chart):
        return carried.belief.mean.robot.pos
    return jnp.exp(carried.log_weights) @ carried.robots.mean.pos


class Contestant(NamedTuple):
    """``build(model)``; whether it is told the map; whether it hears the sensor of landmarks."""

    build: Callable[[Model], Filter]
    told: bool = False
    hears: bool = True


def contestants(gate: float | None, *particles: int) -> dict[str, Contestant]:
    """The rows of a table."""
    ekf = lambda model: ekf_slam(model, gate=gate)  # noqa: E731
    rows = {
        "dead reckoning": Contestant(ekf, hears=False),
        "known map": Contestant(ekf, told=True),
        "EKF-SLAM": Contestant(ekf),
    }
    for k in particles:
        rows[f"FastSLAM, {k:,} particles"] = Contestant(lambda model, k=k: fast_slam(model, k, gate=gate))
    return rows


def rms(error: np.ndarray) -> float:
    """Root mean square of the lengths of errors (K, 2)."""
    return float(np.sqrt((error**2).sum(-1).mean()))


def figures(drive: Drive, pos: np.ndarray, mask: np.ndarray, places: np.ndarray, told: bool) -> tuple[float, ...]:
    """Error of the way in the frame of the start; with the map laid upon the true one; error of the map so laid."""
    got, seen = np.asarray(drive.pos)[: len(pos)], np.asarray(drive.seen)
    raw = rms((got - pos)[mask])
    if told or seen.sum() < 2:
        return raw, np.nan, np.nan
    found = np.asarray(drive.landmarks)[seen], places[seen]
    return raw, rms((laid_upon(*found, got) - pos)[mask]), map_error(*found)


def row(name: str, numbers: np.ndarray, seconds: float) -> str:
    """A line of a table: means over runs."""
    cells = ["" if np.isnan(x) else f"{x:.3f}" for x in numbers]
    return f"| {name} | {' | '.join(cells)} | {seconds:.1f} |"


HEAD = (
    "| | way, frame of the start (m) | way, map laid upon the true one (m) | map (m) | s a run |\n|---|---|---|---|---|"
)


def loop_table(harsh: bool, runs: int, *particles: int) -> None:
    """Simulated laps: root mean squares, the mean of all runs."""
    scenario = slam_scenario(harsh)
    theta = jax.tree.map(jnp.asarray, scenario.theta)
    plan = scenario.schedule(STEPS)
    print(f"\n{'harsh' if harsh else 'mild'} laps, {runs} runs of {STEPS} rows, 20 landmarks\n\n{HEAD}")
    for name, one in contestants(None, *particles).items():
        model = scenario.model(theta)
        filt = one.build(model)

        def run(key: jax.Array, one: Contestant = one, model: Model = model, filt: Filter = filt) -> tuple:
            start = scenario.belief(theta)
            truth, log = jf.simulate(model, start, plan, key)
            carried = filt.begin(start, jax.random.fold_in(key, 1))
            if one.told:
                world = truth.landmarks[0]
                mean, r = start.mean._replace(landmarks=world), start.cov.shape[0] - world.size
                carried = filt.begin(Chart(Gaussian(mean, start.cov.at[r:, r:].set(0.0)), np.ones(len(world), bool)))
            log = log if one.hears else recordings.dead_reckoning(log)
            return driven(filt, carried, log), truth.robot.pos, truth.landmarks[0]

        program = jax.jit(run)
        jax.block_until_ready(program(jax.random.key(0)))
        began = time.perf_counter()
        results = [jax.block_until_ready(program(jax.random.key(1 + k))) for k in range(runs)]
        seconds = (time.perf_counter() - began) / runs
        scores = [
            figures(drive, np.asarray(pos), np.ones(STEPS, bool), np.asarray(places), one.told)
            for drive, pos, places in results
        ]
        print(row(name, np.mean(scores, axis=0), seconds), flush=True)


def utias_table(*particles: int) -> None:
    """The five UTIAS robots, one by one; noises of the known map's replay, none tuned for this."""
    hidden = [mapping.utias_mrclam(datasets.load("utias_mrclam", s)) for s in datasets.sequences("utias_mrclam")]
    beliefs, logs = recordings.batch([h.replay for h in hidden])
    print("\nUTIAS MRCLAM 7, robots 1 ... 5, landmark positions hidden, gate 0.999\n")
    for name, one in contestants(mapping.GATE, *particles).items():
        filt = one.build(mapping.mapping_robot(jax.tree.map(jnp.asarray, hidden[0].replay.theta)))
        program = jax.jit(lambda carried, log, filt=filt: driven(filt, carried, log))
        scores, seconds, refused = [], [], []
        for k, h in enumerate(hidden):
            log = jax.tree.map(lambda a, k=k: a[k], logs)
            log = log if one.hears else recordings.dead_reckoning(log)
            start = jax.tree.map(lambda a, k=k: a[k], beliefs)
            carried = filt.begin(start, jax.random.key(k))
            if one.told:
                carried = filt.begin(Chart(*mapping.known_map(h)))
            began = time.perf_counter()
            drive = jax.block_until_ready(program(carried, log))
            seconds.append(time.perf_counter() - began)
            truth = h.replay.truth
            assert truth is not None
            scores.append(figures(drive, truth.x.pos, truth.mask, h.places, one.told))
            status = np.asarray(drive.status)
            refused.append(int((status == jf.Status.GATED).sum()))
            assert status.max() <= jf.Status.GATED
        if name == "dead reckoning":
            print(HEAD)
        print(row(name, np.mean(scores, axis=0), float(np.mean(seconds))))
        for label, column in zip(("way", "way, laid", "map"), np.transpose(scores), strict=True):
            print(f"    {label}: {', '.join(f'{x:.3f}' for x in column)}", flush=True)
        print(f"    refused: {refused}")


def pose_nees(scenario: Scenario, runs: int, steps: int = STEPS, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """NEES of the pose (3 dimensions) and that of the map at the end (40), over runs of EKF-SLAM: (runs, T), (runs,).

    Args:
        scenario: of `slam_scenario`.
        runs: how many.
        steps: rows of each.
        scale: of all noises, of the robot and of its sensors, in simulation and filter alike.
    """
    shift = float(np.log(scale))
    theta = {name: jax.tree.map(lambda a: jnp.asarray(a + shift), value) for name, value in scenario.theta.items()}
    theta["map"] = jnp.asarray(scenario.theta["map"])
    model, plan, n = scenario.model(theta), scenario.schedule(steps), 3 + LANDMARKS.size
    filt = ekf_slam(model)

    def run(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        truth, log = jf.simulate(model, scenario.belief(theta), plan, key)

        def body(b: Chart, both: tuple) -> tuple[Chart, jax.Array]:
            row, x = both
            b, _ = filt.step(b, row)
            d = model.space.minus(x, b.belief.mean)[:3]
            return b, metrics.nees(d[None], b.belief.cov[None, :3, :3])[0]

        last, nees = jax.lax.scan(body, filt.begin(scenario.belief(theta)), (log, truth))
        d = model.space.minus(jax.tree.map(lambda a: a[-1], truth), last.belief.mean)[3:n]
        return nees, metrics.nees(d[None], last.belief.cov[None, 3:n, 3:n])[0]

    nees, end = jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(5), runs))
    return np.asarray(nees), np.asarray(end)


def consistency_table(runs: int = 100) -> None:
    """Average NEES of the pose by time, over its dimension: 1 is honest, above is too sure."""
    times = (10, 30, 63, 94, 126)
    print(f"\nEKF-SLAM, NEES of the pose / 3 over {runs} runs, at s (one lap: 63 s); of the map at the end / 40\n")
    print(f"| noises | {' | '.join(map(str, times))} | map |\n|---|{'---|' * (len(times) + 1)}")
    for name, harsh, scale in (("mild / 10", False, 0.1), ("mild", False, 1.0), ("harsh", True, 1.0)):
        nees, end = pose_nees(slam_scenario(harsh), runs, scale=scale)
        cells = [f"{nees[:, 10 * t - 10 : 10 * t].mean() / 3:.2f}" for t in times] + [f"{end.mean() / 40:.2f}"]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    print(f"95 % of an honest filter's means lie within 1 +- {1.96 * np.sqrt(2 / 3 / runs):.2f} (single rows).")


def landmarks_table(count: int = 100, steps: int = 200) -> None:
    """Time per row with a sighting, compile time and memory of a compiled run."""
    ring = np.arange(count) * 2 * np.pi / count
    places = 12.0 * np.stack([np.cos(ring), np.sin(ring)], 1) + np.array([0.0, 10.0])
    theta = jax.tree.map(jnp.asarray, MAPPING_ROBOT)
    model, start = slam(theta, count), slam_start(theta, places)
    u = Odometry(np.ones(steps), np.full(steps, 0.1))
    turned = np.arange(1, steps + 1) * 0.01
    pos = 10.0 * np.stack([np.sin(turned), 1 - np.cos(turned)], 1)
    plan = jf.schedule(model, steps, 0.1, every={"gnss": 0}, u=u, c={"landmark": in_sight(pos, places, 30.0)})
    _, log = jax.jit(lambda key: jf.simulate(model, start, plan, key))(jax.random.key(0))
    print(f"\n{count} landmarks ({model.space.dim} dimensions), a sighting in each of {steps} rows\n")
    print("| | compile (s) | ms a row | carried (MB) | while running (MB) |\n|---|---|---|---|---|")
    builds: dict[str, Callable[[], Filter]] = {
        "EKF-SLAM": lambda: ekf_slam(model),
        "dense EKF, landmarks not placed": lambda: jf.ekf(model),
        "FastSLAM, 100 particles": lambda: fast_slam(model, 100),
        "FastSLAM, 1,000 particles": lambda: fast_slam(model, 1000),
    }
    for name, build in builds.items():
        filt = build()
        carried = filt.begin(start, jax.random.key(0))

        def run(carried: Any, log: Log, filt: Filter = filt) -> Any:
            return jf.scan(filt, carried, log, store=lambda b, info: info["landmark"].nis)

        began = time.perf_counter()
        program = jax.jit(run).lower(carried, log).compile()
        compiled = time.perf_counter() - began
        jax.block_until_ready(program(carried, log))
        began = time.perf_counter()
        jax.block_until_ready(program(carried, log))
        each = (time.perf_counter() - began) / steps
        memory = program.memory_analysis()
        held = sum(leaf.nbytes for leaf in jax.tree.leaves(carried)) / 1e6
        used = (memory.temp_size_in_bytes + memory.argument_size_in_bytes) / 1e6 if memory else float("nan")
        print(f"| {name} | {compiled:.1f} | {1e3 * each:.2f} | {held:.2f} | {used:.1f} |", flush=True)


def loops() -> None:
    """Both kinds of laps."""
    for harsh in (False, True):
        loop_table(harsh, 5, 100, 1000)


def main() -> None:
    """Print what was asked for, or all."""
    jax.config.update("jax_enable_x64", True)
    tables: dict[str, Callable[[], None]] = {
        "loop": loops,
        "utias": lambda: utias_table(100),
        "consistency": consistency_table,
        "landmarks": landmarks_table,
    }
    for name in sys.argv[1:] or tables:
        tables[name]()


if __name__ == "__main__":
    main()
