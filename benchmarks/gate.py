"""The gate: no slower, relative to the others on the same machine at the same time, than when the baseline was written.

Seconds differ between machines, and on a shared one between hours; ratios do so much less. So the baseline has, of each
of jaxfilt's back ends on each workload, how many times as fast it was as `BASE`; the gate lets pass what is within a
factor of it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from benchmarks.contestants import BASE
from benchmarks.tables import group, speedup

BASELINE = Path(__file__).resolve().parent / "baseline.json"

SLACK = 0.6
"""Of the baseline's ratio, at least: two runs of one program differ by a third on a busy machine."""

OFF = {"float64": 1e-7, "float32": 0.05}
"""Largest difference from the reference that is let pass: sigmas of means, relative of variances."""


def ratios(records: Iterable[dict[str, Any]]) -> dict[str, float]:
    """Times as fast as `BASE`, of jaxfilt's contestants; keys "workload contestant dtype runs"."""
    found = {}
    for (work, dtype, runs, _), rows in group(records).items():
        for name in rows:
            fast = speedup(rows, name, BASE)
            if name.startswith("jaxfilt") and fast is not None:
                found[f"{work} {name} {dtype} {runs}"] = round(fast, 3)
    return found


def failures(records: Iterable[dict[str, Any]], baseline: dict[str, float], slack: float = SLACK) -> list[str]:
    """What is wrong: a ratio that fell, an answer that is off, a contestant of jaxfilt's that did not arrive."""
    records = list(records)
    wrong = []
    for name, now in ratios(records).items():
        then = baseline.get(name)
        if then is not None and now < slack * then:
            wrong.append(f"{name}: {now:.3g} times as fast as {BASE}, {then:.3g} in the baseline")
    for r in records:
        if not r["contestant"].startswith("jaxfilt"):
            continue
        who = f"{r['workload']} {r['contestant']} {r['dtype']} {r['runs']}"
        if "unable" in r and who in baseline:
            wrong.append(f"{who}: {r['unable']}")
        worst = max((r[k] for k in ("mean_off", "variance_off", "value_off", "gradient_off") if k in r), default=0.0)
        if not worst <= OFF[r["dtype"]]:
            wrong.append(f"{who}: off by {worst:.1e}")
    return wrong


def read(path: Path = BASELINE) -> dict[str, float]:
    """The baseline.

    Raises:
        SystemExit: there is none yet.
    """
    if not path.exists():
        raise SystemExit(f"{path.name} is not there: python -m benchmarks --write makes it")
    return json.loads(path.read_text())


def write(records: Iterable[dict[str, Any]], path: Path = BASELINE) -> None:
    """Take these ratios for the baseline; what was not measured stays."""
    old = read(path) if path.exists() else {}
    path.write_text(json.dumps(dict(sorted((old | ratios(records)).items())), indent=2) + "\n")
