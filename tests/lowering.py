"""A function lowered to a scalar graph and evaluated in NumPy or compiled, and the same function as JAX computes it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxfilt.lanes.graph import Graph, kind_of
from jaxfilt.lanes.lower import literal, lower
from jaxfilt.lanes.program import Output, Program, Source
from tests.graphs import evaluate


def lowered(function: Callable, *args: np.ndarray, strict: bool = True) -> tuple[Graph, list[np.ndarray]]:
    """The graph of a function of arrays with a leading axis of lanes, and the nodes of its results.

    Element ``k`` of argument ``n`` is the input ``("source", n, k)``.
    """
    closed = jax.make_jaxpr(lambda *own: jax.tree.leaves(function(*own)))(*(a[0] for a in args))
    graph, nodes = Graph(strict), []
    for n, arg in enumerate(args):
        kind = kind_of(arg.dtype)
        inputs = [graph.input(("source", n, k), kind) for k in range(arg[0].size)]
        nodes.append(np.array(inputs, np.int64).reshape(arg.shape[1:]))
    return graph, lower(closed, graph, [literal(graph, np.asarray(c)) for c in closed.consts], nodes)


def evaluated(graph: Graph, nodes: list[np.ndarray], *args: np.ndarray) -> list[np.ndarray]:
    """The values of arrays of nodes, leading axis lanes."""
    inputs = {
        ("source", n, k): column for n, arg in enumerate(args) for k, column in enumerate(arg.reshape(len(arg), -1).T)
    }
    values = iter(evaluate(graph, [int(node) for a in nodes for node in a.ravel()], inputs))
    lanes = len(args[0])
    return [
        np.array([np.broadcast_to(next(values), lanes) for _ in range(a.size)]).T.reshape(lanes, *a.shape)
        for a in nodes
    ]


def compiled(graph: Graph, nodes: list[np.ndarray], *args: np.ndarray) -> list[np.ndarray]:
    """The same from a kernel: a row of a run for each lane."""
    from jaxfilt.lanes.kernel import Kernel

    sources = tuple(Source(kind_of(arg.dtype), arg[0].size, False, True) for arg in args)
    own = [a for a in nodes if a.size]
    outputs = tuple(Output(tuple(a.ravel().tolist()), graph.kind[a.flat[0]]) for a in own)
    kernel = Kernel(Program(graph, sources, (), (), outputs))
    _, found = kernel([np.ascontiguousarray(arg) for arg in args], [], len(args[0]), 1)
    rest = iter(found)
    return [next(rest).reshape(-1, *a.shape) if a.size else np.zeros((len(args[0]), *a.shape)) for a in nodes]


def computed(function: Callable, *args: np.ndarray, strict: bool = True) -> list[np.ndarray]:
    """The results of a lowered function, leading axis lanes."""
    return evaluated(*lowered(function, *args, strict=strict), *args)


def expected(function: Callable, *args: np.ndarray) -> list[np.ndarray]:
    """The results as JAX computes them."""
    return [np.asarray(a) for a in jax.tree.leaves(jax.jit(jax.vmap(function))(*args))]


def agree(function: Callable[..., Any], *args: np.ndarray, tolerance: float = 0.0, strict: bool = True) -> None:
    """Assert that a lowered function computes what JAX does, NaN and inf in the same places.

    Args:
        tolerance: relative, to the element and to the largest one; 0 for the very same.
    """
    got, want = computed(function, *args, strict=strict), expected(function, *args)
    assert len(got) == len(want)
    for k, (ours, theirs) in enumerate(zip(got, want, strict=True)):
        assert ours.shape == theirs.shape
        assert ours.dtype == theirs.dtype or not ours.size
        if theirs.dtype.kind == "f" and tolerance:
            scale = np.max(np.abs(theirs), initial=0, where=np.isfinite(theirs))
            np.testing.assert_allclose(ours, theirs, rtol=tolerance, atol=tolerance * scale, err_msg=f"result {k}")
        else:
            np.testing.assert_array_equal(ours, theirs, err_msg=f"result {k}")
