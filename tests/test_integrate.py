"""Integrators: order of convergence on flat and curved spaces, against scipy's adaptive ones."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import jaxfilt as jf


class Pendulum(NamedTuple):
    angle: Any
    rate: Any


PENDULUM = jf.product(Pendulum(jf.scalar, jf.scalar))


def pendulum_rate(x, u):
    return Pendulum(x.rate, -9.81 * jnp.sin(x.angle) - 0.2 * x.rate * jnp.abs(x.rate) + u)


def pendulum_reference(start: np.ndarray, u: float, duration: float) -> np.ndarray:
    def rate(t, y):
        return [y[1], -9.81 * np.sin(y[0]) - 0.2 * y[1] * abs(y[1]) + u]

    return solve_ivp(rate, (0, duration), start, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]


class Body(NamedTuple):
    att: Any
    w: Any


BODY = jf.product(Body(jf.so3, jf.vector(3)))
INERTIA = np.array([1.0, 2.0, 3.5])


def body_rate(x, u):
    """A torque fixed in the world: the body rate's derivative depends on the attitude too."""
    J = jnp.asarray(INERTIA, x.w.dtype)
    return Body(x.w, (jf.rotate_back(x.att, u) - jnp.cross(x.w, J * x.w)) / J)


def body_reference(q: np.ndarray, w: np.ndarray, torque: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotation matrix and rate, by integrating all nine elements of the matrix."""

    def rate(t, y):
        R, w = y[:9].reshape(3, 3), y[9:]
        W = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.r_[(R @ W).ravel(), (R.T @ torque - np.cross(w, INERTIA * w)) / INERTIA]

    start = np.r_[Rotation.from_quat(q, scalar_first=True).as_matrix().ravel(), w]
    y = solve_ivp(rate, (0, duration), start, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    return y[:9].reshape(3, 3), y[9:]


def advance(f, x, u, duration: float, steps: int):
    return jax.lax.fori_loop(0, steps, lambda _, x: f(x, u, duration / steps), x)


def orders(errors: list[float]) -> np.ndarray:
    """Of convergence, from errors with the step halved each time."""
    return -np.diff(np.log2(errors))


@pytest.mark.parametrize(("integrator", "order"), [(jf.euler, 1), (jf.rk4, 4)], ids=["euler", "rk4"])
def test_order_on_a_flat_space(integrator, order):
    f = integrator(pendulum_rate, PENDULUM)
    start, u = np.array([2.0, -1.0]), 0.5
    want = pendulum_reference(start, u, 1.0)
    run = jax.jit(lambda steps: advance(f, Pendulum(start[0], start[1]), u, 1.0, steps))
    errors = [np.linalg.norm(np.array(run(steps)) - want) for steps in (40, 80, 160, 320)]
    np.testing.assert_allclose(orders(errors), order, atol=0.15)
    assert errors[-1] < {1: 0.1, 4: 1e-8}[order]


@pytest.mark.parametrize(("integrator", "order"), [(jf.euler, 1), (jf.rk4, 4)], ids=["euler", "rk4"])
def test_order_on_rotations(integrator, order):
    """A chart taken for flat would leave second order; so would leaving out the derivative of plus."""
    f = integrator(body_rate, BODY)
    q, w, torque = np.array([0.5, -0.5, 0.5, 0.5]), np.array([1.0, -2.0, 0.5]), np.array([0.7, 0.3, -1.0])
    R, rate = body_reference(q, w, torque, 1.0)
    run = jax.jit(lambda steps: advance(f, Body(jnp.asarray(q), jnp.asarray(w)), torque, 1.0, steps))
    errors = []
    for steps in (20, 40, 80, 160):
        x = run(steps)
        attitude = Rotation.from_quat(np.asarray(x.att), scalar_first=True).as_matrix()
        errors.append(np.linalg.norm(attitude - R) + np.linalg.norm(np.asarray(x.w) - rate))
    np.testing.assert_allclose(orders(errors), order, atol=0.25)
    assert errors[-1] < {1: 0.1, 4: 1e-8}[order]


def test_a_constant_body_rate_is_exact_however_long_the_step():
    f = jax.jit(jf.rk4(lambda q, u: u, jf.so3))
    w = np.array([1.0, -0.5, 2.0])
    start = np.array([0.5, 0.5, -0.5, 0.5])
    for dt in (0.0, 0.1, 1.0, 2.5):
        want = (Rotation.from_quat(start, scalar_first=True) * Rotation.from_rotvec(w * dt)).as_matrix()
        got = Rotation.from_quat(np.asarray(f(start, w, dt)), scalar_first=True).as_matrix()
        np.testing.assert_allclose(got, want, atol=1e-14 if dt * np.linalg.norm(w) < math.pi else 1e-12)


def test_substeps_are_steps():
    x, u = Pendulum(jnp.array(1.0), jnp.array(2.0)), 0.3
    one, four = (jax.jit(jf.rk4(pendulum_rate, PENDULUM, substeps=k)) for k in (1, 4))
    in_turn = x
    for _ in range(4):
        in_turn = one(in_turn, u, 0.05)
    np.testing.assert_allclose(four(x, u, 0.2), in_turn, rtol=1e-14)
    assert abs(one(x, u, 0.2).angle - four(x, u, 0.2).angle) > 1e-6


@pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("integrator", [jf.euler, jf.rk4], ids=["euler", "rk4"])
def test_rates_as_vectors_and_as_trees(integrator, dtype):
    """A pytree's leaves make up the tangent in order, Python floats among them."""
    x = Pendulum(dtype(1), dtype(2))
    as_tree = integrator(lambda x, u: Pendulum(x.rate * x.angle, 0.0), PENDULUM)
    as_vector = integrator(lambda x, u: jnp.stack([x.rate * x.angle, 0 * x.rate]), PENDULUM)
    a, b = (jax.jit(f)(x, (), dtype(0.1)) for f in (as_tree, as_vector))
    np.testing.assert_array_equal(a, b)
    assert {leaf.dtype for leaf in a} == {np.dtype(dtype)}
    assert a.rate == 2
    assert a.angle == pytest.approx(1.2 if integrator is jf.euler else math.exp(0.2), rel=1e-5)


def test_gradients():
    """Through a step on rotations, with respect to start, input and dt, also from rest and over no time."""
    f = jf.rk4(lambda q, u: jf.rotate_back(q, u), jf.so3)

    @jax.jit
    @jax.value_and_grad
    def g(theta):
        return jnp.arange(1.0, 5.0) @ f(theta[:4] / jf.norm(theta[:4]), theta[4:7], theta[7])

    theta = np.random.default_rng(0).normal(size=8)
    slope = g(theta)[1]
    for k, step in enumerate(1e-6 * np.eye(8)):
        assert slope[k] == pytest.approx(float(g(theta + step)[0] - g(theta - step)[0]) / 2e-6, rel=1e-7, abs=1e-8)
    at_rest = np.array([1.0, 0, 0, 0, 0, 0, 0, 0])
    assert np.isfinite(g(at_rest)[1]).all()


def test_complaints():
    with pytest.raises(ValueError, match=r"rk4\(substeps\): expected at least 1, got 0"):
        jf.rk4(pendulum_rate, PENDULUM, substeps=0)
    short = jf.euler(lambda x, u: x.rate, PENDULUM)
    text = r"rate\(x, u\): expected leaves that make up a tangent vector \(2,\), got \(1,\)"
    with pytest.raises(ValueError, match=text):
        short(Pendulum(jnp.array(1.0), jnp.array(2.0)), (), 0.1)
    with pytest.raises(ValueError, match=text):
        jax.jit(short)(Pendulum(jnp.array(1.0), jnp.array(2.0)), (), 0.1)
