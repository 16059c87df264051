"""Recordings of ground robots and cars: ranges that are too long, fixes withheld, pseudoranges by way of walls."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt import datasets, recordings
from jaxfilt.recordings import canyon, ranging, roads
from jaxfilt.spaces import quaternion_product, rotate_back

pytestmark = [pytest.mark.data, pytest.mark.usefixtures("data")]

MAKE = {
    "plaza_range": ranging.plaza_range,
    "uwb_labyrinth": ranging.uwb_labyrinth,
    "kitti_imu_gps": roads.kitti_imu_gps,
    "comma2k19": roads.comma2k19,
    "smartloc_berlin": canyon.smartloc_berlin,
}


@functools.cache
def replayed(name: str) -> jf.Replay:
    return MAKE[name](datasets.load(name))


def cut(replay: jf.Replay, seconds: float) -> jf.Replay:
    """The beginning of a replay."""
    rows = int(np.searchsorted(replay.recording.t, replay.recording.t[0] + seconds))
    log, truth = jax.tree.map(lambda a: a[:rows], (replay.recording.log, replay.truth))
    return replay._replace(recording=jf.Recording(log, replay.recording.t[:rows]), truth=truth)


def known(replay: jf.Replay) -> jf.Truth:
    assert replay.truth is not None
    return replay.truth


def silent(log: jf.Log, *sensors: str) -> jf.Log:
    return log._replace(valid={**log.valid, **{name: np.zeros(np.shape(log.dt), bool) for name in sensors}})


def means(replay: jf.Replay, thetas: list[Any], log: jf.Log | None = None, **options: Any) -> list[Any]:
    """The EKF's means with each of these parameters, in one program; no update may go wrong."""
    log = replay.recording.log if log is None else log

    def run(theta: Any) -> Any:
        filt = jf.ekf(replay.model(theta), **options)
        return jf.scan(filt, replay.belief(theta), log, store=lambda b, i: (b.mean, [s.status for s in i.values()]))

    each = jax.tree.map(lambda *a: jnp.stack([jnp.asarray(x, float) for x in a]), *thetas)
    mean, status = jax.tree.map(np.asarray, jax.jit(jax.vmap(run))(each))
    assert max(s.max() for s in status) <= jf.Status.GATED
    return [jax.tree.map(lambda a, k=k: a[k], mean) for k in range(len(thetas))]


def position(replay: jf.Replay, mean: Any) -> float:
    return recordings.rmse(replay, mean)["position"]


def beginning(theta: dict[str, Any], **at: float) -> dict[str, Any]:
    """Parameters with other standard deviations at the start: ``_3=0.1`` is the fourth."""
    stds = list(theta["start"])
    for k, std in at.items():
        stds[int(k[1:])] = math.log(std)
    return theta | {"start": tuple(stds)}


def test_the_mowers_ranges_are_too_long_by_a_share():
    replay = cut(replayed("plaza_range"), 900.0)
    theta = ranging.MOWER
    as_read = beginning(theta, _3=1e-6, _4=1e-6)
    biased = beginning(theta, _4=1e-6) | {"range": math.log(1.2)}
    both, none, bias = means(replay, [theta, as_read, biased])
    assert position(replay, both) < 0.35
    assert 1.0 < position(replay, bias) < 2.0  # by hand and with a bias alone: 1.00
    assert position(replay, none) > 2.5  # by hand without either: 3.33
    assert both.stretch[-1] == pytest.approx(1.07, abs=0.01)
    data = datasets.load("plaza_range")
    ranges, (t, pos) = data.streams["range"], data.truth["pos"]
    at = np.stack([np.interp(ranges.t, t, pos[:, i]) for i in (0, 1)], 1)
    distance = np.hypot(*(at - ranges.c).T)
    stretch, offset = np.polyfit(distance, ranges.z, 1)
    assert stretch == pytest.approx(1.07, abs=0.002)
    assert abs(offset) < 0.1
    assert (ranges.z - stretch * distance - offset).std() < 0.6


def test_the_mower_alone():
    replay = replayed("plaza_range")
    (mean,) = means(replay, [ranging.MOWER])
    (alone,) = means(replay, [ranging.MOWER], log=recordings.dead_reckoning(replay.recording.log))
    assert position(replay, mean) < 0.33
    assert position(replay, alone) > 1.5


def test_odometry_that_is_given_by_increments_is_all_used():
    replay, data = replayed("plaza_range"), datasets.load("plaza_range")
    log, moved = replay.recording.log, data.inputs["odometry"][1][1:]
    np.testing.assert_allclose((log.u.speed * log.dt).sum(), moved[:, 0].sum(), rtol=1e-6)
    np.testing.assert_allclose((log.u.rate * log.dt).sum(), moved[:, 1].sum(), atol=1e-4)


