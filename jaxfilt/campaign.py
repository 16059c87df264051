"""Many chunks, one after the other: over threads or devices, kept in a folder, interrupted and resumed."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxfilt import checkpoint
from jaxfilt.chunk import Chunk, Each, Program, compiled, placed
from jaxfilt.task import Task
from jaxfilt.totals import Records, Totals, added, totals


class Outcome(NamedTuple):
    """What came of it: ``totals``, with fewer runs than asked for where it was interrupted."""

    totals: Totals
    interrupted: bool
    compile_seconds: float
    run_seconds: float


def run(
    task: Task, out: str | Path | None = None, resume: bool = False, progress: Callable[[int, int], Any] | None = None
) -> Outcome:
    """Run the task, from where a checkpoint in ``out`` left it if ``resume``.

    Raises:
        KeyboardInterrupt: before the first chunk is done; later, what is done is returned.
    """
    began = time.perf_counter()
    arguments = (task.theta, task.truth_theta, task.log, task.key)
    example = (*arguments, np.zeros(task.chunk, np.int32), _weights(task, np.zeros(task.chunk, bool)))
    leaves, structure = jax.tree.flatten(jax.eval_shape(lambda *a: a, *example))
    program = compiled(task.plan, task.devices, structure, tuple(leaves))
    about = task.about | {"chunk": task.chunk, "devices": len(task.devices), "program": program.digest}
    state, book = None, None
    if out is not None and resume:
        state = checkpoint.load(Path(out), about, _structure(program))
    if out is not None and jax.process_index() == 0:
        book = checkpoint.begin(Path(out), about, task.runs, resume)
    arguments = placed(task.plan, task.devices, arguments)
    done = 0 if state is None else int(state.done)
    ready = time.perf_counter()
    if progress:
        progress(done, task.runs)
    interrupted = False
    # Ctrl-C strikes the main thread alone: what another one has begun to write is written whole.
    with ThreadPoolExecutor(1) as writer:
        try:
            for part in _parts(task, program, arguments, done):
                state = part if state is None else added(state, part, task.sample)
                if book is not None:
                    writer.submit(checkpoint.save, book, state, int(state.done)).result()
                if progress:
                    progress(int(state.done), task.runs)
        except KeyboardInterrupt:
            if state is None:
                raise
            interrupted = True
    assert state is not None
    return Outcome(state, interrupted, ready - began, time.perf_counter() - ready)


def _structure(program: Program) -> Any:
    """That of the totals, from what the program returns."""
    tree = program.call.out_tree
    chunk: Chunk = jax.tree.unflatten(tree, range(tree.num_leaves))
    records = Records(*range(len(Records._fields)))
    return jax.tree.structure(Totals(0, chunk.sums, chunk.sums, records, 0, 0, 0, chunk.examples))


def _weights(task: Task, counts: np.ndarray) -> np.ndarray:
    """Which runs count for which filter, (R, F); with a sweep (settings, R, F)."""
    shape = (*counts.shape, len(task.plan.filters))
    weights = np.broadcast_to(counts[:, None], shape)
    return np.broadcast_to(weights, (task.settings, *shape)) if any(task.plan.swept) else weights


def _parts(task: Task, program: Program, arguments: tuple, done: int) -> Iterator[Totals]:
    """The totals of one chunk after the other, in order, with a few under way at a time."""
    part = lambda first: _part(task, program, arguments, first)  # noqa: E731
    with ThreadPoolExecutor(task.workers) as pool:
        waiting = deque()
        try:
            for first in range(done, task.runs, task.chunk):
                waiting.append(pool.submit(part, first))
                if len(waiting) > task.workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _part(task: Task, program: Program, arguments: tuple, first: int) -> Totals:
    numbers = np.arange(first, first + task.chunk)
    counts = numbers < task.runs
    weights = _weights(task, counts)
    chunk = _called(task, program, arguments, numbers, weights)
    each: Each = jax.device_get(chunk.each)
    if not each.diverged[..., counts, :].any():
        return totals(jax.device_get(chunk), numbers, counts)
    # Who diverged is known at the end of a run, when its rows are summed up already: the rest is summed once more.
    kept = _called(task, program, arguments, numbers, weights & ~each.diverged).sums
    return totals(jax.device_get(chunk), numbers, counts, jax.device_get(kept))


def _called(task: Task, program: Program, arguments: tuple, numbers: np.ndarray, weights: np.ndarray) -> Chunk:
    own = placed(task.plan, task.devices, (numbers.astype(np.int32), weights), first=len(arguments))
    return program.call(*arguments, *own)
