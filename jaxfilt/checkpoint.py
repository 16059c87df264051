"""The state of a long computation in a folder, so that one that was killed goes on from where it last kept it."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import io
import json
import os
import platform
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxfilt.types import PyTree

STATE_FILE = "checkpoint.npz"
MANIFEST_FILE = "manifest.json"
SCHEMA = "jaxfilt.checkpoint/1"


class Kind(NamedTuple):
    """What it is that keeps its state, and what it counts."""

    name: str
    unit: str


STUDY, TUNING = Kind("study", "runs"), Kind("tuning", "steps")


class Checkpoint(NamedTuple):
    """Where a computation keeps its state, and the manifest that says what it is."""

    folder: Path
    manifest: dict[str, Any]
    kind: Kind


def version(package: str) -> str:
    """Of an installed package; "unknown" for one that runs from its source tree."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def made_with() -> dict[str, str]:
    """The versions and the device that numbers depend on."""
    return {
        "jaxfilt": version("jaxfilt"),
        "jax": jax.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "platform": jax.default_backend(),
        "device": str(jax.devices()[0].device_kind),
    }


def named(tree: PyTree) -> dict[str, Any]:
    """Each leaf by the way to it, as what JSON can hold: ``{"q/yaw": -2.3}``."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(way, simple=True, separator="/"): np.asarray(leaf).tolist() for way, leaf in leaves}


def fingerprint(tree: PyTree) -> str:
    """A short text that differs wherever two trees differ in structure, shape, type or value."""
    leaves, structure = jax.tree.flatten(tree)
    digest = hashlib.sha256(str(structure).encode())
    for leaf in map(np.asarray, leaves):
        digest.update(f"{leaf.shape}{leaf.dtype}".encode() + np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:16]


def begin(folder: Path, about: dict[str, Any], total: int, resume: bool = False, kind: Kind = STUDY) -> Checkpoint:
    """The checkpoint of a computation in a folder, made if need be; a new one removes the state of a finished one.

    Raises:
        OSError: the folder cannot be written.
        FileExistsError: it holds one that was not finished, and is not to be resumed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint = Checkpoint(folder, {"schema": SCHEMA, kind.unit: total, "made_with": made_with()} | about, kind)
    if resume:
        return checkpoint
    old = read_manifest(folder)
    for name, unit in (STUDY, TUNING):
        if old is not None and f"{unit}_done" in old and old[f"{unit}_done"] < old[unit]:
            raise FileExistsError(
                f"{folder} holds a {name} that stopped after {old[f'{unit}_done']:,} of {old[unit]:,} {unit}: "
                "resume it, or remove the folder to begin anew"
            )
    (folder / STATE_FILE).unlink(missing_ok=True)
    write_whole(folder / MANIFEST_FILE, _json(checkpoint.manifest | {f"{kind.unit}_done": 0}))
    return checkpoint


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """What the state in a folder says of itself, None where there is none: that of the state file, which is whole."""
    try:
        with np.load(folder / STATE_FILE) as file:
            return json.loads(str(file["manifest"]))
    except FileNotFoundError:
        return None


def save(checkpoint: Checkpoint, state: PyTree, done: int) -> None:
    """Replace the state in one step: whoever reads, and whenever we are killed, finds the old or the new one, whole.

    Raises:
        OSError: it cannot be written; the state before it stays.
    """
    name, unit = checkpoint.kind
    buffer = io.BytesIO()
    about = checkpoint.manifest | {f"{unit}_done": done}
    np.savez(buffer, manifest=np.array(json.dumps(about)), **{str(i): a for i, a in enumerate(jax.tree.leaves(state))})
    try:
        write_whole(checkpoint.folder / STATE_FILE, buffer.getvalue())
        write_whole(checkpoint.folder / MANIFEST_FILE, _json(about))
    except OSError as error:
        raise OSError(
            error.errno,
            f"the {name} cannot keep its state after {done:,} {unit} ({error.strerror}); what it kept before is whole, "
            "so that it can be resumed",
            str(checkpoint.folder),
        ) from error


def load(folder: Path, about: dict[str, Any], structure: Any, kind: Kind = STUDY) -> PyTree:
    """The state of the same computation, to go on from; None where it was stopped before it had any.

    Raises:
        ValueError: what is there is another one; the text says what differs.
        FileNotFoundError: there is none.
    """
    old = read_manifest(folder)
    if old is None:
        if not (folder / MANIFEST_FILE).exists():
            raise FileNotFoundError(f"{folder}: expected a {kind.name} to resume, found none")
        return None
    if kind.unit not in old:
        raise ValueError(f"{folder}: cannot resume, it holds no {kind.name}")
    here = json.loads(json.dumps(about | {"made_with": made_with()}))
    for what, mine in here.items():
        if mine != old.get(what):
            raise ValueError(f"{folder}: cannot resume, {_difference(what, old.get(what), mine, kind.name)}")
    with np.load(folder / STATE_FILE) as file:
        return jax.tree.unflatten(structure, [file[str(i)] for i in range(len(file.files) - 1)])


def _difference(what: str, old: Any, mine: Any, name: str) -> str:
    """What differs between two manifests, in words."""
    if what == "program":
        return "the model, the filters or the schedule have changed since"
    if isinstance(old, dict) and isinstance(mine, dict):
        for key in old | mine:
            if old.get(key) != mine.get(key):
                return _difference(f"{what}.{key}", old.get(key), mine.get(key), name)
    return f"it has {what} {old}, this {name} {mine}"


def _json(what: dict[str, Any]) -> bytes:
    return (json.dumps(what, indent=1) + "\n").encode()


def write_whole(path: Path, content: bytes) -> None:
    """Put a file in place in one step: it is there whole, or as it was before."""
    partial = path.with_name(path.name + ".partial")
    try:
        with open(partial, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except OSError:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise
