"""Angles brought to [-pi/4, pi/4]: what is left of x after the nearest multiple of pi/2."""

from __future__ import annotations

import math
from typing import NamedTuple

from jaxfilt.lanes.expression import Expression, rarely, select


class Reduced(NamedTuple):
    """``x = quadrant pi/2 + rest - excess``. `quadrant` counts modulo 4 (an integer: its last two bits are right);
    `excess`, of about a unit in the last place of `rest`, is what roundings left over (not told of a large x)."""

    rest: Expression
    excess: Expression
    quadrant: Expression


_HALF_PI = {
    "f64": (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21),
    "f32": (1.57073974609375, 5.657970905303955e-05, 9.920881893776823e-10, 5.390302953474238e-15),
}
"""pi/2 in parts, whose first are so short (33 bits; 15 in float32) that their multiples up to `_FAR` are exact;
positive, so that -0 stays -0."""

_FAR = {"f64": 1e6, "f32": 800.0}

_TWO_OVER_PI = (
    (0x0000000000000000, 0xA2F9836E4E441529, 0xFC2757D1F534DDC0, 0xDB6295993C439041, 0xFE5163ABDEBBC561)
    + (0xB7246E3A424DD2E0, 0x06492EEA09D1921C, 0xFE1DEB1CB129A73E, 0xE88235F52EBB4484, 0xE99C7026B45F7E41)
    + (0x3991D639835339F4, 0x9C845F8BBDF9283B, 0x1FF897FFDE05980F, 0xEF2F118B5A0A6D1F, 0x6D367ECF27CB09B7)
    + (0x4F463F669E5FEA2D, 0x7527BAC7EBE5F17B, 0x3D0739F78A5292EA, 0x6BFB5FB11F8D5D08, 0x56033046FC7B6BAB)
)
"""The fraction's bits, after 64 zeros; the first word's last bit counts 1."""


def reduced(x: Expression) -> Reduced:
    """x less the nearest multiple of pi/2, to about a unit in the last place however much cancels.

    Source: W. J. Cody and W. Waite, Software Manual for the Elementary Functions (1980), ch. 8, with pi/2 in three
    parts (float32: four); beyond them `_exactly`.
    """
    near, far = _nearby(x), abs(x) > _FAR[x.kind]
    if x.kind == "f64":
        distant = _exactly(x)
    else:
        wide = reduced(x.convert("f64"))
        rest = wide.rest.convert("f32")
        excess = (rest.convert("f64") - wide.rest).convert("f32")
        distant = Reduced(rest, excess, wide.quadrant.convert("i32"))
    return Reduced(*rarely(far, *zip(distant, near, strict=True)))


def _nearby(x: Expression) -> Reduced:
    shift = x.format.shift
    shifted = x * 0.6366197723675814 + shift
    turns = shifted - shift
    first, *parts = _HALF_PI[x.kind]
    rest = x - turns * first  # exact
    excess = None
    for part in parts:
        before, multiple = rest, turns * part
        rest = before - multiple
        lost = multiple - (before - rest)
        excess = lost if excess is None else excess + lost
    assert excess is not None
    return Reduced(rest, excess, shifted.bits())


def _exactly(x: Expression) -> Reduced:
    """x (float64) times the 192 bits of 2/pi that matter, in integers: the product modulo 4, to 2^-126.

    No float64 is nearer than 2^-61 to a multiple of pi/2 (relative to pi/2), so 64 bits are left of any.

    Source: M. Payne and R. Hanek, Radian reduction for trigonometric functions, SIGNUM Newsletter 18 (1983) 19-24.
    """
    bits = (abs(x)).bits()
    exponent = bits >> 52
    # |x| = significand 2^(exponent - 1075). Bits of 2/pi above 2^(1077 - exponent) give multiples of 4: skipped.
    significand = (bits & ((1 << 52) - 1)) | (1 << 52)
    skipped = exponent - (1075 - 62)
    words = [bits.constant(word) for word in _TWO_OVER_PI]
    for step in (16, 8, 4, 2, 1):
        on = (skipped & (64 * step)) > 0
        words = [
            select(on, words[i + step], word) if i + step < len(words) else word
            for i, word in enumerate(words[: 3 + step])
        ]
    left = skipped & 63
    window = [(words[i] << left) | (words[i + 1] >> (64 - left)) for i in range(3)]
    low, middle, high = (_halves(word) for word in reversed(window))
    fraction, below = _product(significand, [*low, *middle, *high])
    quadrant = (fraction >> 62) + ((fraction >> 61) & 1)
    fraction, below = (fraction << 2) | (below >> 62), below << 2
    tail = (below >> 1).convert("f64") * 2.0**-127
    rest = (fraction.convert("f64") * 2.0**-64 + tail) * 1.5707963267948966
    back = x.negative()
    rest = select(abs(x) < math.inf, select(back, -rest, rest), math.nan)
    return Reduced(rest, x.constant(0), select(back, -quadrant, quadrant))


def _halves(word: Expression) -> tuple[Expression, Expression]:
    return word & 0xFFFFFFFF, word >> 32


def _product(significand: Expression, limbs: list[Expression]) -> tuple[Expression, Expression]:
    """The two upper words of the product of 53 bits and 192 (limbs of 32, lowest first), modulo 2^192.

    The carry out of the two lowest limbs, at most 3 units of the last bit that is kept, is left out.
    """
    small, large = _halves(significand)
    by_small = [_halves(small * limb) for limb in limbs]
    by_large = [_halves(large * limb) for limb in limbs]
    columns, carry = [], None
    for k in range(2, 6):
        column = (by_small[k][0] + by_small[k - 1][1]) + (by_large[k - 1][0] + by_large[k - 2][1])
        column = column if carry is None else column + carry
        carry = column >> 32
        columns.append(column)
    below = (columns[0] & 0xFFFFFFFF) | (columns[1] << 32)
    return (columns[2] & 0xFFFFFFFF) | (columns[3] << 32), below
