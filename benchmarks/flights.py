"""Real flights by inertial navigation: ``python -m benchmarks.flights [--only euroc_mav|ansfl_phantom4]``.

Needs the recordings at ``$JAXFILT_DATA``. Computes in float64. Some minutes.
"""

from __future__ import annotations

import math
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from jaxfilt import datasets, metrics, recordings
from jaxfilt.recordings.euroc import euroc_mav
from jaxfilt.recordings.phantom import IMUS, PHANTOM, ansfl_phantom4, outage, phantom

GATE = 0.9999
"""Of both sets: one reading in ten thousand of an honest sensor is refused."""

CONVERGED = {"MH_01_easy": 45.0, "V1_02_medium": 20.0, "V2_03_difficult": 20.0}
"""s from the first row on that are not scored: MH_01 is shaken, lies still, takes off after 42 s; V1_02 after 5 s."""

SETTLED = 5.0
"""s of a Phantom flight that are not scored: it starts in the air."""


def degrees(score: dict[str, float]) -> str:
    """RMSE by block, angles in degrees."""
    angles = ("inclination", "heading")
    return " | ".join(f"{math.degrees(value) if name in angles else value:.3g}" for name, value in score.items())


def euroc() -> None:
    """The table of the three EuRoC flights."""
    for sequence, seconds in CONVERGED.items():
        replay = euroc_mav(datasets.load("euroc_mav", sequence))
        filters = {
            "EKF": lambda theta, r=replay: jf.ekf(r.model(theta), gate=GATE),
            "UKF": lambda theta, r=replay: jf.ukf(r.model(theta), gate=GATE),
        }
        late = replay.recording.t - replay.recording.t[0] >= seconds
        print(f"\n{sequence}, from {seconds:.0f} s on to the end at {np.ptp(replay.recording.t):.0f} s\n")
        print(f"| filter | {' | '.join(replay.blocks)} | ANEES per dimension | refused | run (s) |")
        print(f"|{'---|' * (4 + len(replay.blocks))}")
        for name, make in filters.items():
            out = jf.replayed(replay, {name: make})
            review: Any = out.reviews[name]
            scored = late & np.isfinite(review.error).all(1)
            score = metrics.rmse(review.error, replay.blocks, scored)
            anees = review.nees[scored].mean() / replay.space.dim
            refused = sum(review.refused.values())
            print(f"| {name} | {degrees(score)} | {anees:.2f} | {refused} | {out.run_seconds:.1f} |", flush=True)
        log = recordings.dead_reckoning(replay.recording.log)
        alone = replay._replace(recording=replay.recording._replace(log=log))
        reckoned: Any = jf.replayed(alone, {"alone": filters["EKF"]}).reviews["alone"]
        error = reckoned.error
        score = metrics.rmse(error, replay.blocks, late & np.isfinite(error).all(1))
        print(f"| dead reckoning | {degrees(score)} | | | |", flush=True)


def phantoms() -> None:
    """The tables of the 52 Phantom flights, which run as one batch."""
    sequences = datasets.sequences("ansfl_phantom4")
    replays: list[Any] = [ansfl_phantom4(datasets.load("ansfl_phantom4", s), imu) for s in sequences for imu in IMUS]
    flown = sum(np.ptp(r.recording.t) for r in replays)
    theta = jax.tree.map(jnp.asarray, PHANTOM)

    def run(theta: Any, belief: jf.Gaussian, log: jf.Log) -> Any:
        return jf.scan_runs(jf.ekf(phantom(theta), gate=GATE), belief, log, store=jf.mean_only)

    belief, log = recordings.batch(replays)
    began = time.perf_counter()
    program = jax.jit(run).lower(theta, belief, log).compile()
    compiled = time.perf_counter()
    means = jax.device_get(jax.block_until_ready(program(theta, belief, log)))
    done = time.perf_counter() - compiled
    print(f"\nansfl_phantom4: {len(replays)} flights of {flown:.0f} s in all as one batch: compiled in ", end="")
    print(f"{compiled - began:.1f} s, run in {done:.2f} s, {flown / done:.0f} times as fast as real time\n")

    tracks = [jax.tree.map(lambda a, k=k: a[k], means) for k in range(len(replays))]
    print(f"| flight, mean of {len(IMUS)} IMUs | {' | '.join(replays[0].blocks)} |")
    print(f"|{'---|' * (1 + len(replays[0].blocks))}")
    scores, biases = [], []
    for replay, mean, error in zip(replays, tracks, errors(replays, means), strict=True):
        rows = replay.truth.mask & (replay.recording.t - replay.recording.t[0] >= SETTLED)
        scores.append(metrics.rmse(error[: len(rows)][rows], replay.blocks))
        biases.append(mean.gyro_bias[len(replay.recording.t) - 1])
    for k, sequence in enumerate(sequences):
        print(f"| {sequence} | {degrees(mean_of(scores[4 * k : 4 * k + 4]))} |")
    print(f"| all | {degrees(mean_of(scores))} |")
    spread = np.stack(biases).reshape(len(sequences), len(IMUS), 3)
    print(f"\nGyroscope biases at the end, of an IMU over its {len(sequences)} flights: standard deviation ", end="")
    means_of = np.degrees(abs(spread.mean(0)).max())
    print(f"{np.degrees(spread.std(0).mean(0)).round(2)} deg/s about means of up to {means_of:.1f}")
    outages(replays, belief, theta, program)


