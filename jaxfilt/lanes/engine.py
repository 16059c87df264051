"""A compiled loop on arrays in memory, and its strict form for the runs that broke what the first one assumed."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from jaxfilt.lanes.graph import KINDS
from jaxfilt.lanes.kernel import Kernel
from jaxfilt.lanes.pages import prefer_large
from jaxfilt.lanes.program import Leaf, Program
from jaxfilt.lanes.trace import Assumed

Arrays = list[np.ndarray]


class Sizes(NamedTuple):
    """Of a call: ``few`` is how many runs those outputs have that are kept of the first runs only."""

    runs: int
    steps: int
    few: int


class Runner(Protocol):
    """Something that computes all runs at once, as well as it may."""

    def __call__(self, operands: Arrays, results: Arrays, sizes: Sizes) -> np.ndarray:
        """Fill the results; which runs (runs,) are not to be trusted."""
        ...


class Operand(NamedTuple):
    """An array that is read: its kind's dtype, shape of one run, whether all runs share it."""

    dtype: np.dtype
    shape: tuple[int, ...]
    shared: bool

    def at(self, address: int, runs: int) -> np.ndarray:
        """The array at an address."""
        return viewed(address, self.dtype, self.shape if self.shared else (runs, *self.shape))


class Result(NamedTuple):
    """An array that is written: shape of one run or, if ``summed``, of all; ``few``: of the first runs only."""

    dtype: np.dtype
    shape: tuple[int, ...]
    summed: bool = False
    few: bool = False

    def whole(self, sizes: Sizes) -> tuple[int, ...]:
        """The shape for so many runs."""
        return self.shape if self.summed else (sizes.few if self.few else sizes.runs, *self.shape)


class Engine:
    """What is called with addresses: the fast form for all runs, the strict one for those that need it."""

    def __init__(
        self, operands: list[Operand], results: list[Result], fast: Runner, strict: Callable[[], Runner]
    ) -> None:
        self.operands, self.results, self.fast, self._make_strict = operands, results, fast, strict
        self._strict: Runner | None = None

    def __call__(self, reads: list[int], writes: list[int], sizes: Sizes) -> None:
        """Compute: from arrays at these addresses to arrays at those."""
        operands = [o.at(address, sizes.runs) for o, address in zip(self.operands, reads, strict=True)]
        results = [viewed(address, r.dtype, r.whole(sizes)) for r, address in zip(self.results, writes, strict=True)]
        for address, a in zip(writes, results, strict=True):
            prefer_large(address, a.nbytes)
        doubtful = self.fast(operands, results, sizes)
        if doubtful.any():
            self._again(doubtful, operands, results, sizes)

    def _again(self, doubtful: np.ndarray, operands: Arrays, results: Arrays, sizes: Sizes) -> None:
        """Compute the doubtful runs strictly; sums, in which they have been, anew without them."""
        if self._strict is None:
            self._strict = self._make_strict()
        parts = [(self._strict, np.flatnonzero(doubtful))]
        sums = [k for k, r in enumerate(self.results) if r.summed]
        if sums:
            parts.append((self.fast, np.flatnonzero(~doubtful)))
            for k in sums:
                results[k][...] = 0
        for runner, chosen in parts:
            if not len(chosen):
                continue
            own = Sizes(len(chosen), sizes.steps, int((chosen < sizes.few).sum()))
            some = [a if o.shared else a[chosen] for o, a in zip(self.operands, operands, strict=True)]
            found = [np.empty(r.whole(own), r.dtype) for r in self.results]
            runner(some, found, own)
            for r, into, a in zip(self.results, results, found, strict=True):
                if r.summed:
                    into += a
                else:
                    into[chosen[: len(a)]] = a


class Single:
    """One program; the number that tells of its health stays inside."""

    def __init__(self, program: Program, assumed: Assumed) -> None:
        self.kernel, self.leaves = Kernel(program), program.leaves
        self.sources = len(program.sources)
        self.assumed = assumed
        self.expected = [_expected(leaf) for leaf in program.leaves]

    def __call__(self, operands: Arrays, results: Arrays, sizes: Sizes, threads: int | None = None) -> np.ndarray:
        sources, start = operands[: self.sources], operands[self.sources :]
        doubtful = self._unequal(start, sizes.runs)
        health = self.assumed.health
        own = [] if health is None else [np.zeros(1, KINDS[self.leaves[health].kind])]
        final = [] if health is None else [np.empty((sizes.runs, 1), own[0].dtype)]
        carried = len(self.leaves) - len(own)
        self.kernel.run(sources, start + own, results[:carried] + final, results[carried:], *sizes, threads)
        for a in final:
            doubtful |= ~np.isfinite(a[:, 0])
        for a, elements in zip(results, self.assumed.sound, strict=False):
            if elements:
                doubtful |= ~np.isfinite(a.reshape(sizes.runs, -1)[:, list(elements)]).all(1)
        return doubtful

    def _unequal(self, start: Arrays, runs: int) -> np.ndarray:
        """Runs whose start is not what the program takes for granted of it."""
        doubtful = np.zeros(runs, bool)
        for a, expected in zip(start, self.expected, strict=False):
            if expected is not None:
                flat = a.reshape(-1, len(expected.origin))
                doubtful |= (flat != np.where(expected.fixed, expected.constants, flat[:, expected.origin])).any(1)
        return doubtful


class Expected(NamedTuple):
    """What a leaf is taken to start with: each element as that of its ``origin`` or, where ``fixed``, a constant."""

    origin: np.ndarray
    fixed: np.ndarray
    constants: np.ndarray


def _expected(leaf: Leaf) -> Expected | None:
    """None where nothing is taken for granted."""
    first: dict[int, int] = {}
    origin = np.array([first.setdefault(slot, e) if slot >= 0 else -1 for e, slot in enumerate(leaf.slots)], int)
    if (origin == np.arange(len(origin))).all():
        return None
    return Expected(np.maximum(origin, 0), origin < 0, np.array(leaf.constants, KINDS[leaf.kind]))


def viewed(address: int, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    """The array of this shape at an address."""
    size = int(np.prod(shape, dtype=int)) * dtype.itemsize
    if size == 0:
        return np.empty(shape, dtype)
    return np.ctypeslib.as_array((ctypes.c_ubyte * size).from_address(address)).view(dtype).reshape(shape)
