"""One self-contained HTML page: verdicts on top, figures, tables that sort, settings, the command to reproduce.

Nothing is loaded from anywhere: style, script and figures are in the file, and its content security policy allows no
others. All text passes through `_text` on its way into the page, since names are the user's.
"""

from __future__ import annotations

import base64
import hashlib
import html
import importlib.resources
from collections.abc import Mapping, Sequence
from typing import Any

from jaxfilt.bound import Bound
from jaxfilt.findings import count
from jaxfilt.fit import Fit
from jaxfilt.report import figures, tune_summary, tune_tables
from jaxfilt.report.cells import BAD, GOOD, SO_SO, Card, Cell, Table
from jaxfilt.report.drawing import Picture
from jaxfilt.report.summary import REPLAY, SWEEP, summary
from jaxfilt.report.tables import cards, tables
from jaxfilt.report.tune_summary import TUNE
from jaxfilt.review import Replayed
from jaxfilt.study import Study
from jaxfilt.sweep import Sweep

SIGNS = {GOOD: "\N{CHECK MARK}", BAD: "\N{BALLOT X}", SO_SO: "\N{ALMOST EQUAL TO}"}
"""Before the word of a verdict, for those who see no colours."""

WIDE = 40
"""Characters from which on a cell is broken into lines."""


def page(result: Study | Sweep | Replayed | Fit, name: str = "", bound: Bound | None = None, command: str = "") -> str:
    """The report of a study, a sweep, a replay or a tuning as one HTML file.

    Args:
        result: from `jaxfilt.study`, `jaxfilt.sweep`, `jaxfilt.replayed` or `jaxfilt.tune`.
        name: of what was studied.
        bound: from `jaxfilt.cramer_rao`, of a study.
        command: what to type to get the same again.

    Raises:
        ModuleNotFoundError: matplotlib is missing; the text says how to get it.
    """
    tuned = isinstance(result, Fit)
    found = tune_summary.summary(result, name, command) if tuned else summary(result, name, bound, command)
    return rendered(found, figures.pictures(result, bound))


def rendered(found: Mapping[str, Any], pictures: Sequence[Picture]) -> str:
    """The page of a summary and its pictures."""
    found = dict(found)
    kind = {SWEEP: "sweep", REPLAY: "replay", TUNE: "tuning"}.get(found["schema"], "study")
    title = found["name"] or kind
    style, script = (
        importlib.resources.files("jaxfilt.report").joinpath(f"page.{part}").read_text() for part in ("css", "js")
    )
    tuned = kind == "tuning"
    verdicts = "".join(map(_card, tune_tables.cards(found) if tuned else cards(found)))
    told = "".join(f"<li>{_text(text)}</li>" for text in found.get("findings", ()))
    notices = f"<ol class='findings'>{told}</ol>" if told else ""
    about = f"<p class='quiet'>{_text(_about(found, kind))}</p>{_unfinished(found)}"
    made = tune_tables.tables(found) if tuned else tables(found)
    parts = [
        f"<header><h1>{_text(title)}</h1>{about}</header>",
        "<main>",
        _section("Findings" if tuned else "Verdicts", f"<ul class='cards'>{verdicts}</ul>{notices}"),
        _section("Figures", f"<div class='figures'>{''.join(map(_figure, pictures))}</div>"),
        _section("Tables", "<p class='quiet'>Press a column's name to sort by it.</p>", *map(_table, made)),
        _section("Matrices", *_matrices(found)) if tuned else "",
        _section("Settings", _settings(found)),
        _again(found),
        "</main>",
        f"<footer><p>{_text(_made(found))}</p></footer>",
    ]
    return (
        "<!DOCTYPE html>\n<html lang='en'>\n<head>\n<meta charset='utf-8'>\n"
        "<meta name='viewport' content='width=device-width, initial-scale=1'>\n"
        f'<meta http-equiv="Content-Security-Policy" content="{_policy(style, script)}">\n'
        f"<title>{_text(title)}: jaxfilt</title>\n<link rel='icon' href='data:,'>\n"
        f"<style>{style}</style>\n</head>\n<body>\n"
        + "\n".join(parts)
        + f"\n<script>{script}</script>\n</body>\n</html>\n"
    )


def _section(title: str, *parts: str) -> str:
    name = title.split()[-1].lower()
    return f"<section aria-labelledby='{name}'><h2 id='{name}'>{title}</h2>\n" + "\n".join(parts) + "</section>"


def _policy(style: str, script: str) -> str:
    """Our own style and script by their digests, figures from the file itself, and nothing else."""
    digest = {
        what: "'sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() + "'"
        for what, text in (("style", style), ("script", script))
    }
    return f"default-src 'none'; img-src data:; style-src {digest['style']}; script-src {digest['script']}"


def _text(text: Any) -> str:
    return html.escape(str(text))


def _about(found: Mapping[str, Any], kind: str) -> str:
    s = found["settings"]
    if kind == "tuning":
        runs = f"{count(s['runs'], 'run')}, {s['split']}"
        return f"Tuned by {s['objective']} with {s['optimizer']}; {runs}; {s['dtype']}, seed {s['seed']}"
    if kind == "replay":
        return f"A recording of {s['steps']:,} rows, {s['dtype']}"
    runs = f"{count(s['runs'], 'run')} of {count(s['steps'], 'step')}, {s['dtype']}, seed {s['seed']}"
    return f"Monte Carlo study: {runs}" if kind == "study" else f"Sweep: {len(found['points']):,} settings, each {runs}"


