"""Verdicts on studies simulated in plain NumPy, where what is wrong, how much and since when is known."""

import numpy as np
import pytest
import scipy.stats

import jaxfilt as jf
from jaxfilt import findings
from jaxfilt.consistency import Consistency, anees_total, mean_error, mean_of_squares
from jaxfilt.findings import KINDS, figure
from jaxfilt.metrics import Whiteness, whiteness_of_sums
from jaxfilt.scores import STATE, Diverged, Estimate, Fault, Histogram, Scores
from jaxfilt.verdict import innovation_verdict, verdicts

BLOCKS = {"position": ((0, 1), "m"), "heading": ((2,), "rad")}
STEPS, LAGS = 100, 5


def simulated(seed, runs=100, steps=STEPS, rho=0.8, scale=1.0, bias=0.0, nis=None, colour=0.0):
    """Errors (runs, T, 3) and innovations of two sensors (runs, T, 2), normalised by what the filter claims.

    ``scale`` of the errors, ``bias`` added to them, ``nis`` sensor -> scale of its innovations, ``colour`` their
    autocorrelation.
    """
    rng = np.random.default_rng(seed)

    def persistent(dim, keep):
        e = rng.normal(size=(runs, steps, dim))
        for k in range(1, steps):
            e[:, k] = keep * e[:, k - 1] + np.sqrt(1 - keep**2) * e[:, k]
        return e

    error = persistent(3, rho) * scale + bias
    return error, {s: persistent(2, colour) * (nis or {}).get(s, 1.0) for s in ("gnss", "compass")}


def scored(error, innovations, confidence=0.999, refused=None):
    """The sums that a study keeps, and its scores: only those that a verdict reads are filled."""
    runs, steps, n = error.shape
    parts = {**{name: list(index) for name, (index, _) in BLOCKS.items()}, STATE: [0, 1, 2]}
    nees, nees_total, nis, nis_total, white = {}, {}, {}, {}, {}
    for name, index in parts.items():
        values, dim = (error[..., index] ** 2).sum(-1), len(index)
        nees[name] = mean_of_squares(values.sum(0), np.full(steps, dim * runs), np.full(steps, runs), confidence)
        a = values.mean(1)
        nees_total[name] = anees_total(runs, a.mean(), a.var(ddof=1), (values**2).mean(), dim, confidence)
    for name, r in innovations.items():
        q = (r**2).sum(-1)
        nis[name] = mean_of_squares(q.sum(0), np.full(steps, 2 * runs), np.full(steps, runs), confidence)
        nis_total[name] = Consistency(*map(float, mean_of_squares(q.sum(), 2 * q.size, q.size, confidence)))
        dots = np.array([(r[:, :-k] * r[:, k:]).sum() for k in range(1, LAGS + 1)])
        pairs = np.array([2 * runs * (steps - k) for k in range(1, LAGS + 1)])
        white[name] = whiteness_of_sums(dots, pairs, q.sum(), 2 * q.size, confidence)
    of_runs, nothing = error.mean(1), Estimate(np.nan, np.nan)
    return Scores(
        runs=runs,
        rmse={},
        rmse_total={},
        claimed={},
        worst={},
        bias=Estimate(error.mean(0), error.std(0, ddof=1) / np.sqrt(runs)),
        mse=np.zeros((steps, n, n)),
        normalised_error=mean_error(runs, of_runs.mean(0), of_runs.var(0, ddof=1), confidence),
        nees=nees,
        nees_total=nees_total,
        coverage={},
        coverage_total={},
        log_score=nothing,
        log_score_total=nothing,
        noncredibility=np.zeros(steps),
        inclination=np.zeros(steps),
        nis=nis,
        nis_total=nis_total,
        refused={"gnss": 0, "compass": 0} | (refused or {}),
        whiteness=white,
        histogram=Histogram(np.zeros(2), np.zeros((n, 1))),
        run_nees=Histogram(np.zeros(2), np.zeros(1)),
    )


