"""Rules of products and sums: dot_general, reductions, cumulative sums."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import partial, reduce
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfilt.lanes.graph import Graph, kind_of
from jaxfilt.lanes.nodes import Nodes, literal, mapped, shaped
from jaxfilt.lanes.rules.elementwise import converted
from jaxfilt.lanes.rules.registry import rule

if TYPE_CHECKING:
    from jaxfilt.lanes.lower import Lowering

NEUTRAL = {"add": 0, "mul": 1, "and": True, "or": False, "xor": False, "max": -np.inf, "min": np.inf}
"""What a reduction of nothing gives."""


def dot(g: Graph, a: Iterable[int], b: Iterable[int], kind: str) -> int:
    """The sum of products, from the first to the last; zeros that are known cost nothing."""
    total, multiply, add = None, "mul", "add"
    if kind == "b":
        multiply, add = "and", "or"
    nought = g.constant(0, kind)
    skipped = not g.strict or kind[0] != "f"
    for x, y in zip(a, b, strict=True):
        if skipped and (x == nought or y == nought):
            other = y if x == nought else x
            value = g.known(other)
            if value is None or np.isfinite(value):
                if value is None and kind[0] == "f":
                    g.folded.add(other)
                continue
        product = g.make(multiply, x, y)
        total = product if total is None else g.make(add, total, product)
    return nought if total is None else total


@rule("dot_general")
def _(lowering: Lowering, equation: Any, a: Nodes, b: Nodes) -> Nodes:
    (of_a, of_b), (batch_a, batch_b) = equation.params["dimension_numbers"]
    aval = equation.outvars[0].aval
    left, shape_a = _rows(converted(lowering, a, aval.dtype), batch_a, of_a)
    right, shape_b = _rows(converted(lowering, b, aval.dtype), batch_b, of_b)
    g, kind = lowering.graph, kind_of(aval.dtype)
    nodes = [dot(g, x, y, kind) for xs, ys in zip(left, right, strict=True) for x in xs for y in ys]
    return shaped(nodes, (*(a.shape[axis] for axis in batch_a), *shape_a, *shape_b))


def _rows(x: Nodes, batch: tuple[int, ...], summed: tuple[int, ...]) -> tuple[list, tuple[int, ...]]:
    """As lists [batch][free][summed], and the shape of the free axes."""
    free = [axis for axis in range(x.ndim) if axis not in (*batch, *summed)]
    sizes = [[x.shape[axis] for axis in axes] for axes in (batch, free, summed)]
    ordered = x.transpose(*batch, *free, *summed)
    return ordered.reshape([math.prod(size) for size in sizes]).tolist(), tuple(sizes[1])


REDUCTIONS = {
    "reduce_sum": "add",
    "reduce_prod": "mul",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_and": "and",
    "reduce_or": "or",
    "reduce_xor": "xor",
}


@rule(*REDUCTIONS)
def _(lowering: Lowering, equation: Any, x: Nodes) -> Nodes:
    op, axes = REDUCTIONS[equation.primitive.name], equation.params["axes"]
    free = [axis for axis in range(x.ndim) if axis not in axes]
    aval = equation.outvars[0].aval
    rows = x.transpose(*free, *axes).reshape(math.prod(aval.shape), -1).tolist()
    if not x.size:
        return np.full(aval.shape, _neutral(lowering, op, aval.dtype), np.int64)
    return shaped([reduce(partial(lowering.graph.make, op), row) for row in rows], aval.shape)


def _neutral(lowering: Lowering, op: str, dtype: np.dtype) -> int:
    value = NEUTRAL[op]
    if dtype.kind in "iu" and op in ("max", "min"):
        info = np.iinfo(dtype)
        value = info.min if op == "max" else info.max
    return literal(lowering.graph, np.array(value, dtype)).item()


CUMULATIVE = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}


@rule(*CUMULATIVE)
def _(lowering: Lowering, equation: Any, x: Nodes) -> Nodes:
    op, axis = CUMULATIVE[equation.primitive.name], equation.params["axis"]
    rows = np.moveaxis(np.array(x), axis, 0)
    if equation.params["reverse"]:
        rows = rows[::-1]
    for i in range(1, len(rows)):
        rows[i] = mapped(partial(lowering.graph.make, op), rows[i - 1], rows[i])
    if equation.params["reverse"]:
        rows = rows[::-1]
    return np.moveaxis(rows, 0, axis)
