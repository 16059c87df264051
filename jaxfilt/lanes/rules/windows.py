"""Rules of windows that lie where an index says: gather, scatter and dynamic slices.

An index that is known moves nodes about; of one that is not, each place where the window may lie is computed and one
picked, so the table must be small.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jax.lax import GatherScatterMode

from jaxfilt.lanes.nodes import Nodes, Unsupported, mapped
from jaxfilt.lanes.rules.registry import rule

if TYPE_CHECKING:
    from jaxfilt.lanes.lower import Lowering

PLACES = 64
"""Most places of a window whose index is not known."""


class Place(NamedTuple):
    """Where a window may start, and the node that says whether it does."""

    start: tuple[int, ...]
    here: int


def places(lowering: Lowering, name: str, index: Sequence[int], last: Sequence[int], clamped: bool) -> list[Place]:
    """Where a window may start, given nodes of its index and the last start along each axis.

    Of the predicates at most one is true; exactly one if the index is clamped into range.
    """
    g = lowering.graph
    found = [Place((), g.constant(True, "b"))]
    for node, end in zip(index, last, strict=True):
        value = g.known(node)
        if value is not None:
            start = int(np.clip(int(value), 0, end)) if clamped else int(value)
            along = [(start, g.constant(True, "b"))] if 0 <= start <= end else []
        else:
            along = [(i, _is_at(lowering, node, i, end, clamped)) for i in range(end + 1)]
        found = [Place((*p.start, i), g.make("and", p.here, here)) for p in found for i, here in along]
        if len(found) > PLACES:
            raise Unsupported(name, f"an index that depends on the data, into more than {PLACES} places")
    return found


def _is_at(lowering: Lowering, node: int, i: int, end: int, clamped: bool) -> int:
    g = lowering.graph
    at = g.constant(i, g.kind[node])
    if clamped and i == 0:
        return g.constant(True, "b") if end == 0 else g.make("le", node, at)
    return g.make("ge" if clamped and i == end else "eq", node, at)


def picked(
    lowering: Lowering, found: list[Place], window: Callable[[tuple[int, ...]], Nodes], other: Nodes | None
) -> Nodes:
    """The window that is meant; ``other`` where none of the places is, None if one must be."""
    if other is None:
        *found, place = found
        other = window(place.start)
    for start, here in reversed(found):
        other = mapped(partial(lowering.pick, here), window(start), other)
    return other


@rule("dynamic_slice")
def _(lowering: Lowering, equation: Any, x: Nodes, *index: Nodes) -> Nodes:
    size = equation.params["slice_sizes"]
    last = [n - k for n, k in zip(x.shape, size, strict=True)]

    def window(start: tuple[int, ...]) -> Nodes:
        return x[tuple(slice(s, s + k) for s, k in zip(start, size, strict=True))]

    found = places(lowering, "dynamic_slice", [i.item() for i in index], last, clamped=True)
    return picked(lowering, found, window, None)


@rule("dynamic_update_slice")
def _(lowering: Lowering, equation: Any, x: Nodes, update: Nodes, *index: Nodes) -> Nodes:
    last = [n - k for n, k in zip(x.shape, update.shape, strict=True)]
    out = np.array(x)
    for start, here in places(lowering, "dynamic_update_slice", [i.item() for i in index], last, clamped=True):
        at = tuple(slice(s, s + k) for s, k in zip(start, update.shape, strict=True))
        out[at] = mapped(partial(lowering.pick, here), update, out[at])
    return out


@rule("gather")
def _(lowering: Lowering, equation: Any, x: Nodes, index: Nodes) -> Nodes:
    p, aval = equation.params, equation.outvars[0].aval
    d, size = p["dimension_numbers"], p["slice_sizes"]
    filled = GatherScatterMode.from_any(p["mode"]) == GatherScatterMode.FILL_OR_DROP
    shape = index.shape[:-1]
    kept = [axis for axis in range(x.ndim) if axis not in (*d.collapsed_slice_dims, *d.operand_batching_dims)]
    last = [x.shape[axis] - size[axis] for axis in d.start_index_map]
    other = None
    if filled:
        filler = lowering.literal(_filler(p["fill_value"], aval.dtype), aval)
        other = np.broadcast_to(filler, [size[axis] for axis in kept])
    out = np.empty((*shape, *(size[axis] for axis in kept)), np.int64)
    for at in np.ndindex(*shape):
        batch = dict(zip(d.operand_batching_dims, (at[k] for k in d.start_indices_batching_dims), strict=True))

        def window(start: tuple[int, ...], batch: dict[int, int] = batch) -> Nodes:
            origin = batch | dict(zip(d.start_index_map, start, strict=True))
            part = x[tuple(slice(origin.get(k, 0), origin.get(k, 0) + n) for k, n in enumerate(size))]
            return part.reshape([size[axis] for axis in kept])

        found = places(lowering, "gather", index[at].tolist(), last, clamped=not filled)
        out[at] = picked(lowering, found, window, other)
    return np.moveaxis(out, range(len(shape), out.ndim), d.offset_dims)


def _filler(value: Any, dtype: Any) -> Any:
    """What JAX puts where an index is out of range, if nothing else is asked for."""
    if value is not None:
        return value
    if dtype.kind in "iu":
        info = np.iinfo(dtype)
        return info.min if dtype.kind == "i" else info.max
    return True if dtype.kind == "b" else np.nan


UPDATES = {
    "scatter": None,
    "scatter-add": "add",
    "scatter_add": "add",
    "scatter-sub": "sub",
    "scatter_sub": "sub",
    "scatter-mul": "mul",
    "scatter_mul": "mul",
    "scatter-min": "min",
    "scatter_min": "min",
    "scatter-max": "max",
    "scatter_max": "max",
}
"""What becomes of the number that is there; None: it is replaced."""


@rule(*UPDATES)
def _(lowering: Lowering, equation: Any, x: Nodes, index: Nodes, updates: Nodes) -> Nodes:
    p, op = equation.params, UPDATES[equation.primitive.name]
    d = p["dimension_numbers"]
    clamped = GatherScatterMode.from_any(p["mode"]) == GatherScatterMode.CLIP
    kept = [axis for axis in range(x.ndim) if axis not in (*d.inserted_window_dims, *d.operand_batching_dims)]
    of_window = iter(d.update_window_dims)
    size = [updates.shape[next(of_window)] if axis in kept else 1 for axis in range(x.ndim)]
    last = [x.shape[axis] - size[axis] for axis in d.scatter_dims_to_operand_dims]
    updates = np.moveaxis(updates, d.update_window_dims, range(index.ndim - 1, updates.ndim))
    out = np.array(x)

    def put(here: int, new: int, old: int) -> int:
        return lowering.pick(here, new if op is None else lowering.graph.make(op, old, new), old)

    for at in np.ndindex(*index.shape[:-1]):
        batch = dict(zip(d.operand_batching_dims, (at[k] for k in d.scatter_indices_batching_dims), strict=True))
        for start, here in places(lowering, equation.primitive.name, index[at].tolist(), last, clamped):
            origin = batch | dict(zip(d.scatter_dims_to_operand_dims, start, strict=True))
            window = tuple(slice(origin.get(k, 0), origin.get(k, 0) + n) for k, n in enumerate(size))
            out[window] = mapped(partial(put, here), updates[at].reshape(size), out[window])
    return out
