"""Rules of what is done number by number."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jaxfilt.lanes import maths
from jaxfilt.lanes.graph import KINDS, Graph
from jaxfilt.lanes.nodes import Nodes, Unsupported, kind, mapped
from jaxfilt.lanes.rules.registry import rule

if TYPE_CHECKING:
    from jaxfilt.lanes.lower import Lowering

SAME = {
    "add": "add",
    "add_any": "add",
    "sub": "sub",
    "mul": "mul",
    "div": "div",
    "rem": "rem",
    "neg": "neg",
    "abs": "abs",
    "sqrt": "sqrt",
    "floor": "floor",
    "ceil": "ceil",
    "max": "max",
    "min": "min",
    "eq": "eq",
    "ne": "ne",
    "lt": "lt",
    "le": "le",
    "gt": "gt",
    "ge": "ge",
    "and": "and",
    "or": "or",
    "xor": "xor",
    "not": "not",
    "shift_left": "shl",
    "shift_right_logical": "shr",
}
"""Primitives that are one operation of the graph."""


def elementwise(function: Callable[..., int]) -> Callable[..., Nodes]:
    """The rule of a primitive that takes (graph, node of each operand) to a node."""
    return lambda lowering, equation, *args: mapped(partial(function, lowering.graph), *args)


def _operation(op: str) -> Callable[..., Nodes]:
    return lambda lowering, equation, *args: mapped(partial(lowering.graph.make, op), *args)


for _primitive, _op in SAME.items():
    rule(_primitive)(_operation(_op))
for _primitive in maths.__all__:
    rule(_primitive)(elementwise(getattr(maths, _primitive)))


def number(g: Graph, like: int, value: float) -> int:
    """A constant of the kind of a node."""
    return g.constant(value, g.kind[like])


@rule("square")
@elementwise
def _(g: Graph, x: int) -> int:
    return g.make("mul", x, x)


@rule("sign")
@elementwise
def _(g: Graph, x: int) -> int:
    zero = number(g, x, 0)
    positive = g.make("gt", x, zero)
    if g.kind[x][0] == "u":
        return g.make("convert", positive, kind=g.kind[x])
    other = g.make("select", g.make("lt", x, zero), number(g, x, -1), x)  # x itself where it is 0, -0 or NaN
    return g.make("select", positive, number(g, x, 1), other)


@rule("is_finite")
@elementwise
def _(g: Graph, x: int) -> int:
    return g.make("lt", g.make("abs", x), number(g, x, np.inf))


@rule("clamp")
@elementwise
def _(g: Graph, low: int, x: int, high: int) -> int:
    return g.make("min", g.make("max", x, low), high)


@rule("round")
def _(lowering: Lowering, equation: Any, x: Nodes) -> Nodes:
    to_even = equation.params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN
    return mapped(partial(_rounded, lowering.graph, to_even), x)


def _rounded(g: Graph, to_even: bool, x: int) -> int:
    """To the nearest integer, halves to the even one or away from zero."""
    nearest = g.make("round", x)
    if to_even:
        return nearest
    size = g.make("abs", x)
    down = g.make("floor", size)
    # size - down is exact; size + 0.5 would not be, just below a half.
    half = g.make("ge", g.make("sub", size, down), number(g, x, 0.5))
    away = g.make("select", half, g.make("add", down, number(g, x, 1)), down)
    return with_sign(g, away, x)


def with_sign(g: Graph, size: int, x: int) -> int:
    """A number that is not negative, with the sign bit of another of its kind."""
    bits = {"f32": "u32", "f64": "u64"}[g.kind[x]]
    sign = g.constant(1 << (KINDS[bits].itemsize * 8 - 1), bits)
    signed = g.make("and", g.make("bitcast", x, kind=bits), sign)
    return g.make("bitcast", g.make("or", g.make("bitcast", size, kind=bits), signed), kind=g.kind[x])


@rule("integer_pow")
def _(lowering: Lowering, equation: Any, x: Nodes) -> Nodes:
    return mapped(lambda node: integer_power(lowering.graph, node, equation.params["y"]), x)


def integer_power(g: Graph, x: int, exponent: int) -> int:
    """x to an integer, by repeated squaring."""
    power, base, left = number(g, x, 1), x, abs(exponent)
    while left:
        if left & 1:
            power = g.make("mul", power, base)
        left >>= 1
        if left:
            base = g.make("mul", base, base)
    return g.make("div", number(g, x, 1), power) if exponent < 0 else power


@rule("pow")
@elementwise
def _(g: Graph, x: int, exponent: int) -> int:
    return maths.pow(g, x, g.make("convert", exponent, kind=g.kind[x]))


@rule("shift_right_arithmetic")
@elementwise
def _(g: Graph, x: int, by: int) -> int:
    """The highest bit is copied, of unsigned numbers too."""
    own, signed = g.kind[x], "i" + g.kind[x][1:]
    if own == signed:
        return g.make("sar", x, by)
    shifted = g.make("sar", g.make("bitcast", x, kind=signed), g.make("bitcast", by, kind=signed))
    return g.make("bitcast", shifted, kind=own)


@rule("select_n")
def _(lowering: Lowering, equation: Any, which: Nodes, *cases: Nodes) -> Nodes:
    if lowering.graph.kind[which.flat[0]] == "b":
        return mapped(lowering.pick, which, *cases[::-1])
    g = lowering.graph

    def pick(which: int, *cases: int) -> int:
        """The case of this number, the last one if there is none."""
        found = cases[-1]
        for i in reversed(range(len(cases) - 1)):
            found = lowering.pick(g.make("eq", which, number(g, which, i)), cases[i], found)
        return found

    return mapped(pick, which, *cases)


@rule("convert_element_type")
def _(lowering: Lowering, equation: Any, x: Nodes) -> Nodes:
    return converted(lowering, x, equation.params["new_dtype"])


def converted(lowering: Lowering, x: Nodes, dtype: Any) -> Nodes:
    """Numbers as another dtype."""
    g, to = lowering.graph, kind(dtype)

    def convert(node: int) -> int:
        if to == "b":  # NaN is not zero
            return node if g.kind[node] == "b" else g.make("ne", node, number(g, node, 0))
        return g.make("convert", node, kind=to)

    return mapped(convert, x)


@rule("bitcast_convert_type")
def _(lowering: Lowering, equation: Any, x: Nodes) -> Nodes:
    g, to = lowering.graph, kind(equation.params["new_dtype"])
    if x.size and KINDS[g.kind[x.flat[0]]].itemsize != KINDS[to].itemsize:
        raise Unsupported("bitcast_convert_type", "between numbers of different size")
    return mapped(lambda node: node if g.kind[node] == to else g.make("bitcast", node, kind=to), x)


@rule("reduce_precision")
def _(lowering: Lowering, equation: Any, x: Nodes) -> Nodes:
    info = np.finfo(equation.outvars[0].aval.dtype)
    if (equation.params["exponent_bits"], equation.params["mantissa_bits"]) != (info.nexp, info.nmant):
        raise Unsupported("reduce_precision", "to another precision than that of the number")
    return x


@rule("population_count")
@elementwise
def _(g: Graph, x: int) -> int:
    return _ones(g, x)


def _ones(g: Graph, x: int) -> int:
    """How many bits are set: sums of 2, 4, 8, ... neighbouring bits, side by side.

    Source: H. S. Warren, Hacker's Delight, 2nd edition (2012), figure 5-2.
    """
    bits = KINDS[g.kind[x]].itemsize * 8
    unsigned = f"u{bits}"
    total = x if g.kind[x] == unsigned else g.make("bitcast", x, kind=unsigned)
    width = 1
    while width < bits:
        mask = g.constant(sum(((1 << width) - 1) << at for at in range(0, bits, 2 * width)), unsigned)
        upper = g.make("and", g.make("shr", total, g.constant(width, unsigned)), mask)
        total = g.make("add", g.make("and", total, mask), upper)
        width *= 2
    return total if g.kind[x] == unsigned else g.make("bitcast", total, kind=g.kind[x])


@rule("clz")
@elementwise
def _(g: Graph, x: int) -> int:
    """Leading zeros: the zeros that are left when each set bit is copied to all below it."""
    bits = KINDS[g.kind[x]].itemsize * 8
    width = 1
    while width < bits:
        x = g.make("or", x, g.make("shr", x, number(g, x, width)))
        width *= 2
    return _ones(g, g.make("not", x))


@rule("nextafter")
@elementwise
def _(g: Graph, x: int, y: int) -> int:
    """The next number from x towards y: the next or the last integer among the bits."""
    integer = {"f32": "i32", "f64": "i64"}[g.kind[x]]
    one = g.constant(1, integer)
    bits = g.make("bitcast", x, kind=integer)
    larger = g.make("eq", g.make("gt", y, x), g.make("gt", x, number(g, x, 0)))  # away from zero
    moved = g.make("select", larger, g.make("add", bits, one), g.make("sub", bits, one))
    least = g.make("bitcast", one, kind=g.kind[x])
    from_zero = with_sign(g, least, y)
    stepped = g.make("bitcast", moved, kind=g.kind[x])
    stepped = g.make("select", g.make("eq", x, number(g, x, 0)), from_zero, stepped)
    stepped = g.make("select", g.make("eq", x, y), y, stepped)
    missing = g.make("or", g.make("ne", x, x), g.make("ne", y, y))
    return g.make("select", missing, g.make("add", x, y), stepped)
