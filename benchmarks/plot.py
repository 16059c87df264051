"""Time against the number of runs, log-log, a line for each contestant: an SVG for each workload and dtype."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from benchmarks.contestants import REGISTRY
from benchmarks.tables import group
from benchmarks.workloads import WORKLOADS

MARKS = "os^vD<>Pph*X8"


def curves(records: Iterable[dict[str, Any]]) -> dict[tuple[str, str], dict[str, list[tuple[int, float]]]]:
    """(workload, dtype) -> contestant -> (runs, s), of those with two sizes or more."""
    found: dict[tuple[str, str], dict[str, list[tuple[int, float]]]] = {}
    for (work, dtype, runs, _), rows in group(records).items():
        for name, record in rows.items():
            if "run" in record:
                found.setdefault((work, dtype), {}).setdefault(name, []).append((runs, record["run"]))
    several = {key: {name: points for name, points in lines.items() if len(points) > 1} for key, lines in found.items()}
    return {key: lines for key, lines in several.items() if lines}


def draw(records: Iterable[dict[str, Any]], folder: Path) -> list[Path]:
    """Write the figures; which."""
    from matplotlib.figure import Figure

    written = []
    names = list(REGISTRY)
    for (work, dtype), lines in curves(records).items():
        figure = Figure(figsize=(7.5, 4.8), layout="constrained")
        axes = figure.add_subplot()
        for name, points in lines.items():
            k, own = names.index(name), name.startswith("jaxfilt")
            axes.loglog(
                *zip(*points, strict=True), marker=MARKS[k], color=f"C{k}" if k < 10 else "0.4", label=name,
                linewidth=2.5 if own else 1, linestyle="--" if name.startswith("C") else "-",
            )  # fmt: skip
        axes.set(xlabel="runs", ylabel="s", title=f"{work}: {WORKLOADS[work].title}; {dtype}")
        axes.grid(which="both", alpha=0.25)
        figure.legend(loc="outside right center", fontsize="small", frameon=False)
        path = folder / f"{work}-{dtype}.svg"
        figure.savefig(path, metadata={"Date": None})
        written.append(path)
    return written
