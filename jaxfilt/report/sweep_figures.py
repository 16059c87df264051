"""The figures of a sweep: errors and consistency over one parameter as curves, over two as maps."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfilt.report import drawing
from jaxfilt.report.drawing import BAND, EXPECTED, Picture, with_unit
from jaxfilt.scores import STATE
from jaxfilt.study import Study
from jaxfilt.sweep import Sweep

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDE = 5.0
"""Largest over smallest value from which on an axis is logarithmic."""


def overview(w: Sweep, name: str) -> Figure:
    """One picture: RMSE and consistency over the parameter, or as maps over the first two."""
    s: Study = w.studies.flat[0]
    blocks, sensors, filters = list(s.blocks), _sensors(s), list(s.scores)
    title = f"{name or 'sweep'}: {s.runs:,} runs of {s.steps:,} steps at each of {w.studies.size:,} settings"
    if len(w.over) == 1:
        fig = drawing.canvas(15, max(5.0, 2.0 * max(len(blocks), 1 + len(sensors)) + 1.0))
        errors, squares = drawing.columns(fig, [1] * len(blocks), [1] * (1 + len(sensors)))
        _draw_errors(errors, w)
        errors[0].set_title("RMSE; dashed: claimed by the filter", fontsize="medium")
        _draw_nees(squares[:1], w, [STATE])
        squares[0].set_ylabel("ANEES / n")
        _draw_nis(squares[1:], w)
        squares[0].set_title(f"consistency, with {100 * s.confidence:g} % bounds", fontsize="medium")
        for column in (errors, squares):
            _share(column, w)
        drawing.legend(fig, drawing.of_filters(filters))
    else:
        fig = drawing.canvas(4.0 * (len(blocks) + 1), 3.2 * len(filters) + 0.6)
        for f, filt in enumerate(filters):
            for k, (label, unit, score) in enumerate(_maps(s, filt)):
                axes = fig.add_subplot(len(filters), len(blocks) + 1, f * (len(blocks) + 1) + k + 1)
                _draw_map(fig, axes, w, score, ratio=label == "ANEES / n")
                axes.set_title(drawing.written(f"{filt}: ") + with_unit(label, unit), fontsize="medium")
    fig.suptitle(drawing.written(title), fontweight="bold")
    return fig


def figures(w: Sweep) -> list[Picture]:
    """Those of the page, one question each."""
    return _curves(w) if len(w.over) == 1 else _all_maps(w)


def _curves(w: Sweep) -> list[Picture]:
    s: Study = w.studies.flat[0]
    (parameter,) = w.over
    percent, parts = f"{100 * s.confidence:g} %", [STATE, *s.blocks]
    fig, panels = drawing.grid(len(s.blocks), height=1.6)
    _draw_errors(panels, w)
    _share(panels, w)
    entries = drawing.of_filters(list(s.scores)) | {"claimed": {"color": "0.4", "linestyle": (0, (3, 2))}}
    drawing.legend(fig, entries)
    text = f"Root mean square error by block over {parameter}, with two standard errors, and what the filter expects."
    pictures = [Picture("Error over the parameter", text, fig)]
    fig, panels = drawing.grid(len(parts), height=1.6)
    _draw_nees(panels, w, parts)
    _share(panels, w)
    drawing.legend(fig, drawing.of_filters(list(s.scores)))
    text = f"Average normalised estimation error squared over its expectation, with {percent} bounds: 1 if consistent."
    pictures.append(Picture("Consistency over the parameter (ANEES)", text, fig))
    fig, panels = drawing.grid(len(_sensors(s)), height=1.6)
    _draw_nis(panels, w)
    _share(panels, w)
    drawing.legend(fig, drawing.of_filters(list(s.scores)))
    text = f"Average normalised innovation squared by sensor over its expectation, with {percent} bounds."
    return [*pictures, Picture("Innovations over the parameter (ANIS)", text, fig)]


def _all_maps(w: Sweep) -> list[Picture]:
    s: Study = w.studies.flat[0]
    pictures = []
    for filt in s.scores:
        for label, unit, score in _maps(s, filt):
            fig, (axes,) = drawing.grid(1, height=3.0)
            _draw_map(fig, axes, w, score, ratio=label == "ANEES / n")
            what = "ANEES over its expectation, 1 if consistent" if label == "ANEES / n" else label
            text = f"{what}{f' in {unit}' if unit else ''}, {filt}, over {' and '.join(list(w.over)[:2])}{_slice(w)}."
            pictures.append(Picture(f"{filt}: {label}", text, fig))
    return pictures


def _sensors(s: Study) -> list[str]:
    return list(next(iter(s.scores.values())).nis_total)


def _maps(s: Study, filt: str) -> list[tuple[str, str, Callable[[Study], float]]]:
    """Label, unit and score of each map of a filter."""
    maps: list[tuple[str, str, Callable[[Study], float]]] = [
        ("ANEES / n", "", lambda s: s.scores[filt].nees_total[STATE].mean / s.space.dim)
    ]
    for block, (_, unit) in s.blocks.items():
        maps.append((f"RMSE {block}", unit, lambda s, b=block: s.scores[filt].rmse_total[b].value))
    return maps


def _positions(values: np.ndarray) -> tuple[np.ndarray, bool]:
    """Where values lie on an axis, and whether it is logarithmic; what is no number stands one by one."""
    if not np.issubdtype(values.dtype, np.number):
        return np.arange(len(values)), False
    return values, bool((values > 0).all() and values.max() >= WIDE * values.min())


def _share(column: list[Axes], w: Sweep) -> None:
    ((parameter, values),) = w.over.items()
    x, wide = _positions(values)
    for axes in column[:-1]:
        axes.sharex(column[-1])
        axes.tick_params(labelbottom=False)
    if wide:
        column[-1].set_xscale("log")
    if x is not values:
        column[-1].set_xticks(x, [drawing.written(str(v)) for v in values])
    elif len(x) <= 8:
        column[-1].set_xticks(x, [f"{v:g}" for v in x])
        column[-1].set_xticks([], minor=True)
    column[-1].set_xlabel(drawing.written(parameter))


def _draw_errors(panels: list[Axes], w: Sweep) -> None:
    s: Study = w.studies.flat[0]
    x, _ = _positions(next(iter(w.over.values())))
    for axes, (block, (_, unit)) in zip(panels, s.blocks.items(), strict=True):
        shown = []
        for style, filt in zip(drawing.styles(), s.scores, strict=False):
            of = lambda s, f=filt, b=block: s.scores[f].rmse_total[b]  # noqa: E731
            value, error = w.curve(lambda s, of=of: of(s).value), w.curve(lambda s, of=of: of(s).error)
            claimed = w.curve(lambda s, f=filt, b=block: np.sqrt(np.nanmean(s.scores[f].claimed[b] ** 2)))
            axes.errorbar(x, value, 2 * error, **style, marker="o", markersize=3, elinewidth=0.8)
            axes.plot(x, claimed, color=style["color"], linestyle=(0, (3, 2)), linewidth=0.9)
            shown += [value, claimed]
        drawing.from_zero(axes, shown)
        axes.set_ylabel(with_unit(block, unit))


def _draw_nees(panels: list[Axes], w: Sweep, parts: list[str]) -> None:
    for axes, part in zip(panels, parts, strict=True):
        _draw_tests(axes, w, lambda s, f, part=part: s.scores[f].nees_total[part])
        axes.set_ylabel(drawing.written(part))


def _draw_nis(panels: list[Axes], w: Sweep) -> None:
    for axes, sensor in zip(panels, _sensors(w.studies.flat[0]), strict=True):
        _draw_tests(axes, w, lambda s, f, sensor=sensor: s.scores[f].nis_total[sensor])
        axes.set_ylabel(drawing.written(sensor))


def _draw_tests(axes: Axes, w: Sweep, test: Callable[[Study, str], Any]) -> None:
    """Means over their expectations, with each filter's bounds in its colour."""
    x, _ = _positions(next(iter(w.over.values())))
    ratios = []
    for style, filt in zip(drawing.styles(), w.studies.flat[0].scores, strict=False):
        mean, low, high = (
            w.curve(lambda s, f=filt, of=of: getattr(test(s, f), of) / test(s, f).expected)
            for of in ("mean", "low", "high")
        )
        axes.fill_between(x, low, high, **(BAND | {"color": style["color"], "alpha": 0.15}))
        drawing.line(axes, x, mean, **style)
        ratios += [mean, low, high]
    axes.axhline(1.0, **EXPECTED)
    values = drawing.finite(ratios)
    if len(values) and values.min() > 0 and values.max() > 5 * values.min():
        drawing.logarithmic(axes)


