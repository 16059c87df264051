"""Tables of records, in Markdown."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from benchmarks.contestants import BASE, LIMIT, REGISTRY
from benchmarks.workloads import WORKLOADS

QUIET = 0.15
"""Cores of others above which a time is marked."""

HEADS = (
    "contestant", "compile", "run", "ns per run and step", f"times as fast as {BASE}", f"times the time of {LIMIT}",
    "peak memory (MiB)", "off: means (sigma), variances", "note",
)  # fmt: skip

LEGEND = """\
`run`: median of five or more calls in a process of its own, of which `compile` is what the first took longer; all
outputs, means and variances of every row of every run, new and in memory. `*`: the time of a few runs, brought up in
proportion. `!`: others kept more than {quiet:g} cores busy meanwhile. Off: largest difference from a reference in long
double, means in posterior standard deviations, variances relative, over {checked} runs and all rows; of a gradient:
value, gradient, relative to the largest element."""


def seconds(t: float) -> str:
    """Three digits, in s, ms or µs."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if t >= size:
            return f"{t / size:.3g} {unit}"
    return f"{t / 1e-6:.3g} µs"


def ratio(x: float | None) -> str:
    """Three digits, no exponent."""
    return "" if x is None else f"{x:.0f}" if x >= 100 else f"{x:.3g}"


def group(records: Iterable[dict[str, Any]]) -> dict[tuple[str, str, int, int], dict[str, dict[str, Any]]]:
    """(workload, dtype, runs, steps) -> contestant -> its last record; in the order of the registries."""
    found: dict[tuple, dict] = {}
    for record in records:
        key = tuple(record[k] for k in ("workload", "dtype", "runs", "steps"))
        found.setdefault(key, {})[record["contestant"]] = record
    order = list(REGISTRY)
    return {
        key: dict(sorted(found[key].items(), key=lambda item: order.index(item[0])))
        for key in sorted(found, key=lambda key: (key[0], key[1] != "float64", *key[2:]))
    }


def speedup(rows: dict[str, dict[str, Any]], name: str, over: str) -> float | None:
    """How many times as fast a contestant is as another, None if either has no time."""
    slow, fast = (rows.get(who, {}).get("run") for who in (over, name))
    return slow / fast if slow and fast else None


def line(rows: dict[str, dict[str, Any]], name: str) -> str:
    """A row of the table."""
    r = rows[name]
    if "unable" in r:
        return f"| {name} | | {r['unable']} |" + " |" * (len(HEADS) - 3)
    share = r["run"] / (r["runs"] * r["steps"])
    limit = speedup(rows, name, LIMIT)
    off = [f"{r[k]:.0e}" for k in ("mean_off", "variance_off", "value_off", "gradient_off") if k in r]
    cells = [
        name,
        seconds(r["compile"]) if r["compile"] else "",
        seconds(r["run"]) + "*" * (r["runs_done"] < r["runs"]) + "!" * (r["load"] > QUIET),
        f"{share / 1e-9:.3g}",
        ratio(speedup(rows, name, BASE)),
        ratio(1 / limit if limit else None),
        f"{r['peak_memory']:.0f}",
        ", ".join(off),
        r["note"],
    ]
    return f"| {' | '.join(cells)} |"


def table(key: tuple[str, str, int, int], rows: dict[str, dict[str, Any]]) -> str:
    """The contestants of one workload, dtype and size."""
    work, dtype, runs, steps = key
    title = f"### {work}: {WORKLOADS[work].title}; {runs:,} runs x {steps:,} steps, {dtype}"
    heads = [f"| {' | '.join(HEADS)} |", "|" + "---|" * len(HEADS)]
    return "\n".join([title, "", *heads, *(line(rows, name) for name in rows)])


def tables(records: Iterable[dict[str, Any]]) -> str:
    """All of them."""
    return "\n\n".join(table(key, rows) for key, rows in group(records).items())


def described(facts: dict[str, Any], records: Iterable[dict[str, Any]]) -> str:
    """A paragraph: when, where, with which versions."""
    versions: dict[str, str] = {}
    for record in records:
        versions |= record.get("versions", {})
    packages = ", ".join(f"{name} {version}" for name, version in sorted(versions.items()))
    return (
        f"{facts['day']}: {facts['processor']}, {facts['cores']} cores, {', '.join(facts['vectors'])}, "
        f"{facts['memory']} GiB, {facts['system']}; Python {facts['python']}, {packages}."
    )
