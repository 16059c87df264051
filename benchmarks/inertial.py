"""Simulated flights by inertial navigation: ``python -m benchmarks.inertial [--only NAME] [--runs N]`` prints figures.

``inertial`` and ``inertial-gnss``: whether EKF and UKF are consistent, block by block, and how good they are.
``recovery``: a GNSS antenna's lever arm and the lateness of its stamps, both begun at 0, found again from the readings
alone. All in float64, ten minutes on two cores.
"""

from __future__ import annotations

import argparse
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from jaxfilt.consistency import verdict
from jaxfilt.loop import Backend
from jaxfilt.models import inertial_flight
from jaxfilt.models.inertial import inertial, late, remembered
from jaxfilt.models.inertial_flight import GNSS_FLIGHT, flight_start, path, steer
from jaxfilt.models.sensors import gnss_position
from jaxfilt.types import Array, Gaussian, Log, Model, PyTree, Scenario

SCENARIOS = {
    "inertial": inertial_flight.inertial_scenario,
    "inertial-gnss": inertial_flight.inertial_gnss_scenario,
}

RATE = 50
"""Hz of the IMU whose antenna is looked for."""

BETWEEN_FIXES = 10
"""Rows."""

TRUE: dict[str, Any] = GNSS_FLIGHT | {
    "gnss": (math.log(0.02), math.log(0.02), math.log(0.03)),  # m: RTK
    "arm": (0.1, -0.05, 0.15),
    "late": 0.12,
}
"""The truth: the arm in m, the lateness in s."""

UNKNOWN: dict[str, Any] = TRUE | {"arm": (0.0, 0.0, 0.0), "late": 0.0}
"""Where tuning begins."""


def receiver(theta: PyTree) -> Model:
    """Inertial navigation with a GNSS receiver and nothing else, its antenna on an arm and its stamps late."""
    R = jf.diagonal(*(jnp.exp(jnp.asarray(log_std)) for log_std in theta["gnss"]))
    gnss = gnss_position(R, jnp.stack([jnp.asarray(a) for a in theta["arm"]]))
    return inertial(theta, {"gnss": late(gnss, theta["late"], imu=remembered)}, remember=True)


def departure(theta: PyTree) -> Gaussian:
    """The start of `gnss_flight`, without a barometer's drift."""
    mean, cov = flight_start(theta)
    return Gaussian(mean._replace(extra={"imu": mean.extra["imu"]}), cov[:15, :15])


def late_flights(runs: int, steps: int, key: Array) -> Log:
    """Logs (runs, T) of flights whose GNSS readings come rows later: of the truth of then, not of a retreat."""
    prompt = TRUE | {"late": 0.0}
    model, lag = receiver(prompt), round(TRUE["late"] * RATE)
    plan = jf.schedule(model, steps, 1 / RATE, u=path(steps, 1 / RATE))
    belief = departure(prompt)
    fly = jax.jit(jax.vmap(lambda key: jf.simulate(model, belief, plan, key, steer).log))
    logs = jax.tree.map(np.asarray, fly(jax.random.split(key, runs)))
    logs.z["gnss"] = jax.tree.map(lambda a: np.roll(a, lag, axis=1), logs.z["gnss"])
    rows = np.arange(1, steps + 1)
    heard = (rows % BETWEEN_FIXES == 0) & (rows > lag)
    return logs._replace(valid=logs.valid | {"gnss": np.broadcast_to(heard, (runs, steps)).copy()})


def recovery(runs: int = 10, steps: int = 400, seed: int = 3, backend: Backend = "auto") -> jf.Fit:
    """The fit of lever arm and lateness by the likelihood of the readings: no truth."""
    frozen = [name for name in TRUE if name not in ("arm", "late")]
    return jf.tune(
        lambda theta: jf.ekf(receiver(theta)),
        departure,
        UNKNOWN,
        late_flights(runs, steps, jax.random.key(seed)),
        frozen=frozen,
        truth_theta=TRUE,
        steps=30,
        backend=backend,
    )


def consistent(name: str, runs: int, steps: int = 800) -> None:
    """Print the blocks of a scenario: RMSE and ANEES of both filters."""
    scenario: Scenario = SCENARIOS[name]()
    filters = {
        build.__name__: functools.partial(lambda build, theta: build(scenario.model(theta)), build)
        for build in (jf.ekf, jf.ukf)
    }
    found = jf.study(
        scenario.model, filters, scenario.belief, scenario.schedule(steps), jax.random.key(1), theta=scenario.theta,
        runs=runs, control=scenario.control, blocks=scenario.blocks, backend="xla",
    )  # fmt: skip
    print(
        f"\n{name}: {runs} runs of {steps} rows at 100 Hz; {found.run_seconds:.0f} s and {found.compile_seconds:.0f} s"
    )
    print("| filter | block | RMSE | ANEES over its dimension, 99.9 % bounds | |\n|---|---|---|---|---|")
    for filter, scores in found.scores.items():
        for block, c in scores.nees_total.items():
            rmse = f"{scores.rmse_total[block].value:.3g} {scenario.blocks[block][1]}" if block != "state" else ""
            numbers = " | ".join(f"{a / c.expected:.2f}" for a in (c.mean, c.low, c.high))
            ratio, low, high = numbers.split(" | ")
            print(f"| {filter} | {block} | {rmse} | {ratio} ({low} to {high}) | {verdict(c)} |")


def recovered(runs: int) -> None:
    """Print what was true, and what was found."""
    fit = recovery(runs)
    print(
        f"\nrecovery: {runs} flights of 8 s, GNSS at {RATE / BETWEEN_FIXES:g} Hz, likelihood, {fit.run_seconds:.0f} s"
    )
    print("| parameter | start | true | found | standard error |\n|---|---|---|---|---|")
    for p in fit.parameters:
        print(f"| {p.name} | {p.start:g} | {p.true:g} | {p.value:.4f} | {p.error:.4f} |")


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=[*SCENARIOS, "recovery"])
    parser.add_argument("--runs", type=int, help="default: 200 to study, 10 to tune")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for name in SCENARIOS:
        if options.only in (None, name):
            consistent(name, options.runs or 200)
    if options.only in (None, "recovery"):
        recovered(options.runs or 10)


if __name__ == "__main__":
    main()
