"""A compiled program, called on arrays; blocks of runs are shared out among threads."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import math
import os
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np

from jaxfilt.lanes import machine
from jaxfilt.lanes.emit import ir
from jaxfilt.lanes.graph import KINDS
from jaxfilt.lanes.program import Program
from jaxfilt.lanes.reach import Reach

T = TypeVar("T")

_NAME = "rows"

SHORT = 1200
"""Operations of a row below which a number takes two registers."""

_INLINE = 50_000
"""Vector operations, about, that cost as much as to wake another thread."""

_PIECES = 32
"""Pieces of a call: so many that threads end together, so few that nothing is lost between them."""

_pool: ThreadPoolExecutor | None = None


def cores() -> int:
    """How many threads this process may run at once."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def each(work: Callable[[T], None], items: Iterable[T], threads: int | None = None) -> None:
    """Work on each item, on the caller's thread and on others while they have nothing else to do."""
    waiting = deque(items)

    def some() -> None:
        while True:
            try:
                item = waiting.popleft()
            except IndexError:
                return
            work(item)

    others = [_workers().submit(some) for _ in range((threads or cores()) - 1)]
    try:
        some()
    finally:
        failed = [other.exception() for other in others if not other.cancel()]
    for error in failed:
        if error is not None:
            raise error


@functools.cache
def _compiler() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, "jaxfilt-compiler")


def _workers() -> ThreadPoolExecutor:
    global _pool
    if _pool is None:
        _pool = ThreadPoolExecutor(max(1, cores() - 1), "jaxfilt")
    return _pool


def _forget_workers() -> None:
    """A forked child has none of its parent's threads."""
    global _pool
    _pool = None
    _compiler.cache_clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_workers)


class Kernel:
    """A program compiled for this machine.

    ``lanes`` runs are computed at a time, ``size`` is how many operations a row has, and ``digest`` tells kernels
    apart.

    Args:
        program: what is computed.
        registers: how many of the processor's vector registers a number takes. With two there is more to do while one
            waits, which short rows gain from; long ones lose more by having to move values to memory.
    """

    def __init__(self, program: Program, registers: int | None = None) -> None:
        self.program = program
        graph, live = program.graph, Reach(program).live
        computed = [graph.kind[node] for node in live if graph.op[node] not in ("constant", "input")]
        self.size = len(computed)
        # Some steps of an elementary function are wider than what it is a function of: the many count.
        sizes = Counter(KINDS[kind].itemsize for kind in computed if kind[0] == "f") or Counter([8])
        registers = registers or (2 if self.size < SHORT else 1)
        self.lanes = registers * machine.vector_bytes() // sizes.most_common(1)[0][0]
        self.text = ir(program, self.lanes, _NAME)
        self.digest = hashlib.sha256(self.text.encode()).hexdigest()
        # LLVM works beside XLA, which has the rest of the user's function to compile meanwhile.
        self._code = _compiler().submit(machine.compiled, self.text, _NAME)

    @functools.cached_property
    def _function(self) -> Callable[..., None]:
        return ctypes.CFUNCTYPE(None, *[ctypes.c_int64] * 5, ctypes.c_void_p)(self._code.result().address)

    def __call__(
        self,
        sources: Sequence[np.ndarray],
        start: Sequence[np.ndarray],
        runs: int,
        steps: int,
        few: int = 0,
        threads: int | None = None,
        out: Sequence[np.ndarray] | None = None,
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """The leaves after the last row and the outputs.

        Args:
            sources: C-contiguous, ([runs,] [steps,] size), of the program's kinds.
            start: the leaves before the first row, ([runs,] size).
            runs: how many.
            steps: rows.
            few: the runs of outputs that keep a few, at most ``runs``.
            threads: how many work on it; None for all that the process may use.
            out: where to write the outputs.

        Returns:
            The leaves, (runs, size), and the outputs: (runs, steps // every, size), or summed (steps, size).

        Raises:
            ValueError: an array is not of the size, kind or layout that the program has.
        """
        p = self.program
        if not 0 <= few <= runs:
            raise ValueError(f"expected few from 0 to the {runs} runs, got {few}")
        for source, array in zip(p.sources, sources, strict=True):
            _check(array, (1 if source.shared else runs, steps if source.moving else 1, source.size), source.kind)
        for leaf, array in zip(p.leaves, start, strict=True):
            _check(array, (1 if leaf.shared else runs, len(leaf.slots)), leaf.kind)
        shapes = [
            (steps, len(o.nodes)) if o.summed else (few if o.few else runs, steps // o.every, len(o.nodes))
            for o in p.outputs
        ]
        if out is None:
            out = [np.empty(shape, KINDS[o.kind]) for shape, o in zip(shapes, p.outputs, strict=True)]
        for shape, o, array in zip(shapes, p.outputs, out, strict=True):
            _check(array, shape, o.kind)
        final = [np.empty((runs, len(leaf.slots)), KINDS[leaf.kind]) for leaf in p.leaves]
        self.run(sources, start, final, out, runs, steps, few, threads)
        return final, list(out)

    def run(
        self,
        sources: Sequence[np.ndarray],
        start: Sequence[np.ndarray],
        final: Sequence[np.ndarray],
        outputs: Sequence[np.ndarray],
        runs: int,
        steps: int,
        few: int = 0,
        threads: int | None = None,
    ) -> None:
        """As a call, with the memory of the results given and nothing checked."""
        blocks = -(-runs // self.lanes)
        threads = max(1, min(threads or cores(), blocks))
        if self.size * steps * blocks < _INLINE:
            threads = 1
        summed = [k for k, output in enumerate(self.program.outputs) if output.summed]
        # Sums are added up in an order that does not depend on how many threads there are.
        pieces = min(blocks, _PIECES) if summed or threads > 1 else 1
        parts = [np.zeros((pieces, outputs[k].size), outputs[k].dtype) for k in summed]
        read = [_address(a) for arrays in (sources, start, final) for a in arrays]
        written = [_address(a) for a in outputs]

        def work(piece: int) -> None:
            own = list(written)
            for k, part in zip(summed, parts, strict=True):
                own[k] = _address(part[piece])
            table = (ctypes.c_void_p * (len(read) + len(written)))(*read, *own)
            self._function(blocks * piece // pieces, blocks * (piece + 1) // pieces, runs, steps, few, table)

        each(work, range(pieces), threads)
        for k, part in zip(summed, parts, strict=True):
            outputs[k].reshape(-1)[:] = part.sum(axis=0)


def _address(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


def _check(array: np.ndarray, shape: tuple[int, ...], kind: str) -> None:
    if array.dtype != KINDS[kind] or array.size != math.prod(shape) or not array.flags.c_contiguous:
        raise ValueError(f"expected C-contiguous {KINDS[kind]} of {shape}, got {array.dtype} of {array.shape}")
