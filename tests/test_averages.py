"""The baselines: sums by hand, their latency and drift beside a Kalman filter, and what they refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import car_system

import jaxfilt as jf
from jaxfilt.averages import averaging, moving_average
from jaxfilt.models import textbook

ONE = jnp.eye(1)
METER = jf.linear(ONE, ONE, ONE, ONE)


def log_of(z, dt=1.0):
    return jf.Log(jnp.full(len(z), dt), (), {"z": jnp.asarray(z)[:, None]}, {}, {})


def test_the_sum_by_hand():
    z, x, alpha = np.random.default_rng(0).normal(size=50), 3.0, 0.8
    got = jf.scan(moving_average(METER, alpha), jf.Gaussian(jnp.array([x]), ONE), log_of(z))
    for k, reading in enumerate(z):
        x = alpha * x + (1 - alpha) * reading
        np.testing.assert_allclose(got.belief.mean[k, 0], x, rtol=1e-12)
    assert not np.asarray(got.belief.cov).any()
    assert not np.asarray(got.info["z"].S).any()


def test_it_comes_late_where_a_kalman_filter_does_not():
    """After a ramp of 2 m/s it is alpha / (1 - alpha) dt late; a filter that knows of velocity is not."""
    dt, alpha, t = 0.1, 0.9, 0.1 * np.arange(1, 400)
    drone = jf.linear(jnp.array([[1.0, dt], [0.0, 1.0]]), jnp.array([[1.0, 0.0]]), 1e-4 * jnp.eye(2), 0.01 * ONE)
    start, log = jf.Gaussian(jnp.zeros(2), jnp.eye(2)), log_of(2.0 * t, dt)
    late = 2.0 * t[-1] - jf.scan(moving_average(drone, alpha), start, log).belief.mean[-1, 0]
    np.testing.assert_allclose(late / 2.0, alpha / (1 - alpha) * dt, rtol=1e-6)
    assert abs(2.0 * t[-1] - jf.scan(jf.kf(drone), start, log).belief.mean[-1, 0]) < 1e-3


def test_fusion_beats_the_mean_of_two_sensors():
    """GPS and integrated acceleration: the Kalman filter's position error is a fraction of the average's."""
    scenario = textbook.gps_accelerometer_robot_scenario()
    model, start = scenario.model(scenario.theta), scenario.belief(scenario.theta)
    filters = {"kf": lambda th: jf.kf(model), "mean": lambda th: averaging(model, 0.5)}
    plan = scenario.schedule(400)
    found = jf.study(
        scenario.model, filters, lambda th: start, plan, jax.random.key(0), theta=scenario.theta, runs=100,
        blocks=scenario.blocks,
    )  # fmt: skip
    rmse = {name: float(scores.rmse_total["position"].value) for name, scores in found.scores.items()}
    assert rmse["kf"] < 0.8 * rmse["mean"]


def test_angles_missing_components_and_unheard_sensors():
    s = car_system(10)
    model = s.model(s.theta)
    filt = averaging(model, {"gnss": 0.5})
    belief, info = filt.update(s.belief, s.belief.mean.pos + 2.0, "gnss", (), jnp.array([True, False]))
    np.testing.assert_allclose(belief.mean.pos - s.belief.mean.pos, [1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(info.innovation, [2.0, 0.0], atol=1e-12)
    same, info = filt.update(s.belief, (jnp.array(5.0), jnp.array(0.1)), "mark", jnp.array([1.0, 2.0]))
    assert info.status == jf.Status.ABSENT
    np.testing.assert_array_equal(same.mean.pos, s.belief.mean.pos)
    around = moving_average(jf.Model(lambda x, u, dt: x, jf.const(ONE), jf.angle, {
        "compass": jf.Sensor(lambda x, c: x, jf.const(ONE), jf.angle)}), 0.5)  # fmt: skip
    belief, _ = around.update(jf.Gaussian(jnp.asarray(3.1), ONE), jnp.asarray(-3.1), "compass")
    assert abs(abs(float(belief.mean)) - np.pi) < 1e-9


def test_bad_news_and_wrong_use():
    _, info = jax.jit(lambda z: moving_average(METER, 0.5).update(jf.Gaussian(jnp.zeros(1), ONE), z, "z"))(
        jnp.array([np.nan])
    )
    assert info.status == jf.Status.BAD_MEASUREMENT
    with pytest.raises(ValueError, match=r"alpha\['z'\]: expected 0 <= alpha < 1, got 1.5"):
        moving_average(METER, 1.5)
    with pytest.raises(KeyError, match="gps"):
        averaging(METER, {"gps": 0.5})
