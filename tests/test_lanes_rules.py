"""Each JAX operation, lowered to scalars, against JAX itself: on ordinary numbers, and on NaN, inf and the like."""

import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxfilt.lanes.graph import Graph
from jaxfilt.lanes.lower import Unsupported, lower
from tests.lowering import agree, computed, expected, lowered

# No subnormal numbers: JAX on a CPU takes them for zero.
FLOATS = np.array([0.0, -0.0, 1.0, -1.0, 0.5, 1.5, 2.5, -2.5, 0.49999997, 3.7, -1e6, 1e30, np.inf, -np.inf, np.nan])
SIGNED = np.array([0, 1, -1, 2, 3, -7, 31, 32, 33, 64, 100, 2**31 - 1, -(2**31)])
UNSIGNED = np.array([0, 1, 2, 3, 7, 31, 32, 33, 64, 100, 2**31, 2**32 - 1])
FLOAT, INTEGER = (np.float32, np.float64), (np.int32, np.int64, np.uint32, np.uint64)


def specials(dtype: type, operands: int = 1) -> list[np.ndarray]:
    """All tuples of special values of a dtype, as lanes."""
    kind = np.dtype(dtype).kind
    values = {"f": FLOATS, "i": SIGNED, "u": UNSIGNED, "b": np.array([False, True])}[kind].astype(dtype)
    return [np.array(column) for column in zip(*itertools.product(values, repeat=operands), strict=True)]


def numbers(*shape: int, dtype: type = np.float64, seed: int = 0) -> np.ndarray:
    """Ordinary numbers, in 7 lanes."""
    return np.random.default_rng(seed).normal(size=(7, *shape)).astype(dtype)


UNARY = {
    "neg": lax.neg,
    "abs": lax.abs,
    "sign": lax.sign,
    "square": lax.square,
    "floor": lax.floor,
    "ceil": lax.ceil,
    "round to even": lambda x: lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN),
    "round away": lambda x: lax.round(x, lax.RoundingMethod.AWAY_FROM_ZERO),
    "is_finite": lax.is_finite,
    "copy": lax.optimization_barrier,
    "stop_gradient": lax.stop_gradient,
    "bits": lambda x: lax.bitcast_convert_type(x, jnp.int32 if x.dtype == jnp.float32 else jnp.int64),
    "to int32": lambda x: x.astype(jnp.int32),
    "to int64": lambda x: x.astype(jnp.int64),
    "to uint32": lambda x: x.astype(jnp.uint32),
    "to bool": lambda x: x.astype(bool),
    "to float32": lambda x: x.astype(jnp.float32),
    "to float64": lambda x: x.astype(jnp.float64),
    "to the same precision": lambda x: lax.reduce_precision(x, jnp.finfo(x.dtype).nexp, jnp.finfo(x.dtype).nmant),
    **{f"to the power of {n}": lambda x, n=n: lax.integer_pow(x, n) for n in (0, 1, 2, 3, 7, -1, -2)},
}
COMPARED = {op: getattr(lax, op) for op in ("eq", "ne", "lt", "le", "gt", "ge")}
BINARY = {op: getattr(lax, op) for op in ("add", "sub", "mul", "div", "rem", "max", "min", "nextafter")} | COMPARED
ON_INTEGERS = {
    "neg": lax.neg,
    "abs": lax.abs,
    "sign": lax.sign,
    "not": lax.bitwise_not,
    "population_count": lax.population_count,
    "clz": lax.clz,
    "to float32": lambda x: x.astype(jnp.float32),
    "to float64": lambda x: x.astype(jnp.float64),
    "to int32": lambda x: x.astype(jnp.int32),
    "to int64": lambda x: x.astype(jnp.int64),
    "to uint32": lambda x: x.astype(jnp.uint32),
    "to uint64": lambda x: x.astype(jnp.uint64),
    "to bool": lambda x: x.astype(bool),
    "to the power of 3": lambda x: lax.integer_pow(x, 3),
}
BETWEEN_INTEGERS = {
    **{op: getattr(lax, op) for op in ("add", "sub", "mul", "div", "rem", "max", "min")},
    **COMPARED,
    **{f"bitwise_{op}": getattr(lax, f"bitwise_{op}") for op in ("and", "or", "xor")},
    **{op: getattr(lax, op) for op in ("shift_left", "shift_right_logical", "shift_right_arithmetic")},
}


