"""What the command line prints: a progress bar, verdicts, tables."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfilt import consistency
from jaxfilt.bound import Bound
from jaxfilt.consistency import Consistency
from jaxfilt.metrics import Whiteness
from jaxfilt.report.summary import least
from jaxfilt.review import Replayed
from jaxfilt.scores import STATE, Estimate
from jaxfilt.study import Study
from jaxfilt.sweep import Sweep
from jaxfilt.types import Status
from jaxfilt.verdict import Verdict

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID
    from rich.table import Table

COLOURS = {"inside": "green", "above": "red", "below": "yellow", "unknown": "dim"}


@contextlib.contextmanager
def progress_bar() -> Iterator[Callable[[int, int], None]]:
    """A spinner while it compiles, a bar while it runs; on stderr, and only where somebody looks."""
    with _bar() as (bar, task):

        def progress(done: int, total: int) -> None:
            speed = bar.tasks[task].speed
            rate = f", {speed:,.0f} runs/s" if speed else ""
            bar.update(task, description=f"{done:,} of {total:,} runs{rate}", completed=done, total=total)

        yield progress


@contextlib.contextmanager
def tuning_bar() -> Iterator[Callable[[int, int, float, float], None]]:
    """The same for the steps of a tuning, with the loss and that of the validation part."""
    with _bar() as (bar, task):

        def progress(step: int, steps: int, loss: float, validation: float) -> None:
            held = f", validation {validation:.5g}" if np.isfinite(validation) else ""
            text = f"step {step:,} of at most {steps:,}: loss {loss:.5g}{held}"
            bar.update(task, description=text, completed=step, total=steps)

        yield progress


@contextlib.contextmanager
def _bar() -> Iterator[tuple[Progress, TaskID]]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("left:"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        yield bar, bar.add_task("compiling", total=None)


def show(what: Any) -> None:
    """Print text or a table, with its markup."""
    from rich.console import Console

    Console(highlight=False).print(what)


def listing(lines: dict[str, str], title: str) -> None:
    """Names, each with a line about it."""
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=None, show_header=False, padding=(0, 2, 0, 0))
    for name, text in lines.items():
        table.add_row(f"[bold]{name}[/]", text)
    show(table)


def show_study(s: Study, title: str, bound: Bound | None) -> None:
    """Verdicts and a table: errors, consistency, divergence, by filter."""
    table = _table(title, list(s.scores))
    scores = list(s.scores.values())
    lost = {name: d.runs for name, d in s.diverged.items()}
    for block, (_, unit) in s.blocks.items():
        _row(table, _with_unit(f"RMSE {block}", unit), [_measured(c.rmse_total[block]) for c in scores])
        if any(lost.values()):
            _row(table, "  of runs not diverged", [_measured(c.rmse_total[block]) for c in s.kept.values()])
    if bound is not None:
        table.add_section()
        for block, (index, _) in s.blocks.items():
            square = [c.rmse_total[block].value ** 2 for c in s.kept.values()]
            limits = ({"bound": bound.cov} if bound.exact else {}) | {"linearised bound": bound.linearised}
            for name, cov in limits.items():
                mean = (least(cov, index) ** 2).mean()
                _row(table, f"{name} / MSE {block}", [f"{100 * mean / e:.0f} %" for e in square])
    table.add_section()
    for block, first in scores[0].nees_total.items():
        what = f"mean NEES ({first.expected:g})" if block == STATE else f"  {block} ({first.expected:g})"
        _row(table, what, [_judged(c.nees_total[block]) for c in scores])
    for sensor, score in scores[0].nis_total.items():
        _row(table, f"mean NIS {sensor} ({score.expected:g})", [_judged(c.nis_total[sensor]) for c in scores])
    table.add_section()
    _row(table, "log score", [_measured(c.log_score_total) for c in scores])
    _row(table, "diverged runs", [_count(n) for n in lost.values()])
    show(table)
    if bound is not None:
        print(f"Cramer-Rao bound: {bound.kind}")
    for (a, b), pair in s.paired.items():
        _show_pair(s, a, b, pair)
    for verdict in s.verdicts.values():
        _show_verdict(verdict)


def _show_pair(s: Study, a: str, b: str, pair: Any) -> None:
    """Which of two filters is the better one, where the difference is more than three of its standard errors."""
    said = []
    for block, (value, error) in pair.square.items():
        if abs(value) > 3 * error:
            better, share = (a, b) if value < 0 else (b, a), abs(value) / s.kept[a].rmse_total[block].value ** 2
            said.append(f"{better[0]} better in {block} ({100 * share:.2g} % of the mean squared error)")
    print(f"{a} and {b} on the same noise: {', '.join(said) or 'no difference that shows'}")


def show_sweep(sweep: Sweep, title: str) -> None:
    """A row for each setting: errors and consistency of each filter."""
    first: Study = sweep.studies.flat[0]
    table = _table(title, [f"{name}\n{what}" for name in first.scores for what in ("RMSE", "ANEES / n", "diverged")])
    block = next(iter(first.blocks))
    for index in np.ndindex(sweep.studies.shape):
        study: Study = sweep.studies[index]  # type: ignore[assignment]
        at = ", ".join(f"{name}={values[i]:g}" for (name, values), i in zip(sweep.over.items(), index, strict=True))
        cells = []
        for name, scores in study.scores.items():
            nees = scores.nees_total[STATE]
            colour = COLOURS[consistency.verdict(nees)]
            ratio = f"[{colour}]{nees.mean / nees.expected:.3g}[/]"
            cells += [f"{scores.rmse_total[block].value:.4g}", ratio, _count(study.diverged[name].runs)]
        _row(table, at, cells)
    show(table)
    print(f"RMSE of {_with_unit(block, first.blocks[block][1])}; ANEES / n is 1 for a consistent filter")


def show_replay(r: Replayed, title: str, gated: bool) -> None:
    """A table and verdicts: errors where there is a truth, innovations always."""
    table = _table(title, list(r.reviews))
    reviews = list(r.reviews.values())
    if r.truth is not None:
        for block, (_, unit) in r.blocks.items():
            _row(table, _with_unit(f"RMSE {block}", unit), [f"{v.rmse[block]:.4g}" for v in reviews if v.rmse])
        _row(table, f"mean NEES ({r.space.dim})", [_judged(v.nees_mean) for v in reviews if v.nees_mean])
        table.add_section()
    for sensor, score in reviews[0].nis.items():
        _row(table, f"mean NIS {sensor} ({score.expected:.4g})", [_judged(v.nis[sensor]) for v in reviews])
        _row(table, f"white at lags, {sensor}", [_white(v.whiteness[sensor]) for v in reviews])
        if gated:
            _row(table, f"refused, {sensor}", [_refused(v.refused[sensor], v.info[sensor].status) for v in reviews])
    table.add_section()
    _row(table, "diverged", ["[red]yes[/]" if v.diverged else "no" for v in reviews])
    show(table)
    for review in reviews:
        _show_verdict(review.verdict)


def _show_verdict(verdict: Verdict) -> None:
    from rich.console import Console
    from rich.text import Text

    out = Console(highlight=False, soft_wrap=True)
    out.print(Text(verdict.headline, style="bold green" if verdict.consistent else "bold red"))
    for finding in verdict.findings:
        if finding.text not in verdict.headline:
            out.print(Text(f"  {finding.text}"))


def _table(title: str, columns: list[str]) -> Table:
    from rich import box
    from rich.table import Table

    print(title)  # not the table's own title, which would be as narrow as the table
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("")
    for name in columns:
        table.add_column(name)
    return table


def _row(table: Table, label: str, cells: Iterable[str]) -> None:
    """A row; the label is a user's, and no markup."""
    from rich.text import Text

    table.add_row(Text(label), *cells)


def _with_unit(name: str, unit: str) -> str:
    return f"{name}, {unit}" if unit else name


def _measured(e: Estimate) -> str:
    """A value with its standard error."""
    return f"{e.value:.4g} [dim]± {e.error:.1g}[/]" if np.isfinite(e.error) else f"{e.value:.4g}"


def _judged(c: Consistency) -> str:
    """A mean with its verdict, and on a second line its bounds."""
    verdict = consistency.verdict(c)
    bounds = "" if verdict == "unknown" else f"\n[dim]{c.low:.4g} to {c.high:.4g}[/]"
    return f"{c.mean:.4g} [{COLOURS[verdict]}]{verdict}[/]{bounds}"


def _count(number: int) -> str:
    return f"[red]{number:,}[/]" if number else "0"


def _white(w: Whiteness) -> str:
    inside = int((np.abs(w.autocorrelation) <= w.bound).sum())
    colour = "green" if inside == len(w.lags) else "yellow"
    return f"[{colour}]{inside} of {len(w.lags)}[/]"


def _refused(refused: int, status: np.ndarray) -> str:
    there = int((np.asarray(status) != Status.ABSENT).sum())
    return f"{refused:,} of {there:,}"