def _slice(w: Sweep) -> str:
    """At which values of the parameters after the second a map is drawn: the middle ones."""
    rest = [f"{name} = {values[len(values) // 2]}" for name, values in list(w.over.items())[2:]]
    return f" at {', '.join(rest)}" if rest else ""


def _draw_map(fig: Figure, axes: Axes, w: Sweep, score: Callable[[Study], float], ratio: bool) -> None:
    """Colours and figures over the first two parameters; of a ratio, around 1 on a logarithmic scale."""
    from matplotlib.colors import LogNorm

    (first, rows), (second, columns) = list(w.over.items())[:2]
    values = w.curve(score)
    values = values[(slice(None), slice(None), *(len(v) // 2 for v in list(w.over.values())[2:]))]
    known = drawing.finite([values])
    norm = None
    if ratio and len(known) and known.min() > 0:
        reach = max(2.0, known.max(), 1 / known.min())
        norm = LogNorm(1 / reach, reach)
    image = axes.imshow(values, origin="lower", aspect="auto", cmap="RdBu_r" if ratio else "viridis", norm=norm)
    axes.grid(False)
    shade = np.asarray(image.to_rgba(np.ma.masked_invalid(values)))[..., :3] @ [0.299, 0.587, 0.114]
    for k in np.ndindex(values.shape):
        colour = "0.1" if shade[k] > 0.5 else "1"
        axes.text(k[1], k[0], f"{values[k]:.3g}", ha="center", va="center", color=colour, fontsize="small")
    axes.set_xticks(range(len(columns)), [drawing.written(_short(v)) for v in columns])
    axes.set_yticks(range(len(rows)), [drawing.written(_short(v)) for v in rows])
    axes.set_xlabel(drawing.written(second))
    axes.set_ylabel(drawing.written(first))


def _short(value: Any) -> str:
    return f"{value:.3g}" if np.issubdtype(np.asarray(value).dtype, np.number) else str(value)
