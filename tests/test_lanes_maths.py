"""Elementary functions as nodes: against mpmath in 50 digits, in NumPy and compiled; special values against C's."""

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import jax
import mpmath as mp
import numpy as np
import pytest
import scipy.special

from jaxfilt.lanes import maths
from jaxfilt.lanes.graph import KINDS, Graph
from jaxfilt.lanes.program import Output, Program, Source
from tests.graphs import evaluate, size

KIND = pytest.mark.parametrize("kind", ["f64", "f32"])
DIGITS = {"f64": (53, -1074, 1023), "f32": (24, -149, 127)}
"""Of a format: digits, the exponent of its smallest number and of its largest."""


class Case(NamedTuple):
    exact: Callable
    arguments: Callable
    """(random, kind, count) to arrays."""
    ulps: float = 2.0
    """The largest error, in units of the last place."""


def scale(kind: str) -> float:
    """What the exponents of float64 are multiplied by."""
    return 1.0 if kind == "f64" else 1 / 8


def signed(r, values):
    return values * r.choice([-1.0, 1.0], len(values))


def angles(r, kind, n):
    """Headings, multiples of pi/2, what a filter may meet and what it should not."""
    multiples = r.integers(1, 1000, n) * (math.pi / 2)
    return np.concatenate(
        [r.uniform(-4, 4, n), multiples, r.uniform(-1e5, 1e5, n), signed(r, 10 ** r.uniform(-12, 0, n))]
    )


def huge_angles(r, kind, n):
    hardest = (
        6381956970095103 * 2.0**797 if kind == "f64" else 16367173 * 2.0**72
    )  # nearest to a multiple of pi/2 (Muller, Elementary Functions)
    border = np.array([1e6, 1e6 + 1, 800.0, 801.0, 1e15, hardest])
    return np.concatenate([signed(r, 10 ** r.uniform(5, 300 * scale(kind), n)), border, -border])


def exponents(r, kind, n):
    low, high = (-745.0, 709.7) if kind == "f64" else (-103.0, 88.7)
    return np.concatenate([r.uniform(-1, 1, n), r.uniform(low, high, n), signed(r, 10 ** r.uniform(-18, 0, n))])


def positive(r, kind, n):
    """Around 1 and of every exponent, subnormal ones too."""
    low, high = (-1070, 1023) if kind == "f64" else (-147, 127)
    return np.concatenate([r.uniform(0.5, 2, n), 2 ** r.uniform(low, high, n)])


def unit(r, kind, n):
    """Within [-1, 1] and towards both ends of it and 0."""
    small = 10 ** r.uniform(-15 * (0.4 if kind == "f32" else 1), 0, n)
    return np.concatenate([r.uniform(-1, 1, n), signed(r, 1 - 0.9 * small), signed(r, small * 0.99)])


def planes(r, kind, n):
    y, x = r.normal(size=(2, 3 * n))
    y[n : 2 * n] *= 1e3
    far = 2.0 ** (1000 * scale(kind))
    x[2 * n :] *= far
    y[2 * n :] *= far
    return y, x


def powers(r, kind, n):
    most = 7000 * (1 if kind == "f64" else 1 / 8)
    x = np.concatenate([r.uniform(0.01, 100, n), 2 ** r.uniform(-100, 100, n), r.uniform(0.9, 1.1, n)])
    y = np.concatenate([r.uniform(-9, 9, n), r.uniform(-1, 1, n), r.uniform(-most, most, n)])
    return x, y


def single(arguments, *transforms):
    """Cases of one argument."""
    return lambda r, kind, n: (np.concatenate([f(arguments(r, kind, n)) for f in transforms or [lambda x: x]]),)


