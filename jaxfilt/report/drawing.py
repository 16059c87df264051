"""How our figures look, and the panels that several of them share. Needs matplotlib, imported where it is used."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import chisquare
from jaxfilt.consistency import Consistency
from jaxfilt.metrics import Blocks, Whiteness
from jaxfilt.types import PyTree, Space

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00"]
DASHES: list[Any] = ["-", (0, (4, 2)), (0, (1, 1)), (0, (6, 1, 1, 1)), (0, (3, 1, 1, 1, 1, 1))]
BAND: dict[str, Any] = {"color": "0.5", "alpha": 0.25, "linewidth": 0}
EXPECTED: dict[str, Any] = {"color": "0.3", "linewidth": 0.8, "linestyle": "--"}
TRUTH: dict[str, Any] = {"color": "0.6", "linewidth": 3, "solid_capstyle": "round"}
LABEL: dict[str, Any] = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5}

ELLIPSE, ELLIPSES = 0.99, 12
"""Probability of the credible ellipses along a track, and how many of them are drawn."""

PAGE_WIDTH = 5.2
"""Inches: small enough to be read on a phone, where it is shown at two thirds of its size."""

FEW_POINTS = 60
"""Up to so many points of a line are marked, lest a sensor that reads rarely looks as if it read always."""

MANY_POINTS = 500
"""Lines of more points are drawn as pixels in a page's vector graphics, which would be large otherwise."""


class Picture(NamedTuple):
    """A figure of a page, its ``title``, and in words what it shows."""

    title: str
    text: str
    figure: Figure


def canvas(width: float, height: float) -> Figure:
    """A figure (inches) that needs no display.

    Raises:
        ModuleNotFoundError: matplotlib is missing; the text says how to get it.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            f"pictures need matplotlib: pip install 'jaxfilt[plot]' ({missing})", name=missing.name
        ) from None
    fig = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(fig)
    return fig


def columns(fig: Figure, *heights: Sequence[float]) -> list[list[Axes]]:
    """Columns of panels with these relative heights, the first a little wider."""
    cells = fig.add_gridspec(1, len(heights), width_ratios=[1.15] + [1.0] * (len(heights) - 1))
    made = []
    for k, column in enumerate(heights):
        grid = cells[0, k].subgridspec(len(column), 1, height_ratios=column)
        made.append([fig.add_subplot(grid[i]) for i in range(len(column))])
    for column in made:
        fig.align_ylabels(column)
    return _plain_look(fig, made)


def grid(rows: int, across: int = 1, height: float = 1.35) -> tuple[Figure, list[Axes]]:
    """A figure of a page: so many panels, ``across`` of them side by side, each ``height`` inches high."""
    down = -(-rows // across)
    fig = canvas(PAGE_WIDTH, height * down + 0.8)
    cells = fig.add_gridspec(down, across)
    axes = [fig.add_subplot(cells[divmod(k, across)]) for k in range(rows)]
    if across == 1:
        fig.align_ylabels(axes)
    return fig, _plain_look(fig, axes)


def _plain_look(fig: Figure, panels: Any) -> Any:
    for axes in fig.axes:
        axes.grid(color="0.92")
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    return panels


def styles(width: float = 1.3) -> Iterator[dict[str, Any]]:
    """A colour and a dash for each filter in turn; after the last they begin again."""
    lines = [{"color": c, "linestyle": d, "linewidth": width} for c, d in zip(COLOURS, DASHES, strict=True)]
    return itertools.cycle(lines)


def written(text: str) -> str:
    """A user's text, in which a dollar sign begins no formula."""
    return text.replace("$", r"\$")


def with_unit(name: str, unit: str) -> str:
    return written(f"{name} ({unit})" if unit else name)


def legend(fig: Figure, entries: Mapping[str, Mapping[str, Any]], across: int | None = None) -> None:
    """Lines of these styles with their names, below the panels."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], **style, label="name") for style in entries.values()]
    box = fig.legend(handles=handles, loc="outside lower center", ncols=across or min(len(handles), 4), frameon=False)
    for text, name in zip(box.get_texts(), entries, strict=True):  # matplotlib would drop one that begins with "_"
        text.set_text(written(name))


def of_filters(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Entries of a legend."""
    return dict(zip(names, styles(), strict=False))


def note(axes: Axes, text: str) -> None:
    """Why a panel is empty."""
    axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes, color="0.35")


