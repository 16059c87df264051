"""Exponentials, logarithms and what is made of them, as nodes. Each to 2 units in the last place."""

from __future__ import annotations

import math

from jaxfilt.lanes.expression import Expression, function, polynomial, rarely, select

# Minimax polynomials (Remez exchange in 60 digits, then rounded), relative errors below 2^-55 and 2^-26.
EXP = {
    "f64": (0.5000000000000006, 0.16666666666666685, 0.0416666666665737, 0.008333333333314567)
    + (0.0013888888932354223, 0.00019841269903068576, 2.4801504476987482e-05)
    + (2.7557227931844513e-06, 2.762631360262775e-07, 2.5114477038119903e-08),
    "f32": (5.0e-01, 1.6666543e-01, 4.166628e-02, 8.366577e-03, 1.3946439e-03),
}
"""``exp r = 1 + r + r^2 P(r)``, |r| <= log(2) / 2."""
_LOG = {
    "f64": (0.6666666666666734, 0.39999999999414665, 0.2857142874239035, 0.22222198572905133)
    + (0.18183564340168681, 0.1531405020727773, 0.14795953013998203),
    "f32": (6.6666776e-01, 3.9977542e-01, 2.9871732e-01),
}
"""``log((1 + s) / (1 - s)) = 2 s + s z P(z)``, z = s^2, |s| <= 3 - 2 sqrt(2)."""

_LOG_2 = {"f64": (0.6931471805598903, 5.497923018708371e-14), "f32": (0.693145751953125, 1.428606765330187e-06)}
"""log 2 in two parts, whose first is so short (42 bits; 15) that its multiples by an exponent are exact."""

_EXP_NORMAL = {"f64": 708.0, "f32": 87.0}
"""Up to here the exponential and its inverse are normal numbers."""


def exponential(x: Expression, excess: Expression | None = None) -> Expression:
    """e^(x + excess), for an excess far smaller than x; infinite, subnormal or 0 where it must be.

    Source: W. J. Cody and W. Waite, Software Manual for the Elementary Functions (1980), ch. 6 (range reduction).
    """
    rare = ~(abs(x) <= _EXP_NORMAL[x.kind])
    power, shifted = _power(x, excess)
    near = add_to_exponent(power, shifted.bits())
    limit = 2 * _EXP_NORMAL[x.kind]
    within = select(x > limit, limit, select(x < -limit, -limit, x))
    power, shifted = _power(within, excess)
    (result,) = rarely(rare, (times_power_of_two(power, shifted.bits() - shift_bits(x)), near))
    return result


def _power(x: Expression, excess: Expression | None = None) -> tuple[Expression, Expression]:
    """e^r for ``x = n log 2 + r``, and n with the format's `shift` added."""
    r, shifted = _rest(x, excess)
    return 1 + r * (1 + r * polynomial(r, EXP[x.kind])), shifted


def _rest(x: Expression, excess: Expression | None = None) -> tuple[Expression, Expression]:
    shift = x.format.shift
    shifted = x * (1 / math.log(2)) + shift
    n = shifted - shift
    high, low = _LOG_2[x.kind]
    below = n * low if excess is None else n * low - excess
    return (x - n * high) - below, shifted


def shift_bits(x: Expression) -> int:
    number = x.format
    return ((number.bias + number.precision) << number.precision) + (1 << (number.precision - 1))


def add_to_exponent(x: Expression, n: Expression) -> Expression:
    """``x 2^n`` where both are normal; of n only the last bits count, its others go out at the top."""
    return (x.bits() + (n << x.format.precision)).floating()


def times_power_of_two(x: Expression, n: Expression) -> Expression:
    """``x 2^n`` in two steps, that it may become subnormal, 0 or infinite: of |n| up to twice the largest exponent."""
    half = n.arithmetic_shift(1)
    return x * _power_of_two(half) * _power_of_two(n - half)


def _power_of_two(n: Expression) -> Expression:
    """Of an integer, where the power is normal."""
    return ((n + n.format.bias) << n.format.precision).floating()


@function
def exp(x: Expression) -> Expression:
    """e^x."""
    return exponential(x)


@function
def exp2(x: Expression) -> Expression:
    """2^x."""
    shift = x.format.shift
    largest = 2.0 * x.format.bias
    within = select(x > largest, largest, select(x < -largest, -largest, x))
    shifted = within + shift
    r = (within - (shifted - shift)) * math.log(2)
    power = 1 + r * (1 + r * polynomial(r, EXP[x.kind]))
    return times_power_of_two(power, shifted.bits() - shift_bits(x))


@function
def expm1(x: Expression) -> Expression:
    """e^x - 1 without the loss of digits near 0."""
    rare = ~(abs(x) <= _EXP_NORMAL[x.kind])
    (result,) = rarely(rare, (exponential(x) - 1, _exponential_less_one(x)))
    return select(x.equals(0), x, result)


def _exponential_less_one(x: Expression) -> Expression:
    """e^x - 1 where e^|x| is a normal number; the large terms, whose sum is exact or nearly so, are added first."""
    r, shifted = _rest(x)
    power = _power_of_two(shifted.bits() - shift_bits(x))
    return ((power - 1) + power * r) + power * (r * (r * polynomial(r, EXP[x.kind])))


@function
def log(x: Expression) -> Expression:
    """Natural logarithm; NaN of a negative number, -inf of 0."""
    (result,) = rarely(unusual(x), (_log_of_any(x), natural_logarithm(*_significand(x))))
    return result


