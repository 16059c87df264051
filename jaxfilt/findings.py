"""What is significant in the scores of a filter, how large it is and since when: the evidence for a verdict.

The rules are those of `jaxfilt.verdict`, which puts them into one sentence.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxfilt.consistency import Consistency, holm
from jaxfilt.metrics import Whiteness

SLIGHT = 0.05
"""An effect of at most this size is detectable with enough runs, and of no consequence."""

STAYS, EDGE, EXPLAINS = 0.8, 0.05, 0.5
"""Share of a stretch that is outside, share of the steps that counts as an end, share of an excess that explains it."""

KINDS = (
    "faulty",
    "diverged",
    "overconfident",
    "biased",
    "underconfident",
    "inconsistent innovations",
    "correlated",
    "cause",
    "few runs",
)
"""What a finding can be, worst first; the last two explain and accuse nobody."""


class Finding(NamedTuple):
    """One thing found: its ``kind``, of `KINDS`; ``where``, the block, component or sensor; ``text``, a phrase.

    ``ratio``: mean over expectation of the stretch; of a bias the mean normalised error, of a correlation rho, of
    faults and divergence the share of the runs. ``p``: before Holm's correction. ``since``: first row of the stretch,
    None for what is on average only. ``slight``: of no consequence.
    """

    kind: str
    where: str
    ratio: float
    p: float
    since: int | None
    text: str
    slight: bool = False


class Squares(NamedTuple):
    """Normalised squares to test, ``name`` "ANEES" or "NIS": of a block or sensor, in ``total`` and by step.

    ``whole``: of the whole state. ``refused``: readings that a gate kept out of it.
    """

    name: str
    where: str
    total: Consistency
    steps: Consistency | None = None
    whole: bool = False
    refused: int = 0


class Bias(NamedTuple):
    """A component's mean normalised error in ``total``, and its mean error at each step, with a p-value."""

    where: str
    total: Consistency
    steps: Consistency


def significant(
    squares: Sequence[Squares],
    biases: Sequence[Bias],
    whiteness: Mapping[str, Whiteness],
    confidence: float,
    t: np.ndarray | None = None,
) -> list[Finding] | None:
    """What is significant in the family of all these tests; None where there was nothing to test.

    Args:
        squares, biases: as many as there are.
        whiteness: by sensor, with bounds at this ``confidence``.
        confidence: 1 - the probability of any false alarm.
        t: (T,) s, times of the steps.
    """
    level = 1 - confidence
    p = {(i, side): _p(q, side) for i, q in enumerate(squares) for side in ("total", "above", "below")}
    p |= {("bias", i): float(b.total.p) for i, b in enumerate(biases)}
    p |= {("white", name): _p_white(w, confidence) for name, w in whiteness.items()}
    if not any(map(math.isfinite, p.values())):
        return None
    rejected = dict(zip(p, holm(np.array(list(p.values())), level), strict=True))
    findings = []
    for i, q in enumerate(squares):
        for side in ("above", "below"):
            on_average = rejected[i, "total"] and (q.total.mean > q.total.expected) == (side == "above")
            if on_average or rejected[i, side]:
                least = np.nanmin([p[i, "total"] if on_average else 1.0, p[i, side]])
                findings.append(_of_squares(q, side == "above", on_average, float(least), level, t))
    findings += [_of_bias(b, level, t) for i, b in enumerate(biases) if rejected["bias", i]]
    return findings + [_of_correlation(k, w, p["white", k]) for k, w in whiteness.items() if rejected["white", k]]


def _p(q: Squares, side: str) -> float:
    if side == "total":
        return float(q.total.p)
    if q.steps is None:
        return math.nan
    known = np.isfinite(q.steps.p)
    here = known & ((q.steps.mean > q.steps.expected) == (side == "above"))
    return min(1.0, float(known.sum() * q.steps.p[here].min())) if here.any() else math.nan


def _p_white(white: Whiteness, confidence: float) -> float:
    """Of the most correlated lag, times the number of lags; the bound says what a standard deviation is."""
    from scipy.special import ndtr, ndtri

    deviations = np.abs(white.autocorrelation) / white.bound * ndtri(0.5 + 0.5 * confidence)
    known = deviations[np.isfinite(deviations)]
    return min(1.0, float(len(known) * 2 * ndtr(-known.max()))) if len(known) else math.nan


