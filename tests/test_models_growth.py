"""Univariate nonstationary growth: the published mean squared errors of every filter, and a particle filter's."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flat_books import assert_same, book, both
from model_checks import assert_derivatives, filtered, nees, simulated

import jaxfilt as jf
from jaxfilt.models import growth

RUNS, STEPS = 400, 500


def book_f(x, u, dt):
    return x / 2 + 25 * x / (1 + x**2) + 8 * u


@functools.cache
def calm():
    """The published study's data: variances 1."""
    scenario = growth.growth_scenario()._replace(theta=growth.CALM_GROWTH)
    return scenario, simulated(scenario, RUNS, STEPS)


def test_growth_is_the_published_equation():
    model = growth.growth()
    for k, x in enumerate((-7.3, 0.0, 0.1, 12.0)):
        u = growth.growth_scenario().schedule(4).u[k]
        assert u == math.cos(1.2 * k), "step k + 1 is driven by cos(1.2 k)"
        expected = 0.5 * x + 25 * x / (1 + x * x) + 8 * math.cos(1.2 * k)
        np.testing.assert_allclose(model.f(jnp.asarray(x), u, 1.0), expected, rtol=1e-14)
        np.testing.assert_allclose(model.sensors["z"].h(jnp.asarray(x), ()), x * x / 20, rtol=1e-14)
    np.testing.assert_allclose([model.Q(0.0, 0.0, 1.0)[0, 0], model.sensors["z"].R(0.0, ())[0, 0]], [10, 1], rtol=1e-14)
    assert_derivatives(lambda x: model.f(x, 0.3, 1.0), *map(jnp.asarray, (-1.0, 0.0, 5.0)))
    assert jf.check(model, jnp.asarray(1.0), jnp.asarray(0.5), 1.0).ok


@pytest.mark.parametrize("filter", ["ekf", "ukf 1.0"])
def test_growth_equals_the_books_filters(filter):
    own = book(book_f, lambda x, c: x**2 / 20, lambda dt: 10 * np.eye(1), np.eye(1), "z")
    assert_same(*both(growth.growth_scenario(), own, filter, 60), rtol=1e-5)


# Mean squared errors over 100 runs x 500 steps, from the table of the UNGM demonstration in Hartikainen, Solin, Sarkka,
# Optimal Filtering with Kalman Filters and Smoothers, manual of the EKF/UKF toolbox 1.3 (2011). Its UKF has the
# toolbox's documented defaults alpha = 0.5, beta = 2, kappa = 3 - n, no augmentation. The second number is how far
# 100 runs of theirs and 400 of ours may be apart: a few standard errors of both (12, 0.3, 2, 1).
PUBLISHED = {
    "ekf": (jf.ekf, 125.9, 20.0),
    "ukf": (lambda model: jf.ukf(model, 0.5, 2.0, 2.0), 87.9, 1.0),
    "ckf": (jf.ckf, 72.3, 4.0),
    "gauss-hermite": (lambda model: jf.build(jf.gauss_hermite(10), model), 40.9, 3.0),
}


@pytest.mark.parametrize("filter", PUBLISHED)
def test_published_mean_squared_errors_are_met(filter):
    make, published, apart = PUBLISHED[filter]
    scenario, simulation = calm()
    error = np.asarray(filtered(scenario, simulation, make).mean - simulation.truth)
    assert abs((error**2).mean() - published) < apart


def test_a_particle_filter_meets_its_published_error_on_the_same_readings():
    # 10.2 in the same table, 1000 particles: what is simulated is the published system, whatever the filters do
    _, simulation = calm()
    runs = 40
    truth, z, u = np.asarray(simulation.truth)[:runs], np.asarray(simulation.log.z["z"])[:runs], simulation.log.u[0]
    rng = np.random.default_rng(0)
    x = 0.1 + rng.normal(size=(runs, 1000))
    squares = []
    for k in range(STEPS):
        x = book_f(x, float(u[k]), 1.0) + rng.normal(size=x.shape)
        w = -0.5 * (z[:, k, None] - x**2 / 20) ** 2
        w = np.exp(w - w.max(axis=1, keepdims=True))
        edges = np.cumsum(w / w.sum(axis=1, keepdims=True), axis=1)
        at = (np.arange(1000) + rng.uniform(size=(runs, 1))) / 1000
        x = np.stack([x[i, np.minimum(np.searchsorted(edges[i], at[i]), 999)] for i in range(runs)])
        squares.append((x.mean(axis=1) - truth[:, k]) ** 2)
    assert abs(np.mean(squares) - 10.2) < 1.2


def test_growth_defeats_the_ekf():
    # Arulampalam, Maskell, Gordon, Clapp (2002) report an RMSE of 23.19 for the EKF with these noises, variances 10 and
    # 1; that number is quoted from memory and could not be checked against the print
    scenario = growth.growth_scenario()
    simulation = simulated(scenario, 200, 100)
    model = scenario.model(scenario.theta)
    beliefs = {name: filtered(scenario, simulation, make) for name, make in (("ekf", jf.ekf), ("ukf", jf.ukf))}
    rmse = {name: np.sqrt(np.mean(np.square(b.mean - simulation.truth))) for name, b in beliefs.items()}
    assert 19.0 < rmse["ekf"] < 27.0
    assert rmse["ukf"] < 9.0
    assert nees(model, simulation.truth, beliefs["ekf"]).mean() > 100


def test_growth_runs_in_float32():
    theta = jax.tree.map(np.float32, growth.GROWTH)
    model = growth.growth(theta)
    x = jnp.asarray(2.0, jnp.float32)
    assert model.f(x, jnp.asarray(1.0, jnp.float32), jnp.asarray(1.0, jnp.float32)).dtype == jnp.float32
    assert growth.growth_start(theta).cov.dtype == jnp.float32
