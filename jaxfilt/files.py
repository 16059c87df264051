"""Recordings on disk: one .npz file, which anything that reads NumPy's format can read and write.

Its entries are ``version``, ``t`` (T,) float64 s, ``dt`` (T,) s, and one array for each leaf of the log's u, z, c and
valid, named by the way to it: ``z['gnss']``, ``z['mark']['range']``, ``u[0]``. A NamedTuple's fields are named like
the keys of a dict. Something empty is written as text: ``u`` is "()" where there is no input.
"""

from __future__ import annotations

import ast
import contextlib
import os
import re
import uuid
import zipfile
import zlib
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.tree_util import DictKey, GetAttrKey, SequenceKey

from jaxfilt import doors
from jaxfilt.types import Log, Model, PyTree, Recording, Space

VERSION = 1

_PART = r"""\[('(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|\d+)\]"""
_NAME = re.compile(rf"(\w+)((?:{_PART})*)")


def save(path: str | os.PathLike, recording: Recording) -> None:
    """Write a recording to a file, all of it or nothing: an older file of that name stays until the new one is whole.

    Args:
        path: of the file, by custom ``.npz``.
        recording: from `merge`, or ``Recording(log, t)``.

    Raises:
        OSError: where the file cannot be written.
        TypeError, ValueError: not a recording, fields of unequal length, dicts with keys that are no names.

    Example:
        >>> import os, tempfile, numpy as np, jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> rec = jf.merge(walk, {"z": (np.array([0.0, 0.5]), np.array([[1.0], [2.0]]))})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "walk.npz")
        ...     save(path, rec)
        ...     load(path, walk).log.z["z"].tolist()
        [[1.0], [2.0]]
    """
    if not (isinstance(recording, Recording) and isinstance(recording.log, Log)):
        raise TypeError(f"recording: expected Recording(log, t), got {type(recording).__name__}")
    log, t = recording.log, np.asarray(recording.t, np.float64)
    doors.leading("recording", Recording(log, t), t.size)
    arrays: dict[str, Any] = {"version": np.array(VERSION), "t": t}
    for way, leaf in jax.tree.leaves_with_path(log, is_leaf=_is_empty):
        arrays[_name(way)] = np.array(repr(leaf)) if _is_empty(leaf) else np.asarray(leaf)
    for name, a in arrays.items():
        if a.dtype.hasobject:
            raise TypeError(f"recording.log.{name}: expected numbers, got dtype {a.dtype}")
    _write(Path(path), arrays)


def load(path: str | os.PathLike, model: Model | None = None) -> Recording:
    """Read what `save` wrote, bit for bit.

    Args:
        path: of the file.
        model: whose sensors' spaces say what the readings z are made of; without it NamedTuples come back as dicts.
            Those in u and c always do, since a model has no template for them.

    Returns:
        Recording(log, t) of NumPy arrays.

    Raises:
        OSError: where there is no such file.
        KeyError: a sensor that the model lacks.
        ValueError: not such a file, or only a part of one, or readings that do not lie on the sensor's space.
    """
    path = Path(path)
    entries = _read(path)
    version = entries.pop("version").tolist()
    if version != VERSION:
        raise ValueError(f"{path}: expected version {VERSION} of the format, which this jaxfilt reads, got {version}")
    t = entries.pop("t")
    empty: dict[str, Any] = {"u": (), "z": {}, "c": {}, "valid": {}}
    log = Log(**(empty | _nested(path, entries)))
    if model is not None:
        spaces = {name: doors.sensor(model, name).space for name in log.z}
        log = log._replace(z={name: _on_space(path, name, entries, space) for name, space in spaces.items()})
    doors.leading(f"{path}: recording", Recording(log, t), t.size)
    return Recording(log, t)


def _is_empty(x: PyTree) -> bool:
    return not jax.tree.leaves(x)


def _name(way: tuple[Any, ...]) -> str:
    """The name of a leaf from JAX's path to it in a Log."""
    return way[0].name + "".join(f"[{_part(key)!r}]" for key in way[1:])


def _part(key: Any) -> str | int:
    if isinstance(key, SequenceKey):
        return key.idx
    part = key.name if isinstance(key, GetAttrKey) else key.key
    if not isinstance(part, str):
        raise TypeError(f"recording.log: expected names as keys of its dicts, got {part!r}")
    return part


def _write(path: Path, arrays: dict[str, Any]) -> None:
    unfinished = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        with open(unfinished, "xb") as file:
            np.savez_compressed(file, **arrays)
        os.replace(unfinished, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            unfinished.unlink()


def _read(path: Path) -> dict[str, np.ndarray]:
    wrong = f"{path}: expected a recording as `jaxfilt.save` writes it"
    with open(path, "rb") as file:
        if not zipfile.is_zipfile(file):
            raise ValueError(f"{wrong}, got something else or only the beginning of one")
        file.seek(0)
        try:
            with np.load(file, allow_pickle=False) as archive:
                entries = {name: archive[name] for name in archive.files}
        except (ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise ValueError(f"{wrong}, got a damaged file ({error})") from error
    missing = {"version", "t", "dt"} - set(entries)
    if missing:
        raise ValueError(f"{wrong}, got a file without {', '.join(sorted(missing))}")
    return entries


def _nested(path: Path, entries: dict[str, np.ndarray]) -> dict[str, PyTree]:
    """The fields of the log from their leaves, as dicts and tuples."""
    tree: dict = {}
    for name, a in entries.items():
        found = _NAME.fullmatch(name)
        if not found or found[1] not in Log._fields:
            raise ValueError(f"{path}: expected entries of a log, {Log._fields}, got {name!r}")
        *way, last = [found[1], *map(ast.literal_eval, re.findall(_PART, found[2]))]
        node = tree
        for part in way:
            node = node.setdefault(part, {})
        node[last] = ast.literal_eval(str(a)) if a.dtype.kind == "U" else a
    return {field: _with_tuples(node) for field, node in tree.items()}


def _with_tuples(node: PyTree) -> PyTree:
    if not isinstance(node, dict) or not node:
        return node
    if all(isinstance(part, int) for part in node):
        return tuple(_with_tuples(node[part]) for part in sorted(node))
    return {part: _with_tuples(child) for part, child in node.items()}


def _on_space(path: Path, sensor: str, entries: dict[str, np.ndarray], space: Space) -> PyTree:
    """The readings of a sensor, in the structure of its space."""
    ways, structure = jax.tree.flatten_with_path(space.origin)
    prefix = (GetAttrKey("z"), DictKey(sensor))
    names = [_name(prefix + way) for way, _ in ways]
    got = [name for name in entries if name.startswith(_name(prefix))]
    if sorted(names) != sorted(got):
        raise ValueError(f"{path}: expected for sensor {sensor!r} {names}, got {got}")
    z = structure.unflatten([entries[name] for name in names])
    doors.point(f"{path}: z of {sensor!r}", z, space, leading=entries["dt"].shape)
    return z
