"""What tuning found: plain numbers and words."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxfilt import consistency, plaintext
from jaxfilt.consistency import Consistency
from jaxfilt.metrics import Blocks
from jaxfilt.scores import Estimate
from jaxfilt.types import Model, PyTree

BEFORE, ESTIMATED, TUNED, TRUE = "before", "noise estimation", "tuned", "truth"
"""Stages: the parameters given; those that the truth's residuals say; those tuned; those of a simulation's truth."""

TRAIN, VALIDATION, TEST = "train", "validation", "test"


class Parameter(NamedTuple):
    """A free number of theta: where it began, what the residuals of the truth say (None: they were not looked at),
    what tuning says, with its standard error (NaN: unknown), and the true one of a simulation (None: nobody knows)."""

    name: str
    start: float
    estimated: float | None
    value: float
    error: float
    true: float | None


class Flat(NamedTuple):
    """A direction in which the objective says little: ``direction`` a unit vector, by its larger entries;
    ``curvature`` of the loss along it; ``std``, how far theta may move along it (inf: as far as it likes); ``text`` in
    words."""

    direction: dict[str, float]
    curvature: float
    std: float
    text: str


class Covariances(NamedTuple):
    """Q (n, n) over ``dt`` s, R by sensor and the initial P0 (n, n), as plain matrices: at the first row's state, input
    and contexts, and the median interval of the log."""

    dt: float
    Q: np.ndarray
    R: dict[str, np.ndarray]
    P0: np.ndarray


class PartScores(NamedTuple):
    """How well some parameters do on a part of the data: ``loss`` of the objective; ``rows`` that were scored; and,
    with a truth, RMSE by block, mean log score with its standard error, mean NEES. ``nis`` by sensor. ``diverged``
    runs."""

    loss: float
    runs: int
    rows: int
    rmse: dict[str, float] | None
    log_score: Estimate | None
    nees: Consistency | None
    nis: dict[str, Consistency]
    diverged: int


class History(NamedTuple):
    """The way down: after each of k steps the loss, that on the validation part (NaN: not looked at), the norm of the
    gradient, the free parameters (k, p), whether the step was refused, and the seconds since the start."""

    loss: np.ndarray
    validation: np.ndarray
    gradient: np.ndarray
    theta: np.ndarray
    refused: np.ndarray
    seconds: np.ndarray


class Fit(NamedTuple):
    """What `jaxfilt.tune` returns.

    ``theta``, tuned; ``start``, as given; ``estimated``, by the residuals of the truth; ``truth_theta`` of a
    simulation; the last two None where there is none. ``model`` at theta. ``scores``: stage -> part -> `PartScores`;
    stages in order "before", "noise estimation", "tuned", "truth", parts "train", "validation", "test", as far as they
    exist. ``parameters`` with standard errors, made by ``errors_by``; ``flat`` directions. ``covariances`` by stage.
    ``history`` of the best of the ``starts`` (final losses), whose step ``best`` was kept. ``findings`` in words, worst
    first. ``stopped`` why, ``split`` how, in words.
    """

    theta: PyTree
    start: PyTree
    estimated: PyTree | None
    truth_theta: PyTree | None
    model: Model
    scores: dict[str, dict[str, PartScores]]
    parameters: tuple[Parameter, ...]
    errors_by: str
    flat: tuple[Flat, ...]
    covariances: dict[str, Covariances]
    history: History
    starts: np.ndarray
    best: int
    findings: tuple[str, ...]
    frozen: tuple[str, ...]
    objective: str
    optimizer: str
    stopped: str
    split: str
    blocks: Blocks | None
    runs: int
    dtype: str
    seed: int
    compile_seconds: float
    run_seconds: float

    def report(self) -> str:
        """All of it as plain text: findings, scores, parameters, flat directions, matrices."""
        runs = "1 run" if self.runs == 1 else f"{self.runs:,} runs"
        parts = [
            f"Tuned by {self.objective} with {self.optimizer}, {runs}, {self.dtype}; {self.stopped}\n"
            f"{plaintext.wrapped(self.split, 'Data: ')}",
            "\n".join(["Findings", *map(plaintext.wrapped, self.findings)]) if self.findings else "",
            *[self._scored(part) for part in (TEST, VALIDATION, TRAIN)],
            self._parameters(),
            "\n".join(["Flat directions", *[plaintext.wrapped(flat.text) for flat in self.flat]]) if self.flat else "",
            self._matrices(),
        ]
        return "\n\n".join(filter(None, parts))

    def _scored(self, part: str) -> str:
        """Stages beside each other: what each scores on a part of the data."""
        found = {stage: parts[part] for stage, parts in self.scores.items() if part in parts}
        if not found:
            return ""
        one, scores = next(iter(found.values())), list(found.values())
        rows = [["", *found], ["loss", *[f"{s.loss:.5g}" for s in scores]]]
        for block in one.rmse or {}:
            unit = self.blocks[block][1] if self.blocks else ""
            label = f"RMSE {block}, {unit}" if unit else f"RMSE {block}"
            rows.append([label, *[f"{s.rmse[block]:.4g}" if s.rmse else "" for s in scores]])
        if one.log_score is not None:
            rows.append(["log score", *[_measured(*s.log_score) if s.log_score else "" for s in scores]])
        if one.nees is not None:
            rows.append(["ANEES / n", *[_judged(s.nees) for s in scores]])
            bounds = [_bounds(s.nees) for s in scores]
            rows += [["  bounds", *bounds]] if any(bounds) else []
        for sensor in one.nis:
            rows.append([f"ANIS / m, {sensor}", *[_judged(s.nis.get(sensor)) for s in scores]])
        if any(s.diverged for s in scores):
            rows.append(["diverged runs", *[f"{s.diverged:,}" for s in scores]])
        title = f"{part.capitalize()}: {one.runs:,} {'run' if one.runs == 1 else 'runs'}, {one.rows:,} rows scored"
        return f"{title}\n{plaintext.columns(rows)}"

    def _parameters(self) -> str:
        """Where each free number began, and where it is."""
        columns = ["start", "noise estimation", "tuned", "error", "true"]
        rows = [
            [p.name, _known(p.start), _known(p.estimated), _known(p.value), _error(p.error), _known(p.true)]
            for p in self.parameters
        ]
        used = [0, *[k for k in range(1, 6) if any(row[k] for row in rows)]]
        table = plaintext.columns([[row[k] for k in used] for row in [["", *columns], *rows]])
        frozen = f"\n{plaintext.wrapped(', '.join(self.frozen), 'frozen: ')}" if self.frozen else ""
        return f"Parameters; standard errors: {self.errors_by}\n{table}{frozen}"

    def _matrices(self) -> str:
        """The tuned covariances."""
        if TUNED not in self.covariances:
            return ""
        dt, Q, R, P0 = self.covariances[TUNED]
        named = {f"Q over {dt:.4g} s": Q} | {f"R of {sensor}": own for sensor, own in R.items()} | {"P0": P0}
        return "\n".join(["Tuned covariances", *[f"  {name}\n{plaintext.matrix(M)}" for name, M in named.items()]])


def _measured(value: float, error: float) -> str:
    return f"{value:.4g} ± {error:.1g}" if np.isfinite(error) else f"{value:.4g}"


def _judged(score: Consistency | None) -> str:
    """A mean over its expectation, and on which side of its bounds it is."""
    if score is None or not np.isfinite(score.mean):
        return ""
    verdict = consistency.verdict(score)
    return f"{score.mean / score.expected:.3g}" + ("" if verdict == "unknown" else f" {verdict}")


def _bounds(score: Consistency | None) -> str:
    if score is None or not np.isfinite([score.low, score.high]).all():
        return ""
    return f"{score.low / score.expected:.3g} to {score.high / score.expected:.3g}"


def _known(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _error(error: float) -> str:
    return "unknown" if np.isnan(error) else f"± {error:.2g}"
