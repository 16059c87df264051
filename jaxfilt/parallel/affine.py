"""Whether a function is affine in its argument, read off the operations that it is made of.

Its Jacobian would not do: that of ``x + sign(x)`` is the identity wherever it exists. So each operation says what it
makes of values without x, affine in x, or neither; one that is not in these tables is taken to be no affine one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import Literal

from jaxfilt.types import PyTree


class Grade(NamedTuple):
    """How a value hangs on x: level 0 not at all, 1 affinely, 2 otherwise, and then first ``by`` this operation."""

    level: int
    by: str = ""


CONSTANT, AFFINE = Grade(0), Grade(1)

SUMS = {
    *("add", "add_any", "broadcast_in_dim", "concatenate", "copy", "cumsum", "expand_dims", "neg", "pad"),
    *("reduce_sum", "reshape", "rev", "slice", "split", "squeeze", "stack", "sub", "transpose"),
}
"""Affine in all of their operands together."""

PRODUCTS = {"mul", "dot_general"}
"""Affine in either operand."""

AFFINE_IN = {
    "div": {0},
    "dynamic_slice": {0},
    "dynamic_update_slice": {0, 1},
    "gather": {0},
    "scatter": {0, 2},
    "scatter-add": {0, 2},
    "triangular_solve": {1},
}
"""Affine in these operands together, not in the others."""

CALLS = {"checkpoint", "closed_call", "custom_jvp_call", "custom_vjp_call", "jit", "remat2"}


def grade(function: Callable[..., PyTree], x: PyTree, *others: Any) -> Grade:
    """How ``function(x, *others)`` hangs on x; arrays or their shapes and dtypes will do."""
    jaxpr = jax.make_jaxpr(function)(x, *others).jaxpr
    many = len(jax.tree.leaves(x))
    return max(_walk(jaxpr, [AFFINE] * many + [CONSTANT] * (len(jaxpr.invars) - many)), default=CONSTANT)


def _walk(jaxpr: Any, given: list[Grade]) -> list[Grade]:
    grades = dict.fromkeys(jaxpr.constvars, CONSTANT) | dict(zip(jaxpr.invars, given, strict=True))

    def of(atom: Any) -> Grade:
        return CONSTANT if isinstance(atom, Literal) else grades[atom]

    for eqn in jaxpr.eqns:
        grades.update(zip(eqn.outvars, _through(eqn, [of(atom) for atom in eqn.invars]), strict=True))
    return [of(atom) for atom in jaxpr.outvars]


def _through(eqn: Any, given: list[Grade]) -> list[Grade]:
    """The grades of what an operation returns, from those of its operands."""
    name, worst = eqn.primitive.name, max(given, default=CONSTANT)
    if worst == CONSTANT:
        return [CONSTANT] * len(eqn.outvars)
    if name in CALLS:
        inner = eqn.params["jaxpr"] if "jaxpr" in eqn.params else eqn.params["call_jaxpr"]
        return _walk(getattr(inner, "jaxpr", inner), given)
    if name == "scan":
        return _repeated(eqn.params, given)
    if name == "cond" and given[0] == CONSTANT:
        found = [_walk(branch.jaxpr, given[1:]) for branch in eqn.params["branches"]]
        return [max(grades) for grades in zip(*found, strict=True)]
    kept = worst.level == 2 or _is_affine(eqn, name, [g.level > 0 for g in given])
    return [worst if kept else Grade(2, name)] * len(eqn.outvars)


def _is_affine(eqn: Any, name: str, hangs: list[bool]) -> bool:
    if name == "convert_element_type":
        return jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.floating)
    if name == "select_n":
        return not hangs[0]
    if name in PRODUCTS:
        return sum(hangs) == 1
    return name in SUMS or (name in AFFINE_IN and {k for k, yes in enumerate(hangs) if yes} <= AFFINE_IN[name])


def _repeated(params: dict[str, Any], given: list[Grade]) -> list[Grade]:
    """Of a loop: what it carries is graded again until that no longer changes."""
    first, last = params["num_consts"], params["num_consts"] + params["num_carry"]
    while True:
        found = _walk(params["jaxpr"].jaxpr, given)
        carry = [max(pair) for pair in zip(given[first:last], found, strict=False)]
        if carry == given[first:last]:
            return found
        given = [*given[:first], *carry, *given[last:]]
