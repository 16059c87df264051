"""The error function, its complement and its inverse, as nodes."""

from __future__ import annotations

import math

from jaxfilt.lanes.exponentials import exponential, log_beside_one
from jaxfilt.lanes.expression import Expression, function, polynomial, rarely, select

_ERF = (
    (1.1283791670955126, -0.3761263890318375, 0.11283791670954857, -0.026866170645072896)
    + (0.0052239776247808714, -0.0008548326978742404, 0.000120553310369046, -1.4925593506969964e-05)
    + (1.646097281781807e-06, -1.6350025226962183e-07, 1.4657879848281481e-08, -1.136566590854267e-09)
    + (5.94526154256345e-11,)
)
"""``erf x = x P(x^2)``, |x| <= 1: minimax, relative error 2^-62."""

_ERFC = (
    1.2530080582697296,
    -0.1356211061245813,
    -0.04756229435345,
    0.1296451587027803,
    -0.11927366341536078,
    0.06830802734319136,
    -0.023770514917137005,
    0.0025293918305547562,
    0.001888690335383939,
    -0.0007798324189318309,
    -0.0001051595720649693,
    0.00012510024622649376,
    4.948105286832146e-06,
    -2.0103964443648926e-05,
    -7.26124896510119e-07,
    3.480472979657043e-06,
    3.433071434097236e-07,
    -6.280490358239149e-07,
    -1.2032763240820972e-07,
    1.1015954159215822e-07,
    2.240214691040845e-08,
    -1.4806362941704437e-08,
)
"""``(1 + 2 x) e^(x^2) erfc x = P((x - K) / (x + K))``, x >= 1/2: minimax, relative error 2^-57."""

_CENTRE = 3.0
"""The K of `_ERFC`."""

_ERF_INV = {
    "f64": (
        (
            1.6536545626831027,
            0.24015818242558962,
            -0.006033670871430149,
            -0.000740702534166267,
            0.00018673420803405714,
            -1.3882523362786469e-05,
            -1.3654692000834679e-06,
            4.2347877827932404e-07,
            -2.9070369957882005e-08,
            -4.112633980346984e-09,
            1.0512122733215323e-09,
            -5.415412054294628e-11,
            -1.2975133253453532e-11,
            2.6335093153082323e-12,
            -8.151934197605472e-14,
            -4.054566272975207e-14,
            6.637638134358324e-15,
            2.0972767875968562e-17,
            -1.333171662854621e-16,
            1.1157877678025181e-17,
            1.28584807152564e-18,
            -1.6850591381820166e-19,
            -3.64441206401782e-21,
        ),
        (
            3.0838856104922208,
            1.0052589676941592,
            0.005370914553590064,
            -0.003751208507569241,
            0.002491442096107851,
            -0.0016882755560235047,
            0.0009532893797373805,
            -0.0003550375203628475,
            2.4031110387097894e-05,
            6.828485145957318e-05,
            -4.7318229009055734e-05,
            1.2475304481671779e-05,
            2.9234449089955446e-06,
            -4.013867526981546e-06,
            1.5027403968909828e-06,
            1.8239629214389228e-08,
            -2.7517406297064545e-07,
            9.075656193888539e-08,
            2.2137376921775787e-09,
        ),
        (
            4.849906401408584,
            1.0103004648645344,
            -0.00013871931833623122,
            -0.00021503011930044477,
            7.599527703001776e-05,
            -1.968177810553167e-05,
            4.526062597223154e-06,
            -9.9298272942317e-07,
            2.2900482228026655e-07,
            -6.771199775845234e-08,
            2.914795345090108e-08,
            -1.496002662714924e-08,
            7.61570120807834e-09,
            -3.789465440126737e-09,
            1.5076572693500548e-09,
            -2.555641816996525e-10,
            -2.7109920616438573e-11,
        ),
    ),
    "f32": (
        (
            1.50140941,
            0.246640727,
            -0.00417768164,
            -0.00125372503,
            0.00021858087,
            -4.39150654e-06,
            -3.5233877e-06,
            3.43273939e-07,
            2.81022636e-08,
        ),
        (
            2.83297682,
            1.00167406,
            0.00943887047,
            -0.0076224613,
            0.00573950773,
            -0.00367342844,
            0.00134934322,
            0.000100950558,
            -0.000200214257,
        ),
    ),
}
"""``erf_inv x = x P(w)`` with w = -log(1 - x^2) less a centre, or its root less one where w is large."""

_REGIONS = {"f64": ((6.25, 3.125), (16.0, 3.25), (math.inf, 5.0)), "f32": ((5.0, 2.5), (math.inf, 3.0))}
"""Of each polynomial the least w that is beyond it, and the centre."""


@function
def erf(x: Expression) -> Expression:
    """2 / sqrt(pi) times the integral of e^(-t^2) from 0 to x."""
    wide = x.convert("f64")
    size = abs(wide)
    near = wide * polynomial(wide * wide, _ERF)
    far = (1 - _complement(size)).times_sign(wide.sign_bit())
    return select(size > 1, far, near).convert(x.kind)


@function
def erfc(x: Expression) -> Expression:
    """1 - erf x, without the loss of digits at large x."""
    wide = x.convert("f64")
    size = abs(wide)
    far = _complement(size)
    far = select(wide < 0, 2 - far, far)
    near = 1 - wide * polynomial(wide * wide, _ERF)
    return select(size > 0.5, far, near).convert(x.kind)


def _complement(x: Expression) -> Expression:
    """erfc of a float64 from 1/2; the square in the exponential as an exact one and what that leaves.

    Source: M. M. Shepherd and J. G. Laframboise, Chebyshev approximation of (1 + 2x) exp(x^2) erfc x in
    0 <= x < inf, Mathematics of Computation 36 (1981) 249-253 (the form, not the coefficients).
    """
    x = select(x > 28, 28, x)  # beyond, it is 0
    head = (x.bits() & -(1 << 27)).floating()
    fall = exponential(-(head * head), (head - x) * (head + x))
    return fall * polynomial((x - _CENTRE) / (x + _CENTRE), _ERFC) / (1 + 2 * x)


@function
def erf_inv(x: Expression) -> Expression:
    """The inverse of the error function, as XLA computes it, so that random normals are those of JAX.

    Source: M. Giles, Approximating the erfinv function, GPU Computing Gems, Jade Edition (2011), ch. 10.
    """
    w = -log_beside_one(-(x * x))
    regions = list(zip(_REGIONS[x.kind], _ERF_INV[x.kind], strict=True))
    root = w.sqrt()
    (beyond, centre), coefficients = regions[-1]
    result = polynomial(root - centre, coefficients)
    for number, ((beyond, centre), coefficients) in reversed(list(enumerate(regions[:-1]))):
        within = polynomial((w if number == 0 else root) - centre, coefficients)
        (result,) = rarely(~(w < beyond), (result, within))
    return x * select(abs(x).equals(1), math.inf, result)
