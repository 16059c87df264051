"""The lectures' first examples: voltmeter, pendulum, commanded drone, GPS with accelerometer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_checks import assert_derivatives, filtered, kalman, simulated, van_loan
from scipy.integrate import solve_ivp
from scipy.linalg import solve_discrete_are

import jaxfilt as jf
from jaxfilt.models import textbook
from jaxfilt.models.textbook import Axes, Pendulum


def tracked(scenario, log):
    return jax.jit(lambda log: jf.scan(jf.kf(scenario.model(scenario.theta)), scenario.belief(scenario.theta), log))(
        log
    )


# --- voltmeter ---------------------------------------------------------------------------------------------------


def test_voltmeter_settles_at_the_solution_of_the_riccati_equation():
    Q = R = 4.0
    track = tracked(textbook.voltmeter_scenario(), textbook.voltmeter_scenario().schedule(60))
    np.testing.assert_allclose(track.belief.cov[-1, 0, 0], (np.sqrt(Q**2 + 4 * Q * R) - Q) / 2, rtol=1e-12)
    predicted = solve_discrete_are(np.eye(1), np.eye(1), Q * np.eye(1), R * np.eye(1))[0, 0]
    np.testing.assert_allclose(track.belief.cov[-1, 0, 0] + Q, predicted, rtol=1e-12)


def test_voltmeter_is_initialised_by_its_first_reading():
    readings = np.array([13.1, 11.2, 12.4])
    start = textbook.voltmeter_start(first=readings[0])
    assert (start.mean[0], start.cov[0, 0]) == (13.1, 4.0)
    log = jf.Log(np.ones(2), (), {"z": readings[1:, None]}, {}, {})
    means = np.asarray(jf.scan(jf.kf(textbook.voltmeter()), start, log).belief.mean)[:, 0]
    x, P = readings[0], 4.0
    for k, z in enumerate(readings[1:]):
        K = (P + 4.0) / (P + 8.0)
        x, P = x + K * (z - x), (1 - K) * (P + 4.0)
        np.testing.assert_allclose(means[k], x, rtol=1e-12)


def test_voltmeter_on_a_constant_voltage_is_too_cautious():
    # error e' = (1 - K) e - K v with K = P / R settles at variance K^2 R / (1 - (1 - K)^2), less than P
    scenario, rng = textbook.voltmeter_scenario(), np.random.default_rng(1)
    z = 12.0 + 2.0 * rng.normal(size=(20_000, 1))
    belief = tracked(scenario, scenario.schedule(20_000)._replace(z={"z": z})).belief
    nees = np.asarray((belief.mean[100:, 0] - 12.0) ** 2 / belief.cov[100:, 0, 0])
    P = 2 * (np.sqrt(5) - 1)
    K = P / 4.0
    assert abs(nees.mean() - K**2 * 4.0 / (1 - (1 - K) ** 2) / P) < 0.03
    assert nees.mean() < 0.8


# --- pendulum ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("angle", "rate"), [(0.3, 0.0), (2.0, -1.0), (3.1, 0.4)])
def test_pendulum_against_the_differential_equation(angle, rate):
    model = textbook.pendulum()
    step = jax.jit(lambda x: model.f(x, (), 0.01))
    x = Pendulum(jnp.asarray(angle), jnp.asarray(rate))
    for _ in range(200):
        x = step(x)
    expected = solve_ivp(lambda t, s: [s[1], -9.81 * np.sin(s[0])], (0, 2.0), [angle, rate], rtol=1e-11, atol=1e-11)
    phase = np.exp(1j * float(x.angle))
    np.testing.assert_allclose(phase, np.exp(1j * expected.y[0, -1]), atol=1e-6)
    np.testing.assert_allclose(x.rate, expected.y[1, -1], atol=1e-6)


def test_pendulum_noise_derivatives_and_reading():
    model = textbook.pendulum()
    x = Pendulum(jnp.asarray(0.4), jnp.asarray(-0.3))
    expected = van_loan(np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, 0.01]), 0.3)
    np.testing.assert_allclose(model.Q(x, (), 0.3), expected, rtol=1e-6)
    assert_derivatives(lambda x: model.f(x, (), 0.05), x)
    np.testing.assert_allclose(model.sensors["z"].h(x, ()), np.sin(0.4))
    np.testing.assert_allclose(model.sensors["z"].R(x, ()), [[0.1]])


# --- drone with commanded velocity -------------------------------------------------------------------------------


def test_horizontal_drone_goes_where_it_is_told():
    scenario = textbook.horizontal_drone_scenario()
    log = scenario.schedule(400)
    still = log._replace(z={}, valid={})
    belief = tracked(scenario, still).belief
    np.testing.assert_allclose(belief.mean, 0.02 * np.cumsum(log.u, axis=0), atol=1e-12)
    assert np.abs(log.u).max() == 2.0
    np.testing.assert_allclose(belief.mean[-1], 0.0, atol=1e-12, err_msg="a square closes")
    np.testing.assert_allclose(belief.cov[-1], (4.0 + 8.0 * 0.04) * np.eye(2), rtol=1e-12)


# --- GPS and accelerometer ---------------------------------------------------------------------------------------


def axes_matrices(dt):
    A = np.kron(np.eye(2), [[1.0, dt], [0.0, 1.0]])
    B = np.kron(np.eye(2), [[dt**2 / 2], [dt]])
    H = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    return A, B, H


@pytest.mark.parametrize(("form", "sigma"), [("gps_robot", 1.0), ("gps_accelerometer_robot", 0.1)])
def test_gps_robot_equals_the_books_filter(form, sigma):
    scenario, rng, steps, dt = getattr(textbook, f"{form}_scenario")(), np.random.default_rng(2), 50, 0.1
    measured = form == "gps_accelerometer_robot"
    A, B, H = axes_matrices(dt)
    us, zs = rng.normal(size=(steps, 2)), 3.0 * rng.normal(size=(steps, 2))
    log = jf.Log(np.full(steps, dt), us if measured else (), {"gps": zs}, {}, {})
    belief = tracked(scenario, log).belief
    P0 = np.diag([4.0, 1.0, 4.0, 1.0])
    inputs = us if measured else np.zeros((steps, 2))
    means, covs = kalman(A, B, H, B @ (sigma**2 * np.eye(2)) @ B.T, 4.0 * np.eye(2), np.zeros(4), P0, inputs, zs)
    np.testing.assert_allclose(np.stack(belief.mean, axis=1), means, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(belief.cov, covs, rtol=1e-10, atol=1e-12)


def test_accelerations_are_integrated_not_differentiated():
    model = textbook.gps_accelerometer_robot()
    x = Axes(*map(jnp.asarray, (1.0, 2.0, 3.0, 4.0)))
    step = jax.jit(lambda x: model.f(x, jnp.array([0.5, -1.0]), 0.1))
    for _ in range(20):
        x = step(x)
    t = 2.0
    np.testing.assert_allclose(x, [1 + 2 * t + 0.25 * t**2, 2 + 0.5 * t, 3 + 4 * t - 0.5 * t**2, 4 - t], rtol=1e-12)


def test_gps_and_accelerometer_beat_either_alone_and_their_average():
    # the lecture's baseline: the mean of the last GPS position and of the integrated acceleration
    scenario = textbook.gps_accelerometer_robot_scenario()
    simulation = simulated(scenario, runs=100, steps=300)
    px, gps = np.asarray(simulation.truth.px), np.asarray(simulation.log.z["gps"])[..., 0]
    fused = np.asarray(filtered(scenario, simulation, jf.kf).mean.px)
    velocity = 0.1 * np.cumsum(np.asarray(simulation.log.u)[..., 0], axis=1)
    reckoned = 0.1 * np.cumsum(velocity, axis=1)
    seen = np.arange(4, 300, 5)
    held = gps[:, np.repeat(seen, 5)[: 300 - 4]]
    alone = textbook.gps_robot_scenario()
    unaided = alone._replace(schedule=scenario.schedule)
    error = {
        "fused": fused - px,
        "gps": held - px[:, 4:],
        "acceleration": reckoned - px,
        "average": 0.5 * (held + reckoned[:, 4:]) - px[:, 4:],
        "gps filtered": np.asarray(filtered(unaided, simulation, jf.kf).mean.px) - px,
    }
    rmse = {name: np.sqrt((e[:, 50:] ** 2).mean()) for name, e in error.items()}
    assert rmse["fused"] < 0.8 * min(rmse[name] for name in rmse if name != "fused"), rmse
