"""Filters on real recordings: ``python -m benchmarks.recordings [NAME ...]`` prints the README's table of figures.

What flies by an inertial sensor has tables of its own: `benchmarks.flights`, `.attitude`, `.crazyflie`. Needs the
recordings at ``$JAXFILT_DATA``. Computes in float64; ``--float32`` does it in float32. A quarter of an hour.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from jaxfilt import datasets, recordings
from jaxfilt.recordings.canyon import SCATTER
from jaxfilt.recordings.roads import kitti_imu_gps
from jaxfilt.types import Log, Replay

FILTERS = {
    "EKF": lambda model, gate: jf.ekf(model, gate=gate),
    "UKF": lambda model, gate: jf.ukf(model, gate=gate),
    "robust EKF": lambda model, gate: jf.ekf(model, robust=ROBUST),
}

ROBUST = 0.9
"""Probability with which the robust EKF, which has no gate, counts a true reading in full: the same for all."""

LAST = ("plaza_range", "uwb_labyrinth", "kitti_imu_gps", "comma2k19", "smartloc_berlin")
"""Single drives, of which no other is there to hold out: the figures of the last third stand in brackets."""

ALONE = {"comma2k19": ("gnss",)}
"""What dead reckoning does without; default: every sensor."""

VARIANTS: dict[str, dict[str, Callable[[], Replay]]] = {
    "kitti_imu_gps": {"drive, a fix in 10 s": lambda: kitti_imu_gps(datasets.load("kitti_imu_gps"), every=10)},
    "smartloc_berlin": {
        "the same, readings taken for independent": lambda: recordings.replay("smartloc_berlin")._replace(theta=SCATTER)
    },
}
"""More lines of the table: what other fixes or noises would come to."""

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
    "rcv_uwb_drone": "RMSE, horizontal and height (m); the anchors stand nearly in one plane, so height has a mirror",
    "plaza_range": "RMSE of the position (m), [last third]; by hand, with a bias and no scale of the ranges: 1.00",
    "uwb_labyrinth": "RMSE of the position (m), [last third]; 30 s, nothing held out",
    "kitti_imu_gps": "RMSE of the horizontal position (m) on fixes that the filter did not get, [last third]; it gets "
    "one in 5 s",
    "comma2k19": "RMSE of the horizontal position (m), [last third]; the receiver's own fixes: 1.47; dead reckoning by "
    "speed, gyroscope and accelerometer",
    "smartloc_berlin": "RMSE of the horizontal position (m), [last third]; the start is the truth's, so that dead "
    "reckoning begins with no error",
}


def silenced(name: str, log: Log) -> Log:
    """The log for dead reckoning."""
    if name not in ALONE:
        return recordings.dead_reckoning(log)
    silent = {sensor: np.zeros(np.shape(log.dt), bool) for sensor in ALONE[name]}
    return log._replace(valid={**log.valid, **silent})


def means(name: str, replays: Sequence[Replay], build: Callable, gate: Any, silence: bool = False) -> list[Any]:
    """The filter's means on replays of one model, run as one batch; ``silence``: by dead reckoning."""
    belief, log = recordings.batch(replays)
    log = silenced(name, log) if silence else log

    def run(theta: Any, belief: jf.Gaussian, log: jf.Log) -> Any:
        return jf.scan_runs(build(replays[0].model(theta), gate), belief, log, store=jf.mean_only)

    batch = jax.jit(run)(jax.tree.map(jnp.asarray, replays[0].theta), belief, log)
    return [jax.tree.map(lambda a, k=k: a[k], batch) for k in range(len(replays))]


def last_third(replay: Replay) -> Replay:
    """The same replay, scored on the last third of its time only."""
    assert replay.truth is not None
    t = replay.recording.t
    late = t >= t[0] + 2 / 3 * (t[-1] - t[0])
    return replay._replace(truth=replay.truth._replace(mask=replay.truth.mask & late))


