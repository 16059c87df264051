"""Whole trajectories: ``python -m benchmarks.graph`` prints the filter, the smoother and the factor graph side by side.

Robots of `utias_mrclam` and runs of `nclt_1hz` with the README's filters, gates and noises: nothing is tuned for the
graph. Then loops of simulated odometry, closed each time the robot comes by. Needs the recordings at
``$JAXFILT_DATA``. Computes in float64; some minutes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from benchmarks.machine import Use, facts, peak_memory
from jaxfilt import graph, recordings
from jaxfilt.models.wheeled import INDOOR_ROBOT, Odometry, Pose, unicycle
from jaxfilt.smooth import smooth

RECORDINGS = {"utias_mrclam": ("1", "2", "3", "4", "5"), "nclt_1hz": ("2013-01-10", "2013-02-23", "2013-04-05")}

ROBUST = 0.9
"""As in `benchmarks.recordings`."""

TURN = 0.003
"""rad/sqrt(s): wheels that hold their heading to 3.4 degrees over a lap."""

LAPS, SPACING = 400, 50
"""Rows of a lap, and of 1 s each between closures."""


def timed(function: Callable, *arguments: Any) -> tuple[Any, float, float]:
    """What it returns, seconds of the first call, seconds of the second."""
    program = jax.jit(function)
    began = time.perf_counter()
    jax.block_until_ready(program(*arguments))
    again = time.perf_counter()
    result = jax.block_until_ready(program(*arguments))
    end = time.perf_counter()
    return result, (again - began) - (end - again), end - again


def recorded() -> None:
    """RMSE of the position, m."""
    print("| recording | rows | filter | smoother | graph | robust graph | evaluations | compile (s) | run (s) |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name, sequences in RECORDINGS.items():
        for sequence in sequences:
            replay = recordings.replay(name, sequence)
            model, log = replay.model(replay.theta), replay.recording.log
            gated = jf.ekf(model, gate=recordings.GATES[name])
            begin = replay.belief(replay.theta)

            def back(b: Any, log: Any, filt: Any = gated) -> Any:
                track = jf.scan(filt, b, log)
                return track.belief.mean, smooth(filt, track, log).belief.mean

            ahead, smoothed = jax.jit(back)(begin, log)
            found, compiling, running = timed(lambda b, l, f=gated: graph.optimise(f, b, l), begin, log)
            weak = jf.ekf(model, robust=ROBUST)
            weakened = jax.jit(lambda b, l, f=weak: graph.optimise(f, b, l, robust=ROBUST))(begin, log)
            errors = [
                recordings.rmse(replay, mean)["position"]
                for mean in (ahead, smoothed, found.belief.mean, weakened.belief.mean)
            ]
            if not (found.converged and weakened.converged):
                print(f"not converged: {found.converged}, {weakened.converged}")
            cells = " | ".join(f"{e:.3f}" for e in errors)
            times = f"{compiling:.1f} | {running:.2f}"
            print(f"| {name} {sequence} | {len(log.dt)} | {cells} | {found.evaluations} | {times} |")


def laps(steps: int, seed: int = 0) -> tuple[Any, Any, Any, graph.Between]:
    """Circles of 32 m radius by odometry alone; each `SPACING` rows the robot sees where it was a lap ago."""
    model, rng = unicycle({**INDOOR_ROBOT, "turn": np.log(TURN)}), np.random.default_rng(seed)
    u = Odometry(np.full(steps, 0.5), np.full(steps, 2 * np.pi / LAPS))
    log = jf.Log(np.ones(steps), u, {}, {}, {})
    cov = jnp.diag(jnp.asarray([1e-4, 1e-4, 1e-4]))
    begin = jf.Gaussian(Pose(jnp.zeros(2), jnp.zeros(())), 1e-6 * jnp.eye(3))

    def drive(x: Pose, noise: Any) -> tuple[Pose, Pose]:
        u = Odometry(jnp.asarray(0.5), jnp.asarray(2 * np.pi / LAPS))
        L = jnp.linalg.cholesky(model.Q(x, u, jnp.ones(())))
        x = model.space.plus(model.f(x, u, jnp.ones(())), L @ noise)
        return x, x

    truth = jax.lax.scan(drive, begin.mean, jnp.asarray(rng.normal(size=(steps, 3))))[1]
    rows = np.array([(k - LAPS, k) for k in range(LAPS + SPACING - 1, steps, SPACING)])
    tie = graph.planar(rows, Pose(np.zeros((len(rows), 2)), np.zeros(len(rows))), cov)
    a, b = (jax.tree.map(lambda x, r=r: x[r], truth) for r in rows.T)
    seen = jax.vmap(tie.space.plus)(
        jax.vmap(lambda a, b: tie.h(a, b, ()))(a, b), jnp.asarray(0.01 * rng.normal(size=(len(rows), 3)))
    )
    return jf.ekf(model), begin, (log, truth), tie._replace(z=seen)


def simulated() -> None:
    """Odometry alone, and with its loops closed."""
    print(
        "| poses | closures | RMSE without (m) | with (m) | evaluations | compile (s) | run (s) | peak memory (MiB) |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for steps in (1_000, 3_000, 10_000):
        filt, begin, (log, truth), tie = laps(steps)
        alone, _, _ = timed(lambda b, l, f=filt: graph.optimise(f, b, l), begin, log)
        found, compiling, running = timed(lambda b, l, f=filt, t=tie: graph.optimise(f, b, l, [t]), begin, log)
        off = [float(jnp.sqrt(jnp.mean(jnp.sum((x.belief.mean.pos - truth.pos) ** 2, 1)))) for x in (alone, found)]
        status = "" if found.converged else " (not converged)"
        print(
            f"| {steps} | {len(tie.rows)} | {off[0]:.2f} | {off[1]:.2f} | {found.evaluations}{status} | "
            f"{compiling:.1f} | {running:.2f} | {peak_memory():.0f} |"
        )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(facts())
    use = Use.now()
    simulated()
    recorded()
    print(f"others kept {use.others():.1f} cores busy meanwhile")
