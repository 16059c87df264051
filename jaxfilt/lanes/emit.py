"""A program as one LLVM function: blocks of runs, a run a lane, and in each block the rows.

A node that all runs share is a scalar, any other a vector of lanes; what does not change from row to row is computed
before the rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from jaxfilt.lanes import memory
from jaxfilt.lanes.program import Leaf, Output, Program, Source
from jaxfilt.lanes.reach import Reach
from jaxfilt.lanes.schedule import ALWAYS, schedule
from jaxfilt.lanes.slots import Slots
from jaxfilt.lanes.values import Values
from jaxfilt.lanes.writer import Writer, bits_of, bytes_of, type_of


def ir(program: Program, lanes: int, name: str) -> str:
    """The text of ``void name(i64 first, i64 end, i64 runs, i64 steps, i64 few, ptr table)``.

    It computes the blocks ``first`` to ``end`` of ``lanes`` runs each. The lanes of the last block beyond the runs
    repeat the last one. ``table`` has the addresses of the sources, of the leaves at the start and at the end, and of
    the outputs; sums are added to what is there.
    """
    return _Emitter(program, lanes).text(name)


class _Emitter:
    """``sources``: for each, the pointers to what the lanes read now. ``stored``: to where they write their rows."""

    def __init__(self, program: Program, lanes: int) -> None:
        self.program, self.graph, self.lanes = program, program.graph, lanes
        self.w = Writer()
        self.reach = Reach(program)
        self.schedule = schedule(program, self.reach)
        self.slots = Slots(self.w, program, lanes)
        self.values = Values(self.w, self.graph, self.reach, lanes, self._wanted(), self._read)
        self.sources: list[Sequence[str]] = []
        self.stored: list[Sequence[str]] = []
        self.now = ""

    def text(self, name: str) -> str:
        self._entry()
        self._block()
        self._row()
        self._leave()
        parameters = "i64 %first, i64 %end, i64 %runs, i64 %steps, i64 %few, ptr noalias %table"
        width = max((self.lanes * bits_of(self.graph.kind[node]) for node in self.reach.live), default=0)
        attributes = f'nounwind "prefer-vector-width"="{min(512, max(128, width))}"'
        body = "\n".join(self.w.lines)
        declarations = "\n".join(self.w.declarations[name] for name in sorted(self.w.declarations))
        return f"define void @{name}({parameters}) {attributes} {{\nentry:\n{body}\n}}\n{declarations}\n!0 = !{{}}\n"

    def _wanted(self) -> set[int]:
        """The nodes that are wanted in all lanes though all runs share them."""
        wanted = {node for output in self.program.outputs for node in output.nodes}
        wanted |= {slot.after for slot in self.program.slots}
        wanted |= {a for node in self.reach.live if not self.reach.shared(node) for a in self.graph.args[node]}
        return {node for node in wanted if self.reach.shared(node)}

    # The frame.

    def _entry(self) -> None:
        w, p = self.w, self.program
        addresses = []
        for i in range(len(p.sources) + 2 * len(p.leaves) + len(p.outputs)):
            at = w.let(f"getelementptr ptr, ptr %table, i64 {i}")
            addresses.append(w.let(f"load ptr, ptr {at}, align 8"))
        taken = iter(addresses)
        self.given, self.start, self.final, self.out = (
            [next(taken) for _ in arrays] for arrays in (p.sources, p.leaves, p.leaves, p.outputs)
        )
        self.slots.allocate()
        self.last = w.let("sub i64 %runs, 1")
        self.sources = [[address] * self.lanes for address in self.given]
        self.values.items(self.schedule.once)
        before = w.label
        w.do("br label %blocks")
        w.begin("blocks")
        w.do(f"%block = phi i64 [ %first, %{before} ], [ %block.next, %rows.end ]")
        w.do("%block.more = icmp slt i64 %block, %end")
        w.do("br i1 %block.more, label %block.begin, label %blocks.end")

    def _block(self) -> None:
        w, p = self.w, self.program
        w.begin("block.begin")
        self.base = w.let(f"mul i64 %block, {self.lanes}")
        self.runs = [self._least(w.let(f"add i64 {self.base}, {lane}"), self.last) for lane in range(self.lanes)]
        self.masks = self._masks()
        self.sources = [
            [address] * self.lanes
            if source.shared
            else self._of_runs(address, self.runs, _row_bytes(source), "%steps" if source.moving else "1")
            for source, address in zip(p.sources, self.given, strict=True)
        ]
        self.stored = [self._rows(output, address) for output, address in zip(p.outputs, self.out, strict=True)]
        for number, (leaf, address) in enumerate(zip(p.leaves, self.start, strict=True)):
            self.slots.begin(number, leaf, address, self._of_leaf(leaf, address))
        for number, value in self.slots.kept.items():
            self.values.define(p.slots[number].after, value)
        self.values.items(self.schedule.block)
        before = w.label
        w.do("br label %rows")
        w.begin("rows")
        w.do(f"%row = phi i64 [ 0, %{before} ], [ %row.next, %row.end ]")
        w.do("%row.more = icmp slt i64 %row, %steps")
        w.do("br i1 %row.more, label %row.begin, label %rows.end")

    def _row(self) -> None:
        w, p = self.w, self.program
        w.begin("row.begin")
        self.time = w.let(f"sub i64 {w.let('sub i64 %steps, 1')}, %row") if p.reverse else "%row"
        self.now, after = self.slots.buffer("%row"), self.slots.buffer(w.let("add i64 %row, 1"))
        self.sources = [
            self._at(pointers, self.time, _row_bytes(source)) if source.moving else pointers
            for source, pointers in zip(p.sources, self.sources, strict=True)
        ]
        for number, slot in enumerate(p.slots):
            if number not in self.slots.still:
                self.values.when([slot.after], self._carried(number, after))
        for number in self._stored_if(ALWAYS):
            for nodes, store in self._stores(number, self.time):
                self.values.when(nodes, store)
        self.values.items(self.schedule.row)
        for condition, items in self.schedule.stored.items():
            self.values.guarded(self._holds(*condition), items, (), lambda condition=condition: self._store(condition))
        w.do("br label %row.end")
        w.begin("row.end")
        w.do("%row.next = add i64 %row, 1")
        w.do("br label %rows")

    def _leave(self) -> None:
        w, p = self.w, self.program
        w.begin("rows.end")
        last = self.slots.buffer("%steps")
        for leaf, address in zip(p.leaves, self.final, strict=True):
            self.slots.end(leaf, self._of_leaf(leaf, address), last)
        w.do("%block.next = add i64 %block, 1")
        w.do("br label %blocks")
        w.begin("blocks.end")
        w.do("ret void")

    # Addresses.

    def _of_runs(self, address: str, runs: Sequence[str], size: int, rows: str) -> list[str]:
        """The address of each lane's run, of so many rows of a size in bytes."""
        w = self.w
        step = w.let(f"mul i64 {rows}, {size}")
        return [w.let(f"getelementptr i8, ptr {address}, i64 {w.let(f'mul i64 {run}, {step}')}") for run in runs]

    def _of_leaf(self, leaf: Leaf, address: str) -> list[str]:
        return self._of_runs(address, self.runs, len(leaf.slots) * bytes_of(leaf.kind), "1")

    def _at(self, pointers: Sequence[str], row: str, size: int) -> list[str]:
        """The address of a row of each lane."""
        offset = self.w.let(f"mul i64 {row}, {size}")
        moved = {p: self.w.let(f"getelementptr i8, ptr {p}, i64 {offset}") for p in dict.fromkeys(pointers)}
        return [moved[p] for p in pointers]

    def _rows(self, output: Output, address: str) -> list[str]:
        """Where the rows of an output are, of each lane."""
        if output.summed:
            return [address] * self.lanes
        runs = self.runs
        if output.few:  # lanes beyond the few write to the last of them, before it does itself
            last = self.w.let("sub i64 %few, 1")
            runs = [self._least(run, last) for run in runs]
        rows = self.w.let(f"udiv i64 %steps, {output.every}") if output.every > 1 else "%steps"
        return self._of_runs(address, runs, len(output.nodes) * bytes_of(output.kind), rows)

    def _least(self, a: str, b: str) -> str:
        return self.w.call("llvm.smin.i64", "i64", ("i64", a), ("i64", b))

    # What is read.

    def _read(self, node: int) -> None:
        where, number = self.graph.value[node][:2]
        if where == "carry":
            if number not in self.slots.still:
                self.values.define(node, self.slots.load(number, self.now))
            return
        source, element = self.program.sources[number], self.graph.value[node][2]
        if source.shared:
            self.values.define(node, memory.load(self.w, self.sources[number][0], source.kind, element))
        elif node not in self.values:
            wanted = self.reach.elements(number)
            piece = next(p for p in memory.pieces(wanted, source.size, source.kind, self.lanes) if element in p)
            loaded = memory.load_piece(self.w, self.sources[number], source.kind, piece)
            for e, value in zip(piece, loaded, strict=True):
                if e in wanted:
                    self.values.define(wanted[e], value)

    # What is stored.

    def _carried(self, number: int, buffer: str) -> Callable[[], None]:
        return lambda: self.slots.store(number, self.values.wide(self.program.slots[number].after), buffer)

    def _stored_if(self, condition: tuple[int, bool]) -> list[int]:
        return [k for k, o in enumerate(self.program.outputs) if (o.every, o.few) == condition]

    def _store(self, condition: tuple[int, bool]) -> None:
        every = condition[0]
        row = self.w.let(f"udiv i64 {self.time}, {every}") if every > 1 else self.time
        for number in self._stored_if(condition):
            for _, store in self._stores(number, row):
                store()

    def _stores(self, number: int, row: str) -> list[tuple[list[int], Callable[[], None]]]:
        """The pieces of a row of an output: their nodes, and what stores them."""
        output = self.program.outputs[number]
        size = len(output.nodes)
        pointers = self._at(self.stored[number], row, size * bytes_of(output.kind))

        def store(piece: range) -> None:
            values = [self.values.wide(output.nodes[e]) for e in piece]
            if output.summed:
                values = [memory.masked(self.w, self.masks[output.kind], v, output.kind, self.lanes) for v in values]
                memory.add_piece(self.w, pointers[0], output.kind, piece, values, self.lanes)
            else:
                memory.store_piece(self.w, pointers, output.kind, piece, values)

        return [
            ([output.nodes[e] for e in piece], lambda piece=piece: store(piece))
            for piece in memory.pieces(range(size), size, output.kind, self.lanes)
        ]

    def _holds(self, every: int, few: bool) -> str:
        """Whether this row, of these runs, is stored by outputs that not all are stored by."""
        w, tests = self.w, []
        if every > 1:
            rest = w.let(f"urem i64 {w.let(f'add i64 {self.time}, 1')}, {every}")
            tests.append(w.let(f"icmp eq i64 {rest}, 0"))
        if few:
            tests.append(w.let(f"icmp slt i64 {self.base}, %few"))
        return tests[0] if len(tests) == 1 else w.let(f"and i1 {tests[0]}, {tests[1]}")

    def _masks(self) -> dict[str, str]:
        """For each kind that is summed, the bits of the lanes that are runs of their own."""
        w = self.w
        kinds = sorted({output.kind for output in self.program.outputs if output.summed})
        if not kinds:
            return {}
        flags, t = type_of("b", self.lanes), type_of("i64", self.lanes)
        count = ", ".join(f"i64 {lane}" for lane in range(self.lanes))
        run = w.let(f"add {t} {w.broadcast(self.base, 'i64', self.lanes)}, <{count}>")
        own = w.let(f"icmp slt {t} {run}, {w.broadcast('%runs', 'i64', self.lanes)}")
        return {kind: w.let(f"sext {flags} {own} to {type_of(f'u{bits_of(kind)}', self.lanes)}") for kind in kinds}


def _row_bytes(source: Source) -> int:
    return source.size * bytes_of(source.kind)
