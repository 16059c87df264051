"""Rules of what depends on order: argmax, argmin, sort."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfilt.lanes.graph import kind_of
from jaxfilt.lanes.nodes import Nodes, Unsupported, shaped
from jaxfilt.lanes.rules.registry import rule

if TYPE_CHECKING:
    from jaxfilt.lanes.lower import Lowering

SORTED = 16
"""Longest array that is sorted: the comparisons grow with its square."""


@rule("argmax", "argmin")
def _(lowering: Lowering, equation: Any, x: Nodes) -> Nodes:
    """The first of the largest, or the first NaN."""
    g, (axis,) = lowering.graph, equation.params["axes"]
    better, kind = ("gt" if equation.primitive.name == "argmax" else "lt"), kind_of(equation.params["index_dtype"])
    found = []
    rows = np.moveaxis(x, axis, -1)
    for row in rows.reshape(-1, x.shape[axis]).tolist():
        best, where = row[0], g.constant(0, kind)
        for i, node in enumerate(row[1:], 1):
            missing = g.make("and", g.make("ne", node, node), g.make("eq", best, best))
            wins = g.make("or", g.make(better, node, best), missing)
            best, where = g.make("select", wins, node, best), g.make("select", wins, g.constant(i, kind), where)
        found.append(where)
    return shaped(found, rows.shape[:-1])


@rule("sort")
def _(lowering: Lowering, equation: Any, *arrays: Nodes) -> list[Nodes]:
    """Neighbours change places until none has to: stable, and the same comparisons whatever the data.

    Source: D. E. Knuth, The Art of Computer Programming 3, 2nd edition (1998), section 5.3.4, figure 45.
    """
    axis, keys = equation.params["dimension"], equation.params["num_keys"]
    length = arrays[0].shape[axis]
    moved = [np.moveaxis(np.array(a), axis, 0) for a in arrays]
    g = lowering.graph
    for at in np.ndindex(*moved[0].shape[1:]):
        columns = [a[(slice(None), *at)] for a in moved]
        items = list(zip(*(column.tolist() for column in columns), strict=True))
        if length > SORTED and not all(g.known(node) is not None for item in items for node in item[:keys]):
            raise Unsupported("sort", f"more than {SORTED} numbers that depend on the data")
        for column, nodes in zip(columns, zip(*_sorted(lowering, items, keys), strict=True), strict=True):
            column[:] = nodes
    return [np.moveaxis(a, 0, axis) for a in moved]


def _sorted(lowering: Lowering, items: list[tuple[int, ...]], keys: int) -> list[tuple[int, ...]]:
    items = list(items)
    for end in range(len(items) - 1, 0, -1):
        for i in range(end):
            swapped = _before(lowering, items[i + 1][:keys], items[i][:keys])
            first, second = items[i], items[i + 1]
            items[i] = tuple(lowering.pick(swapped, *pair) for pair in zip(second, first, strict=True))
            items[i + 1] = tuple(lowering.pick(swapped, *pair) for pair in zip(first, second, strict=True))
    return items


def _before(lowering: Lowering, a: Sequence[int], b: Sequence[int]) -> int:
    """Whether keys come before others, the first of them that differ decides; NaN comes last."""
    g, found = lowering.graph, lowering.graph.constant(False, "b")
    for x, y in reversed(list(zip(a, b, strict=True))):
        less, same = g.make("lt", x, y), g.make("eq", x, y)
        if g.kind[x][0] == "f":
            number, missing = g.make("eq", x, x), g.make("ne", y, y)
            less = g.make("or", less, g.make("and", number, missing))
            same = g.make("or", same, g.make("and", g.make("not", number), missing))
        found = g.make("or", less, g.make("and", same, found))
    return found
