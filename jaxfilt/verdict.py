"""What the scores of a filter say, in words: which part of the state, how much, since when.

The rules, for one filter:

1. *Faults and divergence first.* Any faulty or diverged run makes the filter inconsistent.
2. *Significance.* By block of the state and by sensor, the mean over runs and time is tested (NEES, NIS), and the means
   at the single steps (T times the smallest p-value, above and below apart); by component the mean normalised error; by
   sensor the autocorrelation of the innovations (L times the smallest of L lags). All of these together are one family:
   Holm's procedure keeps the probability of any false alarm below ``1 - confidence``.
3. *Size, apart from significance.* With enough runs any filter is caught. An effect is *slight*, is said, and does not
   make the filter inconsistent, where the ratio to the expectation is within 5 % of 1, or the mean normalised error or
   the autocorrelation within 0.05 of 0.
4. *When.* A step is outside if its own p is below ``(1 - confidence) / T``. The stretch is the run of steps with the
   most steps outside less four for each one that is not, so that at least 80 % of it, and of each beginning and end
   of it, are outside. It is quoted, with the ratio of its own steps, if it holds half of the excess over all steps;
   else the effect is one "on average". A stretch that begins or ends within 5 % of the study's ends reaches them.
5. *Blocks before the whole.* The state as a whole is not repeated where a block is off in the same direction and the
   whole is not much further off (1.5 times the logarithm of the ratio).
6. *A gate lowers the NIS* of what it lets pass: a low NIS with refused readings is said, and not held against the
   filter.
7. *Causes* are named only where NEES and NIS together say so. Under `FEW` runs the bounds are too wide, which is said.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxfilt.consistency import CONFIDENCE, Consistency
from jaxfilt.findings import KINDS, SLIGHT, Bias, Finding, Squares, count, figure, significant
from jaxfilt.metrics import Blocks, Whiteness
from jaxfilt.scores import STATE, Diverged, Fault, Scores

FEW = 20
"""Runs below which a study says that they are too few."""

FURTHER = 1.5
"""How much further off than its blocks, in the logarithm, the whole state must be to be named beside them."""


class Verdict(NamedTuple):
    """Whether nothing but slight effects was found against a filter, a ``headline``, and all findings, worst first.

    Where nothing could be tested, ``consistent`` is False and the headline says so.
    """

    consistent: bool
    headline: str
    findings: tuple[Finding, ...]


def verdicts(
    scores: Mapping[str, Scores],
    diverged: Mapping[str, Diverged],
    faults: Mapping[str, Fault | None],
    *,
    blocks: Blocks,
    t: np.ndarray,
    confidence: float,
    runs: int,
) -> dict[str, Verdict]:
    """The verdict on each filter of a study.

    Args:
        scores, diverged, faults: by filter, as a study has them.
        blocks: name -> (indices of the tangent vector, unit).
        t: (T,) s, the times of the steps.
        confidence: 1 - the probability that a consistent filter is called inconsistent.
        runs: of the study, diverged ones included.

    Returns:
        filter -> `Verdict`: "ekf overconfident in heading: ANEES 2.3 x expected from step 120 on (t = 12 s)".
    """
    return {
        name: _of_study(name, s, diverged[name], faults[name], blocks, t, confidence, runs)
        for name, s in scores.items()
    }


def innovation_verdict(
    nis_total: Mapping[str, Consistency],
    whiteness: Mapping[str, Whiteness],
    nees: Consistency | None = None,
    confidence: float = CONFIDENCE,
    *,
    name: str = "filter",
    refused: Mapping[str, int] | None = None,
) -> Verdict:
    """The verdict on a filter that ran over one recording, by its innovations: no truth is needed.

    Args:
        nis_total: by sensor, from `jaxfilt.metrics.anis`.
        whiteness: by sensor, from `jaxfilt.metrics.whiteness` at this ``confidence``.
        nees: with a truth, from `jaxfilt.bootstrap.anees_of_one_run`.
        confidence: as in `verdicts`.
        name: of the filter.
        refused: by sensor, how many readings a gate refused.

    Example: 1000 readings whose innovations are 1.5 times as large, squared, as the filter claims.
        >>> from jaxfilt.consistency import mean_of_squares
        >>> nis = {"gnss": mean_of_squares(3000.0, 2000, 1000)}
        >>> innovation_verdict(nis, {}, name="ekf").headline
        'ekf inconsistent: innovations of gnss larger than claimed: NIS 1.5 x expected'
    """
    squares = [] if nees is None else [Squares("ANEES", STATE, nees, whole=True)]
    squares += [Squares("NIS", k, c, refused=(refused or {}).get(k, 0)) for k, c in nis_total.items()]
    found = significant(squares, (), whiteness, confidence)
    return _spoken(name, found, squares, whiteness, confidence, "in this recording", [])


def _of_study(
    name: str,
    s: Scores,
    lost: Diverged,
    fault: Fault | None,
    blocks: Blocks,
    t: np.ndarray,
    confidence: float,
    runs: int,
) -> Verdict:
    parts = [b for b in s.nees_total if b != STATE]
    squares = [Squares("ANEES", b, s.nees_total[b], s.nees[b], b == STATE) for b in [STATE, *parts]]
    squares += [Squares("NIS", k, c, s.nis[k], refused=s.refused[k]) for k, c in s.nis_total.items()]
    found = significant(squares, _biases(s, blocks), s.whiteness, confidence, t)
    extra = _broken(lost, fault, runs)
    if runs < FEW:
        whole = s.nees_total[STATE]
        low, high = figure(whole.low / whole.expected), figure(whole.high / whole.expected)
        passes = "" if high in ("nan", "inf") else f"; any ANEES of {low} to {high} x expected passes"
        text = f"{count(runs, 'run')}: too few to tell small inconsistencies{passes}"
        extra.append(Finding("few runs", "", math.nan, math.nan, None, text))
    return _spoken(name, found, squares, s.whiteness, confidence, f"with {count(runs, 'run')}", extra)


def _biases(s: Scores, blocks: Blocks) -> list[Bias]:
    """By component of the tangent space, named after the first block that holds it."""
    from scipy.special import stdtr

    n = len(s.normalised_error.mean)
    names = {i: f"component {i}" for i in range(n)}
    for block, (index, _) in reversed(list(blocks.items())):
        names |= {i: block if len(index) == 1 else f"{block}[{k}]" for k, i in enumerate(index)}
    deviates = np.abs(s.bias.value) / np.where(s.bias.error > 0, s.bias.error, np.nan)
    p = 2 * stdtr(max(s.runs - 1, 1), -deviates)
    total = s.normalised_error
    return [
        Bias(
            names[i],
            Consistency(total.mean[i], 0.0, total.low[i], total.high[i], total.p[i]),
            Consistency(s.bias.value[:, i], 0.0, np.nan, np.nan, p[:, i]),
        )
        for i in range(n)
    ]


def _broken(lost: Diverged, fault: Fault | None, runs: int) -> list[Finding]:
    """Faulty runs count as diverged (`jaxfilt.metrics.diverged`); here they are told apart."""
    findings, nan = [], math.nan
    faulty = 0 if fault is None else fault.runs
    if fault is not None:
        text = (
            f"faulty in {faulty:,} of {count(runs, 'run')}: first at step {fault.step}, run {fault.run}, "
            f"sensor {fault.sensor}, {fault.status.name}"
        )
        findings.append(Finding("faulty", fault.sensor, faulty / runs, nan, fault.step, text))
    if lost.runs > faulty:
        others = " otherwise" if faulty else ""
        text = f"diverged{others} in {lost.runs - faulty:,} of {count(runs, 'run')}"
        text += f" (of the lost runs the first: {', '.join(map(str, lost.first[:3]))})" if lost.first else ""
        findings.append(Finding("diverged", STATE, (lost.runs - faulty) / runs, nan, None, text))
    return findings


def _without_the_whole(found: list[Finding]) -> list[Finding]:
    """Without what is said of the whole state, where a block that is about as far off says the same (rule 5)."""

    def off(f: Finding) -> float:
        return abs(math.log(f.ratio)) if f.ratio > 0 else math.inf

    kept = []
    for f in found:
        same = [g for g in found if g.kind == f.kind and g.where != STATE]
        if f.where != STATE or all(off(f) > FURTHER * off(g) for g in same):
            kept.append(f)
    return kept


def _causes(squares: list[Squares], found: list[Finding]) -> list[Finding]:
    """What NEES and NIS together say of the cause (rule 7)."""
    serious = [f for f in found if not f.slight]
    innovations = {q.where for q in squares if q.name == "NIS" and math.isfinite(q.total.p)}
    off = [f for f in serious if f.kind == "inconsistent innovations"]
    high, low = {f.where for f in off if f.ratio > 1}, {f.where for f in off if f.ratio < 1}
    optimistic = any(f.kind == "overconfident" for f in serious)
    pessimistic = any(f.kind == "underconfident" for f in serious)
    text = ""
    if not innovations:
        return []
    if optimistic and not pessimistic and high == innovations:
        text = "NIS of every sensor is high as well: Q or R too small"
    elif pessimistic and not optimistic and low == innovations:
        text = "NIS of every sensor is low as well: Q or R too large"
    elif optimistic and not high and not low:
        text = "NIS is as expected: errors that the innovations do not show (unobserved or slow: bias, linearisation)"
    elif (optimistic or pessimistic) and len(high | low) == 1 < len(innovations):
        (sensor,) = high | low
        text = f"NIS is off for {sensor} alone: its R or its model"
    return [Finding("cause", "", math.nan, math.nan, None, text)] if text else []


def _spoken(
    name: str,
    found: list[Finding] | None,
    squares: list[Squares],
    whiteness: Mapping[str, Whiteness],
    confidence: float,
    sample: str,
    extra: list[Finding],
) -> Verdict:
    """One sentence from all findings: the worst first, of the rest what and where."""
    causes = _causes(squares, found or [])
    findings = sorted([*extra, *_without_the_whole(found or []), *causes], key=_gravity)
    against = [f for f in findings if not f.slight and f.kind not in ("cause", "few runs")]
    few = next((f"; {f.text}" for f in findings if f.kind == "few runs"), "")
    if against:
        # Of innovations alone nobody can say "the filter ..."
        subject = f"{name} inconsistent:" if against[0].text.startswith("innovations") else name
        others = list(dict.fromkeys(_noun(f) for f in against[1:]))
        also = f"; also {', '.join(others)}" if others else ""
        return Verdict(False, f"{subject} {against[0].text}{also}{few}", tuple(findings))
    if found is None:
        return Verdict(False, f"{name}: nothing to judge by{few}", tuple(findings))
    slight = [f for f in findings if f.slight]
    if slight:
        text = f"{name} consistent to within {SLIGHT:.0%}".replace("%", " %")
        return Verdict(True, f"{text}: {slight[0].text}, detectable {sample}{few}", tuple(findings))
    facts = [_bounds(q, confidence) for q in squares[:1] if math.isfinite(q.total.low)]
    if any(np.isfinite(w.autocorrelation).any() for w in whiteness.values()):
        facts.append("innovations white")
    return Verdict(True, f"{name} consistent: {', '.join(facts)}{few}", tuple(findings))


def _gravity(f: Finding) -> tuple:
    size = abs(math.log(f.ratio)) if f.ratio > 0 and f.kind not in ("biased", "correlated") else abs(f.ratio)
    return f.slight, KINDS.index(f.kind), -size if math.isfinite(size) else 0.0


def _noun(f: Finding) -> str:
    """ "overconfident in heading", "innovations of gnss not white": the text up to its figures."""
    return f.text.split(":")[0]


def _bounds(q: Squares, confidence: float) -> str:
    mean, low, high = (f"{a / q.total.expected:.2f}" for a in (q.total.mean, q.total.low, q.total.high))
    of = "" if q.whole else f" of {q.where}"
    return f"{q.name}{of} {mean} x expected ({100 * confidence:g} % bounds {low} to {high})"
