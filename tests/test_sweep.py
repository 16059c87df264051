"""Sweeps: each point of the grid is the study of that point; the curves are those of the books."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from jax.core import Tracer

import jaxfilt as jf
from jaxfilt import consistency
from jaxfilt.study import study
from jaxfilt.sweep import sweep

TRACED = []
"""Grows when a model is built for tracing: a program that is there already builds none."""

RIGHT = {"q": 1.0, "r": 1.0}
OPTIONS: dict[str, Any] = {"runs": 300, "chunk": 150, "workers": 1, "lags": 2, "sample": 20, "examples": 2}
FACTORS = np.array([0.1, 0.3, 1.0, 3.0, 10.0])


def model(theta):
    """A walk that is held back, 0.9 of it left at each step; factors on Q and R."""
    if isinstance(theta["q"], Tracer):
        TRACED.append(theta)
    one = jnp.ones((1, 1))
    return jf.linear(0.9 * one, one, theta["q"] * one, theta["r"] * one)


def belief(theta):
    return jf.Gaussian(jnp.zeros(1), jnp.ones((1, 1)))


FILTERS = {"kf": lambda theta: jf.kf(model(theta)), "wary": lambda theta: jf.kf(model(theta | {"q": 4 * theta["q"]}))}


def with_q(q):
    return RIGHT | {"q": q}


def with_r(r):
    return RIGHT | {"r": r}


def swept(over, seed=0, steps=40, **options):
    log = jf.schedule(model(RIGHT), steps, 1.0)
    return sweep(model, FILTERS, belief, log, jax.random.key(seed), over, **(OPTIONS | options))


def single(theta, truth_theta, steps=40):
    log = jf.schedule(model(RIGHT), steps, 1.0)
    return study(model, FILTERS, belief, log, jax.random.key(0), theta=theta, truth_theta=truth_theta, **OPTIONS)


def same(a, b):
    for field in ("scores", "kept", "paired", "diverged", "faults", "truth", "tracks"):
        leaves, structure = jax.tree.flatten(getattr(a, field))
        assert structure == jax.tree.structure(getattr(b, field))
        for x, y in zip(leaves, jax.tree.leaves(getattr(b, field)), strict=True):
            np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-9)
    assert (a.theta, a.truth_theta, a.runs, a.seed, a.blocks) == (b.theta, b.truth_theta, b.runs, b.seed, b.blocks)


@pytest.fixture(scope="module")
def over_q():
    """The filters' Q alone: what is simulated is the same in all settings."""
    return swept({"q": FACTORS}, theta=with_q, truth_theta=RIGHT)


@pytest.fixture(scope="module")
def over_r():
    """The truth's R alone."""
    return swept({"r": FACTORS}, theta=RIGHT, truth_theta=with_r)


@pytest.fixture(scope="module")
def grid():
    """A parameter of the filters and one of the truth."""
    over = {"q": np.array([0.5, 1.0, 2.0]), "r": np.array([1.0, 3.0])}
    return swept(over, theta=lambda q, r: with_q(q), truth_theta=lambda q, r: with_r(r))


def test_a_sweep_of_the_filters_is_their_studies_one_by_one(over_q):
    assert over_q.studies.shape == (5,)
    for factor, found in zip(FACTORS, over_q.studies, strict=True):
        same(found, single(with_q(factor), RIGHT))


def test_a_sweep_of_the_truth_is_its_studies_one_by_one(over_r):
    for factor, found in zip(FACTORS[::2], over_r.studies[::2], strict=True):
        same(found, single(RIGHT, with_r(factor)))


def test_a_grid_has_an_axis_for_each_parameter_in_the_order_given(grid):
    assert list(grid.over) == ["q", "r"]
    assert grid.studies.shape == (3, 2)
    for i, q in enumerate(grid.over["q"]):
        for k, r in enumerate(grid.over["r"]):
            same(grid.studies[i, k], single(with_q(q), with_r(r)))
    assert grid.curve(lambda s: s.theta["q"]).tolist() == [[0.5, 0.5], [1.0, 1.0], [2.0, 2.0]]
    assert grid.curve(lambda s: s.truth_theta["r"]).tolist() == [[1.0, 3.0]] * 3