def test_the_robot_in_the_labyrinth_finds_its_ranges_bias():
    replay = replayed("uwb_labyrinth")
    theta = ranging.LABYRINTH
    known, none = means(replay, [theta, beginning(theta, _3=1e-6)])
    assert position(replay, known) < 0.09
    assert position(replay, none) > 1.6 * position(replay, known)
    assert known.bias[-1] == pytest.approx(0.1, abs=0.03)
    (alone,) = means(replay, [theta], log=recordings.dead_reckoning(replay.recording.log))
    assert position(replay, alone) > 2 * position(replay, known)


def test_the_labyrinths_first_wheel_is_the_left_one():
    data = datasets.load("uwb_labyrinth")
    (t, wheels), (t_truth, pos) = data.inputs["wheels"], data.truth["pos"]
    way = np.diff(pos, axis=0)
    moving = np.hypot(*way.T) > 0.2 * np.diff(t_truth)
    course = np.arctan2(way[:, 1], way[:, 0])
    turned = (np.diff(course) + np.pi) % (2 * np.pi) - np.pi
    steady = moving[1:] & moving[:-1]
    rate = (wheels[:-2, 1] - wheels[:-2, 0]) / (2 * data.constants["track_width"]) * np.diff(t)[:-1]
    assert np.corrcoef(rate[steady], turned[steady])[0, 1] > 0.8
    assert 0.8 < np.polyfit(rate[steady], turned[steady], 1)[0] < 1.1


def test_fixes_that_the_filter_does_not_get_are_where_it_expects_them():
    replay = cut(replayed("kitti_imu_gps"), 140.0)
    log = replay.recording.log
    fixes = datasets.load("kitti_imu_gps").streams["gnss"]
    t = replay.recording.t
    given, scored = t[log.valid["gnss"]], t[known(replay).mask]
    np.testing.assert_allclose(np.diff(given), 5.0, atol=0.05)
    assert not np.isin(scored, given).any()
    assert np.isin(scored, fixes.t).all()
    np.testing.assert_array_equal(known(replay).x[known(replay).mask], fixes.z[np.isin(fixes.t, scored)])
    theta = roads.PASSAT
    slippery = theta | {"road": (math.log(1e3),) * 2}
    mean, slides = means(replay, [theta, slippery])
    late = known(replay)._replace(mask=known(replay).mask & (t > t[0] + 60))
    settled = replay._replace(truth=late)
    assert position(settled, mean) < 1.0
    assert position(settled, mean) < position(settled, slides)


def test_a_gap_of_the_inertial_unit_is_not_driven_through():
    log = replayed("kitti_imu_gps").recording.log
    assert log.dt.max() < 0.03


def test_a_minute_on_a_highway():
    replay = cut(replayed("comma2k19"), 40.0)
    (mean,) = means(replay, [roads.HIGHWAY])
    score = recordings.rmse(replay, mean)
    assert score["position"] < 0.7  # the receiver's own: 1.47
    assert score["velocity"] < 0.2
    assert score["tilt"] < math.radians(2)
    assert score["heading"] < math.radians(2)
    assert mean.extra["mount"][-1, 0] == pytest.approx(-0.066, abs=0.01)  # 1.11 m/s upwards at 16.8 m/s forwards
    (reckoned,) = means(replay, [roads.HIGHWAY], log=silent(replay.recording.log, "gnss"))
    assert 2 * score["position"] < position(replay, reckoned) < 5.0


def test_the_phones_readings_are_turned_to_forward_left_up():
    replay, data = replayed("comma2k19"), datasets.load("comma2k19")
    assert replay.recording.log.u.accelerometer[:, 2].mean() == pytest.approx(9.66, abs=0.02)
    velocity, att = (jnp.asarray(known(replay).x[k][3000]) for k in (1, 2))
    forward, left, up = np.asarray(rotate_back(att, velocity))
    assert forward > 5
    assert abs(left) < 0.05 * forward
    assert 0 < up < 0.1 * forward
    # The truth's own turn about the body axes goes with the gyroscope's.
    t, q = data.truth["attitude"]
    turned = jax.vmap(quaternion_product, (0, None))(jnp.asarray(q), jnp.asarray(roads.FORWARD_RIGHT_DOWN))
    rates = np.asarray(jax.vmap(jf.so3.minus)(turned[1:], turned[:-1])) / np.diff(t)[:, None]
    stamps, gyro = replay.recording.t, replay.recording.log.u.gyro
    read = np.stack([np.interp(0.5 * (t[1:] + t[:-1]), stamps, gyro[:, k]) for k in range(3)], 1)
    assert min(np.corrcoef(rates[:, k], read[:, k])[0, 1] for k in range(3)) > 0.7


