"""The figures of a study, a sweep, a replay or a tuning: one overview, and those of the page as vector graphics."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from jaxfilt.bound import Bound
from jaxfilt.fit import Fit
from jaxfilt.report import replay_figures, study_figures, sweep_figures, tune_figures
from jaxfilt.report.drawing import MANY_POINTS, Picture
from jaxfilt.review import Replayed
from jaxfilt.study import Study
from jaxfilt.sweep import Sweep

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def overview(result: Study | Sweep | Replayed | Fit, name: str = "", bound: Bound | None = None) -> Figure:
    """All that matters in one picture.

    Raises:
        ModuleNotFoundError: matplotlib is missing; the text says how to get it.
    """
    if isinstance(result, Study):
        return study_figures.overview(result, name, bound)
    if isinstance(result, Fit):
        return tune_figures.overview(result, name)
    return sweep_figures.overview(result, name) if isinstance(result, Sweep) else replay_figures.overview(result, name)


def pictures(result: Study | Sweep | Replayed | Fit, bound: Bound | None = None) -> list[Picture]:
    """The figures of the page, in their order.

    Raises:
        ModuleNotFoundError: matplotlib is missing; the text says how to get it.
    """
    if isinstance(result, Study):
        return study_figures.figures(result, bound)
    if isinstance(result, Fit):
        return tune_figures.figures(result)
    return sweep_figures.figures(result) if isinstance(result, Sweep) else replay_figures.figures(result)


def svg(figure: Figure) -> bytes:
    """As vector graphics, the same bytes each time; lines of very many points as pixels within."""
    import matplotlib

    for axes in figure.axes:
        for drawn in axes.lines:
            drawn.set_rasterized(np.size(drawn.get_xdata()) > MANY_POINTS)
        for area in axes.collections:
            area.set_rasterized(sum(np.size(path.vertices) for path in area.get_paths()) > MANY_POINTS)
    with matplotlib.rc_context({"svg.hashsalt": "jaxfilt"}):
        return _saved(figure, "svg", 200)


def png(figure: Figure) -> bytes:
    """As pixels."""
    return _saved(figure, "png", 130)


def _saved(figure: Figure, form: str, dpi: int) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format=form, dpi=dpi, metadata={"Date": None} if form == "svg" else {"Software": None})
    return buffer.getvalue()
