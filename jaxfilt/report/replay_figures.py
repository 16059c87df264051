"""The figures of a replay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxfilt import chisquare, metrics
from jaxfilt.report import drawing
from jaxfilt.report.drawing import EXPECTED, Picture, with_unit
from jaxfilt.report.summary import component_names
from jaxfilt.review import Replayed
from jaxfilt.types import Info

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN = 6
"""Components of the state whose errors are drawn."""


def overview(r: Replayed, name: str) -> Figure:
    """One picture: the track, the errors, the innovations."""
    sensors = _sensors(r)
    shown = _components(r)
    fig = drawing.canvas(15, max(6.5, 1.9 * max(len(shown), 2 * len(sensors)) + 1.0))
    (track,), errors, checks = drawing.columns(fig, [1], [1] * len(shown), [1] * (2 * len(sensors)))
    t = _time(r)
    fig.suptitle(
        drawing.written(f"{name or 'replay'}: {len(t):,} rows over {t[-1]:,.0f} s, {r.dtype}"), fontweight="bold"
    )
    _draw_track(track, r)
    track.set_title("track", fontsize="medium")
    _draw_errors(errors, r)
    errors[0].set_title(_of_errors(r), fontsize="medium")
    for axes, sensor in zip(checks[::2], sensors, strict=True):
        _draw_nis(axes, t, [review.info[sensor] for review in r.reviews.values()], r.confidence)
        axes.set_ylabel(drawing.written(f"NIS {sensor}"))
        axes.set_xlabel("time (s)")
    for axes, sensor in zip(checks[1::2], sensors, strict=True):
        drawing.draw_whiteness(axes, [review.whiteness[sensor] for review in r.reviews.values()])
        axes.set_ylabel(drawing.written(f"whiteness {sensor}"))
        axes.set_xlabel("lag (readings)")
    checks[0].set_title(f"innovations, with {100 * r.confidence:g} % bounds", fontsize="medium")
    _legend(fig, r)
    return fig


def figures(r: Replayed) -> list[Picture]:
    """Those of the page, one question each."""
    fig, (axes,) = drawing.grid(1, height=4.0)
    _draw_track(axes, r)
    _legend(fig, r)
    pictures = [Picture("Track", "Estimates" + ("" if r.truth is None else " and truth") + " of the recording.", fig)]
    fig, panels = drawing.grid(len(_components(r)))
    _draw_errors(panels, r)
    drawing.legend(fig, drawing.of_filters(list(r.reviews)))
    pictures.append(Picture("Errors" if r.truth is not None else "Spread", f"By component: {_of_errors(r)}.", fig))
    fig, panels = drawing.grid(len(_sensors(r)), height=1.6)
    for axes, sensor in zip(panels, _sensors(r), strict=True):
        _draw_nis(axes, _time(r), [review.info[sensor] for review in r.reviews.values()], r.confidence)
        axes.set_ylabel(drawing.written(sensor))
    drawing.share_time(panels, _time(r))
    drawing.legend(fig, drawing.of_filters(list(r.reviews)))
    percent = f"{100 * r.confidence:g} %"
    text = f"Normalised innovation squared of each reading that was used, with {percent} bounds of a single one."
    pictures.append(Picture("Are the readings where they are expected? (NIS)", text, fig))
    fig, panels = drawing.grid(len(_sensors(r)))
    for axes, sensor in zip(panels, _sensors(r), strict=True):
        drawing.draw_whiteness(axes, [review.whiteness[sensor] for review in r.reviews.values()])
        axes.set_ylabel(drawing.written(sensor))
    panels[-1].set_xlabel("lag (readings)")
    drawing.legend(fig, drawing.of_filters(list(r.reviews)))
    text = f"Autocorrelation of the normalised innovations by sensor, with {percent} bounds: 0 if white."
    return [*pictures, Picture("Are the innovations white?", text, fig)]


def _sensors(r: Replayed) -> list[str]:
    return list(next(iter(r.reviews.values())).nis)


def _time(r: Replayed) -> np.ndarray:
    return r.t - r.t[0]


def _components(r: Replayed) -> list[tuple[int, str, str]]:
    """Index, name and unit of the components in blocks, as many as are drawn."""
    names = component_names(r.blocks, r.space.dim)
    units = {i: unit for index, unit in reversed(list(r.blocks.values())) for i in index}
    return [(i, names[i], units[i]) for i in sorted(units)][:SHOWN]


def _of_errors(r: Replayed) -> str:
    return "error, with 3 sigma" if r.truth is not None else "3 sigma of the estimate; nobody knows the error"


def _legend(fig: Figure, r: Replayed) -> None:
    truth = {} if r.truth is None else {"truth": {"color": "0.6", "linewidth": 3}}
    drawing.legend(fig, drawing.of_filters(list(r.reviews)) | truth)


def _draw_track(axes: Axes, r: Replayed) -> None:
    truth = None
    if r.truth is not None:
        truth = np.where(np.asarray(r.truth.mask)[:, None], drawing.coordinates(r.space, r.truth.x), np.nan)
    tracks = [(drawing.coordinates(r.space, review.mean), review.std) for review in r.reviews.values()]
    drawing.draw_track(axes, r.blocks, _time(r), truth, tracks)


def _draw_errors(panels: Sequence[Axes], r: Replayed) -> None:
    reviews = list(r.reviews.values())
    for axes, (i, name, unit) in zip(panels, _components(r), strict=True):
        seen = [review.error[:, i] for review in reviews if review.error is not None]
        drawing.draw_error(axes, _time(r), seen, [review.std[:, i] for review in reviews])
        axes.set_ylabel(with_unit(name, unit))
    drawing.share_time(panels, _time(r))


def _draw_nis(axes: Axes, t: np.ndarray, infos: Sequence[Info], confidence: float) -> None:
    for style, info in zip(drawing.styles(), infos, strict=False):
        nis, dof = (np.asarray(a) for a in metrics.used(info))
        there = (dof > 0) & (nis > 0)
        axes.plot(t[there], nis[there], ".", color=style["color"], markersize=2.5, alpha=0.6)
        low, high = chisquare.bounds(confidence, int(dof.max(initial=1)))
        axes.axhline(float(low), **EXPECTED)
        axes.axhline(float(high), **EXPECTED)
    drawing.logarithmic(axes)
