"""The loop over time of many runs at once: what a batch is made of, apart from how it is computed."""

from __future__ import annotations

import functools
import importlib.util
import logging
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from jaxfilt.types import PyTree

Backend = Literal["auto", "xla", "lanes"]
T = TypeVar("T")
Body = Callable[[PyTree, PyTree, PyTree], tuple[PyTree, tuple]]

WORTHWHILE = 20_000
"""Rows of all runs together from which compiled lanes are worth their compilation."""

LARGEST = 60_000
"""Operations of a row beyond which "auto" leaves it to XLA: straight code of that length takes long to compile."""

_RUNS = "runs"
_log = logging.getLogger("jaxfilt")


class Kept(NamedTuple):
    """An output that is stored: of the first ``runs`` (all: None), each ``every``-th row, the last of its group."""

    every: int = 1
    runs: int | None = None


class Added(NamedTuple):
    """An output that is added up over the runs, at each row."""


Outputs = Sequence[Kept | Added]


def loop(
    body: Body,
    constants: PyTree,
    start: PyTree,
    rows: PyTree,
    *,
    runs: int,
    axes: tuple[Any, Any, Any],
    outputs: Outputs,
    segment: int | None = None,
    backend: Backend = "xla",
) -> tuple[PyTree, tuple]:
    """`jax.lax.scan` of one run under `jax.vmap` over the runs.

    Args:
        body: (constants, carry, row) -> (carry, one tree for each of ``outputs``), of one run.
        constants: what a run has in all of its rows; what all runs have may as well be closed over.
        start: the carry before the first row.
        rows: leading axis T, after that of the runs.
        runs: how many.
        axes: of constants, start and rows, as `jax.vmap` takes them: 0 where each run has its own, None where shared.
        outputs: what becomes of each output.
        segment: as in `jaxfilt.scan`; compiled lanes keep little in any case.
        backend: see `jaxfilt.scan_runs`.

    Returns:
        The carry, leading axis runs, and each output: (runs, T // every, ...) or, added up, (T, ...).

    Raises:
        ValueError: an unknown back end, or one that is not there.
    """
    arguments = (constants, start, rows)

    def on(lanes: bool) -> tuple[PyTree, tuple]:
        if lanes:
            return _lanes(body, arguments, runs, axes, outputs, LARGEST if backend == "auto" else None)
        return _xla(body, arguments, runs, axes, outputs, segment)

    return in_lanes(on, backend, runs * _steps(rows, axes[2], runs))


def in_lanes(function: Callable[[bool], T], backend: Backend, work: int) -> T:
    """``function(whether in compiled lanes)``: what ``backend`` says, and with "auto" by XLA what lanes cannot compute.

    Args:
        function: what traces a loop, its derivative too if there is to be one.
        backend: see `jaxfilt.scan_runs`.
        work: rows of all runs together.
    """
    if not _wants_lanes(backend, work):
        return function(False)
    from jaxfilt.lanes import Unsupported

    try:
        return function(True)
    except Unsupported as error:
        if backend == "lanes":
            raise
        _say(f"computed by XLA, not by compiled lanes: {error}")
        return function(False)


def _wants_lanes(backend: Backend, work: int) -> bool:
    """Whether a loop over so many rows of runs is to be tried in compiled lanes.

    Raises:
        ValueError: an unknown back end, or lanes where they cannot be had.
    """
    if backend not in ("auto", "xla", "lanes"):
        raise ValueError(f"backend: expected 'auto', 'xla' or 'lanes', got {backend!r}")
    if backend == "xla" or (backend == "auto" and work < WORTHWHILE):
        return False
    missing = None
    if jax.default_backend() != "cpu":
        missing = f"they are for CPUs, and JAX computes on {jax.default_backend()}"
    elif importlib.util.find_spec("llvmlite") is None:
        missing = "llvmlite is not installed; pip install 'jaxfilt[fast]'"
    if missing is None:
        return True
    if backend == "lanes":
        raise ValueError(f"backend: expected one that is there, got 'lanes': {missing}")
    if jax.default_backend() == "cpu":
        _say(f"computed by XLA, not by compiled lanes: {missing}")
    return False


@functools.cache
def _say(text: str) -> None:
    """Once."""
    _log.warning(text)


def _steps(rows: PyTree, axes: Any, runs: int) -> int:
    """How many rows there are: an axis of runs, where there is one, comes first."""
    found: list[int] = []
    look = jax.vmap(lambda one: found.append(len(jax.tree.leaves(one)[0])), (axes,), None, axis_size=runs)
    jax.eval_shape(look, rows)
    return found[0]


