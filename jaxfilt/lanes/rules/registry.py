"""A rule for each JAX operation: from the nodes of its operands to the nodes of its results."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

RULES: dict[str, Callable[..., Any]] = {}
"""Name of a primitive -> function of (lowering, equation, nodes of each operand).

It returns the nodes of the result, or a sequence of them where the primitive has several results.
"""


def rule(*primitives: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: the function is the rule of these primitives."""

    def register(function: Callable[..., Any]) -> Callable[..., Any]:
        RULES.update(dict.fromkeys(primitives, function))
        return function

    return register
