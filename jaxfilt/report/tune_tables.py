"""The tables of a tuning's page, from the plain data of `jaxfilt.report.tune_summary`."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxfilt import plaintext
from jaxfilt.fit import BEFORE, ESTIMATED, TEST, TRAIN, TRUE, TUNED, VALIDATION
from jaxfilt.report.cells import (
    BAD,
    GOOD,
    NOTHING,
    PLAIN,
    SO_SO,
    Card,
    Cell,
    Table,
    estimate,
    label,
    number,
    ratio,
)

STAGES = (BEFORE, ESTIMATED, TUNED, TRUE)
PARTS = (TEST, VALIDATION, TRAIN)

MATRIX_WIDTH = 96
"""Characters of a matrix's line on the page."""


def cards(found: dict[str, Any]) -> list[Card]:
    """What tuning came to, on the part of the data that tells most."""
    part = reported(found)
    losses = {stage: found["scores"][stage][part]["loss"] for stage in STAGES if part in found["scores"].get(stage, {})}
    told = ", ".join(f"{stage} {number(loss).text}" for stage, loss in losses.items())
    s = found["settings"]
    text = f"Loss on the {part} part ({s['objective']}, smaller is better): {told}. {_sentence(s['stopped'])}"
    rivals = [s for s in (ESTIMATED, BEFORE) if losses.get(s) is not None and not _less(losses.get(TUNED), losses[s])]
    word, mood = (f"no better than {rivals[0]}", BAD) if rivals else (f"the best on the {part} part", GOOD)
    return [Card("tuned", word, text, [], mood if part != TRAIN else SO_SO)]


def reported(found: dict[str, Any]) -> str:
    """The part that tells most: of test, validation and train the first that there is."""
    return next((part for part in PARTS if any(part in parts for parts in found["scores"].values())), TRAIN)


def tables(found: dict[str, Any]) -> list[Table]:
    """All tables of a tuning; those without a row are left out."""
    made = [_scores(found), _parameters(found), _flat(found)]
    return [table for table in made if table.rows]


def matrices(found: dict[str, Any]) -> dict[str, dict[str, str]]:
    """Stage -> name -> covariance as plain text, the tuned ones first."""
    stages = sorted(found["covariances"], key=lambda stage: (stage != TUNED, STAGES.index(stage)))
    made = {}
    for stage in stages:
        c = found["covariances"][stage]
        named = {f"Q over {c['dt']:.4g} s": c["Q"]} | {f"R of {name}": R for name, R in c["R"].items()}
        made[stage] = {name: _matrix(M) for name, M in (named | {"P0": c["P0"]}).items()}
    return made


def _matrix(M: list) -> str:
    return plaintext.matrix(np.array(M, float), indent=0, width=MATRIX_WIDTH)


def _less(a: float | None, b: float) -> bool:
    return a is not None and a < b


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith('.') else '.'}"


def _scores(found: dict[str, Any]) -> Table:
    each = [
        (part, stage, parts[part])
        for part in PARTS
        for stage in STAGES
        if part in (parts := found["scores"].get(stage, {}))
    ]
    blocks = {block: b["unit"] for _, _, s in each for block, b in (s["rmse"] or {}).items()}
    sensors = list(dict.fromkeys(sensor for _, _, s in each for sensor in s["nis"]))
    truth, lost = any(s["nees"] for _, _, s in each), any(s["diverged"] for _, _, s in each)
    rows = []
    for part, stage, s in each:
        row = [label(part), Cell(stage, stage), number(s["loss"], digits=5)]
        row += [number((s["rmse"] or {}).get(block, {}).get("value"), unit) for block, unit in blocks.items()]
        if truth:
            row += [estimate(s["log_score"]) if s["log_score"] else Cell(NOTHING), *_test(s["nees"], bounds=True)]
        for sensor in sensors:
            row += _test(s["nis"].get(sensor))
        if lost:
            row.append(Cell(f"{s['diverged']:,}", s["diverged"], BAD if s["diverged"] else PLAIN))
        rows.append([*row, number(s["runs"], digits=15), number(s["rows"], digits=15)])
    columns = ["part", "parameters", "loss", *[f"RMSE {block}" for block in blocks]]
    columns += ["log score", "ANEES / n", "bounds"] if truth else []
    columns += [f"ANIS / m {sensor}" for sensor in sensors] + (["diverged"] if lost else []) + ["runs", "rows"]
    text = (
        "Held-out data first. ANEES and ANIS are over their expectations: above 1 the filter is overconfident. Red: "
        "outside the bounds."
    )
    return Table("Scores", text, columns, rows)


def _test(test: dict[str, Any] | None, bounds: bool = False) -> list[Cell]:
    """A mean over its expectation, coloured where it is out of its bounds; and these."""
    if test is None:
        return [Cell(NOTHING)] * (1 + bounds)
    cell = ratio(test["ratio"])._replace(mood={"inside": GOOD, "unknown": PLAIN}.get(test["verdict"], BAD))
    if not bounds:
        return [cell]
    low, high, expected = test["low"], test["high"], test["expected"]
    if low is None or high is None or not expected:
        return [cell, Cell(NOTHING)]
    return [cell, Cell(f"{low / expected:.3g} to {high / expected:.3g}", low)]


def _parameters(found: dict[str, Any]) -> Table:
    columns = {"start": "start", "estimated": "noise estimation", "true": "truth"}
    there = {key: name for key, name in columns.items() if any(p[key] is not None for p in found["parameters"])}
    rows = []
    for p in found["parameters"]:
        tuned = estimate(p) if p["error"] is not None else number(p["value"])
        rows.append([label(p["name"]), tuned, *[number(p[key]) for key in there]])
        if "true" in there:
            off = (p["value"] - p["true"]) / p["error"] if p["error"] and p["true"] is not None else None
            rows[-1].append(number(off, digits=2))
    more = ["off by (errors)"] if "true" in there else []
    text = f"Standard errors: {found['errors_by']}."
    return Table("Parameters", text, ["name", "tuned", *there.values(), *more], rows)


def _flat(found: dict[str, Any]) -> Table:
    rows = []
    for flat in found["flat"]:
        std = Cell("unbounded") if flat["std"] is None else number(flat["std"], digits=3)
        along = ", ".join(f"{name} {share:+.2g}" for name, share in flat["direction"].items())
        rows.append([label(flat["text"]), label(along), std, number(flat["curvature"], digits=2)])
    text = "Combinations of parameters that the data hardly determine: what they are worth apart says little."
    return Table("Flat directions", text, ["in words", "direction", "standard deviation", "curvature"], rows)
