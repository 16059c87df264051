"""C by hand, compiled for this machine: ``arrays`` in and out as everyone's, ``dense`` the same without the zeros of
the models, ``limit`` with runs innermost in memory and outputs that are used again. See benchmarks/native."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.contestants import Entry, Unable
from benchmarks.systems import SYSTEMS, transition
from benchmarks.workloads import SPREAD, Problem

SOURCES = Path(__file__).resolve().parent.parent / "native"
FLAGS = ("-O3", "-march=native", "-ffast-math", "-shared", "-fPIC", "-Wno-psabi")
REALS = {"float64": "double", "float32": "float"}


class Args(ctypes.Structure):
    """As in filters.c."""

    _fields_ = (
        ("steps", ctypes.c_int),
        *((name, ctypes.c_void_p) for name in ("z", "x0", "P0", "u", "Q", "R", "F", "H", "weights")),
        *((name, ctypes.c_void_p) for name in ("means", "variances")),
    )


def library(source: str, dtype: np.dtype) -> ctypes.CDLL:
    """Compile a source, once.

    Raises:
        Unable: no compiler.
    """
    compilers = ("g++", "clang++") if source.endswith("cpp") else ("gcc", "clang")
    found = [path for path in map(shutil.which, compilers) if path]
    if not found:
        raise Unable(f"no {' or '.join(compilers)}")
    command = [found[0], *FLAGS, f"-DREAL={REALS[dtype.name]}"]
    text = " ".join(command) + "".join(path.read_text() for path in sorted(SOURCES.iterdir()))
    name = f"{Path(source).stem}-{hashlib.sha256(text.encode()).hexdigest()[:16]}.so"
    path = Path(tempfile.gettempdir()) / "jaxfilt-benchmarks" / name
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}")
        command += [str(SOURCES / source), "-o", str(part), "-lm"]
        for threads in ("-fopenmp", "-O3"):  # Apple's clang has no OpenMP
            done = subprocess.run([*command, threads], capture_output=True)
            if done.returncode == 0:
                part.replace(path)
                break
        else:
            raise Unable(f"{found[0]} fails: {done.stderr.decode().strip().splitlines()[-1]}")
    return ctypes.CDLL(str(path))


def pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def blocks(array: np.ndarray, lanes: int) -> np.ndarray:
    """(N, ...) -> (blocks, ..., lanes); the last run repeated."""
    many = -(-len(array) // lanes)
    whole = array[np.minimum(np.arange(many * lanes), len(array) - 1)]
    return np.ascontiguousarray(np.moveaxis(whole.reshape(many, lanes, *array.shape[1:]), 1, -1))


def prepare(problem: Problem, variant: str) -> Entry:
    """See `benchmarks.contestants`."""
    if problem.kind == "gradient":
        return gradient(problem)
    lib, system, dtype = library("filters.c", problem.dtype), problem.system, problem.dtype
    L, threads, n, m, runs = lib.lanes(), cores(), system.n, len(system.seen), problem.runs
    rows, columns = np.tril_indices(n)
    x0, P0 = blocks(problem.x0, L), blocks(problem.P0[:, rows, columns], L)
    reach = SPREAD["alpha"] ** 2 * (n + SPREAD["kappa"])
    centre = 1 - n / reach
    weights = [reach**0.5, centre, 0.5 / reach, centre + 1 - SPREAD["alpha"] ** 2 + SPREAD["beta"]]
    F = transition(system, np.zeros(n), [0.0] * 4) if system.linear else np.eye(n)
    common = [np.ascontiguousarray(a, dtype) for a in (problem.u, system.Q, system.R, F, system.H, weights)]
    number = list(SYSTEMS).index(system.name)
    kind = 2 if problem.kind == "ukf" else int(variant == "dense")
    limit = variant == "limit"
    z = blocks(problem.z, L) if limit else np.ascontiguousarray(problem.z)
    u, *rest = common
    buffers = np.empty((threads, problem.steps, m + 2 * n, L), dtype)
    shape = (len(x0), problem.steps, n, L) if limit else (runs, problem.steps, n)
    kept = tuple(np.zeros(shape, dtype) for _ in range(2)) if limit else None

    def run() -> tuple:
        outputs = kept or tuple(np.empty(shape, dtype) for _ in range(2))
        args = Args(problem.steps, *(a.ctypes.data for a in (z, x0, P0, u, *rest, *outputs)))
        if limit:
            lib.run_blocks(number, kind, len(x0), threads, ctypes.byref(args))
        else:
            lib.run_arrays(number, kind, runs, threads, n, m, ctypes.byref(args), pointer(buffers))
        return outputs

    def fetch(found: tuple, k: int) -> tuple:
        if limit:
            found = tuple(np.moveaxis(a[: -(-k // L)], -1, 1).reshape(-1, problem.steps, n) for a in found)
        return tuple(a[:k] for a in found)

    return Entry(run, fetch, compiled=False, note="outputs used again" if limit else "")


def gradient(problem: Problem) -> Entry:
    """Of the car's EKF, in eight parameters, in forward mode."""
    lib, system = library("gradient.cpp", problem.dtype), problem.system
    L, rows, columns = lib.lanes(), *np.tril_indices(system.n)
    arrays = [blocks(a, L) for a in (problem.z, problem.truth, problem.x0, problem.P0[:, rows, columns])]
    theta = np.log(np.concatenate([np.diag(system.Q), np.diag(system.R)])).astype(problem.dtype)
    inputs = [*arrays, np.ascontiguousarray(problem.u), theta]

    def run() -> np.ndarray:
        sums = np.empty((len(arrays[0]), 9))
        lib.value_and_gradient(problem.runs, problem.steps, cores(), *map(pointer, [*inputs, sums]))
        return sums.sum(axis=0)

    return Entry(run, lambda found, k: (found[0], found[1:]), compiled=False)


def cores() -> int:
    """That this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