def unusual(x: Expression) -> Expression:
    """Whether x is not a positive normal number, by one signed comparison."""
    number = x.format
    return x.bits() + (number.sign - number.least) >= number.infinity - number.least - number.sign


def _log_of_any(x: Expression) -> Expression:
    """Of subnormal numbers, 0, infinity, negative numbers and NaN too."""
    number = x.format
    steps = number.precision + 2
    tiny = x < math.ldexp(1.0, 1 - number.bias)
    f, exponent = _significand(select(tiny, x * 2.0**steps, x))
    result = natural_logarithm(f, select(tiny, exponent - steps, exponent))
    result = select(x < math.inf, result, x)
    return select(x > 0, result, select(x.equals(0), x.constant(-math.inf), math.nan))


def _significand(x: Expression) -> tuple[Expression, Expression]:
    """``x = (1 + f) 2^e`` with 1 + f in [sqrt(1/2), sqrt(2)): f and e, both floats."""
    fraction, exponent = parts(x)
    return fraction - 1, whole(exponent)


def parts(x: Expression) -> tuple[Expression, Expression]:
    """The 1 + f of `_significand`, and e + bias as an integer."""
    number = x.format
    root = _root_half(number.precision)
    moved = x.bits() + (number.one - root)
    return ((moved & ((1 << number.precision) - 1)) + root).floating(), moved >> number.precision


def _root_half(precision: int) -> int:
    """The bits of sqrt(1/2)."""
    return {52: 0x3FE6A09E667F3BCD, 23: 0x3F3504F3}[precision]


def whole(exponent: Expression) -> Expression:
    """An exponent with its bias as a float without, by the last bits of a float that is large enough."""
    number = exponent.format
    large = 2.0**number.precision
    bits = (number.bias + number.precision) << number.precision
    return (exponent | bits).floating() - (large + number.bias)


def natural_logarithm(f: Expression, exponent: Expression) -> Expression:
    """log(1 + f) + exponent log 2. The square's half is kept apart from what is summed in less digits.

    Source: J.-M. Muller, Elementary Functions (3rd ed., 2016): the series in f / (2 + f).
    """
    s = f / (2 + f)
    z = s * s
    half = 0.5 * f * f
    high, low = _LOG_2[f.kind]
    below = s * (half + z * polynomial(z, _LOG[f.kind])) + exponent * low
    return exponent * high - ((half - below) - f)


@function
def log1p(x: Expression) -> Expression:
    """log(1 + x) without the loss of digits near 0."""
    return select(x.equals(0), x, log_beside_one(x))


def log_beside_one(x: Expression) -> Expression:
    """log(1 + x), of whose sum only the exponent is used."""
    total = 1 + x
    number = x.format
    _, exponent = parts(total)
    scale = ((2 * number.bias - exponent) << number.precision).floating()
    near = natural_logarithm((scale - 1) + scale * x, whole(exponent))
    # No number to have a logarithm of, or so large that its reciprocal is not normal: nothing is lost by the sum.
    rare = ~((total > 0) & (total < 2.0 ** (number.bias - 1)))
    (result,) = rarely(rare, (_log_of_any(total), near))
    return result


@function
def logistic(x: Expression) -> Expression:
    """1 / (1 + e^-x)."""
    return 1 / (1 + exponential(-x))


@function
def tanh(x: Expression) -> Expression:
    """Hyperbolic tangent."""
    enough = {"f64": 20.0, "f32": 10.0}[x.kind]
    size = abs(x)
    less_one = _exponential_less_one(2 * select(size > enough, enough, size))
    return (less_one / (less_one + 2)).times_sign(x.sign_bit())


@function
def sinh(x: Expression) -> Expression:
    """Hyperbolic sine."""
    size = abs(x)
    less_one = _exponential_less_one(size)
    near = 0.5 * (less_one + less_one / (less_one + 1))
    root = exponential(0.5 * size)
    (result,) = rarely(size > _EXP_NORMAL[x.kind], ((0.5 * root) * root, near))
    return result.times_sign(x.sign_bit())


@function
def cosh(x: Expression) -> Expression:
    """Hyperbolic cosine."""
    size = abs(x)
    power = exponential(size)
    root = exponential(0.5 * size)
    far = (0.5 * root) * root
    (result,) = rarely(size > _EXP_NORMAL[x.kind], (far, 0.5 * (power + 1 / power)))
    return result


@function
def asinh(x: Expression) -> Expression:
    """Inverse hyperbolic sine."""
    size = abs(x)
    square = size * size
    near = log_beside_one(size + square / (1 + (1 + square).sqrt()))
    return _doubled_if_large(size, near).times_sign(x.sign_bit())


@function
def acosh(x: Expression) -> Expression:
    """Inverse hyperbolic cosine; NaN below 1."""
    above = x - 1
    result = _doubled_if_large(x, log_beside_one(above + (above * (x + 1)).sqrt()))
    return select(above < 0, math.nan, result)


def _doubled_if_large(x: Expression, near: Expression) -> Expression:
    """log 2x where the square of x has no room."""
    (result,) = rarely(x > 2.0 ** (x.format.bias // 2), (_log_of_any(x) + math.log(2), near))
    return result


@function
def atanh(x: Expression) -> Expression:
    """Inverse hyperbolic tangent; NaN outside [-1, 1]."""
    size = abs(x)
    return (0.5 * log_beside_one(2 * size / (1 - size))).times_sign(x.sign_bit())
