"""The figures of a study."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jaxfilt import metrics
from jaxfilt.bound import Bound
from jaxfilt.findings import count
from jaxfilt.report import drawing
from jaxfilt.report.drawing import BAND, COLOURS, EXPECTED, Picture, with_unit
from jaxfilt.report.summary import component_names, least
from jaxfilt.scores import STATE
from jaxfilt.study import Study
from jaxfilt.types import Gaussian

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CLAIMED: dict[str, Any] = {"linestyle": (0, (3, 2)), "linewidth": 1.0}
BOUND: dict[str, Any] = {"color": "0.1", "linestyle": (0, (1, 1.2)), "linewidth": 1.8}
LINEARISED: dict[str, Any] = {"color": "0.45", "linestyle": (0, (6, 2, 1, 2)), "linewidth": 1.0}

PEAK = float(1 / np.sqrt(2 * np.pi))
"""Density of the standard normal distribution at 0."""


def overview(s: Study, name: str, bound: Bound | None) -> Figure:
    """One picture: the first run, the errors by block, the consistency."""
    sensors = list(next(iter(s.scores.values())).nis)
    rows = max(len(s.blocks), 1 + len(sensors))
    fig = drawing.canvas(15, max(6.5, 1.9 * rows + 1.0))
    (track, wrong), errors, squares = drawing.columns(fig, [3, 1], [1] * len(s.blocks), [1] * (1 + len(sensors)))
    runs = count(s.runs, "run") if s.runs == s.planned else f"{s.runs:,} of {count(s.planned, 'run')}"
    fig.suptitle(
        drawing.written(f"{name or 'study'}: {runs} of {count(s.steps, 'step')}, {s.dtype}, seed {s.seed}"),
        fontweight="bold",
    )
    _draw_first_run(track, s)
    track.set_title("the first run: truth, estimates, 99 % ellipses", fontsize="medium")
    _draw_first_errors(wrong, s, 0)
    wrong.set_xlabel("time (s)")
    for axes, block in zip(errors, s.blocks, strict=True):
        _draw_rmse(axes, s, block, bound)
    errors[0].set_title(_explained(bound), fontsize="medium")
    drawing.share_time(errors, s.t)
    drawing.draw_ratio(squares[0], s.t, [c.nees[STATE] for c in s.scores.values()])
    squares[0].set_ylabel("ANEES / n")
    for axes, sensor in zip(squares[1:], sensors, strict=True):
        drawing.draw_ratio(axes, s.t, [c.nis[sensor] for c in s.scores.values()])
        axes.set_ylabel(drawing.written(f"ANIS {sensor} / m"))
    squares[0].set_title(f"consistency, 1 if all is well, with {100 * s.confidence:g} % bounds", fontsize="medium")
    drawing.share_time(squares, s.t)
    lost = {f: s.diverged[f].runs for f in s.scores}
    names = [f"{f} ({n:,} of {s.runs:,} runs diverged)" if n else f for f, n in lost.items()]
    drawing.legend(fig, drawing.of_filters(names) | {"truth": {"color": "0.6", "linewidth": 3}}, len(names) + 1)
    return fig


def figures(s: Study, bound: Bound | None) -> list[Picture]:
    """Those of the page, one question each."""
    percent = f"{100 * s.confidence:g} %"
    pictures = [
        _rmse(s, bound),
        _nees(s, percent),
        _nis(s, percent),
        _coverage(s, percent),
        _first_run(s),
        _first_errors(s),
        _histograms(s),
        _whiteness(s, percent),
        _run_nees(s),
    ]
    return [picture for picture in pictures if picture is not None]


def _explained(bound: Bound | None) -> str:
    return "RMSE over the runs; dashed: claimed" + ("" if bound is None else "; dotted: bound")


def _rmse(s: Study, bound: Bound | None) -> Picture:
    fig, panels = drawing.grid(len(s.blocks))
    for axes, block in zip(panels, s.blocks, strict=True):
        _draw_rmse(axes, s, block, bound)
    drawing.share_time(panels, s.t)
    entries: dict[str, Any] = {f: {"color": c, "linewidth": 1.6} for f, c in zip(s.scores, _colours(s), strict=True)}
    entries["claimed by the filter"] = CLAIMED | {"color": "0.4"}
    text = "Root mean square error by block over time, within two standard errors, beside what the filters expect"
    if bound is not None:
        entries[f"{'bound' if bound.exact else 'approximate bound'}"] = BOUND
        text += " and the posterior Cramer-Rao bound"
        if not np.allclose(bound.cov, bound.linearised, rtol=1e-3):
            entries["linearised at the truth"] = LINEARISED
    drawing.legend(fig, entries, 3)
    return Picture("Error over time", text + ".", fig)


def _draw_rmse(axes: Axes, s: Study, block: str, bound: Bound | None) -> None:
    """Solid the error, dashed the claim; the earlier a filter the broader its line, so that equal ones are seen."""
    index, unit = s.blocks[block]
    series = []
    for k, (c, colour) in enumerate(zip(s.scores.values(), _colours(s), strict=True)):
        rmse, error = c.rmse[block]
        width = 1.2 + 0.8 * (len(s.scores) - 1 - k)
        axes.fill_between(s.t, rmse - 2 * error, rmse + 2 * error, color=colour, alpha=0.15, linewidth=0)
        drawing.line(axes, s.t, rmse, color=colour, linewidth=width)
        axes.plot(s.t, c.claimed[block], color=colour, **CLAIMED)
        series += [rmse, c.claimed[block]]
    if bound is not None:
        if not np.allclose(bound.cov, bound.linearised, rtol=1e-3):
            axes.plot(s.t, least(bound.linearised, index), **LINEARISED)
        axes.plot(s.t, least(bound.cov, index), **BOUND)
    drawing.from_zero(axes, series)
    axes.set_ylabel(with_unit(block, unit))


def _nees(s: Study, percent: str) -> Picture:
    parts = [STATE, *(b for b, (index, _) in s.blocks.items() if len(index) < s.space.dim)]
    fig, panels = drawing.grid(len(parts))
    for axes, part in zip(panels, parts, strict=True):
        drawing.draw_ratio(axes, s.t, [c.nees[part] for c in s.scores.values()])
        axes.set_ylabel(drawing.written(part))
    drawing.share_time(panels, s.t)
    drawing.legend(fig, drawing.of_filters(list(s.scores)))
    text = (
        f"Average normalised estimation error squared (ANEES) over its expectation, with {percent} bounds: above 1 "
        "the filter is overconfident, below it is too cautious."
    )
    return Picture("Is the filter as good as it claims? (ANEES)", text, fig)


def _nis(s: Study, percent: str) -> Picture:
    sensors = list(next(iter(s.scores.values())).nis)
    fig, panels = drawing.grid(len(sensors))
    for axes, sensor in zip(panels, sensors, strict=True):
        drawing.draw_ratio(axes, s.t, [c.nis[sensor] for c in s.scores.values()])
        axes.set_ylabel(drawing.written(sensor))
    drawing.share_time(panels, s.t)
    drawing.legend(fig, drawing.of_filters(list(s.scores)))
    text = f"Average normalised innovation squared (ANIS) by sensor over its expectation, with {percent} bounds."
    return Picture("Are the readings where they are expected? (ANIS)", text, fig)


def _coverage(s: Study, percent: str) -> Picture:
    levels = list(next(iter(s.scores.values())).coverage)
    fig, panels = drawing.grid(len(levels))
    for axes, level in zip(panels, levels, strict=True):
        first = next(iter(s.scores.values())).coverage[level]
        axes.fill_between(s.t, 100 * first.low, 100 * first.high, **BAND)
        axes.axhline(100 * level, **EXPECTED)
        for style, c in zip(drawing.styles(0.9), s.scores.values(), strict=False):
            drawing.line(axes, s.t, 100 * c.coverage[level].mean, **style)
        axes.yaxis.set_major_formatter("{x:g} %")
        axes.set_ylabel(f"{100 * level:g} %")
    drawing.share_time(panels, s.t)
    drawing.legend(fig, drawing.of_filters(list(s.scores)))
    text = f"Share of the runs whose error is inside the credible ellipsoid of a probability, with {percent} bounds."
    return Picture("Coverage of the credible ellipsoids", text, fig)


def _histograms(s: Study) -> Picture:
    names = component_names(s.blocks, s.space.dim)
    fig, panels = drawing.grid(len(names), 2 if len(names) > 1 else 1, height=1.5)
    for i, (axes, name) in enumerate(zip(panels, names, strict=True)):
        highest = PEAK
        for style, c in zip(drawing.styles(), s.scores.values(), strict=False):
            edges, counts = c.histogram.edges, c.histogram.counts[i]
            if counts.sum():
                density = counts / counts.sum() / np.diff(edges)
                axes.stairs(density, edges, **style)
                highest = max(highest, density[1:-1].max())  # the last bins, if tall, end outside
        axes.set_ylim(0, 1.1 * highest)
        x = np.linspace(-4, 4, 161)
        axes.plot(x, PEAK * np.exp(-0.5 * x**2), **EXPECTED)
        axes.set_title(drawing.written(name), fontsize="small")
        axes.set_yticks([])
        axes.set_xticks([-4, -2, 0, 2, 4])
    drawing.legend(fig, drawing.of_filters(list(s.scores)) | {"standard normal": EXPECTED})
    text = "Distribution of the errors over their claimed standard deviations; what is beyond 4 is in the last bins."
    return Picture("Normalised errors", text, fig)


def _whiteness(s: Study, percent: str) -> Picture:
    sensors = list(next(iter(s.scores.values())).whiteness)
    fig, panels = drawing.grid(len(sensors))
    for axes, sensor in zip(panels, sensors, strict=True):
        drawing.draw_whiteness(axes, [c.whiteness[sensor] for c in s.scores.values()])
        axes.set_ylabel(drawing.written(sensor))
    panels[-1].set_xlabel("lag (readings)")
    drawing.legend(fig, drawing.of_filters(list(s.scores)))
    text = f"Autocorrelation of the normalised innovations by sensor, with {percent} bounds: 0 if white."
    return Picture("Are the innovations white?", text, fig)


def _run_nees(s: Study) -> Picture:
    fig, (axes,) = drawing.grid(1, height=2.4)
    reached = [0.5, 2.0]
    for style, c in zip(drawing.styles(), s.scores.values(), strict=False):
        edges, counts = c.run_nees.edges, c.run_nees.counts
        if counts.sum():
            axes.stairs(100 * counts / counts.sum(), edges, **style)
            there = np.flatnonzero(counts)
            reached += [float(edges[there[0]]) / 1.1, float(edges[there[-1] + 1]) * 1.1]
    axes.axvline(1.0, **EXPECTED)
    axes.set_xlim(min(reached), max(reached))
    drawing.logarithmic(axes, "x")
    axes.set_xlabel("average NEES of a run over its expectation")
    axes.set_ylabel("runs (%)")
    drawing.legend(fig, drawing.of_filters(list(s.scores)))
    text = "Each run's own average NEES over its expectation; a second hill on the right is of runs that went astray."
    return Picture("Spread between runs", text, fig)


def _colours(s: Study) -> list[str]:
    return [COLOURS[k % len(COLOURS)] for k in range(len(s.scores))]


# --- the first run ----------------------------------------------------------------------------------------------------


def _first_run(s: Study) -> Picture | None:
    if not _kept_runs(s):
        return None
    fig, (axes,) = drawing.grid(1, height=3.6)
    _draw_first_run(axes, s)
    drawing.legend(fig, drawing.of_filters(list(s.scores)) | {"truth": {"color": "0.6", "linewidth": 3}})
    mapped = len(drawing.place(s.blocks)[1]) > 1
    text = "Truth and estimates of the first run" + (", with 99 % credible ellipses." if mapped else " over time.")
    return Picture("The first run", text, fig)


def _first_errors(s: Study) -> Picture | None:
    if not _kept_runs(s):
        return None
    shown = min(s.space.dim, 6)
    fig, panels = drawing.grid(shown)
    for i, axes in enumerate(panels):
        _draw_first_errors(axes, s, i)
    drawing.share_time(panels, s.t)
    drawing.legend(fig, drawing.of_filters(list(s.scores)))
    of = "" if shown == s.space.dim else f", the first {shown} components"
    text = f"Truth minus estimate within three claimed standard deviations{of}."
    return Picture("Errors of the first run", text, fig)


def _tracks(s: Study) -> list[Gaussian]:
    """In the order of the filters, in which JAX does not keep them."""
    return [s.tracks[name] for name in s.scores]


def _kept_runs(s: Study) -> int:
    return len(jax.tree.leaves(s.truth)[0])


def _draw_first_run(axes: Axes, s: Study) -> None:
    if not _kept_runs(s):
        drawing.note(axes, "no run was kept whole")
        return
    first = lambda x: jax.tree.map(lambda a: a[0], x)  # noqa: E731
    tracks = [(drawing.coordinates(s.space, first(b.mean)), np.asarray(b.cov[0])) for b in _tracks(s)]
    drawing.draw_track(axes, s.blocks, s.t, drawing.coordinates(s.space, first(s.truth)), tracks)


def _draw_first_errors(axes: Axes, s: Study, component: int) -> None:
    if not _kept_runs(s):
        drawing.note(axes, "no run was kept whole")
        return
    first = lambda x: jax.tree.map(lambda a: a[0], x)  # noqa: E731
    errors, stds = [], []
    for b in _tracks(s):
        errors.append(np.asarray(metrics.errors(s.space, first(s.truth), first(b.mean)))[:, component])
        variance = np.asarray(b.cov[0])[:, component, component]
        stds.append(np.sqrt(np.where(variance >= 0, variance, np.nan)))
    drawing.draw_error(axes, s.t, errors, stds)
    name = component_names(s.blocks, s.space.dim)[component]
    unit = next((unit for index, unit in s.blocks.values() if component in index), "")
    axes.set_ylabel(with_unit(name, unit))