def _same_signs(function: Callable, *args: np.ndarray) -> None:
    agree(function, *args)
    for got, want in zip(computed(function, *args), expected(function, *args), strict=True):
        if want.dtype.kind == "f":
            there = ~np.isnan(want)
            np.testing.assert_array_equal(np.signbit(got)[there], np.signbit(want)[there])


def _all(functions: dict[str, Callable]) -> Callable:
    """All of them in one program: compiling is what takes the time."""
    return lambda *args: [function(*args) for function in functions.values()]


@pytest.mark.parametrize("dtype", FLOAT)
def test_one_float(dtype: type) -> None:
    _same_signs(_all(UNARY), *specials(dtype))


@pytest.mark.parametrize("dtype", FLOAT)
def test_two_floats(dtype: type) -> None:
    agree(_all(BINARY), *specials(dtype, 2))


@pytest.mark.parametrize("dtype", INTEGER)
def test_one_integer(dtype: type) -> None:
    signed = ("neg", "abs") if np.dtype(dtype).kind == "u" else ()
    agree(_all({name: f for name, f in ON_INTEGERS.items() if name not in signed}), *specials(dtype))


@pytest.mark.parametrize("dtype", INTEGER)
def test_two_integers(dtype: type) -> None:
    agree(_all(BETWEEN_INTEGERS), *specials(dtype, 2))


@pytest.mark.parametrize("op", ["eq", "ne", "bitwise_and", "bitwise_or", "bitwise_xor", "max", "min"])
def test_two_flags(op: str) -> None:
    agree(getattr(lax, op), *specials(bool, 2))


def test_a_number_picked_by_flags_and_by_numbers() -> None:
    which = np.arange(-2, 6, dtype=np.int32)
    cases = [np.full(8, float(c)) for c in range(4)]
    agree(lambda flag, a, b: lax.select(flag, a, b), *[np.array(a) for a in ([True, False], [1.0, 2.0], [3.0, 4.0])])
    for n in (1, 2, 3, 4):
        inside = np.clip(which, 0, n - 1)  # of numbers beyond the cases JAX says nothing
        agree(lax.select_n, inside, *cases[:n])


@pytest.mark.parametrize("dtype", FLOAT)
def test_clamp(dtype: type) -> None:
    for low, high in ((-1, 2), (2, -1)):
        agree(lambda x, a=low, b=high: lax.clamp(jnp.asarray(a, dtype), x, jnp.asarray(b, dtype)), *specials(dtype))


def test_next_float() -> None:
    x = np.array([1.0, -1.0, 0.0, 0.0, -0.0, np.inf, 1e308, np.nan, 3.0, 3.0])
    y = np.array([2.0, 2.0, 1.0, -1.0, 1.0, 0.0, np.inf, 1.0, np.nan, 3.0])
    (got,) = computed(lax.nextafter, x, y)
    np.testing.assert_array_equal(got, np.nextafter(x, y))


MOVED = {
    "reshape": lambda x: x.reshape(4, 6),
    "transpose": lambda x: x.transpose(2, 0, 1),
    "squeeze and expand": lambda x: jnp.squeeze(x[:, :1], 1)[None],
    "broadcast": lambda x: lax.broadcast_in_dim(x, (5, 2, 3, 4), (1, 2, 3)),
    "broadcast a one": lambda x: jnp.broadcast_to(x[:, :1], (2, 3, 4)),
    "tile": lambda x: jnp.tile(x, (1, 2, 1)),
    "flip": lambda x: jnp.flip(x, (0, 2)),
    "concatenate": lambda x: jnp.concatenate([x, x[:, :2], x], 1),
    "stack": lambda x: jnp.stack([x, x], 1),
    "unstack": lambda x: jnp.unstack(x, axis=1),
    "split": lambda x: jnp.split(x, [1, 3], 2),
    "slice": lambda x: x[1:, ::2, 1:4:2],
    "slice backwards": lambda x: x[::-1, :, -1],
    "pad": lambda x: lax.pad(x, x[0, 0, 0], [(1, 2, 0), (0, 1, 2), (2, 0, 1)]),
    "pad negative": lambda x: lax.pad(x, 0.0, [(-1, 1, 0), (-2, -1, 2), (3, -2, 1)]),
    "pad away": lambda x: lax.pad(x, 0.0, [(0, 0, 0), (0, -3, 0), (0, 0, 0)]),
    "iota": lambda x: lax.broadcasted_iota(jnp.int32, (2, 3), 1) + lax.broadcasted_iota(jnp.int32, (2, 3), 0),
    "diagonal": lambda x: jnp.diagonal(x[:, :, 0]),
    "diag": lambda x: jnp.diag(x[0, 0]),
    "tril": lambda x: jnp.tril(x[0]),
    "roll": lambda x: jnp.roll(x, 1, 2),
    "nothing": lambda x: x[:0],
    "empty": lambda x: jnp.zeros((2, 2)) + x[0, 0, 0],
}


