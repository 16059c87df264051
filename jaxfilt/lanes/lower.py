"""From a traced program of small arrays to a graph of scalars."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend import core

from jaxfilt.lanes.graph import Graph
from jaxfilt.lanes.nodes import Nodes, Unsupported, literal, shaped
from jaxfilt.lanes.rules import RULES

__all__ = ["Unsupported", "literal", "lower"]

EQUATIONS = 50_000
"""Most equations that are lowered, those of an unrolled loop counted each time: beyond them code no longer pays."""

THREEFRY, WORDS = "key<fry>", 2
"""The dtype of the random keys that are lowered, and how many words one has."""

NODES = 400_000
"""Most nodes that a graph may grow to, dead ones included."""


def lower(closed: core.ClosedJaxpr, graph: Graph, consts: Sequence[Nodes], args: Sequence[Nodes]) -> list[Nodes]:
    """Add a program to a graph.

    Args:
        closed: the program, from `jax.make_jaxpr`.
        graph: what its operations are added to.
        consts: the nodes of each of its constants, in their shapes.
        args: the nodes of each of its arguments, in their shapes. A random key is its two words: shape (..., 2).

    Returns:
        The nodes of each of its results, in the same form.

    Raises:
        Unsupported: an operation, a dtype or a size that cannot be lowered.
    """
    jaxpr, lowering = closed.jaxpr, Lowering(graph)
    given = [
        lowering.wrapped(nodes) if is_key(v.aval) else nodes
        for v, nodes in zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *args], strict=True)
    ]
    found = lowering.run(jaxpr, given[: len(jaxpr.constvars)], given[len(jaxpr.constvars) :])
    return [lowering.unwrapped(a) if is_key(v.aval) else a for v, a in zip(jaxpr.outvars, found, strict=True)]


def is_key(aval: Any) -> bool:
    """Whether values of this type are random keys.

    Raises:
        Unsupported: of another generator than JAX's default.
    """
    if not jnp.issubdtype(aval.dtype, jax.dtypes.prng_key):
        return False
    if aval.dtype.name != THREEFRY:
        raise Unsupported("key", f"expected keys of JAX's default generator, {THREEFRY}, got {aval.dtype.name}")
    return True


class Lowering:
    """A program on its way into a graph; rules are handed it.

    A random key is a negative number that stands for the nodes of its words, so that keys are moved about as numbers
    are.
    """

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self._keys: list[tuple[int, ...]] = []
        self._number: dict[tuple[int, ...], int] = {}
        self.equations = 0

    def foresee(self, primitive: str, equations: int) -> None:
        """Refuse what is going to be too much."""
        if self.equations + equations > EQUATIONS or len(self.graph) > NODES:
            raise Unsupported(primitive, f"more than {EQUATIONS} operations on arrays or {NODES} on numbers")

    def run(self, jaxpr: Any, consts: Sequence[Nodes], args: Sequence[Nodes]) -> list[Nodes]:
        """The results of an open program."""
        values: dict[Any, Nodes] = dict(zip(jaxpr.constvars, consts, strict=True))
        values.update(zip(jaxpr.invars, args, strict=True))

        def read(v: Any) -> Nodes:
            return self.literal(v.val, v.aval) if isinstance(v, core.Literal) else values[v]

        for equation in jaxpr.eqns:
            found = self._equation(equation, [read(v) for v in equation.invars])
            values.update(zip(equation.outvars, found, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def closed(self, closed: Any, args: Sequence[Nodes]) -> list[Nodes]:
        """The results of a program with its constants."""
        consts = [self.literal(c, v.aval) for v, c in zip(closed.jaxpr.constvars, closed.consts, strict=True)]
        return self.run(closed.jaxpr, consts, args)

    def literal(self, value: Any, aval: Any) -> Nodes:
        """The nodes of a value that is known now."""
        if isinstance(value, Tracer):
            raise Unsupported("constant", "a value of an enclosing transformation; make it an argument")
        if is_key(aval):
            return self.wrapped(literal(self.graph, np.asarray(jax.random.key_data(value))))
        return literal(self.graph, np.asarray(value, aval.dtype))

    def wrapped(self, words: Nodes) -> Nodes:
        """Keys, from their words along the last axis."""
        return shaped([self._key(tuple(key)) for key in words.reshape(-1, words.shape[-1]).tolist()], words.shape[:-1])

    def unwrapped(self, keys: Nodes) -> Nodes:
        """The words of keys, along a new last axis."""
        words = [self._keys[~key] for key in keys.ravel().tolist()]
        return np.array(words, np.int64).reshape(*keys.shape, WORDS)

    def pick(self, predicate: int, yes: int, no: int, instance: int | None = None) -> int:
        """One of two nodes or keys, by a `jax.lax.cond` if an instance is named."""
        if yes < 0:
            pairs = zip(self._keys[~yes], self._keys[~no], strict=True)
            return self._key(tuple(self.pick(predicate, *pair, instance) for pair in pairs))
        return self.graph.make("select" if instance is None else "branch", predicate, yes, no, value=instance)

    def _key(self, words: tuple[int, ...]) -> int:
        if words not in self._number:
            self._number[words] = ~len(self._keys)
            self._keys.append(words)
        return self._number[words]

    def _equation(self, equation: Any, args: list[Nodes]) -> Sequence[Nodes]:
        name = equation.primitive.name
        self.equations += 1
        try:
            self.foresee(name, 0)
            if name not in RULES:
                raise Unsupported(name, "no rule for this operation")
            found = RULES[name](self, equation, *args)
        except Unsupported as error:
            if error.where:
                raise
            raise Unsupported(error.primitive, error.why, line_of(equation)) from None
        return found if equation.primitive.multiple_results else (found,)


def line_of(equation: Any) -> str:
    """The line of the program, outside of JAX, that an equation comes from; "" where that is not known."""
    traceback = equation.source_info.traceback
    inside = Path(jax.__file__).parent
    for frame in traceback.frames if traceback is not None else ():
        if inside not in Path(frame.file_name).parents:
            return f"{frame.file_name}:{frame.line_num}"
    return ""
