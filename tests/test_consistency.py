"""The filters tell the truth about their errors: hundreds of simulated runs, chi-square bounds, negative controls.

A run's NEES is correlated over time, so nothing here averages over time and calls it independent: each test looks at
instants, over runs that are independent.
"""

import jax
import jax.numpy as jnp
import jaxfilt as jf
import numpy as np
import pytest
import scipy.stats
from jaxfilt.models import car

RUNS = 500


def nees_of(scenario, make, steps, runs=RUNS, seed=0, spoil=lambda model: model):
    """(runs, steps): the NEES of each run and step, by plain numpy from the stored beliefs."""
    model, start, plan = scenario.model(scenario.theta), scenario.belief(scenario.theta), scenario.schedule(steps)

    def one(key):
        truth, log = jf.simulate(model, start, plan, key, scenario.control)
        track = jf.scan(make(spoil(model)), start, log, store=lambda b, info: b)
        return jax.vmap(model.space.minus)(truth, track.mean), track.cov

    errors, covs = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(seed), runs))
    return np.einsum("nti,nti->nt", errors, np.linalg.solve(covs, np.asarray(errors)[..., None])[..., 0])


def inside(nees, dim, confidence=0.999):
    """Whether the mean over runs lies in its two-sided band, at each step."""
    low, high = scipy.stats.chi2.interval(confidence, dim * len(nees))
    return (nees.mean(axis=0) >= low / len(nees)) & (nees.mean(axis=0) <= high / len(nees))


def with_process_noise(factor):
    return lambda model: model._replace(Q=lambda x, u, dt: factor * model.Q(x, u, dt))


def constant_velocity():
    """Full, correlated P0, Q and R, so that nothing is right by accident."""
    A = jnp.array([[1.0, 0.1], [0.0, 1.0]])
    model = jf.linear(A, jnp.array([[1.0, 0.2]]), jnp.array([[0.02, 0.01], [0.01, 0.04]]), jnp.array([[0.5]]))
    start = jf.Gaussian(jnp.array([1.0, -1.0]), jnp.array([[2.0, 0.5], [0.5, 1.0]]))
    plan = lambda steps: jf.schedule(model, steps, 0.1)  # noqa: E731
    return jf.Scenario(lambda _: model, lambda _: start, (), plan, {"state": ((0, 1), "")})


FILTERS = {"kf": jf.kf, "ekf": jf.ekf, "iekf": jf.iekf, "ukf": jf.ukf, "ckf": jf.ckf}


@pytest.mark.parametrize("make", FILTERS.values(), ids=FILTERS)
def test_on_a_linear_model_nees_is_chi_square(make):
    """Every instant's NEES is exactly chi-square with n degrees of freedom: compare whole distributions."""
    nees = nees_of(constant_velocity(), make, steps=30, runs=4000)
    for step in (0, 9, 29):
        assert scipy.stats.kstest(nees[:, step], scipy.stats.chi2(2).cdf).pvalue > 1e-3


def test_on_a_linear_model_the_band_holds_as_often_as_it_should():
    """400 studies of 50 runs: the share of means in their 90 % band is 90 %, give or take its binomial spread."""
    nees = nees_of(constant_velocity(), jf.kf, steps=30, runs=20_000)[:, 29].reshape(400, 50)
    low, high = scipy.stats.chi2.interval(0.9, 2 * 50)
    hits = int(((nees.sum(axis=1) >= low) & (nees.sum(axis=1) <= high)).sum())
    assert scipy.stats.binomtest(hits, 400, 0.9).pvalue > 1e-3


@pytest.mark.parametrize("factor", [0.25, 4.0])
def test_on_a_linear_model_a_wrong_q_is_found(factor):
    nees = nees_of(constant_velocity(), jf.kf, steps=30, spoil=with_process_noise(factor))
    assert not inside(nees, 2)[20:].any()


MILD = {"car": (car.scenario, 4), "car-like": (car.car_like_scenario, 6)}
NONLINEAR = {"ekf": jf.ekf, "ukf": jf.ukf, "ckf": jf.ckf}


@pytest.mark.long
@pytest.mark.parametrize("make", NONLINEAR.values(), ids=NONLINEAR)
@pytest.mark.parametrize("name", MILD)
def test_in_a_mild_scenario_the_bands_hold(name, make):
    scenario, dim = MILD[name]
    nees = nees_of(scenario(), make, steps=150)
    # One step in a thousand may be out, and neighbours go together.
    assert inside(nees, dim)[::10].mean() > 0.9


@pytest.mark.long
@pytest.mark.parametrize("factor", [0.25, 4.0])
@pytest.mark.parametrize("name", MILD)
def test_in_a_mild_scenario_a_wrong_q_is_found(name, factor):
    scenario, dim = MILD[name]
    nees = nees_of(scenario(), jf.ekf, steps=150, spoil=with_process_noise(factor))
    assert inside(nees, dim)[100::10].mean() < 0.1


@pytest.mark.long
def test_in_a_harsh_scenario_the_ekf_is_found_out():
    nees = {name: nees_of(car.harsh_scenario(), make, steps=150) for name, make in FILTERS.items() if name != "kf"}
    assert not inside(nees["ekf"], 4)[60:].any()
    assert nees["ekf"][:, -1].mean() > 5 * nees["ukf"][:, -1].mean() > 5 * 4 * 0.5
