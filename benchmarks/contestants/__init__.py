"""Who takes part. A contestant is a module with ``prepare(problem, variant) -> Entry``; the registry names them.

To add one: write the module, add a line to `REGISTRY`. What `prepare` does is not timed: bringing the readings into the
layout that the contestant likes belongs there. The layout of its outputs is free, too.
"""

from __future__ import annotations

import importlib
import importlib.metadata
from collections.abc import Callable
from typing import Any, NamedTuple

from benchmarks.workloads import Problem


class Unable(Exception):
    """A contestant does not do this; the text says why."""


class Entry(NamedTuple):
    """A contestant that is ready to start.

    ``run()`` does all runs once; on return all of its results, new arrays, are in memory. ``fetch(result, k)`` is
    (means, variances), each (k, T, n), of the first k runs, or (value, gradient), or () where nothing is compared.
    ``runs``: how many it does, if not all: the time is brought up in proportion. ``compiled`` False: its first call is
    as good as any. ``clock(result)``: (seconds to compile, to run) of one that measures itself.
    """

    run: Callable[[], Any]
    fetch: Callable[[Any, int], tuple]
    runs: int | None = None
    compiled: bool = True
    note: str = ""
    clock: Callable[[Any], tuple[float, float]] | None = None


class Contestant(NamedTuple):
    """``kinds`` of workloads that it knows; ``packages`` that it needs; ``xla``: flags for its process."""

    module: str
    variant: str
    kinds: frozenset[str]
    packages: tuple[str, ...] = ()
    narrow: bool = True
    """Whether there is a float32 of it."""
    xla: str = ""

    def missing(self) -> str:
        """Why it cannot start here, or nothing."""
        for package in self.packages:
            try:
                importlib.metadata.version(package)
            except importlib.metadata.PackageNotFoundError:
                return f"{package} is not installed"
        return ""

    def prepare(self, problem: Problem) -> Entry:
        """Make it ready.

        Raises:
            Unable: it does not do this.
        """
        if problem.kind not in self.kinds:
            raise Unable(f"has no {problem.kind}")
        return importlib.import_module(f"benchmarks.contestants.{self.module}").prepare(problem, self.variant)


FILTERS = frozenset({"kf", "ekf", "ukf"})
BATCH = FILTERS | {"gradient"}
WHOLE = frozenset({"study", "tuning"})

ONE_THREAD = "--xla_cpu_multi_thread_eigen=false"
"""Small products are slower on XLA's pool of threads than beside it."""

REGISTRY = {
    "jaxfilt lanes": Contestant("ours", "lanes", BATCH | WHOLE, ("llvmlite",)),
    "jaxfilt xla": Contestant("ours", "xla", BATCH | WHOLE | {"online"}),
    "jaxfilt xla, one thread": Contestant("ours", "xla", BATCH, xla=ONE_THREAD),
    "naive JAX": Contestant("naive", "", BATCH | {"online"}),
    "naive JAX, one thread": Contestant("naive", "", BATCH, xla=ONE_THREAD),
    "dynamax": Contestant("dynamax", "", BATCH | {"study"}, ("dynamax",)),
    "cuthbert": Contestant("cuthbert", "", BATCH, ("cuthbert", "cuthbertlib")),
    "kalman-py": Contestant("kalman_py", "jax", BATCH, ("kalman-py",)),
    "kalman-py, NumPy": Contestant("kalman_py", "numpy", FILTERS, ("kalman-py",), narrow=False),
    "filterpy": Contestant("filterpy", "", FILTERS | {"online", "study"}, ("filterpy",), narrow=False),
    "NumPy": Contestant("numpy", "", FILTERS),
    "C": Contestant("native", "arrays", FILTERS | {"gradient"}),
    "C, dense": Contestant("native", "dense", frozenset({"kf", "ekf"})),
    "C, limit": Contestant("native", "limit", FILTERS),
}
"""In the order of the tables."""

BASE, LIMIT = "naive JAX", "C, limit"
"""What the others are compared with: what anyone would write, and what the machine can do."""


def versions(contestant: Contestant) -> dict[str, str]:
    """Of its packages and of those below."""
    return {name: importlib.metadata.version(name) for name in (*contestant.packages, "jax", "jaxlib", "numpy")}
