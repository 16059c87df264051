"""The rows of a derivative: forward the tangents beside the numbers; backward what reverse mode goes through.

Both are again bodies of a loop, made by JAX's own `jax.jvp` and `jax.vjp` of one row, and compiled like any other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.lanes.program import Leaf

Array = jax.Array
Flat = Callable[[list, list, list], tuple[list, list]]
"""(constants, carry, row) -> (carry, outputs), lists of arrays of one run."""


def is_float(a: Array) -> bool:
    """Whether a number of this array has a derivative."""
    return bool(jnp.issubdtype(a.dtype, np.floating))


def tangents(flat: Flat, counts: tuple[int, int], active: tuple[Sequence[int], Sequence[int]]) -> Flat:
    """The row that carries tangents along: of the constants and rows that are ``active``, by number.

    Its constants, carry and row are those of ``flat`` followed by the tangents; of the carry all floats have one. Its
    outputs are the tangents of the float outputs. ``counts``: how many constants and carried arrays ``flat`` has.
    """

    def body(constants: list, carry: list, row: list) -> tuple[list, list]:
        rows = len(row) - len(active[1])
        primals = [constants[: counts[0]], carry[: counts[1]], row[:rows]]
        moved = [constants[counts[0] :], carry[counts[1] :], row[rows:]]
        chosen = [active[0], [k for k, a in enumerate(primals[1]) if is_float(a)], active[1]]

        def of(*parts: list) -> tuple[tuple[list, list], list]:
            full = [_with(p, k, part) for p, k, part in zip(primals, chosen, parts, strict=True)]
            after, outs = flat(*full)
            return ([a for a in after if is_float(a)], [o for o in outs if is_float(o)]), after

        at = [[p[k] for k in ks] for p, ks in zip(primals, chosen, strict=True)]
        _, (d_carry, d_outs), after = jax.jvp(of, at, moved, has_aux=True)
        return [*after, *d_carry], d_outs

    return body


def saving(flat: Flat, leaves: Sequence[Leaf]) -> Flat:
    """The row that stores the carry it begins with, each number that can differ once."""

    def body(constants: list, carry: list, row: list) -> tuple[list, list]:
        saved = [a.ravel()[_firsts(leaf)] for a, leaf in zip(carry, leaves, strict=True)]
        return flat(constants, carry, row)[0], saved

    return body


def pulling(
    flat: Flat,
    leaves: Sequence[Leaf],
    shapes: Sequence[tuple[int, ...]],
    rows: int,
    active: tuple[Sequence[int], Sequence[int]],
) -> Flat:
    """The row of reverse mode, to be run from the last to the first.

    Its constants are those of ``flat``. It carries the cotangents of the float part of the carry, and the sums of those
    of the ``active`` constants. Its row is that of ``flat`` (``rows`` arrays), then what `saving` stored of the leaves,
    then the cotangents of the float outputs. Its outputs are the cotangents of the active rows.
    """

    def body(constants: list, carry: list, row: list) -> tuple[list, list]:
        own, saved, cotangents = row[:rows], row[rows : rows + len(leaves)], row[rows + len(leaves) :]
        before = [_whole(a, leaf, shape) for a, leaf, shape in zip(saved, leaves, shapes, strict=True)]
        floats = [k for k, a in enumerate(before) if is_float(a)]

        def of(some: list, start: list, moving: list) -> tuple[list, list]:
            full = [_with(constants, active[0], some), _with(before, floats, start), _with(own, active[1], moving)]
            after, outs = flat(*full)
            return [a for a in after if is_float(a)], [o for o in outs if is_float(o)]

        at = [constants[k] for k in active[0]], [before[k] for k in floats], [own[k] for k in active[1]]
        _, pull = jax.vjp(of, *at)
        some, start, moving = pull((carry[: len(floats)], cotangents))
        sums = [total + a for total, a in zip(carry[len(floats) :], some, strict=True)]
        return [*start, *sums], moving

    return body


def _with(arrays: list, where: Sequence[int], values: list) -> list:
    new = list(arrays)
    for k, value in zip(where, values, strict=True):
        new[k] = value
    return new


def _firsts(leaf: Leaf) -> np.ndarray:
    """The first element of each slot of a leaf."""
    first: dict[int, int] = {}
    for element, slot in enumerate(leaf.slots):
        if slot >= 0:
            first.setdefault(slot, element)
    return np.array(list(first.values()), np.int32)


def _whole(saved: Array, leaf: Leaf, shape: tuple[int, ...]) -> jax.Array:
    """The array that `saving` took apart."""
    place: dict[int, int] = {}
    for slot in leaf.slots:
        if slot >= 0:
            place.setdefault(slot, len(place))
    table = jnp.concatenate([saved, jnp.asarray(np.array(leaf.constants, saved.dtype))])
    index = [place[slot] if slot >= 0 else len(place) + e for e, slot in enumerate(leaf.slots)]
    return table[np.array(index, np.int32)].reshape(shape)