@pytest.mark.parametrize("name", MOVED)
def test_movement(name: str) -> None:
    agree(MOVED[name], numbers(2, 3, 4))


COMBINED = {
    "dot": lambda x: x[0] @ x[1].T,
    "batched dot": lambda x: jnp.einsum("bij,bkj->bki", x, x),
    "outer": lambda x: jnp.outer(x[0, 0], x[1, 1]),
    "dot of two axes": lambda x: jnp.tensordot(x, x, ((0, 2), (0, 2))),
    "sum": lambda x: x.sum((0, 2)),
    "sum of all": lambda x: x.sum(),
    "sum of none": lambda x: x[:0].sum(0),
    "prod": lambda x: x.prod(1),
    "max": lambda x: x.max(0),
    "min": lambda x: x.min((1, 2)),
    "any": lambda x: (x > 1).any(2),
    "all": lambda x: (x > -1).all(0),
    "xor": lambda x: jnp.bitwise_xor.reduce((x > 0).astype(jnp.int32), axis=1),
    "cumsum": lambda x: (jnp.cumsum(x, 1), jnp.cumsum(x[0, 0])),
    "cumsum reversed": lambda x: lax.cumsum(x, 2, reverse=True),
    "cumprod": lambda x: jnp.cumprod(x, 0),
    "cummax": lambda x: lax.cummax(x, 2),
    "cummin": lambda x: lax.cummin(x, 2),
    "argmax": lambda x: (jnp.argmax(x, 1), jnp.argmax(x)),
    "argmin": lambda x: lax.argmin(x, 2, jnp.int32),
    "sort": lambda x: jnp.sort(x, 2),
    "argsort": lambda x: jnp.argsort(x.round(), axis=2, stable=True),
    "sort by two keys": lambda x: lax.sort([x[0].round(), x[1].round(), x[0]], dimension=1, num_keys=2),
    "mean and variance": lambda x: (x.mean(0), x.var(1)),
    "median": lambda x: jnp.sort(x[0, 0])[2],
}


@pytest.mark.parametrize("name", COMBINED)
def test_combined(name: str) -> None:
    agree(COMBINED[name], numbers(2, 3, 4), tolerance=1e-15)


@pytest.mark.parametrize("name", ["dot", "sum", "max", "argmax", "sort"])
def test_combined_in_single_precision(name: str) -> None:
    agree(COMBINED[name], numbers(2, 3, 4, dtype=np.float32), tolerance=1e-6)


@pytest.mark.parametrize("name", ["max", "min", "sum", "argmax", "argmin", "cummax", "sort", "argsort"])
def test_missing_numbers_are_combined_as_jax_does(name: str) -> None:
    x = numbers(2, 3, 4)
    x[1, 0, 1, 2] = x[1, 1, 2, 0] = x[3, :, 0, 0] = x[3, :, 0, 3] = np.nan
    x[2, 0, 0] = np.inf
    x[4] = 0.0
    agree(COMBINED[name], x, tolerance=1e-15)


def test_integers_are_summed_and_multiplied() -> None:
    x = np.random.default_rng(0).integers(-9, 9, (7, 3, 3))
    for function in (lambda x: x @ x, lambda x: x.sum(0), lambda x: x.max(1), lambda x: x[:0].max(0, initial=-3)):
        agree(function, x)


