"""Does tuning find the noise that is there? ``python -m benchmarks.recovery`` prints a table for simulated robots.

Every standard deviation of Q and R is set wrong by a factor, up and down in turn, and tuned on simulated runs, by the
truth (log score) and without it (likelihood), with the noise estimation off: the descent begins where it was told.
Judged on runs that it did not see. ``--only car`` for one robot, ``--quick`` for fewer runs, ``--time`` for how long
the car takes.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from jaxfilt import consistency
from jaxfilt.models import textbook
from jaxfilt.scenarios import scenario
from jaxfilt.tuning.parameters import covers, parameters
from jaxfilt.types import Scenario

OBJECTIVES = {"log score": jf.log_score, "likelihood": jf.likelihood}


class Robot(NamedTuple):
    """What is tuned: which numbers of theta are those of Q and of R, and how many runs of how many steps."""

    scenario: Scenario
    filters: dict[str, Callable]
    Q: tuple[str, ...]
    R: tuple[str, ...]
    runs: int
    steps: int


def robots() -> dict[str, Robot]:
    return {
        "horizontal drone (linear)": Robot(
            textbook.horizontal_drone_scenario(), {"kf": jf.kf}, ("drift",), ("gnss",), 64, 1000
        ),
        "car": Robot(
            scenario("car"), {"ekf": jf.ekf, "ukf": jf.ukf}, ("slip", "turn", "speed"), ("gnss", "odometer"), 64, 1000
        ),
        "multirotor": Robot(scenario("multirotor"), {"ekf": jf.ekf}, ("force", "torque"), ("pose", "gyro"), 32, 500),
    }


def wrong(theta: Any, names: tuple[str, ...], factor: float) -> Any:
    """Theta with the named standard deviations wrong by a factor, too large and too small in turn."""
    free = parameters(theta)
    own = [any(covers(part, name) for part in names) for name in free.names]
    sign = np.where(np.cumsum(own) % 2 == 1, 1.0, -1.0) * own
    return free.tree(jnp.asarray(free.start + sign * np.log(factor)))


def recovered(robot: Robot, filter: Callable, objective: jf.Objective, factor: float) -> list[str]:
    """A row of the table."""
    s, key = robot.scenario, jax.random.key(5)
    log, theta = s.schedule(robot.steps), jax.tree.map(jnp.asarray, s.theta)
    simulate = jax.jit(jax.vmap(lambda k: jf.simulate(s.model(theta), s.belief(theta), log, k, s.control)))
    x, logs = jax.tree.map(np.asarray, simulate(jax.random.split(key, robot.runs)))
    truth = jf.Truth(x, np.ones((robot.runs, robot.steps), bool))
    tuned = robot.Q + robot.R
    every = parameters(theta).names
    frozen = [name for name in every if not any(covers(part, name) for part in tuned)]
    began = time.perf_counter()
    fit = jf.tune(
        lambda th: filter(s.model(th)), s.belief, wrong(theta, tuned, factor), logs, truth, objective,
        frozen=frozen, blocks=s.blocks, truth_theta=theta, noise_estimate=False, steps=200,
    )  # fmt: skip
    seconds = time.perf_counter() - began
    cells = []
    for names in (robot.R, robot.Q):
        own = [p for p in fit.parameters if any(covers(part, p.name) for part in names)]
        ratio, deviations = max(
            ((abs(np.expm1(p.value - (p.true or 0.0))), abs(p.value - (p.true or 0.0)) / p.error) for p in own), key=max
        )
        cells.append(f"{100 * ratio:.1f} % ({deviations:.1f})")
    held = fit.scores["tuned"]["test"].nees
    assert held is not None
    said = f"{held.mean / held.expected:.3f} {consistency.verdict(held)}"
    return [*cells, said, str(len(fit.history.loss)), f"{seconds:.0f}"]


class Arrival(NamedTuple):
    """Seconds, compilation and all, to the first step, to within 1 % of the least loss, to the last step of ``steps``,
    and to the end of scores and standard errors."""

    first: float
    near: float
    last: float
    done: float
    steps: int
    parameters: int


def timed(runs: int = 32, steps: int = 1000, **how: Any) -> Arrival:
    """How long the car takes from a factor of 10 off, eight parameters tuned. ``how``: arguments of `jaxfilt.tune`."""
    robot = robots()["car"]
    s, theta = robot.scenario, jax.tree.map(jnp.asarray, robot.scenario.theta)
    log = s.schedule(steps)
    simulate = jax.jit(jax.vmap(lambda k: jf.simulate(s.model(theta), s.belief(theta), log, k)))
    x, logs = jax.tree.map(np.asarray, simulate(jax.random.split(jax.random.key(5), runs)))
    tuned = (*robot.Q, *robot.R, "wheel_base", "start/0", "start/1")
    frozen = [name for name in parameters(theta).names if not any(covers(part, name) for part in tuned)]
    seen: list[tuple[float, float]] = []
    began = time.perf_counter()
    fit = jf.tune(
        lambda th: jf.ekf(s.model(th)), s.belief, wrong(theta, robot.Q + robot.R, 10.0), logs,
        jf.Truth(x, np.ones((runs, steps), bool)), frozen=frozen, split=jf.Split(range(runs), (), ()),
        noise_estimate=False, progress=lambda step, steps, loss, _: seen.append((time.perf_counter() - began, loss)),
        **how,
    )  # fmt: skip
    least = min(loss for _, loss in seen)
    near = next(t for t, loss in seen if loss - least <= 0.01 * abs(least))
    return Arrival(seen[0][0], near, seen[-1][0], time.perf_counter() - began, len(seen), len(fit.parameters))


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--only", default="", help="robots whose name contains this")
    asked.add_argument("--quick", action="store_true", help="a quarter of the runs")
    asked.add_argument("--factor", type=float, nargs="*", default=[10.0, 100.0])
    asked.add_argument("--time", action="store_true", help="how long the car takes, and nothing else")
    args = asked.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"load {os.getloadavg()[0]:.1f}, {os.cpu_count()} cores, float64\n")
    if args.time:
        a = timed()
        print(f"car, EKF, log score, 32 runs x 1,000 steps, {a.parameters} parameters; seconds, compilation and all:")
        print(f"first step {a.first:.1f}, within 1 % of the least loss {a.near:.1f}, arrived {a.last:.1f} ({a.steps}")
        print(f"steps), scored and with standard errors {a.done:.1f}")
        return
    heads = ("robot", "filter", "objective", "off by", "worst R (errors)", "worst Q (errors)", "held-out ANEES / n")
    print("| " + " | ".join([*heads, "steps", "s"]) + " |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name, robot in robots().items():
        if args.only not in name:
            continue
        if args.quick:
            robot = robot._replace(runs=robot.runs // 4)
        for (kind, filter), (what, objective) in ((f, o) for f in robot.filters.items() for o in OBJECTIVES.items()):
            for factor in args.factor:
                row = recovered(robot, filter, objective, factor)
                print(f"| {name} | {kind} | {what} | {factor:g} | " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
