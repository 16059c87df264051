"""Every filter against the book's own loop, against other libraries, and against one big conditioning."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from systems import FILTERS, SYSTEMS, A, B, H
from systems import book_covariance as cov

import jaxfilt as jf

BOOKS = oracles.filters(iterations=3)
system = functools.cache(lambda name: SYSTEMS[name]())


@functools.cache
def tracked(name, filter, *without):
    """The library's track of a system: (flat means, covariances, log-likelihood of each row), and the log."""
    s = system(name)
    log = s.log._replace(
        z={n: z for n, z in s.log.z.items() if n not in without},
        valid={n: v for n, v in s.log.valid.items() if n not in without},
    )
    track = jax.jit(lambda theta, b, log: jf.scan(FILTERS[filter](s.model(theta)), b, log))(s.theta, s.belief, log)
    logliks = np.sum([info.loglik for info in track.info.values()], axis=0)
    return s.flat(track.belief.mean), np.asarray(track.belief.cov), logliks, log


def expect_equal(got, want, tolerance=1e-10):
    """Relative to the largest of each component over the run."""
    got, want = np.asarray(got), np.asarray(want)
    scale = np.abs(want).max(axis=0, keepdims=True)
    assert np.all(np.abs(got - want) <= tolerance * scale), np.max(np.abs(got - want) / scale)


# The attitude's programs are the slowest to compile; its Gauss-Hermite rule has 729 points.
LEFT_OUT = {("body", "gauss_hermite"), ("body", "ukf 0.5"), ("body", "ukf 1.0")}
CASES = [(name, filter) for name in SYSTEMS for filter in BOOKS if (name, filter) not in LEFT_OUT]


@pytest.mark.parametrize(("name", "filter"), CASES)
def test_equals_the_loop_of_the_book(name, filter):
    s = system(name)
    means, covs, logliks, log = tracked(name, filter)
    book = s.book(s.theta)
    want = oracles.loop(book, s.start, s.belief.cov, oracles.rows_of(log, book), *BOOKS[filter])
    expect_equal(means, [s.book_flat(x) for x in want.means])
    expect_equal(covs, want.covs)
    expect_equal(logliks, want.logliks)
    assert np.isclose(logliks.sum(), want.logliks.sum(), rtol=1e-10)


def test_the_filters_differ_on_a_nonlinear_system():
    """Else the comparison above would not tell one from another."""
    covs = [tracked("car", filter)[1] for filter in BOOKS]
    for i, a in enumerate(covs):
        for b in covs[:i]:
            assert np.abs(a - b).max() > 1e-6 * np.abs(a).max()


@pytest.mark.parametrize("filter", [name for name in FILTERS if name != "kf"])
def test_all_are_the_kalman_filter_on_a_linear_system(filter):
    for got, want in zip(tracked("linear", filter)[:3], tracked("linear", "kf")[:3], strict=True):
        expect_equal(got, want, 1e-11)


