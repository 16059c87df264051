"""Constant turn rate and velocity: exact, and finite to the second derivative where the turn rate is zero."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_checks import assert_derivatives, cast, van_loan
from scipy.integrate import solve_ivp

from jaxfilt.models import ctrv
from jaxfilt.models.ctrv import Ctrv


def state(pos, yaw, speed, rate, dtype=np.float64):
    return Ctrv(jnp.asarray(pos, dtype), *(jnp.asarray(a, dtype) for a in (yaw, speed, rate)))


@functools.cache
def model():
    return ctrv.ctrv(cast(ctrv.BICYCLIST, np.float64))


def position(rate, yaw=0.3, speed=5.0, dt=0.7):
    return model().f(state([0.0, 0.0], yaw, speed, rate), (), dt).pos


@pytest.mark.parametrize("rate", [-2.0, -1e-4, 0.0, 1e-12, 0.3, 6.0])
def test_ctrv_is_the_exact_solution(rate):
    def derivative(t, s):
        return [s[3] * np.cos(s[2]), s[3] * np.sin(s[2]), s[4], 0.0, 0.0]

    expected = solve_ivp(derivative, (0, 0.9), [1.0, 2.0, -0.5, 4.0, rate], rtol=1e-11, atol=1e-11).y[:, -1]
    y = model().f(state([1.0, 2.0], -0.5, 4.0, rate), (), 0.9)
    np.testing.assert_allclose(y.pos, expected[:2], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * float(y.yaw)), np.exp(1j * expected[2]), atol=1e-9)
    assert (y.speed, y.rate) == (4.0, rate)


def test_a_full_circle_closes():
    x0 = state([3.0, -1.0], 2.0, 5.0, 0.8)
    step = jax.jit(lambda x: model().f(x, (), 2 * np.pi / 0.8 / 40))
    x = x0
    for _ in range(20):
        x = step(x)
    assert abs(np.hypot(*(x.pos - x0.pos)) - 2 * 5.0 / 0.8) < 1e-9, "half way round, the diameter away"
    for _ in range(20):
        x = step(x)
    np.testing.assert_allclose(x.pos, x0.pos, atol=1e-9)


def test_derivatives_across_zero_turn_rate():
    cases = [(speed, rate) for speed in (0.0, 5.0) for rate in (0.0, 1e-9, -1e-9, 1e-4, -0.1)]
    assert_derivatives(lambda x: model().f(x, (), 0.7), *(state([1.0, 2.0], 3.0, *case) for case in cases))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_first_and_second_derivative_are_continuous_at_zero_turn_rate(dtype):
    # d pos / d rate = v int_0^dt s [-sin, cos](yaw) ds and its derivative, at rate 0
    yaw, speed, dt = 0.3, 5.0, 0.7
    first = speed * dt**2 / 2 * np.array([-np.sin(yaw), np.cos(yaw)])
    second = -speed * dt**3 / 3 * np.array([np.cos(yaw), np.sin(yaw)])
    theta = cast(ctrv.BICYCLIST, dtype)

    def g(rate):
        return ctrv.ctrv(theta).f(state([0.0, 0.0], yaw, speed, 0.0, dtype)._replace(rate=rate), (), dt).pos

    @jax.jit
    def derivatives(rate):
        return jax.jacfwd(g)(rate), jax.jacrev(g)(rate), jax.jacrev(jax.jacrev(g))(rate)

    for rate in (-1e-6, -1e-20, 0.0, 1e-20, 1e-6):
        forward, reverse, twice = derivatives(jnp.asarray(rate, dtype))
        np.testing.assert_allclose(forward, first, rtol=1e-5)
        np.testing.assert_allclose(reverse, first, rtol=1e-5)
        np.testing.assert_allclose(twice, second, rtol=1e-5)


def test_noise_is_the_integral_of_white_acceleration():
    # at rest nothing couples the yaw to the position, and the equations are linear: [px, py, yaw, speed, rate]
    yaw, dt = 0.6, 0.5
    A = np.zeros((5, 5))
    A[:2, 3], A[2, 4] = [np.cos(yaw), np.sin(yaw)], 1.0
    density = np.diag(np.square([0.02, 0.02, 0.0, 0.2, 0.1]))
    x = state([5.0, 6.0], yaw, 0.0, 0.0)
    Q = np.asarray(model().Q(x, (), jnp.asarray(dt)))
    slip = density[:2, :2] * dt
    np.testing.assert_allclose(Q, van_loan(A, density, dt), atol=1e-9)
    assert (np.diag(Q)[:2] > np.diag(slip)).all()


def test_noise_of_two_steps_is_the_noise_of_one_of_twice_the_length():
    x, dt = state([5.0, 6.0], 0.6, 0.0, 0.0), jnp.asarray(0.25)
    F = np.eye(5)
    F[:2, 3], F[2, 4] = dt * np.array([np.cos(0.6), np.sin(0.6)]), dt
    once = np.asarray(model().Q(x, (), dt))
    np.testing.assert_allclose(F @ once @ F.T + once, model().Q(x, (), 2 * dt), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_noise_is_positive_definite_at_any_heading(dtype):
    m = ctrv.ctrv(cast(ctrv.BICYCLIST, dtype))
    Q = jax.jit(jax.vmap(lambda yaw: m.Q(state([0.0, 0.0], 0.0, 5.0, 0.1, dtype)._replace(yaw=yaw), (), 0.05)))
    Q = np.asarray(Q(jnp.linspace(-np.pi, np.pi, 73, dtype=dtype)))
    assert Q.dtype == dtype
    assert (np.linalg.eigvalsh(Q.astype(np.float64)) > 0).all()


def test_range_rate_is_the_rate_of_the_range():
    x = state([30.0, -20.0], 1.0, 6.0, 0.3)
    h = model().sensors["radar"].h
    before, after = (h(model().f(x, (), s), ()) for s in (-1e-4, 1e-4))
    reading = h(x, ())
    np.testing.assert_allclose(reading.range_rate, (after.range - before.range) / 2e-4, rtol=1e-7)
    np.testing.assert_allclose([reading.range, reading.bearing], [np.hypot(30, 20), np.arctan2(-20, 30)])
    assert_derivatives(lambda x: h(x, ()), x)


def test_a_target_driving_away_has_a_positive_range_rate():
    assert model().sensors["radar"].h(state([10.0, 0.0], 0.0, 3.0, 0.0), ()).range_rate == 3.0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_radar_is_finite_at_zero_distance(dtype):
    h = ctrv.ctrv(cast(ctrv.BICYCLIST, dtype)).sensors["radar"].h

    @jax.jit
    def with_derivatives(x):
        return h(x, ()), jax.jacfwd(h)(x, ()), jax.jacrev(h)(x, ())

    for distance in (0.0, 1e-30, 1e-6):
        leaves = jax.tree.leaves(with_derivatives(state([distance, 0.0], 0.3, 5.0, 0.1, dtype)))
        assert all(np.isfinite(leaf).all() for leaf in leaves)


def test_velocity_is_the_rate_of_the_position():
    x = state([0.0, 0.0], 2.0, 4.0, 0.5)
    away = (model().f(x, (), 1e-5).pos - model().f(x, (), -1e-5).pos) / 2e-5
    np.testing.assert_allclose(ctrv.velocity(x), away, atol=1e-8)
