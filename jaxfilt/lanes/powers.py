"""Powers and roots, as nodes. Each to 2 units in the last place."""

from __future__ import annotations

import math
from typing import NamedTuple

from jaxfilt.lanes.exponentials import (
    EXP,
    add_to_exponent,
    exponential,
    natural_logarithm,
    parts,
    shift_bits,
    times_power_of_two,
    unusual,
    whole,
)
from jaxfilt.lanes.expression import Expression, function, polynomial, rarely, select

_LOG = (0.5999999999999996, 0.4285714285716765, 0.3333333332630907, 0.2727272830493506) + (
    0.23076835343120505,
    0.20004474720179333,
    0.17512256335269583,
    0.17983281867602693,
)
"""``log((1 + s) / (1 - s)) = 2/3 s (3 + z + z^2 P(z))``, z = s^2: minimax, relative error 2^-73."""

_TO_BINARY = (0.9617966860532761, 7.872699542894897e-09)
"""2 / (3 log 2), the first part of 26 bits."""
_CBRT = (0.6272947086661814, 0.4491937738879122, -0.08377510423176115, 0.009583824004411183, -0.00043210115272054135)
"""The cube root on [1, 8): minimax, relative error 2^-9."""

_LONGEST = 2.0**70
"""An exponent beyond which every base but 1 gives 0 or infinity."""


class _Pair(NamedTuple):
    """A sum of two floats: `high` has 26 bits, so that products of two of them are exact, `low` the rest."""

    high: Expression
    low: Expression


@function
def rsqrt(x: Expression) -> Expression:
    """1 / sqrt(x)."""
    return 1 / x.sqrt()


