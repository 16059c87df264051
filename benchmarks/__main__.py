"""Batched Kalman filters side by side: ``python -m benchmarks`` prints a table for each workload.

    python -m benchmarks --quick                                     # small sizes, a few minutes
    python -m benchmarks --only W2 --contestants "jaxfilt lanes" "naive JAX" --runs 1000 --dtype float32
    python -m benchmarks --quick --gate                              # fails where a ratio is worse than the baseline's
    python -m benchmarks --write                                     # into README.md, baseline.json, figures

Every measurement is a process of its own. What is not installed, or takes too long, is a row that says so.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from benchmarks import gate, machine, plot, tables
from benchmarks.contestants import REGISTRY
from benchmarks.measure import in_a_new_process
from benchmarks.workloads import CHECKED, WORKLOADS, problem

HERE = Path(__file__).resolve().parent
BEGIN, END = "<!-- figures: written by python -m benchmarks --write -->", "<!-- end of figures -->"


def asked() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the smallest sizes, two calls each")
    parser.add_argument("--only", nargs="+", choices=WORKLOADS, default=list(WORKLOADS), metavar="W", help="workloads")
    parser.add_argument("--contestants", nargs="+", choices=REGISTRY, metavar="NAME", help=", ".join(REGISTRY))
    parser.add_argument("--dtype", nargs="+", choices=("float64", "float32"), default=["float64"])
    parser.add_argument("--runs", nargs="+", type=int, help="default: the workload's own sizes")
    parser.add_argument("--steps", type=int, help="default: 1,000; quick: 200")
    parser.add_argument("--repeats", type=int, help="calls after the first, at least; default: 5, quick: 2")
    parser.add_argument("--seconds", type=float, default=20.0, help="of calls, after which no more are begun")
    parser.add_argument("--limit", type=float, default=180.0, help="seconds for a process")
    parser.add_argument("--wait", type=float, default=5.0, help="seconds at most to wait for others to be quiet")
    parser.add_argument("--json", type=Path, help="append the records, one a line")
    parser.add_argument("--from", type=Path, dest="source", help="measure nothing: tables of the records in this file")
    parser.add_argument("--gate", action="store_true", help="fail where a ratio is worse than in baseline.json")
    parser.add_argument("--write", action="store_true", help="into README.md, baseline.json and the figures")
    parser.add_argument("--plot", type=Path, metavar="FOLDER", help="draw time against runs, SVG")
    return parser.parse_args()


def measurements(a: argparse.Namespace) -> list[dict[str, Any]]:
    """All that was asked for, one process after the other."""
    steps, repeats = a.steps or (200 if a.quick else 1000), a.repeats or (2 if a.quick else 5)
    records = []
    for work in a.only:
        kind, own = WORKLOADS[work].kind, WORKLOADS[work].quick if a.quick else WORKLOADS[work].sizes
        sizes = own if kind == "online" else a.runs or own
        names = a.contestants or [name for name, c in REGISTRY.items() if kind in c.kinds]
        for runs in sizes:
            problem(work, runs, steps)  # the readings and the answer are made before any clock starts
            for dtype in a.dtype:
                for name in names:
                    machine.wait_until_quiet(a.wait)
                    record = in_a_new_process(work, name, runs, steps, dtype, repeats, a.seconds, a.limit)
                    said = record.get("unable") or f"{tables.seconds(record['run'])}, others {record['load']:.2f} cores"
                    print(f"{work} {runs} {dtype} {name}: {said}", file=sys.stderr, flush=True)
                    records.append(record)
                    if a.json:
                        with a.json.open("a") as file:
                            file.write(json.dumps(record) + "\n")
    return records


def written(readme: str, text: str) -> str:
    """The README with this text between its marks."""
    before, _, rest = readme.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n\n{text}\n\n{END}{after}"


def main() -> None:
    """Measure, print, and write or judge."""
    a = asked()
    records = list(map(json.loads, a.source.read_text().splitlines())) if a.source else measurements(a)
    legend = tables.LEGEND.format(quiet=tables.QUIET, checked=CHECKED)
    text = f"{tables.described(machine.facts(), records)}\n\n{legend}\n\n{tables.tables(records)}"
    print(text)
    if a.plot:
        plot.draw(records, a.plot)
    if a.gate and (wrong := gate.failures(records, gate.read())):
        raise SystemExit("\n".join(["", "slower than the baseline, or wrong:", *wrong]))
    if a.write:
        figures = "\n".join(f"![{path.stem}]({path.name})" for path in plot.draw(records, HERE))
        readme = HERE / "README.md"
        readme.write_text(written(readme.read_text(), f"{text}\n\n{figures}"))
        gate.write(records)


if __name__ == "__main__":
    main()