def test_equals_one_conditioning_of_the_whole_trajectory():
    s = system("linear")
    means, covs, logliks, log = tracked("linear", "kf")
    rows = oracles.rows_of(log, s.book(s.theta))
    Rs = {name: cov(s.theta[name], 3 + i) for i, name in enumerate(H)}
    for steps in (1, 7, 20):
        mean, P, loglik = oracles.dense_posterior(
            A, B, cov(s.theta["q"], 2), s.start, s.belief.cov, rows[:steps], H, Rs
        )
        np.testing.assert_allclose(means[steps - 1], mean, rtol=1e-9)
        np.testing.assert_allclose(covs[steps - 1], P, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(logliks[:steps].sum(), loglik, rtol=1e-10)


# --- other libraries, on their ground: every row predicts one step, every reading is whole ------------------------


@pytest.fixture(scope="module")
def whole():
    """The linear system with one sensor, unit steps and nothing missing; and its track."""
    s = system("linear")
    z = s.log.z["wide"]
    theta = dict(s.theta)
    Q, R = cov(theta["q"], 2), cov(theta["wide"], 3)
    model = jf.linear(jnp.asarray(A), jnp.asarray(H["wide"]), jnp.asarray(Q), jnp.asarray(R), jnp.asarray(B))
    log = jf.Log(np.ones(len(z)), s.log.u, {"z": z}, {}, {})
    track = {
        f: jax.jit(lambda b, log, f=f: jf.scan(FILTERS[f](model), b, log))(s.belief, log) for f in ("kf", "ukf 0.5")
    }
    return s, Q, R, z, track


def test_equals_filterpy_kalman(whole):
    from filterpy.kalman import KalmanFilter

    s, Q, R, z, track = whole
    theirs: Any = KalmanFilter(dim_x=3, dim_z=2, dim_u=2)
    theirs.x, theirs.P, theirs.Q, theirs.R = s.start.copy(), s.belief.cov.copy(), Q, R
    theirs.F, theirs.B, theirs.H = A, B, H["wide"]
    for k in range(len(z)):
        theirs.predict(u=s.log.u[k])
        theirs.update(z[k])
        np.testing.assert_allclose(track["kf"].belief.mean[k], theirs.x, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(track["kf"].belief.cov[k], theirs.P, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(track["kf"].info["z"].loglik[k], theirs.log_likelihood, rtol=1e-9)
        np.testing.assert_allclose(track["kf"].info["z"].S[k], theirs.S, rtol=1e-9)


def test_equals_filterpy_extended_on_the_car_with_landmarks():
    from filterpy.kalman import ExtendedKalmanFilter

    s = system("car")
    means, covs, _, log = tracked("car", "ekf", "gnss")
    book = s.book(s.theta)
    mark = book.sensors["mark"]
    theirs: Any = ExtendedKalmanFilter(dim_x=4, dim_z=2)
    theirs.x, theirs.P, theirs.R = s.start.copy(), s.belief.cov.copy(), mark.R(None, None)
    for k, row in enumerate(oracles.rows_of(log, book)):
        if row.dt > 0:
            theirs.F, theirs.Q = book.F(theirs.x, row.u, row.dt), book.Q(theirs.x, row.u, row.dt)
            x = book.f(theirs.x, row.u, row.dt)
            theirs.predict()
            theirs.x = x  # its own predict is linear, as its manual says: the user overrides it
        for z, c, _ in row.readings.values():
            theirs.update(z, mark.H, mark.h, args=(c,), hx_args=(c,), residual=mark.minus)
        np.testing.assert_allclose(means[k], s.book_flat(theirs.x), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(covs[k], theirs.P, rtol=1e-8, atol=1e-12)


def test_equals_filterpy_unscented_with_fresh_points(whole):
    """Theirs passes the predicted points on to the update; drawn afresh after the prediction they are ours."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    s, Q, R, z, track = whole
    points = MerweScaledSigmaPoints(3, alpha=0.5, beta=2.0, kappa=0.0)
    theirs: Any = UnscentedKalmanFilter(3, 2, 1.0, lambda x: H["wide"] @ x, lambda x, dt, u: A @ x + B @ u, points)
    theirs.x, theirs.P, theirs.Q, theirs.R = s.start.copy(), s.belief.cov.copy(), Q, R
    for k in range(len(z)):
        theirs.predict(u=s.log.u[k])
        theirs.sigmas_f = points.sigma_points(theirs.x, theirs.P)
        theirs.update(z[k])
        np.testing.assert_allclose(track["ukf 0.5"].belief.mean[k], theirs.x, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(track["ukf 0.5"].belief.cov[k], theirs.P, rtol=1e-8, atol=1e-12)


def test_equals_statsmodels(whole):
    """Update-first: its initial state is the one that the first reading sees, ours after the first prediction."""
    from statsmodels.tsa.statespace.kalman_filter import KalmanFilter

    s, Q, R, z, track = whole
    u = s.log.u
    theirs: Any = KalmanFilter(k_endog=2, k_states=3, k_posdef=3, tolerance=0)
    theirs.bind(z.copy())
    theirs["design"], theirs["obs_cov"], theirs["transition"] = H["wide"], R, A
    theirs["selection"], theirs["state_cov"] = np.eye(3), Q
    theirs.state_intercept = np.ascontiguousarray(np.vstack([u[1:] @ B.T, np.zeros(3)]).T)
    theirs.initialize_known(A @ s.start + B @ u[0], A @ s.belief.cov @ A.T + Q)
    theirs.loglikelihood_burn = 0
    result: Any = theirs.filter()
    np.testing.assert_allclose(track["kf"].belief.mean, result.filtered_state.T, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        track["kf"].belief.cov, result.filtered_state_cov.transpose(2, 0, 1), rtol=1e-9, atol=1e-12
    )
    np.testing.assert_allclose(track["kf"].info["z"].loglik, result.llf_obs, rtol=1e-9)
