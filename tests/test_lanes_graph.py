"""Graphs of scalars: nodes made once, what folds and what does not, and operations as JAX has them."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxfilt.lanes.graph import COMPARISONS, KINDS, OPERATIONS, Graph, converted, kind_of
from tests.graphs import evaluate, reachable, size

FLOATS = ["f32", "f64"]
INTEGERS = ["i32", "i64", "u32", "u64"]


def values(kind: str) -> np.ndarray:
    """Ordinary numbers and the limits of the kind."""
    dtype = KINDS[kind]
    if kind == "b":
        return np.array([False, True])
    if kind in FLOATS:
        f = np.finfo(dtype)
        some = [0.0, 0.5, 1, 1.5, 2, 2.5, 3, 1e-3, 1e6, f.tiny, f.max, np.inf]
        return np.array([*some, *(-v for v in some), np.nan], dtype)
    i = np.iinfo(dtype)
    some = [0, 1, 2, 3, 5, 31, 32, 63, 64, 65, 1000, i.max, i.max - 1, i.min, i.min + 1]
    return np.array([*some, *([-1, -2, -7] if i.min else [])], dtype)


def pairs(kind: str) -> tuple[np.ndarray, np.ndarray]:
    a, b = np.meshgrid(values(kind), values(kind))
    return a.ravel(), b.ravel()


LAX = {
    "add": lax.add,
    "sub": lax.sub,
    "mul": lax.mul,
    "div": lax.div,
    "rem": lax.rem,
    "neg": lax.neg,
    "abs": lax.abs,
    "sqrt": lax.sqrt,
    "floor": lax.floor,
    "ceil": lax.ceil,
    "round": lambda x: lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN),
    "max": lax.max,
    "min": lax.min,
    "eq": lax.eq,
    "ne": lax.ne,
    "lt": lax.lt,
    "le": lax.le,
    "gt": lax.gt,
    "ge": lax.ge,
    "and": lax.bitwise_and,
    "or": lax.bitwise_or,
    "xor": lax.bitwise_xor,
    "not": lax.bitwise_not,
    "shl": lax.shift_left,
    "shr": lax.shift_right_logical,
    "sar": lax.shift_right_arithmetic,
}
UNARY = {"neg", "abs", "sqrt", "floor", "ceil", "round", "not"}
OF_FLOATS = {"add", "sub", "mul", "div", "rem", "max", "min", *COMPARISONS, *UNARY - {"not"}}
OF_INTEGERS = {"add", "sub", "mul", "div", "rem", "max", "min", "and", "or", "xor", "not", "shl", "shr", "sar"}
OF_INTEGERS |= COMPARISONS
CASES = [(op, kind) for kind in FLOATS for op in sorted(OF_FLOATS)]
CASES += [(op, kind) for kind in INTEGERS for op in sorted(OF_INTEGERS)]
CASES += [("neg", "i32"), ("abs", "i32"), ("neg", "i64"), ("abs", "i64"), ("neg", "u32")]
CASES += [(op, "b") for op in ("and", "or", "xor", "not", "eq", "ne")]


def test_every_operation_is_compared():
    assert set(LAX) == set(OPERATIONS) == {op for op, _ in CASES}


@cache
def in_jax(kind: str) -> dict[str, np.ndarray]:
    """Every operation on every pair of values (or value), compiled at once."""
    ops = [op for op, k in CASES if k == kind]

    @jax.jit
    def all_of_them(x, a, b):
        return {op: LAX[op](x) if op in UNARY else LAX[op](a, b) for op in ops}

    return {op: np.asarray(result) for op, result in all_of_them(values(kind), *pairs(kind)).items()}


@pytest.mark.parametrize(("op", "kind"), CASES)
def test_operations_are_those_of_jax(op, kind):
    arguments = (values(kind),) if op in UNARY else pairs(kind)
    with np.errstate(all="ignore"):
        got = OPERATIONS[op](*arguments)
    want = in_jax(kind)[op]
    assert got.dtype == want.dtype
    if op in ("div", "mul") and kind in FLOATS:
        # XLA on a CPU takes subnormal numbers for zero.
        normal = ~((np.abs(got) < np.finfo(got.dtype).tiny) & (got != 0))
        got, want = got[normal], want[normal]
    np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize("kind", KINDS)
def test_conversions_are_those_of_jax(kind):
    x = values(kind)
    if kind in FLOATS:
        edges = [2.0**p for p in (31, 32, 63, 64)] + [2.0**31 - 1, 2.0**53 - 1, 1e19, 1e30]
        x = np.concatenate([x, np.array([*edges, *(-e for e in edges), 1.9, -1.9], x.dtype)])
    x = x[np.abs(x) != np.finfo(np.float64).tiny] if kind == "f64" else x  # in float32 subnormal: for XLA zero
    want = jax.jit(lambda x: [lax.convert_element_type(x, dtype) for dtype in KINDS.values()])(x)
    for to, true in zip(KINDS, want, strict=True):
        with np.errstate(all="ignore"):
            got = converted(x, to)
        assert got.dtype == KINDS[to]
        np.testing.assert_array_equal(got, true)


def test_kinds():
    assert kind_of(jnp.float32) == "f32"
    assert kind_of(np.dtype(bool)) == "b"
    with pytest.raises(KeyError):
        kind_of(np.float16)


@pytest.fixture
def g() -> Graph:
    return Graph()


def of(g: Graph, name: str, kind: str = "f64") -> int:
    return g.input((name,), kind)


def test_equal_nodes_are_one(g):
    x, y = of(g, "x"), of(g, "y")
    assert of(g, "x") == x != y
    assert g.make("add", x, y) == g.make("add", y, x)
    assert g.make("sub", x, y) != g.make("sub", y, x)
    assert g.make("lt", x, y) != g.make("lt", y, x)
    assert g.make("convert", x, kind="f32") != g.make("convert", x, kind="i32")
    assert g.make("convert", x, kind="f64") == x
    made = len(g)
    g.make("add", x, y)
    assert len(g) == made


def test_constants_are_told_apart_by_their_bits(g):
    zero = g.constant(0.0, "f64")
    assert g.constant(-0.0, "f64") != zero
    assert g.constant(0.0, "f32") != zero
    assert g.constant(np.nan, "f64") == g.constant(np.nan, "f64")
    assert g.known(zero) == 0
    assert g.known(of(g, "x")) is None
    assert g.constant(0xFFFFFFFFFFFFFFFF, "i64") == g.constant(-1, "i64")


def test_kinds_of_results(g):
    x, n = of(g, "x", "f32"), of(g, "n", "i32")
    assert g.kind[g.make("mul", x, x)] == "f32"
    assert g.kind[g.make("le", x, x)] == "b"
    assert g.kind[g.make("select", g.make("eq", n, n), x, x)] == "f32"
    assert g.kind[g.make("bitcast", x, kind="i32")] == "i32"


@pytest.mark.parametrize("strict", [False, True])
def test_sums_and_products_with_nothing_to_do(strict):
    g = Graph(strict)
    x, y = of(g, "x"), of(g, "y")
    zero, one, minus = (g.constant(v, "f64") for v in (0, 1, -1))
    negative = g.make("neg", x)
    assert g.make("add", x, zero) == g.make("add", zero, x) == g.make("sub", x, zero) == x
    assert g.make("mul", x, one) == g.make("mul", one, x) == g.make("div", x, one) == x
    assert g.make("sub", zero, x) == g.make("mul", minus, x) == g.make("mul", x, minus) == negative
    assert g.make("neg", negative) == x
    assert g.make("add", y, negative) == g.make("add", negative, y) == g.make("sub", y, x)
    assert g.make("sub", y, negative) == g.make("add", x, y)
    assert g.make("neg", g.make("sub", x, y)) == g.make("sub", y, x)
    assert g.make("mul", negative, g.make("neg", y)) == g.make("mul", x, y)
    assert g.make("mul", negative, y) == g.make("neg", g.make("mul", x, y))
    assert not g.folded


@pytest.mark.parametrize("kind", FLOATS)
def test_division_by_powers_of_two_only_is_a_product(g, kind):
    x = of(g, "x", kind)
    f = np.finfo(KINDS[kind])
    by = {v: g.make("div", x, g.constant(v, kind)) for v in (4.0, -0.5, 3.0, 0.0, np.inf, float(f.tiny))}
    assert [g.op[node] for node in by.values()] == ["mul", "mul", "div", "div", "div", "mul"]
    assert by[4.0] == g.make("mul", x, g.constant(0.25, kind))
    divided = g.raw("div", x, g.constant(4.0, kind))
    got, want = evaluate(g, [by[4.0], divided], {("x",): values(kind)})
    np.testing.assert_array_equal(got, want)
    largest = 2.0 ** (f.maxexp - 1)
    assert g.op[g.make("div", x, g.constant(largest, kind))] == "div"  # its reciprocal is subnormal
    assert g.op[g.make("div", x, g.constant(f.smallest_subnormal, kind))] == "div"  # its reciprocal is infinite


def test_zero_times_something_is_folded_and_told(g):
    x, zero = of(g, "x"), g.constant(0, "f64")
    assert g.make("mul", zero, x) == g.make("mul", x, zero) == zero
    assert g.folded == {x}
    y = of(g, "y")
    assert g.make("div", zero, y) == zero
    assert g.folded == {x, g.make("div", g.constant(1, "f64"), y)}


def test_a_strict_graph_keeps_zero_times_something():
    g = Graph(strict=True)
    x, zero = of(g, "x"), g.constant(0, "f64")
    product, quotient = g.make("mul", zero, x), g.make("div", zero, x)
    assert not g.folded
    got = evaluate(g, [product, quotient], {("x",): np.array([2.0, np.inf, np.nan, 0.0])})
    np.testing.assert_array_equal(got, [[0, np.nan, np.nan, 0], [0, 0, np.nan, np.nan]])


def test_what_may_be_infinite_or_rounded_is_not_folded(g):
    x = of(g, "x")
    one = g.constant(1, "f64")
    for op, args in {"sub": (x, x), "div": (x, x), "ne": (x, x), "eq": (x, x)}.items():
        assert g.op[g.make(op, *args)] == op
    shifted = g.make("add", x, g.constant(1.5 * 2**52, "f64"))
    assert g.op[g.make("sub", shifted, g.constant(1.5 * 2**52, "f64"))] == "sub"
    assert g.op[g.make("add", g.make("add", x, one), one)] == "add"
    assert g.op[g.raw("mul", g.constant(0, "f64"), x)] == "mul"


@pytest.mark.parametrize("kind", INTEGERS)
def test_integers_with_nothing_to_do(g, kind):
    n = of(g, "n", kind)
    zero, one, ones = (g.constant(v, kind) for v in (0, 1, -1))
    assert g.make("add", zero, n) == g.make("sub", n, zero) == g.make("or", n, zero) == g.make("xor", n, zero) == n
    assert g.make("shl", n, zero) == g.make("shr", n, zero) == g.make("sar", n, zero) == g.make("and", n, ones) == n
    assert g.make("mul", n, one) == g.make("and", n, n) == g.make("or", n, n) == n
    assert g.make("mul", n, zero) == g.make("and", zero, n) == zero
    assert g.make("or", n, ones) == ones
    assert g.make("not", g.make("not", n)) == n
    assert g.op[g.make("sub", zero, n)] == "sub"
    assert g.op[g.make("shl", zero, n)] == "shl"


def test_flags_with_nothing_to_do(g):
    p = of(g, "p", "b")
    true, false = g.constant(True, "b"), g.constant(False, "b")
    assert g.make("and", p, true) == g.make("or", p, false) == g.make("xor", false, p) == p
    assert g.make("and", p, false) == false
    assert g.make("or", true, p) == true


@pytest.mark.parametrize("op", ["select", "branch"])
def test_choices(g, op):
    p, x, y = of(g, "p", "b"), of(g, "x"), of(g, "y")
    assert g.make(op, g.constant(True, "b"), x, y, value=0) == x
    assert g.make(op, g.constant(False, "b"), x, y, value=0) == y
    assert g.make(op, p, x, x, value=0) == x
    (got,) = evaluate(
        g,
        [g.make(op, p, x, y, value=0)],
        {("p",): np.array([True, False]), ("x",): np.array([1.0, 2]), ("y",): np.array([3.0, 4])},
    )
    np.testing.assert_array_equal(got, [1, 4])


def test_instances_of_branches(g):
    first, second = g.instance(), g.instance()
    assert first != second
    assert g.instance(("this",)) == g.instance(("this",)) not in (first, second, g.instance(("that",)))
    p, x, y = of(g, "p", "b"), of(g, "x"), of(g, "y")
    assert g.make("branch", p, x, y, value=first) != g.make("branch", p, x, y, value=second)
    assert g.make("branch", p, x, y, value=first) == g.make("branch", p, x, y, value=first)


@pytest.mark.parametrize("kind", ["f64", "f32", "i32", "u64"])
@pytest.mark.parametrize("seed", range(6))
def test_folding_changes_no_value(kind, seed):
    """Random formulas, many of whose operands are 0, 1, -1 and 2: with all folding as with none.

    But for the signs of zeros, which x + 0 = x does not keep (nor does XLA): so nothing is divided by them here.
    """
    r = np.random.default_rng(seed)
    g = Graph(strict=True)
    lanes = values(kind)
    inputs = {(i,): r.permutation(lanes) for i in range(4)}
    nodes = [g.input(where, kind) for where in inputs]
    unfolded = list(inputs.values())
    for literal in (0, 1, -1, 2):
        nodes.append(g.constant(literal, kind))
        unfolded.append(np.full_like(lanes, g.known(nodes[-1])))
    ops = ["add", "sub", "mul", "max", "min", "neg"] + ["and", "or", "xor", "shl", "shr", "not"] * (kind not in FLOATS)
    with np.errstate(all="ignore"):
        for _ in range(200):
            op = r.choice(ops)
            chosen = r.integers(len(nodes), size=1 if op in UNARY else 2)
            nodes.append(g.make(op, *(nodes[i] for i in chosen)))
            unfolded.append(OPERATIONS[op](*(unfolded[i] for i in chosen)))
    for got, want in zip(evaluate(g, nodes, inputs), unfolded, strict=True):
        np.testing.assert_array_equal(np.broadcast_to(got, want.shape), want)


def test_evaluation_visits_what_is_needed(g):
    p, x = of(g, "p", "b"), of(g, "x")
    rare, usual = g.make("sqrt", x), g.make("abs", x)
    of(g, "nobody asked for")
    chosen = g.make("branch", p, rare, usual, value=g.instance())
    assert reachable(g, [chosen]) == [p, x, rare, usual, chosen]
    assert (size(g, [chosen]), size(g, [chosen], usual=True)) == (3, 2)
