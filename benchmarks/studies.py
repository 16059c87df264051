"""A Monte Carlo study of the car beside its peers: ``python -m benchmarks.studies`` prints the README's table of times.

10,000 runs of 1,000 steps of ``scenario("car")`` (GNSS in every fifth row, odometer in every row), EKF and UKF, scores
only: jaxfilt's `study`; the filters alone under `jax.vmap`, jaxfilt's and dynamax's; a loop over runs in filterpy. In
float64; ``--float32`` for those in JAX. Needs ``pip install jaxfilt[bench]``; a peer that is not there is left out, and
said so. Try it small: ``--runs 200 --steps 100 --peer-runs 2``.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from benchmarks import peers
from benchmarks.peers import Runs
from jaxfilt.models.car import DT, Bicycle, Driving
from jaxfilt.scenarios import scenario
from jaxfilt.study import study

CAR = scenario("car")
FILTERS = {"EKF": jf.ekf, "UKF": jf.ukf}
BOTH = " + ".join(FILTERS)

BATCH = 1000
"""Runs in one call of a filter under vmap: the means of all of them are kept, (batch, T, 4)."""

NOTES = """\
- One machine, {cores} cores, {dtype}, {versions}. `*`: {few} runs timed, times {factor:g}.
- jaxfilt, study: simulation of the truths and readings, both filters and all scores. The others: the filters and the
  RMSE alone, on readings simulated before the clock starts; under vmap in batches of {batch} runs.
- RMSE of position (m), yaw (rad) and speed (m/s), of all on the same {few} runs.
- dynamax takes a reading of all sensors in every row: where GNSS is silent its variance is {unseen:g} m^2. Its filters
  start with an update, so they get the first prediction from jaxfilt.
- filterpy: Jacobians written by hand, plain `math` in f; where GNSS and odometer share a row, one update with both.
- In the peers yaw is an ordinary number (it stays within a turn on this drive); jaxfilt wraps it."""


class Timing(NamedTuple):
    """Seconds to compile and to run ``runs`` runs, and the RMSE of position, yaw, speed."""

    compile: float
    run: float
    runs: int
    rmse: list[float] | None = None


def theta() -> Any:
    """The scenario's parameters as arrays of JAX's default dtype."""
    return jax.tree.map(jnp.asarray, CAR.theta)


def flat(x: Bicycle) -> jax.Array:
    """The car's state as (..., 4): x, y, yaw, speed."""
    return jnp.concatenate([x.pos, x.yaw[..., None], x.speed[..., None]], axis=-1)


def simulator(steps: int, jit: bool = True) -> Callable[[jax.Array], Runs]:
    """Function of run numbers (N,) that simulates these runs; for use inside a larger program without ``jit``."""
    plan, key = CAR.schedule(steps), jax.random.key(1)

    def one(theta: Any, number: jax.Array) -> Runs:
        belief, key_of_run = CAR.belief(theta), jax.random.fold_in(key, number)
        truth, log = jf.simulate(CAR.model(theta), belief, plan, key_of_run, CAR.control)
        return Runs(flat(truth), jnp.stack(log.u, axis=1), log.z["gnss"], log.z["odometer"])

    batch = jax.vmap(one, in_axes=(None, 0))
    if not jit:
        return lambda numbers: batch(theta(), numbers)
    program = jax.jit(batch)
    return lambda numbers: jax.block_until_ready(program(theta(), numbers))


def squares(truth: Any, mean: Any) -> jax.Array:
    """Sums over all steps (and runs) of the squared errors of position, yaw and speed: (3,)."""
    e = truth - mean
    return jnp.stack([jnp.sum(e[..., :2] ** 2), jnp.sum(jf.wrap(e[..., 2]) ** 2), jnp.sum(e[..., 3] ** 2)])


def studied(steps: int, runs: int, **how: Any) -> Timing:
    """The study: one program for both filters. ``how``: arguments of `study`."""
    filters = {name: (lambda theta, build=build: build(CAR.model(theta))) for name, build in FILTERS.items()}
    found = study(
        CAR.model, filters, CAR.belief, CAR.schedule(steps), jax.random.key(0),
        theta=CAR.theta, runs=runs, blocks=CAR.blocks, control=CAR.control, **how,
    )  # fmt: skip
    return Timing(found.compile_seconds, found.run_seconds, runs)


def ours(name: str, steps: int) -> Callable[..., jax.Array]:
    """Function of one run's (u, gnss, odometer) that returns the means (T, 4) by jaxfilt."""
    plan, filt, belief = CAR.schedule(steps), FILTERS[name](CAR.model(theta())), CAR.belief(theta())

    def means(u: jax.Array, gnss: jax.Array, odometer: jax.Array) -> jax.Array:
        log = plan._replace(u=Driving(u[:, 0], u[:, 1]), z={"gnss": gnss, "odometer": odometer})
        return flat(jf.scan(filt, belief, log, jf.mean_only))

    return means


