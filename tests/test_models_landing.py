"""The drone that lands on a moving car: its sensors by NumPy, and what the filters know while it is out of sight."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from model_checks import assert_derivatives
from scipy.spatial.transform import Rotation

import jaxfilt as jf
from jaxfilt.models import landing
from jaxfilt.models.car import CarLike
from jaxfilt.models.landing import ABOVE_A_ROBOT, DT, LENGTH, ROOF, Chase, chase, landing_scenario

STEPS, RUNS = 256, 300
SCENARIO = landing_scenario()
FILTERS = {"ekf": lambda theta: jf.ekf(chase(theta)), "ukf": lambda theta: jf.ukf(chase(theta))}


def seen_by_hand(x, R):
    """Marks (front, back) and the middle in the picture: right is the body's right, down is its back."""
    heading = np.array([np.cos(x.car.yaw), np.sin(x.car.yaw), 0.0])
    middle = np.append(x.car.pos, ROOF)
    own = [R.inv().apply(np.array(middle + k * LENGTH / 2 * heading - x.drone)) for k in (1, -1, 0)]
    return [np.array([-p[1], -p[0]]) / -p[2] for p in own]


def chases():
    car = CarLike(*map(jnp.asarray, ([3.0, -1.0], [2.0, 0.1], 2.5, 0.1)))
    for angles in ([0, 0, 0], [0.2, -0.1, 1.0]):
        R = Rotation.from_euler("xyz", angles)
        yield Chase(car, jnp.array([2.0, 0.5, 6.0])), R, jnp.asarray(R.as_quat(scalar_first=True))


@pytest.mark.parametrize(("x", "R", "att"), list(chases()))
def test_what_the_camera_sees(x, R, att):
    front, back, middle = seen_by_hand(x, R)
    sensors = chase().sensors
    np.testing.assert_allclose(sensors["camera"].h(x, att), middle, atol=1e-12)
    direction = np.arctan2(*(front - back)[::-1])
    np.testing.assert_allclose(sensors["marks"].h(x, att), direction, atol=1e-12)
    assert_derivatives(lambda p: [sensors[name].h(p, att) for name in sensors], x)


def test_a_reading_is_worth_less_from_afar():
    """As a position: pixels and tilt times the distance; the marks' direction by their distance in the picture."""
    level, sensors = jnp.array([1.0, 0.0, 0.0, 0.0]), chase().sensors
    car = CarLike(*map(jnp.asarray, ([0.0, 0.0], [2.0, 0.0], 0.3, 0.0)))
    near, far = (Chase(car, jnp.array([0.0, 0.0, ROOF + h])) for h in (2.0, 8.0))
    pixel, tilt = np.exp(ABOVE_A_ROBOT["pixel"]), np.exp(ABOVE_A_ROBOT["tilt"])
    for x, height in ((near, 2.0), (far, 8.0)):
        np.testing.assert_allclose(sensors["camera"].R(x, level), np.eye(2) * (pixel**2 + tilt**2))
        expected = 2 * (pixel * height / LENGTH) ** 2 + tilt**2
        np.testing.assert_allclose(sensors["marks"].R(x, level), [[expected]])
    aside = far._replace(drone=jnp.array([8.0, 0.0, ROOF + 8.0]))
    assert sensors["camera"].R(aside, level)[0, 0] > 2 * sensors["camera"].R(far, level)[0, 0]


def test_the_schedule_sees_the_car_now_and_then():
    log = SCENARIO.schedule(STEPS)
    camera, marks = log.valid["camera"], log.valid["marks"]
    assert camera[:64].sum() == 16
    assert camera[:16].all()
    np.testing.assert_array_equal(camera[:192], np.tile(camera[:64], 3))
    assert not marks[:31].any()
    np.testing.assert_array_equal(marks[64:], camera[64:])
    np.testing.assert_allclose([landing.descent(400)[0], landing.descent(400)[-1]], [9.975, 2.0])


def test_the_drone_follows():
    x = Chase(CarLike(*map(jnp.asarray, ([3.0, -1.0], [2.0, 0.0], 0.0, 0.0))), jnp.array([1.0, 0.0, 6.0]))
    np.testing.assert_allclose(landing.behind(x, jnp.array([0.0, 0.0, 5.0])), [1.0 + DT * 4.0, -2 * DT, 5.0])


@functools.cache
def studied():
    return jf.study(
        chase, FILTERS, landing.chase_start, SCENARIO.schedule(STEPS), jax.random.key(1), runs=RUNS,
        theta=SCENARIO.theta, blocks=SCENARIO.blocks, control=SCENARIO.control, backend="lanes",
    )  # fmt: skip


@pytest.mark.parametrize("block", SCENARIO.blocks)
@pytest.mark.parametrize("name", FILTERS)
def test_the_filters_are_consistent_block_by_block(name, block):
    """At instants 3.2 s apart, in sight and out of it: the mean over runs in its band (Bonferroni: 8 instants)."""
    dof = len(SCENARIO.blocks[block][0])
    at = np.concatenate([np.arange(15, STEPS, 64), np.arange(63, STEPS, 64)])
    low, high = scipy.stats.chi2.interval(1 - 1e-3 / len(at), dof * RUNS)
    nees = np.asarray(studied().scores[name].nees[block].mean)[at] * RUNS
    assert ((nees > low) & (nees < high)).all(), nees / RUNS


def test_out_of_sight_the_error_grows_and_a_look_shrinks_it():
    for name in FILTERS:
        rmse = np.asarray(studied().scores[name].rmse["position"].value)
        in_sight, blind = rmse[15::64], rmse[63::64]
        assert (blind > 5 * in_sight).all()
        assert (in_sight[1:] < 0.3 * blind[:-1]).all()
        assert (np.diff(rmse[15:64]) > 0).all()


def test_where_it_touches_down_is_predicted():
    """A second ahead, without a look: the mean of straight driving, and no less uncertain than now."""
    filt = jf.ukf(chase())
    belief = jax.jit(lambda b: landing.touchdown(filt, b, 1.0))(landing.chase_start())
    now = landing.chase_start()
    np.testing.assert_allclose(belief.mean.car.pos, [2.0, 0.0], atol=0.05)
    assert (np.linalg.eigvalsh(belief.cov[:2, :2] - now.cov[:2, :2]) > 0).all()
