"""The filters tell the truth about their errors: hundreds of simulated runs, chi-square bounds, negative controls.

A run's NEES is correlated over time, so nothing here averages over time and calls it independent: each test looks at
instants, over runs that are independent.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import jaxfilt as jf
from jaxfilt.models import car, multirotor

RUNS = 500


def nees_of(scenario, filters, steps, runs=RUNS, seed=0):
    """name -> (runs, steps): the NEES of each run and step, by plain numpy from the stored beliefs."""
    model, start, plan = scenario.model(scenario.theta), scenario.belief(scenario.theta), scenario.schedule(steps)

    def one(key):
        truth, log = jf.simulate(model, start, plan, key, scenario.control)
        beliefs = {name: jf.scan(make(model), start, log, store=lambda b, info: b) for name, make in filters.items()}
        return {name: (jax.vmap(model.space.minus)(truth, b.mean), b.cov) for name, b in beliefs.items()}

    results = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(seed), runs))
    return {name: nees(*map(np.asarray, result)) for name, result in results.items()}


def nees(errors, covs):
    return np.einsum("nti,nti->nt", errors, np.linalg.solve(covs, errors[..., None])[..., 0])


def inside(nees, dim, confidence=0.999):
    """Whether the mean over runs lies in its two-sided band, at each step."""
    low, high = scipy.stats.chi2.interval(confidence, dim * len(nees))
    return (nees.mean(axis=0) >= low / len(nees)) & (nees.mean(axis=0) <= high / len(nees))


def wrong_q(make, factor):
    """A filter that believes the process noise to be ``factor`` times what it is."""
    return lambda model: make(model._replace(Q=lambda x, u, dt: factor * model.Q(x, u, dt)))


def constant_velocity():
    """Full, correlated P0, Q and R, so that nothing is right by accident."""
    A = jnp.array([[1.0, 0.1], [0.0, 1.0]])
    model = jf.linear(A, jnp.array([[1.0, 0.2]]), jnp.array([[0.02, 0.01], [0.01, 0.04]]), jnp.array([[0.5]]))
    start = jf.Gaussian(jnp.array([1.0, -1.0]), jnp.array([[2.0, 0.5], [0.5, 1.0]]))
    plan = lambda steps: jf.schedule(model, steps, 0.1)  # noqa: E731
    return jf.Scenario(lambda _: model, lambda _: start, (), plan, {"state": ((0, 1), "")})


FILTERS = {"kf": jf.kf, "ekf": jf.ekf, "iekf": jf.iekf, "ukf": jf.ukf, "ckf": jf.ckf}


def test_on_a_linear_model_nees_is_chi_square():
    """Every instant's NEES is exactly chi-square with n degrees of freedom: compare whole distributions."""
    for values in nees_of(constant_velocity(), FILTERS, steps=30, runs=4000).values():
        for step in (0, 9, 29):
            assert scipy.stats.kstest(values[:, step], scipy.stats.chi2(2).cdf).pvalue > 1e-3


def test_on_a_linear_model_the_band_holds_as_often_as_it_should():
    """400 studies of 50 runs: the share of means in their 90 % band is 90 %, give or take its binomial spread."""
    last = nees_of(constant_velocity(), {"kf": jf.kf}, steps=30, runs=20_000)["kf"][:, 29].reshape(400, 50)
    low, high = scipy.stats.chi2.interval(0.9, 2 * 50)
    hits = int(((last.sum(axis=1) >= low) & (last.sum(axis=1) <= high)).sum())
    assert scipy.stats.binomtest(hits, 400, 0.9).pvalue > 1e-3


def test_on_a_linear_model_a_wrong_q_is_found():
    spoilt = {factor: wrong_q(jf.kf, factor) for factor in (0.25, 4.0)}
    for values in nees_of(constant_velocity(), spoilt, steps=30).values():
        assert not inside(values, 2)[20:].any()


MILD = {"car": (car.scenario, 4), "car-like": (car.car_like_scenario, 6), "multirotor": (multirotor.scenario, 12)}


@pytest.mark.long
@pytest.mark.parametrize("name", MILD)
def test_in_a_mild_scenario_the_bands_hold_and_a_wrong_q_is_found(name):
    scenario, dim = MILD[name]
    sound = {"ekf": jf.ekf, "ukf": jf.ukf} | ({"ckf": jf.ckf} if dim < 12 else {})  # in 12 it compiles for long
    wrong = {"Q / 4": wrong_q(jf.ekf, 0.25), "4 Q": wrong_q(jf.ekf, 4.0)}
    values = nees_of(scenario(), sound | wrong, steps=150, runs=RUNS if dim < 12 else 250)
    for name in sound:
        # One step in a thousand may be out of its band, and neighbours go together.
        assert inside(values[name], dim)[::10].mean() > 0.9, name
    for name in wrong:
        assert inside(values[name], dim)[100::10].mean() < 0.1, name


@pytest.mark.long
def test_in_a_harsh_scenario_the_ekf_is_found_out():
    values = nees_of(car.harsh_scenario(), {"ekf": jf.ekf, "ukf": jf.ukf}, steps=150)
    assert not inside(values["ekf"], 4)[60:].any()
    assert values["ekf"][:, -1].mean() > 5 * values["ukf"][:, -1].mean()
