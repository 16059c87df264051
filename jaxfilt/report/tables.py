"""The tables of a page, from the plain data of `jaxfilt.report.summary`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

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
    is_number,
    label,
    number,
    ratio,
)
from jaxfilt.report.summary import REPLAY, SWEEP

FIRST = 12
"""How many diverged runs are named."""


def cards(found: dict[str, Any]) -> list[Card]:
    """The verdict on each filter."""
    if found["schema"] == SWEEP:
        return [_over_settings(found, name) for name in found["points"][0]["verdicts"]]
    made = []
    for name, v in found["verdicts"].items():
        word, mood = ("consistent", GOOD) if v["consistent"] else ("inconsistent", BAD)
        if not v["consistent"] and not any(not f["slight"] and f["kind"] != "few runs" for f in v["findings"]):
            word, mood = "not judged", SO_SO
        made.append(Card(name, word, v["headline"], [f["text"] for f in v["findings"]], mood))
    return made


def _over_settings(found: dict[str, Any], name: str) -> Card:
    points = found["points"]
    good = [p for p in points if p["verdicts"][name]["consistent"]]
    text = f"{name} consistent at {len(good)} of {len(points)} settings"
    if 0 < len(good) < len(points):
        text += ": " + "; ".join(_at(p["at"]) for p in good[:FIRST]) + ("; ..." if len(good) > FIRST else "")
    word, mood = ("consistent", GOOD) if len(good) == len(points) else ("in part", SO_SO)
    return Card(name, word if good else "inconsistent", text, [], mood if good else BAD)


def _at(point: dict[str, Any]) -> str:
    return ", ".join(
        f"{name} = {value:.4g}" if is_number(value) else f"{name} = {value}" for name, value in point.items()
    )


def tables(found: dict[str, Any]) -> list[Table]:
    """All tables of a study, a sweep or a replay; those without a row are left out."""
    if found["schema"] == SWEEP:
        made = [_points(found)]
    elif found["schema"] == REPLAY:
        made = [_recorded_errors(found), _sensors(found), _faults(found)]
    else:
        made = [_blocks(found), _consistency(found), _sensors(found), _coverage(found), _overall(found)]
        made += [_bias(found), _paired(found), _faults(found), _kept(found)]
    return [table for table in made if table.rows]


def _share(value: Any) -> Cell:
    return number(100 * value, "%", 3) if is_number(value) else Cell(NOTHING)


def _test(test: dict[str, Any], relative: bool = True) -> list[Cell]:
    """Mean, bounds, p and verdict; relative to the expectation."""
    scale = test["expected"] if relative and test["expected"] else 1.0
    mean, low, high = (None if test[k] is None else test[k] / scale for k in ("mean", "low", "high"))
    bounds = Cell(NOTHING) if low is None or high is None else Cell(f"{low:.3g} to {high:.3g}", low)
    mood = {"inside": GOOD, "unknown": PLAIN}.get(test["verdict"], BAD)
    shown = ratio(mean) if relative else number(mean, digits=3)
    return [shown, bounds, number(test["p"], digits=2), Cell(test["verdict"], test["verdict"], mood)]


def _each(found: dict[str, Any], what: str) -> Iterator[tuple[str, str, Any]]:
    """Filter, name and content of what a filter has by name."""
    for name, f in found["filters"].items():
        for key, content in (f[what] or {}).items():
            yield name, key, content


def _blocks(found: dict[str, Any]) -> Table:
    bound = found["bound"]
    columns = ["filter", "block", "RMSE", "claimed", "worst error", "in run"]
    if bound:
        columns += ["bound" if bound["exact"] else "approximate bound", "efficiency"]
    rows = []
    for name, block, b in _each(found, "blocks"):
        row = [label(name), label(block), estimate(b["rmse"], b["unit"]), number(b["claimed"], b["unit"])]
        row += [number(b["worst"]["value"], b["unit"]), number(b["worst"]["run"], digits=15)]
        if bound:
            row += [number(bound["rmse"][block], b["unit"]), _share(b["efficiency"])]
        rows.append(row)
    text = "Root mean square error over runs and time with its standard error, and what the filter itself expects."
    if bound:
        text += f" Efficiency: bound over mean squared error. The bound is {bound['kind']}."
    return Table("Errors", text, columns, rows)


def _consistency(found: dict[str, Any]) -> Table:
    rows = []
    for name, f in found["filters"].items():
        tests = {"state": f["state"]["nees"]} | {block: b["nees"] for block, b in f["blocks"].items()}
        rows += [[label(name), label(part), *_test(t), _share(t["share_inside"])] for part, t in tests.items()]
    text = (
        "Average normalised estimation error squared (ANEES) over its expectation: above 1 the filter is "
        "overconfident. p: how probable so large a deviation is for a consistent filter."
    )
    return Table("Consistency", text, _tested("ANEES", "block"), rows)


def _tested(what: str, of: str) -> list[str]:
    return ["filter", of, f"{what} / expected", "bounds", "p", "verdict", "steps inside"]


def _sensors(found: dict[str, Any]) -> Table:
    rows = []
    for name, sensor, s in _each(found, "sensors"):
        white = s["whiteness"]
        known = [(r, b) for r, b in zip(white["autocorrelation"], white["bound"], strict=True) if r is not None and b]
        inside = sum(abs(r) <= b for r, b in known)
        mood = PLAIN if not known else GOOD if inside == len(known) else BAD
        white_cells = [number(known[0][0] if known else None, digits=2)]
        white_cells.append(Cell(f"{inside} of {len(known)}", inside, mood) if known else Cell(NOTHING))
        share = [] if found["schema"] == REPLAY else [_share(s["nis"]["share_inside"])]
        row = [label(name), label(sensor), *_test(s["nis"]), *share, *white_cells]
        rows.append([*row, number(s["refused"], digits=15)])
    columns = _tested("ANIS", "sensor")[: -1 if found["schema"] == REPLAY else None]
    text = (
        "Average normalised innovation squared (ANIS) over its expectation; autocorrelation of the innovations at lag "
        "1 and lags at which it is inside its bounds; readings that a gate refused."
    )
    return Table("Sensors", text, [*columns, "lag 1", "lags inside", "refused"], rows)


def _coverage(found: dict[str, Any]) -> Table:
    rows = []
    for name, f in found["filters"].items():
        for level, t in f["state"]["coverage"].items():
            _, bounds, p, verdict = _test(t, relative=False)
            if t["low"] is not None and t["high"] is not None:
                bounds = Cell(f"{100 * t['low']:.3g} to {100 * t['high']:.3g} %", t["low"])
            inside = _share(t["share_inside"])
            rows.append([label(name), _share(float(level)), _share(t["mean"]), bounds, p, verdict, inside])
    text = "How many of the errors lie in the credible ellipsoid of a probability."
    return Table("Coverage", text, ["filter", "ellipsoid", "inside", "bounds", "p", "verdict", "steps inside"], rows)


def _overall(found: dict[str, Any]) -> Table:
    rows = []
    for name, f in found["filters"].items():
        s, d = f["state"], f["diverged"]
        lost = Cell(f"{d['runs']:,}", d["runs"], BAD if d["runs"] else GOOD)
        scores = [estimate(s["log_score"]), number(s["noncredibility"], "dB", 3), number(s["inclination"], "dB", 3)]
        rows.append([label(name), number(f["runs"], digits=15), lost, *scores])
    text = "Log score: mean of log N(error; 0, P), larger is better. Inclination above 0: overconfident."
    columns = ["filter", "runs scored", "diverged", "log score", "noncredibility", "inclination"]
    return Table("Overall", text, columns, rows)


def _bias(found: dict[str, Any]) -> Table:
    rows = []
    for name, component, c in _each(found, "components"):
        rows.append([label(name), label(component), *_test(c["normalised_error"], relative=False)])
    text = "Mean of the errors over their claimed standard deviations: 0 if unbiased."
    return Table("Bias", text, ["filter", "component", "mean normalised error", "bounds", "p", "verdict"], rows)


def _paired(found: dict[str, Any]) -> Table:
    rows = []
    for p in found["paired"]:
        score = p["log_score"] | {"unit": ""}
        for what, e in [*p["square"].items(), ("log score", score)]:
            value, error = e["value"], e["error"]
            z = value / error if is_number(value) and is_number(error) and error > 0 else None
            better = NOTHING
            if z is not None:
                first_wins = (z > 0) == (e is score)
                better = "neither, within 3 errors" if abs(z) < 3 else p["first" if first_wins else "second"]
            difference = label(f"{p['first']} \N{MINUS SIGN} {p['second']}")
            rows.append(
                [
                    difference,
                    label(what),
                    estimate(e, e["unit"].replace("^2", "\N{SUPERSCRIPT TWO}")),
                    Cell(NOTHING) if z is None else Cell(f"{z:.1f}", z),
                    label(better),
                ]
            )
    text = "Differences in mean squared error by block and in log score, on the same noise, over runs neither lost."
    return Table("Filters compared", text, ["filters", "of", "difference", "in standard errors", "better"], rows)


def _faults(found: dict[str, Any]) -> Table:
    rows = []
    for name, f in found["filters"].items():
        d, fault = f["diverged"], f["fault"]
        lost = d if isinstance(d, bool) else d["runs"]
        if not lost and fault is None:
            continue
        which = "yes" if d is True else "no" if d is False else _runs(d)
        what = NOTHING
        if fault is not None:
            what = f"run {fault['run']}, step {fault['step']}, sensor {fault['sensor']}: {fault['status']}"
            what += f" (faults in {fault['runs']:,} runs)"
        rows.append([label(name), Cell(which, float(lost)), label(what)])
    text = "Diverged: the last errors are impossible for a consistent filter, or a belief is no belief any more."
    return Table("Runs that went wrong", text, ["filter", "diverged", "first fault"], rows)


def _runs(diverged: dict[str, Any]) -> str:
    first = diverged["first"][:FIRST]
    more = ", ..." if diverged["runs"] > len(first) else ""
    return f"{diverged['runs']:,}: run {', '.join(map(str, first))}{more}" if diverged["runs"] else "0"


def _kept(found: dict[str, Any]) -> Table:
    rows = []
    for name, f in found["filters"].items():
        for block, rmse in (f["kept"] or {"rmse": {}})["rmse"].items():
            unit, test = f["blocks"][block]["unit"], f["kept"]["nees"][block]
            runs = number(f["kept"]["runs"], digits=15)
            rows.append([label(name), label(block), runs, estimate(rmse, unit), *_test(test)])
    columns = ["filter", "block", "runs", "RMSE", "ANEES / expected", "bounds", "p", "verdict"]
    return Table("Without the diverged runs", "The same over the runs that did not diverge.", columns, rows)


def _recorded_errors(found: dict[str, Any]) -> Table:
    rows = []
    for name, block, b in _each(found, "blocks"):
        value = number(b["rmse"], b["unit"])
        rows.append([label(name), label(f"RMSE {block}"), value, Cell(NOTHING), Cell(NOTHING)])
    for name, f in found["filters"].items():
        if f["state"]:
            mean, bounds, _, verdict = _test(f["state"]["nees"])
            rows.append([label(name), label("ANEES / expected"), mean, bounds, verdict])
    return Table(
        "Errors", "Against the truth, where it is known.", ["filter", "score", "value", "bounds", "verdict"], rows
    )


def _worst(verdict: dict[str, Any]) -> Cell:
    """In few words: the worst of the findings up to its figures."""
    if verdict["consistent"]:
        return Cell("consistent", "consistent", GOOD)
    text = verdict["findings"][0]["text"].split(":")[0] if verdict["findings"] else "not judged"
    return Cell(text, text, BAD)


def _points(found: dict[str, Any]) -> Table:
    over = list(found["over"])
    blocks = {block: b["unit"] for block, b in next(iter(found["points"][0]["filters"].values()))["blocks"].items()}
    rows = []
    for point in found["points"]:
        for name, f in point["filters"].items():
            at = [number(v) if is_number(v) else label(str(v)) for v in point["at"].values()]
            errors = [estimate(f["blocks"][block]["rmse"], unit) for block, unit in blocks.items()]
            mean, bounds, _, verdict = _test(f["state"]["nees"])
            lost = number(f["diverged"]["runs"], digits=15)
            rows.append([*at, label(name), _worst(point["verdicts"][name]), *errors, mean, bounds, verdict, lost])
    columns = [
        *over,
        "filter",
        "verdict",
        *(f"RMSE {block}" for block in blocks),
        "ANEES / expected",
        "bounds",
        "inside?",
    ]
    return Table("All settings", "Each with its verdict.", [*columns, "diverged"], rows)
