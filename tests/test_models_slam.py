"""The model of a robot and its landmarks: the robot's own, with places looked up in the state."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt.models import slam
from jaxfilt.models.slam import World, in_sight, landmark_of, placed, with_landmarks
from jaxfilt.models.wheeled import Odometry, Pose, unicycle
from jaxfilt.types import Law

PLACES = np.array([[3.0, 1.0], [-2.0, 4.0], [0.5, -6.0]])
WORLD = World(Pose(jnp.array([0.3, -0.2]), jnp.asarray(0.4)), jnp.asarray(PLACES))


def robot() -> jf.Model:
    model = unicycle()
    return model._replace(sensors={"landmark": model.sensors["mark"], "gnss": model.sensors["gnss"]})


def test_the_robot_moves_and_the_landmarks_do_not():
    model, alone = with_landmarks(robot(), 3), robot()
    u = Odometry(1.3, -0.4)
    after = model.f(WORLD, u, 0.5)
    jax.tree.map(np.testing.assert_array_equal, after.robot, alone.f(WORLD.robot, u, 0.5))
    np.testing.assert_array_equal(after.landmarks, PLACES)
    Q = np.asarray(model.Q(WORLD, u, 0.5))
    np.testing.assert_array_equal(Q[:3, :3], alone.Q(WORLD.robot, u, 0.5))
    assert not Q[3:].any()
    assert not Q[:, 3:].any()


@pytest.mark.parametrize("number", [0, 1, 2])
def test_a_sighting_is_of_the_landmark_with_that_number(number):
    d = PLACES[number] - np.array([0.3, -0.2])
    want = np.hypot(*d), (np.arctan2(d[1], d[0]) - 0.4 + np.pi) % (2 * np.pi) - np.pi
    sensor = with_landmarks(robot(), 3).sensors["landmark"]
    got = sensor.h(WORLD, jnp.asarray(number))
    np.testing.assert_allclose(got, want, atol=1e-14)
    np.testing.assert_allclose(placed(WORLD.robot, got), PLACES[number], rtol=1e-13)
    np.testing.assert_array_equal(sensor.R(WORLD, jnp.asarray(number)), robot().sensors["landmark"].R(WORLD.robot, ()))


def test_plus_and_minus_go_by_landmark():
    space = with_landmarks(robot(), 3).space
    assert space.dim == 9
    d = jnp.zeros(9).at[5].set(0.1)
    np.testing.assert_allclose(space.plus(WORLD, d).landmarks[1], [-1.9, 4.0])
    np.testing.assert_allclose(space.minus(space.plus(WORLD, d), WORLD), d, atol=1e-15)


@pytest.mark.parametrize("number", [-1, 3, 1000])
def test_a_landmark_that_is_none_reads_nan(number):
    assert np.isnan(landmark_of(jnp.asarray(PLACES), jnp.asarray(number))).all()


def test_bad_input_is_named():
    with pytest.raises(TypeError, match="c: expected the number of a landmark, one integer, got float"):
        landmark_of(jnp.asarray(PLACES), jnp.asarray(1.0))
    with pytest.raises(ValueError, match="count: expected at least 1 landmark, got 0"):
        with_landmarks(robot(), 0)
    with pytest.raises(KeyError, match=r"sensor: expected one of \['landmark', 'gnss'\], got 'camera'"):
        with_landmarks(robot(), 3, ["camera"])


def test_a_law_reads_the_landmarks_place():
    law = Law(lambda z, x, c: -((z - c[0]) ** 2).sum(), lambda x, c, key: c[0])
    sensor = robot().sensors["landmark"]._replace(law=law)
    model = with_landmarks(robot()._replace(sensors={"landmark": sensor}), 3)
    mapped = model.sensors["landmark"].law
    assert mapped is not None
    assert float(mapped.draw(WORLD, jnp.asarray(1), jax.random.key(0))) == -2.0
    assert float(mapped.log_density(jnp.asarray(1.0), WORLD, jnp.asarray(0))) == -4.0


def test_in_sight_takes_them_in_turn_and_the_nearest_otherwise():
    pos = np.zeros((6, 2))
    assert in_sight(pos, np.array([[1.0, 0], [2.0, 0], [9.0, 0]]), 5.0, each=2).tolist() == [0, 0, 1, 1, 0, 0]
    assert in_sight(pos[:2], np.array([[8.0, 0], [7.0, 0]]), 5.0).tolist() == [1, 1]


@pytest.mark.parametrize("build", [slam.slam_scenario, slam.harsh_slam_scenario])
def test_a_lap_shows_every_landmark_again_and_again(build):
    scenario = build()
    log = scenario.schedule(1260)
    seen = log.c["landmark"][log.valid["landmark"]]
    count = np.bincount(seen[:315], minlength=20)
    assert (count > 2).all()
    assert len(set(seen[:10])) < 8  # not all at once
    truth, _ = jf.simulate(scenario.model(scenario.theta), scenario.belief(scenario.theta), log, jax.random.key(0))
    d = np.asarray(truth.landmarks)[np.arange(1260), log.c["landmark"]] - np.asarray(truth.robot.pos)
    assert np.median(np.hypot(*d[:630].T)) < 7.0  # a lap; then the harsh drive strays from its plan
    np.testing.assert_array_equal(truth.landmarks[0], truth.landmarks[-1])