def test_without_a_truth_of_its_own_both_change(grid):
    """The same shape as the grid, of filters and truth: nothing is compiled."""
    TRACED.clear()
    over = {"q": np.array([0.5, 1.0, 2.0]), "r": np.array([1.0, 3.0])}
    both = swept(over, theta=lambda q, r: {"q": q, "r": r})
    assert not TRACED
    found = both.studies[2, 1]
    assert found.theta == found.truth_theta == {"q": 2.0, "r": 3.0}
    same(found, single({"q": 2.0, "r": 3.0}, {"q": 2.0, "r": 3.0}))


def test_other_values_compile_nothing(over_q):
    TRACED.clear()
    swept({"q": 2 * FACTORS}, theta=with_q, truth_theta=RIGHT)
    assert not TRACED


def test_the_truth_is_the_same_for_all_settings_of_the_filters(over_q):
    for found in over_q.studies[1:]:
        np.testing.assert_array_equal(found.truth, over_q.studies[0].truth)
    assert (over_q.studies[0].tracks["kf"].mean != over_q.studies[4].tracks["kf"].mean).any()


def test_the_rmse_is_least_where_the_filter_is_right(over_q, over_r):
    rmse = over_q.curve(lambda s: s.scores["kf"].rmse_total["x[0]"].value)
    assert (np.diff(rmse[:3]) < 0).all()
    assert (np.diff(rmse[2:]) > 0).all()
    rmse = over_r.curve(lambda s: s.scores["kf"].rmse_total["x[0]"].value)
    assert (np.diff(rmse) > 0).all()


def test_the_anees_falls_with_the_factor_on_q_as_the_riccati_equation_says(over_q):
    """At the last step, where all is settled: the actual variance of the error over the claimed one.

    It falls up to 3; far beyond, where the filter believes its readings alone, it is on its way back to 1.
    """
    anees = over_q.curve(lambda s: s.scores["kf"].nees["state"].mean[-1])
    verdicts = [consistency.verdict(s.scores["kf"].nees_total["state"]) for s in over_q.studies[:4]]
    assert (np.diff(anees[:4]) < 0).all()
    assert verdicts == ["above", "above", "inside", "below"]
    one = np.eye(1)
    for q, found in zip(FACTORS, anees, strict=True):
        predicted = float(scipy.linalg.solve_discrete_are(0.9 * one, one, q * one, one)[0, 0])
        gain = predicted / (predicted + 1)
        actual = ((1 - gain) ** 2 + gain**2) / (1 - (0.9 * (1 - gain)) ** 2)
        expected = actual / ((1 - gain) * predicted)
        assert found == pytest.approx(expected, abs=4 * expected * np.sqrt(2 / 300))


def test_the_anees_rises_with_the_factor_on_the_truth(over_r):
    anees = over_r.curve(lambda s: s.scores["kf"].nees_total["state"].mean)
    assert (np.diff(anees) > 0).all()
    assert over_r.studies[2].scores["kf"].nees_total["state"].p > 1e-3


@pytest.mark.parametrize(
    ("over", "options", "text"),
    [
        ({}, {"theta": with_q}, "over: expected values that theta or truth_theta is a function of, got none"),
        ({"q": [1.0]}, {"theta": RIGHT}, "over: expected values that theta or truth_theta is a function of, got none"),
        ({"q": []}, {"theta": with_q}, r"over\['q'\]: expected values \(K,\), got shape \(0,\)"),
        ({"q": 1.0}, {"theta": with_q}, r"over\['q'\]: expected values \(K,\), got shape \(\)"),
        ({"q": [[1.0]]}, {"theta": with_q}, r"over\['q'\]: expected values \(K,\), got shape \(1, 1\)"),
        ({"q": [1.0]}, {"theta": with_q, "runs": 0}, "runs: expected at least 1, got 0"),
    ],
)
def test_bad_arguments_are_named(over, options, text):
    with pytest.raises(ValueError, match=text):
        swept(over, **options)


def test_options_and_names_that_nobody_knows_are_refused():
    with pytest.raises(TypeError, match="colour"):
        swept({"q": [1.0]}, theta=with_q, colour="red")
    with pytest.raises(TypeError, match="s"):
        swept({"s": [1.0]}, theta=with_q)