def test_a_zero_times_what_is_not_finite() -> None:
    A = jnp.asarray([[0.0, 1.0], [2.0, 0.0]])
    x = numbers(2)
    x[0, 0], x[1, 1] = np.nan, np.inf
    agree(lambda x: A @ x, x, tolerance=1e-15)  # strictly
    graph, _ = lowered(lambda x: A @ x, x, strict=False)
    assert graph.folded == {graph.input(("source", 0, k), "f64") for k in (0, 1)}
    bad = jnp.asarray([[0.0, jnp.inf]])
    (got,) = computed(lambda x: bad @ jnp.stack([x[0], jnp.zeros(())]), x, strict=False)
    assert np.isnan(got).all()


def spd(n: int, dtype: type = np.float64) -> np.ndarray:
    a = numbers(n, n, dtype=dtype)
    return a @ np.swapaxes(a, 1, 2) + 0.1 * np.eye(n, dtype=dtype)


@pytest.mark.parametrize("n", [1, 2, 4])
def test_cholesky(n: int) -> None:
    agree(jnp.linalg.cholesky, spd(n), tolerance=1e-12)
    bad = spd(n)
    bad[0, 0, 0], bad[1, -1, -1], bad[2, -1, -1] = -1.0, 0.0, np.nan
    agree(jnp.linalg.cholesky, bad, tolerance=1e-12)


def test_cholesky_takes_the_lower_triangle() -> None:
    agree(lambda a: lax.linalg.cholesky(a, symmetrize_input=False), spd(3) + np.triu(numbers(3, 3), 1), tolerance=1e-12)


