"""Compiled programs against the same programs computed node by node in NumPy."""

import itertools
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilt.lanes import values
from jaxfilt.lanes.graph import COMPARISONS, KINDS, Graph
from jaxfilt.lanes.program import Leaf, Output, Program, Slot, Source
from tests.graphs import evaluate

pytest.importorskip("llvmlite")
from jaxfilt.lanes.kernel import Kernel, each

FLOATS = ("f32", "f64")
WHOLE = ("i32", "i64", "u32", "u64")
KNOWN_BY = {
    **dict.fromkeys(
        ["add", "sub", "mul", "div", "rem", "neg", "max", "min", "eq", "ne", "lt", "le", "gt", "ge"], FLOATS + WHOLE
    ),
    **dict.fromkeys(["abs"], (*FLOATS, "i32", "i64")),
    **dict.fromkeys(["sqrt", "floor", "ceil", "round"], FLOATS),
    **dict.fromkeys(["and", "or", "xor", "not"], (*WHOLE, "b")),
    **dict.fromkeys(["shl", "shr"], WHOLE),
    "sar": ("i32", "i64"),
}
UNARY = {"neg", "abs", "sqrt", "floor", "ceil", "round", "not"}


@pytest.fixture(autouse=True, scope="module")
def _own_cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAXFILT_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def special(kind: str) -> np.ndarray:
    """The numbers at which an operation may go wrong."""
    dtype = KINDS[kind]
    if kind == "b":
        return np.array([False, True])
    if kind in FLOATS:
        info = np.finfo(dtype)
        some = [
            0.0,
            0.5,
            1.0,
            1.5,
            2.5,
            3.0,
            7.25,
            1e9,
            3e9,
            1e19,
            info.max,
            info.tiny,
            info.smallest_subnormal,
            np.inf,
        ]
        values = np.array([*some, *(-a for a in some), np.nan], dtype)
        return np.concatenate([values, np.nextafter(dtype.type(0.5), dtype.type(0))[None]])
    info = np.iinfo(dtype)
    some = {0, 1, 2, 3, 7, 31, 32, 33, 63, 64, 100, info.max, info.max - 1, info.min, info.min + 1}
    return np.array(sorted(some | ({-1, -2, -7, -64} if kind[0] == "i" else set())), dtype)


def pairs(kind: str) -> np.ndarray:
    return np.array(list(itertools.product(special(kind), repeat=2)))


def loop(p: Program, sources: list, start: list, runs: int, steps: int, few: int = 0) -> tuple[list, list]:
    """What a kernel computes, run by row."""

    def read(k: int, e: int, row: int) -> np.ndarray:
        a = sources[k].reshape(-1, steps if p.sources[k].moving else 1, p.sources[k].size)
        return np.broadcast_to(a[:, row if p.sources[k].moving else 0, e], runs)

    begin = [
        np.broadcast_to(a.reshape(-1, len(f.slots)), (runs, len(f.slots))) for f, a in zip(p.leaves, start, strict=True)
    ]
    carry = [begin[s.leaf][:, s.element] for s in p.slots]
    nodes = [n for o in p.outputs for n in o.nodes] + [s.after for s in p.slots]
    found: list[dict] = [{} for _ in p.outputs]
    for t in reversed(range(steps)) if p.reverse else range(steps):
        inputs = {("carry", i): a for i, a in enumerate(carry)}
        for k, source in enumerate(p.sources):
            inputs |= {("source", k, e): read(k, e, t) for e in range(source.size)}
        values = [np.broadcast_to(a, runs) for a in evaluate(p.graph, nodes, inputs)]
        for rows, output in zip(found, p.outputs, strict=True):
            rows[t], values = np.stack(values[: len(output.nodes)], 1), values[len(output.nodes) :]
        carry = values
    outs = []
    for rows, o in zip(found, p.outputs, strict=True):
        a = np.stack([rows[t] for t in range(steps)], 1) if steps else np.zeros((runs, 0, len(o.nodes)), KINDS[o.kind])
        outs.append(a.sum(0) if o.summed else a[: few if o.few else runs, o.every - 1 :: o.every])
    final = [
        np.stack(
            [
                carry[s] if s >= 0 else np.full(runs, c, KINDS[f.kind])
                for s, c in zip(f.slots, f.constants, strict=True)
            ],
            1,
        )
        for f in p.leaves
    ]
    return final, outs