def judged(scores, confidence=0.999, diverged=Diverged(0, ()), fault=None, runs=None):
    t = 0.1 * np.arange(len(scores.bias.value))
    given = {"ekf": scores}, {"ekf": diverged}, {"ekf": fault}
    return verdicts(*given, blocks=BLOCKS, t=t, confidence=confidence, runs=runs or scores.runs)["ekf"]


def verdict(seed=0, **what):
    return judged(scored(*simulated(seed, **what)))


def kinds(v):
    return [(f.kind, f.where) for f in v.findings if not f.slight and f.kind != "cause"]


def cause(v):
    return next((f.text for f in v.findings if f.kind == "cause"), None)


def from_step(first, factor, components=(2,), last=STEPS):
    """Scale of the errors: sqrt(factor) on these components from this step on."""
    scale = np.ones((STEPS, 3))
    scale[first:last, list(components)] = np.sqrt(factor)
    return scale


def test_a_consistent_filter_is_called_that_with_its_figures():
    v = verdict()
    assert v.consistent
    assert v.findings == ()
    total = scored(*simulated(0)).nees_total[STATE]
    mean, low, high = total.mean / 3, total.low / 3, total.high / 3
    bounds = f"(99.9 % bounds {low:.2f} to {high:.2f})"
    assert v.headline == f"ekf consistent: ANEES {mean:.2f} x expected {bounds}, innovations white"


def test_false_alarms_are_as_rare_as_they_are_said_to_be():
    """300 consistent studies at 95 %: Holm over some 25 tests each; without it most of them would be accused."""
    alarms, alone = 0, 0
    for seed in range(300):
        scores = scored(*simulated(1000 + seed, runs=30, steps=40), 0.95)
        alarms += not judged(scores, 0.95).consistent
        totals = [*scores.nees_total.values(), *scores.nis_total.values()]
        alone += min([c.p for c in totals] + scores.normalised_error.p.tolist()) < 0.05
    assert scipy.stats.binomtest(alarms, 300, 0.05, alternative="greater").pvalue > 1e-2
    assert alone > 2.5 * 0.05 * 300  # the control: the tests are awake


def test_overconfidence_from_a_step_on_is_found_there_and_as_large_as_it_is():
    v = verdict(scale=from_step(60, 2.3), runs=400)
    (found,) = [f for f in v.findings if f.kind == "overconfident"]
    assert (v.consistent, found.where) == (False, "heading")
    assert abs(found.since - 60) <= 3
    assert found.ratio == pytest.approx(2.3, rel=0.1)
    assert found.p < 1e-6
    since = f"from step {found.since} on (t = {0.1 * found.since:.4g} s)"
    assert v.headline == f"ekf overconfident in heading: ANEES {figure(found.ratio)} x expected {since}"


@pytest.mark.parametrize(
    ("first", "last", "words"),
    [
        (0, 100, " throughout"),
        (4, 97, " throughout"),
        (0, 30, " up to step "),
        (40, 70, " from step "),
        (70, 100, " from step "),
    ],
)
def test_the_stretch_is_said_as_it_is(first, last, words):
    v = verdict(scale=from_step(first, 2.5, last=last), runs=400)
    (found,) = [f for f in v.findings if f.kind == "overconfident"]
    assert words in found.text
    assert abs(found.since - first) <= 2
    assert (" on (t" in found.text) == ((first, last) == (70, 100))
    if last < 90:
        assert abs(int(found.text.split("step ")[-1].split()[0]) - (last - 1)) <= 3
    assert found.ratio == pytest.approx(2.5, rel=0.1)


def test_of_a_stretch_and_of_its_ends_four_fifths_are_outside():
    """Against all stretches tried one by one."""
    rng = np.random.default_rng(0)
    for density in (0.1, 0.5, 0.8, 0.95):
        out = rng.random(60) < density
        out[rng.integers(60)] = True
        first, last = findings._stretch(out)
        gain = np.where(out, 1, -4)
        assert gain[first : last + 1].sum() == max(gain[a:b].sum() for a in range(60) for b in range(a + 1, 61))
        shares = [out[first:k].mean() for k in range(first + 1, last + 2)]
        shares += [out[k : last + 1].mean() for k in range(first, last + 1)]
        assert min(shares) >= 0.8


