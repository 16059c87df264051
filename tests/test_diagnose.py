"""diagnose: the first run, step and sensor that went wrong, inside jit and vmap too."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf

STEPS = 12


def walk(f=lambda x, u, dt: x, R=lambda x, c: jnp.eye(1), h=lambda x, c: x[:1]):
    sensors = {
        "zebra": jf.Sensor(h, R, jf.vector(1)),
        "ant": jf.Sensor(lambda x, c: x, jf.const(jnp.eye(2)), jf.vector(2)),
    }
    return jf.Model(f, jf.const(0.1 * jnp.eye(2)), jf.vector(2), sensors)


def log(bad_row=None, sensor="zebra"):
    z = {"zebra": np.zeros((STEPS, 1)), "ant": np.zeros((STEPS, 2))}
    if bad_row is not None:
        z[sensor][bad_row] = np.nan
    return jf.Log(np.ones(STEPS), np.arange(STEPS, dtype=float), z, {}, {})


START = jf.Gaussian(np.zeros(2), np.eye(2))


def run(model, rows, start=START):
    """Inside jit, where the door cannot see the values."""
    return jax.jit(lambda b, rows: jf.scan(jf.ekf(model), b, rows))(start, rows)


def test_nothing_wrong():
    assert jf.diagnose(run(walk(), log())) is None


def test_a_refused_reading_is_not_wrong():
    rows = log()
    rows.z["zebra"][5] = 1e6
    track = jax.jit(lambda rows: jf.scan(jf.ekf(walk(), gate=0.99), START, rows))(rows)
    assert track.info["zebra"].status[5] == jf.Status.GATED
    assert jf.diagnose(track) is None


@pytest.mark.parametrize("sensor", ["zebra", "ant"])
def test_a_nan_reading(sensor):
    found = jf.diagnose(run(walk(), log(7, sensor)))
    assert (found.run, found.step, found.sensor) == (None, 7, sensor)
    assert found.status is jf.Status.BAD_MEASUREMENT
    assert f"step 7, sensor '{sensor}'" in found.message


def test_a_nan_prediction_names_no_sensor():
    model = walk(f=lambda x, u, dt: jnp.where(u == 4, jnp.nan, x))
    found = jf.diagnose(run(model, log()))
    assert (found.step, found.sensor, found.status) == (4, None, jf.Status.BAD_BELIEF)
    assert "f(x, u, dt) or Q(x, u, dt)" in found.message


def test_h_that_fails_somewhere():
    model = walk(h=lambda x, c: jnp.sqrt(x[:1] - 1))
    found = jf.diagnose(run(model, log()))
    assert (found.step, found.sensor, found.status) == (0, "zebra", jf.Status.BAD_PREDICTION)


def test_an_indefinite_innovation():
    model = walk(R=lambda x, c: -100.0 * jnp.eye(1))
    found = jf.diagnose(run(model, log()))
    assert (found.step, found.sensor, found.status) == (0, "zebra", jf.Status.INDEFINITE_INNOVATION)


def test_an_indefinite_belief():
    start = jf.Gaussian(np.zeros(2), np.array([[1.0, 2.0], [2.0, 1.0]]))
    model = walk(R=lambda x, c: 10.0 * jnp.eye(1))._replace(Q=lambda x, u, dt: jnp.zeros((2, 2)))
    silent = log()._replace(valid={"zebra": np.zeros(STEPS, bool), "ant": np.zeros(STEPS, bool)})
    found = jf.diagnose(run(model, silent, start))
    assert (found.step, found.sensor) == (0, None)
    assert "positive definiteness" in found.message


def test_the_first_of_many_runs_and_the_others_unharmed():
    z = np.zeros((5, STEPS, 1))
    z[3, 6], z[1, 9] = np.nan, np.inf
    rows = log()
    rows.z["zebra"] = z
    many = jax.jit(lambda rows: jf.scan_runs(jf.ekf(walk()), START, rows, batched=("z",)))
    rows.z["ant"] = np.zeros((5, STEPS, 2))
    track = many(rows)
    found = jf.diagnose(track)
    assert (found.run, found.step, found.sensor, found.runs) == (3, 6, "zebra", 2)
    assert "run 3, step 6" in found.message
    assert "2 of 5 runs" in found.message
    clean = many(rows._replace(z={**rows.z, "zebra": np.zeros((5, STEPS, 1))}))
    for k in (0, 2, 4):
        np.testing.assert_array_equal(track.belief.mean[k], clean.belief.mean[k])


def test_it_wants_a_track():
    with pytest.raises(TypeError, match=r"track: expected a Track, got Gaussian"):
        jf.diagnose(START)
    with pytest.raises(TypeError, match="outside jit and vmap"):
        jax.jit(lambda rows: jf.diagnose(jf.scan(jf.ekf(walk()), START, rows)) and 0)(log())
