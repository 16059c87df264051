"""Circular functions and their inverses, as nodes. Each to 2 units in the last place."""

from __future__ import annotations

import math

from jaxfilt.lanes.expression import Expression, function, polynomial, rarely, select
from jaxfilt.lanes.reduction import reduced

# Minimax polynomials (Remez exchange in 60 digits, then rounded), relative errors below 2^-55 and 2^-27.
_SIN = {
    "f64": (-0.1666666666666663, 0.008333333333322118, -0.00019841269829589333)
    + (2.755731362131678e-06, -2.5050747752597617e-08, 1.589622959095243e-10),
    "f32": (-1.6666655e-01, 8.33216e-03, -1.9515282e-04),
}
"""``sin r = r + r z P(z)``, z = r^2, |r| <= pi/4."""
_COS = {
    "f64": (0.04166666666666647, -0.0013888888888862, 2.4801587284094218e-05)
    + (-2.755731311719438e-07, 2.087558211578012e-09, -1.1353280739104033e-11),
    "f32": (4.166662e-02, -1.3886682e-03, 2.4383566e-05),
}
"""``cos r = 1 - z/2 + z^2 P(z)``."""
_ATAN = {
    "f64": (-0.333333333333332, 0.19999999999953247, -0.14285714280166417, 0.11111110782147834)
    + (-0.09090897725051056, 0.07692059713975588, -0.06663099165746088, 0.05847859004656098)
    + (-0.05039189246142243, 0.03806211057289675, -0.017905007972405955),
    "f32": (-3.3333316e-01, 1.9998471e-01, -1.4243533e-01, 1.0593811e-01, -6.0782142e-02),
}
"""``atan t = t + t z P(z)``, z = t^2, |t| <= tan(pi/8)."""
_ASIN = {
    "f64": (0.16666666666665408, 0.07500000000337016, 0.044642856828324154, 0.030381959137136972)
    + (0.022371758047281014, 0.017359704792068647, 0.013885235382397011, 0.012169210913589497)
    + (0.00652798336741552, 0.019528231481546345, -0.016224184792634946, 0.03191221471795673),
    "f32": (1.6666752e-01, 7.4952975e-02, 4.5470383e-02, 2.4179481e-02, 4.216636e-02),
}
"""``asin s = s + s z P(z)``, z = s^2 <= 1/4."""

_HALF_PI_LOW = {"f64": 6.123233995736766e-17, "f32": -4.371139000186241e-08}
"""pi/2 less its nearest float."""


@function
def sin(x: Expression) -> Expression:
    """sin x (rad); NaN of an infinite one."""
    rest, _, quadrant = reduced(x)
    sine, cosine = _near_zero(rest)
    return _of_quadrant(quadrant, sine, cosine)


@function
def cos(x: Expression) -> Expression:
    """cos x (rad); NaN of an infinite one."""
    rest, _, quadrant = reduced(x)
    sine, cosine = _near_zero(rest)
    return _of_quadrant(quadrant + 1, sine, cosine)


@function
def tan(x: Expression) -> Expression:
    """tan x (rad), from the sine and cosine of the rest with its excess, so that only their quotient rounds."""
    rest, excess, quadrant = reduced(x)
    z = rest * rest
    zz = z * z
    cosine = 1 - (0.5 * z - (zz * polynomial(z, _COS[x.kind]) + rest * excess))
    # Written so that the sine of -0 is -0.
    sine = rest - (excess * cosine - rest * _sine_excess(z, zz))
    odd, sign = _odd(quadrant), quadrant << _width(x) - 1
    return (select(odd, cosine, sine) / select(odd, sine, cosine)).times_sign(sign)


def _near_zero(rest: Expression) -> tuple[Expression, Expression]:
    """Sine and cosine of an angle up to pi/4."""
    z = rest * rest
    zz = z * z
    return rest + rest * _sine_excess(z, zz), (1 - 0.5 * z) + zz * polynomial(z, _COS[rest.kind])


def _sine_excess(z: Expression, zz: Expression) -> Expression:
    """``sin r / r - 1``; summed in this order it is +0 at 0, and a sine keeps the sign of its -0."""
    first, *others = _SIN[z.kind]
    return z * first + zz * polynomial(z, others)


