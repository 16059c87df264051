"""Rules of random keys and bits, for JAX's default generator: Threefry-2x32 with 20 rounds.

Source: J. K. Salmon, M. A. Moraes, R. O. Dror, D. E. Shaw, Parallel random numbers: as easy as 1, 2, 3 (2011),
section 4.2 and table 2 (rotations).
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jax.extend.random import threefry_prng_impl

from jaxfilt.lanes.graph import Graph
from jaxfilt.lanes.nodes import Nodes, Unsupported, literal
from jaxfilt.lanes.rules.registry import rule

if TYPE_CHECKING:
    from jaxfilt.lanes.lower import Lowering

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
PARITY = 0x1BD11BDA
SETTINGS = ("jax_threefry_partitionable", "jax_enable_x64")
"""Of JAX, which its own functions of keys depend on."""

GENERATOR = "keys of another generator than Threefry, the default of jax.random.key"


@rule("threefry2x32")
def _(lowering: Lowering, equation: Any, *words: Nodes) -> tuple[Nodes, Nodes]:
    shape = equation.outvars[0].aval.shape
    flat = [np.broadcast_to(w, shape).ravel().tolist() for w in words]
    pairs = [_threefry(lowering.graph, *four) for four in zip(*flat, strict=True)]
    first, second = np.array(pairs, np.int64).reshape(-1, 2).T
    return first.reshape(shape), second.reshape(shape)


def _threefry(g: Graph, key0: int, key1: int, x0: int, x1: int) -> tuple[int, int]:
    parity = g.constant(PARITY, "u32")
    key = (key0, key1, g.make("xor", g.make("xor", key0, key1), parity))
    x0, x1 = g.make("add", x0, key[0]), g.make("add", x1, key[1])
    for group in range(5):
        for rotation in ROTATIONS[group % 2]:
            x0 = g.make("add", x0, x1)
            left = g.make("shl", x1, g.constant(rotation, "u32"))
            right = g.make("shr", x1, g.constant(32 - rotation, "u32"))
            x1 = g.make("xor", g.make("or", left, right), x0)
        x0 = g.make("add", x0, key[(group + 1) % 3])
        x1 = g.make("add", g.make("add", x1, key[(group + 2) % 3]), g.constant(group + 1, "u32"))
    return x0, x1


@rule("iota_2x32_shape")
def _(lowering: Lowering, equation: Any) -> tuple[Nodes, Nodes]:
    """The high and the low word of 0, 1, ..."""
    shape = equation.outvars[0].aval.shape
    counted = np.arange(np.prod(shape, dtype=np.uint64), dtype=np.uint64).reshape(shape)
    words = ((counted >> np.uint64(32)), counted & np.uint64(0xFFFFFFFF))
    return literal(lowering.graph, words[0].astype(np.uint32)), literal(lowering.graph, words[1].astype(np.uint32))


@rule("random_wrap")
def _(lowering: Lowering, equation: Any, words: Nodes) -> Nodes:
    return lowering.wrapped(words)


@rule("random_unwrap")
def _(lowering: Lowering, equation: Any, keys: Nodes) -> Nodes:
    return lowering.unwrapped(keys)


@rule("random_clone")
def _(lowering: Lowering, equation: Any, keys: Nodes) -> Nodes:
    return keys


@rule("random_bits")
def _(lowering: Lowering, equation: Any, keys: Nodes) -> Nodes:
    width, shape = equation.params["bit_width"], tuple(equation.params["shape"])
    return _each(lowering, ("random_bits", width, shape), keys.shape, shape, lowering.unwrapped(keys))


@rule("random_split")
def _(lowering: Lowering, equation: Any, keys: Nodes) -> Nodes:
    shape = tuple(equation.params["shape"])
    return lowering.wrapped(_each(lowering, ("split", shape), keys.shape, (*shape, 2), lowering.unwrapped(keys)))


@rule("random_seed")
def _(lowering: Lowering, equation: Any, seeds: Nodes) -> Nodes:
    if equation.params["impl"].tag != threefry_prng_impl.tag:
        raise Unsupported("random_seed", GENERATOR)
    return lowering.wrapped(_each(lowering, ("seed", equation.invars[0].aval.dtype), seeds.shape, (2,), seeds))


@rule("random_fold_in")
def _(lowering: Lowering, equation: Any, keys: Nodes, messages: Nodes) -> Nodes:
    shape = equation.outvars[0].aval.shape
    words = lowering.unwrapped(np.broadcast_to(keys, shape))
    return lowering.wrapped(_each(lowering, ("fold_in",), shape, (2,), words, np.broadcast_to(messages, shape)))


def _each(lowering: Lowering, what: tuple, batch: tuple[int, ...], shape: tuple[int, ...], *arrays: Nodes) -> Nodes:
    """JAX's own function of one key, for each of a batch."""
    closed = _own(what, tuple(getattr(jax.config, name) for name in SETTINGS))
    out = np.empty((*batch, *shape), np.int64)
    for at in np.ndindex(*batch):
        (out[at],) = lowering.closed(closed, [np.asarray(a[at]) for a in arrays])
    return out


@lru_cache(maxsize=256)
def _own(what: tuple, settings: tuple[bool, ...]) -> Any:
    """JAX's own program, which depends on its settings."""
    del settings
    key, message = jax.ShapeDtypeStruct((2,), np.uint32), jax.ShapeDtypeStruct((), np.uint32)
    impl = threefry_prng_impl
    name, rest = what[0], what[1:]
    if name == "seed":
        return jax.make_jaxpr(impl.seed)(jax.ShapeDtypeStruct((), rest[0]))
    if name == "fold_in":
        return jax.make_jaxpr(impl.fold_in)(key, message)
    return jax.make_jaxpr(lambda key: getattr(impl, name)(key, *rest))(key)
