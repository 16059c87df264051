"""Readers of recorded data, against the facts that come with the recordings: counts, rates, units, frames."""

from pathlib import Path

import numpy as np
import pytest

from jaxfilt import datasets

pytestmark = pytest.mark.data

ALL = [(name, sequence) for name in datasets.names() for sequence in datasets.sequences(name)]


@pytest.fixture
def load(data: Path):
    """`datasets.load`, with the recordings known to be there."""
    assert data.is_dir()
    return datasets.load


def at(t: np.ndarray, timed: tuple) -> np.ndarray:
    """A truth (K, n) or (K,) at times t."""
    stamps, x = timed
    return np.stack([np.interp(t, stamps, column) for column in np.reshape(x, (len(stamps), -1)).T], 1)


def robust_std(e: np.ndarray) -> float:
    return float(1.4826 * np.median(np.abs(e - np.median(e))))


def wrapped(a: np.ndarray) -> np.ndarray:
    return (a + np.pi) % (2 * np.pi) - np.pi


def rotated(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """R(q) v from the rotation matrix of a quaternion (w, x, y, z), row by row."""
    w, x, y, z = q.T
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.einsum("ijk,kj->ki", R, v)


def test_there_are_fifteen_sets():
    assert len(datasets.names()) == 15
    assert len(ALL) == 45


@pytest.mark.parametrize(("name", "sequence"), ALL)
def test_what_every_set_promises(load, name, sequence):
    data = load(name, sequence)
    assert (data.name, data.sequence) == (name, sequence)
    assert data.licence
    assert "20" in data.citation
    assert len(data.about) > 200
    for t, _ in [*data.inputs.values(), *data.truth.values()]:
        assert t.dtype == np.float64
        assert (np.diff(t) > 0).all()
    for stream in data.streams.values():
        leaves = stream.z if isinstance(stream.z, tuple) else (stream.z,)
        leaves += tuple(stream.c.values()) if isinstance(stream.c, dict) else (np.asarray(stream.c),)
        assert (np.diff(stream.t) >= 0).all()
        assert all(np.isfinite(leaf).all() for leaf in leaves)
        assert all(len(leaf) in (0, len(stream.t)) for leaf in leaves)
    for _, values in [*data.inputs.values(), *data.truth.values()]:
        assert np.isfinite(values).all()


def test_udacity_has_the_noise_that_was_handed_out(load):
    data = load("udacity_ctrv")
    lidar, radar = data.streams["lidar"], data.streams["radar"]
    assert len(lidar.t) == len(radar.t) == 250
    np.testing.assert_allclose(np.diff(np.sort(np.r_[lidar.t, radar.t])), 0.05, atol=1e-6)
    p, v = at(radar.t, data.truth["pos"]), at(radar.t, data.truth["vel"])
    np.testing.assert_allclose((lidar.z - at(lidar.t, data.truth["pos"])).std(0), [0.151, 0.146], atol=0.001)
    r = np.hypot(*p.T)
    assert (radar.z[0] - r).std() == pytest.approx(0.305, abs=0.001)
    assert wrapped(radar.z[1] - np.arctan2(p[:, 1], p[:, 0])).std() == pytest.approx(0.0284, abs=0.0001)
    assert (radar.z[2] - (p * v).sum(1) / r).std() == pytest.approx(0.288, abs=0.002)


MRCLAM = {  # robot: readings, of robots, median and robust sd of the range error (m), robust sd of the bearing (rad)
    "1": (3228, 650, 0.044, 0.067, 0.018),
    "2": (4518, 700, 0.025, 0.181, 0.009),
    "3": (5399, 965, -0.005, 0.115, 0.007),
    "4": (2377, 555, 0.002, 0.175, 0.011),
    "5": (4760, 1336, -0.012, 0.134, 0.006),
}


@pytest.mark.parametrize("robot", MRCLAM)
def test_mrclam_sightings_fit_the_map(load, robot):
    data = load("utias_mrclam", robot)
    total, of_robots, median, std, bearing_std = MRCLAM[robot]
    seen, unknown = data.streams["landmark"], 9 if robot == "3" else 0
    assert len(data.streams["robot"].t) == of_robots
    assert len(seen.t) == total - of_robots - unknown
    assert len(data.constants["landmarks"]) == 15
    d = seen.c - at(seen.t, data.truth["pos"])
    yaw = at(seen.t, (data.truth["yaw"][0], np.unwrap(data.truth["yaw"][1])))[:, 0]
    error = seen.z[0] - np.hypot(*d.T)
    assert np.median(error) == pytest.approx(median, abs=0.001)
    assert robust_std(error) == pytest.approx(std, abs=0.001)
    assert robust_std(wrapped(seen.z[1] - np.arctan2(d[:, 1], d[:, 0]) + yaw)) == pytest.approx(bearing_std, abs=0.001)
    t, odometry = data.inputs["odometry"]
    assert 60 < len(t) / np.ptp(t) < 70
    assert 0.05 < odometry[:, 0].max() < 0.2


NCLT = {  # run: length (s), share of GPS fixes, their RMSE (m), share of RTK fixes, their RMSE (m)
    "2013-01-10": (1025, 0.93, 6.6, 0.84, 3.5),
    "2013-02-23": (4810, 0.86, 14.1, 0.78, 6.7),
    "2013-04-05": (4182, 0.84, 8.9, 0.71, 3.1),
}


@pytest.mark.parametrize("run", NCLT)
def test_nclt_fixes_are_as_bad_as_they_are_said_to_be(load, run):
    data = load("nclt_1hz", run)
    length, share, rmse, rtk_share, rtk_rmse = NCLT[run]
    _, truth = data.truth["pos"]
    assert len(truth) == length
    for name, there, size in [("gps", share, rmse), ("rtk", rtk_share, rtk_rmse)]:
        stream = data.streams[name]
        assert stream.valid.shape == (length,)
        assert stream.valid.mean() == pytest.approx(there, abs=0.006)
        assert (stream.z[~stream.valid] == 0).all()
        error = np.hypot(*(stream.z - truth)[stream.valid].T)
        assert np.sqrt((error**2).mean()) == pytest.approx(size, abs=0.06)
    assert np.hypot(*(data.constants["start"] - truth[0])) < 0.5
    course = np.arctan2(*np.diff(truth, axis=0).T[::-1])
    moving = np.hypot(*np.diff(truth, axis=0).T) > 0.8
    assert np.degrees(robust_std(wrapped(course - data.truth["yaw"][1][:-1])[moving])) < 3


@pytest.mark.parametrize(("run", "seconds", "end"), [("1", 32.4, 0.54), ("2", 116.6, 0.35), ("4", 11.8, 0.15)])
def test_wifibot_dead_reckoning_ends_where_it_should(load, run, seconds, end):
    data = load("wifibot", run)
    t, odometry = data.inputs["odometry"]
    assert np.ptp(t) == pytest.approx(seconds, abs=0.1)
    _, pos = data.truth["pos"]
    yaw, x = data.truth["yaw"][1][0], pos[0].copy()
    for k, dt in enumerate(np.diff(t)):
        c, s = np.cos(yaw), np.sin(yaw)
        x += dt * np.array([c * odometry[k, 0] - s * odometry[k, 1], s * odometry[k, 0] + c * odometry[k, 1]])
        yaw += dt * odometry[k, 2]
    assert np.hypot(*(x - pos[-1])) == pytest.approx(end, abs=0.01)


def test_plaza_ranges_are_too_long_by_three_metres(load):
    data = load("plaza_range")
    ranges = data.streams["range"]
    assert len(ranges.t) == 3529
    assert len(data.constants["beacons"]) == 4
    error = ranges.z - np.hypot(*(ranges.c - at(ranges.t, data.truth["pos"])).T)
    assert 2.75 < np.median(error) < 3.04
    t, odometry = data.inputs["odometry"]
    assert np.ptp(t) == pytest.approx(1933, abs=2)
    assert np.abs(odometry[:, 0]).sum() == pytest.approx(1860, abs=10)


def test_labyrinth_ranges_and_wheels(load):
    data = load("uwb_labyrinth")
    ranges = data.streams["range"]
    assert len(ranges.t) == 233
    error = ranges.z - np.hypot(*(ranges.c - at(ranges.t, data.truth["pos"])).T)
    assert np.median(error) == pytest.approx(0.10, abs=0.01)
    assert robust_std(error) == pytest.approx(0.09, abs=0.01)
    t, wheels = data.inputs["wheels"]
    way = np.hypot(*np.diff(data.truth["pos"][1], axis=0).T).sum()
    assert (wheels.mean(1)[1:] * np.diff(t)).sum() == pytest.approx(way, rel=0.1)
    assert 0.02 < data.constants["track_width"] < 0.5


@pytest.mark.parametrize(
    ("sequence", "seconds", "top"),
    [("free_driving_1", 67.8, 1.5), ("free_driving_2", 98.3, 2.6), ("throttle_ramp_steer025", 105.1, 3.0)],
)
def test_dart_sensors_agree_with_the_motion_capture(load, sequence, seconds, top):
    data = load("dart_car", sequence)
    t, pos = data.truth["pos"]
    assert np.ptp(t) == pytest.approx(seconds, abs=0.1)
    smooth = np.ones(9) / 9
    speed = np.convolve(np.hypot(*np.gradient(pos, t, axis=0).T), smooth, "same")
    turn = np.convolve(np.gradient(np.unwrap(data.truth["yaw"][1]), t), smooth, "same")
    assert speed.max() == pytest.approx(top, abs=0.15)
    encoder, gyro = data.streams["speed"], data.streams["turn_rate"]
    assert len(encoder.t) / np.ptp(encoder.t) == pytest.approx(10, abs=0.1)
    assert np.corrcoef(encoder.z, np.interp(encoder.t - 0.1, t, speed))[0, 1] > 0.98
    assert np.corrcoef(gyro.z, np.interp(gyro.t - 0.05, t, turn))[0, 1] > 0.98
    assert np.abs(data.inputs["steering"][1]).max() <= 1


def test_comma_is_in_a_local_frame(load):
    data = load("comma2k19")
    t, pos = data.truth["pos"]
    _, vel = data.truth["vel"]
    assert (pos[0] == 0).all()
    np.testing.assert_allclose(np.gradient(pos, t, axis=0)[5:-5], vel[5:-5], atol=0.5)
    assert np.linalg.norm(vel, axis=1).mean() == pytest.approx(16.9, abs=0.1)
    ahead = rotated(data.truth["attitude"][1], np.tile([1.0, 0.0, 0.0], (len(t), 1)))
    down = rotated(data.truth["attitude"][1], np.tile([0.0, 0.0, 1.0], (len(t), 1)))
    assert ((ahead * vel).sum(1) / np.linalg.norm(vel, axis=1)).min() > 0.99
    assert down[:, 2].max() < -0.97
    gnss = data.streams["gnss"]
    inside = (gnss.t > t[0]) & (gnss.t < t[-1])
    error = (gnss.z - at(gnss.t, data.truth["pos"]))[inside]
    assert np.sqrt((error[:, :2] ** 2).sum(1).mean()) == pytest.approx(1.47, abs=0.05)
    assert error[:, 2].mean() == pytest.approx(1.1, abs=0.1)
    assert np.linalg.norm(data.inputs["accelerometer"][1], axis=1).mean() == pytest.approx(9.73, abs=0.01)
    assert (data.streams["speed"].z - np.linalg.norm(at(data.streams["speed"].t, data.truth["vel"]), axis=1))[
        100:-100
    ].mean() == pytest.approx(-0.14, abs=0.02)


def test_kitti_units(load):
    data = load("kitti_imu_gps")
    t, accelerometer = data.inputs["accelerometer"]
    assert len(t) == 46968
    assert np.median(np.diff(t)) == pytest.approx(0.010, abs=1e-4)
    assert np.linalg.norm(accelerometer, axis=1).mean() == pytest.approx(9.92, abs=0.01)
    gnss = data.streams["gnss"]
    assert len(gnss.t) == 470
    assert np.linalg.norm(np.diff(gnss.z, axis=0), axis=1).sum() == pytest.approx(3710, abs=10)
    assert data.truth == {}
    assert data.constants["accelerometer_std"] == 0.01
    assert data.constants["gyro_bias_std"] == 2.91e-6


def test_smartloc_pseudoranges_are_free_of_the_earths_rotation(load):
    data = load("smartloc_berlin")
    seen = data.streams["pseudorange"]
    assert len(seen.t) == 20038
    t, pos = data.truth["pos"]
    assert len(t) == 1372
    assert np.linalg.norm(np.diff(pos, axis=0), axis=1).sum() == pytest.approx(1549, abs=5)
    assert np.ptp(pos[:, 2]) < 20
    residual = seen.z - np.linalg.norm(seen.c["satellite"] - at(seen.t, data.truth["pos"]), axis=1)
    for epoch in np.unique(seen.t):
        for system in (1, 4):
            clock = (seen.t == epoch) & (seen.c["system"] == system)
            if clock.any():
                residual[clock] -= np.median(residual[clock])
    assert robust_std(residual) == pytest.approx(15, abs=1)
    assert (np.abs(residual) > 15).mean() == pytest.approx(0.41, abs=0.02)
    up = (seen.c["satellite"] / np.linalg.norm(seen.c["satellite"], axis=1, keepdims=True))[:, 2]
    np.testing.assert_allclose(up, np.sin(seen.c["elevation"]), atol=0.01)
    speed = np.linalg.norm(np.diff(pos, axis=0), axis=1) / np.diff(t)
    assert (data.inputs["odometry"][1][1:, 0] - speed).std() == pytest.approx(0.27, abs=0.015)


def test_crazyflie_units_and_biases(load):
    data = load("crazyflie_uwb", "circle_xy")
    _, accelerometer = data.inputs["accelerometer"]
    assert np.linalg.norm(accelerometer[:50], axis=1).mean() == pytest.approx(9.80665, rel=0.01)
    assert np.abs(data.inputs["gyro"][1]).max() < 10
    for k, (low, high) in {1: (-0.33, -0.30), 5: (-0.36, -0.34), 8: (-0.32, -0.27)}.items():
        ranges = data.streams[f"range_{k}"]
        error = ranges.z - np.linalg.norm(ranges.c - at(ranges.t, data.truth["pos"]), axis=1)
        assert low - 0.01 < np.median(error) < high + 0.01
    height = data.streams["height"]
    error = height.z - at(height.t, data.truth["pos"])[:, 2]
    assert np.median(error) == pytest.approx(-0.01, abs=0.01)
    assert data.constants["anchors"].shape == (8, 3)


@pytest.mark.parametrize("flight", datasets.sequences("ansfl_phantom4"))
def test_phantom_clocks_and_frames(load, flight):
    data = load("ansfl_phantom4", flight)
    for k in (1, 4):
        euler = data.streams[f"euler_{k}"]
        t, roll = data.truth["roll"]
        inner = (t > max(t[0], euler.t[0]) + 1) & (t < min(t[-1], euler.t[-1]) - 1)
        seen = at(t[inner], (euler.t, euler.z))
        assert np.corrcoef(seen[:, 0], roll[inner])[0, 1] > 0.98
        assert np.corrcoef(seen[:, 1], data.truth["pitch"][1][inner])[0, 1] < -0.9
        t, accelerometer = data.inputs[f"accelerometer_{k}"]
        assert np.median(np.diff(t)) == pytest.approx(1 / 120, abs=1e-4)
        assert 9.2 < np.linalg.norm(accelerometer, axis=1).mean() < 11.6
    t, pos = data.truth["pos"]
    assert np.ptp(t) < 60
    course = np.diff(pos[:, :2], axis=0) / np.diff(t)[:, None]
    np.testing.assert_allclose(np.hypot(*course.T).mean(), data.truth["speed"][1].mean(), atol=0.3)


@pytest.mark.parametrize(
    ("flight", "rows", "seconds"),
    [("MH_01_easy", 36820, 184.1), ("V1_02_medium", 17100, 85.5), ("V2_03_difficult", 23370, 116.8)],
)
def test_euroc_clocks_units_and_frames(load, flight, rows, seconds):
    data = load("euroc_mav", flight)
    t, gyro = data.inputs["gyro"]
    _, accelerometer = data.inputs["accelerometer"]
    assert len(t) == rows
    assert np.ptp(t) == pytest.approx(seconds, abs=0.1)
    still = np.argsort(np.linalg.norm(gyro, axis=1))[:400]
    assert np.linalg.norm(accelerometer[still], axis=1).mean() == pytest.approx(9.81, abs=0.15)
    attitude = data.truth["attitude"]
    np.testing.assert_allclose(np.linalg.norm(attitude[1], axis=1), 1, atol=1e-3)
    force = rotated(attitude[1], at(attitude[0], (t, accelerometer)))
    np.testing.assert_allclose(force.mean(0), [0, 0, 9.81], atol=0.15)
    for name, lever_arm_error in {"leica": 0.02, "vicon": 0.05}.items():
        if name in data.streams:
            stream = data.streams[name]
            inside = (stream.t > attitude[0][0]) & (stream.t < attitude[0][-1])
            arm = np.tile(data.constants["lever_arm"], (inside.sum(), 1))
            there = at(stream.t[inside], data.truth["pos"]) + rotated(at(stream.t[inside], attitude), arm)
            z = stream.z if name == "leica" else stream.z[0]
            assert np.sqrt(((z[inside] - there) ** 2).sum(1).mean()) < lever_arm_error


@pytest.mark.parametrize(
    ("flight", "counts"), [("sequence3", (958, 963, 956, 964)), ("sequence6", (645, 637, 638, 634))]
)
def test_rcv_ranges(load, flight, counts):
    data = load("rcv_uwb_drone", flight)
    np.testing.assert_allclose(np.linalg.norm(data.truth["attitude"][1], axis=1), 1, atol=1e-5)
    assert np.abs(data.truth["attitude"][1][:, 0]).mean() > 0.5
    for k, count in enumerate(counts, start=1):
        ranges = data.streams[f"range_{k}"]
        assert len(ranges.t) == count
        error = ranges.z - np.linalg.norm(ranges.c - at(ranges.t, data.truth["pos"]), axis=1)
        assert 0.18 < np.median(error) < 0.27
    assert 0.5 < data.constants["anchors"][:, 2].min() < data.constants["anchors"][:, 2].max() < 1.2


@pytest.mark.parametrize(
    ("trial", "seconds", "norm", "gaps"),
    [("02_undisturbed_slow_rotation_B", 186.3, 9.820, 0.032), ("21_undisturbed_fast_combined", 187.6, 9.823, 0.042)],
)
def test_broad_at_rest(load, trial, seconds, norm, gaps):
    data = load("broad", trial)
    t, gyro = data.inputs["gyro"]
    assert np.ptp(t) == pytest.approx(seconds, abs=0.1)
    still = data.truth["moving"][1] == 0
    assert np.linalg.norm(data.streams["accelerometer"].z[still], axis=1).mean() == pytest.approx(norm, abs=0.002)
    np.testing.assert_allclose(np.degrees(np.median(gyro[still], 0)), [0.18, 0.12, -0.24], atol=0.03)
    assert np.linalg.norm(data.streams["magnetometer"].z, axis=1).mean() == pytest.approx(44.3, abs=1)
    when, q = data.truth["attitude"]
    assert 1 - len(when) / len(t) == pytest.approx(gaps, abs=0.001)
    up = rotated(q, at(when, (t, data.streams["accelerometer"].z)))[at(when, data.truth["moving"])[:, 0] == 0]
    np.testing.assert_allclose(up.mean(0), [0, 0, norm], atol=0.2)


def test_a_missing_file_is_named(monkeypatch, tmp_path, data):
    (tmp_path / "kitti_imu_gps").mkdir()
    (tmp_path / "kitti_imu_gps" / "gps.csv").symlink_to(data / "kitti_imu_gps" / "gps.csv")
    monkeypatch.setenv("JAXFILT_DATA", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"imu\.txt\.gz"):
        datasets.load("kitti_imu_gps")
