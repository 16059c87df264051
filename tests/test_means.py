"""Bounds and p-values of means: against scipy, and as often as they say."""

import numpy as np
import pytest
import scipy.stats

from jaxfilt import consistency
from jaxfilt.consistency import Consistency, anees_total, coverage, coverage_total, holm, mean_error

RNG = np.random.default_rng(0)


def total(nees, dim, confidence=0.999):
    """The total of NEES (runs, T), from the sums over runs that a study keeps."""
    a = nees.mean(1)
    return anees_total(len(a), a.mean(), a.var(ddof=1), (nees**2).mean(), dim, confidence)


def persistent(rng, shape, rho):
    """Standard normal errors (..., T, n) that keep a share rho of the last one."""
    e = rng.normal(size=shape)
    for k in range(1, shape[-2]):
        e[..., k, :] = rho * e[..., k - 1, :] + np.sqrt(1 - rho**2) * e[..., k, :]
    return e


def test_chi_square_bounds_and_p_are_scipys():
    sums, dof, count = np.array([130.0, 70.0, 100.0, 5.0]), np.array([100, 100, 100, 3]), np.array([50, 50, 50, 1])
    got = consistency.mean_of_squares(sums, dof, count, 0.99)
    low, high = scipy.stats.chi2.interval(0.99, dof)
    np.testing.assert_allclose(got[:4], [sums / count, dof / count, low / count, high / count], rtol=1e-9)
    cdf, sf = scipy.stats.chi2.cdf(sums, dof), scipy.stats.chi2.sf(sums, dof)
    np.testing.assert_allclose(got.p, 2 * np.minimum(cdf, sf), rtol=1e-9)


def test_chi_square_of_many_degrees_of_freedom():
    got = consistency.mean_of_squares(np.array(2.0e7), np.array(2 * 10**7), np.array(10**7), 0.999)
    low, high = scipy.stats.chi2.interval(0.999, 2e7)
    assert (float(got.low), float(got.high)) == pytest.approx((low / 1e7, high / 1e7), rel=1e-9)
    assert float(got.p) == pytest.approx(1.0, abs=1e-3)


def test_nothing_counted_is_not_a_number_and_a_gross_mean_is_no_accident():
    got = consistency.mean_of_squares(
        np.array([0.0, np.inf, 1e9, np.nan]), np.array([0, 4, 4, 4]), np.array([0, 2, 2, 2])
    )
    assert np.isnan(got.p).tolist() == [True, False, False, True]
    assert np.isnan(got.low).tolist() == [True, False, False, False]
    assert (got.p[1:3] == 0).all()


def test_average_over_time_of_independent_steps_has_the_bounds_of_all_of_them():
    nees = RNG.chisquare(2, (2000, 50))
    got = total(nees, 2)
    low, high = scipy.stats.chi2.interval(0.999, 2 * nees.size)
    assert got.mean == pytest.approx(nees.mean())
    assert (got.low, got.high) == pytest.approx(
        (low / nees.size, high / nees.size), abs=0.15 * (high - low) / nees.size
    )


def test_average_over_time_of_constant_steps_has_the_bounds_of_one():
    nees = np.repeat(RNG.chisquare(2, (2000, 1)), 50, axis=1)
    low, high = scipy.stats.chi2.interval(0.999, 2 * 2000)
    assert total(nees, 2)[2:4] == pytest.approx((low / 2000, high / 2000), rel=1e-3)


def test_average_over_time_of_next_to_nothing():
    one, none = anees_total(1, 2.0, np.nan, 9.0, 2), anees_total(0, np.nan, np.nan, np.nan, 2)
    assert (one.mean, consistency.verdict(one), np.isnan(one.p)) == (2.0, "unknown", True)
    assert none.expected == 2.0
    assert np.isnan([none.mean, none.low, none.high, none.p]).all()
    same = total(np.full((5, 9), 2.0), 2)
    assert consistency.verdict(same) == "inside"


@pytest.mark.parametrize("runs", [4, 40])
@pytest.mark.parametrize("rho", [0.0, 0.95])
def test_average_over_correlated_time_is_inside_as_often_as_it_says(runs, rho):
    """600 studies of runs whose errors persist from step to step, as those of every filter do."""
    studies = (persistent(np.random.default_rng(runs), (600, runs, 60, 3), rho) ** 2).sum(3)
    totals = [total(nees, 3, confidence=0.9) for nees in studies]
    hits = sum(consistency.verdict(t) == "inside" for t in totals)
    assert scipy.stats.binomtest(hits, 600, 0.9).pvalue > 1e-3
    assert scipy.stats.kstest([t.p for t in totals], "uniform").pvalue > 1e-3


def test_bounds_that_take_steps_for_independent_are_too_narrow():
    """The control: the same studies, each step of each run counted as one more."""
    studies = (persistent(np.random.default_rng(40), (200, 40, 60, 3), 0.95) ** 2).sum(3)
    p = [float(consistency.mean_of_squares(nees.sum(), 3 * nees.size, nees.size).p) for nees in studies]
    assert scipy.stats.kstest(p, "uniform").pvalue < 1e-9


@pytest.mark.parametrize("runs", [2, 3, 10, 1000])
@pytest.mark.parametrize("confidence", [0.9, 0.999])
def test_p_of_a_total_at_its_bounds_is_what_they_leave(runs, confidence):
    """The same worth throughout: a variance between runs that goes with the mean's variance."""
    at = anees_total(runs, 3.0, 1.0, 9.0 + 6.0, 3, confidence)
    for bound in (at.low, at.high):
        if 0 < bound < np.inf:
            got = anees_total(runs, bound, 1.0, bound**2 + 6.0, 3, confidence)
            assert (got.low, got.high) == pytest.approx((at.low, at.high), rel=1e-9)
            assert got.p == pytest.approx(1 - confidence, rel=1e-4)
    assert 0 <= at.low < 3 < at.high