CASES = {
    "sin": Case(mp.sin, single(angles)),
    "cos": Case(mp.cos, single(angles)),
    "tan": Case(mp.tan, single(angles)),
    "asin": Case(mp.asin, single(unit)),
    "acos": Case(mp.acos, single(unit)),
    "atan": Case(mp.atan, lambda r, kind, n: (signed(r, 10 ** r.uniform(-20, 20, 2 * n)),)),
    "atan2": Case(mp.atan2, planes),
    "exp": Case(mp.exp, single(exponents)),
    "exp2": Case(lambda x: mp.mpf(2) ** x, single(exponents)),
    "expm1": Case(mp.expm1, single(exponents)),
    "log": Case(mp.log, single(positive)),
    "log1p": Case(mp.log1p, lambda r, kind, n: (np.concatenate([positive(r, kind, n), 0.999 * unit(r, kind, n)]),)),
    "logistic": Case(lambda x: 1 / (1 + mp.exp(-x)), lambda r, kind, n: (r.uniform(-80, 80, 2 * n),)),
    "sinh": Case(mp.sinh, single(exponents, np.abs)),
    "cosh": Case(mp.cosh, single(exponents, np.abs)),
    "tanh": Case(mp.tanh, single(exponents), 2.6),
    "asinh": Case(mp.asinh, single(exponents)),
    "acosh": Case(mp.acosh, single(positive, lambda x: 1 + x)),
    "atanh": Case(mp.atanh, single(unit, lambda x: 0.999999 * x)),
    "rsqrt": Case(lambda x: 1 / mp.sqrt(x), single(positive)),
    "cbrt": Case(lambda x: mp.sign(x) * mp.cbrt(abs(x)), single(positive, lambda x: -x, lambda x: x)),
    "pow": Case(lambda x, y: x**y, powers),
    "erf": Case(mp.erf, lambda r, kind, n: (np.concatenate([r.uniform(-6, 6, n), 0.5 * unit(r, kind, n)]),)),
    "erfc": Case(mp.erfc, lambda r, kind, n: (r.uniform(-6, 26 if kind == "f64" else 9.5, 2 * n),), 2.6),
    # Near 1 the rounding of x^2 tells: there it is compared with JAX, not with the truth.
    "erf_inv": Case(mp.erfinv, lambda r, kind, n: (r.uniform(-0.5, 0.5, n),), 4.0),
}


def node_of(name: str, kind: str, count: int) -> tuple[Graph, int]:
    graph = Graph(strict=True)
    return graph, getattr(maths, name)(graph, *(graph.input(("source", 0, i), kind) for i in range(count)))


def in_numpy(name: str, kind: str, *arguments: np.ndarray) -> np.ndarray:
    graph, node = node_of(name, kind, len(arguments))
    return evaluate(graph, [node], {("source", 0, i): a for i, a in enumerate(arguments)})[0]


def compiled(name: str, kind: str, *arguments: np.ndarray) -> np.ndarray:
    runs = len(arguments[0])
    _, (result,) = kernel_of(name, kind, len(arguments))([np.stack(arguments, 1).copy()], [], runs, 1)
    return result.reshape(runs)


@cache
def kernel_of(name: str, kind: str, count: int) -> Callable:
    pytest.importorskip("llvmlite")
    from jaxfilt.lanes.kernel import Kernel

    graph, node = node_of(name, kind, count)
    source = Source(kind, count, shared=False, moving=False)
    return Kernel(Program(graph, (source,), (), (), (Output((node,), kind),)))


COMPUTED = pytest.mark.parametrize("computed", [in_numpy, compiled])


def ulps(got: np.ndarray, want: list, kind: str) -> np.ndarray:
    """Errors in units of the last place that the true value has in the format."""
    digits, least, most = DIGITS[kind]
    errors = []
    for value, true in zip(got, want, strict=True):
        exponent = max(int(mp.floor(mp.log(abs(true), 2))) + 1 - digits, least) if true else least
        overflow = abs(true) >= mp.mpf(2) ** most * (2 - mp.mpf(2) ** -digits)
        if overflow or not np.isfinite(value):
            errors.append(0.0 if overflow and value == math.copysign(math.inf, true) else math.inf)
        else:
            errors.append(float(abs(mp.mpf(float(value)) - true) / mp.mpf(2) ** exponent))
    return np.array(errors)


def assert_accurate(computed, name: str, kind: str, arguments, limit: float) -> None:
    arguments = [np.asarray(a).astype(KINDS[kind]) for a in arguments]
    got = computed(name, kind, *arguments)
    assert got.dtype == KINDS[kind]
    want = [CASES[name].exact(*map(mp.mpf, map(float, values))) for values in zip(*arguments, strict=True)]
    errors = ulps(got, want, kind)
    worst = int(np.argmax(errors))
    assert errors[worst] <= limit, (
        f"{name}{tuple(a[worst] for a in arguments)}: {errors[worst]:.2f} ulp, got {got[worst]}, {want[worst]}"
    )


@KIND
@COMPUTED
@pytest.mark.parametrize("name", CASES)
def test_accuracy(name, computed, kind):
    case = CASES[name]
    with mp.workdps(50):
        assert_accurate(computed, name, kind, case.arguments(np.random.default_rng(1), kind, 150), case.ulps)


@KIND
@COMPUTED
@pytest.mark.parametrize("name", ["sin", "cos", "tan"])
def test_angles_however_large(name, computed, kind):
    with mp.workdps(400):
        assert_accurate(computed, name, kind, [huge_angles(np.random.default_rng(2), kind, 100)], 4)


