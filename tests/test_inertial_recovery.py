"""Tuning finds a GNSS antenna's lever arm and the lateness of its stamps again, from the readings alone."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import inertial


@pytest.fixture(scope="module", autouse=True)
def _as_users_compile():
    """What takes its time here is not compilation by XLA alone."""
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", True)


def test_the_readings_are_of_then(monkeypatch):
    """Of the antenna 6 rows ago, from a known start, by the IMU's readings summed in NumPy."""
    monkeypatch.setitem(inertial.TRUE, "start", (-14.0,) * 6)
    log = inertial.late_flights(1, 60, jax.random.key(0))
    rows = np.flatnonzero(log.valid["gnss"][0])
    np.testing.assert_array_equal(rows, [9, 19, 29, 39, 49, 59])
    first = inertial.path(1)
    pos, vel, att, places = first.pos[0], first.vel[0], Rotation.identity(), []
    for gyro, force in zip(log.u.gyro[0], log.u.accelerometer[0], strict=True):
        acc = att.apply(force.copy()) - [0, 0, 9.81]
        pos, vel = pos + vel / 50 + acc / 5000, vel + acc / 50
        att = att * Rotation.from_rotvec(gyro / 50)
        places.append(pos + att.apply([0.1, -0.05, 0.15]))
    read, places = log.z["gnss"][0, rows], np.array(places)
    assert np.linalg.norm(read - places[rows - 6], axis=1).max() < 0.12
    assert np.linalg.norm(read - places[rows], axis=1).min() > 0.15


@pytest.mark.long
def test_lever_arm_and_lateness_are_found():
    """From 0, within 4.5 standard errors, which are small beside what is looked for."""
    pytest.importorskip("llvmlite")
    fit = inertial.recovery(backend="lanes")
    found = {p.name: p for p in fit.parameters}
    assert set(found) == {"arm/0", "arm/1", "arm/2", "late"}
    for p in found.values():
        assert p.start == 0
        assert p.true is not None
        assert p.error is not None
        assert abs(p.value - p.true) < 4.5 * p.error, p
        assert p.error < (0.005 if p.name == "late" else 0.03), p
    tuned, true, before = (fit.scores[stage]["test"].loss for stage in ("tuned", "truth", "before"))
    assert tuned < true + 0.05
    assert before > true + 0.1
