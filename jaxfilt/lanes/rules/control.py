"""Rules of calls, branches and loops."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfilt.lanes.nodes import Nodes, Unsupported, known, literal, mapped
from jaxfilt.lanes.rules.registry import rule

if TYPE_CHECKING:
    from jaxfilt.lanes.lower import Lowering

CALLED = ("jaxpr", "call_jaxpr", "fun_jaxpr", "call")
"""What the parameter is called that holds the program of a call."""


@rule(
    "jit", "pjit", "closed_call", "core_call", "call", "remat", "remat2", "checkpoint", "custom_jvp_call",
    "custom_vjp_call", "custom_vjp_call_jaxpr", "custom_vmap_call", "composite",
)  # fmt: skip
def _(lowering: Lowering, equation: Any, *args: Nodes) -> list[Nodes]:
    called = next(equation.params[name] for name in CALLED if name in equation.params)
    if hasattr(called, "consts"):
        return lowering.closed(called, args)
    return lowering.run(called, [], args)


@rule("custom_linear_solve")
def _(lowering: Lowering, equation: Any, *args: Nodes) -> list[Nodes]:
    """The solve itself; its arguments come third, after those of the map and of its transpose."""
    lengths = equation.params["const_lengths"]
    before = lengths.matvec + lengths.vecmat
    ours = args[before : before + lengths.solve]
    return lowering.closed(equation.params["jaxprs"].solve, [*ours, *args[sum(lengths) :]])


@rule("cond")
def _(lowering: Lowering, equation: Any, index: Nodes, *args: Nodes) -> list[Nodes]:
    branches = equation.params["branches"]
    where = lowering.graph.known(index.item())
    if where is not None:
        return lowering.closed(branches[int(np.clip(where, 0, len(branches) - 1))], args)
    return _either(lowering, index.item(), 0, [lowering.closed(branch, args) for branch in branches])


def _either(lowering: Lowering, index: int, first: int, found: list[list[Nodes]]) -> list[Nodes]:
    """The results of the branch that an index names, of those from the first on."""
    if first == len(found) - 1:
        return found[-1]
    others = _either(lowering, index, first + 1, found)
    g = lowering.graph
    if len(found) == 2 and g.op[index] == "convert" and g.kind[g.args[index][0]] == "b":
        predicate, sides = g.args[index][0], (others, found[0])
    else:
        at = g.constant(first, g.kind[index])
        predicate, sides = g.make("eq", index, at), (found[first], others)
    instance = g.instance(("cond", predicate, *(tuple(nodes.ravel().tolist()) for side in sides for nodes in side)))

    def branch(yes: int, no: int) -> int:
        return lowering.pick(predicate, yes, no, instance)

    return [mapped(branch, yes, no) for yes, no in zip(*sides, strict=True)]


@rule("scan")
def _(lowering: Lowering, equation: Any, *args: Nodes) -> list[Nodes]:
    """Each row anew: a loop inside of a row is short."""
    p = equation.params
    fixed, carried = p["num_consts"], p["num_consts"] + p["num_carry"]
    lowering.foresee("scan", p["length"] * len(p["jaxpr"].eqns))
    constants, carry, rows = list(args[:fixed]), list(args[fixed:carried]), args[carried:]
    order = range(p["length"])
    stored: list[Sequence[Nodes]] = []
    for i in reversed(order) if p["reverse"] else order:
        found = lowering.closed(p["jaxpr"], [*constants, *carry, *(x[i] for x in rows)])
        carry = found[: p["num_carry"]]
        stored.append(found[p["num_carry"] :])
    if p["reverse"]:
        stored.reverse()
    outs = equation.outvars[p["num_carry"] :]
    return carry + [
        np.stack([row[k] for row in stored]) if stored else np.zeros(v.aval.shape, np.int64) for k, v in enumerate(outs)
    ]


@rule("while")
def _(lowering: Lowering, equation: Any, *args: Nodes) -> list[Nodes]:
    """Turn by turn, as long as it is known whether there is another."""
    p = equation.params
    of_condition, of_body = args[: p["cond_nconsts"]], args[p["cond_nconsts"] :][: p["body_nconsts"]]
    carry = list(args[p["cond_nconsts"] + p["body_nconsts"] :])
    while True:
        (more,) = lowering.closed(p["cond_jaxpr"], [*of_condition, *carry])
        go_on = known(lowering.graph, more)
        if go_on is None:
            raise Unsupported("while", "how often it turns depends on the data; a fori_loop of fixed length would do")
        if not go_on:
            return carry
        carry = lowering.closed(p["body_jaxpr"], [*of_body, *carry])


@rule("platform_index")
def _(lowering: Lowering, equation: Any) -> Nodes:
    for i, platforms in enumerate(equation.params["platforms"]):
        if platforms is None or "cpu" in platforms:
            return literal(lowering.graph, np.int32(i))
    if equation.params.get("has_default"):  # early JAX: the last branch, which has no name
        return literal(lowering.graph, np.int32(len(equation.params["platforms"])))
    raise Unsupported("platform_index", "nothing for a CPU")
