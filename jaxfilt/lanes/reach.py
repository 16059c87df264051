"""What each node depends on: whether it changes from row to row, and whether it differs between runs."""

from __future__ import annotations

from jaxfilt.lanes.program import Program

ONCE, BLOCK, ROW = range(3)
"""Where a node is computed: once in a call, once for a block of runs, in each row."""


def living(program: Program) -> set[int]:
    """The nodes that slots and outputs need."""
    stack = [node for output in program.outputs for node in output.nodes]
    stack += [slot.after for slot in program.slots]
    needed: set[int] = set()
    while stack:
        node = stack.pop()
        if node not in needed:
            needed.add(node)
            stack.extend(program.graph.args[node])
    return needed


class Reach:
    """``live``: the nodes that are needed, in an order in which they can be computed."""

    def __init__(self, program: Program) -> None:
        graph = self._graph = program.graph
        self.live = sorted(living(program))  # a node is made after its arguments
        self._moving: set[int] = set()
        self._shared: set[int] = set()
        self._elements: dict[int, dict[int, int]] = {}
        for node in self.live:
            if self.read(node):
                _, source, element = graph.value[node]
                self._elements.setdefault(source, {})[element] = node
            moving, shared = self._input(program, node) if graph.op[node] == "input" else (False, True)
            if moving or any(a in self._moving for a in graph.args[node]):
                self._moving.add(node)
            if shared and all(a in self._shared for a in graph.args[node]):
                self._shared.add(node)

    @staticmethod
    def _input(program: Program, node: int) -> tuple[bool, bool]:
        place = program.graph.value[node]
        if place[0] == "carry":
            return program.slots[place[1]].after != node, False
        source = program.sources[place[1]]
        return source.moving, source.shared

    def moves(self, node: int) -> bool:
        """Whether a node changes from row to row."""
        return node in self._moving

    def shared(self, node: int) -> bool:
        """Whether a node is the same for all runs."""
        return node in self._shared

    def section(self, node: int) -> int:
        """Where a node is computed."""
        return ROW if node in self._moving else ONCE if node in self._shared else BLOCK

    def read(self, node: int) -> bool:
        """Whether a node is read from a source."""
        return self._graph.op[node] == "input" and self._graph.value[node][0] == "source"

    def elements(self, source: int) -> dict[int, int]:
        """The nodes that read a source, by element."""
        return self._elements.get(source, {})