@function
def cbrt(x: Expression) -> Expression:
    """Cube root of any sign: a polynomial and Halley's iteration, each step of which triples the digits."""
    number = x.format
    size = abs(x)
    rare = unusual(size)
    steps = 3 * (number.precision // 3 + 1)
    odd_ones = size.equals(0) | ~(size < math.inf)
    (inside,) = rarely(rare, (select(odd_ones, 1, size * 2.0**steps), size))
    bits = inside.bits()
    exponent = bits >> number.precision
    shifted = (whole(exponent) - 1) * (1 / 3) + number.shift
    third = shifted.bits() - shift_bits(x)
    m = (bits - ((third + (third << 1)) << number.precision)).floating()  # in [1, 8)
    root = polynomial(m, _CBRT)
    for _ in range(2 if x.kind == "f64" else 1):
        cube = root * root * root
        root = root - root * ((cube - m) / (2 * cube + m))
    root = add_to_exponent(root, third)
    (root,) = rarely(rare, (select(odd_ones, size, root * 2.0 ** (-steps // 3)), root))
    return root.times_sign(x.sign_bit())


@function
def pow(x: Expression, y: Expression) -> Expression:
    """x^y, special cases as in C: x^0 = 1^y = 1 even of NaN; of a negative x NaN unless y is an integer."""
    exponent = x.graph.known(y.node)
    if exponent is not None and exponent in (1, 2, -1):
        return {1: x, 2: x * x, -1: 1 / x}[int(exponent)]
    if x.kind == "f32":
        return _power(x.convert("f64"), y.convert("f64"), _approximate_power).convert("f32")
    return _power(x, y, _accurate_power)


def _power(x: Expression, y: Expression, of_positive) -> Expression:
    rare = unusual(x) | ~(abs(y) <= _LONGEST)
    base, more, bounded = rarely(rare, *zip(_tamed(x, y), (x, x.constant(0), y), strict=True))
    usual = of_positive(base, more, bounded)
    (result,) = rarely(rare, (_of_any(x, y, usual), usual))
    return result


def _tamed(x: Expression, y: Expression) -> tuple[Expression, Expression, Expression]:
    """A positive normal base, what to add to its exponent, and y no longer than matters."""
    size = abs(x)
    endless = x.equals(0) | ~(size < math.inf)
    tiny = size < math.ldexp(1.0, 1 - x.format.bias)
    base = select(endless, 1, select(tiny, size * 2.0**54, size))
    bounded = select(y > _LONGEST, _LONGEST, select(y < -_LONGEST, -_LONGEST, y))
    return base, select(tiny & ~endless, x.constant(-54), x.constant(0)), bounded


def _of_any(x: Expression, y: Expression, usual: Expression) -> Expression:
    """The special cases; `usual` is right for \\|x\\| if that is neither 0 nor infinite."""
    size, zero, back = abs(x), x.equals(0), x.negative()
    endless = size.equals(math.inf)
    whole_number = Expression(x.graph, x.graph.make("floor", y.node)).equals(y)
    half = 0.5 * y
    odd = whole_number & ~Expression(x.graph, x.graph.make("floor", half.node)).equals(half)
    result = select(zero, select(y > 0, x.constant(0), math.inf), usual)
    result = select(endless, select(y > 0, x.constant(math.inf), 0), result)
    result = select(back & odd, -result, result)
    result = select((x < 0) & ~(endless | whole_number), math.nan, result)
    unknown = ~(x.equals(x) & y.equals(y))
    return select(y.equals(0) | x.equals(1), 1, select(unknown, math.nan, result))


def _approximate_power(x: Expression, more: Expression, y: Expression) -> Expression:
    """To about 2^-44: enough for float32."""
    fraction, exponent = parts(x)
    logarithm = natural_logarithm(fraction - 1, whole(exponent) + more)
    return exponential(y * logarithm)


def _accurate_power(x: Expression, more: Expression, y: Expression) -> Expression:
    """2^(y log2 x), the exponent to some 2^-58: as long as the result's own digits need.

    Source: J.-M. Muller, Elementary Functions (3rd ed., 2016): exact products of short factors.
    """
    logarithm = _binary_logarithm(x, more)
    factor = _truncated(y)
    high = factor * logarithm.high
    low = (y - factor) * logarithm.high + y * logarithm.low
    exponent = high + low
    rare = ~(abs(exponent) <= x.format.bias - 3.0)
    far = abs(exponent) > 2000.0
    within = select(far, select(exponent > 0, x.constant(2000), -2000), exponent)
    shift = x.format.shift

    def power(exponent: Expression, high: Expression, low: Expression) -> tuple[Expression, Expression]:
        shifted = exponent + shift
        r = ((high - (shifted - shift)) + low) * math.log(2)
        return 1 + r * (1 + r * polynomial(r, EXP["f64"])), shifted.bits() - shift_bits(x)

    beyond, n = power(within, select(far, within, high), select(far, 0, low))
    near, m = power(exponent, high, low)
    (result,) = rarely(rare, (times_power_of_two(beyond, n), add_to_exponent(near, m)))
    return result


def _binary_logarithm(x: Expression, more: Expression) -> _Pair:
    """log2(x) + more, from the series of log in s = f / (2 + f), every leading term of which is a pair."""
    fraction, exponent = parts(x)
    f = fraction - 1
    s = _quotient(f)
    both = s.high + s.low
    z = both * both
    rest = z * z * polynomial(z, _LOG) + s.low * (s.high + both)
    square = s.high * s.high
    sum_high = _truncated(3 + (square + rest))
    sum_low = rest - ((sum_high - 3) - square)
    product = s.high * sum_high
    product_low = s.low * sum_high + sum_low * both
    high = _truncated(product + product_low)
    low = product_low - (high - product)
    scale_high, scale_low = _TO_BINARY
    binary = high * scale_high
    binary_low = high * scale_low + low * (scale_high + scale_low)
    k = whole(exponent) + more
    total = _truncated(k + (binary + binary_low))
    return _Pair(total, binary_low - ((total - k) - binary))


def _quotient(f: Expression) -> _Pair:
    """f / (2 + f)."""
    below = 2 + f
    reciprocal = 1 / below
    high = _truncated(f * reciprocal)
    below_high = _truncated(below)
    below_low = f - (below_high - 2)
    return _Pair(high, ((f - high * below_high) - high * below_low) * reciprocal)


def _truncated(x: Expression) -> Expression:
    """The first 26 bits of a float64."""
    return (x.bits() & -(1 << 27)).floating()
