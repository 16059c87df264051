"""Scores against plain numpy and scipy; bounds that hold as often as they say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import jaxfilt as jf
from jaxfilt import metrics

RNG = np.random.default_rng(0)


def covariances(*shape, n):
    A = RNG.normal(size=(*shape, n, n))
    return A @ np.swapaxes(A, -1, -2) + np.eye(n)


def info(nis, dof, status, m=2):
    nis, shape = np.asarray(nis, float), np.shape(nis)
    nothing = np.zeros(shape)
    return jf.Info(
        np.zeros((*shape, m)), np.zeros((*shape, m, m)), nis, nothing, np.array(dof), nothing, np.array(status)
    )


OK, ABSENT, GATED, BAD = jf.Status.OK, jf.Status.ABSENT, jf.Status.GATED, jf.Status.BAD_MEASUREMENT


def test_errors_are_truth_minus_mean_whatever_the_leading_axes():
    space = jf.product((jf.vector(2), jf.angle))
    truth = jnp.array([[1.0, 2.0], [3.0, 4.0]]), jnp.array([3.0, 0.5])
    mean = jnp.array([[0.0, 0.0], [1.0, 1.0]]), jnp.array([-3.0, 0.25])
    expected = [[1.0, 2.0, 6.0 - 2 * np.pi], [2.0, 3.0, 0.25]]
    np.testing.assert_allclose(metrics.errors(space, truth, mean), expected, atol=1e-12)
    one = jax.tree.map(lambda a: a[0], (truth, mean))
    np.testing.assert_allclose(metrics.errors(space, *one), expected[0], atol=1e-12)
    batch = jax.tree.map(lambda a: jnp.stack([a, a, a]), (truth, mean))
    np.testing.assert_allclose(metrics.errors(space, *batch), [expected] * 3, atol=1e-12)


def test_errors_on_rotations_live_in_the_body_frame_at_the_mean():
    turned = jf.so3_exp(jnp.array([0.1, -0.2, 0.3]))
    mean = jf.so3_exp(jnp.array([1.0, 0.5, -2.0]))
    truth = jf.so3.plus(mean, jnp.array([0.1, -0.2, 0.3]))
    np.testing.assert_allclose(metrics.errors(jf.so3, turned, jf.so3_exp(jnp.zeros(3))), [0.1, -0.2, 0.3], atol=1e-12)
    np.testing.assert_allclose(metrics.errors(jf.so3, truth, mean), [0.1, -0.2, 0.3], atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shape", [(), (3, 5)])
def test_nees_is_the_mahalanobis_square(dtype, shape):
    e, P = RNG.normal(size=(*shape, 4)), covariances(*shape, n=4)
    expected = (e * np.linalg.solve(P, e[..., None])[..., 0]).sum(-1)
    got = metrics.nees(jnp.asarray(e, dtype), jnp.asarray(P, dtype))
    assert got.dtype == dtype
    np.testing.assert_allclose(got, expected, rtol=1e-4 if dtype == np.float32 else 1e-12)


def test_nees_of_an_indefinite_covariance_is_not_a_number():
    assert np.isnan(metrics.nees(jnp.ones(2), jnp.diag(jnp.array([1.0, -1.0]))))


def test_rmse_is_the_length_of_the_error_over_what_counts():
    e = RNG.normal(size=(6, 7, 3))
    mask = RNG.random((6, 7)) < 0.5
    got = metrics.rmse(e, {"xy": ((0, 1), "m"), "yaw": ((2,), "rad")}, mask)
    assert got["xy"] == pytest.approx(np.sqrt(np.mean([np.linalg.norm(v) ** 2 for v in e[mask][:, :2]])))
    assert got["yaw"] == pytest.approx(np.sqrt(np.mean(e[mask][:, 2] ** 2)))
    assert np.isnan(metrics.rmse(e, {"yaw": ((2,), "rad")}, np.zeros((6, 7), bool))["yaw"])


def test_average_nees_has_scipys_bounds_and_skips_what_is_not_finite():
    values = RNG.chisquare(3, (40, 5))
    values[:10, 1] = np.nan
    values[:, 2] = np.inf
    got = metrics.anees(values, 3, confidence=0.95)
    for step, runs in ((0, 40), (1, 30)):
        low, high = scipy.stats.chi2.interval(0.95, 3 * runs)
        assert got.mean[step] == pytest.approx(values[-runs:, step].mean())
        assert (got.low[step], got.high[step], got.expected[step]) == pytest.approx((low / runs, high / runs, 3))
    assert all(np.isnan(a[2]) for a in got)


def total(nees, dim, confidence=0.999):
    return metrics.anees_total(nees.mean(1), (nees**2).mean(1), dim, confidence)


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
    assert total(nees, 2)[2:] == pytest.approx((low / 2000, high / 2000), rel=1e-3)


def test_average_over_time_of_next_to_nothing():
    assert metrics.verdict(total(np.full((1, 9), 2.0), 2)) == "unknown"
    assert np.isnan(metrics.anees_total([], [], 2).mean)
    assert total(np.array([[1.0, 2.0], [2.0, 3.0], [np.nan, 1.0]]), 2).mean == 2.0


@pytest.mark.parametrize("runs", [4, 40])
@pytest.mark.parametrize("rho", [0.0, 0.95])
def test_average_over_correlated_time_is_inside_as_often_as_it_says(runs, rho):
    """400 studies of runs whose errors persist from step to step, as those of every filter do."""
    error = RNG.normal(size=(400, runs, 60, 3))
    for k in range(1, 60):
        error[:, :, k] = rho * error[:, :, k - 1] + np.sqrt(1 - rho**2) * error[:, :, k]
    studies = (error**2).sum(3)
    hits = sum(metrics.verdict(total(nees, 3, confidence=0.9)) == "inside" for nees in studies)
    assert scipy.stats.binomtest(hits, 400, 0.9).pvalue > 1e-4


def test_runs_that_got_lost_do_not_widen_the_bounds_until_they_fit():
    """Where a few runs are far off, the spread between runs is as large as the mean: it proves nothing."""
    nees = RNG.chisquare(4, (200, 50))
    nees[:10] *= 200.0
    assert metrics.verdict(total(nees, 4)) == "above"


def test_average_nis_counts_only_what_was_used():
    i = info([1.0, 2.0, 50.0, 4.0, np.nan, 0.0], [2, 1, 0, 2, 2, 0], [OK, OK, GATED, OK, BAD, ABSENT])
    low, high = scipy.stats.chi2.interval(0.9, 5)
    assert metrics.anis(i, confidence=0.9) == pytest.approx((7 / 3, 5 / 3, low / 3, high / 3))
    assert np.isnan(metrics.anis(info([0.0], [0], [ABSENT])).mean)


def test_chi_square_bounds_of_many_degrees_of_freedom():
    got = metrics.mean_of_squares(np.array(2.0e7), np.array(2 * 10**7), np.array(10**7), 0.999)
    low, high = scipy.stats.chi2.interval(0.999, 2e7)
    assert (float(got.low), float(got.high)) == pytest.approx((low / 1e7, high / 1e7), rel=1e-9)


@pytest.mark.parametrize(
    ("mean", "expected"), [(2.0, "inside"), (3.0, "above"), (0.5, "below"), (np.nan, "unknown"), (np.inf, "above")]
)
def test_verdict(mean, expected):
    assert metrics.verdict(metrics.Consistency(mean, 2.0, 1.0, 2.5)) == expected


def test_share_inside_is_of_the_steps_that_have_bounds():
    score = metrics.Consistency(np.array([1.0, 2.0, 9.0, np.nan]), 2.0, np.full(4, 0.5), np.full(4, 3.0))
    assert metrics.share_inside(score) == pytest.approx(2 / 3)


def test_a_run_has_diverged_if_it_is_lost_at_the_end_or_was_ever_unsound():
    threshold = scipy.stats.chi2.isf(1e-9, 4)
    last = np.array([4.0, 0.999 * threshold, 1.001 * threshold, 4.0, np.nan])
    sound = np.array([True, True, True, False, False])
    assert metrics.diverged(last, sound, 4).tolist() == [False, False, True, True, True]


def coloured(rho, length, m=2, seed=0):
    """Innovations (length, m) that keep a share rho of the last one, with a covariance to normalise by."""
    rng = np.random.default_rng(seed)
    w = rng.normal(size=(length, m))
    e = w.copy()
    for k in range(1, length):
        e[k] = rho * e[k - 1] + np.sqrt(1 - rho**2) * w[k]
    S = np.broadcast_to(np.array([[4.0, 1.0], [1.0, 9.0]])[:m, :m], (length, m, m))
    r = e @ np.linalg.cholesky(S[0]).T
    every = np.zeros(length)
    return jf.Info(r, S, (e**2).sum(1), every, np.full(length, m), every, np.zeros(length, int)), e


def test_whiteness_is_the_autocorrelation_of_what_was_used():
    i, e = coloured(0.3, 200)
    used = np.arange(200) % 4 != 1
    i = i._replace(dof=np.where(used, 2, 0), status=np.where(used, OK, ABSENT))
    got = metrics.whiteness(i, lags=3, confidence=0.95)
    a = e[used]
    expected = [np.trace(a[:-k].T @ a[k:]) / np.linalg.norm(a[:-k]) / np.linalg.norm(a[k:]) for k in (1, 2, 3)]
    np.testing.assert_allclose(got.autocorrelation, expected, rtol=1e-10)
    np.testing.assert_allclose(got.bound, [1.959964 / np.sqrt(2 * (150 - k)) for k in (1, 2, 3)], rtol=1e-6)
    assert got.lags.tolist() == [1, 2, 3]


def test_whiteness_holds_as_often_as_it_says_and_finds_colour():
    inside = []
    for seed in range(60):
        white = metrics.whiteness(coloured(0.0, 150, seed=seed)[0], lags=5, confidence=0.9)
        inside += (np.abs(white.autocorrelation) <= white.bound).tolist()
    assert scipy.stats.binomtest(sum(inside), len(inside), 0.9).pvalue > 1e-3
    found = metrics.whiteness(coloured(0.5, 150)[0], lags=1)
    assert found.autocorrelation[0] > found.bound[0]


def test_whiteness_of_little_or_nothing():
    assert len(metrics.whiteness(coloured(0.0, 4)[0], lags=20).lags) == 3
    assert len(metrics.whiteness(info(np.zeros(5), np.zeros(5, int), np.full(5, ABSENT))).lags) == 0
    with pytest.raises(ValueError, match=r"info: expected leading axis T, one run, got float64\[2, 3\]"):
        metrics.whiteness(info(np.zeros((2, 3)), np.zeros((2, 3), int), np.zeros((2, 3), int)))
