"""Through a loop: on SO(3) nothing happens at 90 degrees of pitch; Euler angles say where they ended."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxfilt as jf
from jaxfilt.models import loop
from jaxfilt.models.control import GRAVITY
from jaxfilt.models.multirotor import BLOCKS, euler_multirotor, to_euler

RUNS, STEPS = 40, 200


@functools.cache
def flown():
    """Truth and logs of many flights; by the way, one loop takes 180 rows."""
    scenario = loop.loop_scenario()
    log = scenario.schedule(STEPS)

    @jax.jit
    def fly(keys):
        model, belief = scenario.model(scenario.theta), scenario.belief(scenario.theta)
        return jax.vmap(lambda key: jf.simulate(model, belief, log, key, scenario.control))(keys)

    return log, *jax.device_get(fly(jax.random.split(jax.random.key(0), RUNS)))


def filtered(model, belief):
    log, _, logs = flown()
    shared = log._replace(z={name: logs.z[name] for name in log.z}, u=logs.u)
    run = jax.jit(lambda log: jf.scan_runs(jf.ekf(model), belief, log, batched=("z", "u"), backend="xla"))
    return jax.device_get(run(shared))


def rotations(att):
    return Rotation.from_quat(np.asarray(att).reshape(-1, 4), scalar_first=True)


def test_the_reference_is_a_loop_that_the_rotors_can_push():
    dt = 1e-4
    path = loop.looping(18001, dt)
    for position, velocity in ((path.pos, path.vel), (path.vel, path.acc)):
        slope = (position[2:] - position[:-2]) / (2 * dt)
        np.testing.assert_allclose(slope, velocity[1:-1], atol=1e-4)
    push = path.acc + [0, 0, GRAVITY]
    tilt = np.unwrap(np.arctan2(-push[:, 0], push[:, 2]))
    np.testing.assert_allclose(np.diff(tilt) / dt, -0.5 * (path.rates[1:, 1] + path.rates[:-1, 1]), atol=1e-5)
    assert tilt[-1] == pytest.approx(2 * np.pi, abs=1e-3)
    frame = loop.hummingbird()
    size = frame.mass * np.linalg.norm(push, axis=1)
    assert 0.5 * frame.mass * GRAVITY < size.min() < size.max() < 4 * frame.max_thrust
    np.testing.assert_allclose(path.pos[-1], path.pos[0], atol=1e-3)


def test_every_flight_loops():
    _, truth, _ = flown()
    up = rotations(truth.att).as_matrix()[:, 2].reshape(RUNS, STEPS, 3)
    assert (up[..., 2].min(1) < -0.99).all(), "upside down at the top"
    nose = -np.degrees(np.arcsin(up[..., 0]))
    assert (np.abs(nose).max(1) > 85).all(), "the nose straight up on the way"
    assert np.abs(truth.pos - flown()[0].u.pos).max() < 0.5


def test_on_so3_the_filter_flies_through_and_is_consistent():
    scenario = loop.loop_scenario()
    track = filtered(scenario.model(scenario.theta), scenario.belief(scenario.theta))
    assert jf.diagnose(track) is None
    _, truth, _ = flown()
    turn = (rotations(track.belief.mean.att).inv() * rotations(truth.att)).as_rotvec().reshape(RUNS, STEPS, 3)
    mean = track.belief.mean
    parts = [truth.pos - mean.pos, truth.vel - mean.vel, turn, truth.rates - mean.rates]
    error = np.concatenate(parts, -1)
    nees = np.einsum("rti,rti->rt", error, np.linalg.solve(track.belief.cov, error[..., None])[..., 0])
    average = nees.mean(1)
    assert average.mean() == pytest.approx(12, abs=4 * average.std(ddof=1) / np.sqrt(RUNS))
    assert 0.9 < average.mean() / 12 < 1.1
    assert np.degrees(np.sqrt((turn**2).sum(-1).mean())) < 3
    halved = nees.mean() * 2
    assert abs(halved - 12) > 4 * 2 * average.std(ddof=1) / np.sqrt(RUNS), "half the covariance would be found out"


def test_euler_angles_say_which_run_ended_where_and_why():
    track = filtered(euler_multirotor(loop.LOOP), loop.euler_loop_start())
    found = jf.diagnose(track)
    assert found is not None
    assert found.runs == RUNS, "none flies on with angles that mean nothing"
    assert found.sensor is None
    assert found.status is jf.Status.BAD_BELIEF
    assert found.run is not None
    before = track.belief.mean.rpy[found.run, found.step - 1]
    assert 75 < np.degrees(abs(before[1])) < 90
    assert f"run {found.run}, step {found.step}, prediction: f(x, u, dt)" in found.message
    pitch = np.array2string(before, precision=3, separator=", ", suppress_small=True)
    assert f"rpy = {pitch}" in found.message
    # Until then each was as good as the other.
    _, truth, _ = flown()
    sound = np.isfinite(track.belief.mean.rpy).all(2)
    ended = np.argmin(sound, 1)
    assert (ended > 20).all()
    assert (ended < 120).all()
    for run in range(RUNS):
        assert not sound[run, ended[run] :].any()
        own = Rotation.from_euler("ZYX", track.belief.mean.rpy[run, : ended[run], ::-1])
        off = (own.inv() * rotations(truth.att[run, : ended[run]])).magnitude()
        assert np.degrees(off).max() < 20


def test_a_study_says_so_too():
    scenario = loop.loop_scenario()
    study = jf.study(
        scenario.model,
        {"euler": lambda theta: jf.ekf(euler_multirotor(theta))},
        loop.euler_loop_start,
        scenario.schedule(120),
        jax.random.key(0),
        theta=jax.tree.map(jnp.asarray, scenario.theta),
        truth_belief=loop.loop_start,
        view=to_euler,
        control=scenario.control,
        runs=8,
        blocks=BLOCKS,
        backend="xla",
    )
    assert not study.verdicts["euler"].consistent
    assert study.verdicts["euler"].headline.startswith("euler faulty in 8 of 8 runs: first at step ")
    assert "BAD_BELIEF" in study.verdicts["euler"].headline
