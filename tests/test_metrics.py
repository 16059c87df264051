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


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_log_score_is_the_density_of_the_error(dtype):
    e, P = RNG.normal(size=(3, 5, 4)), covariances(3, 5, n=4)
    expected = [[scipy.stats.multivariate_normal(cov=P[i, j]).logpdf(e[i, j]) for j in range(5)] for i in range(3)]
    got = metrics.log_score(jnp.asarray(e, dtype), jnp.asarray(P, dtype))
    assert got.dtype == dtype
    np.testing.assert_allclose(got, expected, rtol=1e-4 if dtype == np.float32 else 1e-12)
    assert np.isnan(metrics.log_score(jnp.ones(2), jnp.diag(jnp.array([1.0, -1.0]))))


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
        assert got.p[step] == pytest.approx(2 * min(tails(got.mean[step] * runs, 3 * runs)))
    assert all(np.isnan(a[2]) for a in got)


def tails(total, dof):
    return scipy.stats.chi2.cdf(total, dof), scipy.stats.chi2.sf(total, dof)


def test_average_nis_counts_only_what_was_used():
    i = info([1.0, 2.0, 50.0, 4.0, np.nan, 0.0], [2, 1, 0, 2, 2, 0], [OK, OK, GATED, OK, BAD, ABSENT])
    low, high = scipy.stats.chi2.interval(0.9, 5)
    assert metrics.anis(i, confidence=0.9) == pytest.approx((7 / 3, 5 / 3, low / 3, high / 3, 2 * min(tails(7, 5))))
    assert np.isnan(metrics.anis(info([0.0], [0], [ABSENT])).mean)


def test_a_run_has_diverged_if_it_is_lost_at_the_end_or_was_ever_unsound():
    threshold = scipy.stats.chi2.isf(1e-9, 4)
    last = np.array([4.0, 0.999 * threshold, 1.001 * threshold, 4.0, np.nan])
    sound = np.array([True, True, True, False, False])
    assert metrics.diverged(last, sound, 4).tolist() == [False, False, True, True, True]
    assert metrics.divergence_threshold(4) == pytest.approx(threshold, rel=1e-6)
    assert type(metrics.divergence_threshold(4)) is float  # weakly typed inside jit


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


def sums_of(studies):
    """Sums over runs of the products at lags 1 to 5, as a study keeps them, from e (runs, T, m)."""
    runs, T, m = studies.shape
    dots = np.array([(studies[:, :-lag] * studies[:, lag:]).sum() for lag in range(1, 6)])
    pairs = np.array([runs * (T - lag) * m for lag in range(1, 6)])
    return metrics.whiteness_of_sums(dots, pairs, (studies**2).sum(), runs * T * m, confidence=0.9)


def test_whiteness_of_many_runs_holds_as_often_as_it_says_and_finds_colour():
    rng, inside = np.random.default_rng(4), []
    for _ in range(100):
        white = sums_of(rng.normal(size=(20, 30, 2)))
        inside += (np.abs(white.autocorrelation) <= white.bound).tolist()
    assert scipy.stats.binomtest(sum(inside), len(inside), 0.9).pvalue > 1e-3
    found = sums_of(np.stack([coloured(0.3, 200, seed=seed)[1] for seed in range(30)]))
    np.testing.assert_allclose(found.autocorrelation, 0.3 ** np.arange(1, 6), atol=0.03)
    assert found.bound[0] == pytest.approx(1.6449 / np.sqrt(30 * 199 * 2), rel=1e-4)
    assert found.lags.tolist() == [1, 2, 3, 4, 5]


def test_whiteness_does_not_ask_for_innovations_of_the_right_size():
    small, large = (sums_of(scale * np.stack([coloured(0.3, 200)[1]])) for scale in (1.0, 5.0))
    np.testing.assert_allclose(small.autocorrelation, large.autocorrelation, rtol=1e-12)


def test_whiteness_of_no_pairs():
    white = metrics.whiteness_of_sums(np.array([3.0, 0.0]), np.array([4, 0]), 8.0, 8)
    assert (white.autocorrelation[0], np.isnan(white.autocorrelation[1]), np.isnan(white.bound[1])) == (
        0.75,
        True,
        True,
    )
    assert np.isnan(metrics.whiteness_of_sums(np.zeros(2), np.zeros(2), 0.0, 0).autocorrelation).all()
