"""Scalar graphs evaluated in NumPy, one operation at a time: what compiled lanes are compared with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from jaxfilt.lanes.graph import KINDS, OPERATIONS, Graph, converted


def evaluate(graph: Graph, nodes: Sequence[int], inputs: Mapping[tuple, np.ndarray] | None = None) -> list[np.ndarray]:
    """The values of `nodes`, for each lane.

    Args:
        inputs: for each input that the nodes need, by its ``where``, its value in each lane, (lanes,) or ().

    Returns:
        an array for each node: (lanes,), or () of one that is the same in all lanes.
    """
    values: dict[int, np.ndarray] = {}
    with np.errstate(all="ignore"):
        for node in reachable(graph, nodes):
            args = [values[a] for a in graph.args[node]]
            values[node] = _value(graph, node, args, inputs or {})
    return [values[node] for node in nodes]


def reachable(graph: Graph, nodes: Sequence[int], usual: bool = False) -> list[int]:
    """The nodes that `nodes` are computed from, themselves included, arguments first; `usual`: where no ``branch``
    holds."""
    found: set[int] = set()
    waiting = [int(node) for node in nodes]
    while waiting:
        node = waiting.pop()
        if node not in found:
            found.add(node)
            rare = usual and graph.op[node] == "branch"
            waiting.extend(graph.args[node][::2] if rare else graph.args[node])
    return sorted(found)  # a node is made after its arguments


def size(graph: Graph, nodes: Sequence[int], usual: bool = False) -> int:
    """How many operations `nodes` need: inputs, constants and reinterpreted bits cost none."""
    return sum(graph.op[node] not in ("constant", "input", "bitcast") for node in reachable(graph, nodes, usual))


def _value(graph: Graph, node: int, args: list[np.ndarray], inputs: Mapping[tuple, np.ndarray]) -> np.ndarray:
    op, kind = graph.op[node], graph.kind[node]
    if op == "constant":
        value = np.asarray(graph.value[node])
    elif op == "input":
        value = np.asarray(inputs[graph.value[node]])
    elif op == "convert":
        value = converted(args[0], kind)
    elif op == "bitcast":
        value = np.ascontiguousarray(args[0]).reshape(np.shape(args[0])).view(KINDS[kind])
    elif op in ("select", "branch"):
        value = np.where(*args)
    else:
        value = OPERATIONS[op](*args)
    value = np.asarray(value)
    if value.dtype != KINDS[kind]:
        raise TypeError(f"node {node} ({op}) is {value.dtype}, not {kind}")
    return value
