"""What a filter sees that nothing measures: a velocity, a bias; and what it cannot see."""

import functools

import jax
import numpy as np
import pytest
from model_checks import filtered, matrices, observability_rank, simulated
from scipy.linalg import solve_discrete_are

import jaxfilt as jf
from jaxfilt.models import lti

A_LTI, B_LTI = np.array([[1, 0.01], [0, 0.99]]), np.array([[0], [0.01]])
A_BIAS = np.array([[1, 0.01, 0, 0], [0, 0, 1, 1], [0, 0, 1, 0], [0, 0, 0, 0.99]])
B_BIAS = np.array([[0], [0], [0], [0.01]])
PUSH = np.sin(0.02 * np.arange(800))[:, None]


@pytest.mark.parametrize(("make", "A", "B"), [(lti.lti, A_LTI, B_LTI), (lti.hidden_bias, A_BIAS, B_BIAS)])
def test_matrices_of_the_lecture(make, A, B):
    got, _ = matrices(make(), np.zeros(len(A)), np.zeros(1), 0.01)
    np.testing.assert_allclose(got, A)
    np.testing.assert_allclose(make().f(np.zeros(len(A)), np.ones(1), 0.01), B[:, 0])


def test_lti_measurements_of_the_lecture():
    _, H = matrices(lti.lti(), np.zeros(2), np.zeros(1), 0.01)
    np.testing.assert_array_equal(H["position"], [[1, 0]])
    np.testing.assert_array_equal(H["both"], [[0, 1], [1, 0]])


@functools.cache
def lti_runs():
    """100 runs of 8 s with both measurements in the log."""
    every_sensor = lti.lti_scenario()._replace(
        schedule=lambda steps: jf.schedule(lti.lti(), steps, 0.01, u=PUSH[:steps])
    )
    return simulated(every_sensor, runs=100, steps=800)


@functools.cache
def bias_runs():
    """100 quiet runs of 6 s with both measurements in the log, and their parameters."""
    theta = lti.HIDDEN_BIAS | {"process": tuple(s - 2.0 for s in lti.HIDDEN_BIAS["process"])}
    scenario = lti.hidden_bias_scenario()._replace(
        theta=theta, schedule=lambda steps: jf.schedule(lti.hidden_bias(), steps, 0.01, u=PUSH[:steps])
    )
    return theta, simulated(scenario, runs=100, steps=600)


@pytest.mark.parametrize("sensor", ["position", "both"])
def test_lti_velocity_is_estimated_measured_or_not(sensor):
    scenario = lti.lti_scenario(sensor)
    simulation = lti_runs()
    beliefs = filtered(scenario, simulation, jf.kf)
    velocity = np.asarray(simulation.truth)[:, -1, 1]
    error = np.asarray(beliefs.mean)[:, -1, 1] - velocity
    H, R = {
        "position": (np.array([[1.0, 0.0]]), np.array([[0.05**2]])),
        "both": (np.array([[0.0, 1.0], [1.0, 0.0]]), np.diag([0.1**2, 0.05**2])),
    }[sensor]
    Q = np.diag([1e-6, 1e-4])
    P = solve_discrete_are(A_LTI.T, H.T, Q, R)
    P = P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)
    covs = np.asarray(beliefs.cov).reshape(-1, 800, 2, 2)
    np.testing.assert_allclose(covs[0, -1], P, rtol=1e-4)
    np.testing.assert_allclose(error.std(), np.sqrt(P[1, 1]), rtol=0.25)
    assert np.sqrt(P[1, 1]) < 0.25 * 0.5, "the prior was 0.5 m/s"


def test_observability_of_the_hidden_bias():
    A, H = matrices(lti.hidden_bias(), np.zeros(4), np.zeros(1), 0.01)
    np.testing.assert_array_equal(H["position"], [[1, 0, 0, 0]])
    np.testing.assert_array_equal(H["velocity"], [[0, 1, 0, 0]])
    assert observability_rank(A, H["position"]) == 4
    assert observability_rank(A, H["velocity"]) == 3
    kernel = np.linalg.svd(np.concatenate([H["velocity"] @ np.linalg.matrix_power(A, k) for k in range(4)]))[2][-1]
    np.testing.assert_allclose(np.abs(kernel), [1, 0, 0, 0], atol=1e-12, err_msg="it is r that r_dot does not show")
    frozen = A.copy()
    frozen[3, 3] = 1.0
    assert observability_rank(frozen, H["position"]) == 3, "were i to keep its value, nobody could tell it from b"


@pytest.mark.parametrize("sensor", ["position", "velocity"])
def test_hidden_bias_is_found_from_either_measurement(sensor):
    theta, simulation = bias_runs()
    beliefs = filtered(lti.hidden_bias_scenario(sensor), simulation, jf.kf, theta)
    error = np.asarray(beliefs.mean - simulation.truth)[:, -1]
    std = np.sqrt(np.diagonal(np.asarray(beliefs.cov).reshape(-1, 600, 4, 4)[0, -1]))
    np.testing.assert_allclose(error.std(0), std, rtol=0.25)
    assert std[2] < 0.2 * 0.5, "the prior was 0.5 m/s"
    if sensor == "velocity":
        assert std[0] > 0.5, "the position stays as unknown as it was"
    else:
        assert std[0] < 0.05


def test_scenarios_use_the_sensor_that_was_asked_for():
    for make, names in ((lti.lti_scenario, ("position", "both")), (lti.hidden_bias_scenario, ("position", "velocity"))):
        for name in names:
            assert list(make(name).schedule(3).z) == [name]
    assert jax.tree.leaves(lti.lti_scenario().schedule(500).u)[0].std() > 0.5
