"""Vertical drone over floor and table, and the drone of seven states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_checks import assert_derivatives, filtered, kalman, nees, simulated, van_loan
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import jaxfilt as jf
from jaxfilt.models import altitude
from jaxfilt.models.altitude import LevelDrone, LevelImu


def test_vertical_drone_equals_the_books_filter():
    scenario, rng, steps, dt = altitude.vertical_drone_scenario(), np.random.default_rng(0), 80, 1 / 30
    A, B = np.array([[1, dt], [0, 1]]), np.array([[dt**2 / 2], [dt]])
    Q = van_loan(np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, 0.1**2]), dt)
    us, zs = rng.normal(size=(steps, 1)), 1.5 + 0.1 * rng.normal(size=(steps, 1))
    log = jf.Log(np.full(steps, dt), us[:, 0], {"range": zs[:, 0]}, {}, {})
    start = scenario.belief(scenario.theta)
    belief = jax.jit(lambda log: jf.scan(jf.kf(scenario.model(scenario.theta)), start, log))(log).belief
    H, R = np.array([[1.0, 0.0]]), np.array([[0.02**2]])
    means, covs = kalman(A, B, H, Q, R, np.array([1.5, 0.0]), 0.01 * np.eye(2), us, zs)
    np.testing.assert_allclose(np.stack(belief.mean, axis=1), means, atol=1e-7)
    np.testing.assert_allclose(belief.cov, covs, rtol=1e-5, atol=1e-9)


def test_range_reads_at_30_hz_between_faster_predictions():
    log = altitude.vertical_drone_scenario().schedule(120)
    np.testing.assert_allclose(log.dt.sum(), 1.0)
    assert log.valid["range"].sum() == 30


def test_the_edge_of_a_known_table_is_no_step_in_height():
    scenario = altitude.table_drone_scenario()
    simulation = simulated(scenario, runs=50, steps=720)
    terrain = np.asarray(scenario.schedule(720).c["range"])
    edges = np.flatnonzero(np.diff(terrain)) + 1
    assert len(edges) == 2, "onto the table and off again"
    height, wanted = np.asarray(simulation.truth.height), scenario.schedule(720).u.height
    assert np.abs(height - wanted)[:, 240:].max() < 0.3 < 0.5 < np.ptp(wanted), "the controller keeps it on its way"
    seen = np.asarray(scenario.schedule(720).valid["range"])
    jump = np.asarray(simulation.log.z["range"])[:, seen] - height[:, seen]
    np.testing.assert_allclose(jump.mean(0), -terrain[seen], atol=0.02, err_msg="the reading does jump")

    beliefs = filtered(scenario, simulation, jf.kf)
    error = np.asarray(beliefs.mean.height) - height
    assert np.abs(error[:, 120:]).max() < 6 * 0.02, "from the second second on, across both edges"
    assert abs(nees(scenario.model(scenario.theta), simulation.truth, beliefs)[:, 120:].mean() - 2.0) < 0.4

    ignorant = scenario._replace(model=lambda theta: altitude.vertical_drone(theta))
    error = np.asarray(filtered(ignorant, simulation, jf.kf).mean.height) - height
    assert np.abs(error[:, edges[1] - 1]).min() > 0.5, "who does not know the table believes that the drone sank"


# --- seven states ------------------------------------------------------------------------------------------------


def drone(pos, vel, yaw):
    return LevelDrone(jnp.asarray(pos), jnp.asarray(vel), jnp.asarray(yaw))


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
def test_level_drone_against_the_differential_equation(yaw):
    accel, dt = np.array([0.7, -0.4, 10.5]), 0.3
    world = Rotation.from_euler("z", yaw).apply(accel) - [0.0, 0.0, 9.81]
    start = [1.0, 2.0, 3.0, 0.5, -0.5, 0.1]
    expected = solve_ivp(lambda t, s: [*s[3:], *world], (0, dt), start, rtol=1e-11, atol=1e-11).y[:, -1]
    y = altitude.level_drone().f(drone(start[:3], start[3:], yaw), LevelImu(jnp.asarray(accel), 0.2), dt)
    np.testing.assert_allclose([*y.pos, *y.vel, y.yaw], [*expected, yaw + 0.2 * dt], atol=1e-10)


def test_level_drone_accelerates_where_it_looks():
    # facing along world y, thrust forward moves it along y; the inverse rotation would send it along -y
    imu = LevelImu(jnp.array([1.0, 0.0, 9.81]), 0.0)
    y = altitude.level_drone().f(drone([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], np.pi / 2), imu, 1.0)
    np.testing.assert_allclose(y.vel, [0.0, 1.0, 0.0], atol=1e-12)


def test_hover_is_an_equilibrium_at_any_yaw():
    model, hover = altitude.level_drone(), LevelImu(jnp.array([0.0, 0.0, 9.81]), 0.0)
    for yaw in (-3.0, 0.0, 2.0):
        x = drone([1.0, 2.0, 3.0], [0.0, 0.0, 0.0], yaw)
        for a, b in zip(model.f(x, hover, 0.5), x, strict=True):
            np.testing.assert_array_equal(a, b)


def test_level_drone_noise_and_derivatives():
    model = altitude.level_drone()
    x = drone([1.0, 2.0, 3.0], [0.0, 0.0, 0.0], 3.1)
    A, density = np.zeros((7, 7)), np.diag([0, 0, 0, 0.01, 0.01, 0.01, 1e-4])
    A[:3, 3:6] = np.eye(3)
    np.testing.assert_allclose(model.Q(x, (), 0.2), van_loan(A, density, 0.2), rtol=1e-5, atol=1e-12)
    imu = LevelImu(jnp.array([0.3, 0.1, 9.0]), jnp.asarray(0.2))
    assert_derivatives(lambda point: model.f(*point, 0.1), (x, imu))


def test_level_drone_control_leads_to_the_wanted_place():
    model = altitude.level_drone()
    wanted = drone([1.0, -2.0, 3.0], [0.0, 0.0, 0.0], 2.0)

    @jax.jit
    def step(x):
        return model.f(x, altitude.level_drone_control(x, wanted), 0.02)

    x = drone([0.0, 0.0, 0.0], [0.5, 0.0, 0.0], -1.5)
    for _ in range(750):
        x = step(x)
    np.testing.assert_allclose(x.pos, wanted.pos, atol=1e-3)
    np.testing.assert_allclose(x.yaw, 2.0, atol=1e-3)
