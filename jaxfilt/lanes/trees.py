"""The door of the lane compiler: a loop over rows for many runs, of pytrees."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxfilt.lanes.batch import Parts, compiled
from jaxfilt.lanes.engine import Sizes
from jaxfilt.lanes.trace import Stored, traced

PyTree = Any
Body = Callable[[PyTree, PyTree, PyTree], tuple[PyTree, Sequence[PyTree]]]


def over_runs(
    body: Body,
    constants: PyTree,
    start: PyTree,
    rows: PyTree,
    axes: tuple[Any, Any, Any],
    runs: int,
    stored: Sequence[Stored],
    few: int | None = None,
    largest: int | None = None,
) -> tuple[PyTree, list[PyTree]]:
    """`jax.lax.scan` of one run under `jax.vmap`, compiled to one loop that keeps a register of runs in flight.

    Args:
        body: (constants, carry, row) -> (carry, one tree for each of ``stored``), of one run. What it closes over all
            runs share: arrays known now are compiled in, values of an enclosing `jax.jit` are read.
        constants, start, rows: with leading axes ([runs,] [steps,]).
        axes: of the three, 0 where each run has its own, None where shared, as `jax.vmap` takes them.
        runs: how many.
        stored: what becomes of each tree that the body returns.
        few: of how many of the first runs those outputs are that are kept of a few.
        largest: how many operations on numbers a row may have.

    Returns:
        The carry, leading axis runs, and the outputs.

    Raises:
        Unsupported: an equation that has no rule, or too many of them.
        TypeError: what is carried changes its shape or dtype.
    """
    trees = Parts(constants, rows, start)
    by_tree = Parts(axes[0], axes[2], axes[1])
    forms = Parts(*(jax.tree.structure(tree) for tree in trees))
    leaves = Parts(*(jax.tree.leaves(tree) for tree in trees))
    shared = Parts(*(_shared(axis, tree) for axis, tree in zip(by_tree, trees, strict=True)))
    keys = Parts(*([_generator(a) for a in part] for part in leaves))
    arrays = Parts(*([_plain(a) for a in part] for part in leaves))
    returned: list[tuple[Any, list]] = []

    def flat(constants: list, carry: list, row: list) -> tuple[list, list]:
        given = Parts(constants, row, carry)
        wrapped = [[_wrapped(a, k) for a, k in zip(own, ks, strict=True)] for own, ks in zip(given, keys, strict=True)]
        own, row_tree, carried = (jax.tree.unflatten(f, part) for f, part in zip(forms, wrapped, strict=True))
        after, found = body(own, carried, row_tree)
        if jax.tree.structure(after) != forms.start:
            raise TypeError(f"carry: expected {forms.start} after a row as before it, got {jax.tree.structure(after)}")
        returned[:] = [(jax.tree.structure(tree), jax.tree.leaves(tree)) for tree in found]
        outs = [jnp.asarray(a) for _, each in returned for a in each]
        return [_plain(a) for a in jax.tree.leaves(after)], outs

    row = traced(flat, _of_one(arrays, shared))
    counts = [len(each) for _, each in returned]
    row = row._replace(stored=tuple(how for how, n in zip(stored, counts, strict=True) for _ in range(n)))
    steps = next(a.shape[not alike] for a, alike in zip(arrays.rows, shared.rows, strict=True))
    sizes = Sizes(runs, steps, runs if few is None else min(few, runs))
    carry, outs = compiled(row, arrays, shared, sizes, largest)
    ends = [0, *itertools.accumulate(counts)]
    found = [jax.tree.unflatten(form, outs[ends[k] : ends[k + 1]]) for k, (form, _) in enumerate(returned)]
    return jax.tree.unflatten(forms.start, [_wrapped(a, k) for a, k in zip(carry, keys.start, strict=True)]), found


def _shared(axis: Any, tree: PyTree) -> list[bool]:
    """For each leaf whether it has no axis of runs, of axes that are given for some subtrees of it."""
    if axis is None or isinstance(axis, int):
        return [axis is None for _ in jax.tree.leaves(tree)]
    flags = jax.tree.map(
        lambda a, part: [a is None for _ in jax.tree.leaves(part)], axis, tree, is_leaf=lambda a: a is None
    )
    return [flag for part in jax.tree.leaves(flags, is_leaf=lambda a: isinstance(a, list)) for flag in part]


def _generator(a: Any) -> Any:
    """Which generator a random key is of, None of any other array."""
    return jax.random.key_impl(a) if jnp.issubdtype(jnp.result_type(a), jax.dtypes.prng_key) else None


def _plain(a: Any) -> jax.Array:
    """The array, or the words of a random key."""
    return jax.random.key_data(a) if _generator(a) is not None else jnp.asarray(a)


def _wrapped(a: jax.Array, generator: Any) -> jax.Array:
    return a if generator is None else jax.random.wrap_key_data(a, impl=generator)


def _of_one(arrays: Parts, shared: Parts) -> Parts:
    """The shapes of one run, and of one row."""

    def cut(a: jax.Array, alike: bool, moving: bool) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(a.shape[(not alike) + moving :], a.dtype)

    constants = [cut(a, s, False) for a, s in zip(arrays.constants, shared.constants, strict=True)]
    rows = [cut(a, s, True) for a, s in zip(arrays.rows, shared.rows, strict=True)]
    return Parts(constants, rows, [cut(a, s, False) for a, s in zip(arrays.start, shared.start, strict=True)])