def figure(name: str, replays: Sequence[Replay], tracks: list[Any]) -> list[str]:
    """The errors of these tracks in the words of `NOTES`: one text for each, or one for all of a fleet."""
    scores = [recordings.rmse(r, x) for r, x in zip(replays, tracks, strict=True)]
    if name in ("udacity_ctrv", "rcv_uwb_drone"):
        return [", ".join(f"{value:.3f}" for value in score.values()) for score in scores]
    position = [score["position"] for score in scores]
    if name == "utias_mrclam":
        return [f"{np.mean(position):.3f} ({', '.join(f'{p:.2f}' for p in position)})"]
    if name == "nclt_1hz":
        errors = [recordings.errors(r, x) for r, x in zip(replays, tracks, strict=True)]
        return [f"{p:.2f}, mean {np.hypot(*e.T).mean():.2f}" for p, e in zip(position, errors, strict=True)]
    if name in LAST:
        late = [recordings.rmse(last_third(r), x)["position"] for r, x in zip(replays, tracks, strict=True)]
        return [f"{p:.3f} [{q:.3f}]" for p, q in zip(position, late, strict=True)]
    return [f"{p:.3f}" for p in position]


def rows(name: str) -> list[tuple[str, ...]]:
    """Lines of the table, a sequence or a fleet each; all sequences run as one batch."""
    sequences = datasets.sequences(name)
    labels = ["dataset 7, robots 1-5"] if name == "utias_mrclam" else list(sequences)
    found = lines(name, labels, [recordings.replay(name, sequence) for sequence in sequences])
    for label, variant in VARIANTS.get(name, {}).items():
        found += lines(name, [label], [variant()])
    return found


def lines(name: str, labels: Sequence[str], replays: Sequence[Replay]) -> list[tuple[str, ...]]:
    """The lines of these replays, one batch."""
    gate = recordings.GATES[name]
    columns = [figure(name, replays, means(name, replays, build, gate)) for build in FILTERS.values()]
    # A vehicle tracked from outside has no odometry to reckon with.
    if jax.tree.leaves(replays[0].recording.log.u):
        columns.append(figure(name, replays, means(name, replays, FILTERS["EKF"], None, silence=True)))
    else:
        columns.append([""] * len(labels))
    return list(zip([name] * len(labels), labels, *columns, strict=True))


def canyon() -> None:
    """Print what gates and the robust option make of pseudoranges, two in five of them off by more than 15 m."""
    replay = recordings.replay("smartloc_berlin")
    noises = {"inflated": replay, "taken for independent": replay._replace(theta=SCATTER)}
    filters: dict[str, Callable] = {"plain": lambda model, _: jf.ekf(model)}
    filters |= {f"gate {p}": lambda model, _, p=p: jf.ekf(model, gate=p) for p in (0.99, 0.9)}
    filters |= {f"robust {p}": lambda model, _, p=p: jf.ekf(model, robust=p) for p in (0.9, 0.5, 0.2)}
    print(f"\n| smartloc_berlin, noises | {' | '.join(filters)} |\n|{'---|' * (1 + len(filters))}")
    for label, one in noises.items():
        found = [
            figure("smartloc_berlin", [one], means("smartloc_berlin", [one], f, None))[0] for f in filters.values()
        ]
        print(f"| {label} | {' | '.join(found)} |", flush=True)


def main() -> None:
    """Print the table and what its numbers are."""
    jax.config.update("jax_enable_x64", "--float32" not in sys.argv[1:])
    asked = [word for word in sys.argv[1:] if not word.startswith("-")]
    strangers = sorted(set(asked) - set(NOTES))
    if strangers:
        raise SystemExit(f"expected recordings of {', '.join(NOTES)}, got {', '.join(strangers)}")
    names = asked or list(NOTES)
    print(f"| recording | sequence | {' | '.join(FILTERS)} | dead reckoning |")
    print(f"|{'---|' * (3 + len(FILTERS))}")
    for name in names:
        for line in rows(name):
            print(f"| {' | '.join(line)} |", flush=True)
    print()
    for name in names:
        gate = recordings.GATES[name]
        published = f" Published: {PUBLISHED[name]}." if name in PUBLISHED else ""
        print(f"- `{name}`: {NOTES[name]}. Gate: {'none' if gate is None else gate}.{published}")
    print(f"- robust EKF: no gate, robust={ROBUST}")
    if "smartloc_berlin" in names:
        canyon()


if __name__ == "__main__":
    main()
