"""Drones in halls, ranged from anchors: what their models say, and that the biases of the anchors are worth knowing."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt import datasets, recordings
from jaxfilt.models.inertial import Imu, Navigation
from jaxfilt.recordings import anchored, indoor_inertial
from jaxfilt.recordings.indoor import Moving

SECONDS = 25.0
MEASURED = {
    "bias": (-0.3, -0.2, -0.3, -0.1, -0.35, -0.3, -0.3, -0.3),
    "range": tuple(np.log([0.1, 0.2, 0.05, 0.3, 0.1, 0.05, 0.1, 0.05])),
    "late": (0.05, 0.1),
}
"""What the set's README measured on the five flights: not held out, a bound for the model and not for a tuning."""


@functools.cache
def drone(sequence: str) -> jf.Replay:
    """A Crazyflie's first seconds."""
    whole = indoor_inertial.crazyflie_uwb_inertial(datasets.load("crazyflie_uwb", sequence))
    rows = int(np.searchsorted(whole.recording.t, whole.recording.t[0] + SECONDS))
    log, t, truth = jax.tree.map(lambda a: a[:rows], (whole.recording.log, whole.recording.t, whole.truth))
    return whole._replace(recording=jf.Recording(log, t), truth=truth)


@functools.cache
def anchored_flight(sequence: str) -> jf.Replay:
    return anchored.rcv_uwb_drone(datasets.load("rcv_uwb_drone", sequence))


@functools.cache
def program(model, robust):
    """(theta, belief, log) -> means: compiled once for all parameters."""

    def run(theta, belief, log):
        return jf.scan(jf.ekf(model(theta), robust=robust), belief, log, store=jf.mean_only)

    return jax.jit(run)


def score(replay: jf.Replay, robust: float | None = 0.95, **changed) -> dict[str, float]:
    theta = jax.tree.map(jnp.asarray, {**replay.theta, **changed})
    mean = program(replay.model, robust)(theta, replay.belief(theta), replay.recording.log)
    return recordings.rmse(replay, mean)


@pytest.mark.data
@pytest.mark.usefixtures("data")
def test_inertial_navigation_among_anchors_gains_from_their_biases():
    replay = drone("sine_xyz")
    newcomer, known = score(replay)["position"], score(replay, **MEASURED)["position"]
    assert known < 0.12
    assert known < 0.8 * newcomer < 0.25


@pytest.mark.data
@pytest.mark.usefixtures("data")
def test_four_anchors_tell_where_a_drone_is_but_not_how_high():
    replay = anchored_flight("sequence3")
    told, plain = score(replay), score(replay, robust=None)
    assert told["horizontal"] < 0.2
    assert told["height"] > told["horizontal"]
    assert plain["horizontal"] > 3 * told["horizontal"]  # gross outliers
    # On this flight only: on sequence6, where the height is on the wrong side, no bias does slightly better.
    assert score(replay, bias=0.0)["height"] > 1.5 * told["height"]


@pytest.mark.data
@pytest.mark.usefixtures("data")
@pytest.mark.parametrize(
    ("name", "read"),
    [("crazyflie_uwb", indoor_inertial.crazyflie_uwb_inertial), ("rcv_uwb_drone", anchored.rcv_uwb_drone)],
)
def test_no_reading_knows_the_truth(name, read):
    data = datasets.load(name)
    off = data._replace(truth={k: (t, x + 1.0 if k == "pos" else x) for k, (t, x) in data.truth.items()})
    a, b = read(data), read(off)
    for one, other in zip(
        jax.tree.leaves((a.recording, a.belief(a.theta))),
        jax.tree.leaves((b.recording, b.belief(b.theta))),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)


def test_an_indoor_drones_readings_by_hand():
    yaw, roll = 0.4, 0.3
    quaternion = [
        np.cos(yaw / 2) * np.cos(roll / 2),
        np.cos(yaw / 2) * np.sin(roll / 2),
        np.sin(yaw / 2) * np.sin(roll / 2),
        np.sin(yaw / 2) * np.cos(roll / 2),
    ]
    R = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]) @ np.array(
        [[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]]
    )
    pos, vel, bias = np.array([1.0, 2.0, 0.8]), np.array([0.5, -1.0, 0.6]), np.array([0.01, -0.02, 0.03])
    x = Navigation(*map(jnp.asarray, (pos, vel, np.array(quaternion), bias, np.zeros(3))))
    theta = indoor_inertial.INERTIAL_DRONE | {"late": (0.2, 0.1), "bias": tuple(0.1 * k for k in range(8))}
    sensors = indoor_inertial.inertial_drone(theta).sensors
    anchor = np.array([-3.0, 4.0, 2.0])
    for k in range(8):
        expected = np.linalg.norm(pos - 0.2 * vel - anchor) + 0.1 * k
        assert float(sensors[f"range_{k + 1}"].h(x, jnp.asarray(anchor))) == pytest.approx(expected, rel=1e-9)
    assert float(sensors["height"].h(x, ())) == pytest.approx((0.8 - 0.06) / np.cos(roll), rel=1e-9)
    rates = np.array([0.3, 0.5, -0.2])
    own, turn = R.T @ vel, rates - bias
    expected = 4.0 * (own[:2] * np.cos(roll) / 0.8 + np.array([-turn[1], turn[0]]))
    flow = sensors["flow"].h(x, Imu(jnp.asarray(rates), jnp.zeros(3)))
    np.testing.assert_allclose(flow, expected, rtol=1e-9)
    # On the floor nothing is divided by zero.
    low = sensors["flow"].h(x._replace(pos=jnp.zeros(3)), Imu(jnp.asarray(rates), jnp.zeros(3)))
    assert np.isfinite(np.asarray(low)).all()


def test_anchors_in_a_plane_do_not_tell_a_height_from_its_mirror_image():
    sensor = anchored.anchored_drone().sensors["range_2"]
    here, there = (Moving(jnp.array([0.3, -1.0, z]), jnp.zeros(3)) for z in (1.7, 0.3))
    anchor = jnp.array([2.0, 2.0, 1.0])
    assert float(sensor.h(here, anchor)) == pytest.approx(np.sqrt(1.7**2 + 9 + 0.49) + 0.2, rel=1e-9)
    assert float(sensor.h(here, anchor)) == pytest.approx(float(sensor.h(there, anchor)), rel=1e-9)