def checkpointed(body: Callable, carry: PyTree, xs: PyTree, segment: int | None = None) -> tuple[PyTree, PyTree]:
    """`jax.lax.scan` of which reverse mode keeps the carry of each row, or of each segment, and computes the rest anew.

    Args:
        body: (carry, row) -> (carry, what is stored).
        carry: before the first row.
        xs: rows, leading axis T.
        segment: rows between kept carries: then memory is for ``T / segment + segment`` of them. What is left of T by
            a segment that does not divide it is a scan, and a program to compile, of its own.

    Raises:
        ValueError: a segment below 1.

    Source: A. Griewank, Achieving logarithmic growth of temporal and spatial complexity in reverse automatic
    differentiation (1992): its scheme with two levels.
    """
    if segment is not None and segment < 1:
        raise ValueError(f"segment: expected at least one row, got {segment}")
    # A scan's body is its own fence: nothing that is computed again can be merged with what was computed before.
    row = jax.checkpoint(body, prevent_cse=False)
    steps = len(jax.tree.leaves(xs)[0])
    if segment is None or segment >= steps:
        return jax.lax.scan(row, carry, xs)
    whole = steps - steps % segment
    pieces = jax.tree.map(lambda a: a[:whole].reshape(-1, segment, *a.shape[1:]), xs)
    carry, stored = jax.lax.scan(jax.checkpoint(functools.partial(jax.lax.scan, row), prevent_cse=False), carry, pieces)
    stored = jax.tree.map(lambda a: a.reshape(whole, *a.shape[2:]), stored)
    if whole == steps:
        return carry, stored
    carry, rest = jax.lax.scan(row, carry, jax.tree.map(lambda a: a[whole:], xs))
    return carry, jax.tree.map(lambda *parts: jnp.concatenate(parts), stored, rest)


def _xla(
    body: Body, arguments: tuple[PyTree, PyTree, PyTree], runs: int, axes: tuple, outputs: Outputs, segment: int | None
) -> tuple[PyTree, tuple]:
    def one(constants: PyTree, start: PyTree, rows: PyTree) -> tuple[PyTree, list]:
        def row_of(carry: PyTree, row: PyTree) -> tuple[PyTree, list]:
            carry, found = body(constants, carry, row)
            return carry, [_gathered(how, tree) for how, tree in zip(outputs, found, strict=True)]

        return _thinned(row_of, start, rows, outputs, segment)

    together = [isinstance(how, Added) or how.runs is not None for how in outputs]
    out_axes = (0, [None if shared else 0 for shared in together])
    mapped = jax.vmap(one, in_axes=axes, out_axes=out_axes, axis_name=_RUNS, axis_size=runs)
    carry, found = mapped(*arguments)
    return carry, tuple(
        jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), tree) if isinstance(how, Kept) and shared else tree
        for how, shared, tree in zip(outputs, together, found, strict=True)
    )


def _gathered(how: Kept | Added, tree: PyTree) -> PyTree:
    """What is stored of an output: in the row itself, for what a scan has stored of all runs it has stored for good."""
    if isinstance(how, Added):
        return jax.lax.psum(tree, _RUNS)
    return tree if how.runs is None else jax.tree.map(lambda a: jax.lax.all_gather(a, _RUNS)[: how.runs], tree)


def _thinned(
    row_of: Callable, start: PyTree, rows: PyTree, outputs: Outputs, segment: int | None
) -> tuple[PyTree, list]:
    """The scan, of whose outputs each ``every``-th row is left.

    A scan over groups of rows stores what the last row of each left behind. Where the rows do not come in such groups,
    all of them are stored and most dropped.
    """
    strides = [how.every if isinstance(how, Kept) else 1 for how in outputs]
    size, steps = max(strides, default=1), len(jax.tree.leaves(rows)[0])
    if size == 1 or segment is not None or steps % size or set(strides) - {1, size}:
        carry, found = checkpointed(row_of, start, rows, segment)
        thin = zip(strides, found, strict=True)
        return carry, [jax.tree.map(lambda a, k=k: a[k - 1 :: k], tree) if k > 1 else tree for k, tree in thin]
    rare = [k == size for k in strides]
    blank = jax.eval_shape(row_of, start, jax.tree.map(lambda a: a[0], rows))[1]
    blank = [
        jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), tree) for tree, yes in zip(blank, rare, strict=True) if yes
    ]

    def grouped(carry: PyTree, group: PyTree) -> tuple[PyTree, list]:
        def inner(carry: tuple, row: PyTree) -> tuple[tuple, list]:
            carry, found = row_of(carry[0], row)
            last = [tree for tree, yes in zip(found, rare, strict=True) if yes]
            return (carry, last), [tree for tree, yes in zip(found, rare, strict=True) if not yes]

        (carry, last), each = checkpointed(inner, (carry, blank), group)
        kept, each = iter(last), iter(each)
        return carry, [next(kept if yes else each) for yes in rare]

    groups = jax.tree.map(lambda a: a.reshape(-1, size, *a.shape[1:]), rows)
    carry, found = jax.lax.scan(grouped, start, groups)
    whole = zip(rare, found, strict=True)
    return carry, [t if yes else jax.tree.map(lambda a: a.reshape(steps, *a.shape[2:]), t) for yes, t in whole]


def _lanes(
    body: Body,
    arguments: tuple[PyTree, PyTree, PyTree],
    runs: int,
    axes: tuple,
    outputs: Outputs,
    largest: int | None,
) -> tuple[PyTree, tuple]:
    from jaxfilt.lanes.trace import Stored
    from jaxfilt.lanes.trees import over_runs

    few = max((how.runs for how in outputs if isinstance(how, Kept) and how.runs is not None), default=runs)
    stored = [
        Stored(summed=True) if isinstance(how, Added) else Stored(every=how.every, few=how.runs is not None)
        for how in outputs
    ]
    carry, found = over_runs(body, *arguments, axes, runs, stored, few, largest)

    def first(how: Kept | Added, tree: PyTree) -> PyTree:
        return tree if isinstance(how, Added) else jax.tree.map(lambda a: a[: how.runs], tree)

    return carry, tuple(first(how, tree) for how, tree in zip(outputs, found, strict=True))
