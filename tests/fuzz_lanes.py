"""Random programs, lowered and compiled, against JAX.

``python -m tests.fuzz_lanes 5000`` tries so many, from a seed that may follow; the test suite tries a few.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from tests.lowering import compiled, evaluated, expected, lowered

Choose = Callable[[int], int]
"""n -> a number from 0 to n - 1."""

LANES, STEPS, WIDEST = 20, 12, 4
TOLERANCE = 1e-9
SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, 2.0, 0.5, np.inf, -np.inf, np.nan, 1e6, 1e-6])


def _bounded(x: jax.Array) -> jax.Array:
    """Kept from growing without end; NaN stays."""
    return jnp.where(jnp.abs(x) > 1e8, jnp.sign(x), x)


def _unsigned(x: jax.Array) -> jax.Array:
    """Without the sign of a zero, which no lane keeps through ``x + 0``."""
    return jnp.where(x == 0, 0.0, x)


def _tame(x: jax.Array) -> jax.Array:
    """What LAPACK makes of a NaN or inf depends on whose LAPACK it is."""
    return jnp.where(jnp.abs(x) < 1e3, x, 1.0)


def _positive(x: jax.Array) -> jax.Array:
    return _tame(x) @ _tame(x).T + jnp.eye(len(x), dtype=x.dtype)


def _regular(x: jax.Array) -> jax.Array:
    return _tame(x) + 4 * jnp.eye(len(x), dtype=x.dtype)


def _index(x: jax.Array, n: int) -> jax.Array:
    """A number that depends on the data, often out of range."""
    return jnp.where(jnp.abs(x.sum()) < 50, x.sum(), 0.0).astype(jnp.int32) % (n + 2) - 1


ONE: list[Callable[[jax.Array], jax.Array]] = [
    jnp.sin, jnp.cos, jnp.tanh, jnp.arctan, jnp.abs, jnp.negative, jnp.square, jnp.sign, jnp.floor, jnp.round, jnp.cbrt,
    lambda x: jnp.exp(jnp.minimum(x, 5.0)),
    lambda x: jnp.log(jnp.abs(x) + 0.1),
    lambda x: jnp.log1p(jnp.abs(x)),
    lambda x: jnp.sqrt(x),
    lambda x: 1.0 / _unsigned(x),
    lambda x: lax.rsqrt(jnp.abs(x) + 0.5),
    lambda x: jax.nn.sigmoid(x),
    lambda x: lax.erf(x),
    lambda x: jnp.clip(x, -1.0, 1.0),
    lambda x: jnp.isfinite(x).astype(x.dtype),
    lambda x: x**3,
    lambda x: lax.integer_pow(x, -2),
    lambda x: x.astype(jnp.float32).astype(x.dtype),
    lambda x: jnp.where(jnp.abs(x) < 1e6, x, 0.0).astype(jnp.int32).astype(x.dtype),
    lambda x: (jnp.where(jnp.abs(x) < 1e6, x, 0.0).astype(jnp.int32) // 3 ^ 5).astype(x.dtype),
    lambda x: x.T,
    lambda x: x.reshape(-1),
    lambda x: x[None],
    lambda x: jnp.flip(x),
    lambda x: lax.cond(x.sum() > 0, lambda x: x + 1, lambda x: 2 * x, x),
    lambda x: lax.switch(_index(x, 3), [lambda x: x, lambda x: -x, lambda x: x * 3], x),
    lambda x: lax.fori_loop(0, 3, lambda i, c: 0.5 * c + i.astype(x.dtype), x),
    lambda x: jax.jit(lambda x: x * x + x)(x),
    lambda x: jax.grad(lambda x: (jnp.sin(x) * x).sum())(x),
    lambda x: jax.jvp(lambda x: jnp.arctan2(x, x + 1), (x,), (x,))[1],
    lambda x: jax.checkpoint(lambda x: jnp.cos(x) * x)(x),
]  # fmt: skip
"""Of an array of any shape."""

ROWS: list[Callable[[jax.Array], jax.Array]] = [
    lambda x: x.sum(0),
    lambda x: x.max(-1),
    lambda x: x.min(0),
    lambda x: x.mean(-1),
    lambda x: x.prod(0),
    lambda x: jnp.cumsum(x, 0),
    lambda x: lax.cummax(x, 0),
    lambda x: jnp.sort(x, -1),
    lambda x: x[jnp.argsort(x.reshape(len(x), -1)[:, 0])],
    lambda x: jnp.argmax(x, 0).astype(x.dtype),
    lambda x: jnp.argmin(x, -1).astype(x.dtype),
    lambda x: x[0],
    lambda x: x[::-1],
    lambda x: x[-1:],
    lambda x: jnp.concatenate([x, x[:1]])[1:],
    lambda x: jnp.stack([x[0], x[-1]]),
    lambda x: x[_index(x, len(x))],
    lambda x: lax.dynamic_index_in_dim(x, _index(x, len(x)), 0),
    lambda x: jnp.take(x, _index(x, len(x)), axis=0, mode="fill"),
    lambda x: x.at[_index(x, len(x))].add(1.0),
    lambda x: x.at[0].set(3.0),
    lambda x: jnp.pad(x, [(1, 0)] + [(0, 0)] * (x.ndim - 1))[:-1],
    lambda x: jnp.roll(x, 1, 0),
    lambda x: lax.scan(lambda c, r: (0.5 * c + r, c), x[0], x)[1],
    lambda x: lax.map(lambda r: r * r, x),
    lambda x: jnp.outer(x.reshape(-1)[:2], x.reshape(-1)[:3]),
    lambda x: jnp.diag(x.reshape(-1)[:3]),
]
"""Of an array with at least one axis."""

SQUARE: list[Callable[[jax.Array], jax.Array]] = [
    lambda x: x @ x,
    jnp.tril,
    jnp.diagonal,
    lambda x: jnp.linalg.cholesky(_positive(x)),
    lambda x: jnp.linalg.solve(_regular(x), _tame(x)),
    lambda x: jnp.linalg.det(_regular(x)),
    lambda x: jax.scipy.linalg.solve_triangular(_regular(x), _tame(x), lower=True),
]

TWO: list[Callable[[jax.Array, jax.Array], jax.Array]] = [
    jnp.add, jnp.subtract, jnp.multiply, jnp.maximum, jnp.minimum,
    lambda x, y: x / _unsigned(y),
    lambda x, y: jnp.arctan2(_unsigned(x), _unsigned(y)),
    lambda x, y: jnp.where(x < y, x, y * 2),
    lambda x, y: jnp.where(x == y, 1.0, x),
    lambda x, y: lax.rem(x, jnp.where(jnp.abs(y) < 0.1, 1.0, y)),
    lambda x, y: jnp.where((x > 0) & ~(y > 0) | (x >= y), x, y),
    lambda x, y: lax.cond((x > y).all(), lambda: x, lambda: y),
    lambda x, y: lax.pow(jnp.abs(x), jnp.clip(y, -3.0, 3.0)),
]  # fmt: skip
"""Of two arrays of one shape."""


class Step(NamedTuple):
    """A function and which of the arrays so far it is given."""

    function: Callable[..., jax.Array]
    given: tuple[int, ...]


def program(choose: Choose) -> tuple[Callable[..., tuple], tuple[tuple[int, ...], ...]]:
    """A random function of a few arrays, and the shapes of those."""
    shapes = [(), (2,), (3,), (2, 3), (2, 2), (3, 3)]
    inputs = tuple(shapes[choose(len(shapes))] for _ in range(1 + choose(3)))
    avals = [jax.ShapeDtypeStruct(shape, np.float64) for shape in inputs]
    steps: list[Step] = []
    while len(steps) < STEPS:
        step = _step(choose, avals)
        found = jax.eval_shape(step.function, *(avals[i] for i in step.given))
        if found.size <= WIDEST**2 and found.ndim <= 3 and found.dtype == np.float64:
            avals.append(found)
            steps.append(step)

    def run(*args: jax.Array) -> tuple:
        values = list(args)
        for step in steps:
            values.append(_bounded(step.function(*(values[i] for i in step.given))))
        return tuple(values[len(args) :])

    return run, inputs


def _step(choose: Choose, avals: Sequence[Any]) -> Step:
    first = len(avals) - 1 - min(choose(len(avals)), choose(len(avals)))  # rather a late one
    like = [i for i, a in enumerate(avals) if a.shape == avals[first].shape]
    shape = avals[first].shape
    families: list[tuple[list, int]] = [(ONE, 1), (TWO, 2)]
    families += [(ROWS, 1)] if shape and shape[0] > 0 and avals[first].size > 1 else []
    families += [(SQUARE, 1)] * 2 if len(shape) == 2 and shape[0] == shape[1] else []
    functions, operands = families[choose(len(families))]
    others = tuple(like[choose(len(like))] for _ in range(operands - 1))
    return Step(functions[choose(len(functions))], (first, *others))


def check(choose: Choose, seed: int, strict: bool, kernel: bool) -> int:
    """Assert that a random program computes what JAX does; how many numbers were compared.

    A number that JAX itself changes when the inputs change by a few roundings is left out, and, if the program is not
    strict, a lane in which something that it takes to be finite is not.
    """
    function, shapes = program(choose)
    rng = np.random.default_rng(seed)
    args = [rng.normal(size=(LANES, *shape)) * 3 for shape in shapes]
    for arg in args:
        arg[: LANES // 2] = arg[: LANES // 2].round()
        if strict:
            odd = rng.random(arg.shape) < 0.15
            odd[LANES // 2 :] = False
            arg[odd] = rng.choice(SPECIAL, odd.sum())
    graph, nodes = lowered(function, *args, strict=strict)
    got = (compiled if kernel else evaluated)(graph, nodes, *args)
    want = expected(function, *args)
    sound = np.ones(LANES, bool)
    if graph.folded:
        watched = evaluated(graph, [np.array(sorted(graph.folded))], *args)[0]
        sound = np.isfinite(watched).all(1)
    bad = [_differs(ours, theirs)[sound] for ours, theirs in zip(got, want, strict=True)]
    if any(b.any() for b in bad):
        again = [expected(function, *(_nudged(a, rng) for a in args)) for _ in range(4)]
        shaky = [np.any([_differs(a[k], theirs) for a in again], 0)[sound] for k, theirs in enumerate(want)]
        for k, (b, s) in enumerate(zip(bad, shaky, strict=True)):
            lanes = np.flatnonzero(sound)[np.flatnonzero((b & ~s).reshape(len(b), -1).any(1))]
            assert not lanes.size, (
                f"result {k}: {got[k][lanes]}, JAX has {want[k][lanes]}, of {[a[lanes] for a in args]}"
            )
    return sum(b.size for b in bad)


def _nudged(a: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return a * (1 + 1e-14 * rng.normal(size=a.shape)) + np.where(a == 0, 1e-14 * rng.normal(size=a.shape), 0)


def _differs(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    scale = np.max(np.abs(theirs), initial=1.0, where=np.isfinite(theirs))
    return ~np.isclose(ours, theirs, rtol=TOLERANCE, atol=TOLERANCE * min(scale, 1e3), equal_nan=True)


def main(programs: int, first: int = 0) -> None:
    """Try many programs; a failure says its seed."""
    jax.config.update("jax_enable_x64", True)
    compared = 0
    for seed in range(first, first + programs):
        rng = np.random.default_rng(seed)
        try:
            compared += check(lambda n, rng=rng: int(rng.integers(n)), seed, strict=seed % 2 == 0, kernel=seed % 4 < 2)
        except Exception:
            print(f"seed {seed}")
            raise
        if seed % 100 == 99:
            print(f"{seed + 1 - first} programs, {compared} numbers", flush=True)
            jax.clear_caches()


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
