"""The values of nodes while a program is written: a scalar where all runs share them, else a vector of lanes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from jaxfilt.lanes.arithmetic import operation
from jaxfilt.lanes.graph import Graph
from jaxfilt.lanes.reach import Reach
from jaxfilt.lanes.schedule import Choice
from jaxfilt.lanes.writer import Writer, constant, type_of

LONG = 5000
"""Operations of a row from which on their order is kept, see `Values.items`."""

_STRETCH = 40


class Values:
    """What has been computed so far.

    Args:
        w: where it is written.
        graph: the nodes.
        reach: which of them all runs share.
        lanes: how many runs there are in a vector.
        wanted: the shared nodes that are needed in all lanes too.
        read: defines an input.
    """

    def __init__(
        self, w: Writer, graph: Graph, reach: Reach, lanes: int, wanted: set[int], read: Callable[[int], None]
    ) -> None:
        self.w, self.graph, self.reach, self.lanes = w, graph, reach, lanes
        self._wanted, self._read = wanted, read
        self._scalar: dict[int, str] = {}
        self._wide: dict[int, str] = {}
        self._waiting: dict[int, list[list]] = {}
        self._long = len(reach.live) > LONG
        self._written = 0

    def __contains__(self, node: int) -> bool:
        return node in self._wide

    def scalar(self, node: int) -> str:
        """A node that all runs share."""
        return self._of(node, 1)

    def wide(self, node: int) -> str:
        """A node in all lanes."""
        return self._of(node, self.lanes)

    def define(self, node: int, value: str) -> None:
        """The value of a node: a scalar if all runs share it."""
        if not self.reach.shared(node):
            self._wide[node] = value
            return
        self._scalar[node] = value
        if node in self._wanted:
            self._wide[node] = self.w.broadcast(value, self.graph.kind[node], self.lanes)

    def items(self, items: list) -> None:
        """Computes nodes and choices in their order.

        LLVM's scheduler takes a row as one list of instructions, in which it looks for others to do while one waits.
        In a long one it draws so much together that most values are moved to memory and back (of a quadrotor's EKF,
        half of all instructions, which are a quarter more). It does not move anything over a label, of which there is
        nothing left in the code; in a short row, what it finds is worth more.
        """
        for item in items:
            if isinstance(item, Choice):
                self._choice(item)
                continue
            if self.graph.op[item] == "input":
                self._read(item)
            else:
                args = self.graph.args[item]
                self._compute(item, self.graph.op[item], [self.graph.known(a) for a in args])
            self._settle(item)
            self._written += 1
            if self._long and self._written % _STRETCH == 0:
                self.w.barrier()

    def when(self, nodes: Sequence[int], then: Callable[[], None]) -> None:
        """Does something as soon as nodes are defined; those that do not move from row to row are by now."""
        moving = {node for node in nodes if self.reach.moves(node)}
        entry = [len(moving), then]
        for node in moving:
            self._waiting.setdefault(node, []).append(entry)
        if not moving:
            then()

    def guarded(self, condition: str, items: list, results: Sequence[int], then: Callable[[], None]) -> None:
        """Computes items, and does something, only if a condition holds; their results are zero otherwise."""
        w = self.w
        before, inside, after = w.label, w.fresh("take"), w.fresh("skip")
        w.do(f"br i1 {condition}, label %{inside}, label %{after}")
        w.begin(inside)
        self.items(items)
        then()
        end = w.label
        w.do(f"br label %{after}")
        w.begin(after)
        found = []
        for node in results:
            lanes = self._lanes(node)
            ways = f"[ {self._of(node, lanes)}, %{end} ], [ zeroinitializer, %{before} ]"
            found.append(w.let(f"phi {type_of(self.graph.kind[node], lanes)} {ways}"))
        for node, value in zip(results, found, strict=True):
            self.define(node, value)

    def _lanes(self, node: int) -> int:
        return 1 if self.reach.shared(node) else self.lanes

    def _of(self, node: int, lanes: int) -> str:
        known = self.graph.known(node)
        if known is not None:
            return constant(known, self.graph.kind[node], lanes)
        return (self._scalar if lanes == 1 else self._wide)[node]

    def _compute(self, node: int, op: str, known: Sequence) -> None:
        graph, lanes = self.graph, self._lanes(node)
        args = graph.args[node]
        values = [self._of(a, lanes) for a in args]
        self.define(node, operation(self.w, op, graph.kind[node], graph.kind[args[0]], values, known, lanes))

    def _settle(self, node: int) -> None:
        for entry in self._waiting.pop(node, ()):
            entry[0] -= 1
            if not entry[0]:
                entry[1]()

    def _choice(self, choice: Choice) -> None:
        """Sides that some run takes, then a select for each node: with a scalar predicate a side is an ``if``."""
        w = self.w
        shared = self.reach.shared(choice.predicate)
        predicate = self.scalar(choice.predicate) if shared else self.wide(choice.predicate)
        for side, items in ((True, choice.true), (False, choice.false)):
            if not items:
                continue
            taken = predicate
            if not shared:
                name = f"llvm.vector.reduce.{'or' if side else 'and'}.v{self.lanes}i1"
                taken = w.call(name, "i1", (type_of("b", self.lanes), predicate))
            if not side:
                taken = w.let(f"xor i1 {taken}, true")
            self.guarded(taken, items, self._results(choice, side, items), lambda: None)
        for node in choice.nodes:
            self._compute(node, "branch", [None] * 3)
            self._settle(node)

    def _results(self, choice: Choice, side: bool, items: list) -> list[int]:
        """The nodes of a side that the choice is between."""
        inside = {n for item in items for n in (item.nodes if isinstance(item, Choice) else (item,))}
        wanted = dict.fromkeys(self.graph.args[node][1 if side else 2] for node in choice.nodes)
        return [node for node in wanted if node in inside]
