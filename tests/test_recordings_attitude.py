"""BROAD: the board's attitude on a trial that nothing was chosen on; and that truth is for scoring."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxfilt as jf
from jaxfilt import datasets, recordings
from jaxfilt.recordings.attitude import BOARD, broad

pytestmark = [pytest.mark.data, pytest.mark.usefixtures("data")]

SLOW, FAST = "02_undisturbed_slow_rotation_B", "21_undisturbed_fast_combined"


@functools.cache
def replayed(trial):
    return broad(datasets.load("broad", trial))


def truth_of(replay):
    assert replay.truth is not None
    return replay.truth


def errors(trial, change=()):
    """RMSE of inclination and heading, degrees."""
    replay = replayed(trial)
    theta = jax.tree.map(jnp.asarray, BOARD | dict(change))
    log = replay.recording.log
    run = jax.jit(lambda theta: jf.scan(jf.ekf(replay.model(theta)), replay.belief(theta), log, store=jf.mean_only))
    found = recordings.rmse(replay, run(theta))
    return {block: math.degrees(value) for block, value in found.items()}


def test_the_slow_trial_which_is_held_out_and_what_bias_estimation_is_worth():
    found = errors(SLOW)
    assert found["inclination"] < 1.2
    assert found["heading"] < 2.8
    sure = {"gyro_walk": math.log(1e-9), "start": (*BOARD["start"][:2], math.log(1e-9))}
    assert errors(SLOW, sure.items())["heading"] > 2 * found["heading"]


@pytest.mark.long
def test_the_fast_trial():
    found = errors(FAST)
    assert found["inclination"] < 3.5
    assert found["heading"] < 3.8


def test_the_truth_is_turned_about_the_vertical_alone_and_by_one_angle():
    data, replay = datasets.load("broad", FAST), replayed(FAST)
    t, true = data.truth["attitude"]
    at = np.searchsorted(t, replay.recording.t)
    exact = np.flatnonzero((at < len(t)) & (t[np.minimum(at, len(t) - 1)] == replay.recording.t))[::100]
    a = Rotation.from_quat(truth_of(replay).x[exact], scalar_first=True)
    turns = (a * Rotation.from_quat(true[at[exact]], scalar_first=True).inv()).as_rotvec()
    assert np.ptp(turns, axis=0).max() < 1e-9
    np.testing.assert_allclose(turns[0, :2], 0, atol=1e-9)
    rest = (replay.recording.t < 40) | (replay.recording.t > 160)
    assert not truth_of(replay).mask[rest & (replay.recording.t < 36)].any()
    assert 0.5 < truth_of(replay).mask.mean() < 0.65


def test_no_reading_knows_the_truth():
    data = datasets.load("broad", SLOW)
    t, q = data.truth["attitude"]
    turned = (Rotation.from_rotvec([0, 0, 1.0]) * Rotation.from_quat(q, scalar_first=True)).as_quat(scalar_first=True)
    other = broad(data._replace(truth={**data.truth, "attitude": (t, turned)}))
    for a, b in zip(jax.tree.leaves(replayed(SLOW).recording), jax.tree.leaves(other.recording), strict=True):
        np.testing.assert_array_equal(a, b)
    # A truth whose heading begins elsewhere scores the same.
    gap = (
        Rotation.from_quat(truth_of(other).x[::500], scalar_first=True).inv()
        * Rotation.from_quat(truth_of(replayed(SLOW)).x[::500], scalar_first=True)
    ).magnitude()
    assert gap.max() < 1e-9
