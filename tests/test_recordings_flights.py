"""Real flights by inertial navigation: attitude from positions alone, and that truth is used where it is said only."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxfilt as jf
from jaxfilt import datasets, metrics, recordings
from jaxfilt.models.inertial import Imu
from jaxfilt.recordings import alignment, euroc, phantom

pytestmark = [pytest.mark.data, pytest.mark.usefixtures("data")]

GATE = 0.9999


@functools.cache
def hall() -> tuple[Any, Any]:
    """MH_01_easy to 75 s, 33 s of them in the air, and the compiled EKF: theta -> means, log likelihood by row."""
    replay: Any = euroc.euroc_mav(datasets.load("euroc_mav", "MH_01_easy"))
    rows = int(np.searchsorted(replay.recording.t, replay.recording.t[0] + 75.0))
    cut = jax.tree.map(lambda a: a[:rows], (replay.recording, replay.truth))
    replay = replay._replace(recording=cut[0], truth=cut[1])

    def run(theta: Any, belief: jf.Gaussian, log: jf.Log) -> Any:
        filt = jf.ekf(replay.model(theta), gate=GATE)
        return jf.scan(filt, belief, log, store=lambda b, info: (b.mean, info["position"].loglik))

    return replay, jax.jit(run)


def hall_with(**changes: Any) -> tuple[dict[str, float], float]:
    """RMSE from 20 s on, angles in degrees, and the log likelihood, with these parameters changed."""
    replay, run = hall()
    theta = jax.tree.map(lambda a: jnp.asarray(a, float), replay.theta | changes)
    mean, loglik = run(theta, replay.belief(replay.theta), replay.recording.log)
    error = recordings.errors(replay, mean)
    late = (replay.recording.t - replay.recording.t[0])[replay.truth.mask] > 20.0
    score = metrics.rmse(error[late], replay.blocks)
    return {k: math.degrees(v) if k in ("inclination", "heading") else v for k, v in score.items()}, float(loglik.sum())


def test_positions_alone_tell_the_attitude():
    score, _ = hall_with()
    assert score["inclination"] < 0.6  # 2 degrees are asked for
    assert score["heading"] < 5.0
    assert score["position"] < 0.02


def test_without_the_lever_arm_it_is_worse():
    (score, loglik), (without, less) = hall_with(), hall_with(arm=(0.0, 0.0, 0.0))
    assert without["inclination"] > 1.5 * score["inclination"]
    assert without["position"] > 5 * score["position"]
    assert less < loglik - 50


def test_an_offset_of_the_clock_that_is_left_in_is_seen():
    # The stamps are right by now, so to take another 0.135 s off is to be wrong by as much.
    (score, loglik), (shifted, less) = hall_with(), hall_with(late=0.135)
    assert shifted["position"] > 2 * score["position"]
    assert less < loglik - 100
    best = max((-0.02, 0.0, 0.02), key=lambda late: hall_with(late=late)[1])
    assert best == 0.0


def test_the_heading_is_found_not_given():
    replay, _ = hall()
    true = Rotation.from_quat(np.asarray(replay.truth.x.att)[replay.truth.mask][0][[1, 2, 3, 0]])
    start = Rotation.from_quat(np.asarray(replay.belief(replay.theta).mean.att)[[1, 2, 3, 0]])
    # The vehicle was turned a little in the second that the truth comes later.
    w = (start * true.inv()).as_quat()
    assert abs(2 * np.arctan2(w[2], w[3])) % (2 * np.pi) < np.radians(45) or abs(2 * np.arctan2(-w[2], -w[3])) < 0.8
    std = np.sqrt(np.asarray(replay.belief(replay.theta).cov)[6:9, 6:9].trace())
    assert std > 0.4  # rad: nobody told


def test_a_belief_about_a_tilted_vehicle_errs_about_the_vertical():
    att = Rotation.from_euler("xyz", [0.7, -1.2, 2.0])
    quaternion = att.as_quat()[[3, 0, 1, 2]]
    stds = [jnp.asarray(s) for s in (1.0, 2.0, 0.1, 0.3, 0.4)]
    belief = alignment.about(np.zeros(3), quaternion, stds, 0.9, {"b": jnp.array([5.0]), "a": jnp.array([6.0, 7.0])})
    cov = np.asarray(belief.cov)
    turned = att.as_matrix() @ cov[6:9, 6:9] @ att.as_matrix().T
    np.testing.assert_allclose(turned, np.diag([0.01, 0.01, 0.81]), atol=1e-12)
    np.testing.assert_allclose(np.diag(cov)[[0, 3, 9, 12]], [1.0, 4.0, 0.09, 0.16])
    np.testing.assert_allclose(np.diag(cov)[15:], [36.0, 49.0, 25.0])  # by name
    np.testing.assert_allclose(belief.mean.att, quaternion)


def test_the_markers_are_where_the_calibration_says():
    data = datasets.load("euroc_mav", "V2_03_difficult")
    turn = Rotation.from_quat(np.array(euroc.VICON_TURN)[[1, 2, 3, 0]])
    np.testing.assert_allclose(turn.as_matrix(), data.constants["rotation"], atol=1e-4)
    model = euroc.watched_hexacopter(euroc.EUROC | {"arm": (0.1, -0.2, 0.3), "late": 0.1})
    q, mount = Rotation.from_euler("xyz", [0.1, -0.5, 1.0]), np.array([0.02, -0.01, 0.03])
    x = model.space.origin._replace(
        pos=jnp.array([1.0, 2.0, 3.0]),
        vel=jnp.array([1.0, 0.0, -2.0]),
        att=jnp.asarray(q.as_quat()[[3, 0, 1, 2]]),
        extra={"mount": jnp.asarray(mount)},
    )
    still = Imu(jnp.zeros(3), jnp.asarray(q.inv().apply([0, 0, 9.81])))
    x = jax.tree.map(jnp.asarray, x)
    pos, att = model.sensors["pose"].h(x, (still, ()))
    np.testing.assert_allclose(pos, np.array([0.9, 2.0, 3.2]) + q.apply([0.1, -0.2, 0.3]), atol=1e-3)
    expected = q * turn * Rotation.from_rotvec(mount)
    assert (expected.inv() * Rotation.from_quat(np.asarray(att)[[1, 2, 3, 0]])).magnitude() < 1e-6


FLIGHTS = ("Horizontal_path_06", "Horizontal_path_08")


@functools.cache
def phantoms() -> tuple[list[Any], Any]:
    """Two flights with two sensors each."""
    loaded = [datasets.load("ansfl_phantom4", flight) for flight in FLIGHTS]
    replays = [phantom.ansfl_phantom4(data, imu) for data in loaded for imu in (1, 4)]

    def run(theta: Any, belief: jf.Gaussian, log: jf.Log) -> Any:
        return jf.scan_runs(jf.ekf(phantom.phantom(theta), gate=GATE), belief, log, store=jf.mean_only, backend="xla")

    return replays, jax.jit(run)


def phantom_errors(cut: bool = False, alone: bool = False) -> list[np.ndarray]:
    """Errors (T, 9) of the four flights in one batch, NaN where nobody knows or it has not settled."""
    replays, run = phantoms()
    belief, log = recordings.batch(replays)
    if cut:
        silent: list[Any] = [phantom.outage(r) for r in replays]
        log = jf.stack([s[0] for s in silent])
    log = recordings.dead_reckoning(log) if alone else log
    means = run(jax.tree.map(jnp.asarray, phantom.PHANTOM), belief, log)
    out = []
    for k, replay in enumerate(replays):
        error = np.full((len(replay.recording.t), 9), np.nan)
        error[replay.truth.mask] = recordings.errors(replay, jax.tree.map(lambda a, k=k: a[k], means))
        error[replay.recording.t - replay.recording.t[0] < 5.0] = np.nan
        out.append(error)
    return out


def test_one_fix_a_second_is_enough_for_cheap_sensors_that_shake():
    rms = np.sqrt([np.nanmean(e**2, axis=0) for e in phantom_errors()])
    alone = np.sqrt([np.nanmean(e**2, axis=0) for e in phantom_errors(alone=True)])
    assert np.linalg.norm(rms[:, :3], axis=1).max() < 0.4
    assert np.linalg.norm(rms[:, 3:6], axis=1).max() < 0.8
    assert np.degrees(np.linalg.norm(rms[:, 6:8], axis=1)).max() < 5.0
    assert (np.linalg.norm(alone[:, :3], axis=1) > 20 * np.linalg.norm(rms[:, :3], axis=1)).all()


def test_ten_seconds_without_fixes():
    replays, _ = phantoms()
    kept, lost = phantom_errors(), phantom_errors(cut=True)
    for replay, a, b in zip(replays, kept, lost, strict=True):
        cut: Any = phantom.outage(replay)
        log, first, last = cut
        t = replay.recording.t
        assert t[last] - t[first] == pytest.approx(10.0, abs=0.25)
        fixes = t[replay.recording.log.valid["position"] & ~log.valid["position"]]
        assert len(fixes) in (10, 11)
        np.testing.assert_array_equal(a[:first], b[:first])
        assert np.linalg.norm(a[last, :3]) < 1.0 < np.linalg.norm(b[last, :3]) < 60.0


def test_fixes_are_every_tenth_sample_of_the_truth_and_never_scored():
    data = datasets.load("ansfl_phantom4", FLIGHTS[0])
    replay: Any = phantom.ansfl_phantom4(data, 3)
    t, valid = replay.recording.t, replay.recording.log.valid["position"]
    np.testing.assert_allclose(np.diff(t[valid]), 1.0, atol=1e-6)
    assert not (valid & replay.truth.mask).any()
    stamps, pos = data.truth["pos"]
    at = t - phantom.POSITION_CLOCK[FLIGHTS[0]]
    for rows, seen in ((valid, replay.recording.log.z["position"]), (replay.truth.mask, replay.truth.x.pos)):
        expected = np.stack([np.interp(at[rows], stamps, pos[:, i]) for i in range(3)], 1)
        np.testing.assert_allclose(seen[rows], expected, atol=1e-6)
    angles = [np.interp(t, stamps, np.unwrap(data.truth[k][1])) for k in ("roll", "pitch", "yaw")]
    expected = Rotation.from_euler("ZYX", np.stack([angles[2], -angles[1], angles[0]], 1)[replay.truth.mask])
    att = Rotation.from_quat(np.asarray(replay.truth.x.att)[replay.truth.mask][:, [1, 2, 3, 0]])
    assert (expected.inv() * att).magnitude().max() < 1e-6
    with pytest.raises(KeyError, match="imu: expected one of"):
        phantom.ansfl_phantom4(data, 5)


def test_no_reading_of_the_leica_flight_knows_the_truth():
    data = datasets.load("euroc_mav", "MH_01_easy")
    off = data._replace(truth={k: (t, x[::-1].copy()) for k, (t, x) in data.truth.items()})
    (original, _), other = hall(), euroc.euroc_mav(off)
    rows = len(original.recording.t)
    for a, b in zip(*map(jax.tree.leaves, (original.recording, other.recording)), strict=True):
        np.testing.assert_array_equal(a, b[:rows])
    for a, b in zip(*map(jax.tree.leaves, (original.belief(original.theta), other.belief(other.theta))), strict=True):
        np.testing.assert_array_equal(a, b)
