"""The text of one LLVM function as it is written: lines, fresh names, types and constants."""

from __future__ import annotations

import numpy as np

from jaxfilt.lanes.graph import KINDS

_TYPES = {"b": "i1", "i32": "i32", "i64": "i64", "u32": "i32", "u64": "i64", "f32": "float", "f64": "double"}


def bytes_of(kind: str) -> int:
    """The size of a number in memory; a flag is a byte there."""
    return KINDS[kind].itemsize


def bits_of(kind: str) -> int:
    """The width of a number in a register; a flag is a bit there."""
    return 1 if kind == "b" else 8 * KINDS[kind].itemsize


def type_of(kind: str, lanes: int) -> str:
    """A number of each lane; of one lane a scalar, which is how a number that all runs share is kept."""
    return _TYPES[kind] if lanes == 1 else f"<{lanes} x {_TYPES[kind]}>"


def memory_type(kind: str, lanes: int) -> str:
    """The same in memory."""
    return type_of(kind, lanes).replace("i1", "i8") if kind == "b" else type_of(kind, lanes)


def constant(value: object, kind: str, lanes: int) -> str:
    """A number known now, in each lane."""
    number = np.asarray(value).astype(KINDS[kind])
    if kind[0] == "f":  # LLVM writes a float as the double it is
        text = f"0x{int(number.astype(np.float64).view(np.uint64)):016X}"
    else:
        text = str(bool(number)).lower() if kind == "b" else str(int(number))
    return text if lanes == 1 else f"splat ({_TYPES[kind]} {text})"


class Writer:
    """The lines of a function. ``label`` is the name of the basic block that is being written."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.declarations: dict[str, str] = {}
        self.label = "entry"
        self._count = 0

    def let(self, instruction: str) -> str:
        """A new value."""
        self._count += 1
        name = f"%v{self._count}"
        self.lines.append(f"  {name} = {instruction}")
        return name

    def do(self, instruction: str) -> None:
        """An instruction without a value."""
        self.lines.append(f"  {instruction}")

    def barrier(self) -> None:
        """A label in the machine code, of no size, over which instructions are not moved."""
        self.declarations["llvm.codeview.annotation"] = "declare void @llvm.codeview.annotation(metadata)"
        self.do("call void @llvm.codeview.annotation(metadata !0)")

    def fresh(self, name: str) -> str:
        """A new label."""
        self._count += 1
        return f"{name}{self._count}"

    def begin(self, label: str) -> None:
        """The next basic block; the last one has been left by a branch."""
        self.lines.append(f"{label}:")
        self.label = label

    def call(self, function: str, result: str, *args: tuple[str, str]) -> str:
        """The value of a function of (type, value) pairs, which is declared on the way."""
        self.declarations[function] = f"declare {result} @{function}({', '.join(t for t, _ in args)})"
        return self.let(f"call {result} @{function}({', '.join(f'{t} {v}' for t, v in args)})")

    def broadcast(self, value: str, kind: str, lanes: int) -> str:
        """A scalar in every lane."""
        wide = type_of(kind, lanes)
        first = self.let(f"insertelement {wide} poison, {type_of(kind, 1)} {value}, i64 0")
        return self.let(f"shufflevector {wide} {first}, {wide} poison, <{lanes} x i32> zeroinitializer")

    def shuffle(self, a: str, b: str, kind: str, width: int, picks: list[int]) -> str:
        """Elements of two vectors of ``width`` in memory's type, by their number in both."""
        vector = memory_type(kind, width) if width > 1 else f"<1 x {memory_type(kind, 1)}>"
        mask = ", ".join(f"i32 {pick}" for pick in picks)
        return self.let(f"shufflevector {vector} {a}, {vector} {b}, <{len(picks)} x i32> <{mask}>")