def finite(series: Sequence[Any]) -> np.ndarray:
    values = np.concatenate([np.ravel(a) for a in series]) if series else np.zeros(0)
    return values[np.isfinite(values)]


def share_time(column: Sequence[Axes], t: np.ndarray) -> None:
    for axes in column[:-1]:
        axes.sharex(column[-1])
        axes.tick_params(labelbottom=False)
    margin = 0.02 * (t[-1] - t[0]) or 1.0
    column[-1].set_xlim(t[0] - margin, t[-1] + margin)
    column[-1].set_xlabel("time (s)")


def line(axes: Axes, x: np.ndarray, y: np.ndarray, **style: Any) -> None:
    """Of what is finite, with marks where there are few points."""
    seen = np.isfinite(y)
    marks = {"marker": "o", "markersize": 2.5} if seen.sum() <= FEW_POINTS else {}
    axes.plot(np.asarray(x)[seen], np.asarray(y)[seen], **(marks | style))


def from_zero(axes: Axes, series: Sequence[Any]) -> None:
    """From 0 on; on a logarithmic axis where a linear one would show one filter only, or only the start."""
    values = finite(series)
    if len(values) and values.min() > 0 and values.max() > 30 * np.median(values):
        logarithmic(axes)
    elif len(values):
        axes.set_ylim(bottom=0)
    else:
        note(axes, "nothing to average")


