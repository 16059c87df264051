"""Attitude and bias: against scipy's rotations, a plain NumPy error-state filter, and by its consistency."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_checks import assert_derivatives, cast, filtered, nees, simulated, van_loan
from scipy.spatial.transform import Rotation

import jaxfilt as jf
from jaxfilt.models import attitude as attitudes
from jaxfilt.models.attitude import HAND_HELD, Attitude, attitude

ATTS = Rotation.random(20, rng=np.random.default_rng(1))
STRENGTH, DIP, DECLINATION = HAND_HELD["field"]
FIELD = STRENGTH * np.array([np.cos(DIP) * np.sin(DECLINATION), np.cos(DIP) * np.cos(DECLINATION), -np.sin(DIP)])


def point(k):
    return Attitude(jnp.asarray(ATTS[k].as_quat(scalar_first=True)), jnp.array([0.01, -0.02, 0.03]))


def skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def test_sensors_are_the_vectors_of_the_world_as_scipy_turns_them():
    model = attitude()
    for k in range(5):
        x, R = point(k), ATTS[k].as_matrix()
        np.testing.assert_allclose(model.sensors["accelerometer"].h(x, ()), R.T @ [0, 0, 9.81], atol=1e-12)
        np.testing.assert_allclose(model.sensors["magnetometer"].h(x, ()), R.T @ FIELD, atol=1e-12)
        # Turned about the vertical by 0.3 rad, an attitude reads a field that is 0.3 rad off.
        off = Rotation.from_rotvec([0, 0, 0.3]) * ATTS[k]
        wrong = Attitude(jnp.asarray(off.as_quat(scalar_first=True)), x.gyro_bias)
        assert float(model.sensors["heading"].h(wrong, jnp.asarray(R.T @ FIELD))) == pytest.approx(0.3, abs=1e-12)


def test_a_disturbed_dip_does_not_move_a_heading():
    model = attitude()
    x, R = point(3), ATTS[3].as_matrix()
    iron = jnp.asarray(R.T @ (FIELD * [1, 1, 0.3]))
    level = jf.Gaussian(x, jnp.diag(jnp.array([0.1, 0.1, 0.1, 1e-3, 1e-3, 1e-3])) ** 2)
    by_heading, _ = jf.ekf(model).update(level, jnp.asarray(0.0), "heading", iron)
    by_vector, _ = jf.ekf(model).update(level, iron, "magnetometer")
    assert np.abs(np.asarray(jf.so3.minus(by_heading.mean.att, x.att))).max() < 1e-9
    assert np.abs(np.asarray(jf.so3.minus(by_vector.mean.att, x.att))).max() > 0.05


def test_the_noise_is_the_integral_of_its_densities():
    A = np.zeros((6, 6))
    A[:3, 3:] = -np.eye(3)
    theta = HAND_HELD | {"gyro": tuple(np.log([0.1, 0.2, 0.3])), "gyro_walk": tuple(np.log([0.3, 0.1, 0.5]))}
    density = np.diag(np.square([0.1, 0.2, 0.3, 0.3, 0.1, 0.5]))
    for dt in (0.01, 2.0):
        np.testing.assert_allclose(
            attitude(theta).Q(point(0), jnp.ones(3), jnp.asarray(dt)), van_loan(A, density, dt), rtol=1e-6, atol=1e-12
        )


def test_derivatives():
    model = attitude()
    reading = jnp.asarray(ATTS[2].inv().apply(FIELD))
    assert_derivatives(lambda x: model.f(x, jnp.array([0.3, -0.2, 1.0]), 0.1), point(1))
    assert_derivatives(lambda x: model.sensors["heading"].h(x, reading), point(2), atol=1e-6)


def by_hand(theta, q, P, rows):
    """Error-state EKF with rotation matrices, no line shared: means (matrix, bias) and covariances."""
    n, w, a, m = (math.exp(2 * theta[k]) for k in ("gyro", "gyro_walk", "accelerometer", "magnetometer"))
    M, b, out, eye = q.as_matrix(), np.zeros(3), [], np.eye(3)
    for dt, u, force, magnetic in rows:
        v = dt * (u - b)
        angle, V = np.linalg.norm(v), skew(v)
        right = eye - (1 - np.cos(angle)) / angle**2 * V + (angle - np.sin(angle)) / angle**3 * V @ V
        turn = Rotation.from_rotvec(v).as_matrix()
        F = np.block([[turn.T, -dt * right], [np.zeros((3, 3)), eye]])
        Q = np.block([[(dt * n + dt**3 / 3 * w) * eye, -(dt**2) / 2 * w * eye], [-(dt**2) / 2 * w * eye, dt * w * eye]])
        M, P = M @ turn, F @ P @ F.T + Q
        for z, world, R in ((force, np.array([0, 0, 9.81]), a), (magnetic, FIELD, m)):
            if z is None:
                continue
            H = np.hstack([skew(M.T @ world), np.zeros((3, 3))])
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R * eye)
            d = K @ (z - M.T @ world)
            P = (np.eye(6) - K @ H) @ P
            angle, V = np.linalg.norm(d[:3]), skew(d[:3])
            carry = np.eye(6)
            carry[:3, :3] = eye - (1 - np.cos(angle)) / angle**2 * V + (angle - np.sin(angle)) / angle**3 * V @ V
            M, b, P = M @ Rotation.from_rotvec(d[:3]).as_matrix(), b + d[3:], carry @ P @ carry.T
        out.append((M, b, P))
    return [np.array(column) for column in zip(*out, strict=True)]


def test_equals_a_plain_filter_at_irregular_intervals():
    rng, steps = np.random.default_rng(5), 40
    dt, u = rng.uniform(0.005, 0.1, steps), rng.normal(0, 1, (steps, 3))
    force = rng.normal(0, 0.5, (steps, 3)) + ATTS[0].inv().apply([0, 0, 9.81])
    magnetic = rng.normal(0, 2, (steps, 3)) + ATTS[0].inv().apply(FIELD)
    there = np.arange(steps) % 3 == 0
    start = attitudes.attitude_start(HAND_HELD, point(0).att)
    log = jf.Log(dt, u, {"accelerometer": force, "magnetometer": magnetic}, {}, {"magnetometer": there})
    got = jax.jit(lambda log: jf.scan(jf.ekf(attitude()), start, log).belief)(log)
    rows = [(dt[k], u[k], force[k], magnetic[k] if there[k] else None) for k in range(steps)]
    M, b, P = by_hand(HAND_HELD, ATTS[0], np.asarray(start.cov), rows)
    np.testing.assert_allclose(
        Rotation.from_quat(np.asarray(got.mean.att), scalar_first=True).as_matrix(), M, atol=1e-9
    )
    np.testing.assert_allclose(got.mean.gyro_bias, b, atol=1e-10)
    np.testing.assert_allclose(got.cov, P, rtol=1e-7, atol=1e-14)


def test_the_start_knows_heading_from_inclination_at_any_attitude():
    att = ATTS[4]
    theta = HAND_HELD | {"start": (math.log(0.01), math.log(0.2), math.log(0.003))}
    cov = np.asarray(attitudes.attitude_start(theta, jnp.asarray(att.as_quat(scalar_first=True))).cov)
    R = att.as_matrix()
    np.testing.assert_allclose(R @ cov[:3, :3] @ R.T, np.diag(np.square([0.01, 0.01, 0.2])), atol=1e-12)
    np.testing.assert_allclose(cov[3:], np.hstack([np.zeros((3, 3)), 9e-6 * np.eye(3)]))


@functools.cache
def simulation():
    return simulated(attitudes.scenario(), 40, 300)


def averages(build, theta=None):
    """Mean NEES over time by run and block, over its dimension."""
    scenario = attitudes.scenario()
    beliefs = filtered(scenario, simulation(), build, theta)
    found = {}
    for block, (index, _) in scenario.blocks.items():
        at = list(index)
        part = jf.Model(lambda x, u, dt: x, jf.const(jnp.eye(3)), jf.so3 if at[0] == 0 else jf.vector(3), {})
        field = "att" if at[0] == 0 else "gyro_bias"
        truth, mean = (getattr(x, field) for x in (simulation().truth, beliefs.mean))
        own = jf.Gaussian(mean, np.asarray(beliefs.cov)[..., at, :][..., at])
        found[block] = nees(part, truth, own).mean(1) / 3
    return found


@pytest.mark.parametrize("build", [jf.ekf, jf.ukf])
def test_waved_in_a_hand_the_filter_is_consistent_in_every_block(build):
    for values in averages(build).values():
        assert abs(values.mean() - 1) < 4 * values.std(ddof=1) / np.sqrt(len(values))
        assert 0.8 < values.mean() < 1.25


def test_what_is_inconsistent_is_found_out():
    """A gyroscope taken for ten times as good, a bias for known: the blocks that say so."""
    wrong = HAND_HELD | {"start": (*HAND_HELD["start"][:2], math.log(math.radians(0.3)))}
    values = averages(jf.ekf, cast(wrong, jnp.float64))
    for block in values:
        own = values[block]
        assert own.mean() - 1 > 4 * own.std(ddof=1) / np.sqrt(len(own))


def test_without_bias_estimation_it_stays():
    sure = HAND_HELD | {"gyro_walk": math.log(1e-9), "start": (*HAND_HELD["start"][:2], math.log(1e-9))}
    beliefs = filtered(attitudes.scenario(), simulation(), jf.ekf, cast(sure, jnp.float64))
    assert np.abs(beliefs.mean.gyro_bias).max() < 1e-6


# --- errors as the benchmark has them ----------------------------------------------------------------------------


def test_heading_and_inclination_are_laidigs():
    for a, b in zip(ATTS[:10], ATTS[10:], strict=True):
        _, _, z, w = (a * b.inv()).as_quat()
        heading, inclination = attitudes.heading_and_inclination(
            *(jnp.asarray(r.as_quat(scalar_first=True)) for r in (a, b))
        )
        assert float(heading) == pytest.approx(2 * np.arctan(abs(z / w)), abs=1e-9)
        assert float(inclination) == pytest.approx(2 * np.arccos(np.hypot(w, z)), abs=1e-7)
        total = 2 * np.arccos(np.cos(heading / 2) * np.cos(inclination / 2))
        assert total == pytest.approx((a * b.inv()).magnitude(), abs=1e-7)


def test_the_space_of_inclination_and_heading_is_one():
    space = attitudes.inclination_and_heading
    rng = np.random.default_rng(2)
    for k in range(10):
        q = jnp.asarray(ATTS[k].as_quat(scalar_first=True))
        d = rng.uniform(-1, 1, 3)
        np.testing.assert_allclose(space.minus(space.plus(q, d), q), d, atol=1e-12)
        turned = Rotation.from_rotvec([d[0], d[1], 0]) * Rotation.from_rotvec([0, 0, d[2]]) * ATTS[k]
        got = Rotation.from_quat(np.asarray(space.plus(q, d)), scalar_first=True)
        assert (turned.inv() * got).magnitude() < 1e-12
        slope = jax.jacrev(lambda d, q=q: space.minus(space.plus(q, d), q))(jnp.zeros(3))
        np.testing.assert_allclose(slope, np.eye(3), atol=1e-9)