def check(p: Program, sources: list, start: list, runs: int, steps: int, few: int = 0, **how) -> None:
    expected, got = loop(p, sources, start, runs, steps, few), Kernel(p, **how)(sources, start, runs, steps, few)
    for want, have in zip(expected[0], got[0], strict=True):
        np.testing.assert_array_equal(have, want)
    for output, want, have in zip(p.outputs, expected[1], got[1], strict=True):
        assert have.dtype == KINDS[output.kind]
        if output.summed:
            np.testing.assert_allclose(have, want, rtol=1e-4 if output.kind == "f32" else 1e-12, atol=1e-4)
        else:
            np.testing.assert_array_equal(have, want)


def operation_program(op: str, kind: str, shared: bool, constants: bool) -> Program:
    g = Graph(strict=True)
    a, b = (g.input(("source", 0, e), kind) for e in range(2))
    args = (a,) if op in UNARY else (a, b)
    nodes = [g.make(op, *args)]
    if constants and op not in UNARY:
        for c in special(kind):
            nodes += [g.make(op, a, g.constant(c, kind)), g.make(op, g.constant(c, kind), a)]
    result = "b" if op in COMPARISONS else kind
    return Program(g, (Source(kind, 2, shared, shared),), (), (), (Output(tuple(nodes), result),))


@pytest.mark.parametrize(("op", "kind"), [(op, kind) for op, kinds in KNOWN_BY.items() for kind in kinds])
def test_operations(op, kind):
    """Each operation on all pairs of special numbers: in lanes, by the run, and on scalars, by the row."""
    table = pairs(kind)
    p = operation_program(op, kind, False, kind not in FLOATS or op in ("max", "min", "div"))
    check(p, [table], [], len(table), 1)
    check(operation_program(op, kind, True, False), [table], [], 1, len(table))


@pytest.mark.parametrize("op", ["max", "min"])
@pytest.mark.parametrize("kind", FLOATS)
def test_zeros_have_the_sign_that_jax_gives_them(op, kind):
    table = np.array(list(itertools.product([0.0, -0.0, 1.0], repeat=2)), KINDS[kind])
    (_, (got,)) = Kernel(operation_program(op, kind, False, True))([table], [], len(table), 1)
    function = jax.jit({"max": jnp.maximum, "min": jnp.minimum}[op])
    columns = [function(table[:, 0], table[:, 1])]
    for c in special(kind):
        columns += [function(table[:, 0], jnp.full(len(table), c)), function(jnp.full(len(table), c), table[:, 0])]
    expected = np.stack(columns, 1)
    number = ~np.isnan(expected)
    np.testing.assert_array_equal(np.signbit(got[:, 0])[number], np.signbit(expected)[number])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("of", KINDS)
def test_conversions(of, kind):
    """Between all kinds; of floats to whole numbers those at the end of the range saturate."""
    g = Graph()
    a = g.input(("source", 0, 0), of)
    p = Program(g, (Source(of, 1, False, False),), (), (), (Output((g.make("convert", a, kind=kind),), kind),))
    values = special(of)[:, None]
    check(p, [values], [], len(values), 1)


@pytest.mark.parametrize(
    ("of", "kind"), [("f32", "u32"), ("i32", "f32"), ("f64", "i64"), ("u64", "f64"), ("i32", "u32")]
)
def test_bits(of, kind):
    g = Graph()
    a = g.input(("source", 0, 0), of)
    p = Program(g, (Source(of, 1, False, False),), (), (), (Output((g.make("bitcast", a, kind=kind),), kind),))
    values = special(of)[:, None]
    check(p, [values], [], len(values), 1)