@pytest.mark.parametrize("left", [True, False])
@pytest.mark.parametrize("lower", [True, False])
@pytest.mark.parametrize("transposed", [True, False])
@pytest.mark.parametrize("unit", [True, False])
def test_triangular_solve(left: bool, lower: bool, transposed: bool, unit: bool) -> None:
    def solve(a: jax.Array, b: jax.Array) -> jax.Array:
        return lax.linalg.triangular_solve(
            a, b, left_side=left, lower=lower, transpose_a=transposed, unit_diagonal=unit
        )

    agree(solve, spd(3), numbers(3, 2) if left else numbers(2, 3), tolerance=1e-12)
    agree(solve, spd(3), numbers(3, 1) if left else numbers(1, 3), tolerance=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_solve_and_its_pivots(n: int) -> None:
    a = numbers(n, n)
    a[0] = np.eye(n)[::-1]  # nothing on the diagonal
    a[1, 0, 0] = 0.0
    agree(jnp.linalg.solve, a, numbers(n, 2, seed=1), tolerance=1e-10)
    agree(jnp.linalg.inv, a, tolerance=1e-10)
    agree(jnp.linalg.det, a, tolerance=1e-12)
    agree(lambda a: jax.scipy.linalg.lu_factor(a), a, tolerance=1e-12)


@pytest.mark.parametrize("shape", [(2, 4), (4, 2)])
def test_lu_of_a_rectangle(shape: tuple[int, int]) -> None:
    agree(lax.linalg.lu, numbers(*shape), tolerance=1e-12)


def test_lu_of_a_singular_matrix() -> None:
    a = np.stack([np.zeros((3, 3)), np.ones((3, 3)), np.diag([0.0, 1.0, 2.0])])
    agree(lax.linalg.lu, a, tolerance=1e-12)
    agree(jnp.linalg.det, a)


def test_known_pivots_cost_nothing() -> None:
    A = jnp.asarray([[0.0, 2.0], [1.0, 0.0]])
    graph, _ = lowered(lambda b: jnp.linalg.solve(A, b), numbers(2), strict=False)
    assert "select" not in graph.op
    assert "div" not in graph.op


@pytest.mark.parametrize("swaps", [[0, 1, 2], [2, 2, 2], [1, 1, 3], [3, 2, 3]])
def test_pivots_to_permutation(swaps: list[int]) -> None:
    agree(lambda p: lax.linalg.lu_pivots_to_permutation(p, 4), np.array([swaps] * 2, np.int32))


TABLE = jnp.arange(12.0).reshape(4, 3)


INDEXED = {
    "element": lambda x, i: x[i[0], i[1]],
    "row": lambda x, i: x[i[0]],
    "rows": lambda x, i: x[i],
    "column": lambda x, i: x[:, i[1]],
    "take clipped": lambda x, i: jnp.take(x, i, axis=1, mode="clip"),
    "take filled": lambda x, i: jnp.take(x, i, axis=0, mode="fill"),
    "take filled with 7": lambda x, i: jnp.take(x, i, axis=0, mode="fill", fill_value=7.0),
    "integers filled": lambda x, i: jnp.take(x.astype(jnp.int32), i, axis=0, mode="fill"),
    "flags filled": lambda x, i: jnp.take(x > 0, i, axis=0, mode="fill"),
    "wrapped": lambda x, i: jnp.take(x, i, axis=0, mode="wrap"),
    "a table": lambda x, i: TABLE[i] + x[0, 0],
    "along an axis": lambda x, i: jnp.take_along_axis(x, jnp.broadcast_to(i[:, None], (2, 3)), 0),
    "batched": lambda x, i: jax.vmap(lambda row, j: row[j])(x[:2], i),
    "dynamic slice": lambda x, i: lax.dynamic_slice(x, (i[0], i[1]), (2, 2)),
    "dynamic index": lambda x, i: lax.dynamic_index_in_dim(x, i[0], 1),
    "dynamic update": lambda x, i: lax.dynamic_update_slice(x, -jnp.ones((2, 1)), (i[0], i[1])),
    "set": lambda x, i: x.at[i[0], i[1]].set(9.0),
    "set dropped": lambda x, i: x.at[i].set(9.0, mode="drop"),
    "set clipped": lambda x, i: x.at[i[0]].set(x[1], mode="clip"),
    "add": lambda x, i: x.at[i].add(x[:2]),
    "add twice": lambda x, i: x.at[jnp.stack([i[0], i[0]])].add(1.5),
    "multiply": lambda x, i: x.at[:, i[1]].mul(3.0),
    "min": lambda x, i: x.at[i].min(0.0),
    "max": lambda x, i: x.at[i].max(0.0),
    "subtract": lambda x, i: x.at[i].subtract(2.0),
    "slices set": lambda x, i: jax.vmap(lambda row, j: row.at[j].set(0.0))(x[:2], i),
    "derivative": lambda x, i: jax.grad(lambda x: (x[i] ** 2).sum() + x[i[0], 1])(x),
}


@pytest.mark.parametrize("name", INDEXED)
def test_an_index_that_is_not_known(name: str) -> None:
    pairs = np.array(list(itertools.product(range(-5, 6), repeat=2)), np.int32)
    x = np.random.default_rng(0).normal(size=(len(pairs), 4, 3))
    agree(INDEXED[name], x, pairs, tolerance=1e-15)


@pytest.mark.parametrize("name", INDEXED)
@pytest.mark.parametrize("index", [(3, -2), (5, -7)])
def test_an_index_that_is_known(name: str, index: tuple[int, int]) -> None:
    def function(x: jax.Array) -> jax.Array:
        return INDEXED[name](x, jnp.asarray(index, jnp.int32))

    agree(function, numbers(4, 3))
    graph, _ = lowered(function, numbers(4, 3))
    assert "select" not in graph.op


def test_a_large_table_is_refused() -> None:
    table = jnp.arange(1000.0)
    with pytest.raises(Unsupported, match="64 places"):
        lowered(lambda i: table[i], np.zeros(2, np.int32))


def _collatz(x: jax.Array) -> jax.Array:
    return lax.while_loop(lambda x: x > 1, lambda x: jnp.where(x % 2 == 0, x // 2, 3 * x + 1), x)


@jax.custom_jvp
def own_derivative(x: jax.Array) -> jax.Array:
    return x**3


own_derivative.defjvps(lambda dx, y, x: 5 * dx * y)


@jax.custom_vjp
def own_pullback(x: jax.Array) -> jax.Array:
    return x**3


own_pullback.defvjp(lambda x: (x**3, x), lambda x, ct: (7 * ct * x,))


def _linear_solve(x: jax.Array) -> jax.Array:
    A = jnp.asarray([[2.0, 1.0], [0.0, 3.0]])
    solve = lambda _, b: jnp.linalg.solve(A, b)  # noqa: E731
    return lax.custom_linear_solve(lambda v: A @ v, x[:2], solve, solve)


CONTROLLED = {
    "jit": lambda x: jax.jit(lambda x: x + TABLE[0])(x),
    "cond": lambda x: lax.cond(x[0] > 0, lambda x: x + 1, lambda x: x * 2, x),
    "cond of the same": lambda x: lax.cond(x[0] > 0, lambda x: (x, x + 1), lambda x: (x, x), x),
    "cond in cond": lambda x: lax.cond(
        x[0] > 0, lambda x: lax.cond(x[1] > 0, lambda x: -x, lambda x: x + 1, x), lambda x: x * 2, x
    ),
    "cond known": lambda x: lax.cond(TABLE[1, 1] > 0, lambda x: x + 1, lambda x: x * 2, x),
    "switch": lambda x: lax.switch((3 * x[0]).astype(jnp.int32), [lambda x: x, lambda x: -x, lambda x: x * 3], x),
    "switch known": lambda x: lax.switch(5, [lambda x: x, lambda x: -x, lambda x: x * 3], x),
    "scan": lambda x: lax.scan(lambda c, row: (c * row + 1, (c, row)), x[0], x),
    "scan backwards": lambda x: lax.scan(lambda c, row: (c * row + 1, c), x[0], x, reverse=True),
    "scan of nothing": lambda x: lax.scan(lambda c, row: (c + row, c), x[0], x[:0]),
    "scan without rows": lambda x: lax.scan(lambda c, _: (c * 2, None), x, None, length=3),
    "fori_loop": lambda x: lax.fori_loop(0, 4, lambda i, c: c * 2 + x[i % 3], x),
    "fori_loop from 2": lambda x: lax.fori_loop(2, 3, lambda i, c: c + i, x),
    "while known": lambda x: x + _collatz(jnp.int32(6)).astype(x.dtype),
    "map": lambda x: lax.map(lambda row: row**2, x),
    "checkpoint": lambda x: jax.checkpoint(lambda x: jnp.sin(x) * 0 + x)(x),
    "custom_jvp": lambda x: (own_derivative(x), jax.jvp(own_derivative, (x,), (x,))),
    "custom_vjp": lambda x: (own_pullback(x), jax.vjp(own_pullback, x)[1](x)),
    "custom_linear_solve": _linear_solve,
    "platform": lambda x: lax.platform_dependent(x, cpu=lambda x: x + 1, default=lambda x: x),
    "jacfwd": jax.jacfwd(lambda x: x * x[::-1]),
    "jacrev": jax.jacrev(lambda x: x * x[::-1]),
    "hessian": jax.hessian(lambda x: (x**3).sum() * x[0]),
    "vmap": jax.vmap(lambda x: x * 2),
    "gradient of a scan": jax.grad(lambda x: lax.scan(lambda c, r: (c * r, c), 1.0, x)[1].sum()),
}


@pytest.mark.parametrize("name", CONTROLLED)
def test_control(name: str) -> None:
    agree(CONTROLLED[name], numbers(3), tolerance=1e-15)


def test_a_branch_is_named_once() -> None:
    graph, _ = lowered(CONTROLLED["cond"], numbers(3))
    assert {graph.value[n] for n in range(len(graph)) if graph.op[n] == "branch"} == {0}
    assert graph.op.count("branch") == 3
    predicate = graph.args[graph.op.index("branch")][0]
    assert graph.op[predicate] == "gt" or graph.op[predicate] == "lt"


def test_a_loop_that_depends_on_data_is_refused_with_its_line() -> None:
    with pytest.raises(Unsupported, match=r"while: how often it turns .*test_lanes_rules\.py:\d+") as raised:
        lowered(_collatz, np.ones(2, np.int32))
    assert raised.value.primitive == "while"


@pytest.mark.parametrize(
    ("name", "function"),
    [
        ("eigh", lambda x: jnp.linalg.eigh(x @ x.T)),
        ("dtype", lambda x: x.astype(jnp.float16)),
        ("sort", lambda x: jnp.sort(jnp.tile(x[0], 9))),
    ],
)
def test_refused(name: str, function: Callable) -> None:
    with pytest.raises(Unsupported, match=name) as raised:
        lowered(function, numbers(3, 3))
    assert "test_lanes_rules.py" in raised.value.where


def test_a_loop_too_long_is_refused() -> None:
    with pytest.raises(Unsupported, match="more than"):
        lowered(lambda x: lax.fori_loop(0, 300_000, lambda i, c: c + 1.0, x), np.ones(2))


RANDOM = {
    "bits": lambda k: jax.random.bits(k, (5,)),
    "bits of 64": lambda k: jax.random.bits(k, (5,), jnp.uint64),
    "an odd number": lambda k: jax.random.bits(k, (3, 1)),
    "none": lambda k: jax.random.bits(k, (0,)),
    "uniform": lambda k: jax.random.uniform(k, (3,), jnp.float64, -1, 2),
    "uniform32": lambda k: jax.random.uniform(k, (3,), jnp.float32),
    "integers": lambda k: jax.random.randint(k, (4,), 0, 10),
    "bernoulli": lambda k: jax.random.bernoulli(k, 0.3, (4,)),
    "split": lambda k: jax.random.key_data(jax.random.split(k, 3)),
    "split in a grid": lambda k: jax.random.key_data(jax.random.split(k, (2, 2)))[1],
    "fold_in": lambda k: jax.random.key_data(jax.random.fold_in(k, 12)),
    "moved": lambda k: jax.random.bits(jnp.stack([k, jax.random.fold_in(k, 1)])[::-1][0], (2,)),
    "batched": lambda k: jax.vmap(lambda k: jax.random.uniform(k, (2,)))(jax.random.split(k, 3)),
    "clone": lambda k: jax.random.bits(jax.random.clone(k)),
}


@pytest.mark.parametrize("partitionable", [True, False])
@pytest.mark.parametrize("name", RANDOM)
def test_random(name: str, partitionable: bool) -> None:
    keys = np.random.default_rng(0).integers(0, 2**32, (7, 2), np.uint32)
    with jax.threefry_partitionable(partitionable):
        agree(lambda words: RANDOM[name](jax.random.wrap_key_data(words)), keys)
        if name not in ("moved", "clone"):  # of typed keys only
            agree(lambda words: RANDOM[name](words), keys)


def test_keys_that_are_picked() -> None:
    def draw(words: jax.Array, x: jax.Array) -> jax.Array:
        first, second = jax.random.split(jax.random.wrap_key_data(words))
        key = lax.cond(x > 0, lambda: first, lambda: second)
        key = jnp.where(x > 1, key, first)
        keys = jnp.stack([key, second])
        return jax.random.bits(keys[jnp.where(x > 0.5, 1, 0)]), jax.random.bits(
            lax.dynamic_index_in_dim(keys, 0, 0, False)
        )

    agree(draw, np.random.default_rng(0).integers(0, 2**32, (7, 2), np.uint32), numbers())


def test_a_seed() -> None:
    seeds = np.array([0, 1, -1, 2**40], np.int64)
    agree(lambda s: jax.random.key_data(jax.random.key(s)), seeds)
    agree(lambda s: jax.random.PRNGKey(s), seeds.astype(np.int32))


def test_a_typed_key_goes_in_and_out_as_its_words() -> None:
    closed = jax.make_jaxpr(jax.random.split)(jax.random.key(3))
    graph = Graph()
    words = np.array([graph.constant(w, "u32") for w in np.asarray(jax.random.key_data(jax.random.key(3)))])
    (found,) = lower(closed, graph, [], [words])
    want = np.asarray(jax.random.key_data(jax.random.split(jax.random.key(3))))
    assert [[graph.known(n) for n in key] for key in found.tolist()] == want.tolist()


def test_keys_of_other_generators_are_refused() -> None:
    with pytest.raises(Unsupported, match="generator"):
        lowered(lambda s: jax.random.bits(jax.random.key(s, impl="rbg")), np.ones(2, np.int32))


def test_an_array_of_the_program_is_a_literal() -> None:
    table = jax.random.key(0), jnp.arange(3.0)
    agree(lambda x: jax.jit(lambda x: x + table[1] + jax.random.uniform(table[0]))(x), numbers(3))
