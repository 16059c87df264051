"""What a study or a replay found, as plain data and as a picture."""

from __future__ import annotations

import importlib.metadata
import itertools
import json
import math
import platform
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import chisquare, metrics
from jaxfilt.metrics import Blocks, Consistency
from jaxfilt.study import Fault, Replayed, Study
from jaxfilt.types import PyTree, Space

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

VERSION = 1
"""Of the layout of `summary`; it grows when a field changes its meaning or goes away, not when one is added."""


def summary(result: Study | Replayed, name: str = "") -> dict[str, Any]:
    """All that a study or a replay found, as what JSON can hold: dicts, lists, numbers, text, None for NaN.

    ``schema``: "jaxfilt.study/1" or "jaxfilt.replay/1". ``name`` as given. ``made_with``: versions and device.
    ``settings``: runs, steps, seed, dtype, confidence, theta (each parameter by its way in the tree), truth_theta;
    a replay's: steps, dtype, confidence, theta. ``seconds``: compile, run. ``filters`` by name, with

    - ``rmse``: block -> value and unit, over all steps;
    - ``nees``: mean, expected, low, high, verdict ("inside", "above", "below" or "unknown") and, of the single
      steps, ``share_inside`` their bounds; None without a truth;
    - ``nis``: the same by sensor, for a replay with ``refused``, the readings that a gate refused;
    - ``whiteness`` (replay): by sensor lags, autocorrelation, bound;
    - ``diverged`` (runs), ``first_fault``: None, or run, step, sensor, status;
    - ``over_time`` (study): t (s), rmse by block, nees and nis (mean, low, high).

    Example:
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> from jaxfilt.study import study
        >>> walk = lambda theta: jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> start = lambda theta: jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> log = jf.schedule(walk(()), steps=20, dt=1.0)
        >>> result = study(walk, {"kf": lambda _: jf.kf(walk(()))}, start, log, jax.random.key(0), theta=(), runs=10)
        >>> found = summary(result, "walk")
        >>> found["schema"], found["settings"]["runs"], found["filters"]["kf"]["diverged"]
        ('jaxfilt.study/1', 10, 0)
    """
    return _plain(_study(result, name) if isinstance(result, Study) else _replayed(result, name))


def write(result: Study | Replayed, out: str | Path, name: str = "") -> Path:
    """Write ``summary.json`` and a picture, ``study.png`` or ``replay.png``, to a folder, made if need be.

    Returns:
        The folder.

    Raises:
        OSError: the folder cannot be written.
        ModuleNotFoundError: matplotlib is missing; the text says how to get it.
    """
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    (out / "summary.json").write_text(json.dumps(summary(result, name), indent=1, allow_nan=False) + "\n")
    picture = "study.png" if isinstance(result, Study) else "replay.png"
    figure(result, name).savefig(out / picture, dpi=130)
    return out


def _study(s: Study, name: str) -> dict[str, Any]:
    filters = {}
    for filt, scores in s.scores.items():
        filters[filt] = {
            "rmse": {b: {"value": scores.rmse_total[b], "unit": unit} for b, (_, unit) in s.blocks.items()},
            "nees": _consistency(scores.nees_total) | {"share_inside": metrics.share_inside(scores.nees)},
            "nis": {
                sensor: _consistency(total) | {"share_inside": metrics.share_inside(scores.nis[sensor])}
                for sensor, total in scores.nis_total.items()
            },
            "diverged": int(scores.diverged.sum()),
            "first_fault": _fault(scores.fault),
            "over_time": {
                "t": s.t,
                "rmse": scores.rmse,
                "nees": _series(scores.nees),
                "nis": {sensor: _series(c) for sensor, c in scores.nis.items()},
            },
        }
    settings = {"runs": s.runs, "steps": s.steps, "seed": s.seed, "dtype": s.dtype, "confidence": s.confidence}
    settings |= {"theta": _named(s.theta), "truth_theta": _named(s.truth_theta)}
    return _frame("study", name, settings, s.compile_seconds, s.run_seconds, filters)


