"""Unicycle with odometry and the lecture's two-wheeled robot."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_checks import assert_derivatives, kalman
from scipy.integrate import solve_ivp

import jaxfilt as jf
from jaxfilt.models import wheeled
from jaxfilt.models.wheeled import Odometry, Pose, TwoWheeled


@functools.cache
def unicycle():
    return wheeled.unicycle()


def pose(x, y, yaw):
    return Pose(jnp.array([x, y]), jnp.asarray(yaw))


@pytest.mark.parametrize("rate", [-1.5, 0.0, 1e-10, 0.4])
def test_unicycle_is_the_exact_solution(rate):
    def derivative(t, s):
        return [1.2 * np.cos(s[2]), 1.2 * np.sin(s[2]), rate]

    expected = solve_ivp(derivative, (0, 0.9), [1.0, 2.0, -0.5], rtol=1e-11, atol=1e-11).y[:, -1]
    y = unicycle().f(pose(1.0, 2.0, -0.5), Odometry(1.2, rate), 0.9)
    np.testing.assert_allclose([*y.pos, y.yaw], expected, atol=1e-9)


def test_odometry_moves_the_wheels_as_far_as_they_rolled():
    # each wheel's contact point travels along its own arc: of length (wheel speed x dt), whatever the other does
    left, right, track, dt = 0.3, 0.5, 0.4, 0.01
    u = wheeled.odometry(left, right, track)
    step = jax.jit(lambda x: unicycle().f(x, u, dt))
    x, rolled = pose(0.0, 0.0, 0.2), np.zeros(2)
    for _ in range(300):
        y = step(x)
        for k, side in enumerate((1.0, -1.0)):
            contacts = [p.pos + side * 0.5 * track * np.array([-np.sin(p.yaw), np.cos(p.yaw)]) for p in (x, y)]
            rolled[k] += np.hypot(*(contacts[1] - contacts[0]))
        x = y
    np.testing.assert_allclose(rolled, np.array([left, right]) * 3.0, rtol=1e-5)


def test_unicycle_derivatives_at_rest_straight_and_on_the_spot():
    inputs = [Odometry(*map(jnp.asarray, u)) for u in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))]
    assert_derivatives(lambda point: unicycle().f(*point, 0.3), *((pose(1.0, 2.0, 3.1), u) for u in inputs))


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, 0.7])
def test_wheels_err_along_the_track(yaw):
    R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    expected = np.zeros((3, 3))
    expected[:2, :2] = R @ np.diag([0.02**2, 0.005**2]) @ R.T
    expected[2, 2] = 0.03**2
    np.testing.assert_allclose(unicycle().Q(pose(0.0, 0.0, yaw), (), 0.5), 0.5 * expected, atol=1e-15)


def test_dead_reckoning_drifts_as_its_covariance_says_and_a_landmark_stops_it():
    scenario = wheeled.unicycle_scenario()
    steps, runs = 200, 1000
    log = scenario.schedule(steps)
    blind = log._replace(z={}, c={}, valid={})

    @jax.jit
    def spread(keys):
        truth = jax.vmap(lambda key: jf.simulate(unicycle(), belief, blind, key).truth)(keys)
        return jax.vmap(unicycle().space.minus)(
            jax.tree.map(lambda a: a[:, -1], truth), jax.tree.map(last, reckoned.mean)
        )

    def last(a):
        return jnp.broadcast_to(a[-1], (runs, *a.shape[1:]))

    belief = scenario.belief(scenario.theta)
    filt = jf.ekf(unicycle())
    reckoned = jax.jit(lambda log: jf.scan(filt, belief, log))(blind).belief
    seen = jax.jit(lambda log: jf.scan(filt, belief, log))(log).belief
    e = np.asarray(spread(jax.random.split(jax.random.key(0), runs)))
    predicted = np.sqrt(np.diag(reckoned.cov[-1]))
    np.testing.assert_allclose(e.std(0), predicted, rtol=0.1)
    assert (np.diff(np.trace(reckoned.cov, axis1=1, axis2=2)) > 0).all()
    assert np.sqrt(seen.cov[-1, 2, 2]) < 0.3 * predicted[2]


# --- the lecture's two-wheeled robot ------------------------------------------------------------------------------


def test_two_wheeled_equations():
    Ts, d, r = 0.1, 1.0, 0.25
    y = wheeled.two_wheeled().f(TwoWheeled(*map(jnp.asarray, (0.3, 9.0, 5.0, 2.0))), (), Ts)
    np.testing.assert_allclose(y, [0.3 + r * Ts / d * (5.0 - 2.0), r / 2 * (5.0 + 2.0), 5.0, 2.0])


def lecture():
    """Matrices of the lecture, state [theta, v, w1, w2], readings in the order encoders, compass, speedometer."""
    Ts, d, r, degree = 0.1, 1.0, 0.25, np.pi / 180
    A = np.array([[1, 0, r * Ts / d, -r * Ts / d], [0, 0, r / 2, r / 2], [0, 0, 1, 0], [0, 0, 0, 1]])
    Q = np.diag(np.square([1 * degree, 0.1, 1 * degree, 1 * degree]))
    H = np.array([[0.0, 0, 1, 0], [0, 0, 0, 1], [1, 0, 0, 0], [0, 1, 0, 0]])
    R = np.diag(np.square([5 * degree, 5 * degree, 5 * degree, 0.1]))
    return A, Q, H, R


@pytest.mark.parametrize("compass", [False, True], ids=["case 1", "case 2"])
def test_two_wheeled_robot_of_the_lecture(compass):
    scenario = wheeled.two_wheeled_scenario(compass)
    log, rng, steps = scenario.schedule(600), np.random.default_rng(0), 600
    A, Q, H, R = lecture()
    seen = slice(0, 4 if compass else 2)
    H, R = H[seen], R[seen, seen]
    zs = np.array([4.0, 4.0, 0.0, 1.0])[seen] + 0.1 * rng.normal(size=(steps, len(H)))
    z = {"encoders": zs[:, :2]} | ({"compass": zs[:, 2], "speedometer": zs[:, 3]} if compass else {})
    assert set(log.z) == set(z)
    start = scenario.belief(scenario.theta)
    belief = jax.jit(lambda log: jf.scan(jf.kf(scenario.model(scenario.theta)), start, log))(log._replace(z=z)).belief
    means, covs = kalman(
        A, np.zeros((4, 1)), H, Q, R, np.array([0.0, 1.0, 4.0, 4.0]), np.array(start.cov), np.zeros((steps, 1)), zs
    )
    np.testing.assert_allclose(np.stack(belief.mean, axis=1), means, atol=1e-10)
    np.testing.assert_allclose(belief.cov, covs, atol=1e-12)

    variance = np.asarray(belief.cov[:, 0, 0])
    growth = np.diff(variance)
    if compass:
        assert variance.max() <= variance[0]
        assert abs(growth[-1]) < 1e-12, "settled"
    else:
        assert (growth >= Q[0, 0]).all(), "without a heading it grows by at least its own noise, each step, for ever"
        np.testing.assert_allclose(growth[-100:], growth[-1], rtol=1e-6)
