"""A linear function with a transpose of its own making, as JAX's derivatives need it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
from jax.extend import core
from jax.interpreters import ad, batching, mlir

Arrays = list[jax.Array]
Function = Callable[[Arrays, Arrays], Arrays]

_linear = core.Primitive("lanes_linear")
_linear.multiple_results = True


def apply(
    forward: Function,
    transpose: Function,
    residuals: Arrays,
    arguments: Arrays,
    results: Sequence[jax.ShapeDtypeStruct],
) -> Arrays:
    """``forward(residuals, arguments)``, linear in the arguments, of which ``transpose(residuals, cotangents)`` is the
    transpose.

    Unlike `jax.custom_derivatives.linear_call` it may be mapped over, one item after the other.
    """
    parameters = {"forward": forward, "transpose": transpose, "fixed": len(residuals), "results": tuple(results)}
    return _linear.bind(*residuals, *arguments, **parameters)


def _forward(*arrays: Any, forward: Function, fixed: int, **_: Any) -> Arrays:
    return forward(list(arrays[:fixed]), list(arrays[fixed:]))


def _transpose(cotangents: Arrays, *arrays: Any, transpose: Function, fixed: int, **_: Any) -> list:
    residuals = list(arrays[:fixed])
    whole = [ad.instantiate_zeros(c) for c in cotangents]
    return [None] * fixed + transpose(residuals, whole)


def differentiated_once(*_: Any, **__: Any) -> Any:
    """The rule of what has no derivative of its own."""
    raise NotImplementedError("compiled lanes are differentiated once; backend='xla' has second derivatives")


def _batch(arrays: Any, axes: Any, **parameters: Any) -> tuple[Arrays, list[int]]:
    mapped = [k for k, axis in enumerate(axes) if axis is not None]
    moved = [jnp.moveaxis(arrays[k], axes[k], 0) for k in mapped]

    def one(some: Arrays) -> Arrays:
        full = list(arrays)
        for k, a in zip(mapped, some, strict=True):
            full[k] = a
        return _linear.bind(*full, **parameters)

    found = jax.lax.map(one, moved)
    return found, [0] * len(found)


_linear.def_impl(lambda *arrays, **parameters: jax.jit(lambda *a: _forward(*a, **parameters))(*arrays))
_linear.def_abstract_eval(lambda *_, results, **__: [jax.core.ShapedArray(a.shape, a.dtype) for a in results])
mlir.register_lowering(_linear, mlir.lower_fun(_forward, multiple_results=True))
ad.primitive_transposes[_linear] = _transpose
ad.primitive_jvps[_linear] = differentiated_once
batching.primitive_batchers[_linear] = _batch
