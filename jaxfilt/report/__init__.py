"""A study, a sweep, a replay or a tuning in a folder: plain data, labelled arrays, a picture and a page."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

from jaxfilt.bound import Bound
from jaxfilt.checkpoint import write_whole
from jaxfilt.fit import Fit
from jaxfilt.report import arrays, figures, tune_summary
from jaxfilt.report.page import rendered
from jaxfilt.report.summary import summary
from jaxfilt.review import Replayed
from jaxfilt.study import Study
from jaxfilt.sweep import Sweep


def files(result: Study | Sweep | Replayed | Fit) -> list[str]:
    """Names of what `write` writes, the page first: it is what one opens."""
    if isinstance(result, Fit):
        return ["report.html", "summary.json", "tune.png", "theta.json", "history.csv"]
    kind = "study" if isinstance(result, Study) else "sweep" if isinstance(result, Sweep) else "replay"
    labelled = [] if isinstance(result, Replayed) or importlib.util.find_spec("xarray") is None else [f"{kind}.nc"]
    return ["report.html", "summary.json", f"{kind}.png", *labelled]


def write(
    result: Study | Sweep | Replayed | Fit,
    out: str | Path,
    name: str = "",
    bound: Bound | None = None,
    command: str = "",
) -> Path:
    """Write a page to look at, ``report.html``, with all that was found.

    Beside it ``summary.json``; an overview, ``study.png``, ``sweep.png`` or ``replay.png``; and, of a study or a sweep
    where xarray is installed, labelled arrays, ``study.nc`` or ``sweep.nc``. Of a tuning: ``tune.png``,
    ``theta.json`` with the parameters and with Q, R and P0 as matrices, and ``history.csv``. Each file appears whole or
    not at all.

    Args:
        result: from `jaxfilt.study`, `jaxfilt.sweep`, `jaxfilt.replayed` or `jaxfilt.tune`.
        out: folder, made if need be.
        name: of what was studied.
        bound: from `jaxfilt.cramer_rao`, of a study.
        command: what to type to get the same again.

    Returns:
        The folder.

    Raises:
        OSError: the folder cannot be written.
        ModuleNotFoundError: matplotlib is missing; the text says how to get it.
    """
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    tuned = isinstance(result, Fit)
    found = tune_summary.summary(result, name, command) if tuned else summary(result, name, bound, command)
    for file in files(result):
        if file == "theta.json" and tuned:
            content = tune_summary.theta_json(result, name, command).encode()
        elif file.endswith(".csv") and tuned:
            content = tune_summary.history_csv(result).encode()
        elif file.endswith(".html"):
            content = rendered(found, figures.pictures(result, bound)).encode()
        elif file.endswith(".json"):
            content = (json.dumps(found, indent=1, allow_nan=False) + "\n").encode()
        elif file.endswith(".png"):
            content = figures.png(figures.overview(result, name, bound))
        else:
            assert isinstance(result, Study | Sweep)
            content = arrays.netcdf(result)
        write_whole(out / file, content)
    return out
