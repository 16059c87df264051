"""The noncredibility index: against a loop from the definition."""

import math

import numpy as np

from jaxfilt.credibility import noncredibility

RNG = np.random.default_rng(0)


def drawn(runs, claimed, actual):
    """Errors (runs, 1, n) of the actual covariance, and their NEES by the claimed one."""
    e = RNG.normal(size=(runs, len(actual))) @ np.linalg.cholesky(actual).T
    return e[:, None], np.einsum("ri,ij,rj->r", e, np.linalg.inv(claimed), e)[:, None]


def test_index_and_inclination_are_those_of_the_definition():
    e = RNG.normal(size=(7, 3, 2)) * [10.0, 0.01]
    claimed = np.diag([50.0, 2e-4])
    nees = np.einsum("rti,ij,rtj->rt", e, np.linalg.inv(claimed), e)
    nees[2, 1] = np.nan
    mse = np.einsum("rti,rtj->tij", e, e) / 7
    index, inclination = noncredibility(e, nees, mse)
    for t in range(3):
        terms = []
        for r in range(7):
            actual = e[r, t] @ np.linalg.solve(mse[t], e[r, t])
            if nees[r, t] == nees[r, t]:
                terms.append(math.log10(nees[r, t]) - math.log10(actual))
        assert math.isclose(index[t], 10 * sum(map(abs, terms)) / len(terms), rel_tol=1e-9)
        assert math.isclose(inclination[t], 10 * sum(terms) / len(terms), rel_tol=1e-9)


def test_the_sign_tells_optimists_from_pessimists():
    actual = np.array([[2.0, 0.3], [0.3, 1.0]])
    for factor, expected in ((0.5, 10 * math.log10(2)), (1.0, 0.0), (2.0, -10 * math.log10(2))):
        index, inclination = noncredibility(*drawn(50, factor * actual, actual), actual[None])
        assert math.isclose(inclination[0], expected, abs_tol=1e-9)
        assert math.isclose(index[0], abs(expected), abs_tol=1e-9)


def test_claims_that_err_both_ways_show_in_the_index_alone():
    index, inclination = noncredibility(*drawn(4000, np.diag([4.0, 0.25]), np.eye(2)), np.eye(2)[None])
    assert index[0] > 2.0
    assert abs(inclination[0]) < index[0] - 1.0  # not exactly 0: NEES is quadratic in the factors, not logarithmic


def test_singular_or_unknown_is_not_a_number():
    e = RNG.normal(size=(3, 4, 2))
    mse = np.stack([np.ones((2, 2)), np.diag([1.0, 0.0]), np.full((2, 2), np.nan), np.diag([1e12, 1e-12])])
    nees = np.ones((3, 4))
    index, inclination = noncredibility(e, nees, mse)
    assert np.isnan(index).tolist() == [True, True, True, False]
    assert np.isnan(inclination).tolist() == [True, True, True, False]
    nothing = noncredibility(e, np.full((3, 4), np.nan), np.stack([np.eye(2)] * 4))
    assert np.isnan(nothing).all()
    assert np.isnan(noncredibility(np.zeros((0, 1, 2)), np.zeros((0, 1)), np.eye(2)[None])).all()
