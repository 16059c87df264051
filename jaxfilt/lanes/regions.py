"""Which nodes only one side of a branch needs, so that they can be skipped where no run takes it.

The nodes of one `jax.lax.cond` (branch nodes of one instance and predicate) are one `Choice` with two sides. A node
lies in the innermost side that all its uses lie in: the lowest common ancestor of its uses in the tree of sides.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxfilt.lanes.program import Program
from jaxfilt.lanes.reach import Reach

WORTH = 6
"""Operations that a side must have, for a test and a jump to be cheaper than to compute it."""

_COST = {"constant": 0, "input": 0, "div": 6, "rem": 20, "sqrt": 6}


class Region(NamedTuple):
    """A stretch of code that is run if something holds: None of the top. ``what``: (choice, side), or the (every, few)
    of outputs that not every row or run stores."""

    parent: int
    depth: int
    what: tuple | None


class Regions(NamedTuple):
    """``of``: the region of each node; ``needs``: what a region reads from outside; ``choice`` of a branch node;
    ``members`` of a choice."""

    tree: list[Region]
    of: dict[int, int]
    needs: list[set[int]]
    choice: dict[int, tuple]
    members: dict[tuple, list[int]]
    sides: dict[tuple, int]
    stores: dict[tuple[int, bool], int]


def regions(program: Program, reach: Reach) -> Regions:
    """The tree of sides; those that are not worth a jump, or cannot have one, are dissolved into what is around."""
    plain: set[tuple] = set()
    while True:
        found, stuck = _assigned(program, reach, plain)
        if not stuck:
            small = _small(program, found)
            if not small:
                return found
            plain |= small
        plain |= {(choice, side) for choice in stuck for side in (True, False)}


def _assigned(program: Program, reach: Reach, plain: set[tuple]) -> tuple[Regions, set[tuple]]:
    """The regions, and the choices that wait for themselves: one side's input is another's result."""
    graph = program.graph
    choice, members = _choices(program, reach, plain)
    tree, sides, stores = [Region(-1, 0, None)], {}, {}
    where: dict[int, int] = {}

    def region(parent: int, what: tuple) -> int:
        tree.append(Region(parent, tree[parent].depth + 1, what))
        return len(tree) - 1

    def use(node: int, at: int) -> None:
        where[node] = at if node not in where else _common(tree, where[node], at)

    for output in program.outputs:
        condition = (output.every, output.few)
        at = 0
        if condition != (1, False):
            at = stores[condition] if condition in stores else stores.setdefault(condition, region(0, condition))
        for node in output.nodes:
            use(node, at if reach.moves(node) else 0)
    for slot in program.slots:
        use(slot.after, 0)

    waiting = dict.fromkeys(reach.live, 0)
    for node in reach.live:
        for a in graph.args[node]:
            waiting[a] += 1
    ready = [node for node in reach.live if not waiting[node]]
    gathered: dict[tuple, int] = {}
    while ready:
        node = ready.pop()
        key = choice.get(node)
        if key is None:
            done = [(node, where[node])]
        else:
            gathered[key] = gathered.get(key, 0) + 1
            if gathered[key] < len(members[key]):
                continue
            at = where[members[key][0]]
            for other in members[key]:
                at = _common(tree, at, where[other])
            for side in (True, False):
                if (key, side) not in plain:
                    sides[key, side] = region(at, (key, side))
            done = [(other, at) for other in members[key]]
        for user, at in done:
            where[user] = at
            for position, a in enumerate(graph.args[user]):
                inner = sides.get((key, position == 1), at) if position else at
                use(a, inner if reach.section(a) == reach.section(user) and not reach.read(a) else 0)
                waiting[a] -= 1
                if not waiting[a]:
                    ready.append(a)
    stuck = {key for key in members if gathered.get(key, 0) < len(members[key])}
    found = Regions(tree, where, [set() for _ in tree], choice, members, sides, stores)
    if not stuck:
        _find_needs(program, reach, found)
    return found, stuck


def _choices(program: Program, reach: Reach, plain: set[tuple]) -> tuple[dict[int, tuple], dict[tuple, list[int]]]:
    choice: dict[int, tuple] = {}
    members: dict[tuple, list[int]] = {}
    for node in reach.live:
        if program.graph.op[node] == "branch":
            key = (program.graph.value[node], program.graph.args[node][0], reach.section(node))
            if not {(key, True), (key, False)} <= plain:
                choice[node] = key
                members.setdefault(key, []).append(node)
    return choice, members


def _common(tree: list[Region], a: int, b: int) -> int:
    while a != b:
        if tree[a].depth >= tree[b].depth:
            a = tree[a].parent
        else:
            b = tree[b].parent
    return a


def _find_needs(program: Program, reach: Reach, found: Regions) -> None:
    """Adds, to each region between a use and what it uses, the node."""

    def use(node: int, at: int) -> None:
        while at != found.of[node] and at > 0:
            found.needs[at].add(node)
            at = found.tree[at].parent

    for output in program.outputs:
        for node in output.nodes:
            use(node, found.stores.get((output.every, output.few), 0))
    for user in reach.live:
        at, key = found.of[user], found.choice.get(user)
        for position, a in enumerate(program.graph.args[user]):
            use(a, found.sides.get((key, position == 1), at) if key and position else at)


def _small(program: Program, found: Regions) -> set[tuple]:
    cost = [0] * len(found.tree)
    for node, at in found.of.items():
        price = _COST.get(program.graph.op[node], 1)
        while at > 0:
            cost[at] += price
            at = found.tree[at].parent
    return {what for what, at in found.sides.items() if cost[at] < WORTH}