def test_one_bad_step_is_found_among_many():
    assert " at step 0 (t = 0 s)" in verdict(scale=from_step(0, 3.0, last=1), rho=0.0).headline
    found = verdict(scale=from_step(37, 3.0, last=38), rho=0.0).findings[0]
    assert (found.kind, found.where, found.since) == ("overconfident", "heading", 37)
    assert " at step 37 (t = 3.7 s)" in found.text
    assert found.ratio > 2


def test_what_no_single_step_shows_is_there_on_average():
    found = verdict(scale=from_step(0, 1.2), rho=0.0).findings[0]
    assert (found.kind, found.where, found.since) == ("overconfident", "heading", None)
    assert found.text.endswith("on average, at no single step")
    assert found.ratio == pytest.approx(1.2, rel=0.03)


def test_a_lone_step_is_not_taken_for_the_whole_effect():
    scale = from_step(0, 1.15)
    scale[50, 2] = np.sqrt(2.6)
    found = verdict(scale=scale, rho=0.0).findings[0]
    assert "in heading: ANEES 1.2 x expected on average, at 1 of 100 steps also by itself" in found.text
    assert found.ratio == pytest.approx(1.15, rel=0.05)


def test_too_little_confidence_first_and_too_much_later_are_two_findings():
    scale = from_step(0, 0.4, last=50)
    scale[50:, 2] = np.sqrt(2.5)
    found = {f.kind: f for f in verdict(scale=scale, runs=400).findings if f.where == "heading"}
    assert set(found) == {"overconfident", "underconfident"}
    assert abs(found["overconfident"].since - 50) <= 3
    assert " up to step " in found["underconfident"].text
    assert found["underconfident"].ratio == pytest.approx(0.4, rel=0.1)


def test_the_whole_is_named_where_no_block_explains_it():
    """Errors of opposite sign in two blocks that the filter takes for independent: each block is as claimed."""
    scores = scored(*simulated(0))
    scores.nees_total[STATE] = anees_total(100, 6.0, 0.2, 45.0, 3)
    whole = judged(scores)
    assert kinds(whole)[0] == ("overconfident", STATE)
    assert whole.headline.startswith("ekf overconfident: ANEES 2.0 x expected")
    beside = scored(*simulated(0, scale=from_step(0, 1.3)))
    assert ("overconfident", STATE) not in kinds(judged(beside))
    beside.nees_total[STATE] = anees_total(100, 9.0, 0.2, 90.0, 3)
    assert kinds(judged(beside)) == [("overconfident", STATE), ("overconfident", "heading")]
    every = verdict(scale=from_step(0, 2.0, components=(0, 1, 2)))
    assert {w for k, w in kinds(every) if k == "overconfident"} == {"position", "heading"}


def test_an_infinite_error_is_said_and_breaks_nothing():
    scores = scored(*simulated(0))
    for part in (scores.nees["heading"], scores.nees[STATE]):
        part.mean[7], part.p[7] = np.inf, 0.0
    for name in ("heading", STATE):
        scores.nees_total[name] = anees_total(100, np.inf, np.inf, np.inf, 1)
    v = judged(scores)
    assert v.headline == "ekf overconfident in heading: ANEES inf x expected at step 7 (t = 0.7 s)"


def test_bias_is_found_with_its_sign_and_its_component():
    v = verdict(bias=np.array([0.0, -0.6, 0.0]), runs=200)
    biases = [f for f in v.findings if f.kind == "biased"]
    assert [f.where for f in biases] == ["position[1]"]
    assert biases[0].ratio == pytest.approx(-0.6, abs=0.1)
    # Errors are truth minus estimate: the estimate is too high.
    assert "the estimate is 0.6" in biases[0].text
    assert "too high throughout" in biases[0].text
    assert not v.consistent