def _unfinished(found: Mapping[str, Any]) -> str:
    if found.get("complete", True):
        return ""
    s = found["settings"]
    return f"<p class='notice'>Not finished: {s['runs']:,} of {s['planned']:,} runs were done.</p>"


def _card(card: Card) -> str:
    findings = ""
    if len(card.findings) > 1:
        items = "".join(f"<li>{_text(text)}</li>" for text in card.findings)
        findings = f"<details><summary>All {len(card.findings)} findings</summary><ol>{items}</ol></details>"
    sign = SIGNS[card.mood]
    word = f"<strong><span aria-hidden='true'>{sign}</span> {_text(card.name)}: {_text(card.word)}</strong>"
    return f"<li class='card {card.mood}'>{word}<p>{_text(card.headline)}</p>{findings}</li>"


def _figure(picture: Picture) -> str:
    data = base64.b64encode(figures.svg(picture.figure)).decode()
    width, height = (round(96 * inches) for inches in picture.figure.get_size_inches())
    return (
        f"<figure><figcaption><h3>{_text(picture.title)}</h3>{_text(picture.text)}</figcaption>"
        f"<img alt='{_text(picture.title)}. {_text(picture.text)}' width='{width}' height='{height}' "
        f"src='data:image/svg+xml;base64,{data}'></figure>"
    )


def _table(table: Table) -> str:
    left = [_reads_as_text([row[k] for row in table.rows]) for k in range(len(table.columns))]
    side = [" class='text'" if text else "" for text in left]
    heads = "".join(
        f"<th scope='col' aria-sort='none'{s}><button type='button'>{_text(column)}</button></th>"
        for s, column in zip(side, table.columns, strict=True)
    )
    rows = "".join(f"<tr>{''.join(map(_cell, row, left))}</tr>" for row in table.rows)
    name = "table-" + table.title.lower().replace(" ", "-")
    return (
        f"<div class='table'><h3 id='{name}'>{_text(table.title)}</h3><p class='quiet'>{_text(table.text)}</p>"
        f"<div class='scroll' role='region' aria-labelledby='{name}' tabindex='0'>"
        f"<table aria-labelledby='{name}'><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div></div>"
    )


def _reads_as_text(cells: Sequence[Cell]) -> bool:
    """Whether a column is aligned to the left."""
    return all(isinstance(c.order, str | None) for c in cells) or any(len(c.text) > WIDE for c in cells)


def _cell(cell: Cell, left: bool) -> str:
    classes = [c for c in (cell.mood, "text" if left else "", "wide" if len(cell.text) > WIDE else "") if c]
    if cell.order is None:
        key = "data-none"
    else:
        key = f"data-{'text' if isinstance(cell.order, str) else 'number'}='{_text(cell.order)}'"
    style = f" class='{' '.join(classes)}'" if classes else ""
    return f"<td{style} {key}>{_text(cell.text)}</td>"


def _matrices(found: Mapping[str, Any]) -> list[str]:
    """Tuned covariances, to be read; the others folded away."""
    made = []
    for stage, named in tune_tables.matrices(dict(found)).items():
        blocks = "".join(
            f"<h3>{_text(name)}</h3><div class='scroll' tabindex='0' role='region' aria-label='{_text(name)}, "
            f"{_text(stage)}'><pre class='matrix'>{_text(M)}</pre></div>"
            for name, M in named.items()
        )
        made.append(blocks if not made else f"<details><summary>{_text(stage)}</summary>{blocks}</details>")
    return made


def _settings(found: Mapping[str, Any]) -> str:
    settings = dict(found["settings"])
    theta, truth = settings.pop("theta", {}), settings.pop("truth_theta", {})
    if "confidence" in settings:
        settings["confidence"] = f"{100 * settings['confidence']:g} %"
    over = {f"{name} (swept)": ", ".join(map(_short, values)) for name, values in found.get("over", {}).items()}
    parts = [_list(settings | over)]
    if theta:
        parts.append(f"<h3>Parameters that the filters assume</h3>{_list(theta)}")
    if found.get("theta"):
        parts.append(f"<h3>All parameters, tuned and frozen</h3>{_list(found['theta'])}")
    if truth and truth != theta:
        parts.append(f"<h3>Parameters of the truth</h3>{_list(truth)}")
    return "".join(parts)


def _list(items: Mapping[str, Any]) -> str:
    pairs = (f"<div><dt>{_text(name)}</dt><dd>{_text(_short(value))}</dd></div>" for name, value in items.items())
    return f"<dl>{''.join(pairs)}</dl>"


def _short(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_short, value)) or "none"
    if isinstance(value, float):
        return f"{value:.6g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) and value < 1e12 else str(value)


def _again(found: Mapping[str, Any]) -> str:
    if not found["command"]:
        return ""
    return _section("To get the same again", f"<pre><code>{_text(found['command'])}</code></pre>")


def _made(found: Mapping[str, Any]) -> str:
    made, seconds = found["made_with"], found["seconds"]
    versions = ", ".join(f"{what} {version}" for what, version in made.items() if what not in ("platform", "device"))
    spent = f"compile {seconds['compile']:.1f} s, run {seconds['run']:.1f} s"
    return f"Made with {versions} on {made['device']}; {spent}."
