"""Options of sensors that may be known, tuned or estimated: a number, or a function of the state."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from jaxfilt.types import Array, PyTree

Option = Array | float | Sequence[float] | Callable[[PyTree], Array]
"""A number or an array, known or from theta, or a function of the state: ``lambda x: x.extra["drift"]``."""


def chosen(option: Option, x: PyTree, like: Array) -> jax.Array:
    """What an option is in this state, in the dtype of ``like``."""
    return jnp.asarray(option(x) if callable(option) else option, like.dtype)
