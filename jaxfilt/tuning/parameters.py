"""Theta as a vector: which of its numbers are free, and what each is called."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.types import Array, PyTree


class Parameters(NamedTuple):
    """The free numbers of a theta: their ``names``, their values ``start`` (p,), and ``tree``, vector (p,) -> theta.

    A number of an array is called after its leaf and its place, "q[2]"; one that is a leaf, after the way to it,
    "mark/0".
    """

    names: tuple[str, ...]
    start: np.ndarray
    tree: Callable[[Array], PyTree]


def parameters(theta: PyTree, frozen: Sequence[str] = ()) -> Parameters:
    """The free numbers of theta.

    Args:
        theta: a pytree of floating numbers and arrays.
        frozen: names of numbers that stay as they are, or what the names of several begin with: "start" is
            "start[0]", "start[1]", "start/x", ...

    Raises:
        ValueError: a name that nothing has, no number left, numbers that are not finite.
        TypeError: a theta that holds something else than floating numbers.

    Example:
        >>> import jax.numpy as jnp
        >>> free = parameters({"q": jnp.array([1.0, 2.0]), "mark": (3.0, 4.0)}, frozen=["mark/1", "q[0]"])
        >>> free.names, free.tree(jnp.array([5.0, 6.0]))["mark"]
        (('mark/0', 'q[1]'), (Array(5., dtype=float32), 4.0))
    """
    leaves, structure = jax.tree.flatten(theta)
    ways = [
        jax.tree_util.keystr(way, simple=True, separator="/") for way, _ in jax.tree_util.tree_leaves_with_path(theta)
    ]
    names: list[list[str]] = []
    for way, leaf in zip(ways, leaves, strict=True):
        if not jnp.issubdtype(jnp.result_type(leaf), np.floating):
            raise TypeError(f"theta: expected floating numbers, got {jnp.result_type(leaf)} for {way or 'theta'!r}")
        if not np.isfinite(np.asarray(leaf)).all():
            raise ValueError(f"theta: expected finite numbers, got {np.asarray(leaf)} for {way or 'theta'!r}")
        names.append([_called(way, index) for index in np.ndindex(np.shape(leaf))])
    every = [name for own in names for name in own]
    for name in frozen:
        if not any(covers(name, own) for own in every):
            raise ValueError(f"frozen: expected some of {', '.join(every)}, or what they begin with, got {name!r}")
    free = [np.array([not any(covers(f, name) for f in frozen) for name in own], bool) for own in names]
    if not any(own.any() for own in free):
        raise ValueError(f"theta: expected a free number, got none: frozen are {', '.join(frozen) or 'none'}")
    start = np.concatenate([np.ravel(np.asarray(leaf))[own] for leaf, own in zip(leaves, free, strict=True)])

    def tree(vector: Array) -> PyTree:
        filled, first = [], 0
        for leaf, own in zip(leaves, free, strict=True):
            places, count = np.flatnonzero(own), int(own.sum())
            if count:
                flat = jnp.ravel(jnp.asarray(leaf, vector.dtype)).at[places].set(vector[first : first + count])
                filled.append(flat.reshape(np.shape(leaf)))
                first += count
            else:
                filled.append(leaf)
        return jax.tree.unflatten(structure, filled)

    return Parameters(
        tuple(n for own, keep in zip(names, free, strict=True) for n, k in zip(own, keep, strict=True) if k),
        start,
        tree,
    )


def _called(way: str, index: tuple[int, ...]) -> str:
    return way + (f"[{','.join(map(str, index))}]" if index else "") or "theta"


def covers(part: str, name: str) -> bool:
    """Whether a name is this one, or begins with it: "start" covers "start/0" and "start[1]", not "starter"."""
    return name == part or name.startswith((part + "/", part + "["))
