"""What the emitter is given: the scalar graph of one row of one run, and where its numbers come from and go to."""

from __future__ import annotations

from typing import NamedTuple

from jaxfilt.lanes.graph import Graph


class Source(NamedTuple):
    """An array that is read: ``size`` numbers, the same for all runs (``shared``) or of each, the same in all rows or
    of each (``moving``). Its memory is C-contiguous: ([runs,] [rows,] size). Its nodes are inputs ("source", number of
    the source, element)."""

    kind: str
    size: int
    shared: bool
    moving: bool


class Output(NamedTuple):
    """An array that is written: ``nodes`` of each row.

    Stored as (runs, rows // every, size): of each ``every``-th row (the last of each group) and, if ``few``, of the
    first runs only, whose number is told at the call. If ``summed``: as (rows, size), floats added up over the runs.
    """

    nodes: tuple[int, ...]
    kind: str
    every: int = 1
    few: bool = False
    summed: bool = False


class Slot(NamedTuple):
    """A number that a run carries from row to row: before a row it is the input ("carry", number of the slot), after it
    the node ``after``. It begins with an ``element`` of a ``leaf`` of the start."""

    kind: str
    leaf: int
    element: int
    after: int


class Leaf(NamedTuple):
    """An array of the carry. ``slots``: for each of its elements the number of the slot that holds it, or -1 for one
    that is always ``constants`` there. Memory at the start ([runs,] size), at the end (runs, size)."""

    kind: str
    shared: bool
    slots: tuple[int, ...]
    constants: tuple[float, ...]


class Program(NamedTuple):
    """A loop over rows for many runs. ``reverse``: from the last row to the first."""

    graph: Graph
    sources: tuple[Source, ...]
    leaves: tuple[Leaf, ...]
    slots: tuple[Slot, ...]
    outputs: tuple[Output, ...]
    reverse: bool = False
