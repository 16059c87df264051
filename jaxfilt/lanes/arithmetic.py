"""One node's operation as LLVM instructions, on a scalar or on a vector of lanes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxfilt.lanes.graph import COMPARISONS, KINDS
from jaxfilt.lanes.writer import Writer, bits_of, constant, type_of

_FLOAT = {"add": "fadd contract", "sub": "fsub contract", "mul": "fmul contract", "div": "fdiv", "rem": "frem"}
_WHOLE = {"add": "add", "sub": "sub", "mul": "mul", "and": "and", "or": "or", "xor": "xor"}
_FLAGS = {"add": "or", "mul": "and", "max": "or", "min": "and", "and": "and", "or": "or", "xor": "xor"}
_ROUNDED = {"sqrt": "sqrt", "floor": "floor", "ceil": "ceil", "round": "roundeven", "abs": "fabs"}


def operation(
    w: Writer, op: str, kind: str, of: str, args: Sequence[str], known: Sequence[np.generic | None], lanes: int
) -> str:
    """The value of a node.

    Args:
        w: where it is written.
        op: as in `jaxfilt.lanes.graph`.
        kind: of the node.
        of: the kind of its (first) argument.
        args: their values.
        known: the numbers of those that are constants.
        lanes: of the node and its arguments.
    """
    if op in ("select", "branch"):
        return _select(w, args[0], args[1], args[2], kind, lanes)
    if op == "convert":
        return _converted(w, args[0], of, kind, lanes)
    if op == "bitcast":
        return w.let(f"bitcast {type_of(of, lanes)} {args[0]} to {type_of(kind, lanes)}")
    if op in COMPARISONS:
        return _compared(w, op, args[0], args[1], of, lanes)
    rules = {"f": _float, "b": _flag, "i": _whole, "u": _whole}
    return rules[kind[0]](w, op, kind, args, known, lanes)


def _float(w: Writer, op: str, kind: str, args: Sequence[str], known: Sequence, lanes: int) -> str:
    t = type_of(kind, lanes)
    if op in _FLOAT:
        return w.let(f"{_FLOAT[op]} {t} {args[0]}, {args[1]}")
    if op == "neg":
        return w.let(f"fneg {t} {args[0]}")
    if op in _ROUNDED:
        return w.call(f"llvm.{_ROUNDED[op]}.{_suffix(kind, lanes)}", t, (t, args[0]))
    if op in ("max", "min"):
        return _extreme(w, op, kind, args, known, lanes)
    raise ValueError(f"{op} of {kind} is not an operation")


def _extreme(w: Writer, op: str, kind: str, args: Sequence[str], known: Sequence, lanes: int) -> str:
    """The larger or smaller, NaN if either is; 0 is larger than -0.

    With a constant, a comparison will do: it is false with NaN, and a zero's sign says which of two zeros it picks.
    """
    a, b = args
    t = type_of(kind, lanes)
    if known[0] is None:
        a, b, known = b, a, known[::-1]
    if known[0] is None or np.isnan(known[0]):
        return w.call(f"llvm.{op}imum.{_suffix(kind, lanes)}", t, (t, a), (t, b))
    ties = known[0] == 0 and np.signbit(known[0]) == (op == "min")
    first = w.let(f"fcmp {'og' if op == 'max' else 'ol'}{'e' if ties else 't'} {t} {a}, {b}")
    return _select(w, first, a, b, kind, lanes)


def _flag(w: Writer, op: str, kind: str, args: Sequence[str], known: Sequence, lanes: int) -> str:
    t = type_of(kind, lanes)
    if op == "not":
        return w.let(f"xor {t} {args[0]}, {constant(True, kind, lanes)}")
    if op not in _FLAGS:
        raise ValueError(f"{op} of {kind} is not an operation")
    return w.let(f"{_FLAGS[op]} {t} {args[0]}, {args[1]}")


def _whole(w: Writer, op: str, kind: str, args: Sequence[str], known: Sequence, lanes: int) -> str:
    t = type_of(kind, lanes)
    sign = "s" if kind[0] == "i" else "u"
    if op in _WHOLE:
        return w.let(f"{_WHOLE[op]} {t} {args[0]}, {args[1]}")
    if op in ("div", "rem"):
        return _divided(w, op, kind, args, known, lanes)
    if op in ("shl", "shr", "sar"):
        return _shifted(w, op, kind, args, known, lanes)
    if op in ("max", "min"):
        return w.call(f"llvm.{sign}{op}.{_suffix(kind, lanes)}", t, (t, args[0]), (t, args[1]))
    if op == "neg":
        return w.let(f"sub {t} {constant(0, kind, lanes)}, {args[0]}")
    if op == "not":
        return w.let(f"xor {t} {args[0]}, {constant(_all_bits(kind), kind, lanes)}")
    if op == "abs":
        return w.call(f"llvm.abs.{_suffix(kind, lanes)}", t, (t, args[0]), ("i1", "false")) if sign == "s" else args[0]
    if op in ("floor", "ceil", "round"):
        return args[0]
    raise ValueError(f"{op} of {kind} is not an operation")


def _divided(w: Writer, op: str, kind: str, args: Sequence[str], known: Sequence, lanes: int) -> str:
    """Quotient or remainder towards zero: by zero -1 and the dividend, the least by -1 itself and 0, and no traps."""
    a, b = args
    t, signed = type_of(kind, lanes), kind[0] == "i"
    instruction = f"{'s' if signed else 'u'}{op}"
    if known[1] is not None and known[1] not in (0, -1):
        return w.let(f"{instruction} {t} {a}, {b}")
    nought, one = constant(0, kind, lanes), constant(1, kind, lanes)
    zero = w.let(f"icmp eq {t} {b}, {nought}")
    safe = _select(w, zero, one, b, kind, lanes)
    if signed:
        least = w.let(f"icmp eq {t} {a}, {constant(np.iinfo(KINDS[kind]).min, kind, lanes)}")
        minus = w.let(f"icmp eq {t} {b}, {constant(-1, kind, lanes)}")
        safe = _select(w, w.let(f"and {type_of('b', lanes)} {least}, {minus}"), one, safe, kind, lanes)
    result = w.let(f"{instruction} {t} {a}, {safe}")
    by_zero = a if op == "rem" else constant(_all_bits(kind), kind, lanes)
    return _select(w, zero, by_zero, result, kind, lanes)


def _shifted(w: Writer, op: str, kind: str, args: Sequence[str], known: Sequence, lanes: int) -> str:
    """A shift, by an amount that is read as unsigned; past the width nothing is left but the sign of ``sar``."""
    a, b = args
    t, bits = type_of(kind, lanes), bits_of(kind)
    instruction = {"shl": "shl", "shr": "lshr", "sar": "ashr"}[op]
    if known[1] is not None and 0 <= known[1] < bits:
        return w.let(f"{instruction} {t} {a}, {b}")
    if op == "sar":
        b = w.call(f"llvm.umin.{_suffix(kind, lanes)}", t, (t, b), (t, constant(bits - 1, kind, lanes)))
        return w.let(f"{instruction} {t} {a}, {b}")
    within = w.let(f"icmp ult {t} {b}, {constant(bits, kind, lanes)}")
    return _select(w, within, w.let(f"{instruction} {t} {a}, {b}"), constant(0, kind, lanes), kind, lanes)


def _compared(w: Writer, op: str, a: str, b: str, of: str, lanes: int) -> str:
    t = type_of(of, lanes)
    if of[0] == "f":  # with NaN nothing holds but that they differ
        return w.let(f"fcmp {'une' if op == 'ne' else 'o' + op} {t} {a}, {b}")
    sign = "" if op in ("eq", "ne") else "s" if of[0] == "i" else "u"
    return w.let(f"icmp {sign}{op} {t} {a}, {b}")


def _converted(w: Writer, a: str, of: str, kind: str, lanes: int) -> str:
    old, new = type_of(of, lanes), type_of(kind, lanes)
    if kind == "b":
        return _compared(w, "ne", a, constant(0, of, lanes), of, lanes)
    if of == "b":
        return _select(w, a, constant(1, kind, lanes), constant(0, kind, lanes), kind, lanes)
    if of[0] == "f" and kind[0] != "f":  # beyond the range to its end, NaN to 0
        name = f"llvm.fpto{'s' if kind[0] == 'i' else 'u'}i.sat.{_suffix(kind, lanes)}.{_suffix(of, lanes)}"
        return w.call(name, new, (old, a))
    if of[0] == "f":
        return w.let(f"{'fpext' if kind == 'f64' else 'fptrunc'} {old} {a} to {new}")
    if kind[0] == "f":
        return w.let(f"{'s' if of[0] == 'i' else 'u'}itofp {old} {a} to {new}")
    if bits_of(of) == bits_of(kind):
        return a
    step = "trunc" if bits_of(of) > bits_of(kind) else "sext" if of[0] == "i" else "zext"
    return w.let(f"{step} {old} {a} to {new}")


def _select(w: Writer, predicate: str, true: str, false: str, kind: str, lanes: int) -> str:
    t = type_of(kind, lanes)
    return w.let(f"select {type_of('b', lanes)} {predicate}, {t} {true}, {t} {false}")


def _suffix(kind: str, lanes: int) -> str:
    scalar = f"{'f' if kind[0] == 'f' else 'i'}{bits_of(kind)}"
    return scalar if lanes == 1 else f"v{lanes}{scalar}"


def _all_bits(kind: str) -> int:
    return -1 if kind[0] == "i" else np.iinfo(KINDS[kind]).max
