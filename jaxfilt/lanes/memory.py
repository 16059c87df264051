"""Numbers between lanes and memory, where each run has its own array.

Consecutive elements of a run are moved in pieces of 16 bytes and turned from runs into lanes, or back, in registers:
with ``g`` elements a piece, blocks of g lanes are g x g matrices to be transposed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from jaxfilt.lanes.writer import Writer, bits_of, bytes_of, memory_type, type_of

_PIECE = 16


def pieces(elements: Iterable[int], size: int, kind: str, lanes: int) -> list[range]:
    """Ranges that cover ``elements`` of an array of ``size``, each of a length that can be moved at once."""
    wanted = set(elements)
    longest = 1 if kind == "b" else min(_PIECE // bytes_of(kind), lanes)
    found, at = [], 0
    while at < size:
        length = longest
        while length > 1 and (at + length > size or 2 * sum(e in wanted for e in range(at, at + length)) <= length):
            length //= 2
        if length > 1 or at in wanted:
            found.append(range(at, at + length))
        at += length
    return found


def load(w: Writer, pointer: str, kind: str, element: int) -> str:
    """One number that all runs share."""
    at = _element(w, pointer, kind, element)
    value = w.let(f"load {memory_type(kind, 1)}, ptr {at}, align {bytes_of(kind)}, !invariant.load !0")
    return from_memory(w, value, kind, 1)


def load_piece(w: Writer, pointers: Sequence[str], kind: str, piece: range) -> list[str]:
    """The elements of a piece, each as a vector over the lanes, whose arrays begin at ``pointers``."""
    lanes, g = len(pointers), len(piece)
    scalar = memory_type(kind, 1)
    part = scalar if g == 1 else memory_type(kind, g)
    loaded = [
        w.let(f"load {part}, ptr {_element(w, pointer, kind, piece.start)}, align {bytes_of(kind)}, !invariant.load !0")
        for pointer in pointers
    ]
    if g == 1:
        value, wide = "poison", memory_type(kind, lanes)
        for lane, number in enumerate(loaded):
            value = w.let(f"insertelement {wide} {value}, {scalar} {number}, i64 {lane}")
        return [from_memory(w, value, kind, lanes)]
    blocks = [_joined(w, loaded[i::g], kind, g) for i in range(g)]
    return _transposed(w, blocks, kind, lanes)


def store_piece(w: Writer, pointers: Sequence[str], kind: str, piece: range, values: Sequence[str]) -> None:
    """The elements of a piece from vectors over the lanes; of lanes with one pointer, the first has the last word."""
    lanes, g = len(pointers), len(piece)
    if g == 1:
        wide = to_memory(w, values[0], kind, lanes)
        vector, part = memory_type(kind, lanes), memory_type(kind, 1)
        parts = [w.let(f"extractelement {vector} {wide}, i64 {lane}") for lane in range(lanes)]
    else:
        blocks, part = _transposed(w, list(values), kind, lanes), memory_type(kind, g)
        parts = [
            blocks[lane % g]
            if g == lanes
            else w.shuffle(blocks[lane % g], "poison", kind, lanes, list(range(lane - lane % g, lane - lane % g + g)))
            for lane in range(lanes)
        ]
    for pointer, value in zip(reversed(pointers), reversed(parts), strict=True):
        w.do(f"store {part} {value}, ptr {_element(w, pointer, kind, piece.start)}, align {bytes_of(kind)}")


def add_piece(w: Writer, pointer: str, kind: str, piece: range, values: Sequence[str], lanes: int) -> None:
    """Adds to the elements of a piece their sums over the lanes."""
    g = len(piece)
    sums, spread = list(values), 1
    while len(sums) > 1:  # two vectors become one, in which they alternate
        low = [p if p % (2 * spread) < spread else lanes + p - spread for p in range(lanes)]
        high = [p + spread if p % (2 * spread) < spread else lanes + p for p in range(lanes)]
        sums = [
            _sum(w, w.shuffle(a, b, kind, lanes, low), w.shuffle(a, b, kind, lanes, high), kind, lanes)
            for a, b in zip(sums[::2], sums[1::2], strict=True)
        ]
        spread *= 2
    total, width = sums[0], lanes
    while width > g:
        width //= 2
        low = w.shuffle(total, "poison", kind, 2 * width, list(range(width)))
        high = w.shuffle(total, "poison", kind, 2 * width, list(range(width, 2 * width)))
        total = w.let(f"fadd {_vector(kind, width)} {low}, {high}")
    vector = _vector(kind, g)
    at = _element(w, pointer, kind, piece.start)
    before = w.let(f"load {vector}, ptr {at}, align {bytes_of(kind)}")
    after = w.let(f"fadd {vector} {before}, {total}")
    w.do(f"store {vector} {after}, ptr {at}, align {bytes_of(kind)}")


def from_memory(w: Writer, value: str, kind: str, lanes: int) -> str:
    """A flag of a byte."""
    return w.let(f"icmp ne {memory_type(kind, lanes)} {value}, {_zero(lanes)}") if kind == "b" else value


def to_memory(w: Writer, value: str, kind: str, lanes: int) -> str:
    """A byte of a flag."""
    return w.let(f"zext {type_of(kind, lanes)} {value} to {memory_type(kind, lanes)}") if kind == "b" else value


def masked(w: Writer, mask: str, value: str, kind: str, lanes: int) -> str:
    """Zero in the lanes where not all bits of an integer ``mask`` are set."""
    t, bits = type_of(kind, lanes), type_of(f"u{bits_of(kind)}", lanes)
    kept = w.let(f"and {bits} {w.let(f'bitcast {t} {value} to {bits}')}, {mask}")
    return w.let(f"bitcast {bits} {kept} to {t}")


def _zero(lanes: int) -> str:
    return "0" if lanes == 1 else "splat (i8 0)"


def _vector(kind: str, width: int) -> str:
    return f"<{width} x {type_of(kind, 1)}>"


def _sum(w: Writer, a: str, b: str, kind: str, lanes: int) -> str:
    return w.let(f"fadd {_vector(kind, lanes)} {a}, {b}")


def _element(w: Writer, pointer: str, kind: str, element: int) -> str:
    return w.let(f"getelementptr i8, ptr {pointer}, i64 {element * bytes_of(kind)}") if element else pointer


def _joined(w: Writer, parts: list[str], kind: str, width: int) -> str:
    """Vectors one after the other."""
    while len(parts) > 1:
        both = list(range(2 * width))
        parts = [w.shuffle(a, b, kind, width, both) for a, b in zip(parts[::2], parts[1::2], strict=True)]
        width *= 2
    return parts[0]


def _transposed(w: Writer, rows: list[str], kind: str, lanes: int) -> list[str]:
    """g vectors, each g x g block of them transposed: blocks off the diagonal change places, of 1, 2, 4... a side."""
    side = 1
    while side < len(rows):
        low = [p if p % (2 * side) < side else lanes + p - side for p in range(lanes)]
        high = [p + side if p % (2 * side) < side else lanes + p for p in range(lanes)]
        for i in range(len(rows)):
            if not i & side:
                a, b = rows[i], rows[i + side]
                rows[i], rows[i + side] = (w.shuffle(a, b, kind, lanes, pick) for pick in (low, high))
        side *= 2
    return rows