@pytest.mark.parametrize("kind", ["f32", "f64", "i32", "u64", "b"])
@pytest.mark.parametrize("size", [1, 2, 3, 4, 7, 9])
def test_layout(kind, size):
    """Arrays of any size go in and out, read whole, in part and backwards, of runs that fill no block."""
    g = Graph()
    moving, still = ([g.input(("source", k, e), kind) for e in range(size)] for k in range(2))
    carry = [g.input(("carry", i), kind) for i in range(2)]
    mixed = g.make("xor" if kind == "b" else "add", carry[0], moving[0])
    p = Program(
        g,
        (Source(kind, size, False, True), Source(kind, size, False, False)),
        (Leaf(kind, False, (1, -1, 0, 1), (0, 1, 0, 0)), Leaf(kind, True, (-1, 2), (0, 0))),
        (
            Slot(kind, 0, 2, mixed),
            Slot(kind, 0, 0, carry[0]),
            Slot(kind, 1, 1, g.input(("carry", 2), kind)),
        ),
        (
            Output(tuple(moving[::-1]), kind),
            Output((*still[::2], carry[1], mixed), kind),
            Output((g.constant(1, kind),), kind),
        ),
    )
    rng = np.random.default_rng(size)
    for runs in (1, 3, 18):
        draw = lambda *shape: rng.integers(0, 2 if kind == "b" else 100, shape).astype(KINDS[kind])  # noqa: E731
        start = [draw(runs, 4), draw(2)]
        check(p, [draw(runs, 5, size), draw(runs, size)], start, runs, 5)


def counter(reverse: bool = False, outputs: tuple = (), kind: str = "f64") -> Program:
    """x becomes x + z; outputs: (every, few, summed) of x before, x after and z."""
    g = Graph()
    x, z = g.input(("carry", 0), kind), g.input(("source", 0, 0), kind)
    after = g.make("add", x, z)
    stored = tuple(Output((x, after, z), kind, *how) for how in outputs)
    return Program(
        g,
        (Source(kind, 1, False, True),),
        (Leaf(kind, False, (0,), (0,)),),
        (Slot(kind, 0, 0, after),),
        stored,
        reverse,
    )


@pytest.mark.parametrize("registers", [1, 2])
@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("kind", FLOATS)
def test_outputs(kind, reverse, registers):
    """All rows or each third, all runs or the first few, each or their sum, forwards and backwards."""
    p = counter(
        reverse, ((1, False, False), (3, False, False), (1, True, False), (4, True, False), (1, False, True)), kind
    )
    rng = np.random.default_rng(0)
    for runs, steps, few in [(1, 1, 1), (7, 11, 3), (21, 12, 21), (40, 3, 0), (33, 0, 2)]:
        z, x = rng.integers(-50, 50, (runs, steps, 1)), rng.integers(-50, 50, (runs, 1))
        check(p, [z.astype(KINDS[kind])], [x.astype(KINDS[kind])], runs, steps, few, registers=registers)


def test_lanes_beyond_the_few_and_the_runs_write_nowhere():
    p = counter(outputs=((1, True, False), (1, False, False)))
    kernel = Kernel(p)
    runs, steps = kernel.lanes + 1, 3
    memory = [np.full((n + 2, steps, 3), -1.0) for n in (2, runs)]
    z, x = np.ones((runs, steps, 1)), np.arange(runs * 1.0)[:, None]
    kernel.run([z], [x], [x.copy()], [memory[0][1:3], memory[1][1:-1]], runs, steps, 2)
    for a in memory:
        assert (a[0] == -1).all()
        assert (a[-1] == -1).all()
        np.testing.assert_array_equal(a[1:-1, 0, 0], x[: len(a) - 2, 0])


