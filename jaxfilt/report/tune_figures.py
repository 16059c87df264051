"""The figures of a tuning: the way down, the parameters, and what they score on the data that they did not see."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfilt.consistency import Consistency
from jaxfilt.fit import BEFORE, ESTIMATED, TEST, TRAIN, TRUE, TUNED, VALIDATION, Fit, Parameter, PartScores
from jaxfilt.report import drawing
from jaxfilt.report.drawing import BAND, COLOURS, EXPECTED, Picture, written

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKS: dict[str, dict[str, Any]] = {
    BEFORE: {"color": "0.45", "marker": "o"},
    ESTIMATED: {"color": COLOURS[4], "marker": "s"},
    TUNED: {"color": COLOURS[0], "marker": "D"},
    TRUE: {"color": COLOURS[2], "marker": "*"},
}
"""How each stage is drawn."""

TRAINING: dict[str, Any] = {"color": COLOURS[0], "linestyle": "-", "linewidth": 1.3}
HELD_OUT: dict[str, Any] = {"color": COLOURS[1], "linestyle": "--", "linewidth": 1.3}
REFUSED: dict[str, Any] = {"color": "#A40E26", "marker": "x", "linestyle": "none", "markersize": 6}
KEPT: dict[str, Any] = {"color": COLOURS[2], "linestyle": ":", "linewidth": 1.5}

NARROW = 8.0
"""Loss of the first step over the range of the later ones from which on the axis shows these."""

LEAST = 0.05
"""An RMSE is drawn on an axis that shows at least so large a share of it up and down: less is no difference."""

FAR = 3.0
"""Error bars are cut off at so many times the reach of the parameters."""


def overview(fit: Fit, name: str) -> Figure:
    """One picture: the way down, the parameters, the scores."""
    scores = _drawn_scores(fit)
    rows = len(fit.parameters)
    fig = drawing.canvas(15, max(6.5, 0.28 * rows + 2.0, 1.7 * len(scores) + 1.0))
    down, (parameters,), held = drawing.columns(fig, [1.6, 1.0], [1], [1] * len(scores))
    fig.suptitle(written(f"{name or 'tuning'}: {fit.objective}, {fit.optimizer}, {fit.stopped}"), fontweight="bold")
    _draw_descent(down, fit)
    down[0].set_title("the way down", fontsize="medium")
    _draw_parameters(parameters, fit)
    parameters.set_title("parameters, with two standard errors", fontsize="medium")
    _draw_scores(held, fit, scores)
    held[0].set_title(f"scores on the {_part(fit)} part", fontsize="medium")
    drawing.legend(fig, _legend_of_descent(fit) | _legend_of_stages(fit), across=8)
    return fig


def figures(fit: Fit) -> list[Picture]:
    """Those of the page, one question each."""
    fig, panels = drawing.grid(2, height=1.9)
    _draw_descent(panels, fit)
    drawing.legend(fig, _legend_of_descent(fit))
    text = "Loss over the steps, and norm of its gradient; the dotted line is the step that was kept."
    pictures = [Picture("The way down", text, fig)]
    fig, (axes,) = drawing.grid(1, height=0.24 * len(fit.parameters) + 1.0)
    _draw_parameters(axes, fit)
    drawing.legend(fig, _legend_of_stages(fit))
    text = f"{_centre(fit)[1].capitalize()}, with two standard errors ({fit.errors_by})."
    pictures.append(Picture("Parameters", text, fig))
    scores = _drawn_scores(fit)
    fig, panels = drawing.grid(len(scores), across=2, height=1.5)
    _draw_scores(panels, fit, scores)
    for axes in panels:
        axes.set_xticks([])
    drawing.legend(fig, {stage: MARKS[stage] | {"linestyle": "none"} for stage in _stages(fit)})
    text = f"By stage, on the {_part(fit)} part; grey bands where a consistent filter is; bars are two standard errors."
    pictures.append(Picture("What it is worth", text, fig))
    if len(fit.starts) > 1:
        fig, (axes,) = drawing.grid(1, height=1.8)
        _draw_starts(axes, fit)
        pictures.append(Picture("Starts", "Final loss of each start, sorted; the best one was kept.", fig))
    return pictures


def _part(fit: Fit) -> str:
    """The part that tells most: of test, validation and train the first that there is."""
    return next((p for p in (TEST, VALIDATION) if any(p in parts for parts in fit.scores.values())), TRAIN)


def _stages(fit: Fit) -> dict[str, PartScores]:
    part = _part(fit)
    return {stage: parts[part] for stage, parts in fit.scores.items() if part in parts}


def _legend_of_descent(fit: Fit) -> dict[str, dict[str, Any]]:
    entries = {"train": TRAINING}
    if np.isfinite(fit.history.validation).any():
        entries["validation"] = HELD_OUT
    if np.any(fit.history.refused):
        entries["step refused"] = REFUSED
    return entries | {"kept": KEPT}


def _legend_of_stages(fit: Fit) -> dict[str, dict[str, Any]]:
    there = {
        BEFORE: True,
        ESTIMATED: any(p.estimated is not None for p in fit.parameters),
        TUNED: True,
        TRUE: any(p.true is not None for p in fit.parameters),
    }
    return {stage: MARKS[stage] | {"linestyle": "none"} for stage in MARKS if there[stage]}


def _draw_descent(panels: Sequence[Axes], fit: Fit) -> None:
    loss, gradient = panels
    h, k = fit.history, np.arange(1, len(fit.history.loss) + 1)
    refused = np.asarray(h.refused, bool)
    drawing.line(loss, k, np.asarray(h.loss, float), **TRAINING)
    drawing.line(loss, k, np.asarray(h.validation, float), **HELD_OUT)
    seen = [h.loss, h.validation]
    low, high = _shown(seen, fit)
    loss.set_ylim(low, high)
    # Where a step was refused the loss is that of before, or none: the mark goes to the top, where it hides nothing.
    if refused.any():
        loss.plot(k[refused], np.full(refused.sum(), high), clip_on=False, **REFUSED)
    drawing.line(gradient, k, np.where(np.asarray(h.gradient) > 0, h.gradient, np.nan), **TRAINING)
    if len(drawing.finite([gradient.lines[0].get_ydata()])):
        drawing.logarithmic(gradient)
    for axes in panels:
        axes.axvline(fit.best, **KEPT)
    loss.set_ylabel(written(f"loss: {fit.objective}"))
    gradient.set_ylabel("gradient")
    gradient.set_xlabel("step")
    loss.sharex(gradient)
    loss.tick_params(labelbottom=False)
    gradient.locator_params(axis="x", integer=True)


def _shown(series: Sequence[np.ndarray], fit: Fit) -> tuple[float, float]:
    """Limits of the loss: all of it, unless its beginning is so far up that nothing else would be seen."""
    values = drawing.finite(series)
    if not len(values):
        return 0.0, 1.0
    later = drawing.finite([a[len(a) // 5 :] for a in series])
    low, high = float(values.min()), float(values.max())
    end = float(later.max()) if len(later) else high
    if high - low > NARROW * (end - low) > 0:
        high = low + 1.5 * (end - low)
    margin = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    return low - margin, high + margin


def _centre(fit: Fit) -> tuple[dict[str, float], str]:
    """What parameters are drawn relative to, and that in words."""
    if all(p.true is not None for p in fit.parameters):
        return {p.name: float(p.true or 0.0) for p in fit.parameters}, "difference from the truth"
    return {p.name: p.value for p in fit.parameters}, "difference from the tuned value"


def _draw_parameters(axes: Axes, fit: Fit) -> None:
    """A row for each parameter, the first on top."""
    centre, words = _centre(fit)
    rows = np.arange(len(fit.parameters))[::-1]
    axes.axvline(0.0, **EXPECTED)
    reach = 0.0
    for stage, field in ((BEFORE, "start"), (ESTIMATED, "estimated"), (TRUE, "true"), (TUNED, "value")):
        found = [getattr(p, field) for p in fit.parameters]
        x = np.array([np.nan if v is None else v - centre[p.name] for v, p in zip(found, fit.parameters, strict=True)])
        size = 7 if stage == TRUE else 4.5
        axes.plot(x, rows, linestyle="none", markersize=size, zorder=4 if stage == TUNED else 3, **MARKS[stage])
        reach = max([reach, *np.abs(drawing.finite([x]))])
    reach = 1.15 * reach or 1.0
    for row, p in zip(rows, fit.parameters, strict=True):
        _draw_error_bar(axes, p, row, p.value - centre[p.name], FAR * reach)
    axes.set_xlim(-reach, reach)
    axes.set_yticks(rows, [written(p.name) for p in fit.parameters])
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.set_xlabel(words)


def _draw_error_bar(axes: Axes, p: Parameter, row: int, x: float, longest: float) -> None:
    if np.isfinite(x) and not np.isnan(p.error):
        half = min(2 * p.error, longest)
        axes.plot([x - half, x + half], [row, row], color=MARKS[TUNED]["color"], linewidth=1.8, alpha=0.6)


def _drawn_scores(fit: Fit) -> list[tuple[str, dict[str, tuple]]]:
    """Panels: label, and stage -> (value, half of a bar, low, high of a band)."""
    stages = _stages(fit)
    one = next(iter(stages.values()))
    panels: list[tuple[str, dict[str, tuple]]] = [
        (f"loss: {fit.objective}", {stage: (s.loss, np.nan, np.nan, np.nan) for stage, s in stages.items()})
    ]
    for block in one.rmse or {}:
        unit = fit.blocks[block][1] if fit.blocks else ""
        rmse = {stage: (s.rmse[block], np.nan, np.nan, np.nan) for stage, s in stages.items() if s.rmse}
        panels.append((f"RMSE {block} ({unit})" if unit else f"RMSE {block}", rmse))
    if one.log_score is not None:
        scored = {
            k: (s.log_score.value, 2 * s.log_score.error, np.nan, np.nan) for k, s in stages.items() if s.log_score
        }
        panels.append(("log score", scored))
    if one.nees is not None:
        panels.append(("ANEES / n", {stage: _ratio(s.nees) for stage, s in stages.items() if s.nees}))
    for sensor in one.nis:
        panels.append((f"ANIS / m {sensor}", {stage: _ratio(s.nis[sensor]) for stage, s in stages.items()}))
    return panels


def _ratio(score: Consistency) -> tuple[float, float, float, float]:
    scale = score.expected if score.expected else np.nan
    return score.mean / scale, np.nan, score.low / scale, score.high / scale


def _draw_scores(panels: Sequence[Axes], fit: Fit, scores: Sequence[tuple[str, dict[str, tuple]]]) -> None:
    names = list(_stages(fit))
    for axes, (label, found) in zip(panels, scores, strict=True):
        for k, stage in enumerate(names):
            value, half, low, high = found.get(stage, (np.nan,) * 4)
            if np.isfinite([low, high]).all():
                axes.fill_between([k - 0.3, k + 0.3], low, high, **BAND)
            if np.isfinite(value):
                axes.errorbar(k, value, yerr=half if np.isfinite(half) else None, markersize=6, **MARKS[stage])
        values = drawing.finite([[v[0] for v in found.values()]])
        if label.startswith("AN"):
            axes.axhline(1.0, **EXPECTED)
        if not len(values):
            drawing.note(axes, "nothing that is finite")
        elif values.min() > 0 and values.max() > 5 * values.min():
            drawing.logarithmic(axes)
        elif label.startswith("RMSE"):
            middle = 0.5 * (values.max() + values.min())
            half = max(0.6 * (values.max() - values.min()), LEAST * middle)
            axes.set_ylim(middle - half, middle + half)
        axes.set_ylabel(written(label), fontsize="small")
        axes.set_xlim(-0.5, len(names) - 0.5)
        axes.set_xticks(range(len(names)), names)
    for axes in panels[:-1]:
        axes.tick_params(labelbottom=False)


def _draw_starts(axes: Axes, fit: Fit) -> None:
    final = np.sort(np.asarray(fit.starts, float))  # NaN, a start that came to nothing, sorts last
    axes.plot(np.arange(1, len(final) + 1), final, "o", color=COLOURS[0])
    lost = int(np.isnan(final).sum())
    if lost:
        drawing.note(axes, f"{lost} of {len(final)} came to nothing")
    axes.set_xlim(0.5, len(final) + 0.5)
    axes.locator_params(axis="x", integer=True)
    axes.set_xlabel("start, sorted")
    axes.set_ylabel("final loss")