def test_correlated_innovations_are_found_and_are_the_sensors():
    v = verdict(colour=0.2)
    assert {k for k in kinds(v) if k[0] == "correlated"} == {("correlated", "gnss"), ("correlated", "compass")}
    assert v.headline.startswith("ekf inconsistent: innovations of ")
    assert " not white: autocorrelation 0.2" in v.headline
    assert " at lag 1; also innovations of " in v.headline


@pytest.mark.parametrize(("deviations", "found"), [(3.4, False), (3.8, True)])
def test_twenty_lags_are_twenty_chances(deviations, found):
    """At 99 %: the largest of 20 is beyond 3.4 deviations with probability 0.013, beyond 3.8 with 0.003."""
    bound = np.full(20, scipy.stats.norm.ppf(0.995) / 10)
    rho = np.where(np.arange(20) == 3, deviations / 10, 0.0)
    v = innovation_verdict({}, {"gnss": Whiteness(np.arange(1, 21), rho, bound)}, confidence=0.99)
    assert [(f.kind, f.ratio) for f in v.findings] == found * [("correlated", deviations / 10)]
    assert (" at lag 4" in v.headline) == found


def test_one_sensor_off_is_named_alone():
    v = verdict(nis={"gnss": np.sqrt(1.8)}, scale=from_step(0, 1.5))
    assert ("inconsistent innovations", "gnss") in kinds(v)
    assert ("inconsistent innovations", "compass") not in kinds(v)
    assert v.headline.endswith("; also innovations of gnss larger than claimed")
    assert cause(v) == "NIS is off for gnss alone: its R or its model"


@pytest.mark.parametrize(
    ("factor", "words"), [(1.6, "high as well: Q or R too small"), (0.6, "low as well: Q or R too large")]
)
def test_the_cause_is_said_where_nees_and_nis_agree(factor, words):
    nis = dict.fromkeys(("gnss", "compass"), np.sqrt(factor))
    v = verdict(nis=nis, scale=from_step(0, factor, components=(0, 1, 2)))
    assert cause(v).endswith(words)


def test_large_errors_under_good_innovations_are_what_the_innovations_do_not_show():
    v = verdict(scale=from_step(0, 2.0))
    assert cause(v).startswith("NIS is as expected: errors that the innovations do not show")


def test_no_cause_is_given_for_nothing():
    assert cause(verdict()) is None
    assert cause(verdict(colour=0.2)) is None


def test_a_slight_effect_is_said_and_does_not_condemn():
    v = verdict(scale=from_step(0, 1.03), rho=0.0, runs=10_000)
    assert v.consistent
    assert [f.slight for f in v.findings] == [True]
    text = "ekf consistent to within 5 %: slightly overconfident in heading: ANEES 1.03 x expected"
    assert v.headline.startswith(text)
    assert v.headline.endswith(", detectable with 10,000 runs")


def test_slight_correlation_and_bias_do_not_condemn_either():
    colour = verdict(colour=0.03, runs=1000)
    assert colour.consistent
    assert "slightly correlated: autocorrelation 0.03" in colour.headline
    bias = verdict(bias=0.03, rho=0.0, runs=1000)
    assert bias.consistent
    assert {f.kind for f in bias.findings} >= {"biased"}


def test_faults_and_divergence_come_first():
    scores = scored(*simulated(0, runs=97, scale=from_step(0, 2.5)))
    fault = Fault(12, 88, "gnss", jf.Status.BAD_MEASUREMENT, 1)
    v = judged(scores, diverged=Diverged(3, (4, 12, 60)), fault=fault, runs=100)
    assert [f.kind for f in v.findings[:3]] == ["faulty", "diverged", "overconfident"]
    assert v.headline.startswith(
        "ekf faulty in 1 of 100 runs: first at step 88, run 12, sensor gnss, BAD_MEASUREMENT; also diverged otherwise"
    )
    assert "diverged otherwise in 2 of 100 runs" in v.findings[1].text
    only = judged(scored(*simulated(0)), diverged=Diverged(1, (7,)), runs=101)
    assert (only.consistent, only.headline) == (False, "ekf diverged in 1 of 101 runs (of the lost runs the first: 7)")
    same = judged(scored(*simulated(0)), diverged=Diverged(1, (12,)), fault=fault, runs=101)
    assert [f.kind for f in same.findings] == ["faulty"]


