"""Tuning finds the noise of simulated robots again, from standard deviations wrong by 10 to 100; and where the model is
wrong, it beats the residuals of the truth."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt import consistency
from jaxfilt.models import textbook
from jaxfilt.scenarios import scenario
from jaxfilt.tuning.parameters import covers, parameters

DRONE = textbook.horizontal_drone_scenario(), ("drift",), ("gnss",)
CAR = scenario("car"), ("slip", "turn", "speed"), ("gnss", "odometer")


@pytest.fixture(scope="module", autouse=True)
def _as_users_compile():
    """What takes its time here is not compilation."""
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", True)


@functools.cache
def simulated(name, runs, steps):
    robot = {"drone": DRONE, "car": CAR}[name][0]
    log, model, belief = robot.schedule(steps), robot.model(robot.theta), robot.belief(robot.theta)
    keys = jax.random.split(jax.random.key(11), runs)
    x, logs = jax.jit(jax.vmap(lambda key: jf.simulate(model, belief, log, key, robot.control)))(keys)
    return jax.tree.map(np.asarray, (logs, jf.Truth(x, np.full((runs, steps), True))))


def wrong(theta, names, factor):
    """Wrong by the factor, above and below in turn."""
    free = parameters(theta)
    own = np.array([any(covers(part, name) for part in names) for name in free.names])
    return free.tree(jnp.asarray(free.start + np.where(np.cumsum(own) % 2 == 1, 1, -1) * own * math.log(factor)))


@pytest.mark.long
@pytest.mark.parametrize(
    ("robot", "filter", "objective", "factor", "runs", "steps"),
    [
        ("drone", jf.kf, jf.log_score, 100.0, 60, 400),
        ("drone", jf.kf, jf.likelihood, 100.0, 60, 400),
        ("car", jf.ekf, jf.log_score, 10.0, 40, 400),
        ("car", jf.ukf, jf.likelihood, 10.0, 40, 400),
    ],
    ids=["drone, log score", "drone, likelihood", "car EKF, log score", "car UKF, likelihood"],
)
def test_the_noise_is_found_again(robot, filter, objective, factor, runs, steps):
    """R to 10 %, what of Q the data tell to 10 % of one standard error to 25 %, all to 4.5 standard errors."""
    s, Q, R = {"drone": DRONE, "car": CAR}[robot]
    every = parameters(s.theta).names
    frozen = [name for name in every if not any(covers(part, name) for part in Q + R)]
    logs, truth = simulated(robot, runs, steps)
    fit = jf.tune(
        lambda theta: filter(s.model(theta)),
        s.belief,
        wrong(s.theta, Q + R, factor),
        logs,
        truth,
        objective,
        frozen=frozen,
        blocks=s.blocks,
        truth_theta=s.theta,
        noise_estimate=False,
    )
    found = {p.name: p for p in fit.parameters}
    for p in found.values():
        assert abs(p.start - p.true) == pytest.approx(math.log(factor))
        assert abs(p.value - p.true) < 4.5 * p.error, p
    for name, p in found.items():
        if any(covers(part, name) for part in R):
            assert abs(math.expm1(p.value - p.true)) < 0.10, p
        elif p.error < 0.10:
            assert abs(math.expm1(p.value - p.true)) < 0.25, p
    assert any(p.error < 0.10 for name, p in found.items() if any(covers(part, name) for part in Q))
    assert consistency.verdict(fit.scores["tuned"]["test"].nees) == "inside"
    assert consistency.verdict(fit.scores["before"]["test"].nees) != "inside"
    tuned, true = (fit.scores[stage]["test"].loss for stage in ("tuned", "truth"))
    assert tuned < true + 0.05
    assert fit.scores["before"]["test"].loss > true + 0.5


def constant_velocity(theta):
    dt = 0.1
    noise = jnp.kron(jnp.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), jnp.eye(2))
    A = jnp.eye(4) + dt * jnp.eye(4, k=2)
    return jf.linear(A, jnp.eye(2, 4), Q=jnp.exp(2 * theta["q"]) * noise, R=jf.shared(2).cov(theta["r"]))


def test_tuning_beats_noise_estimation_where_the_model_is_wrong():
    """The truth drives a circle at a constant rate: an acceleration that lasts, and not the white one of the filter."""
    runs, steps, dt = 20, 150, 0.1
    rng = np.random.default_rng(0)
    yaw = rng.uniform(-3, 3, (runs, 1)) + 0.5 * dt * np.arange(steps)
    vel = 8.0 * np.stack([np.cos(yaw), np.sin(yaw)], 2)
    pos = 16.0 * np.stack([np.sin(yaw), -np.cos(yaw)], 2)
    x = np.concatenate([pos - pos[:, :1], vel], 2)
    plan = jf.schedule(constant_velocity({"q": 0.0, "r": 0.0}), steps, dt)
    logs = jax.tree.map(lambda a: np.broadcast_to(a, (runs, *np.shape(a))), plan)
    logs = logs._replace(z={"z": x[:, :, :2] + rng.normal(size=(runs, steps, 2))})
    fit = jf.tune(
        lambda theta: jf.kf(constant_velocity(theta)),
        lambda theta: jf.Gaussian(jnp.zeros(4), jf.diagonal(2.0, 2.0, 5.0, 5.0)),
        {"q": jnp.asarray(0.0), "r": jnp.asarray(1.0)},
        logs,
        jf.Truth(x, np.full((runs, steps), True)),
        blocks={"position": ((0, 1), "m"), "velocity": ((2, 3), "m/s")},
    )
    assert fit.findings[0].startswith(("tuning beats noise estimation on the test data", "the mean"))
    assert any(text.startswith("tuning beats noise estimation") for text in fit.findings)
    estimated, tuned = fit.scores["noise estimation"]["test"], fit.scores["tuned"]["test"]
    assert tuned.log_score.value > estimated.log_score.value + 5 * estimated.log_score.error
    assert abs(math.log(tuned.nees.mean / 4)) < abs(math.log(estimated.nees.mean / 4))
    # The residuals of the truth, in NumPy: what drives the velocity, and the readings' noise.
    increments = np.diff(vel, axis=1)
    assert math.exp(2 * float(fit.estimated["q"])) == pytest.approx((increments**2).mean() / dt, rel=0.5)
    assert math.exp(float(fit.estimated["r"])) == pytest.approx(1.0, rel=0.05)
