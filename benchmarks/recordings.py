"""Filters on real recordings: ``python -m benchmarks.recordings`` prints the README's table of figures.

Needs the recordings at ``$JAXFILT_DATA``. Computes in float64; ``--float32`` does it in float32. A few minutes.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from jaxfilt import datasets, recordings

FILTERS = {"EKF": jf.ekf, "UKF": jf.ukf}

PUBLISHED = {
    "udacity_ctrv": "pass marks EKF 0.11, 0.11, 0.52, 0.52, UKF 0.09, 0.10, 0.40, 0.30; UKFs reported 0.061, 0.086, "
    "0.330, 0.213 and 0.069, 0.083, 0.332, 0.233",
    "nclt_1hz": "2013-04-05: EKF of mte546-project, mean error 7.98; KalmanNet 8.47",
}

NOTES = {
    "udacity_ctrv": "simulated; RMSE of px, py (m), vx, vy (m/s)",
    "utias_mrclam": "RMSE of the position (m), robots 1 ... 5: mean, and one by one; the five run as one batch",
    "nclt_1hz": "RMSE of the position (m) and mean error (m); 2013-04-05 is the test, the others calibrated it",
    "wifibot": "RMSE of the position (m); fixes made from the truth, 2 Hz, 0.1 m",
    "dart_car": "RMSE of the position (m); fixes made from the truth, 2 Hz, 0.05 m",
    "crazyflie_uwb": "RMSE of the position (m), in space; a newcomer's noises: `benchmarks.tuning` finds better ones",
}


def means(replays: list[jf.Replay], build: Callable, gate: Any, alone: bool = False) -> list[Any]:
    """The filter's means on replays of one model, run as one batch; ``alone``: by dead reckoning, no sensor heard."""
    belief, log = recordings.batch(replays)
    log = recordings.dead_reckoning(log) if alone else log

    def run(theta: Any, belief: jf.Gaussian, log: jf.Log) -> Any:
        return jf.scan_runs(build(replays[0].model(theta), gate=gate), belief, log, store=jf.mean_only)

    batch = jax.jit(run)(jax.tree.map(jnp.asarray, replays[0].theta), belief, log)
    return [jax.tree.map(lambda a, k=k: a[k], batch) for k in range(len(replays))]


def figure(name: str, replays: list[jf.Replay], tracks: list[Any]) -> list[str]:
    """The errors of these tracks in the words of `NOTES`: one text for each, or one for all of a fleet."""
    scores = [recordings.rmse(r, x) for r, x in zip(replays, tracks, strict=True)]
    if name == "udacity_ctrv":
        return [", ".join(f"{value:.3f}" for value in score.values()) for score in scores]
    position = [score["position"] for score in scores]
    if name == "utias_mrclam":
        return [f"{np.mean(position):.3f} ({', '.join(f'{p:.2f}' for p in position)})"]
    if name == "nclt_1hz":
        errors = [recordings.errors(r, x) for r, x in zip(replays, tracks, strict=True)]
        return [f"{p:.2f}, mean {np.hypot(*e.T).mean():.2f}" for p, e in zip(position, errors, strict=True)]
    return [f"{p:.3f}" for p in position]


def rows(name: str) -> list[tuple[str, ...]]:
    """Lines of the table, a sequence or a fleet each; all sequences run as one batch."""
    sequences = datasets.sequences(name)
    replays = [recordings.replay(name, sequence) for sequence in sequences]
    labels = ["dataset 7, robots 1-5"] if name == "utias_mrclam" else sequences
    gate = recordings.GATES[name]
    columns = [figure(name, replays, means(replays, build, gate)) for build in FILTERS.values()]
    # A vehicle tracked from outside has no odometry to reckon with.
    if jax.tree.leaves(replays[0].recording.log.u):
        columns.append(figure(name, replays, means(replays, jf.ekf, None, alone=True)))
    else:
        columns.append([""] * len(labels))
    return list(zip([name] * len(labels), labels, *columns, strict=True))


def main() -> None:
    """Print the table and what its numbers are."""
    jax.config.update("jax_enable_x64", "--float32" not in sys.argv[1:])
    print(f"| recording | sequence | {' | '.join(FILTERS)} | dead reckoning |")
    print(f"|{'---|' * (3 + len(FILTERS))}")
    for name in recordings.names():
        for line in rows(name):
            print(f"| {' | '.join(line)} |", flush=True)
    print()
    for name, note in NOTES.items():
        gate = recordings.GATES[name]
        published = f" Published: {PUBLISHED[name]}." if name in PUBLISHED else ""
        print(f"- `{name}`: {note}. Gate: {'none' if gate is None else gate}.{published}")


if __name__ == "__main__":
    main()
