"""A Python function of memory addresses as an operation inside a jitted program.

XLA calls a C function with a frame of pointers to its operands and results. That function is made by ctypes, so that
nothing has to be built where jaxfilt is installed; it takes the GIL for as long as it needs to find the addresses, and
the kernels that it starts run without it. Measured: 15 us a call, where `jax.pure_callback` takes 240 and copies.

Source of the layouts: the C interface of XLA's foreign functions, xla/ffi/api/c_api.h (its major version 0, which is
kept compatible), as `jax.ffi.include_dir` has it.
"""

from __future__ import annotations

import ctypes
import threading
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.ffi

Addresses = list[int]
Function = Callable[[Addresses, Addresses], None]

_pointer = ctypes.c_void_p


class _Version(ctypes.Structure):
    _fields_ = [("size", ctypes.c_size_t), ("extension", _pointer), ("major", ctypes.c_int), ("minor", ctypes.c_int)]


class _Metadata(ctypes.Structure):
    _fields_ = [("size", ctypes.c_size_t), ("version", _Version), ("traits", ctypes.c_uint32)]


class _Extension(ctypes.Structure):
    _fields_ = [
        ("size", ctypes.c_size_t),
        ("kind", ctypes.c_int),
        ("next", _pointer),
        ("metadata", ctypes.POINTER(_Metadata)),
    ]


class _Buffer(ctypes.Structure):
    _fields_ = [("size", ctypes.c_size_t), ("extension", _pointer), ("dtype", ctypes.c_int), ("data", _pointer)]


class _Buffers(ctypes.Structure):
    _fields_ = [
        ("size", ctypes.c_size_t),
        ("extension", _pointer),
        ("count", ctypes.c_int64),
        ("kinds", _pointer),
        ("each", ctypes.POINTER(ctypes.POINTER(_Buffer))),
    ]


class _Frame(ctypes.Structure):
    _fields_ = [
        ("size", ctypes.c_size_t),
        ("extension", ctypes.POINTER(_Extension)),
        ("api", ctypes.POINTER(_pointer)),
        ("context", _pointer),
        ("stage", ctypes.c_int),
        ("operands", _Buffers),
        ("results", _Buffers),
    ]


class _Error(ctypes.Structure):
    _fields_ = [
        ("size", ctypes.c_size_t),
        ("extension", _pointer),
        ("message", ctypes.c_char_p),
        ("code", ctypes.c_int),
    ]


_HANDLER = ctypes.CFUNCTYPE(_pointer, ctypes.POINTER(_Frame))
_ERROR_CREATE = ctypes.CFUNCTYPE(_pointer, ctypes.POINTER(_Error))
_INTERNAL = 13
# In the table of the interface: two words, then version (three words), then the internal table, then this function.
_ERROR_CREATE_AT = 6

_registered: dict[str, Any] = {}
_lock = threading.Lock()


def operation(name: str, function: Function, results: Sequence[jax.ShapeDtypeStruct]) -> Callable[..., Any]:
    """A function of arrays that hands their addresses, and those of the results, to ``function``.

    Args:
        name: tells this function apart from all others, in any process: compiled programs are cached by it.
        function: (addresses of operands, of results), C-contiguous arrays; what it raises XLA raises.
        results: their shapes and dtypes.
    """
    target = f"jaxfilt_lanes_{name}"
    with _lock:
        if target not in _registered:
            # Programs keep the bare address, so the object must live as long as the process.
            handler = _registered[target] = _handler(function)
            jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(handler), platform="cpu", api_version=1)
    return jax.ffi.ffi_call(target, list(results), vmap_method="sequential")


def _handler(function: Function) -> Any:
    def handle(frame: Any) -> int | None:
        frame = frame.contents
        if frame.extension:  # asked which version of the interface this is
            metadata = frame.extension.contents.metadata.contents
            metadata.version.major, metadata.version.minor, metadata.traits = 0, 1, 0
            return None
        try:
            function(_addresses(frame.operands), _addresses(frame.results))
        except BaseException:
            return _failed(frame, traceback.format_exc())
        return None

    return _HANDLER(handle)


def _addresses(buffers: _Buffers) -> Addresses:
    return [buffers.each[k].contents.data or 0 for k in range(buffers.count)]


def _failed(frame: Any, text: str) -> int | None:
    error = _Error(ctypes.sizeof(_Error), None, text.encode(), _INTERNAL)
    return _ERROR_CREATE(frame.api[_ERROR_CREATE_AT])(ctypes.byref(error))
