"""The bicycle and the car-like robot against the equations of motion, integrated by SciPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_checks import assert_derivatives, cast
from scipy.integrate import solve_ivp

import jaxfilt as jf
from jaxfilt.models import car
from jaxfilt.models.car import Bicycle, CarLike, Driving

WHEEL_BASE = 2.7


def bicycle(pos, yaw, speed, dtype=np.float64):
    return Bicycle(jnp.asarray(pos, dtype), jnp.asarray(yaw, dtype), jnp.asarray(speed, dtype))


@functools.cache
def model():
    return car.bicycle(cast(car.CITY_CAR, np.float64))


def driven(x, a, steering, dt):
    """The kinematic bicycle's differential equations, solved numerically."""

    def rate(t, s):
        return [s[3] * np.cos(s[2]), s[3] * np.sin(s[2]), s[3] * np.tan(steering) / WHEEL_BASE, a]

    start = [*np.asarray(x.pos), float(x.yaw), float(x.speed)]
    return solve_ivp(rate, (0, dt), start, rtol=1e-11, atol=1e-11).y[:, -1]


@pytest.mark.parametrize("steering", [-0.6, -1e-5, 0.0, 1e-9, 0.02, 0.6])
@pytest.mark.parametrize(("speed", "a"), [(10.0, 1.0), (0.0, 2.0), (-3.0, 0.5), (1.0, -2.0)])
def test_bicycle_is_the_exact_solution(steering, speed, a):
    x = bicycle([1.0, -2.0], 0.4, speed)
    expected = driven(x, a, steering, 0.8)
    y = model().f(x, Driving(a, steering), 0.8)
    np.testing.assert_allclose([*y.pos, y.yaw, y.speed], expected, atol=1e-9)


def test_turning_radius_is_wheel_base_over_tan_steering():
    steering, radius = 0.3, WHEEL_BASE / np.tan(0.3)
    x = bicycle([0.0, 0.0], 0.0, 5.0)
    step = jax.jit(lambda x: model().f(x, Driving(0.0, steering), 2 * np.pi * radius / 5.0 / 100))
    for k in range(100):
        x = step(x)
        np.testing.assert_allclose(np.hypot(x.pos[0], x.pos[1] - radius), radius, rtol=1e-12)
        if k == 49:
            np.testing.assert_allclose(x.pos, [0.0, 2 * radius], atol=1e-9)
    np.testing.assert_allclose(x.pos, [0.0, 0.0], atol=1e-9)
    assert abs(x.yaw) < 1e-9


def test_bicycle_derivatives_straight_and_at_rest():
    cases = [(10.0, 0.0), (0.0, 0.0), (0.0, 0.3), (-2.0, 0.2), (10.0, 1e-7)]
    points = [(bicycle([1.0, 2.0], 3.1, v), Driving(jnp.asarray(0.5), jnp.asarray(s))) for v, s in cases]
    assert_derivatives(lambda point: model().f(*point, 0.1), *points)


def test_gradient_with_respect_to_the_wheel_base():
    x, u = bicycle([0.0, 0.0], 0.3, 8.0), Driving(0.3, 0.2)
    assert_derivatives(
        lambda base: car.bicycle(car.CITY_CAR | {"wheel_base": base}).f(x, u, 0.5), jnp.asarray(np.log(WHEEL_BASE))
    )


def test_landmark_seen_from_the_car():
    mark = model().sensors["mark"]
    distance, direction = mark.h(bicycle([1.0, 1.0], np.pi / 2, 0.0), jnp.array([-2.0, 5.0]))
    np.testing.assert_allclose([distance, direction], [5.0, np.arctan2(3.0, 4.0)])
    assert_derivatives(lambda x: mark.h(x, jnp.array([4.0, 3.0])), bicycle([1.0, 1.0], 3.0, 5.0))


def test_noise_grows_with_time_and_has_the_units_of_the_state():
    x = bicycle([0.0, 0.0], 0.0, 10.0)
    np.testing.assert_allclose(np.diag(model().Q(x, (), 4.0)), np.square([0.1, 0.1, 0.02, 0.4]))
    np.testing.assert_allclose(model().sensors["gnss"].R(x, ()), np.eye(2))


def test_the_dtype_of_theta_is_the_dtype_of_the_filter():
    scenario = car.scenario()
    log = jax.tree.map(lambda a: a.astype(np.float32) if a.dtype.kind == "f" else a, scenario.schedule(60))
    run = jax.jit(lambda theta: jf.scan(jf.ekf(scenario.model(theta)), scenario.belief(theta), log).belief)
    belief = run(cast(scenario.theta, np.float32))
    assert {leaf.dtype for leaf in jax.tree.leaves(belief)} == {np.dtype(np.float32)}
    assert (np.linalg.eigvalsh(np.asarray(belief.cov, np.float64)) > 0).all()


# --- the car-like robot ------------------------------------------------------------------------------------------


def test_car_like_follows_the_equations():
    like = car.car_like()
    r, v, heading, rate = np.array([1.0, 2.0]), np.array([1.5, -0.3]), 0.7, 0.4
    x, dt = CarLike(*map(jnp.asarray, (r, v, heading, rate))), 0.1
    step = jax.jit(lambda x: like.f(x, (), dt))
    for _ in range(100):
        x = step(x)
        R = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        r, heading = r + dt * R @ v, heading + dt * rate
        np.testing.assert_allclose(x.pos, r, atol=1e-12)
        np.testing.assert_allclose(np.exp(1j * float(x.yaw)), np.exp(1j * heading), atol=1e-12)
    np.testing.assert_array_equal(x.vel, v)
    assert x.rate == rate


def test_car_like_heads_where_its_yaw_points():
    north = CarLike(jnp.zeros(2), jnp.array([2.0, 0.0]), jnp.asarray(np.pi / 2), jnp.asarray(0.0))
    np.testing.assert_allclose(car.car_like().f(north, (), 0.5).pos, [0.0, 1.0], atol=1e-12)


def test_car_like_derivatives():
    points = [CarLike(*map(jnp.array, ([1.0, 2.0], [speed, 0.0], 3.0, 0.0))) for speed in (0.0, 2.0)]
    assert_derivatives(lambda x: car.car_like().f(x, (), 0.1), *points)


def test_car_like_sensors():
    x = CarLike(jnp.array([1.0, 2.0]), jnp.array([3.0, 4.0]), jnp.asarray(0.5), jnp.asarray(0.1))
    pose, camera = (car.car_like().sensors[name] for name in ("pose", "camera"))
    np.testing.assert_array_equal(np.concatenate([*pose.h(x, ())[:2], [pose.h(x, ()).yaw]]), [1, 2, 3, 4, 0.5])
    seen = camera.h(x, jnp.array([3.0, 0.0]))
    np.testing.assert_array_equal([*seen.pos, seen.yaw], [-2.0, 2.0, 0.5])


def test_a_camera_that_sees_it_now_and_then_keeps_the_car_found():
    scenario = car.car_like_scenario()
    log = scenario.schedule(400)
    pose, camera = log.valid["pose"], log.valid["camera"]
    assert pose[:100].sum() == 20
    assert not pose[100:].any()
    assert camera[200:300].sum() == 10
    assert camera.sum() == 10
    run = jax.jit(lambda log: jf.scan(jf.ekf(car.car_like()), scenario.belief(scenario.theta), log))
    covs = np.asarray(run(log).belief.cov)
    std = np.sqrt(covs[:, 0, 0] + covs[:, 1, 1])
    assert std[199] > 2 * std[99], "out of sight, the position is lost"
    assert std[299] < 0.3 * std[199], "the camera finds it again"
