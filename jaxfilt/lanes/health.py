"""Which numbers to watch, so that none that was folded away with ``0 * x`` can have been infinite or NaN unseen."""

from __future__ import annotations

from jaxfilt.lanes.graph import Graph
from jaxfilt.lanes.program import Program
from jaxfilt.lanes.reach import living

# What these give is not finite if any of these arguments is not.
_PASS_ON = {
    "add": (0, 1), "sub": (0, 1), "mul": (0, 1), "neg": (0,), "abs": (0,), "sqrt": (0,),
    "div": (0,), "floor": (0,), "ceil": (0,), "round": (0,),
}  # fmt: skip

# What these give is finite if all arguments are, but for an overflow beyond the largest float.
_SAFE = {"add", "sub", "mul", "neg", "abs", "floor", "ceil", "round", "max", "min", "select", "branch"}


def watch(program: Program) -> tuple[list[int], set[int]]:
    """Nodes whose sum must be finite in each row, and slots that must be finite at the end.

    Each folded x leads, through operations that pass on what is not finite and from row to row through the slots, to
    one of them.
    """
    graph = program.graph
    live = living(program)
    targets = _resolved(graph, live)
    ahead = _ahead(program, live)
    found: list[int] = []
    covered: set[int] = set()
    behind: dict[int, list[int]] = {}
    for node, nexts in ahead.items():
        for n in nexts:
            behind.setdefault(n, []).append(node)
    # Slots first: what reaches one of them is seen there, and most does.
    last = {slot.after for slot in program.slots}
    for target in sorted(targets):
        if target in covered:
            continue
        reach = _closure({target}, ahead)
        best = max(reach & last, default=None)
        best = max(reach) if best is None else best
        found.append(best)
        covered |= _closure({best}, behind)
    inputs = {graph.value[n][1]: n for n in live if graph.op[n] == "input" and graph.value[n][0] == "carry"}
    loose = {k for k, n in inputs.items() if n in covered and program.slots[k].kind[0] == "f"}
    return found, loose if found else set()


def _resolved(graph: Graph, live: set[int]) -> set[int]:
    """The folded nodes; of one that nothing else needs those that it is made of, so that it need not be computed."""
    targets: set[int] = set()
    seen: set[int] = set()
    stack = list(graph.folded)
    while stack:
        node = stack.pop()
        if node in seen or graph.op[node] == "constant" or graph.kind[node][0] != "f":
            continue
        seen.add(node)
        if node not in live and graph.op[node] in _SAFE:
            stack += graph.args[node]
        else:
            targets.add(node)
    return targets


def _ahead(program: Program, live: set[int]) -> dict[int, list[int]]:
    """node -> nodes that are not finite when it is not: of this row, and of the next through the slots."""
    graph = program.graph
    ahead: dict[int, list[int]] = {}
    for node in live:
        for k in _PASS_ON.get(graph.op[node], ()):
            if graph.kind[node][0] == "f":
                ahead.setdefault(graph.args[node][k], []).append(node)
        if graph.op[node] == "convert" and graph.kind[node][0] == graph.kind[graph.args[node][0]][0] == "f":
            ahead.setdefault(graph.args[node][0], []).append(node)
    for node in live:
        if graph.op[node] == "input" and graph.value[node][0] == "carry":
            ahead.setdefault(program.slots[graph.value[node][1]].after, []).append(node)
    return ahead


def _closure(start: set[int], edges: dict[int, list[int]]) -> set[int]:
    reached, stack = set(start), list(start)
    while stack:
        for n in edges.get(stack.pop(), ()):
            if n not in reached:
                reached.add(n)
                stack.append(n)
    return reached