def dynamax(name: str, steps: int) -> Callable[..., jax.Array]:
    """The same by dynamax."""
    plan = CAR.schedule(steps)
    first = Driving(*[jnp.asarray(a[0]) for a in plan.u])
    belief = FILTERS[name](CAR.model(theta())).predict(CAR.belief(theta()), first, DT)
    return peers.dynamax(name, flat(belief.mean), belief.cov, plan.valid["gnss"])


def vmapped(means: Callable[..., jax.Array], steps: int, total: int, few: Runs) -> Timing:
    """A filter under jit and vmap, reduced to sums of squared errors inside, batch after batch of new runs.

    The last batch is a full one too, for another size would compile again, and its time is counted in proportion.
    """
    size, simulate = min(BATCH, total), simulator(steps)
    batch = jax.jit(jax.vmap(lambda truth, *readings: squares(truth, means(*readings))))

    def timed(runs: Runs) -> float:
        begun = time.perf_counter()
        jax.block_until_ready(batch(*runs))
        return time.perf_counter() - begun

    cold, seconds = timed(simulate(jnp.arange(size))), 0.0
    for done in range(0, total, size):
        seconds += timed(simulate(jnp.arange(done, done + size))) * min(1.0, (total - done) / size)
    found = np.sqrt(np.asarray(batch(*few)).sum(axis=0) / np.size(few.odometer))
    return Timing(max(cold - seconds * size / total, 0.0), seconds, total, found.tolist())


def looped(name: str, steps: int, few: Runs) -> Timing:
    """filterpy over a few runs."""
    begun = time.perf_counter()
    means = peers.filterpy(name, few, CAR.schedule(steps).valid["gnss"])
    seconds = time.perf_counter() - begun
    found = np.sqrt(np.asarray(squares(few.truth, means)) / np.size(few.odometer))
    return Timing(0.0, seconds, len(few.truth), found.tolist())


def line(who: str, what: str, timing: Timing, runs: int, reference: Timing) -> str:
    """A row of the table, brought to this number of runs and compared with the reference."""
    seconds = timing.run * runs / timing.runs
    cells = [
        who,
        what,
        f"{timing.compile:.1f}" if timing.compile else "",
        f"{seconds:.4g}{'*' if timing.runs < runs else ''}",
        f"{runs / seconds:.3g}",
        f"{seconds / reference.run:.3g}",
        ", ".join(f"{e:.6f}" for e in timing.rmse or []),
    ]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Print the table and what its numbers are."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--steps", type=int, default=1_000)
    parser.add_argument("--peer-runs", type=int, default=4, help="runs in filterpy's loop, then extrapolated")
    parser.add_argument("--float32", action="store_true", help="in JAX")
    sizes = parser.parse_args()
    jax.config.update("jax_enable_x64", not sizes.float32)
    steps, runs = sizes.steps, sizes.runs

    few = jax.device_get(simulator(steps)(jnp.arange(sizes.peer_runs)))
    contestants: dict[str, Callable[[str], Timing]] = {
        "jaxfilt, vmap": lambda name: vmapped(ours(name, steps), steps, runs, few),
        "dynamax, vmap": lambda name: vmapped(dynamax(name, steps), steps, runs, few),
        "filterpy, loop": lambda name: looped(name, steps, few),
    }
    missing = [name for name in ("dynamax", "filterpy") if importlib.util.find_spec(name) is None]
    packages = [name for name in ("jax", "numpy", "dynamax", "filterpy") if name not in missing]

    print(f"| {runs} runs x {steps} steps | filter | compile (s) | run (s) | runs/s | times the study's | RMSE |")
    print("|" + "---|" * 7)
    whole = studied(steps, runs)
    print(line("jaxfilt, study", BOTH, whole, runs, whole), flush=True)
    for who, timing in contestants.items():
        if who.split(",")[0] in missing:
            continue
        timings = {name: timing(name) for name in FILTERS}
        a, b = timings.values()
        for name, one in (timings | {BOTH: Timing(a.compile + b.compile, a.run + b.run, a.runs)}).items():
            print(line(who, name, one, runs, whole), flush=True)
    print()
    for name in missing:
        print(f"- {name} is not installed and left out: pip install jaxfilt[bench]")
    print(
        NOTES.format(
            cores=os.cpu_count(),
            dtype="float32 (filterpy in float64)" if sizes.float32 else "float64",
            versions=", ".join(f"{name} {importlib.metadata.version(name)}" for name in packages),
            few=sizes.peer_runs,
            factor=runs / sizes.peer_runs,
            batch=min(BATCH, runs),
            unseen=peers.UNSEEN,
        )
    )


if __name__ == "__main__":
    main()