def _of_quadrant(quadrant: Expression, sine: Expression, cosine: Expression) -> Expression:
    """sin(quadrant pi/2 + r)."""
    sign = (quadrant & 2) << _width(sine) - 2
    return select(_odd(quadrant), cosine, sine).times_sign(sign)


def _odd(quadrant: Expression) -> Expression:
    return (quadrant << _width(quadrant) - 1) < 0  # the sign bit: what blends look at


def _width(x: Expression) -> int:
    return int(x.kind[1:])


@function
def atan2(y: Expression, x: Expression) -> Expression:
    """The direction of (x, y) in [-pi, pi], signs of zeros and infinities as in C."""
    return _direction(y, x)


@function
def atan(x: Expression) -> Expression:
    """The angle in [-pi/2, pi/2] whose tangent is x."""
    return _direction(x, x.constant(1))


def _direction(y: Expression, x: Expression) -> Expression:
    """One quotient, of the smaller by the larger or, beyond pi/8 from both axes, of difference by sum."""
    tall, wide = abs(y), abs(x)
    steep = tall > wide
    least, most = _scaled(select(steep, wide, tall), select(steep, tall, wide))
    middle = least > most * math.tan(math.pi / 8)
    t = select(middle, least - most, least) / select(middle, least + most, most)
    z = t * t
    nothing, low = x.constant(0), x.constant(0.5 * _HALF_PI_LOW[x.kind])
    angle = t + (t * (z * polynomial(z, _ATAN[x.kind])) + select(middle, low, nothing))
    angle = select(middle, x.constant(math.pi / 4), nothing) + angle
    angle = select(steep, math.pi / 2 - angle, angle)
    angle = select(x.negative(), math.pi - angle, angle)
    return angle.times_sign(y.sign_bit())


def _scaled(least: Expression, most: Expression) -> tuple[Expression, ...]:
    """Two numbers, not negative, in the same proportion, whose sum and quotient are normal; (0, 0) as (0, 1), two
    infinities as (1, 1)."""
    number = most.format
    lowest = number.least
    highest = (number.infinity - number.one) // 2 + number.one  # about the root of the largest number
    # One signed comparison finds what is less than the lowest or not less than the highest, NaN included.
    rare = most.bits() + (number.sign - lowest) >= (highest - lowest) - number.sign
    factor = select(most < 1, most.constant(2.0 ** (number.precision + 1)), most.constant(0.25))
    endless = least.equals(math.inf) & most.equals(math.inf)
    large = select(most.equals(0) | endless, 1, most * factor)
    return rarely(rare, (select(endless, 1, least * factor), least), (large, most))


@function
def asin(x: Expression) -> Expression:
    """The angle in [-pi/2, pi/2] whose sine is x; NaN outside [-1, 1]."""
    far, s, excess = _arc(x)
    half_pi = x.constant(math.pi / 2)
    beyond = (half_pi - 2 * s) - (2 * excess - _HALF_PI_LOW[x.kind])
    return select(far, beyond, s + excess).times_sign(x.sign_bit())


@function
def acos(x: Expression) -> Expression:
    """The angle in [0, pi] whose cosine is x; NaN outside [-1, 1]."""
    far, s, excess = _arc(x)
    half_pi, low = x.constant(math.pi / 2), _HALF_PI_LOW[x.kind]
    near = (half_pi - x) - (excess.times_sign(x.sign_bit()) - low)
    back = (2 * half_pi - 2 * s) - (2 * excess - 2 * low)
    return select(far, select(x.negative(), back, 2 * s + 2 * excess), near)


def _arc(x: Expression) -> tuple[Expression, Expression, Expression]:
    """Whether |x| > 1/2; s and the excess of asin s over it, where s is |x| or, far, the sine of half the angle left
    to pi/2, sqrt((1 - |x|) / 2).

    Source: J.-M. Muller, Elementary Functions (3rd ed., 2016).
    """
    size = abs(x)
    far = size > 0.5
    z = select(far, 0.5 - 0.5 * size, size * size)
    s = select(far, z.sqrt(), size)
    return far, s, s * (z * polynomial(z, _ASIN[x.kind]))
