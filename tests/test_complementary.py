"""The complementary filter against the lecture's in one plane and a plain NumPy loop on SO(3); dead reckoning."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxfilt as jf
from jaxfilt import metrics
from jaxfilt.complementary import complementary, dead_reckoning
from jaxfilt.models import attitude as attitudes
from jaxfilt.models.attitude import attitude

SHARE = {"accelerometer": 0.02, "magnetometer": 0.01}
INTEGRAL = {"accelerometer": 0.003, "magnetometer": 0.002}
STEPS, DT = 60, 0.05
FIELD = np.array(attitudes.field(attitudes.HAND_HELD))


@functools.cache
def log():
    rng = np.random.default_rng(3)
    att = Rotation.from_rotvec([0.5, -2.0, 1.0])
    u, force, magnetic = rng.normal(0, 1, (STEPS, 3)), [], []
    for k in range(STEPS):
        att = att * Rotation.from_rotvec(DT * u[k])
        force.append(att.inv().apply([0, 0, 9.81]) + rng.normal(0, 0.5, 3))
        magnetic.append(att.inv().apply(FIELD) + rng.normal(0, 1, 3))
    z = {"accelerometer": np.array(force), "magnetometer": np.array(magnetic)}
    return jf.Log(np.full(STEPS, DT), u + 0.1, z, {}, {"magnetometer": np.arange(STEPS) % 4 != 1})


START = attitudes.attitude_start(attitudes.HAND_HELD, jnp.array([1.0, 0.0, 0.0, 0.0]))


@functools.cache
def track():
    return jax.jit(lambda log: jf.scan(complementary(attitude(), SHARE, INTEGRAL), START, log))(log())


def test_equals_a_plain_loop_on_rotation_matrices():
    rows, M, b = log(), np.eye(3), np.zeros(3)
    for k in range(STEPS):
        M = M @ Rotation.from_rotvec(DT * (rows.u[k] - b)).as_matrix()
        for name in SHARE:
            if name == "magnetometer" and not rows.valid[name][k]:
                continue
            z = rows.z[name][k]
            if name == "accelerometer":
                a, e = z / np.linalg.norm(z), M.T @ [0, 0, 1]
                axis = np.cross(a, e)
                turn = np.arctan2(np.linalg.norm(axis), a @ e) * axis / np.linalg.norm(axis)
            else:
                seen = M @ z
                turn = M.T @ [0, 0, np.angle((FIELD[0] + 1j * FIELD[1]) / (seen[0] + 1j * seen[1]))]
            M = M @ Rotation.from_rotvec(SHARE[name] * turn).as_matrix()
            b = b - INTEGRAL[name] * turn
        got = Rotation.from_quat(np.asarray(track().belief.mean.att[k]), scalar_first=True).as_matrix()
        np.testing.assert_allclose(got, M, atol=1e-10)
        np.testing.assert_allclose(track().belief.mean.gyro_bias[k], b, atol=1e-11)


def test_in_one_plane_it_is_the_lectures():
    alpha, angle = 0.98, 0.4
    rolling = np.array([0.3, -0.5, 0.8, 0.1])
    tilts = np.array([0.5, 0.3, 0.45, 0.6])
    force = 9.81 * np.stack([0 * tilts, np.sin(tilts), np.cos(tilts)], 1)
    u = np.stack([rolling, 0 * rolling, 0 * rolling], 1)
    start = attitudes.attitude_start(attitudes.HAND_HELD, jf.so3_exp(jnp.array([angle, 0.0, 0.0])))
    rows = jf.Log(np.full(4, 0.1), u, {"accelerometer": force}, {}, {})
    mean = jf.scan(complementary(attitude(), {"accelerometer": 1 - alpha}), start, rows).belief.mean
    for k in range(4):
        angle = alpha * (angle + 0.1 * rolling[k]) + (1 - alpha) * tilts[k]
        np.testing.assert_allclose(jf.so3_log(mean.att[k]), [angle, 0, 0], atol=1e-12)


def test_it_converges_from_any_attitude_and_finds_the_bias():
    n, bias = 3000, np.array([0.02, -0.03, 0.05])
    z = {"accelerometer": np.tile([0, 0, 9.81], (n, 1)), "magnetometer": np.tile(FIELD, (n, 1))}
    rows = jf.Log(np.full(n, 0.05), np.tile(bias, (n, 1)), z, {}, {})
    filt = complementary(attitude(), {"accelerometer": 0.05, "magnetometer": 0.05}, dict.fromkeys(SHARE, 0.01))
    run = jax.jit(lambda start: jf.scan(filt, start, rows, store=jf.mean_only))
    for att in Rotation.random(3, rng=np.random.default_rng(4)):
        start = attitudes.attitude_start(attitudes.HAND_HELD, jnp.asarray(att.as_quat(scalar_first=True)))
        end = jax.tree.map(lambda a: a[-1], run(start))
        assert np.abs(np.asarray(jf.so3_log(end.att))).max() < 1e-3
        np.testing.assert_allclose(end.gyro_bias, bias, atol=1e-3)


def test_a_disturbed_compass_does_not_tilt_it_unless_told_to():
    filt = complementary(attitude(), {"magnetometer": 1.0})
    full = complementary(attitude(), {"magnetometer": 1.0}, heading=())
    iron = jnp.asarray(FIELD + np.array([8.0, -3.0, 10.0]))
    level, _ = filt.update(START, iron, "magnetometer")
    turn = np.asarray(jf.so3_log(level.mean.att))
    np.testing.assert_allclose(turn[:2], 0, atol=1e-12)
    assert abs(turn[2]) > 0.1
    assert np.abs(np.asarray(jf.so3_log(full.update(START, iron, "magnetometer")[0].mean.att))[:2]).max() > 0.1


def test_it_claims_no_covariance_and_reports_no_consistency():
    info, mean = track().info["magnetometer"], track().belief.mean
    assert not np.asarray(track().belief.cov).any()
    there = log().valid["magnetometer"]
    np.testing.assert_array_equal(info.status, np.where(there, jf.Status.OK, jf.Status.ABSENT))
    for field in (info.S, info.nis, info.loglik, info.dof, info.ratio):
        assert not np.asarray(field).any()
    assert np.abs(info.innovation[there]).min() > 0
    assert math.isnan(metrics.anis(info).mean)
    assert jf.diagnose(track()) is None
    assert np.isfinite(mean.att).all()


def test_a_replay_scores_its_errors_and_gives_no_verdict():
    theta = jax.tree.map(jnp.asarray, attitudes.HAND_HELD)
    truth = jf.Truth(track().belief.mean.att, np.full(STEPS, True))
    recording = jf.Recording(log(), DT * np.arange(STEPS))
    space = attitudes.inclination_and_heading
    replay = jf.Replay(attitude, lambda theta: START, theta, recording, truth, space, lambda x: x.att, attitudes.ERRORS)
    filters = {"complementary": lambda theta: complementary(attitude(theta), {"accelerometer": 0.05})}
    review = jf.replayed(replay, filters).reviews["complementary"]
    assert review.verdict.headline == "complementary: nothing to judge by"
    assert not review.diverged
    assert review.fault is None
    assert review.rmse is not None
    assert review.rmse["heading"] > 0.01
    assert review.nees is not None
    assert np.isnan(review.nees).all()


def test_bad_readings_are_reported_and_unknown_ones_change_nothing():
    filt = complementary(attitude(), {"accelerometer": 0.1})
    run = jax.jit(lambda z: filt.update(START, z, "accelerometer")[1].status)
    assert run(jnp.array([0.0, jnp.nan, 1.0])) == jf.Status.BAD_MEASUREMENT
    same, info = filt.update(START, jnp.asarray(FIELD), "magnetometer")
    assert info.status == jf.Status.ABSENT
    np.testing.assert_array_equal(same.mean.att, START.mean.att)
    partly, info = filt.update(START, jnp.array([1.0, 2.0, 3.0]), "accelerometer", (), np.array([True, True, False]))
    assert info.status == jf.Status.ABSENT
    np.testing.assert_array_equal(partly.mean.att, START.mean.att)


@pytest.mark.parametrize("reading", [[0.0, 0.0, 9.81], [0.0, 0.0, -9.81], [0.0, 0.0, 0.0], [3.0, 0.0, 9.0]])
def test_gradients_are_finite_where_nothing_or_the_opposite_is_seen(reading):
    for name in SHARE:
        filt = complementary(attitude(), {name: 0.1})
        gradient = jax.grad(lambda z, name=name, filt=filt: filt.update(START, z, name)[0].mean.att[1:].sum())
        assert np.isfinite(gradient(jnp.array(reading))).all()


def test_float32_and_lanes_are_the_same():
    single = jax.tree.map(lambda a: a.astype(np.float32) if a.dtype.kind == "f" else a, log())
    start = jax.tree.map(lambda a: a.astype(jnp.float32), START)
    filt = complementary(attitude(), SHARE, INTEGRAL)
    mean = jax.jit(lambda log: jf.scan(filt, start, log, store=jf.mean_only))(single)
    assert {a.dtype for a in jax.tree.leaves(mean)} == {np.dtype(np.float32)}
    np.testing.assert_allclose(mean.att, track().belief.mean.att, atol=1e-4)
    pytest.importorskip("llvmlite")
    many = jax.tree.map(lambda a: np.stack([a, a]), log())
    lanes = jax.jit(lambda log: jf.scan_runs(filt, START, log, store=jf.mean_only, backend="lanes"))(many)
    for k in range(2):
        np.testing.assert_allclose(lanes.att[k], track().belief.mean.att, atol=1e-9)


def test_dead_reckoning_is_the_ekf_that_hears_nothing():
    silent = log()._replace(valid={name: np.zeros(STEPS, bool) for name in SHARE})
    want = jax.jit(lambda log: jf.scan(jf.ekf(attitude()), START, log))(silent)
    got = jax.jit(lambda log: jf.scan(dead_reckoning(attitude()), START, log))(log())
    np.testing.assert_allclose(got.belief.mean.att, want.belief.mean.att, atol=1e-12)
    np.testing.assert_allclose(got.belief.cov, want.belief.cov, rtol=1e-9, atol=1e-15)
    assert (got.info["accelerometer"].status == jf.Status.ABSENT).all()


def test_what_does_not_fit_is_named():
    walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
    with pytest.raises(ValueError, match="model: expected a state with att"):
        complementary(walk, {"z": 0.1})
    with pytest.raises(KeyError, match=r"sensor: expected one of .* got 'sonar'"):
        complementary(attitude(), {"sonar": 0.1})
    with pytest.raises(ValueError, match=r"share\['accelerometer'\]: expected 0 to 1, got 2"):
        complementary(attitude(), {"accelerometer": 2.0})
    with pytest.raises(ValueError, match="sensors of a vector"):
        complementary(attitude(), {"heading": 0.1})
    with pytest.raises(KeyError, match="integral: expected sensors that have a share"):
        complementary(attitude(), {"accelerometer": 0.1}, {"magnetometer": 0.1})