def choices(predicate_shared: bool, nested: bool, heavy: bool) -> Program:
    """A branch of two values, whose sides have shared inputs, inner branches and nodes that others want too."""
    g = Graph()
    x, z, u = g.input(("carry", 0), "f64"), g.input(("source", 0, 0), "f64"), g.input(("source", 1, 0), "f64")
    one = g.constant(1, "f64")
    p = g.make("gt", u if predicate_shared else z, g.constant(0, "f64"))

    def side(start: int, times: int) -> int:
        for i in range(times):
            start = g.make("max" if i % 2 else "sub", g.make("add", start, one), g.make("abs", start))
        return start

    count = 6 if heavy else 0
    common = side(g.make("add", x, u), 2)
    true, false = side(g.make("add", common, z), count), side(g.make("sub", common, z), count + 1)
    if nested:
        q = g.make("lt", z if predicate_shared else u, g.constant(0.5, "f64"))
        true = g.make("branch", q, side(true, count), side(g.make("neg", true), count), value=7)
        true = g.make("add", true, g.make("branch", q, side(u, count), one, value=7))
    first = g.make("branch", p, true, false, value=3)
    second = g.make("branch", p, side(g.make("add", z, one), count), common, value=3)
    third = g.make("branch", p, g.make("neg", side(u, count)), u, value=3)
    after = g.make("max", g.make("min", g.make("add", first, second), g.constant(100, "f64")), g.constant(-100, "f64"))
    outputs = (Output((first, second, third), "f64"), Output((false, side(after, 3)), "f64", 2))
    sources = (Source("f64", 1, False, True), Source("f64", 1, True, True))
    return Program(g, sources, (Leaf("f64", False, (0,), (0,)),), (Slot("f64", 0, 0, after),), outputs)


@pytest.mark.parametrize("heavy", [False, True])
@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("shared", [False, True])
def test_branches(shared, nested, heavy):
    p = choices(shared, nested, heavy)
    text = Kernel(p._replace(outputs=p.outputs[:1])).text
    assert nested or ("take" in text) == heavy  # two operations are not worth a jump
    rng = np.random.default_rng(5)
    for chance in (0, 0.5, 1):  # no run, some runs, all runs there
        z, u = (np.where(rng.random(s) < chance, 1, -1) * rng.integers(1, 9, s) / 8 for s in [(13, 40, 1), (40, 1)])
        check(p, [z, u], [rng.integers(-9, 9, (13, 1)) / 8], 13, 40)


def test_branch_that_waits_for_itself_is_a_select():
    """Two branches of one name, one inside the other's side."""
    g = Graph()
    z = g.input(("source", 0, 0), "f64")
    p = g.make("gt", z, g.constant(0, "f64"))

    def long(x: int) -> int:
        for i in range(9):
            x = g.make("add", g.make("abs", x), g.constant(i + 1, "f64"))
        return x

    inner = g.make("branch", p, long(z), z, value=1)
    outer = g.make("branch", p, long(g.make("neg", inner)), inner, value=1)
    program = Program(g, (Source("f64", 1, False, True),), (), (), (Output((outer,), "f64"),))
    check(program, [np.linspace(-3, 3, 60).reshape(6, 10, 1)], [], 6, 10)