def test_a_low_nis_behind_a_gate_is_not_held_against_the_filter():
    parts = simulated(0, nis={"gnss": np.sqrt(0.9)})
    assert not judged(scored(*parts)).consistent
    v = judged(scored(*parts, refused={"gnss": 150}))
    assert v.consistent
    assert "the gate, which refused 150 readings, lowers it" in v.findings[0].text


def test_few_runs_are_said_to_be_few():
    v = verdict(runs=10)
    assert v.consistent
    few = v.findings[-1]
    assert few.kind == "few runs"
    total = scored(*simulated(0, runs=10)).nees_total[STATE]
    assert f"any ANEES of {figure(total.low / 3)} to {figure(total.high / 3)} x expected passes" in few.text
    assert few.text in v.headline
    assert "few runs" not in [f.kind for f in verdict(runs=20).findings]


def test_nothing_to_judge_by_is_no_praise():
    error, innovations = simulated(0, runs=100)
    scores = scored(error, innovations)
    nothing = lambda c: Consistency(*[a * np.nan for a in c])  # noqa: E731
    empty = {
        field: {k: nothing(c) for k, c in getattr(scores, field).items()}
        for field in ("nees", "nees_total", "nis", "nis_total")
    }
    scores = scores._replace(**empty, normalised_error=nothing(scores.normalised_error), whiteness={})
    v = judged(scores, diverged=Diverged(100, (0, 1, 2, 3)))
    assert v.headline == "ekf diverged in 100 of 100 runs (of the lost runs the first: 0, 1, 2)"
    assert (judged(scores).consistent, judged(scores).headline) == (False, "ekf: nothing to judge by")


def test_steps_without_readings_do_not_count():
    """A sensor that reads each tenth step, too large from step 50 on."""
    error, innovations = simulated(0, runs=400, nis={"gnss": from_step(50, 2.0, (0, 1))[:, :2]})
    scores = scored(error, innovations)
    there = np.arange(STEPS) % 10 == 0
    scores.nis["gnss"] = Consistency(*(np.where(there, a, np.nan) for a in scores.nis["gnss"]))
    (found,) = [f for f in judged(scores).findings if f.where == "gnss"]
    assert (found.since, found.ratio) == (50, pytest.approx(2.0, rel=0.1))


def test_findings_are_worst_first_and_of_known_kinds():
    v = verdict(scale=from_step(0, 2.5), bias=np.array([1.0, 0, 0]), colour=0.3, nis={"gnss": 0.7}, runs=200)
    order = [KINDS.index(f.kind) for f in v.findings if not f.slight]
    assert order == sorted(order)
    assert {f.kind for f in v.findings} >= {"overconfident", "biased", "inconsistent innovations", "correlated"}


def test_innovations_alone_can_tell():
    scores = scored(*simulated(0, runs=20))
    v = innovation_verdict(scores.nis_total, scores.whiteness, name="ukf")
    assert v.consistent
    assert v.headline.startswith("ukf consistent: NIS of gnss ")
    assert v.headline.endswith("innovations white")
    off = scored(*simulated(0, runs=20, nis={"gnss": 1.3}))
    bad = innovation_verdict(off.nis_total, off.whiteness, name="ukf", refused={"compass": 3})
    assert bad.headline.startswith("ukf inconsistent: innovations of gnss larger than claimed: NIS 1.7 x expected")
    over = innovation_verdict(scores.nis_total, scores.whiteness, Consistency(9.0, 3.0, 2.0, 4.0, 1e-9))
    assert over.headline == "filter overconfident: ANEES 3.0 x expected"
    assert cause(over).startswith("NIS is as expected")
    assert innovation_verdict({}, {}).headline == "filter: nothing to judge by"
