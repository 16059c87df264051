"""Attitude on the two trials of BROAD: ``python -m benchmarks.attitude`` prints a table of errors in motion, degrees.

Needs the recordings at ``$JAXFILT_DATA``. Computes in float64. Every parameter, of the Kalman filters and of the
complementary filter, was chosen on the fast trial, so that the slow one is held out; but for the line that says so.
Some minutes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from jaxfilt import datasets, recordings
from jaxfilt.complementary import complementary, dead_reckoning
from jaxfilt.recordings.attitude import BOARD, board, broad

RATE = 286.0
"""Hz, of all sensors."""

PULL = {"accelerometer": 0.03 / RATE, "magnetometer": 0.02 / RATE}
"""Shares of the complementary filter: time constants of 33 and 50 s; the best of a grid on the fast trial."""

INTEGRAL = {name: 0.05 * share for name, share in PULL.items()}
"""1/s, likewise."""

FIRM = {"accelerometer": 0.8 / RATE, "magnetometer": 0.1 / RATE}, 0.1
"""Shares, and the integral over them, 1/s: the best of a grid on the slow trial."""

NO_BIAS = {"gyro_walk": math.log(1e-9), "start": (*BOARD["start"][:2], math.log(1e-9))}
"""Parameters of a filter that takes the gyroscope for true."""

FILTERS: dict[str, tuple[Callable[[Any], jf.Filter], dict]] = {
    "EKF": (lambda theta: jf.ekf(board(theta)), {}),
    "EKF, no bias": (lambda theta: jf.ekf(board(theta)), NO_BIAS),
    "UKF": (lambda theta: jf.ukf(board(theta)), {}),
    "UKF, no bias": (lambda theta: jf.ukf(board(theta)), NO_BIAS),
    "complementary": (lambda theta: complementary(board(theta), PULL, INTEGRAL), {}),
    "complementary, chosen on the slow trial": (
        lambda theta: complementary(board(theta), FIRM[0], {name: FIRM[1] * share for name, share in FIRM[0].items()}),
        {},
    ),
    "complementary, no bias": (lambda theta: complementary(board(theta), PULL), {}),
    "gyroscope alone": (lambda theta: dead_reckoning(board(theta)), {}),
}


def degrees(replay: jf.Replay, att: Any) -> tuple[float, float, float]:
    """RMSE of inclination, heading and of both together, degrees."""
    e = recordings.errors(replay, att)
    inclination, heading = np.hypot(e[:, 0], e[:, 1]), np.abs(e[:, 2])
    total = 2 * np.arccos(np.clip(np.cos(0.5 * inclination) * np.cos(0.5 * heading), -1, 1))
    i, h, both = (math.degrees(np.sqrt((a**2).mean())) for a in (inclination, heading, total))
    return i, h, both


def scored(replay: jf.Replay, make: Callable[[Any], jf.Filter], change: dict) -> tuple[float, float, float]:
    """Those of one filter on one trial."""
    run = jax.jit(lambda theta: jf.scan(make(theta), replay.belief(theta), replay.recording.log, store=jf.mean_only))
    return degrees(replay, run(jax.tree.map(jnp.asarray, replay.theta | change)))


def main() -> None:
    """Print the table."""
    jax.config.update("jax_enable_x64", True)
    trials = datasets.sequences("broad")
    replays = [broad(datasets.load("broad", trial)) for trial in trials]
    print(f"| filter | {' | '.join(f'{trial}: inclination, heading, total' for trial in trials)} |")
    print(f"|{'---|' * (1 + len(trials))}")
    for name, (make, change) in FILTERS.items():
        cells = [", ".join(f"{a:.2f}" for a in scored(replay, make, change)) for replay in replays]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    print(
        "\nRMSE in motion, degrees. Methods of the literature: 2.9 to 16.7 on average over such trials (Laidig 2021)."
    )


if __name__ == "__main__":
    main()
