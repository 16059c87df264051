"""A folder of machine code that was compiled before: shared by processes, and never needed.

A file that is cut off, changed, of somebody else or not to be read is as good as none; one that cannot be written is
not missed.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import tempfile
from pathlib import Path

LIMIT = 256_000_000
"""Bytes that the folder may hold; what was not used for longest goes first."""

_MARK = b"jaxfilt machine code 1\n"
_SUFFIX = ".code"


def folder() -> Path:
    """``$JAXFILT_CACHE``, else the platform's folder for what can be made again."""
    chosen = os.environ.get("JAXFILT_CACHE")
    if chosen:
        return Path(chosen)
    home = Path(os.path.expanduser("~"))
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    return base / "jaxfilt"


def read(key: str) -> bytes | None:
    """What was written under a key, None if it is not there as it was written."""
    try:
        with open(folder() / (key + _SUFFIX), "rb") as file:
            if not _own(os.fstat(file.fileno())):
                return None
            found = file.read()
    except OSError:
        return None
    mark, digest, code = found[: len(_MARK)], found[len(_MARK) : len(_MARK) + 32], found[len(_MARK) + 32 :]
    if mark != _MARK or hashlib.sha256(code).digest() != digest:
        return None
    with contextlib.suppress(OSError):
        os.utime(folder() / (key + _SUFFIX))
    return code


def write(key: str, code: bytes) -> None:
    """Keeps code under a key, whole or not at all."""
    place = folder()
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=place)
    except OSError:
        return
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(_MARK + hashlib.sha256(code).digest() + code)
        os.replace(name, place / (key + _SUFFIX))
        _shrink(place)
    except OSError:
        with contextlib.suppress(OSError):
            os.unlink(name)


def _own(status: os.stat_result) -> bool:
    """Whether nobody else can have written a file: what it holds will be run."""
    if not hasattr(os, "geteuid"):
        return True
    return status.st_uid == os.geteuid() and not status.st_mode & 0o022


def _shrink(place: Path) -> None:
    files = []
    for path in place.glob("*" + _SUFFIX):
        with contextlib.suppress(OSError):  # another process may be doing the same
            status = path.stat()
            files.append((status.st_mtime, status.st_size, path))
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= LIMIT:
            return
        with contextlib.suppress(OSError):
            path.unlink()
        total -= size
