"""Machine code from LLVM's text, for the processor this runs on. Nothing else imports llvmlite, and this when asked."""

from __future__ import annotations

import hashlib
import threading
from functools import cache
from typing import Any, NamedTuple

from jaxfilt.lanes import cache as files

OPTIMIZATION = 1

_lock = threading.Lock()


class Code(NamedTuple):
    """A function in memory, for as long as ``engine`` is there."""

    address: int
    engine: Any


@cache
def available() -> bool:
    """Whether this machine can compile."""
    try:
        _host()
    except (ImportError, OSError, RuntimeError):
        return False
    return True


@cache
def vector_bytes() -> int:
    """The size of a vector register."""
    has = set(_host()[2].split(","))
    return 64 if "+avx512f" in has else 32 if "+avx2" in has else 16


def compiled(text: str, name: str) -> Code:
    """The function of an LLVM module, compiled or as it was compiled before."""
    import llvmlite

    told = [llvmlite.__version__, *map(str, _llvm().llvm_version_info), *_host(), str(OPTIMIZATION), name, text]
    key = hashlib.sha256("\0".join(told).encode()).hexdigest()
    with _lock:
        code = files.read(key)
        if code is None:
            code = _object_code(text)
            files.write(key, code)
        return _loaded(code, name)


def _llvm() -> Any:
    import llvmlite.binding

    return llvmlite.binding


@cache
def _host() -> tuple[str, str, str]:
    """Triple, name and features of the processor."""
    llvm = _llvm()
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.get_process_triple(), llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()


def _target() -> Any:
    triple, cpu, features = _host()
    return (
        _llvm()
        .Target.from_triple(triple)
        .create_target_machine(
            cpu=cpu, features=features, opt=OPTIMIZATION, reloc="default", codemodel="jitdefault", jit=True
        )
    )


def _object_code(text: str) -> bytes:
    target = _target()
    module = _llvm().parse_assembly(text)
    module.triple = target.triple
    module.data_layout = str(target.target_data)
    module.verify()
    return target.emit_object(module)


def _loaded(code: bytes, name: str) -> Code:
    llvm = _llvm()
    empty = llvm.parse_assembly("")
    empty.triple = _host()[0]
    engine = llvm.create_mcjit_compiler(empty, _target())
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return Code(engine.get_function_address(name), engine)