def _of_squares(q: Squares, above: bool, on_average: bool, p: float, level: float, t: np.ndarray | None) -> Finding:
    ratio, since, when = float(q.total.mean / q.total.expected), None, ""
    if q.steps is not None:
        excess = np.asarray(q.steps.mean - q.steps.expected)
        when, since, rows = _when(q.steps.p, (excess > 0) == above, excess if on_average else None, level, t)
        if len(rows):
            ratio = float(np.mean(q.steps.mean[rows]) / np.mean(q.steps.expected[rows]))
    small = abs(ratio - 1) <= SLIGHT
    gated = q.refused > 0 and not above
    adverb = "slightly " if small else ""
    if q.name == "NIS":
        kind = "inconsistent innovations"
        what = f"innovations of {q.where} {adverb}{'larger' if above else 'smaller'} than claimed"
    else:
        kind = "overconfident" if above else "underconfident"
        what = f"{adverb}{kind}" + ("" if q.whole else f" in {q.where}")
    gate = f"; the gate, which refused {count(q.refused, 'reading')}, lowers it" if gated else ""
    text = f"{what}: {q.name} {figure(ratio)} x expected{when}{gate}"
    return Finding(kind, q.where, ratio, p, since, text, small or gated)


def _of_bias(b: Bias, level: float, t: np.ndarray | None) -> Finding:
    value = float(b.total.mean)
    when, since, _ = _when(b.steps.p, (b.steps.mean > 0) == (value > 0), b.steps.mean, level, t)
    slight = abs(value) <= SLIGHT
    text = (  # errors are truth minus estimate
        f"{'slightly ' if slight else ''}biased in {b.where}: the estimate is {figure(abs(value))} of its claimed "
        f"standard deviation too {'low' if value > 0 else 'high'}{when}"
    )
    return Finding("biased", b.where, value, float(b.total.p), since, text, slight)


def _of_correlation(sensor: str, white: Whiteness, p: float) -> Finding:
    k = int(np.nanargmax(np.abs(white.autocorrelation) / white.bound))
    rho = float(white.autocorrelation[k])
    slight = abs(rho) <= SLIGHT
    what = f"innovations of {sensor} {'slightly correlated' if slight else 'not white'}"
    return Finding(
        "correlated", sensor, rho, p, None, f"{what}: autocorrelation {figure(rho)} at lag {white.lags[k]}", slight
    )


def _when(
    p: np.ndarray, side: np.ndarray, excess: np.ndarray | None, level: float, t: np.ndarray | None
) -> tuple[str, int | None, np.ndarray]:
    """(", from step a on", a, rows of the stretch) of what is outside on this side; see rule 4 of `jaxfilt.verdict`.

    ``excess`` (T,) where the mean over all steps is significant, which the stretch has then to explain.
    """
    known = np.flatnonzero(np.isfinite(p))
    steps = len(known)
    out = (p[known] <= level / max(steps, 1)) & side[known]
    if not out.any():
        return " on average, at no single step", None, known[:0]
    first, last = _stretch(out)
    rows = known[first : last + 1]
    with np.errstate(divide="ignore", invalid="ignore"):  # an infinite excess is explained by the stretch that has it
        explained = 1.0 if excess is None else excess[rows].sum() / excess[known].sum()
    if explained < EXPLAINS:
        return f" on average, at {out.sum()} of {steps} steps also by itself", None, known[:0]
    a, b = int(rows[0]), int(rows[-1])
    early, late = first <= EDGE * steps, last >= steps - 1 - EDGE * steps
    time = (lambda k: "") if t is None else (lambda k: f" (t = {t[k]:.4g} s)")
    if a == b and steps > 1:
        return f" at step {a}{time(a)}", a, rows
    if early and late:
        return " throughout", a, rows
    if late:
        return f" from step {a} on{time(a)}", a, rows
    if early:
        return f" up to step {b}{time(b)}", a, rows
    return f" from step {a}{time(a)} to step {b}{time(b)}", a, rows


def _stretch(out: np.ndarray) -> tuple[int, int]:
    """First and last of the steps with the largest sum of +1 where outside, -4 where not."""
    total = np.concatenate([[0.0], np.cumsum(np.where(out, 1.0, -STAYS / (1 - STAYS)))])
    last = int(np.argmax(total[1:] - np.minimum.accumulate(total)[:-1]))
    return int(np.argmin(total[: last + 1])), last


def figure(a: float) -> str:
    """A ratio to two significant digits, to three about 1.

    Example:
        >>> [figure(a) for a in (2.04, 0.4, 1.02, 23.4, 12345.0)]
        ['2.0', '0.40', '1.02', '23', '12,000']
    """
    if 0.9 <= a < 1.1:
        return f"{a:.2f}"
    return f"{float(f'{a:.2g}'):,.0f}" if 9.95 <= a < 1e6 else f"{a:#.2g}"


def count(number: int, noun: str) -> str:
    """1 run, 10,000 runs."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
