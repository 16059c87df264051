"""Studies: is a filter consistent, and how good is it? Over thousands of simulated runs.

A study simulates, filters and scores many runs in one compiled program. It compiles functions of the parameters
theta, never a built model: other parameters compile nothing new.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxfilt.campaign import run
from jaxfilt.consistency import CONFIDENCE
from jaxfilt.credibility import noncredibility
from jaxfilt.fold import itself
from jaxfilt.loop import Backend
from jaxfilt.metrics import Blocks
from jaxfilt.mismatch import Corruption
from jaxfilt.scores import Diverged, Fault, Paired, Scores, Worst, paired, scores
from jaxfilt.streaming import NO_FAULT
from jaxfilt.tally import Sums, every
from jaxfilt.task import Filters, Options, Task, seed, task_of
from jaxfilt.totals import NOBODY, Records, Totals
from jaxfilt.types import Array, Gaussian, Log, Model, PyTree, Space, Status
from jaxfilt.verdict import Verdict, verdicts


class Study(NamedTuple):
    """What `study` returns: plain NumPy and numbers.

    By filter: ``verdicts`` in words; ``scores`` over all runs, as far as they are finite; ``kept`` over the runs that
    did not diverge (the same where none did); ``diverged``; ``faults``, None where nothing went wrong; ``tracks``, the
    beliefs of the first runs, leading axes (examples, T). ``paired``: by (filter, filter), their difference on the same
    noise.

    ``truth`` (examples, T, ...) of the first runs. ``t`` (T,) s since the start. ``space`` and ``blocks`` of the
    filters' state. ``runs`` that were done, of ``planned``. ``seed`` makes the key again, ``jax.random.key(seed)``, for
    JAX's default generator. ``sample``: of how many runs the noncredibility is. ``confidence`` of all bounds.
    ``compile_seconds`` is near 0 where the program was there already.
    """

    verdicts: dict[str, Verdict]
    scores: dict[str, Scores]
    kept: dict[str, Scores]
    diverged: dict[str, Diverged]
    faults: dict[str, Fault | None]
    paired: dict[tuple[str, str], Paired]
    truth: PyTree
    tracks: dict[str, Gaussian]
    t: np.ndarray
    space: Space
    blocks: Blocks
    theta: PyTree
    truth_theta: PyTree
    runs: int
    planned: int
    steps: int
    seed: int
    dtype: str
    confidence: float
    chunk: int
    workers: int
    devices: int
    sample: int
    compile_seconds: float
    run_seconds: float


class Interrupted(KeyboardInterrupt):
    """Ctrl-C; ``result`` is what was found: a `Study` (or a `Sweep`) of fewer runs, a `Fit` of fewer steps."""

    def __init__(self, result: Any) -> None:
        super().__init__("interrupted")
        self.result = result


def study(
    model: Callable[[PyTree], Model],
    filters: Filters,
    belief: Callable[[PyTree], Gaussian],
    log: Log,
    key: Array,
    *,
    theta: PyTree,
    truth_theta: PyTree = None,
    runs: int = 1000,
    control: Callable[[PyTree, PyTree], PyTree] | None = None,
    corrupt: Callable[[PyTree], Corruption] | None = None,
    truth_belief: Callable[[PyTree], Gaussian] | None = None,
    view: Callable[[PyTree], PyTree] = itself,
    blocks: Blocks | None = None,
    confidence: float = CONFIDENCE,
    chunk: int | None = None,
    workers: int | None = None,
    devices: Sequence[Any] | None = None,
    examples: int = 1,
    sample: int = 100,
    lags: int = 10,
    out: str | Path | None = None,
    resume: bool = False,
    progress: Callable[[int, int], Any] | None = None,
    backend: Backend = "auto",
) -> Study:
    """Monte Carlo study: simulate runs, run every filter on the same truth and readings, score them.

    Each run draws its start from ``truth_belief(truth_theta)`` and its noises from ``model(truth_theta)``; the filters
    start at ``belief(theta)`` and know ``theta``. Run number i has the key ``fold_in(key, i)``, whatever the chunk and
    the devices. Only sums leave a chunk: memory does not grow with the number of runs.

    The functions are compiled once for all parameters; give the same functions again (not a new lambda) and a second
    study compiles nothing.

    Args:
        model: theta -> model of what is simulated; the filters' own models may differ.
        filters: name -> (theta -> filter), all on one state space.
        belief: theta -> Gaussian where the filters start.
        log: the schedule, see `jaxfilt.schedule`.
        key: of `jax.random`.
        theta: parameters that the filters assume.
        truth_theta: parameters of the truth; default theta.
        runs: how many, >= 1.
        control: as in `jaxfilt.simulate`. Without it, all runs share their inputs.
        corrupt: truth_theta -> (truth, log, key) -> log: what happens to a run's readings, see `jaxfilt.mismatch`.
        truth_belief: theta -> Gaussian that the true start is drawn from; default ``belief``.
        view: true state -> state of the filters, where the truth has more to it.
        blocks: name -> (indices of the tangent vector, unit), what is scored apart; default each component by itself.
        confidence: probability of all two-sided bounds.
        chunk: runs in one call of the program; default by memory.
        workers: threads that call it; default 2 on a CPU with more than one core, otherwise 1.
        devices: over which the runs of a chunk are spread; default all, also those of other processes.
        examples: how many of the first runs to keep whole.
        sample: how many of the first runs to take the noncredibility from.
        lags: of the innovations' autocorrelation, in readings.
        out: folder to keep the state in, after each chunk.
        resume: go on with the study in ``out``, to as many runs as asked for now.
        progress: called with (runs done, runs) when the program is compiled and after each chunk.
        backend: as in `jaxfilt.scan_runs`; over several devices XLA computes.

    Returns:
        `Study`. The same arguments give the same numbers, bit for bit, whatever the number of workers and however often
        it was interrupted; another chunk or other devices change the rounding of sums.

    Raises:
        ValueError, TypeError, KeyError: naming the argument, what was expected and what came.
        FileExistsError: ``out`` holds another study that is not finished. OSError: it cannot be written.
        Interrupted: Ctrl-C, with what was done.

    Example: a filter on its own model is consistent.
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> def walk(theta):
        ...     return jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1) * theta, R=jnp.eye(1))
        >>> def start(theta):
        ...     return jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> log = jf.schedule(walk(1.0), steps=50, dt=1.0)
        >>> filters = {"kf": lambda theta: jf.kf(walk(theta))}
        >>> found = study(walk, filters, start, log, jax.random.key(0), theta=1.0, runs=100)
        >>> nees = found.scores["kf"].nees_total["state"]
        >>> nees.expected, nees.low < nees.mean < nees.high
        (1.0, True)
    """
    options = Options(
        runs, control, corrupt, truth_belief, view, blocks, confidence, chunk, workers, devices, examples, sample, lags,
        out, resume, progress, backend,
    )  # fmt: skip
    truth_theta = theta if truth_theta is None else truth_theta
    (result,), interrupted = conducted(
        model, filters, belief, log, key, [(theta, truth_theta)], (False, False), options
    )
    if interrupted:
        raise Interrupted(result)
    return result


def conducted(
    model: Callable[[PyTree], Model],
    filters: Filters,
    belief: Callable[[PyTree], Gaussian],
    log: Log,
    key: Array,
    settings: Sequence[tuple[PyTree, PyTree]],
    swept: tuple[bool, bool],
    options: Options,
) -> tuple[list[Study], bool]:
    """One study for each setting (theta, truth theta), on the same noise; and whether they were interrupted.

    ``swept``: which of the two differ between settings; what does not is computed once for all of them.
    """
    task = task_of(model, filters, belief, log, key, settings, swept, options)
    outcome = run(task, options.out, options.resume, options.progress)
    totals = outcome.totals
    t = np.cumsum(np.asarray(log.dt, np.float64))
    studies = []
    for i, (theta, truth_theta) in enumerate(settings):
        part = jax.tree.map(lambda a, i=i: a[i], totals._replace(done=())) if any(swept) else totals
        found = _found(task, part)
        judged = {name: found[name] for name in ("scores", "diverged", "faults")}
        words = verdicts(**judged, blocks=task.blocks, t=t, confidence=task.confidence, runs=int(totals.done))
        studies.append(
            Study(
                verdicts=words,
                **found,
                truth=part.examples.truth,
                tracks={name: part.examples.tracks[name] for name in filters},  # in their order, which JAX sorted
                t=t,
                space=task.space,
                blocks=task.blocks,
                theta=theta,
                truth_theta=truth_theta,
                runs=int(totals.done),
                planned=options.runs,
                steps=len(log.dt),
                seed=seed(key),
                dtype=str(task.dtype),
                confidence=options.confidence,
                chunk=task.chunk,
                workers=task.workers,
                devices=len(task.devices),
                sample=totals.nees.shape[-1],
                compile_seconds=outcome.compile_seconds,
                run_seconds=outcome.run_seconds,
            )
        )
    return studies, outcome.interrupted


def _found(task: Task, totals: Totals) -> dict[str, dict]:
    """The fields of `Study` that the totals of one setting hold."""
    names, r = [name for name, _ in task.plan.filters], totals.records
    found: dict[str, dict] = {"scores": {}, "kept": {}, "diverged": {}, "faults": {}, "paired": {}}
    for f, name in enumerate(names):
        found["scores"][name] = _scores(task, totals, f, totals.all, r.worst[f], r.worst_run[f], totals.nees[f])
        kept_nees = np.where(totals.lost[:, f], np.nan, totals.nees[f])
        found["kept"][name] = _scores(task, totals, f, totals.kept, r.kept_worst[f], r.kept_worst_run[f], kept_nees)
        first = tuple(int(run) for run in r.named[f] if run != NOBODY)
        found["diverged"][name] = Diverged(int(r.diverged[f]), first)
        found["faults"][name] = _fault(r, f, task.sensors)
    for k, (a, b) in enumerate(zip(*np.triu_indices(len(names), 1), strict=True)):
        differences = jax.tree.map(lambda x, k=k: x[k], totals.kept.paired)
        found["paired"][names[a], names[b]] = paired(differences, task.blocks)
    return found


def _scores(
    task: Task, totals: Totals, f: int, sums: Sums, square: np.ndarray, run_of: np.ndarray, nees: np.ndarray
) -> Scores:
    """Those of filter number f over one of the two sets of runs."""
    own = jax.tree.map(lambda a: a[f], sums._replace(paired=()))
    worst = {b: Worst(float(np.sqrt(square[k])), int(run_of[k])) for k, b in enumerate(task.blocks)}
    credible = _credible(totals.error[f], nees, own.outer, own.rows["error"].number[:, 0], task.steps)
    return scores(own, task.blocks, task.space.dim, task.confidence, worst, credible)


def _credible(error: np.ndarray, nees: np.ndarray, outer: np.ndarray, count: np.ndarray, steps: int) -> tuple:
    """Noncredibility index and inclination (T,) of a sample (rows, runs, n) at some rows, NaN at the others."""
    step = every(steps)
    some = slice(step - 1, None, step)
    mse = outer[some] / np.maximum(count[some], 1)[:, None, None]
    result = np.full((2, steps), np.nan)
    result[:, some] = noncredibility(np.swapaxes(error, 0, 1), nees.T, mse)
    return tuple(result)


def _fault(r: Records, f: int, sensors: Sequence[str]) -> Fault | None:
    if r.fault[f] == NO_FAULT:
        return None
    step, sensor = divmod(int(r.fault[f]), len(sensors))
    return Fault(int(r.fault_run[f]), step, sensors[sensor], Status(int(r.status[f])), int(r.faulty[f]))