def logarithmic(axes: Axes, which: str = "y") -> None:
    """With plain numbers in place of powers of ten: 0.5, 1, 2 or, where it is long, 0.1, 1, 10."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axis = axes.yaxis if which == "y" else axes.xaxis
    axes.set(**{f"{which}scale": "log"})
    low, high = axis.get_view_interval()
    subs = (1.0, 2.0, 5.0) if high < 50 * low else (1.0,)
    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def draw_ratio(axes: Axes, t: np.ndarray, tests: Sequence[Consistency]) -> None:
    """Means over their expectations, with the bounds; a logarithmic axis where they are far out."""
    first = tests[0]
    expected = np.where(np.asarray(first.expected) > 0, first.expected, np.nan)
    there = np.isfinite(first.low) & np.isfinite(expected)
    low, high = np.asarray(first.low)[there] / expected[there], np.asarray(first.high)[there] / expected[there]
    axes.fill_between(np.asarray(t)[there], low, high, **BAND)
    axes.axhline(1.0, **EXPECTED)
    ratios = [np.asarray(test.mean) / np.where(np.asarray(test.expected) > 0, test.expected, np.nan) for test in tests]
    for style, ratio in zip(styles(0.9), ratios, strict=False):
        line(axes, t, ratio, **style)
    values = finite(ratios)
    if not len(values):
        note(axes, "nothing to average")
    elif values.max() > 5 * max(np.median(high) if len(high) else 1.0, 1.0) and values.min() > 0:
        logarithmic(axes)


def draw_error(axes: Axes, t: np.ndarray, errors: Sequence[np.ndarray], stds: Sequence[np.ndarray]) -> None:
    """Errors within the bands of three standard deviations that their filters claim; the start may stick out."""
    for style, std in zip(styles(), stds, strict=False):
        axes.fill_between(t, -3 * std, 3 * std, color=style["color"], alpha=0.15, linewidth=0)
    for style, error in zip(styles(0.9), errors, strict=False):
        axes.plot(t, error, **style)
    values = [(3 * finite(stds), 0.95), (np.abs(finite(errors)), 0.99)]
    reach = max((float(np.quantile(v, share)) for v, share in values if len(v)), default=0.0)
    if reach > 0:
        axes.set_ylim(-1.3 * reach, 1.3 * reach)


def draw_whiteness(axes: Axes, whiteness: Sequence[Whiteness]) -> None:
    """Autocorrelation of the innovations over lags, with its bounds."""
    white = whiteness[0]
    axes.fill_between(white.lags, -white.bound, white.bound, **BAND)
    axes.axhline(0, **EXPECTED)
    for style, each in zip(styles(), whiteness, strict=False):
        line(axes, each.lags, each.autocorrelation, **(style | {"marker": "o", "markersize": 2.5}))
    axes.set_xlim(0.5, white.lags[-1] + 0.5)
    axes.locator_params(axis="x", integer=True)
    if not len(finite([w.autocorrelation for w in whiteness])):
        axes.set_ylim(-1, 1)
        note(axes, "too few readings")


def coordinates(space: Space, points: PyTree) -> np.ndarray:
    """Points (T, ...) as tangent vectors (T, n) from the origin: a vector's own coordinates, an angle's value."""
    origin = jax.tree.map(lambda o, p: jnp.asarray(o, p.dtype), space.origin, points)
    return np.asarray(jax.jit(jax.vmap(space.minus, in_axes=(0, None)))(points, origin))


def place(blocks: Blocks) -> tuple[str, tuple[int, ...], str]:
    """The block that a map is drawn of: the first with two components in m; otherwise the first of all."""
    for name, (index, unit) in blocks.items():
        if unit == "m" and len(index) > 1:
            return name, index, unit
    name, (index, unit) = next(iter(blocks.items()))
    return name, index, unit


def draw_track(
    axes: Axes,
    blocks: Blocks,
    t: np.ndarray,
    truth: np.ndarray | None,
    tracks: Sequence[tuple[np.ndarray, np.ndarray]],
) -> None:
    """A map where there is a place to draw, seen from above, with ellipses; otherwise the first component over time.

    ``truth`` (T, n) and by filter the means (T, n) as `coordinates`, and the covariances (T, n, n), or (T, n) their
    diagonals, which draw no ellipses.
    """
    name, (i, *others), unit = place(blocks)
    if others:
        _draw_map(axes, (i, others[0]), truth, tracks)
        axes.set_xlabel(with_unit(f"{name}[0]", unit))
        axes.set_ylabel(with_unit(f"{name}[1]", unit))
        return
    if truth is not None:
        axes.plot(t, truth[:, i], **TRUTH)
    for style, (x, spread) in zip(styles(), tracks, strict=False):
        std = spread[:, i] if spread.ndim == 2 else np.sqrt(np.where(spread[:, i, i] >= 0, spread[:, i, i], np.nan))
        axes.plot(t, x[:, i], **style)
        axes.fill_between(t, x[:, i] - 3 * std, x[:, i] + 3 * std, color=style["color"], alpha=0.12, linewidth=0)
    axes.set_xlabel("time (s)")
    axes.set_ylabel(with_unit(name, unit) + ", with 3 sigma")


def _draw_map(axes: Axes, ij: Sequence[int], truth: np.ndarray | None, tracks: Sequence[tuple]) -> None:
    i, j = ij
    if truth is not None:
        axes.plot(truth[:, i], truth[:, j], **TRUTH)
    for style, (x, spread) in zip(styles(), tracks, strict=False):
        axes.plot(x[:, i], x[:, j], **style)
        if spread.ndim == 3:
            some = np.unique(np.linspace(0, len(x) - 1, ELLIPSES).astype(int))
            for centre, cov in zip(x[some][:, [i, j]], spread[some][:, [[i], [j]], [i, j]], strict=True):
                axes.plot(*ellipse(centre, cov), color=style["color"], linewidth=0.7)
    way = truth if truth is not None else tracks[0][0]
    way = way[np.isfinite(way).all(1)]
    if len(way):
        axes.plot(way[0, i], way[0, j], "o", color="0.2", markersize=6)
        axes.annotate("start", (way[0, i], way[0, j]), (8, -12), textcoords="offset points", bbox=LABEL)
    axes.set_aspect("equal", adjustable="datalim")


def ellipse(centre: np.ndarray, cov: np.ndarray, probability: float = ELLIPSE) -> np.ndarray:
    """The credible ellipse (2, K) of a Gaussian in the plane: ``{x: (x - c)' P^-1 (x - c) = chi-square quantile}``.

    Example: two standard deviations along each axis hold 86 %.
        >>> points = ellipse(np.zeros(2), np.diag([1.0, 9.0]), probability=1 - np.exp(-2))
        >>> points.max(1).round(3).tolist()
        [2.0, 6.0]
    """
    (a, b), (_, c) = cov
    if not a > 0:
        return np.full((2, 1), np.nan)
    turn = np.linspace(0, 2 * np.pi, 65)
    circle = np.sqrt(chisquare.quantile(probability, 2)) * np.array([np.cos(turn), np.sin(turn)])
    L = np.array([[np.sqrt(a), 0.0], [b / np.sqrt(a), np.sqrt(max(c - b * b / a, 0.0))]])
    return centre[:, None] + L @ circle
