"""A row of one run, in JAX, becomes a program of scalars.

The program is made under two assumptions, which whoever runs it must check (`Assumed`): what stood in a product with
zero was finite, and numbers of the carry that stay equal, or constant, were so at the start. A covariance is half as
much work where P_ij = P_ji; that it stays so is found out and not asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.core
import numpy as np
from jax.extend import core

from jaxfilt.lanes import health
from jaxfilt.lanes.graph import KINDS, Graph, kind_of
from jaxfilt.lanes.lower import literal, lower
from jaxfilt.lanes.program import Leaf, Output, Program, Slot, Source


class Stored(NamedTuple):
    """Where an output goes, see `jaxfilt.lanes.program.Output`."""

    every: int = 1
    few: bool = False
    summed: bool = False


class Traced(NamedTuple):
    """The equations of a row, (constants, carry, row) -> (carry, outputs), each a flat list of arrays of one run.

    ``given`` are the arrays that the function closed over and that are only known when it runs: further constants, the
    same for all runs, behind the others. ``stored`` says for each output array where it goes.
    """

    closed: core.ClosedJaxpr
    known: tuple[Any, ...]
    given: tuple[Any, ...]
    sizes: tuple[int, int, int]
    stored: tuple[Stored, ...]

    def carried(self) -> Sequence[Any]:
        """Shapes and dtypes of the carry."""
        return self.closed.in_avals[self.sizes[0] : self.sizes[0] + self.sizes[1]]

    def flat(self, constants: list, carry: list, row: list) -> tuple[list, list]:
        """The equations as a function, that closes over nothing."""
        given = iter(constants[self.sizes[0] :])
        consts = [next(given) if c is None else c for c in self.known]
        out = jax.core.eval_jaxpr(self.closed.jaxpr, consts, *constants[: self.sizes[0]], *carry, *row)
        return out[: self.sizes[1]], out[self.sizes[1] :]


class Assumed(NamedTuple):
    """What a program takes for granted.

    ``health``: the number of a carried leaf, beyond those of the caller, that ends as NaN if a number was not finite;
    ``sound``: for each leaf, elements that must be finite at the end. Equal slots and constants are in the `Leaf`.
    """

    health: int | None
    sound: tuple[tuple[int, ...], ...]


def traced(body: Callable, avals: Any, stored: Sequence[Stored] = ()) -> Traced:
    """Trace ``body(constants, carry, row) -> (carry, outputs)`` of flat lists, for arguments of these shapes.

    Raises:
        TypeError: what is carried changes its shape or dtype.
    """
    closed = jax.make_jaxpr(body)(avals.constants, avals.start, avals.rows)
    for before, after in zip(avals.start, closed.out_avals, strict=False):
        if (before.shape, before.dtype) != (after.shape, after.dtype):
            raise TypeError(f"carry: expected {before.dtype}{list(before.shape)} after a row as before it, got {after}")
    known, given = [], []
    for c in closed.consts:
        tracer = isinstance(c, jax.core.Tracer)
        given += [c] if tracer else []
        known.append(None if tracer else np.asarray(c))
    sizes = len(avals.constants), len(avals.start), len(avals.rows)
    return Traced(closed, tuple(known), tuple(given), sizes, tuple(stored))


def program(row: Traced, shared: Any, reverse: bool, strict: bool) -> tuple[Program, Assumed]:
    """The program of a traced row, for arguments of which all runs share those that are said.

    ``strict`` assumes nothing.

    Raises:
        Unsupported: an equation that has no rule, or a type that no kernel handles.
    """
    carried = row.carried()
    guess = _Guess(carried, strict)
    while True:
        graph = Graph(strict)
        sources, outs = _lowered(graph, row, shared, guess)
        after = [int(node) for out in outs[: len(carried)] for node in out.ravel()]
        if guess.holds(graph, after):
            break
    slots, leaves = _slots(graph, guess, carried, shared.start, after)
    outputs = [_output(graph, out, how) for out, how in zip(outs[len(carried) :], row.stored, strict=True)]
    made = Program(graph, tuple(sources), tuple(leaves), tuple(slots), tuple(outputs), reverse)
    if strict:
        return made, Assumed(None, tuple(() for _ in leaves))
    return _watched(made)


def _lowered(graph: Graph, row: Traced, shared: Any, guess: _Guess) -> tuple[list[Source], list[np.ndarray]]:
    sources: list[Source] = []

    def read(aval: Any, alike: bool, moving: bool) -> np.ndarray:
        number, kind = len(sources), kind_of(aval.dtype)
        sources.append(Source(kind, int(np.prod(aval.shape, dtype=int)), alike, moving))
        nodes = [graph.input(("source", number, k), kind) for k in range(sources[-1].size)]
        return np.array(nodes, np.int64).reshape(aval.shape)

    avals, (first, second, _) = row.closed.in_avals, row.sizes
    constants = [read(a, alike, False) for a, alike in zip(avals[:first], shared.constants[:first], strict=True)]
    given = iter(row.given)
    consts = [read(next(given), True, False) if c is None else literal(graph, c) for c in row.known]
    rows = [read(a, alike, True) for a, alike in zip(avals[first + second :], shared.rows, strict=True)]
    carry = guess.nodes(graph)
    return sources, lower(row.closed, graph, consts, [*constants, *carry, *rows])


class _Guess:
    """Which elements of the carry are taken to be equal or constant, until a pass shows that they are not.

    Elements are numbered through all leaves. ``alike`` has for each the first that equals it. The first guess is that
    square leaves are symmetric, and that nothing is constant.
    """

    def __init__(self, avals: Sequence[Any], strict: bool) -> None:
        self.avals, self.strict = avals, strict
        self.alike: list[int] = []
        self.constant: dict[int, np.generic] = {}
        self.refuted: set[int] = set()
        for aval in avals:
            start, size = len(self.alike), int(np.prod(aval.shape, dtype=int))
            own = np.arange(start, start + size).reshape(aval.shape)
            if not strict and aval.ndim >= 2 and aval.shape[-1] == aval.shape[-2]:
                own = np.minimum(own, np.swapaxes(own, -1, -2))
            self.alike += [int(e) for e in own.ravel()]

    def nodes(self, graph: Graph) -> list[np.ndarray]:
        nodes, element = [], 0
        for aval in self.avals:
            kind, own = kind_of(aval.dtype), []
            for _ in range(int(np.prod(aval.shape, dtype=int))):
                known = self.constant.get(element)
                first = self.alike[element]
                own.append(graph.input(("carry", first), kind) if known is None else graph.constant(known, kind))
                element += 1
            nodes.append(np.array(own, np.int64).reshape(aval.shape))
        return nodes

    def holds(self, graph: Graph, after: list[int]) -> bool:
        """Whether all that was guessed is so after the row too; if not, the guess is mended."""
        groups: dict[tuple, int] = {}
        alike = [
            groups.setdefault((first, node), e) for e, (first, node) in enumerate(zip(self.alike, after, strict=True))
        ]
        constant = {}
        for e, node in enumerate(after):
            value = graph.known(node)
            if value is None or e in self.refuted or self.strict:
                continue
            if e not in self.constant or self.constant[e].tobytes() == value.tobytes():
                constant[e] = value
        self.refuted |= set(self.constant) - set(constant)
        same = alike == self.alike and set(constant) == set(self.constant)
        self.alike, self.constant = alike, constant
        return same


def _slots(
    graph: Graph, guess: _Guess, avals: Sequence[Any], shared: Sequence[bool], after: list[int]
) -> tuple[list[Slot], list[Leaf]]:
    number: dict[int, int] = {}
    slots, leaves, element = [], [], 0
    for k, (aval, alike) in enumerate(zip(avals, shared, strict=True)):
        kind, own, constants, begin = kind_of(aval.dtype), [], [], element
        for _ in range(int(np.prod(aval.shape, dtype=int))):
            first = guess.alike[element]
            constant = guess.constant.get(element)
            if constant is None and first not in number:
                number[first] = len(slots)
                slots.append(Slot(kind, k, element - begin, after[first]))
            own.append(-1 if constant is not None else number[first])
            constants.append(constant if constant is not None else KINDS[kind].type(0))
            element += 1
        leaves.append(Leaf(kind, alike, tuple(own), tuple(constants)))
    for node in range(len(graph)):
        if graph.op[node] == "input" and graph.value[node][0] == "carry":
            graph.value[node] = ("carry", number[graph.value[node][1]])
    return slots, leaves


def _output(graph: Graph, nodes: np.ndarray, how: Stored) -> Output:
    numbers = [int(n) for n in nodes.ravel()]
    kind = graph.kind[numbers[0]]
    if how.summed and kind[0] != "f":
        kind = "f64"
        numbers = [graph.make("convert", n, kind=kind) for n in numbers]
    return Output(tuple(numbers), kind, *how)


def _watched(made: Program) -> tuple[Program, Assumed]:
    """The program with a number that becomes NaN when one of the folded ones was not finite."""
    graph = made.graph
    watch, loose = health.watch(made)
    sound = tuple(
        tuple(e for e, slot in enumerate(leaf.slots) if slot in loose and made.slots[slot].element == e)
        for leaf in made.leaves
    )
    if not watch:
        return made, Assumed(None, sound)
    kind = "f64" if any(graph.kind[node] == "f64" for node in watch) else "f32"
    total = None
    for node in watch:
        node = graph.make("convert", node, kind=kind)
        total = node if total is None else graph.make("add", total, node)
    own = graph.input(("carry", len(made.slots)), kind)
    assert total is not None
    nothing = graph.raw("mul", graph.constant(0, kind), total)
    slot = Slot(kind, len(made.leaves), 0, graph.make("add", own, nothing))
    leaf = Leaf(kind, True, (len(made.slots),), (KINDS[kind].type(0),))
    program = made._replace(leaves=(*made.leaves, leaf), slots=(*made.slots, slot))
    return program, Assumed(len(made.leaves), sound)
