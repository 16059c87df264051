"""What a tuning found, as plain data: the layout of its ``summary.json``, ``theta.json`` and ``history.csv``."""

from __future__ import annotations

import csv
import io
from typing import Any

import numpy as np

from jaxfilt import checkpoint
from jaxfilt.fit import TUNED, Covariances, Fit, PartScores
from jaxfilt.report.plain import judged, plain
from jaxfilt.theta_file import theta_to_json

TUNE = "jaxfilt.tune/1"
"""Schema; the number grows when a field changes its meaning or goes away, not when one is added."""


def summary(fit: Fit, name: str = "", command: str = "") -> dict[str, Any]:
    """All that was found, in the manner of `jaxfilt.report.summary`, schema "jaxfilt.tune/1".

    ``schema``; ``name`` and ``command`` as given; ``findings``, in words, worst first; ``settings``; ``made_with``:
    versions and device; ``seconds``: compile, run; and

    - ``scores``: stage ("before", "noise estimation", "tuned", "truth") -> part ("train", "validation", "test"), each
      loss, runs, rows, diverged (runs), nis (sensor -> test), and, None without a truth, rmse (block -> unit, value),
      log_score (value, error), nees (test);
    - ``parameters``: a list of name, start, estimated, value, error, true; ``errors_by``, in words;
    - ``flat``: a list of direction, curvature, std (None: unbounded), text;
    - ``covariances``: stage -> dt, Q, R by sensor, P0;
    - ``history`` after each step: loss, validation, gradient, refused, seconds; ``best``, how many steps were kept;
      ``starts``, the final loss of each;
    - ``theta``: the tuned parameters by their way in the tree, with ``start_theta``, ``estimated_theta`` and
      ``truth_theta`` (the last two None where there is none).
    """
    units = {block: unit for block, (_, unit) in (fit.blocks or {}).items()}
    h = fit.history
    return plain(
        {
            "schema": TUNE,
            "name": name,
            "command": command,
            "findings": fit.findings,
            "settings": {
                "objective": fit.objective,
                "optimizer": fit.optimizer,
                "stopped": fit.stopped,
                "steps": len(h.loss),
                "best": fit.best,
                "starts": len(fit.starts),
                "runs": fit.runs,
                "split": fit.split,
                "frozen": fit.frozen,
                "errors_by": fit.errors_by,
                "dtype": fit.dtype,
                "seed": fit.seed,
            },
            "made_with": checkpoint.made_with(),
            "seconds": {"compile": fit.compile_seconds, "run": fit.run_seconds},
            "scores": {
                stage: {part: _scores(scores, units) for part, scores in parts.items()}
                for stage, parts in fit.scores.items()
            },
            "parameters": fit.parameters,
            "errors_by": fit.errors_by,
            "flat": fit.flat,
            "covariances": fit.covariances,
            "history": {field: getattr(h, field) for field in h._fields if field != "theta"},
            "best": fit.best,
            "starts": fit.starts,
            "theta": _named(fit.theta),
            "start_theta": _named(fit.start),
            "estimated_theta": _named(fit.estimated),
            "truth_theta": _named(fit.truth_theta),
        }
    )


def theta_json(fit: Fit, name: str = "", command: str = "") -> str:
    """The tuned parameters, and beside them Q, R and P0 as plain matrices, for a robot that runs no JAX."""
    more: dict[str, Any] = {"name": name, "command": command, "objective": fit.objective}
    more["made_with"] = checkpoint.made_with()
    if TUNED in fit.covariances:
        tuned: Covariances = fit.covariances[TUNED]
        more["covariances"] = {
            "dt": float(tuned.dt),
            "Q": np.asarray(tuned.Q).tolist(),
            "R": {sensor: np.asarray(R).tolist() for sensor, R in tuned.R.items()},
            "P0": np.asarray(tuned.P0).tolist(),
        }
    return theta_to_json(fit.theta, more)


def history_csv(fit: Fit) -> str:
    """A line for each step: step, loss, validation, gradient, refused, seconds, and each free parameter by its name."""
    h, text = fit.history, io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow(["step", "loss", "validation", "gradient", "refused", "seconds", *[p.name for p in fit.parameters]])
    for k in range(len(h.loss)):
        numbers = [_cell(a[k]) for a in (h.loss, h.validation, h.gradient)]
        lines.writerow([k + 1, *numbers, int(h.refused[k]), f"{h.seconds[k]:.3f}", *map(_cell, h.theta[k])])
    return text.getvalue()


def _cell(value: Any) -> str:
    return repr(float(value)) if np.isfinite(value) else ""


def _named(theta: Any) -> dict[str, Any] | None:
    return None if theta is None else checkpoint.named(theta)


def _scores(s: PartScores, units: dict[str, str]) -> dict[str, Any]:
    rmse = None if s.rmse is None else {b: {"unit": units.get(b, ""), "value": value} for b, value in s.rmse.items()}
    return {
        "loss": s.loss,
        "runs": s.runs,
        "rows": s.rows,
        "diverged": s.diverged,
        "rmse": rmse,
        "log_score": s.log_score,
        "nees": None if s.nees is None else judged(s.nees),
        "nis": {sensor: judged(nis) for sensor, nis in s.nis.items()},
    }