def random_program(seed: int) -> Program:
    """Nodes at random, of operations that round nothing that another order or a fused product would round otherwise."""
    rng = np.random.default_rng(seed)
    g = Graph(strict=True)
    kinds = ["f64", "i32", "u64"] if seed % 2 else ["f32", "u32", "i32"]
    sources = [
        Source(k, int(rng.integers(1, 6)), bool(rng.integers(2)), bool(rng.integers(2))) for k in [*kinds, *kinds, "b"]
    ]
    pool: dict[str, list[int]] = {k: [g.constant(1, k)] for k in ["b", *kinds]}
    for k, source in enumerate(sources):
        pool[source.kind] += [g.input(("source", k, e), source.kind) for e in range(source.size)]
    carried = [str(k) for k in rng.permutation([*kinds, *kinds, "b"])]
    for i, kind in enumerate(carried):
        pool[kind].append(g.input(("carry", i), kind))
    pick = lambda kind: int(rng.choice(pool[kind][-14:]))  # noqa: E731
    for instance in range(70):
        kind = str(rng.choice(["b", *kinds]))
        way = rng.integers(5)
        if kind == "b" and way:
            of = str(rng.choice(kinds))
            node = g.make(str(rng.choice(sorted(COMPARISONS))), pick(of), pick(of))
        elif way == 0:
            node = g.make(str(rng.choice(["select", "branch"])), pick("b"), pick(kind), pick(kind), value=instance // 3)
        elif way == 1:
            node = g.make("convert", pick(str(rng.choice(["b", *kinds]))), kind=kind)
        else:
            ops = [
                "add",
                "sub",
                "max",
                "min",
                "neg",
                *(["abs", "floor", "round"] if kind[0] == "f" else ["mul", "and", "div", "rem", "shl", "shr"]),
            ]
            op = str(rng.choice(ops))
            node = g.make(op, *[pick(kind) for _ in range(1 if op in UNARY else 2)])
        pool[kind].append(node)
    slots = tuple(Slot(kind, i, 0, pick(kind)) for i, kind in enumerate(carried))
    leaves = tuple(Leaf(kind, bool(rng.integers(2)), (i,), (0,)) for i, kind in enumerate(carried))
    outputs = [
        Output(
            tuple(pick(kind) for _ in range(rng.integers(1, 7))), kind, int(rng.integers(1, 4)), bool(rng.integers(2))
        )
        for kind in ["b", *kinds]
    ]
    return Program(g, tuple(sources), leaves, slots, tuple(outputs), bool(seed % 3 == 0))


@pytest.mark.parametrize("seed", range(40))
def test_random_programs(seed, monkeypatch):
    monkeypatch.setattr(values, "LONG", 0 if seed % 4 > 1 else values.LONG)
    p = random_program(seed)
    rng = np.random.default_rng(seed)
    runs, steps = int(rng.integers(1, 30)), int(rng.integers(1, 9))

    def draw(kind: str, *shape: int) -> np.ndarray:
        return rng.choice(special(kind), shape)

    sources = [draw(s.kind, *([] if s.shared else [runs]), *([steps] if s.moving else []), s.size) for s in p.sources]
    start = [draw(f.kind, *([] if f.shared else [runs]), 1) for f in p.leaves]
    check(p, sources, start, runs, steps, int(rng.integers(0, runs + 1)), registers=1 + seed % 2)


def test_threads_give_the_same_numbers():
    """Sums too, to the last bit, however many work on them."""
    p = counter(outputs=((1, False, False), (1, False, True)))
    kernel = Kernel(p)
    rng = np.random.default_rng(2)
    z, x = rng.normal(size=(501, 300, 1)), rng.normal(size=(501, 1))
    results = [kernel([z], [x], 501, 300, threads=n) for n in (1, 2, 5)]
    for final, outs in results[1:]:
        for a, b in zip(final + outs, results[0][0] + results[0][1], strict=True):
            np.testing.assert_array_equal(a, b)


def test_results_go_where_they_are_asked_to():
    kernel = Kernel(counter(outputs=((1, False, False), (1, False, True))))
    out = [np.full((3, 4, 3), np.nan), np.full((4, 3), np.nan)]
    _, got = kernel([np.ones((3, 4, 1))], [np.zeros((3, 1))], 3, 4, out=out)
    assert got[0] is out[0]
    np.testing.assert_array_equal(out[1][:, 1], 3.0 * np.arange(1, 5))


def test_the_text_is_always_the_same():
    """So that code compiled by one process is found by another, whatever the order of its sets."""
    assert Kernel(random_program(3)).text == Kernel(random_program(3)).text


@pytest.mark.parametrize(
    ("sources", "start", "few"),
    [
        ([np.ones((3, 4, 1), np.float32)], [np.zeros((3, 1))], 0),
        ([np.ones((3, 5, 1))], [np.zeros((3, 1))], 0),
        ([np.ones((3, 4, 2))[..., :1]], [np.zeros((3, 1))], 0),
        ([np.ones((3, 4, 1))], [np.zeros((2, 1))], 0),
        ([np.ones((3, 4, 1))], [np.zeros((3, 1))], 4),
    ],
)
def test_arrays_that_do_not_fit_are_refused(sources, start, few):
    with pytest.raises(ValueError, match="expected"):
        Kernel(counter(outputs=((1, False, False),)))(sources, start, 3, 4, few)


def test_each_item_is_worked_on_once_and_errors_come_through():
    seen, lock = [], threading.Lock()

    def work(i: int) -> None:
        with lock:
            seen.append(i)
        if i == 13:
            raise RuntimeError("thirteen")

    each(work, range(12), 4)
    assert sorted(seen) == list(range(12))
    with pytest.raises(RuntimeError, match="thirteen"):
        each(work, [13], 4)