def specials(kind: str) -> np.ndarray:
    number = np.finfo(KINDS[kind])
    values = [0.0, 1, 0.5, 2, 3, 7, 1e-3, number.tiny, number.smallest_subnormal, number.max, number.max / 2, np.inf]
    return np.array([*values, *(-v for v in values), np.nan, math.pi, -math.pi], KINDS[kind])


REFERENCE = {
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "asinh": np.arcsinh,
    "acosh": np.arccosh,
    "atanh": np.arctanh,
    "pow": np.power,
    "logistic": scipy.special.expit,
    "erf": scipy.special.erf,
    "erfc": scipy.special.erfc,
    "erf_inv": lambda x: np.copysign(scipy.special.erfinv(x), x),  # SciPy has no -0
    "rsqrt": lambda x: 1 / np.sqrt(x),
}
"""Where NumPy has another name, or none, for it."""


@KIND
@COMPUTED
@pytest.mark.parametrize("name", CASES)
def test_special_values(name, computed, kind):
    """Zeros with their signs, infinities, NaN, the smallest and largest numbers: as in C."""
    values = specials(kind)
    arguments = [values]
    if name in ("pow", "atan2"):
        arguments = [a.ravel() for a in np.meshgrid(values, values)]
    with np.errstate(all="ignore"):
        want = (REFERENCE.get(name) or getattr(np, name))(*arguments).astype(KINDS[kind])
    got = computed(name, kind, *arguments)
    np.testing.assert_allclose(got, want, rtol=4 * np.finfo(KINDS[kind]).eps, atol=0)
    known = ~np.isnan(want)
    np.testing.assert_array_equal(np.signbit(got)[known], np.signbit(want)[known])


@KIND
def test_not_a_number_of_any_bits_stays_so(kind):
    """No bits of a NaN get into the exponent of a result."""
    bits = {"f64": "u8", "f32": "u4"}[kind]
    dtype = KINDS[kind]
    quiet = np.array([np.nan], dtype).view(bits)
    nans = (quiet | np.arange(1, 4096, 7).astype(bits)).view(dtype)
    for name in CASES:
        for sign in (nans, -nans):
            arguments = [sign] * (2 if name in ("pow", "atan2") else 1)
            assert np.isnan(in_numpy(name, kind, *arguments)).all(), name


@KIND
def test_inverse_error_function_is_that_of_xla(kind):
    r = np.random.default_rng(3)
    dtype = KINDS[kind]
    x = np.concatenate([r.uniform(-1, 1, 3000), signed(r, 1 - 10 ** r.uniform(-15 * scale(kind) ** 0.4, 0, 3000))])
    x = x.astype(dtype)
    got, want = in_numpy("erf_inv", kind, x), np.asarray(jax.jit(jax.lax.erf_inv)(x))
    np.testing.assert_allclose(got, want, rtol=20 * np.finfo(dtype).eps, atol=0)  # its logarithm is off by that


@KIND
def test_sine_and_cosine_share_their_work(kind):
    graph = Graph()
    x = graph.input(("source", 0, 0), kind)
    nodes = maths.sin(graph, x), maths.cos(graph, x)
    alone, both = size(graph, nodes[:1], usual=True), size(graph, nodes, usual=True)
    assert both <= alone + 8
    assert len({graph.value[n] for n in range(len(graph)) if graph.op[n] == "branch"}) == (1 if kind == "f64" else 2)


def test_how_many_operations():
    """Multiplications and additions counted apart: a machine that fuses them needs about two thirds."""
    most = {"sin": 48, "exp": 35, "log": 36, "log1p": 43, "atan2": 51, "cbrt": 45, "tanh": 44, "pow": 120}
    for name, limit in most.items():
        graph, node = node_of(name, "f64", 2 if name in ("atan2", "pow") else 1)
        assert size(graph, [node], usual=True) <= limit, name


@KIND
@pytest.mark.parametrize("name", CASES)
def test_of_a_constant_is_a_constant(name, kind):
    graph = Graph()
    arguments = [graph.constant(value, kind) for value in ((0.3, 0.7) if name in ("pow", "atan2") else (0.3,))]
    if name == "acosh":
        arguments = [graph.constant(1.3, kind)]
    found = graph.known(getattr(maths, name)(graph, *arguments))
    assert found is not None
    assert found == in_numpy(name, kind, *(np.array([graph.known(a)]) for a in arguments))[0]


@KIND
def test_powers_that_are_products(kind):
    graph = Graph()
    x = graph.input(("source", 0, 0), kind)
    assert maths.pow(graph, x, graph.constant(2, kind)) == graph.make("mul", x, x)
    assert maths.pow(graph, x, graph.constant(1, kind)) == x
    assert maths.pow(graph, x, graph.constant(-1, kind)) == graph.make("div", graph.constant(1, kind), x)
