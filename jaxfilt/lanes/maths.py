"""Elementary functions as nodes: ``function(graph, node, ...)`` gives the node of the result, of the arguments' kind.

They are made of operations that every vector unit has, so that they run at its width on any machine; what only unusual
arguments need (far from 0, subnormal, infinite, not a number) is in a ``branch`` that is skipped when no run has one.
"""

from jaxfilt.lanes.exponentials import (
    acosh,
    asinh,
    atanh,
    cosh,
    exp,
    exp2,
    expm1,
    log,
    log1p,
    logistic,
    sinh,
    tanh,
)
from jaxfilt.lanes.gaussian import erf, erf_inv, erfc
from jaxfilt.lanes.powers import cbrt, pow, rsqrt
from jaxfilt.lanes.trigonometry import acos, asin, atan, atan2, cos, sin, tan

__all__ = [
    "acos",
    "acosh",
    "asin",
    "asinh",
    "atan",
    "atan2",
    "atanh",
    "cbrt",
    "cos",
    "cosh",
    "erf",
    "erf_inv",
    "erfc",
    "exp",
    "exp2",
    "expm1",
    "log",
    "log1p",
    "logistic",
    "pow",
    "rsqrt",
    "sin",
    "sinh",
    "tan",
    "tanh",
]
