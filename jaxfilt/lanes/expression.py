"""Nodes of a graph written as formulas, for code that makes many of them by hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from typing import NamedTuple, TypeAlias

from jaxfilt.lanes.graph import Graph


class Format(NamedTuple):
    """A binary floating-point format (IEEE 754) and the integers of its width, whose kind is `bits`."""

    bits: str
    precision: int
    """Stored bits of the fraction."""
    bias: int
    sign: int
    one: int
    least: int
    """The smallest normal number, as bits."""
    infinity: int
    shift: float
    """Added to a number, leaves its nearest integer, ties to even, in the last bits: one operation on any machine."""


def _format(width: int, precision: int) -> Format:
    bias = (1 << (width - precision - 2)) - 1
    infinity = (2 * bias + 1) << precision
    shift = 1.5 * 2.0**precision
    return Format(f"i{width}", precision, bias, 1 << (width - 1), bias << precision, 1 << precision, infinity, shift)


FORMATS = {"f64": _format(64, 52), "f32": _format(32, 23)}

Operand: TypeAlias = "Expression | float"


class Expression:
    """A node of a graph; operators and methods make further nodes, numbers beside them become constants of its kind.

    ``<<`` and ``>>`` are logical shifts of integers, ``&``, ``|``, ``^`` and ``~`` also combine flags.
    """

    __slots__ = ("graph", "node")

    def __init__(self, graph: Graph, node: int) -> None:
        self.graph = graph
        self.node = node

    @property
    def kind(self) -> str:
        return self.graph.kind[self.node]

    @property
    def format(self) -> Format:
        """Of a float or an integer of its width."""
        return FORMATS["f" + self.kind[1:]]

    def _make(self, op: str, *others: Operand, reverse: bool = False) -> Expression:
        nodes = [self.node, *(o.node if isinstance(o, Expression) else self.constant(o).node for o in others)]
        return Expression(self.graph, self.graph.make(op, *(nodes[::-1] if reverse else nodes)))

    def constant(self, value: float) -> Expression:
        """A number of this one's kind; an integer beyond it keeps its low bits."""
        return Expression(self.graph, self.graph.constant(value, self.kind))

    def __add__(self, other: Operand) -> Expression:
        return self._make("add", other)

    def __radd__(self, other: float) -> Expression:
        return self._make("add", other)

    def __sub__(self, other: Operand) -> Expression:
        return self._make("sub", other)

    def __rsub__(self, other: float) -> Expression:
        return self._make("sub", other, reverse=True)

    def __mul__(self, other: Operand) -> Expression:
        return self._make("mul", other)

    def __rmul__(self, other: float) -> Expression:
        return self._make("mul", other)

    def __truediv__(self, other: Operand) -> Expression:
        return self._make("div", other)

    def __rtruediv__(self, other: float) -> Expression:
        return self._make("div", other, reverse=True)

    def __neg__(self) -> Expression:
        return self._make("neg")

    def __abs__(self) -> Expression:
        return self._make("abs")

    def __and__(self, other: Operand) -> Expression:
        return self._make("and", other)

    def __or__(self, other: Operand) -> Expression:
        return self._make("or", other)

    def __xor__(self, other: Operand) -> Expression:
        return self._make("xor", other)

    def __invert__(self) -> Expression:
        return self._make("not")

    def __lshift__(self, other: Operand) -> Expression:
        return self._make("shl", other)

    def __rshift__(self, other: Operand) -> Expression:
        return self._make("shr", other)

    def __lt__(self, other: Operand) -> Expression:
        return self._make("lt", other)

    def __le__(self, other: Operand) -> Expression:
        return self._make("le", other)

    def __gt__(self, other: Operand) -> Expression:
        return self._make("gt", other)

    def __ge__(self, other: Operand) -> Expression:
        return self._make("ge", other)

    def equals(self, other: Operand) -> Expression:
        return self._make("eq", other)

    def sqrt(self) -> Expression:
        return self._make("sqrt")

    def arithmetic_shift(self, by: int) -> Expression:
        """An integer divided by a power of two, rounded down."""
        return self._make("sar", by)

    def bits(self) -> Expression:
        """A float's bits as an integer."""
        return Expression(self.graph, self.graph.make("bitcast", self.node, kind=self.format.bits))

    def floating(self) -> Expression:
        """The float whose bits an integer is."""
        return Expression(self.graph, self.graph.make("bitcast", self.node, kind="f" + self.kind[1:]))

    def convert(self, kind: str) -> Expression:
        """The nearest number of a kind, truncated if an integer."""
        return Expression(self.graph, self.graph.make("convert", self.node, kind=kind))

    def sign_bit(self) -> Expression:
        """Of a float, -0 and NaN included: all other bits 0."""
        return self.bits() & self.format.sign

    def times_sign(self, sign: Expression) -> Expression:
        """A float, negated where the `sign_bit` is set."""
        return (self.bits() ^ sign).floating()

    def negative(self) -> Expression:
        """Whether the sign bit is set."""
        return self.bits() < 0


def function(body: Callable[..., Expression]) -> Callable[..., int]:
    """A function of expressions as one of a graph and its nodes."""

    @wraps(body)
    def on_nodes(graph: Graph, *nodes: int) -> int:
        return body(*(Expression(graph, int(node)) for node in nodes)).node

    return on_nodes


def select(where: Expression, true: Operand, false: Operand) -> Expression:
    """One of two numbers, at least one of which is an expression."""
    some = true if isinstance(true, Expression) else false
    assert isinstance(some, Expression)
    nodes = (x.node if isinstance(x, Expression) else some.constant(x).node for x in (true, false))
    return Expression(where.graph, where.graph.make("select", where.node, *nodes))


def rarely(where: Expression, *choices: tuple[Expression, Expression]) -> tuple[Expression, ...]:
    """Of each pair the first where `where` holds, which is seldom: what only it needs is skipped otherwise."""
    graph = where.graph
    instance = graph.instance((where.node, *((a.node, b.node) for a, b in choices)))
    made = (graph.make("branch", where.node, a.node, b.node, value=instance) for a, b in choices)
    return tuple(Expression(graph, node) for node in made)


def polynomial(x: Expression, coefficients: Sequence[float]) -> Expression:
    """``c[0] + c[1] x + c[2] x^2 + ...`` by Horner's rule."""
    total = x.constant(coefficients[-1])
    for c in coefficients[-2::-1]:
        total = total * x + c
    return total