def errors(replays: list[Any], means: Any) -> np.ndarray:
    """Errors of a batch, (runs, T, n), in one program: what is behind the end of a flight is padding."""
    length = means.pos.shape[1]
    truths = [jax.tree.map(lambda a: np.pad(a, [(0, length - len(a)), (0, 0)], "edge"), r.truth.x) for r in replays]
    every = jax.tree.map(lambda *a: np.stack(a), *truths)
    space, view = replays[0].space, replays[0].view
    return np.asarray(jax.jit(lambda x, y: metrics.errors(space, x, jax.vmap(jax.vmap(view))(y)))(every, means))


def mean_of(scores: list[dict[str, float]]) -> dict[str, float]:
    return {name: float(np.mean([s[name] for s in scores])) for name in scores[0]}


def outages(replays: list[Any], belief: jf.Gaussian, theta: Any, program: Any) -> None:
    """What 10 s without fixes cost, against dead reckoning from the true state with no biases known."""
    cuts = [outage(r) for r in replays]
    logs = [r.recording.log if cut is None else cut[0] for r, cut in zip(replays, cuts, strict=True)]
    means = jax.device_get(program(theta, belief, jf.stack(logs)))
    starts, alone = [], []
    for replay, cut in zip(replays, cuts, strict=True):
        if cut is None:
            continue
        log, first, last = cut
        x = jax.tree.map(lambda a, row=first: a[row], replay.truth.x)
        origin = replay.belief(theta)
        mean = origin.mean._replace(pos=jnp.asarray(x.pos), vel=jnp.asarray(x.vel), att=jnp.asarray(x.att))
        starts.append(origin._replace(mean=mean))
        between = slice(first + 1, last + 1)
        alone.append(recordings.dead_reckoning(jax.tree.map(lambda a, rows=between: a[rows], log)))
    reckoned = jax.jit(lambda b, log: jf.scan_runs(jf.ekf(phantom(theta)), b, log, store=jf.mean_only))
    reckoning = jax.device_get(reckoned(jax.tree.map(lambda *b: jnp.stack(b), *starts), jf.stack(alone)))
    found: dict[str, list[tuple[float, float]]] = {"filter": [], "dead reckoning": []}
    k = 0
    for run, cut in enumerate(cuts):
        if cut is None:
            continue
        x = jax.tree.map(lambda a, cut=cut: a[cut[2]], replays[run].truth.x)
        ends = {"filter": (means, run, cut[2]), "dead reckoning": (reckoning, k, -1)}
        for name, (mean, i, row) in ends.items():
            far = float(np.linalg.norm(mean.pos[i][row] - x.pos)), float(np.linalg.norm(mean.vel[i][row] - x.vel))
            found[name].append(far)
        k += 1
    print(f"\n10 s without fixes, {k} flights, at the end: median, 90th percentile\n")
    print("| | drift (m) | velocity error (m/s) |\n|---|---|---|")
    for name, values in found.items():
        cells = [f"{np.median(column):.1f}, {np.quantile(column, 0.9):.1f}" for column in np.array(values).T]
        print(f"| {name} | {' | '.join(cells)} |")


def main() -> None:
    """Print the tables."""
    jax.config.update("jax_enable_x64", True)
    only = sys.argv[sys.argv.index("--only") + 1] if "--only" in sys.argv else None
    for name, table in {"euroc_mav": euroc, "ansfl_phantom4": phantoms}.items():
        if only in (None, name):
            table()


if __name__ == "__main__":
    main()
