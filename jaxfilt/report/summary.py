"""What a study, a sweep or a replay found, as plain data: the layout of ``summary.json``."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from jaxfilt import checkpoint, chisquare
from jaxfilt.bound import Bound, efficiency
from jaxfilt.consistency import Consistency
from jaxfilt.metrics import Blocks, Whiteness
from jaxfilt.report.plain import judged, plain
from jaxfilt.review import Replayed, Review
from jaxfilt.scores import STATE, Fault, Paired, Scores
from jaxfilt.study import Study
from jaxfilt.sweep import Sweep
from jaxfilt.verdict import Verdict

STUDY, SWEEP, REPLAY = "jaxfilt.study/2", "jaxfilt.sweep/1", "jaxfilt.replay/2"
"""Schemas; the number grows when a field changes its meaning or goes away, not when one is added."""


def summary(
    result: Study | Sweep | Replayed, name: str = "", bound: Bound | None = None, command: str = ""
) -> dict[str, Any]:
    """All that was found, as what JSON can hold: dicts, lists, numbers, text, None for what is not a finite number.

    Numbers have six digits, parameters all of theirs. An *estimate* is value and error (standard error of Monte Carlo).
    A *test* is mean, expected, ratio (mean over expected), low, high (bounds), p, and verdict: "inside", "above" or
    "below" its bounds, or "unknown"; over time it has ``share_inside``, the share of the steps at which the mean over
    runs is inside.

    Always: ``schema``; ``name`` and ``command`` as given; ``verdicts``: filter -> consistent, headline, findings, worst
    first; ``settings``; ``made_with``: versions and device; ``seconds``: compile, run.

    "jaxfilt.study/2" has ``complete`` (all planned runs were done); ``settings``: seed, runs, planned, steps, dtype,
    confidence, chunk, workers, devices, theta and truth_theta (each parameter by its way in the tree); ``bound``: None,
    or exact, kind, and by block rmse and linearised, the least root mean square error over all steps; ``paired``: a
    list of first and second filter, runs, square (by block: value, error, unit), log_score; ``filters`` by name, with

    - ``runs`` in the scores, ``diverged``: runs, share, first (numbers of the first such runs); ``fault``: None, or
      run, step, sensor, status, runs;
    - ``blocks``: block -> unit, rmse (estimate), claimed (root mean square error that the filter itself expects),
      worst (value, run), efficiency (bound over mean squared error; None without a bound), nees (test);
    - ``state``: nees (test), log_score (estimate), coverage (probability -> test), noncredibility and inclination (dB,
      mean over their rows), and efficiency, the mean of the components';
    - ``components``: name -> normalised_error (test);
    - ``sensors``: sensor -> nis (test), refused (readings), whiteness: lags, autocorrelation, bound;
    - ``kept``: None where no run diverged; else runs, rmse by block and nees by block over the others;
    - ``over_time``: t (s), and by row rmse and claimed by block, efficiency by block, nees by block and coverage by
      probability (mean, expected, low, high), nis by sensor (the same), bias by component, log_score, noncredibility,
      inclination.

    "jaxfilt.sweep/1" has ``complete``, the settings that all studies share, ``over``: name -> values, and ``points``: a
    list, the last parameter fastest, of ``at`` (name -> value), theta, truth_theta, verdicts, and ``filters`` as above
    but without over_time.

    "jaxfilt.replay/2" has ``settings``: steps, dtype, confidence, theta; and ``filters`` by name, with ``blocks``:
    block -> unit, rmse, and ``state``: nees (test), both None without a truth; ``sensors`` as above, ``diverged``,
    ``fault``.

    Args:
        result: from `jaxfilt.study`, `jaxfilt.sweep` or `jaxfilt.replayed`.
        name: of what was studied.
        bound: from `jaxfilt.cramer_rao`, of a study.
        command: what to type to get the same again.

    Example:
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> from jaxfilt.study import study
        >>> def walk(theta):
        ...     return jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> def start(theta):
        ...     return jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> log = jf.schedule(walk(()), steps=20, dt=1.0)
        >>> filters = {"kf": lambda theta: jf.kf(walk(theta))}
        >>> found = summary(study(walk, filters, start, log, jax.random.key(0), theta=(), runs=30), "walk")
        >>> found["schema"], found["settings"]["runs"], found["verdicts"]["kf"]["consistent"]
        ('jaxfilt.study/2', 30, True)
    """
    if isinstance(result, Study):
        found = _study(result, bound)
    else:
        found = _sweep(result) if isinstance(result, Sweep) else _replayed(result)
    schema = {Study: STUDY, Sweep: SWEEP, Replayed: REPLAY}[type(result)]
    return plain({"schema": schema, "name": name, "command": command, **found})


def component_names(blocks: Blocks, dim: int) -> list[str]:
    """Each component of the tangent space, named after the first block that holds it: ``position[0]``, ``yaw``."""
    names = {i: f"x[{i}]" for i in range(dim)}
    for block, (index, _) in reversed(list(blocks.items())):
        names |= {i: block if len(index) == 1 else f"{block}[{k}]" for k, i in enumerate(index)}
    return [names[i] for i in range(dim)]


def least(bound: np.ndarray, index: tuple[int, ...]) -> np.ndarray:
    """The root mean square error of a block that a bound (T, n, n) allows, (T,)."""
    return np.sqrt(np.diagonal(bound, axis1=1, axis2=2)[:, list(index)].sum(1))


def _study(s: Study, bound: Bound | None) -> dict[str, Any]:
    return {
        "complete": s.runs == s.planned,
        "verdicts": {name: _verdict(v) for name, v in s.verdicts.items()},
        "settings": _settings(s) | {"theta": checkpoint.named(s.theta), "truth_theta": checkpoint.named(s.truth_theta)},
        "made_with": checkpoint.made_with(),
        "seconds": {"compile": s.compile_seconds, "run": s.run_seconds},
        "bound": None if bound is None else _bound(s, bound),
        "paired": [_paired(s, names, p) for names, p in s.paired.items()],
        "filters": {name: _filter(s, name, bound) | {"over_time": _over_time(s, name, bound)} for name in s.scores},
    }


def _settings(s: Study) -> dict[str, Any]:
    fields = ("seed", "runs", "planned", "steps", "dtype", "confidence", "chunk", "workers", "devices")
    return {field: getattr(s, field) for field in fields}


def _sweep(swept: Sweep) -> dict[str, Any]:
    studies: list[Study] = list(swept.studies.flat)
    first = studies[0]
    points = []
    for where, s in zip(np.ndindex(swept.studies.shape), studies, strict=True):
        points.append(
            {
                "at": {name: values[k] for k, (name, values) in zip(where, swept.over.items(), strict=True)},
                "theta": checkpoint.named(s.theta),
                "truth_theta": checkpoint.named(s.truth_theta),
                "verdicts": {name: _verdict(v) for name, v in s.verdicts.items()},
                "filters": {name: _filter(s, name, None) for name in s.scores},
            }
        )
    return {
        "complete": first.runs == first.planned,
        "over": swept.over,
        "settings": _settings(first),
        "made_with": checkpoint.made_with(),
        "seconds": {"compile": first.compile_seconds, "run": first.run_seconds},
        "points": points,
    }


def _replayed(r: Replayed) -> dict[str, Any]:
    return {
        "verdicts": {name: _verdict(review.verdict) for name, review in r.reviews.items()},
        "settings": {"steps": len(r.t), "dtype": r.dtype, "confidence": r.confidence}
        | {"theta": checkpoint.named(r.theta)},
        "made_with": checkpoint.made_with(),
        "seconds": {"compile": r.compile_seconds, "run": r.run_seconds},
        "filters": {name: _review(r, review) for name, review in r.reviews.items()},
    }


def _review(r: Replayed, review: Review) -> dict[str, Any]:
    blocks = state = None
    if review.rmse is not None:
        blocks = {b: {"unit": unit, "rmse": review.rmse[b]} for b, (_, unit) in r.blocks.items()}
    if review.nees_mean is not None and review.nees is not None:
        low, high = chisquare.bounds(r.confidence, r.space.dim)
        rows = Consistency(review.nees, r.space.dim, low, high)
        state = {"nees": judged(review.nees_mean, rows)}
    return {
        "diverged": review.diverged,
        "fault": _fault(review.fault),
        "blocks": blocks,
        "state": state,
        "sensors": {
            sensor: {
                "nis": judged(nis),
                "refused": review.refused[sensor],
                "whiteness": _white(review.whiteness[sensor]),
            }
            for sensor, nis in review.nis.items()
        },
    }


def _filter(s: Study, name: str, bound: Bound | None) -> dict[str, Any]:
    """What one filter of a study did, over all runs and steps."""
    c, kept, lost = s.scores[name], s.kept[name], s.diverged[name]
    efficient = {}
    if bound is not None:
        whole = efficiency(bound.cov.mean(0)[None], c.mse.mean(0)[None], s.blocks)
        efficient = {block: float(value[0]) for block, value in whole.items()}
    normalised = [Consistency(*parts) for parts in zip(*c.normalised_error, strict=True)]
    return {
        "runs": c.runs,
        "diverged": {"runs": lost.runs, "share": lost.runs / s.runs if s.runs else None, "first": lost.first},
        "fault": _fault(s.faults[name]),
        "blocks": {
            block: {
                "unit": unit,
                "rmse": c.rmse_total[block],
                "claimed": _root_mean(c.claimed[block]),
                "worst": c.worst[block],
                "efficiency": efficient.get(block),
                "nees": judged(c.nees_total[block], c.nees[block]),
            }
            for block, (_, unit) in s.blocks.items()
        },
        "state": {
            "nees": judged(c.nees_total[STATE], c.nees[STATE]),
            "log_score": c.log_score_total,
            "coverage": {str(level): judged(c.coverage_total[level], c.coverage[level]) for level in c.coverage},
            "noncredibility": _mean(c.noncredibility),
            "inclination": _mean(c.inclination),
            "efficiency": efficient.get("total"),
        },
        "components": {
            component: {"normalised_error": judged(error)}
            for component, error in zip(component_names(s.blocks, s.space.dim), normalised, strict=True)
        },
        "sensors": {
            sensor: {
                "nis": judged(c.nis_total[sensor], c.nis[sensor]),
                "refused": c.refused[sensor],
                "whiteness": _white(c.whiteness[sensor]),
            }
            for sensor in c.nis
        },
        "kept": None if not lost.runs else _kept(kept),
    }


def _kept(c: Scores) -> dict[str, Any]:
    nees = {block: judged(total) for block, total in c.nees_total.items()}
    return {"runs": c.runs, "rmse": c.rmse_total, "nees": nees}


def _over_time(s: Study, name: str, bound: Bound | None) -> dict[str, Any]:
    c = s.scores[name]
    series = lambda scores: {str(k): _series(score) for k, score in scores.items()}  # noqa: E731
    return {
        "t": s.t,
        "rmse": c.rmse,
        "claimed": c.claimed,
        "efficiency": None if bound is None else efficiency(bound.cov, c.mse, s.blocks),
        "nees": series(c.nees),
        "nis": series(c.nis),
        "coverage": series(c.coverage),
        "bias": dict(zip(component_names(s.blocks, s.space.dim), np.asarray(c.bias.value).T, strict=True)),
        "log_score": c.log_score,
        "noncredibility": c.noncredibility,
        "inclination": c.inclination,
    }


def _bound(s: Study, bound: Bound) -> dict[str, Any]:
    over = lambda cov: {name: _root_mean(least(cov, index)) for name, (index, _) in s.blocks.items()}  # noqa: E731
    return {"exact": bound.exact, "kind": bound.kind, "rmse": over(bound.cov), "linearised": over(bound.linearised)}


def _paired(s: Study, names: tuple[str, str], p: Paired) -> dict[str, Any]:
    square = {block: p.square[block]._asdict() | {"unit": squared(unit)} for block, (_, unit) in s.blocks.items()}
    return {"first": names[0], "second": names[1], "runs": p.runs, "square": square, "log_score": p.log_score}


def squared(unit: str) -> str:
    """A unit's square.

    Example:
        >>> squared("m"), squared("m/s"), squared("")
        ('m^2', '(m/s)^2', '')
    """
    return f"({unit})^2" if "/" in unit or " " in unit else f"{unit}^2" if unit else ""


def _series(c: Consistency) -> dict[str, Any]:
    return {"mean": c.mean, "expected": c.expected, "low": c.low, "high": c.high}


def _white(w: Whiteness) -> dict[str, Any]:
    return w._asdict()


def _fault(fault: Fault | None) -> dict[str, Any] | None:
    return None if fault is None else fault._asdict() | {"status": fault.status.name}


def _verdict(v: Verdict) -> dict[str, Any]:
    return {"consistent": v.consistent, "headline": v.headline, "findings": [f._asdict() for f in v.findings]}


def _mean(a: np.ndarray) -> float:
    """Of what is finite."""
    there = a[np.isfinite(a)]
    return float(there.mean()) if len(there) else math.nan


def _root_mean(a: np.ndarray) -> float:
    return math.sqrt(_mean(np.asarray(a) ** 2))
