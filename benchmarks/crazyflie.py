"""The small drone in a hall, leaving out one flight after the other: ``python -m benchmarks.crazyflie`` prints a table.

`jaxfilt.tune` learns noises, biases and late stamps of the range-only point model (`ranging_drone`) from four flights
and their truth, by the log score. The fifth is filtered by that model, and by inertial navigation (`inertial_drone`)
with the same ranges, biases, late stamps and height. Huber's weights, here and there, against ranges that are off by
metres.

What `jaxfilt.tune` learned is held out. Of the inertial filter this is not: the IMU's late stamps (0.06 s), the scale
and the noise of the flow (rounded) were found with the truth of all five flights in sight, and updating with one range
at a time was preferred to four at once by its scores on all five. It is not tuned itself, and is overconfident.

Needs the recordings at ``$JAXFILT_DATA``. Computes in float64; ``--ukf`` adds the UKF.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from jaxfilt import datasets, metrics
from jaxfilt.log import stack
from jaxfilt.recordings.indoor import INDOOR_DRONE, crazyflie_uwb
from jaxfilt.recordings.indoor_inertial import INERTIAL_DRONE, crazyflie_uwb_inertial
from jaxfilt.tuning.split import Split
from jaxfilt.types import Array, Gaussian, Log, PyTree, Replay

ROBUST = 0.95
STEPS = 25
HANDED_ON = ("range", "bias", "height", "late")
"""What the inertial filter takes from the tuned point model."""


def tuned(train: Sequence[Replay], steps: int = STEPS) -> PyTree:
    """Theta of the point model, learned from these flights and their truth."""
    one = train[0]
    fit = jf.tune(
        lambda theta: jf.ekf(one.model(theta), robust=ROBUST),
        [r.belief for r in train],
        INDOOR_DRONE,
        [r.recording.log for r in train],
        [r.truth for r in train if r.truth is not None],
        jf.log_score,
        space=one.space,
        view=one.view,
        split=Split(tuple(range(len(train))), (), ()),
        frozen=("start",),
        burn_in=1.0,
        steps=steps,
        backend="lanes",
    )
    return fit.theta


@functools.cache
def program(replay: Callable[[PyTree], jf.Model], build: Callable) -> Callable:
    """(theta, belief, log) -> positions and their covariances: compiled once for logs of one length."""

    def store(b: Gaussian, info: dict[str, jf.Info]) -> tuple[Array, Array]:
        return b.mean.pos, b.cov[:3, :3]

    return jax.jit(lambda theta, belief, log: jf.scan(build(replay(theta), robust=ROBUST), belief, log, store))


def scored(replay: Replay, log: Log, theta: PyTree, build: Callable = jf.ekf) -> tuple[float, float]:
    """RMSE of the position in space (m), and its ANEES over 3; ``log``: the replay's, padded."""
    theta = jax.tree.map(jnp.asarray, theta)
    found = jax.device_get(program(replay.model, build)(theta, replay.belief(theta), log))
    assert replay.truth is not None
    mask = replay.truth.mask
    pos, cov = (a[: len(mask)][mask] for a in found)
    error = replay.truth.x[mask] - pos
    return float(np.sqrt((error**2).sum(1).mean())), float(np.mean(metrics.nees(error, cov)) / 3)


def padded(replays: Sequence[Replay]) -> list[Log]:
    """Their logs, all of one length."""
    batch = stack([r.recording.log for r in replays])
    return [jax.tree.map(lambda a, k=k: a[k], batch) for k in range(len(replays))]


def main() -> None:
    """Print the table, flight by flight as they come, and the means."""
    parser = argparse.ArgumentParser(description="Tune on four flights, judge on the fifth.")
    parser.add_argument("--ukf", action="store_true", help="the UKF too")
    parser.add_argument("--steps", type=int, default=STEPS, help="of the tuning, at most")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    began = time.perf_counter()
    flights = datasets.sequences("crazyflie_uwb")
    data = [datasets.load("crazyflie_uwb", flight) for flight in flights]
    points, inertials = ([read(d) for d in data] for read in (crazyflie_uwb, crazyflie_uwb_inertial))
    logs = {id(r): log for replays in (points, inertials) for r, log in zip(replays, padded(replays), strict=True)}
    filters = {"EKF": jf.ekf} | ({"UKF": jf.ukf} if given.ukf else {})
    stages = ["point before", "inertial before", *(f"{m} tuned, {f}" for f in filters for m in ("point", "inertial"))]
    print(f"| held out | {' | '.join(stages)} | seconds |\n|{'---|' * (len(stages) + 2)}", flush=True)
    every = []
    for k, flight in enumerate(flights):
        clock = time.perf_counter()
        point, drone = points[k], inertials[k]
        theta = tuned([r for r in points if r is not point], given.steps)
        handed = INERTIAL_DRONE | {name: theta[name] for name in HANDED_ON}
        cells = [scored(point, logs[id(point)], INDOOR_DRONE), scored(drone, logs[id(drone)], INERTIAL_DRONE)]
        for build in filters.values():
            cells += [scored(r, logs[id(r)], th, build) for r, th in ((point, theta), (drone, handed))]
        every.append(cells)
        words = " | ".join(f"{rmse:.3f}, {anees:.2f}" for rmse, anees in cells)
        print(f"| {flight} | {words} | {time.perf_counter() - clock:.0f} |", flush=True)
    mean = " | ".join(f"{rmse:.3f}, {anees:.2f}" for rmse, anees in np.mean(every, axis=0))
    print(f"| mean | {mean} | {time.perf_counter() - began:.0f} |")
    print("\nRMSE of the position in space (m), then its ANEES over 3, 1 if consistent.")


if __name__ == "__main__":
    main()
