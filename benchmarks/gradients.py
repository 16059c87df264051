"""Reverse mode through a filter, time and memory: ``python -m benchmarks.gradients [--quick]`` prints the table.

Value and gradient of the log-likelihood, summed over runs of ``scenario("car")`` (GNSS in every fifth row, odometer in
every row), with respect to eight parameters, by the EKF: through the textbook's step, written with `jnp.linalg.solve`;
through the library; through the library with segments. Each in a process of its own, compiled and run apart.
``--against FOLDER`` adds the library that lies there, an older checkout say; ``--scenario`` and ``--filter`` take
others, of which there is no textbook's step.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from benchmarks.peers import SEEN, moved
from jaxfilt.models.car import DT
from jaxfilt.scenarios import scenario

HERE = Path(__file__).resolve().parent.parent
FILTERS = {"ekf": jf.ekf, "ukf": jf.ukf, "ckf": jf.ckf}
TUNED = ("wheel_base", "slip", "turn", "speed", "gnss", "odometer")
"""Of the car's parameters; with two of the start's, eight."""

Loss = Callable[[Any, jf.Log], jax.Array]


def textbook(plan: jf.Log) -> Loss:
    """Minus the log-likelihood of one run by the car's EKF as the book has it; Sarkka (2013), algorithm 5.4.

    GNSS and odometer in one update where both speak, ``P - K S K'``, and Jacobians by `jax.jacfwd`.
    """
    car = scenario("car")

    def loss(theta: Any, log: jf.Log) -> jax.Array:
        std = jax.tree.map(jnp.exp, theta)
        Q = DT * jnp.diag(jnp.stack([std["slip"], std["slip"], std["turn"], std["speed"]])) ** 2
        R = jnp.diag(jnp.stack([std["gnss"], std["gnss"], std["odometer"]])) ** 2
        belief = car.belief(theta)
        mean = jnp.concatenate([belief.mean.pos, jnp.stack([belief.mean.yaw, belief.mean.speed])])

        def f(x: jax.Array, u: Any) -> jax.Array:
            return jnp.stack(moved(x, u, std["wheel_base"], jnp, lambda a: jnp.sinc(a / math.pi)))

        def update(x: jax.Array, P: jax.Array, z: jax.Array, H: np.ndarray, R: jax.Array) -> tuple:
            r, S = z - H @ x, H @ P @ H.T + R
            K = jnp.linalg.solve(S, H @ P).T
            nll = 0.5 * (r @ jnp.linalg.solve(S, r) + jnp.linalg.slogdet(2 * math.pi * S)[1])
            return x + K @ r, P - K @ S @ K.T, nll

        def step(carry: tuple, row: tuple) -> tuple:
            x, P = carry
            u, gnss, odometer, heard = row
            F = jax.jacfwd(f)(x, u)
            x, P = f(x, u), F @ P @ F.T + Q
            both = jnp.append(gnss, odometer)
            x, P, nll = jax.lax.cond(
                heard,
                lambda x, P: update(x, P, both, SEEN, R),
                lambda x, P: update(x, P, both[2:], SEEN[2:], R[2:, 2:]),
                x, P,
            )  # fmt: skip
            return (x, P), nll

        rows = tuple(log.u), log.z["gnss"], log.z["odometer"], jnp.asarray(plan.valid["gnss"])
        return jax.lax.scan(step, (mean, belief.cov), rows)[1].sum()

    return loss


def ours(name: str, filter: str, plan: jf.Log, segment: int | None) -> Loss:
    """Minus the log-likelihood of one run by the library."""
    robot = scenario(name)
    # An older library, to compare with, knows no segments.
    options: dict[str, Any] = {} if segment is None else {"segment": segment}

    def loss(theta: Any, log: jf.Log) -> jax.Array:
        whole = plan._replace(u=log.u, z=log.z)
        return -jf.log_likelihood(FILTERS[filter](robot.model(theta)), robot.belief(theta), whole, **options)

    return loss


def measure(way: str, name: str, filter: str, runs: int, steps: int, segment: int | None) -> dict[str, Any]:
    """Compile and run one contestant; called in a process of its own, so that the peak of memory is its own."""
    robot = scenario(name)
    theta, plan = jax.tree.map(jnp.asarray, robot.theta), robot.schedule(steps)

    def simulated(key: jax.Array) -> jf.Log:
        return jf.simulate(robot.model(theta), robot.belief(theta), plan, key, robot.control)[1]

    logs = jax.jit(jax.vmap(simulated))(jax.random.split(jax.random.key(0), runs))
    loss = textbook(plan) if way == "textbook" else ours(name, filter, plan, segment)
    if name == "car":
        at: Any = [theta[key] for key in TUNED] + [theta["start"][2], theta["start"][3]]
    else:
        at = theta

    def summed(at: Any, logs: jf.Log) -> jax.Array:
        full = at
        if name == "car":
            full = theta | dict(zip(TUNED, at[:6], strict=True)) | {"start": (*theta["start"][:2], at[6], at[7])}
        axes = jf.Log(None, 0, 0, None, None)  # pyright: ignore[reportArgumentType]
        return jax.vmap(lambda log: loss(full, log), in_axes=(axes,))(logs._replace(dt=None, c=None, valid=None)).sum()

    began = time.perf_counter()
    lowered = jax.jit(jax.value_and_grad(summed)).lower(at, logs)
    traced = time.perf_counter()
    program = lowered.compile()
    compiled, seconds = time.perf_counter(), []
    needs: Any = program.memory_analysis()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    value, gradient = jax.block_until_ready(program(at, logs))
    for _ in range(3):
        start = time.perf_counter()
        jax.block_until_ready(program(at, logs))
        seconds.append(time.perf_counter() - start)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "trace": traced - began,
        "compile": compiled - traced,
        "run": min(seconds),
        "temporary": needs.temp_size_in_bytes / 2**20,
        "peak": after / 2**10,
        "grown": (after - before) / 2**10,
        "value": float(value),
        "gradient": np.concatenate([np.ravel(a) for a in jax.tree.leaves(gradient)]).tolist(),
    }


def in_a_new_process(folder: Path, *arguments: object) -> dict[str, Any]:
    """`measure` with the library in this folder."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(HERE)])}
    command = [sys.executable, __file__, "--one", *map(str, arguments)]
    done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="16 runs of 100 steps")
    parser.add_argument("--runs", type=int, default=256)
    parser.add_argument("--steps", type=int, default=1_000)
    parser.add_argument("--scenario", default="car")
    parser.add_argument("--filter", choices=FILTERS, default="ekf")
    parser.add_argument("--against", type=Path, help="the folder of another jaxfilt")
    parser.add_argument("--float32", action="store_true")
    parser.add_argument("--one", metavar="WAY", help=argparse.SUPPRESS)
    parser.add_argument("--segment", type=int, help="rows; default about the square root of the steps")
    a = parser.parse_args()
    runs, steps = (16, 100) if a.quick else (a.runs, a.steps)
    if a.one:
        jax.config.update("jax_enable_x64", not a.float32)
        print(json.dumps(measure(a.one, a.scenario, a.filter, runs, steps, a.segment)))
        return

    root = math.isqrt(steps)
    segment = a.segment or next(k for k in range(root, 0, -1) if steps % k == 0)
    common = ["--runs", runs, "--steps", steps, "--scenario", a.scenario, "--filter", a.filter]
    common += ["--float32"] if a.float32 else []
    contestants: dict[str, tuple] = {}
    if a.scenario == "car" and a.filter == "ekf":
        contestants["textbook's step, jnp.linalg.solve"] = (HERE, "textbook")
    if a.against:
        contestants[f"jaxfilt in {a.against}"] = (a.against, "library")
    contestants["jaxfilt"] = (HERE, "library")
    contestants[f"jaxfilt, segment={segment}"] = (HERE, "library", "--segment", segment)

    columns = [
        "trace (s)",
        "compile (s)",
        "run (s)",
        "temporary (MiB)",
        "peak of the process (MiB)",
        "by the run (MiB)",
    ]
    columns = [f"{runs} runs x {steps} steps, {a.scenario} {a.filter}", *columns, "times slower", "gradient off by"]
    print(f"| {' | '.join(columns)} |")
    print("|" + "---|" * 9)
    found = {who: in_a_new_process(*how, *common) for who, how in contestants.items()}
    want = np.array(found["jaxfilt"]["gradient"])
    for who, m in found.items():
        off = np.abs(np.array(m["gradient"]) - want).max() / np.abs(want).max()
        cells = [who, f"{m['trace']:.1f}", f"{m['compile']:.1f}", f"{m['run']:.3f}", f"{m['temporary']:.0f}"]
        cells += [f"{m['peak']:.0f}", f"{m['grown']:.0f}", f"{m['run'] / found['jaxfilt']['run']:.2f}", f"{off:.0e}"]
        print(f"| {' | '.join(cells)} |")
    dtype = "float32" if a.float32 else "float64"
    print(f"\n- {os.cpu_count()} cores, {dtype}, jax {jax.__version__}, best of three runs, one program at a time.")


if __name__ == "__main__":
    main()
