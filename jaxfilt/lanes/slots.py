"""What is carried: two buffers in memory, of which each row reads one and writes the other."""

from __future__ import annotations

from collections.abc import Sequence

from jaxfilt.lanes import memory
from jaxfilt.lanes.program import Leaf, Program
from jaxfilt.lanes.writer import Writer, bytes_of, constant, memory_type


class Slots:
    """``still`` are the slots that only keep what they began with: no buffer has them, but ``kept``."""

    def __init__(self, w: Writer, program: Program, lanes: int) -> None:
        self.w, self.slots, self.lanes = w, program.slots, lanes
        graph = program.graph
        self.still = {
            i
            for i, slot in enumerate(program.slots)
            if graph.op[slot.after] == "input" and graph.value[slot.after] == ("carry", i)
        }
        self.kept: dict[int, str] = {}
        self._offset: dict[int, int] = {}
        at = 0
        for i, slot in sorted(enumerate(program.slots), key=lambda pair: -bytes_of(pair[1].kind)):
            if i not in self.still:
                self._offset[i] = at
                at += lanes * bytes_of(slot.kind)
        self._half = -(-at // 64) * 64

    def allocate(self) -> None:
        """The two buffers."""
        self._buffers = self.w.let(f"alloca [{max(2 * self._half, 64)} x i8], align 64")

    def buffer(self, row: str) -> str:
        """The one that a row reads, and the row before it writes."""
        w = self.w
        offset = w.let(f"mul i64 {w.let(f'and i64 {row}, 1')}, {self._half}")
        return w.let(f"getelementptr i8, ptr {self._buffers}, i64 {offset}")

    def load(self, number: int, buffer: str) -> str:
        """The value of a slot."""
        t, at, align = self._place(number, buffer)
        return memory.from_memory(
            self.w, self.w.let(f"load {t}, ptr {at}, align {align}"), self.slots[number].kind, self.lanes
        )

    def store(self, number: int, value: str, buffer: str) -> None:
        """A new value."""
        t, at, align = self._place(number, buffer)
        value = memory.to_memory(self.w, value, self.slots[number].kind, self.lanes)
        self.w.do(f"store {t} {value}, ptr {at}, align {align}")

    def begin(self, number: int, leaf: Leaf, address: str, pointers: Sequence[str]) -> None:
        """A leaf at the start, from its address or, of each run, their pointers, into the buffer of the first row."""
        w, size = self.w, len(leaf.slots)
        held = {slot.element: i for i, slot in enumerate(self.slots) if slot.leaf == number}
        values = {}
        if leaf.shared:
            values = {e: w.broadcast(memory.load(w, address, leaf.kind, e), leaf.kind, self.lanes) for e in held}
        else:
            for piece in memory.pieces(held, size, leaf.kind, self.lanes):
                values.update(zip(piece, memory.load_piece(w, pointers, leaf.kind, piece), strict=True))
        for element, slot in held.items():
            if slot in self.still:
                self.kept[slot] = values[element]
            else:
                self.store(slot, values[element], self._buffers)

    def end(self, leaf: Leaf, pointers: Sequence[str], buffer: str) -> None:
        """A leaf after the last row."""
        for piece in memory.pieces(range(len(leaf.slots)), len(leaf.slots), leaf.kind, self.lanes):
            values = [self._final(leaf, element, buffer) for element in piece]
            memory.store_piece(self.w, pointers, leaf.kind, piece, values)

    def _final(self, leaf: Leaf, element: int, buffer: str) -> str:
        slot = leaf.slots[element]
        if slot < 0:
            return constant(leaf.constants[element], leaf.kind, self.lanes)
        return self.kept[slot] if slot in self.still else self.load(slot, buffer)

    def _place(self, number: int, buffer: str) -> tuple[str, str, int]:
        """The type, address and alignment of a slot."""
        kind = self.slots[number].kind
        at = self.w.let(f"getelementptr i8, ptr {buffer}, i64 {self._offset[number]}")
        return memory_type(kind, self.lanes), at, min(64, self.lanes * bytes_of(kind))
