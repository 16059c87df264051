"""The order in which nodes are computed: depth first, so that few values are alive at a time."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from jaxfilt.lanes.program import Program
from jaxfilt.lanes.reach import BLOCK, ONCE, ROW, Reach
from jaxfilt.lanes.regions import Regions, regions

ALWAYS = (1, False)
"""The (every, few) of outputs that are stored in each row, of each run."""


class Choice(NamedTuple):
    """The nodes of one branch. ``true`` and ``false``: what is computed only if some run goes there."""

    nodes: tuple[int, ...]
    predicate: int
    true: list
    false: list


class Schedule(NamedTuple):
    """What is computed where: nodes and choices. ``stored``: before outputs that not all rows or runs store, by their
    (every, few)."""

    once: list
    block: list
    row: list
    stored: dict[tuple[int, bool], list]


def schedule(program: Program, reach: Reach) -> Schedule:
    """The order of a program's nodes."""
    order = _Order(program, reach, regions(program, reach))
    used = [a for node in reach.live for a in program.graph.args[node]]
    always = [output for output in program.outputs if (output.every, output.few) == ALWAYS]
    roots = [node for output in always for node in output.nodes]
    roots += [slot.after for slot in program.slots]
    conditional = [output for output in program.outputs if output not in always]
    everything = [*roots, *(node for output in conditional for node in output.nodes)]
    inner = [node for at in order.regions.stores.values() for node in sorted(order.regions.needs[at])]
    return Schedule(
        order.section(ONCE, used + everything),
        order.section(BLOCK, used + everything),
        order.section(ROW, roots + inner),
        {
            condition: order.region(at, ROW, [n for o in conditional if (o.every, o.few) == condition for n in o.nodes])
            for condition, at in order.regions.stores.items()
        },
    )


class _Order:
    def __init__(self, program: Program, reach: Reach, regions: Regions) -> None:
        self.graph, self.reach, self.regions = program.graph, reach, regions
        self._done: set[int] = set()

    def section(self, section: int, roots: Iterable[int]) -> list:
        return self.region(0, section, roots)

    def region(self, at: int, section: int, roots: Iterable[int]) -> list:
        """The nodes of one region that the roots need, after those that they need."""
        found: list = []
        for root in roots:
            stack = [(root, False)]
            while stack:
                node, ready = stack.pop()
                if not self._due(node, at, section):
                    continue
                if ready:
                    self._add(node, found, section)
                    continue
                stack.append((node, True))
                stack.extend((a, False) for a in reversed(self._before(node)) if self._due(a, at, section))
        return found

    def _due(self, node: int, at: int, section: int) -> bool:
        return (
            node not in self._done
            and self.regions.of[node] == at
            and self.reach.section(node) == section
            and self.graph.op[node] != "constant"
        )

    def _before(self, node: int) -> list[int]:
        """What must be there when a node, or the choice that it is of, is computed."""
        key = self.regions.choice.get(node)
        if key is None:
            return list(self.graph.args[node])
        before = [key[1]]
        for other in self.regions.members[key]:
            before += self.graph.args[other][1:]
        for side in (True, False):
            before += (
                sorted(self.regions.needs[self.regions.sides[key, side]]) if (key, side) in self.regions.sides else []
            )
        return before

    def _add(self, node: int, found: list, section: int) -> None:
        key = self.regions.choice.get(node)
        if key is None:
            found.append(node)
            self._done.add(node)
            return
        nodes = self.regions.members[key]
        true, false = (
            self.region(self.regions.sides[key, side], section, [self.graph.args[n][1 if side else 2] for n in nodes])
            if (key, side) in self.regions.sides
            else []
            for side in (True, False)
        )
        found.append(Choice(tuple(nodes), key[1], true, false))
        self._done.update(nodes)