def _replayed(r: Replayed, name: str) -> dict[str, Any]:
    filters = {}
    for filt, review in r.reviews.items():
        rmse = review.rmse or {}
        nees = None
        if review.nees_mean is not None and review.nees is not None:
            nees = _consistency(review.nees_mean) | {"share_inside": _share_of_rows(r, review.nees)}
        filters[filt] = {
            "rmse": {b: {"value": rmse[b], "unit": unit} for b, (_, unit) in r.blocks.items() if b in rmse},
            "nees": nees,
            "nis": {sensor: _consistency(c) | {"refused": review.refused[sensor]} for sensor, c in review.nis.items()},
            "whiteness": {sensor: w._asdict() for sensor, w in review.whiteness.items()},
            "diverged": int(review.diverged),
            "first_fault": _fault(review.fault),
        }
    settings = {"steps": len(r.t), "dtype": r.dtype, "confidence": r.confidence, "theta": _named(r.theta)}
    return _frame("replay", name, settings, r.compile_seconds, r.run_seconds, filters)


def _share_of_rows(r: Replayed, nees: np.ndarray) -> float:
    """Share of a track's rows whose own NEES is within the bounds of a single one."""
    low, high = chisquare.bounds(r.confidence, r.space.dim)
    return metrics.share_inside(Consistency(nees, r.space.dim, low, high))


def _frame(kind: str, name: str, settings: dict, compiling: float, running: float, filters: dict) -> dict[str, Any]:
    return {
        "schema": f"jaxfilt.{kind}/{VERSION}",
        "name": name,
        "made_with": {
            "jaxfilt": version("jaxfilt"),
            "jax": jax.__version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
            "device": str(jax.devices()[0].device_kind),
        },
        "settings": settings,
        "seconds": {"compile": round(compiling, 3), "run": round(running, 3)},
        "filters": filters,
    }


