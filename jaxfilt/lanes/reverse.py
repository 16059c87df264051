"""Reverse mode of a compiled loop: forward with each row's carry kept, then backward, a few runs at a time."""

from __future__ import annotations

import threading
from typing import NamedTuple

import numpy as np

from jaxfilt.lanes.engine import Arrays, Operand, Result, Single, Sizes
from jaxfilt.lanes.kernel import cores, each

MEMORY = 32e6
"""Bytes that one thread may keep of its runs' way forward, about."""


class Counts(NamedTuple):
    """How many arrays of each sort the operands are, in this order: ``constants``, ``rows``, ``start``, the cotangents
    of the carry (its ``floats``) and the rest, those of the outputs. ``sums``: of how many constants the cotangent is
    asked for."""

    constants: int
    rows: int
    start: int
    floats: int
    sums: int


class Pair:
    """The two programs that are reverse mode; see `jaxfilt.lanes.derive.saving` and `pulling`.

    Results: cotangents of the start's floats and of some constants, of each run, then those of some rows.
    """

    def __init__(
        self,
        forth: Single,
        back: Single,
        counts: Counts,
        operands: list[Operand],
        results: list[Result],
        kept: list[Result],
    ) -> None:
        """``kept``: what a run keeps of a row, for each array of the carry."""
        self.forth, self.back, self.counts = forth, back, counts
        self.operands, self.results, self.kept = operands, results, kept

    def __call__(self, operands: Arrays, results: Arrays, sizes: Sizes) -> np.ndarray:
        doubtful = np.zeros(sizes.runs, bool)
        for r, a in zip(self.results, results, strict=True):
            if r.summed:
                a[...] = 0
        lock = threading.Lock()

        def piece(bounds: tuple[int, int]) -> None:
            own = slice(*bounds)
            some = [a if o.shared else a[own] for o, a in zip(self.operands, operands, strict=True)]
            found = [np.empty_like(a) if r.summed else a[own] for r, a in zip(self.results, results, strict=True)]
            doubtful[own] = self._piece(some, found, Sizes(bounds[1] - bounds[0], sizes.steps, 0))
            with lock:
                for r, into, a in zip(self.results, results, found, strict=True):
                    if r.summed:
                        into += a

        each(piece, self._cut(sizes), cores())
        return doubtful

    def _piece(self, operands: Arrays, results: Arrays, sizes: Sizes) -> np.ndarray:
        c = self.counts
        ends = np.cumsum([c.constants + c.rows, c.start, c.floats])
        sources, start, slope, cotangents = (
            operands[a:b] for a, b in zip([0, *ends], [*ends, len(operands)], strict=True)
        )
        carried = [np.empty((sizes.runs, *o.shape), o.dtype) for o in self.operands[ends[0] : ends[1]]]
        kept = [np.empty((sizes.runs, sizes.steps, *k.shape), k.dtype) for k in self.kept]
        doubtful = self.forth([*sources, *start], [*carried, *kept], sizes, threads=1)
        sums = [np.zeros((sizes.runs, *r.shape), r.dtype) for r in self.results[c.floats : c.floats + c.sums]]
        return doubtful | self.back([*sources, *kept, *cotangents, *slope, *sums], results, sizes, threads=1)

    def _cut(self, sizes: Sizes) -> list[tuple[int, int]]:
        """Pieces of the runs, whole registers of them, for all threads."""
        size = sizes.steps * sum(int(np.prod(k.shape)) * k.dtype.itemsize for k in self.kept)
        most = max(1, int(MEMORY / max(size, 1)))
        lanes = self.forth.kernel.lanes
        step = lanes * max(1, min(most, -(-sizes.runs // cores())) // lanes)
        return [(a, min(a + step, sizes.runs)) for a in range(0, sizes.runs, step)]
