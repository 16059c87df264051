"""Readers of recorded drives and flights: one small function a set, by name, from the folder at $JAXFILT_DATA.

Each reader's docstring says what was recorded, in which units and frames; `load` hands it on as ``Dataset.about``.
"""

from __future__ import annotations

from jaxfilt.datasets import cars, multirotors, robots
from jaxfilt.datasets.common import VARIABLE, Dataset, Source, root

_SOURCES: dict[str, Source] = {**cars.SOURCES, **robots.SOURCES, **multirotors.SOURCES}


def names() -> tuple[str, ...]:
    """The sets that `load` knows.

    Example:
        >>> import jaxfilt.datasets
        >>> "wifibot" in jaxfilt.datasets.names()
        True
    """
    return tuple(_SOURCES)


def sequences(name: str) -> tuple[str, ...]:
    """The sequences of a set; the first is the one that `load` takes by default.

    Raises:
        KeyError: a set that is not among `names`.

    Example:
        >>> import jaxfilt.datasets
        >>> jaxfilt.datasets.sequences("nclt_1hz")
        ('2013-01-10', '2013-02-23', '2013-04-05')
    """
    return _source(name).sequences


def load(name: str, sequence: str | None = None) -> Dataset:
    """Read one sequence of a recorded set from ``$JAXFILT_DATA/<name>/``.

    Args:
        name: one of `names`.
        sequence: one of `sequences`; default the first.

    Returns:
        Dataset(name, sequence, streams, inputs, truth, constants, about, licence, citation). What is missing is
        ``valid = False`` in its stream, with zeros in z.

    Raises:
        KeyError: a set or a sequence that does not exist.
        FileNotFoundError: the variable, the folder or a file is missing; the text says where it was looked for and
            where to get it.
    """
    source = _source(name)
    sequence = source.sequences[0] if sequence is None else str(sequence)
    if sequence not in source.sequences:
        raise KeyError(f"sequence of {name!r}: expected one of {list(source.sequences)}, got {sequence!r}")
    try:
        contents = source.read(root() / name, sequence)
    except FileNotFoundError as missing:
        raise FileNotFoundError(
            f"{name}: {missing}. Put the files of this set into the folder {name}/ of a folder of your choice and set "
            f"{VARIABLE} to the latter. Get them from {source.origin} ({source.citation})"
        ) from None
    return Dataset(name, sequence, *contents, source.read.__doc__ or "", source.licence, source.citation)


def _source(name: str) -> Source:
    if name not in _SOURCES:
        raise KeyError(f"dataset: expected one of {list(_SOURCES)}, got {name!r}")
    return _SOURCES[name]
