"""Rules of what moves numbers about and changes none: NumPy on the arrays of nodes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfilt.lanes.nodes import Nodes, literal
from jaxfilt.lanes.rules.registry import rule

if TYPE_CHECKING:
    from jaxfilt.lanes.lower import Lowering


@rule("copy", "copy_p", "stop_gradient", "name", "device_put", "sharding_constraint", "optimization_barrier", "pvary")
def _(lowering: Lowering, equation: Any, *args: Nodes) -> Any:
    return args if equation.primitive.multiple_results else args[0]


@rule("reshape", "squeeze", "expand_dims")
def _(lowering: Lowering, equation: Any, x: Nodes, *_: Nodes) -> Nodes:
    return x.reshape(equation.outvars[0].aval.shape)


@rule("broadcast_in_dim")
def _(lowering: Lowering, equation: Any, x: Nodes, *_: Nodes) -> Nodes:
    shape = equation.params["shape"]
    lined_up = [1] * len(shape)
    for axis, size in zip(equation.params["broadcast_dimensions"], x.shape, strict=True):
        lined_up[axis] = size
    return np.broadcast_to(x.reshape(lined_up), shape)


@rule("broadcast_to")
def _(lowering: Lowering, equation: Any, x: Nodes) -> Nodes:
    return np.broadcast_to(x, equation.outvars[0].aval.shape)


@rule("tile")
def _(lowering: Lowering, equation: Any, x: Nodes) -> Nodes:
    return np.tile(x, equation.params["reps"])


@rule("transpose")
def _(lowering: Lowering, equation: Any, x: Nodes) -> Nodes:
    return x.transpose(equation.params["permutation"])


@rule("rev")
def _(lowering: Lowering, equation: Any, x: Nodes) -> Nodes:
    return np.flip(x, equation.params["dimensions"])


@rule("concatenate")
def _(lowering: Lowering, equation: Any, *parts: Nodes) -> Nodes:
    return np.concatenate(parts, equation.params["dimension"])


@rule("stack")
def _(lowering: Lowering, equation: Any, *parts: Nodes) -> Nodes:
    return np.stack(parts, equation.params["axis"])


@rule("unstack")
def _(lowering: Lowering, equation: Any, x: Nodes) -> list[Nodes]:
    return list(np.moveaxis(x, equation.params["axis"], 0))


@rule("split")
def _(lowering: Lowering, equation: Any, x: Nodes) -> list[Nodes]:
    return np.split(x, np.cumsum(equation.params["sizes"])[:-1], equation.params["axis"])


@rule("slice")
def _(lowering: Lowering, equation: Any, x: Nodes) -> Nodes:
    starts, limits = equation.params["start_indices"], equation.params["limit_indices"]
    strides = equation.params["strides"] or (1,) * x.ndim
    return x[tuple(slice(*ends) for ends in zip(starts, limits, strides, strict=True))]


@rule("pad")
def _(lowering: Lowering, equation: Any, x: Nodes, filler: Nodes) -> Nodes:
    padding = equation.params["padding_config"]
    # Room for all of it, gaps too; then what a negative padding takes off at the ends is cut.
    spread = [max((n - 1) * (gap + 1) + 1, 0) for n, (_, _, gap) in zip(x.shape, padding, strict=True)]
    size = [max(low, 0) + n + max(high, 0) for n, (low, high, _) in zip(spread, padding, strict=True)]
    out = np.full(size, filler.item(), np.int64)
    at = [slice(max(low, 0), max(low, 0) + n, gap + 1) for n, (low, _, gap) in zip(spread, padding, strict=True)]
    out[tuple(at)] = x
    return out[tuple(slice(max(-low, 0), n - max(-high, 0)) for n, (low, high, _) in zip(size, padding, strict=True))]


@rule("iota")
def _(lowering: Lowering, equation: Any, *_: Nodes) -> Nodes:
    shape, axis = equation.outvars[0].aval.shape, equation.params["dimension"]
    counted = np.arange(shape[axis]).astype(equation.params["dtype"])
    lined_up = [-1 if i == axis else 1 for i in range(len(shape))]
    return np.broadcast_to(literal(lowering.graph, counted).reshape(lined_up), shape)


@rule("empty", "empty2")
def _(lowering: Lowering, equation: Any) -> Nodes:
    aval = equation.outvars[0].aval
    return np.broadcast_to(literal(lowering.graph, np.zeros((), aval.dtype)), aval.shape)