@pytest.mark.parametrize("mean", [1e-12, 1e3, 1e30, 1e300, np.inf])
@pytest.mark.parametrize("runs", [2, 100, 10**6])
def test_a_total_far_off_has_a_small_p_however_far(runs, mean):
    got = anees_total(runs, mean, 1.0, mean * mean + 6.0, 3)
    assert 0 <= got.p <= 2 * scipy.stats.t.sf(5, runs - 1)
    assert (got.p < 1e-3) == (not got.low <= mean <= got.high)


def test_totals_go_elementwise_over_arrays():
    nees = RNG.chisquare(2, (2, 50, 10))
    a = nees.mean(2)
    both = anees_total(50, a.mean(1), a.var(1, ddof=1), (nees**2).mean((1, 2)), 2)
    for k in range(2):
        assert tuple(x[k] for x in both) == pytest.approx(total(nees[k], 2))


def test_runs_that_got_lost_do_not_widen_the_bounds_until_they_fit():
    """Where a few runs are far off, the spread between runs is as large as the mean: it proves nothing."""
    nees = RNG.chisquare(4, (200, 50))
    nees[:10] *= 200.0
    assert consistency.verdict(total(nees, 4)) == "above"


def test_mean_error_is_students_t_test_over_the_runs():
    a = RNG.normal(0.2, 1.5, (12, 3))
    got = mean_error(12, a.mean(0), a.var(0, ddof=1), confidence=0.9)
    theirs = scipy.stats.ttest_1samp(a, 0.0)
    np.testing.assert_allclose(got.p, theirs.pvalue, rtol=1e-10)
    interval = theirs.confidence_interval(0.9)
    np.testing.assert_allclose([got.mean + got.low, got.mean + got.high], [interval.low, interval.high], rtol=1e-10)
    assert np.isnan(mean_error(1, np.ones(2), np.full(2, np.nan)).p).all()
    exact = mean_error(5, np.array([0.0, 1.0]), np.zeros(2))
    assert (np.isnan(exact.p[0]), exact.p[1]) == (True, 0.0)


def test_coverage_has_the_exact_binomial_bounds_and_test():
    hits, count = np.array([43, 50, 30, 0, 0]), np.array([50, 50, 50, 50, 0])
    got = coverage(hits, count, 0.9, confidence=0.95)
    for k in range(4):
        sides = [scipy.stats.binomtest(hits[k], 50, 0.9, side).pvalue for side in ("less", "greater")]
        assert got.p[k] == pytest.approx(min(1.0, 2 * min(sides)))
        assert (got.p[k] > 0.05) == (got.low[k] <= got.mean[k] <= got.high[k])
    assert all(np.isnan(a[4]) for a in got)
    chance = scipy.stats.binom.pmf(np.arange(50 * got.low[0] - 0.5, 50 * got.high[0] + 0.5).round(), 50, 0.9)
    assert 0.95 <= chance.sum() < 0.99


def test_total_coverage_is_students_and_a_share():
    a = RNG.beta(9, 1, 40)
    got = coverage_total(40, a.mean(), a.var(ddof=1), 0.8, confidence=0.9)
    assert got.p == pytest.approx(scipy.stats.ttest_1samp(a, 0.8).pvalue)
    assert coverage_total(3, 0.9, 0.2, 0.9).high == 1.0
    every = coverage_total(10, 1.0, 0.0, 0.99)
    assert (every.mean, np.isnan([every.low, every.high, every.p]).all()) == (1.0, True)


def test_holm_is_the_step_down_of_the_book():
    """Sorted p against level / (m - i), by a loop over plain Python."""
    for _ in range(200):
        p = RNG.beta(0.5, 8, 6)
        p[RNG.random(6) < 0.2] = np.nan
        tests = sorted((v, i) for i, v in enumerate(p) if v == v)
        rejected = set()
        for k, (v, i) in enumerate(tests):
            if v > 0.1 / (len(tests) - k):
                break
            rejected.add(i)
        assert set(np.flatnonzero(holm(p, 0.1))) == rejected
    assert holm([np.nan, np.nan], 0.1).tolist() == [False, False]
    assert holm([[0.0, 1.0], [0.0, np.nan]], 0.1).tolist() == [[True, False], [True, False]]
    assert holm([], 0.1).shape == (0,)


def test_holm_keeps_the_family_and_is_no_weaker_than_bonferroni():
    false_alarms = [holm(RNG.uniform(size=20), 0.05).any() for _ in range(2000)]
    assert scipy.stats.binomtest(sum(false_alarms), 2000, 0.05, alternative="greater").pvalue > 1e-3
    p = np.array([0.0024, 0.0026, 0.3] + 17 * [0.9])
    assert holm(p, 0.05).tolist() == [True, True] + 18 * [False]
    assert (p <= 0.05 / 20).sum() == 1


@pytest.mark.parametrize(
    ("mean", "expected"), [(2.0, "inside"), (3.0, "above"), (0.5, "below"), (np.nan, "unknown"), (np.inf, "above")]
)
def test_verdict(mean, expected):
    assert consistency.verdict(Consistency(mean, 2.0, 1.0, 2.5)) == expected


def test_share_inside_is_of_the_steps_that_have_bounds():
    score = Consistency(np.array([1.0, 2.0, 9.0, np.nan]), 2.0, np.full(4, 0.5), np.full(4, 3.0))
    assert consistency.share_inside(score) == pytest.approx(2 / 3)
