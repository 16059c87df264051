"""What a recorded set is, where its files lie, and the few helpers that every reader needs."""

from __future__ import annotations

import gzip
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfilt.types import PyTree, Stream

VARIABLE = "JAXFILT_DATA"
"""Environment variable with the folder in which the recorded sets lie, one folder each."""

Timed = tuple[np.ndarray, PyTree]
"""Stamps (K,), s, strictly increasing, and values with leading axis K."""


class Contents(NamedTuple):
    """What a reader finds in the files of one sequence; the fields as in `Dataset`."""

    streams: dict[str, Stream]
    inputs: dict[str, Timed]
    truth: dict[str, Timed]
    constants: dict[str, Any]


class Dataset(NamedTuple):
    """One sequence of a recorded set, in SI units and float64.

    ``streams`` sensor -> `Stream`; ``inputs`` name -> (t, values), with strictly increasing stamps; ``truth``
    quantity -> (t, values), likewise, empty where nobody knows it; ``constants`` name -> what does not change: the
    map, lever arms, noise figures. ``about`` says what each of them is, with units and frames; ``licence`` and
    ``citation`` are those of the set's authors.
    """

    name: str
    sequence: str
    streams: dict[str, Stream]
    inputs: dict[str, Timed]
    truth: dict[str, Timed]
    constants: dict[str, Any]
    about: str
    licence: str
    citation: str


class Source(NamedTuple):
    """A recorded set: its sequences (the first is the default), its reader, and where it comes from."""

    sequences: tuple[str, ...]
    read: Callable[[Path, str], Contents]
    origin: str
    licence: str
    citation: str


def root() -> Path:
    """The folder of all sets, from the environment variable `VARIABLE`.

    Raises:
        FileNotFoundError: the variable is not set.
    """
    where = os.environ.get(VARIABLE)
    if not where:
        raise FileNotFoundError(f"the environment variable {VARIABLE} is not set")
    return Path(where)


def table(path: Path, skip: int = 0, delimiter: str | None = None) -> np.ndarray:
    """Numbers in columns (K, n), float64, plain or gzipped; lines that begin with # are comments."""
    return np.loadtxt(path, skiprows=skip, delimiter=delimiter, ndmin=2)


def named_columns(path: Path) -> dict[str, np.ndarray]:
    """Columns of numbers by the names in the first line of a comma-separated file, plain or gzipped."""
    names = [name.strip() for name in _lines(path)[0].split(",")]
    return dict(zip(names, table(path, skip=1, delimiter=",").T, strict=True))


def tagged_rows(path: Path, tag: str) -> np.ndarray:
    """The numbers (K, n) on the lines that begin with this word, plain or gzipped."""
    rows = [line.split()[1:] for line in _lines(path) if line.split()[:1] == [tag]]
    return np.array(rows, float)


def text_rows(path: Path) -> list[list[str]]:
    """The cells of a comma-separated file below its header line, as text, plain or gzipped."""
    return [line.split(",") for line in _lines(path)[1:] if line]


def _lines(path: Path) -> list[str]:
    if path.suffix == ".gz":
        with gzip.open(path, "rt") as file:
            return file.read().splitlines()
    return path.read_text().splitlines()


def arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an npz file."""
    with np.load(path) as file:
        return {name: file[name] for name in file.files}


def sensed(t: np.ndarray, z: np.ndarray, c: PyTree = ()) -> Stream:
    """A stream from readings with NaN where something is missing: marked in ``valid``, with zeros in ``z``.

    A vector (K, m) is marked by component, unless its components are always missing together.
    """
    there = np.isfinite(z)
    if z.ndim > 1 and (there == there[:, :1]).all():
        there = there[:, 0]
    return Stream(t, np.where(np.isfinite(z), z, 0.0), c, None if there.all() else there)


def increasing(t: np.ndarray, values: PyTree) -> Timed:
    """Stamps and values as an input or a truth: of a repeated stamp only the last value is kept."""
    last = np.r_[np.diff(t) > 0, True]
    return t[last], _taken(values, last)


def known(t: np.ndarray, values: np.ndarray) -> Timed:
    """Stamps and values without the rows that hold a NaN."""
    there = np.isfinite(values).reshape(len(t), -1).all(1)
    return t[there], values[there]


def _taken(values: PyTree, which: np.ndarray) -> PyTree:
    if isinstance(values, dict):
        return {name: value[which] for name, value in values.items()}
    return values[which]


def each(point: Sequence[float] | np.ndarray, times: int) -> np.ndarray:
    """The same array as context of every one of so many readings, leading axis ``times``."""
    point = np.asarray(point, float)
    return np.broadcast_to(point, (times, *point.shape))