def version(package: str) -> str:
    """Of an installed package; "unknown" for one that runs from its source tree."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def _consistency(c: Consistency) -> dict[str, Any]:
    return c._asdict() | {"verdict": metrics.verdict(c)}


def _series(c: Consistency) -> dict[str, Any]:
    return {"mean": c.mean, "low": c.low, "high": c.high}


def _fault(fault: Fault | None) -> dict[str, Any] | None:
    return None if fault is None else fault._asdict() | {"status": fault.status.name}


def _named(theta: PyTree) -> dict[str, Any]:
    """Each parameter by the way to it: ``{"q/yaw": -2.3}``."""
    leaves = jax.tree_util.tree_leaves_with_path(theta)
    return {jax.tree_util.keystr(way, simple=True, separator="/"): np.asarray(leaf) for way, leaf in leaves}


def _plain(x: Any) -> Any:
    """The same as JSON knows it; numbers to six digits, NaN and inf as None."""
    if isinstance(x, dict):
        return {str(key): _plain(value) for key, value in x.items()}
    if isinstance(x, np.ndarray | np.generic):
        return _plain(x.tolist())
    if isinstance(x, (list, tuple)):
        return [_plain(value) for value in x]
    if isinstance(x, float):
        return float(f"{x:.6g}") if math.isfinite(x) else None
    return x


# --- pictures -----------------------------------------------------------------------------------------------------

COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00"]
DASHES: list[Any] = ["-", (0, (4, 2)), (0, (1, 1)), (0, (6, 1, 1, 1)), (0, (3, 1, 1, 1, 1, 1))]
BAND: dict[str, Any] = {"color": "0.5", "alpha": 0.25, "linewidth": 0}
EXPECTED: dict[str, Any] = {"color": "0.3", "linewidth": 0.8, "linestyle": "--"}


def figure(result: Study | Replayed, name: str = "") -> Figure:
    """The picture of a study or a replay: track and truth, errors, NEES and NIS with their bounds.

    Raises:
        ModuleNotFoundError: matplotlib is missing; the text says how to get it.
    """
    return _study_figure(result, name) if isinstance(result, Study) else _replay_figure(result, name)


def _canvas(rows: int) -> Figure:
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            f"pictures need matplotlib: pip install 'jaxfilt[plot]' ({missing})", name=missing.name
        ) from None
    fig = Figure(figsize=(15, max(6.5, 1.9 * rows + 1.0)), layout="constrained")
    FigureCanvasAgg(fig)
    return fig


def _columns(fig: Figure, *heights: list[int]) -> list[list[Axes]]:
    """Columns of panels with these relative heights, the first a little wider."""
    cells = fig.add_gridspec(1, len(heights), width_ratios=[1.15] + [1.0] * (len(heights) - 1))
    columns = []
    for k, column in enumerate(heights):
        grid = cells[0, k].subgridspec(len(column), 1, height_ratios=column)
        columns.append([fig.add_subplot(grid[i]) for i in range(len(column))])
    for axes in fig.axes:
        axes.grid(color="0.92")
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    for column in columns:
        fig.align_ylabels(column)
    return columns


def _share_time(column: list[Axes], t: np.ndarray) -> None:
    for axes in column[:-1]:
        axes.sharex(column[-1])
        axes.tick_params(labelbottom=False)
    margin = 0.02 * (t[-1] - t[0]) or 1.0
    column[-1].set_xlim(t[0] - margin, t[-1] + margin)
    column[-1].set_xlabel("time (s)")


def _study_figure(s: Study, name: str) -> Figure:
    sensors = list(next(iter(s.scores.values())).nis)
    fig = _canvas(max(len(s.blocks), 1 + len(sensors)))
    (track, wrong), errors, squares = _columns(fig, [3, 1], [1] * len(s.blocks), [1] * (1 + len(sensors)))
    fig.suptitle(
        f"{name or 'study'}: {s.runs:,} runs of {s.steps:,} steps, {s.dtype}, seed {s.seed}", fontweight="bold"
    )
    first = lambda x: jax.tree.map(lambda a: a[0], x)  # noqa: E731
    truth, estimates = first(s.truth), {filt: (first(c.mean), c.std[0]) for filt, c in s.scores.items()}
    _draw_track(track, s.space, s.blocks, s.t, truth, estimates)
    track.set_title("the first run: truth and estimates", fontsize="medium")
    block, index, unit = _place(s.blocks)
    i = index[0]
    error = {filt: np.asarray(metrics.errors(s.space, truth, mean)) for filt, (mean, _) in estimates.items()}
    _draw_error(wrong, s.t, [e[:, i] for e in error.values()], [std[:, i] for _, std in estimates.values()])
    wrong.set_ylabel(_with_unit(_component(s.blocks, block, 0) + " error", unit))
    wrong.set_xlabel("time (s), with 3 sigma of the filters")
    for axes, (block, (_, unit)) in zip(errors, s.blocks.items(), strict=True):
        for style, (_, scores) in zip(_styles(), s.scores.items(), strict=False):
            axes.plot(s.t, scores.rmse[block], **style)
        _logarithmic(axes, [scores.rmse[block] for scores in s.scores.values()])
        axes.set_ylabel(_with_unit(block, unit))
    errors[0].set_title("RMSE over the runs", fontsize="medium")
    _share_time(errors, s.t)
    series = {"NEES": [scores.nees for scores in s.scores.values()]}
    series |= {f"NIS {sensor}": [scores.nis[sensor] for scores in s.scores.values()] for sensor in sensors}
    for axes, (label, all_scores) in zip(squares, series.items(), strict=True):
        _draw_consistency(axes, s.t, all_scores)
        axes.set_ylabel(f"mean {label}")
    squares[0].set_title(f"consistency, with {100 * s.confidence:g} % bounds", fontsize="medium")
    _share_time(squares, s.t)
    lost = {filt: int(scores.diverged.sum()) for filt, scores in s.scores.items()}
    _legend(fig, [f"{filt} ({n:,} of {s.runs:,} runs diverged)" if n else filt for filt, n in lost.items()])
    return fig


def _styles(width: float = 1.3) -> Iterator[dict[str, Any]]:
    """A colour and a dash for each filter in turn; after the last they begin again."""
    lines = [{"color": c, "linestyle": d, "linewidth": width} for c, d in zip(COLOURS, DASHES, strict=True)]
    return itertools.cycle(lines)


def _component(blocks: Blocks, block: str, k: int) -> str:
    return f"{block}[{k}]" if len(blocks[block][0]) > 1 else block


def _with_unit(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name


def _legend(fig: Figure, filters: list[str]) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], **style, label=name) for style, name in zip(_styles(), filters, strict=False)]
    handles.append(Line2D([], [], color="0.6", linewidth=3, label="truth"))
    fig.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)


def _finite(series: list[np.ndarray]) -> np.ndarray:
    values = np.concatenate([np.ravel(a) for a in series])
    return values[np.isfinite(values)]


def _logarithmic(axes: Axes, series: list[np.ndarray]) -> None:
    """A logarithmic axis where a linear one would show one filter only, or only the start."""
    values = _finite(series)
    if len(values) and values.min() > 0 and values.max() > 30 * np.median(values):
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0)


def _draw_error(axes: Axes, t: np.ndarray, errors: list[np.ndarray], stds: list[np.ndarray]) -> None:
    """Errors within the bands of three standard deviations that their filters claim; the start may stick out."""
    for style, std in zip(_styles(), stds, strict=False):
        axes.fill_between(t, -3 * std, 3 * std, color=style["color"], alpha=0.15, linewidth=0)
    for style, error in zip(_styles(0.9), errors, strict=False):
        axes.plot(t, error, **style)
    values = [(3 * _finite(stds), 0.95), (np.abs(_finite(errors)) if errors else np.zeros(0), 0.99)]
    reach = max((float(np.quantile(v, share)) for v, share in values if len(v)), default=0.0)
    if reach > 0:
        axes.set_ylim(-1.3 * reach, 1.3 * reach)


def _draw_consistency(axes: Axes, t: np.ndarray, scores: list[Consistency]) -> None:
    there = np.isfinite(scores[0].low)
    axes.fill_between(t[there], scores[0].low[there], scores[0].high[there], **BAND)
    axes.plot(t[there], scores[0].expected[there], **EXPECTED)
    for style, score in zip(_styles(0.9), scores, strict=False):
        seen = np.isfinite(score.mean)
        axes.plot(t[seen], score.mean[seen], **style)
    values = _finite([score.mean for score in scores])
    if len(values) and values.max() > 5 * np.median(scores[0].high[there]):
        axes.set_yscale("log")


def _coordinates(space: Space, points: PyTree) -> np.ndarray:
    """Points (T, ...) as tangent vectors (T, n) from the origin: a vector's own coordinates, an angle's value."""
    origin = jax.tree.map(lambda o, p: jnp.asarray(o, p.dtype), space.origin, points)
    return np.asarray(jax.jit(jax.vmap(space.minus, in_axes=(0, None)))(points, origin))


def _place(blocks: Blocks) -> tuple[str, tuple[int, ...], str]:
    """The block that a map is drawn of: the first with two components in m; otherwise the first of all."""
    for name, (index, unit) in blocks.items():
        if unit == "m" and len(index) > 1:
            return name, index, unit
    name, (index, unit) = next(iter(blocks.items()))
    return name, index, unit


def _draw_track(
    axes: Axes,
    space: Space,
    blocks: Blocks,
    t: np.ndarray,
    truth: PyTree | None,
    estimates: dict[str, tuple[PyTree, np.ndarray]],
    mask: np.ndarray | None = None,
) -> None:
    """A map where there is a place to draw, seen from above; otherwise the first component over time."""
    name, index, unit = _place(blocks)
    real = None if truth is None else _coordinates(space, truth)
    if real is not None and mask is not None:
        real = np.where(mask[:, None], real, np.nan)
    seen = {filt: (_coordinates(space, mean), std) for filt, (mean, std) in estimates.items()}
    i = index[0]
    if len(index) > 1:
        j = index[1]
        if real is not None:
            axes.plot(real[:, i], real[:, j], color="0.6", linewidth=3, solid_capstyle="round")
        for style, (x, _) in zip(_styles(), seen.values(), strict=False):
            axes.plot(x[:, i], x[:, j], **style)
        way = next(iter(seen.values()))[0] if real is None else real
        way = way[np.isfinite(way).all(1)]
        if len(way):
            axes.plot(way[0, i], way[0, j], "o", color="0.2", markersize=6)
            axes.annotate("start", (way[0, i], way[0, j]), (8, -12), textcoords="offset points")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel(_with_unit(f"{name}[0]", unit))
        axes.set_ylabel(_with_unit(f"{name}[1]", unit))
        return
    if real is not None:
        axes.plot(t, real[:, i], color="0.6", linewidth=3)
    for style, (x, std) in zip(_styles(), seen.values(), strict=False):
        axes.plot(t, x[:, i], **style)
        axes.fill_between(
            t, x[:, i] - 3 * std[:, i], x[:, i] + 3 * std[:, i], color=style["color"], alpha=0.12, linewidth=0
        )
    axes.set_xlabel("time (s)")
    axes.set_ylabel(_with_unit(name, unit) + ", with 3 sigma")


def _replay_figure(r: Replayed, name: str) -> Figure:
    reviews, t = r.reviews, r.t - r.t[0]
    sensors = list(next(iter(reviews.values())).nis)
    components = [(block, k, i, unit) for block, (index, unit) in r.blocks.items() for k, i in enumerate(index)][:6]
    fig = _canvas(max(len(components), 2 * len(sensors)))
    (track,), errors, checks = _columns(fig, [1], [1] * len(components), [1] * (2 * len(sensors)))
    fig.suptitle(f"{name or 'replay'}: {len(t):,} rows over {t[-1]:,.0f} s, {r.dtype}", fontweight="bold")
    truth = None if r.truth is None else r.truth.x
    mask = None if r.truth is None else np.asarray(r.truth.mask)
    estimates = {filt: (review.mean, review.std) for filt, review in reviews.items()}
    _draw_track(track, r.space, r.blocks, t, truth, estimates, mask)
    track.set_title("track", fontsize="medium")
    for axes, (block, k, i, unit) in zip(errors, components, strict=True):
        seen = [review.error[:, i] for review in reviews.values() if review.error is not None]
        _draw_error(axes, t, seen, [review.std[:, i] for review in reviews.values()])
        axes.set_ylabel(_with_unit(_component(r.blocks, block, k), unit))
    errors[0].set_title(
        "error, with 3 sigma" if r.truth is not None else "3 sigma of the estimate; nobody knows the error",
        fontsize="medium",
    )
    _share_time(errors, t)
    for axes, sensor in zip(checks[::2], sensors, strict=True):
        _draw_nis(axes, t, [review.info[sensor] for review in reviews.values()], r.confidence)
        axes.set_ylabel(f"NIS {sensor}")
        axes.set_xlabel("time (s)")
    for axes, sensor in zip(checks[1::2], sensors, strict=True):
        for k, (style, review) in enumerate(zip(_styles(), reviews.values(), strict=False)):
            white = review.whiteness[sensor]
            axes.fill_between(white.lags, -white.bound, white.bound, **BAND) if k == 0 else None
            axes.plot(white.lags, white.autocorrelation, **style, marker="o", markersize=2.5)
        axes.axhline(0, **EXPECTED)
        axes.set_ylabel(f"whiteness {sensor}")
        axes.set_xlabel("lag (readings)")
        axes.locator_params(axis="x", integer=True)
    checks[0].set_title(f"innovations, with {100 * r.confidence:g} % bounds", fontsize="medium")
    _legend(fig, list(reviews))
    return fig


def _draw_nis(axes: Axes, t: np.ndarray, infos: list, confidence: float) -> None:
    for style, info in zip(_styles(), infos, strict=False):
        nis, dof = (np.asarray(a) for a in metrics.used(info))
        there = dof > 0
        axes.plot(t[there], nis[there], ".", color=style["color"], markersize=2.5, alpha=0.6)
        low, high = chisquare.bounds(confidence, int(dof.max(initial=1)))
        axes.axhline(float(low), **EXPECTED)
        axes.axhline(float(high), **EXPECTED)
    axes.set_yscale("log")
