"""Arrays of nodes: what an array of a traced program is while it is being lowered."""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np

from jaxfilt.lanes.graph import KINDS, Graph, kind_of

Nodes = np.ndarray
"""Numbers of nodes, int64, in the shape of the array that they stand for."""


class Unsupported(Exception):
    """A program that no kernel can be made of, for now.

    Attributes:
        primitive: the name of the JAX operation that is in the way.
        why: what is not handled of it.
        where: the line of the user's program that it comes from, as ``file:line``, or "".
    """

    def __init__(self, primitive: str, why: str, where: str = "") -> None:
        super().__init__(f"{primitive}: {why}" + (f" ({where})" if where else ""))
        self.primitive, self.why, self.where = primitive, why, where


def kind(dtype: np.typing.DTypeLike) -> str:
    """The kind of a dtype.

    Raises:
        Unsupported: a dtype that no kernel handles, such as float16.
    """
    if dtype == jax.dtypes.float0:
        return "b"  # the tangent of an integer: no number at all, and read by nobody
    try:
        return kind_of(dtype)
    except (KeyError, TypeError):
        raise Unsupported("dtype", f"expected one of {', '.join(map(str, KINDS.values()))}, got {dtype}") from None


def literal(graph: Graph, array: np.typing.ArrayLike) -> Nodes:
    """The nodes of numbers that are known now.

    Raises:
        Unsupported: a dtype that no kernel handles.
    """
    array = np.asarray(array)
    number = kind(array.dtype)
    if array.dtype == jax.dtypes.float0:
        array = np.zeros(array.shape, bool)
    return shaped([graph.constant(x, number) for x in array.ravel()], array.shape)


def known(graph: Graph, nodes: Nodes) -> np.ndarray | None:
    """The numbers of an array whose nodes are all constants, None of any other."""
    values = [graph.known(node) for node in nodes.ravel().tolist()]
    if any(value is None for value in values):
        return None
    return np.array(values).reshape(nodes.shape)


def shaped(nodes: list[int], shape: tuple[int, ...]) -> Nodes:
    """A list of nodes as an array."""
    return np.array(nodes, np.int64).reshape(shape)


def mapped(function: Callable[..., int], *arrays: Nodes) -> Nodes:
    """A function of nodes, element by element."""
    if len({a.shape for a in arrays}) > 1:
        arrays = tuple(np.broadcast_arrays(*arrays))
    lists = [a.ravel().tolist() for a in arrays]
    return shaped([function(*nodes) for nodes in zip(*lists, strict=True)], arrays[0].shape)