@pytest.fixture(scope="module")
def drive() -> jf.Replay:
    return cut(replayed("smartloc_berlin"), 120.0)


def test_robust_beats_plain_in_the_canyon(drive):
    stated = canyon.CANYON | {"floor": math.log(10.0), "share": math.log(0.01)}  # as the authors have it
    thetas = [canyon.CANYON, canyon.SCATTER, stated]
    inflated, scatter, equal = (position(drive, x) for x in means(drive, thetas))
    robust = [position(drive, x) for x in means(drive, thetas, robust=0.5)]
    assert robust[0] < inflated * 1.001  # nothing stands out of such noises
    assert robust[1] < 0.9 * scatter
    assert robust[2] < 0.95 * equal
    assert inflated < 0.6 * min(scatter, equal)
    assert inflated < 8.0


def test_float32_knows_a_pseudorange_to_the_centimetre(drive):
    log, sensor = drive.recording.log, drive.model(drive.theta).sensors["pseudorange"]
    k = 7000
    c = jax.tree.map(lambda a: np.asarray(a[k]), log.c["pseudorange"])
    x = drive.belief(drive.theta).mean._replace(pos=jnp.array([310.0, -470.0, 3.0]), clock=jnp.zeros(2))
    exact = np.linalg.norm(c.place.astype(np.longdouble) - np.array([310.0, -470.0, 3.0])) - np.linalg.norm(
        c.place.astype(np.longdouble)
    )
    assert float(sensor.h(x, c)) == pytest.approx(float(exact), abs=1e-6)
    x, c = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), (x, c))
    assert float(sensor.h(x, c)) == pytest.approx(float(exact), abs=0.01)


def test_walls_make_ranges_too_long():
    replay, data = replayed("smartloc_berlin"), datasets.load("smartloc_berlin")
    seen, (t, pos) = data.streams["pseudorange"], data.truth["pos"]
    at = np.stack([np.interp(seen.t, t, pos[:, i]) for i in range(3)], 1)
    error = seen.z - np.linalg.norm(seen.c["satellite"] - at, axis=1)
    # Epoch by epoch the clock is that of the satellites heard best.
    strong = seen.c["cn0"] > 45
    for stamp in np.unique(seen.t):
        epoch = seen.t == stamp
        error[epoch] -= np.median(error[epoch & strong]) if (epoch & strong).any() else np.median(error[epoch])
    assert (error > 30).sum() > 4 * (error < -30).sum()
    assert (replay.recording.log.dt == 0).mean() > 0.9


def test_the_gradient_of_the_canyons_likelihood_is_finite():
    replay = cut(replayed("smartloc_berlin"), 10.0)

    def loss(theta: Any) -> jax.Array:
        filt = jf.ekf(replay.model(theta), robust=0.5)
        info = jf.scan(filt, replay.belief(theta), replay.recording.log, store=lambda b, i: i["pseudorange"].loglik)
        return -info.sum()

    theta = jax.tree.map(lambda a: jnp.asarray(a, float), canyon.CANYON)
    slope = jax.jit(jax.grad(loss))(theta)
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(slope))
    moved = theta | {"floor": theta["floor"] + 1e-5}, theta | {"floor": theta["floor"] - 1e-5}
    high, low = (float(jax.jit(loss)(one)) for one in moved)
    assert float(slope["floor"]) == pytest.approx((high - low) / 2e-5, rel=1e-4)


@pytest.mark.parametrize("name", MAKE)
def test_no_reading_knows_the_truth(name):
    data = datasets.load(name)
    off = data._replace(truth={k: (t, x if k == "attitude" else x + 1.0) for k, (t, x) in data.truth.items()})
    original, other = replayed(name), MAKE[name](off)
    for a, b in zip(jax.tree.leaves(original.recording), jax.tree.leaves(other.recording), strict=True):
        np.testing.assert_array_equal(a, b)
    beliefs = original.belief(original.theta), other.belief(other.theta)
    same = all((a == b).all() for a, b in zip(*map(jax.tree.leaves, beliefs), strict=True))
    assert same == (name in ("kitti_imu_gps", "comma2k19"))  # the others say that they start at the true pose


@pytest.mark.parametrize("name", MAKE)
def test_a_log_in_float32_fits_its_model(name):
    replay = replayed(name)

    def cast(tree: Any) -> Any:
        return jax.tree.map(lambda a: np.asarray(a, np.float32) if np.asarray(a).dtype.kind == "f" else a, tree)

    log, theta = cast(replay.recording.log), cast(replay.theta)
    row = jax.tree.map(lambda a: a[5], log)
    step = jax.eval_shape(jf.ekf(replay.model(theta)).step, replay.belief(theta), row)
    assert all(a.dtype != np.float64 for a in jax.tree.leaves(step))
