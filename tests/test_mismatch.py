"""Corrupted readings: their distributions against SciPy, their masks, and what a filter makes of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial.transform
import scipy.stats

import jaxfilt as jf
from jaxfilt import mismatch
from jaxfilt.models import car

ROWS = 20_000
KEY = jax.random.key(5)
NOISE = np.array([[2.0, 0.6], [0.6, 0.5]])


def still(R=NOISE, dtype=np.float64):
    """A robot that stands at a known place and reads it: sensor "z"."""
    eye = jnp.eye(2, dtype=dtype)
    return jf.linear(A=eye, H=eye, Q=jnp.zeros((2, 2), dtype), R=jnp.asarray(R, dtype))


def run_of(model, start, steps=ROWS, key=0, **options):
    return jf.simulate(model, start, jf.schedule(model, steps, 1.0, **options), jax.random.key(key))


@pytest.fixture(scope="module")
def standing():
    return run_of(still(), jf.Gaussian(jnp.array([3.0, -1.0]), jnp.zeros((2, 2))))


def noise(run, log=None):
    return np.asarray((log or run.log).z["z"] - run.truth)


# --- noise ------------------------------------------------------------------------------------------------------------


def test_outliers_strike_with_their_probability_and_by_their_scale_alone(standing):
    log = mismatch.outliers(still(), "z", 0.1, 7.0)(*standing, KEY)
    times = noise(standing, log) / noise(standing)
    np.testing.assert_allclose(times[:, 0], times[:, 1], rtol=1e-6)
    struck = np.isclose(times[:, 0], 7.0)
    np.testing.assert_allclose(times[~struck], 1.0, rtol=1e-6)
    assert scipy.stats.binomtest(int(struck.sum()), ROWS, 0.1).pvalue > 1e-3
    # Independent from row to row: as many runs of outliers as the Wald-Wolfowitz mean says.
    runs = 1 + (struck[1:] != struck[:-1]).sum()
    assert abs(runs - 2 * ROWS * 0.1 * 0.9) < 5 * np.sqrt(ROWS * 0.2)
    found, expected = np.cov(noise(standing, log).T), (1 + 0.1 * (7.0**2 - 1)) * NOISE
    np.testing.assert_allclose(found, expected, rtol=0.1)


@pytest.mark.parametrize("dof", [1.0, 4.0])
def test_heavy_tails_are_student_t_of_scale_r(standing, dof):
    log = mismatch.heavy_tails(still(), "z", dof)(*standing, KEY)
    v = noise(standing, log)
    for i in range(2):
        marginal = scipy.stats.t(dof, scale=np.sqrt(NOISE[i, i]))
        assert scipy.stats.kstest(v[:, i], marginal.cdf).pvalue > 1e-3
        # Negative control: the test tells t from the Gaussian that was there before.
        assert scipy.stats.kstest(noise(standing)[:, i], marginal.cdf).pvalue < 1e-6
    # One factor for all components: v' R^-1 v / 2 is F(2, dof), which two independent t's are not.
    distance = np.einsum("ti,ij,tj->t", v, np.linalg.inv(NOISE), v) / 2
    assert scipy.stats.kstest(distance, scipy.stats.f(2, dof).cdf).pvalue > 1e-3


def test_tails_of_few_degrees_of_freedom_do_not_underflow(standing):
    truth, log = jax.tree.map(lambda a: a[:2000], tuple(standing))
    log = jax.tree.map(lambda a: a.astype(jnp.float32) if a.dtype == jnp.float64 else a, log)
    model = still(dtype=np.float32)
    z = mismatch.heavy_tails(model, "z", 0.5)(truth.astype(jnp.float32), log, KEY).z["z"]
    assert z.dtype == jnp.float32
    assert jnp.isfinite(z).all()


def test_scaled_r_keeps_the_covariance_of_heavy_tails():
    model = still()
    narrow = mismatch.scaled(model, R=(9 - 2) / 9)
    run = run_of(narrow, jf.Gaussian(jnp.zeros(2), jnp.zeros((2, 2))))
    log = mismatch.heavy_tails(narrow, "z", 9.0)(*run, KEY)
    np.testing.assert_allclose(np.cov(noise(run, log).T), NOISE, rtol=0.06)


# --- angles, attitudes, contexts --------------------------------------------------------------------------------------


def test_a_bearing_is_scaled_across_its_seam_and_by_what_its_context_saw():
    """The landmark differs by row and lies behind the car, where the bearing jumps from pi to -pi."""
    model, steps = car.bicycle(), 400
    posts = np.stack([np.full(steps, -50.0), np.tile([3.0, -3.0], steps // 2)], axis=1)
    log = jf.schedule(
        model, steps, 0.02, {"gnss": 0, "odometer": 0}, car.Driving(*np.zeros((2, steps))), {"mark": posts}
    )
    start = jf.Gaussian(car.Bicycle(jnp.zeros(2), jnp.asarray(0.0), jnp.asarray(0.0)), jnp.zeros((4, 4)))
    truth, log = jf.simulate(mismatch.scaled(model, Q=0.0, R={"mark": 25.0}), start, log, KEY)
    out = mismatch.outliers(model, "mark", 1.0, 3.0)(truth, log, KEY)
    r = np.hypot(*posts.T)
    bearing = np.arctan2(posts[:, 1], posts[:, 0])
    wrapped = lambda a: (a + np.pi) % (2 * np.pi) - np.pi  # noqa: E731
    before, after = (np.asarray(a.z["mark"][1]) for a in (log, out))
    np.testing.assert_allclose(wrapped(after - bearing), 3.0 * wrapped(before - bearing), atol=1e-5)
    np.testing.assert_allclose(out.z["mark"][0] - r, 3.0 * (log.z["mark"][0] - r), atol=1e-4)
    assert (np.abs(after) <= np.pi + 1e-6).all()
    assert (np.sign(before) != np.sign(after)).any()


def test_an_attitude_stays_a_unit_quaternion_and_its_error_grows_in_the_tangent():
    cov = 0.1**2 * jnp.eye(3)
    sensor = jf.Sensor(lambda x, c: x, jf.const(cov), jf.so3)
    model = jf.Model(lambda x, u, dt: x, jf.const(cov), jf.so3, {"star": sensor})
    truth, log = run_of(model, jf.Gaussian(jnp.array([1.0, 0, 0, 0]), jnp.eye(3)), steps=50)
    rotation = lambda q: scipy.spatial.transform.Rotation.from_quat(np.asarray(q)[:, [1, 2, 3, 0]])  # noqa: E731
    error = (rotation(truth).inv() * rotation(log.z["star"])).as_rotvec()
    for corrupt, expected in (
        (mismatch.outliers(model, "star", 1.0, 4.0), 4.0 * error),
        (mismatch.outliers(model, "star", 0.0, 4.0), error),
    ):
        q = corrupt(truth, log, KEY).z["star"]
        np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, rtol=1e-12)
        np.testing.assert_allclose((rotation(truth).inv() * rotation(q)).as_rotvec(), expected, atol=1e-9)
    turn = np.array([0.0, 0.0, 0.3])
    q = mismatch.bias(model, "star", turn)(truth, log, KEY).z["star"]
    by_scipy = rotation(log.z["star"]) * scipy.spatial.transform.Rotation.from_rotvec(turn)
    assert (rotation(q).inv() * by_scipy).magnitude().max() < 1e-9


# --- what is there ----------------------------------------------------------------------------------------------------


def lengths(flags):
    """(lengths of stretches of True, of False), whole ones only."""
    ends = np.flatnonzero(np.diff(flags.astype(int)))
    whole = np.diff(ends)
    inside = flags[ends[:-1] + 1]
    return whole[inside], whole[~inside]


def geometric(found, mean):
    """p-value of the chi-square test that stretches have the geometric distribution of this mean."""
    expected = scipy.stats.geom(1 / mean)
    last = max(2, int(3 * mean))
    counts = np.append([np.sum(found == k) for k in range(1, last)], np.sum(found >= last))
    shares = np.append(expected.pmf(np.arange(1, last)), expected.sf(last - 1))
    return scipy.stats.chisquare(counts, shares * len(found)).pvalue


@pytest.mark.parametrize("length", [None, 6.0, 1.0])
def test_drop_outs_have_their_share_and_their_length_in_readings(standing, length):
    """The sensor reads in every third row: a burst counts its readings, and where none was due none is made."""
    due = np.arange(ROWS) % 3 == 2
    log = standing.log._replace(valid={"z": due})
    valid = np.asarray(mismatch.drop_outs(still(), "z", 0.3, length)(standing.truth, log, KEY).valid["z"])
    assert not valid[~due].any()
    lost = ~valid[due]
    mean = 1 / 0.7 if length is None else length
    lost_in_a_row, there_in_a_row = lengths(lost)
    if length == 1.0:
        assert (lost_in_a_row == 1).all()
    else:
        assert geometric(lost_in_a_row, mean) > 1e-3
        assert geometric(lost_in_a_row, 2 * mean) < 1e-3  # negative control
    assert geometric(there_in_a_row, mean * 0.7 / 0.3) > 1e-3
    assert lost.mean() == pytest.approx(0.3, abs=0.04)


def test_bursts_start_from_their_stationary_share(standing):
    log = jax.tree.map(lambda a: a[:2], standing.log)
    corrupt = mismatch.drop_outs(still(), "z", 0.3, 50.0)
    first = jax.jit(jax.vmap(lambda k: corrupt(standing.truth[:2], log, k).valid["z"][0]))(jax.random.split(KEY, 4000))
    assert scipy.stats.binomtest(int((~first).sum()), 4000, 0.3).pvalue > 1e-3


def test_masks_by_component_stay_by_component_and_a_missing_mask_is_made(standing):
    truth, log = jax.tree.map(lambda a: a[:200], tuple(standing))
    masks = np.stack([np.ones(200, bool), np.arange(200) % 2 == 0], axis=1)
    valid = mismatch.drop_outs(still(), "z", 0.5)(truth, log._replace(valid={"z": masks}), KEY).valid["z"]
    made = mismatch.drop_outs(still(), "z", 0.5)(truth, log, KEY).valid["z"]
    np.testing.assert_array_equal(valid, masks & np.asarray(made)[:, None])
    assert 60 < made.sum() < 140
    none, all_lost = (mismatch.drop_outs(still(), "z", p)(truth, log, KEY).valid["z"] for p in (0, 1))
    assert none.all()
    assert not all_lost.any()


@pytest.mark.parametrize("by_component", [False, True])
def test_a_delay_moves_reading_context_and_mask_together(by_component):
    rng, steps, rows = np.random.default_rng(0), 12, 3
    model = car.bicycle()
    posts, valid = rng.normal(size=(steps, 2)), rng.random((steps, 2) if by_component else steps) < 0.6
    z = {"mark": (rng.normal(size=steps), rng.normal(size=steps)), "gnss": rng.normal(size=(steps, 2))}
    log = jf.Log(np.ones(steps), (), z, {"mark": posts}, {"mark": valid})
    late = mismatch.delay(model, "mark", rows)(None, log, KEY)
    jf.validate(model, late)
    for old, new in ((z["mark"][0], late.z["mark"][0]), (z["mark"][1], late.z["mark"][1]), (posts, late.c["mark"])):
        np.testing.assert_array_equal(new[rows:], old[:-rows])
        np.testing.assert_array_equal(new[:rows], np.repeat(old[:1], rows, axis=0))
    np.testing.assert_array_equal(late.valid["mark"][rows:], valid[:-rows])
    assert not late.valid["mark"][:rows].any()
    np.testing.assert_array_equal(late.z["gnss"], z["gnss"])
    assert "gnss" not in late.valid
    assert mismatch.delay(model, "gnss", rows)(None, log, KEY).valid["gnss"].tolist() == [False] * 3 + [True] * 9


# --- composition, tracing, dtypes -------------------------------------------------------------------------------------


def corrupted(dtype, *first):
    """Function of a key: a simulated run of 40 rows with these corruptions, and then all that can be combined."""
    model = still(dtype=dtype)
    start = jf.Gaussian(jnp.zeros(2, dtype), jnp.eye(2, dtype=dtype))
    plan = jax.tree.map(lambda a: a.astype(dtype), jf.schedule(model, 40, 1.0))
    corrupt = mismatch.several(
        *first,
        mismatch.outliers(model, "z", 0.2, 10.0),
        mismatch.bias(model, "z", np.array([1.0, -1.0])),
        mismatch.delay(model, "z", 2),
        mismatch.drop_outs(model, "z", 0.2, 3.0),
    )

    def one(key):
        truth, log = jf.simulate(model, start, plan, key)
        return corrupt(truth, log, jax.random.fold_in(key, 1))

    return one


def test_all_of_them_together_under_vmap_and_jit_are_those_of_run_after_run():
    keys, one = jax.random.split(KEY, 5), corrupted(np.float64)
    batch, alone = jax.jit(jax.vmap(one))(keys), jax.jit(one)
    for k in range(5):
        for a, b in zip(jax.tree.leaves(alone(keys[k])), jax.tree.leaves(batch), strict=True):
            np.testing.assert_allclose(a, b[k], rtol=1e-12)
    assert len({mask.tobytes() for mask in np.asarray(batch.valid["z"])}) == 5


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_readings_keep_their_dtype(dtype):
    tails = mismatch.heavy_tails(still(dtype=dtype), "z", 4.0)
    log = jax.eval_shape(jax.vmap(corrupted(dtype, tails)), jax.random.split(KEY, 3))
    assert (log.z["z"].dtype, log.z["z"].shape) == (dtype, (3, 40, 2))
    assert (log.valid["z"].dtype, log.valid["z"].shape) == (bool, (3, 40))


def test_probabilities_and_sizes_sweep_under_vmap(standing):
    def one(p, scale):
        corrupt = mismatch.several(mismatch.outliers(still(), "z", p, scale), mismatch.drop_outs(still(), "z", p))
        log = corrupt(*standing, KEY)
        return jnp.var(log.z["z"][:, 0]), jnp.mean(~log.valid["z"])

    p, scale = np.array([0.0, 0.2, 0.6]), np.array([5.0, 3.0, 2.0])
    variance, lost = jax.jit(jax.vmap(one))(p, scale)
    np.testing.assert_allclose(variance, (1 + p * (scale**2 - 1)) * NOISE[0, 0], rtol=0.1)
    np.testing.assert_allclose(lost, p, atol=0.02)


def test_each_of_several_has_its_own_key(standing):
    twice = mismatch.several(*[mismatch.drop_outs(still(), "z", 0.5)] * 2)
    left = np.asarray(twice(*standing, KEY).valid["z"]).sum()
    assert scipy.stats.binomtest(int(left), ROWS, 0.25).pvalue > 1e-3
    assert mismatch.several()(*standing, KEY) == standing.log


def test_delays_sweep_under_vmap(standing):
    late = jax.vmap(lambda rows: mismatch.delay(still(), "z", rows)(*standing, KEY).valid["z"])(np.array([1, 5]))
    assert (ROWS - late.sum(axis=1)).tolist() == [1, 5]


# --- noises by a factor -----------------------------------------------------------------------------------------------


def test_scaled_multiplies_q_and_each_r_and_nothing_else():
    model, dt = car.bicycle(), 0.02
    x, u = car.bicycle_start().mean, car.Driving(jnp.asarray(1.0), jnp.asarray(0.1))
    changed = mismatch.scaled(model, Q=3.0, R={"gnss": 4.0})
    assert list(changed.sensors) == list(model.sensors)
    np.testing.assert_allclose(changed.Q(x, u, dt), 3.0 * model.Q(x, u, dt), rtol=1e-6)
    for name, factor in {"gnss": 4.0, "odometer": 1.0, "mark": 1.0}.items():
        np.testing.assert_allclose(changed.sensors[name].R(x, ()), factor * model.sensors[name].R(x, ()), rtol=1e-6)
        assert changed.sensors[name].h is model.sensors[name].h
    both = mismatch.scaled(model, R=2.0)
    np.testing.assert_allclose(both.sensors["odometer"].R(x, ()), 2.0 * model.sensors["odometer"].R(x, ()), rtol=1e-6)
    assert both.f is model.f


def test_factors_are_swept_under_vmap_and_give_the_exact_nis():
    """Of a known robot that stands: NIS is that of the right filter over the factor on R. In float32."""
    model, factors = still(dtype=np.float32), np.array([0.5, 1.0, 4.0], np.float32)
    start = jf.Gaussian(jnp.zeros(2, np.float32), jnp.zeros((2, 2), np.float32))
    plan = jax.tree.map(lambda a: a.astype(np.float32), jf.schedule(model, 50, 1.0))
    _, log = jf.simulate(model, start, plan, KEY)
    nis = lambda a: jf.scan(jf.kf(mismatch.scaled(model, R=a)), start, log).info["z"].nis  # noqa: E731
    swept = jax.jit(jax.vmap(nis))(factors)
    assert swept.dtype == np.float32
    np.testing.assert_allclose(swept * factors[:, None], np.repeat(swept[1:2], 3, axis=0), rtol=1e-4)


# --- what a filter makes of it ----------------------------------------------------------------------------------------


def test_heavy_tails_inflate_nis_as_computed(standing):
    """Known state, P = 0: NIS = v' R^-1 v, of mean m dof / (dof - 2) = 2 * 1.5 and distribution 2 F(2, dof)."""
    known = jf.Gaussian(jnp.array([3.0, -1.0]), jnp.zeros((2, 2)))
    nis = jax.jit(lambda log: jf.scan(jf.kf(still()), known, log).info["z"].nis)
    log = mismatch.heavy_tails(still(), "z", 6.0)(*standing, KEY)
    found, clean = (np.asarray(nis(a)) for a in (log, standing.log))
    assert found.mean() == pytest.approx(3.0, abs=5 * 2 * scipy.stats.f(2, 6).std() / np.sqrt(ROWS))
    assert clean.mean() == pytest.approx(2.0, abs=5 * 2 / np.sqrt(ROWS))
    assert scipy.stats.kstest(found / 2, scipy.stats.f(2, 6).cdf).pvalue > 1e-3


DT, RUNS, STEPS = 0.5, 200, 60
MOVING = jf.Gaussian(np.zeros(2), np.eye(2))


def moving(sensors=("position", "velocity")):
    """Position and velocity, both read, or one of them."""
    H = {"position": np.array([[1.0, 0.0]]), "velocity": np.array([[0.0, 1.0]])}
    R = {"position": np.array([[0.5]]), "velocity": np.array([[0.05]])}
    A, Q = np.array([[1.0, DT], [0.0, 1.0]]), np.diag([1e-3, 0.5])
    chosen = [{name: jnp.asarray(M[name]) for name in sensors} for M in (H, R)]
    return jf.linear(jnp.asarray(A), chosen[0], jnp.asarray(Q), chosen[1])


def errors_and_innovations(model, filters, corruptions):
    """By corruption and filter: errors (RUNS, STEPS, 2), and normalised innovations of "position" (RUNS, STEPS)."""
    plan = jf.schedule(model, STEPS, DT)

    def one(key):
        truth, log = jf.simulate(model, MOVING, plan, key)
        found = {}
        for name, corrupt in corruptions.items():
            wrong = corrupt(truth, log, jax.random.fold_in(key, 1))
            for kind, filt in filters.items():
                belief, info = jf.scan(filt, MOVING, wrong)
                e = info["position"].innovation[:, 0] / jnp.sqrt(info["position"].S[:, 0, 0])
                found[name, kind] = truth - belief.mean, e
        return found

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(jax.random.split(KEY, RUNS)))


def test_a_gate_survives_outliers():
    model = moving()
    filters = {"open": jf.kf(model), "gated": jf.kf(model, gate=0.99)}
    struck = {"outliers": mismatch.outliers(model, "position", 0.1, 20.0)}
    found = errors_and_innovations(model, filters, struck)
    rms = {kind: np.sqrt((e[..., 0] ** 2).mean()) for (_, kind), (e, _) in found.items()}
    assert rms["gated"] < 0.5 * rms["open"]


def lag_one(e):
    """Autocorrelation at lag 1 over all runs, in standard deviations of that of white noise; the start left out."""
    e = e[:, 20:]
    return (e[:, 1:] * e[:, :-1]).sum() / (e**2).mean() / np.sqrt(e[:, 1:].size)


@pytest.mark.parametrize("sensors", [["position", "velocity"], ["position"]])
def test_a_delay_correlates_the_innovations_unless_all_that_there_is_is_late(sensors):
    """Position late beside a velocity that is not: seen. Position alone: the clock is shifted, and nothing shows."""
    model = moving(sensors)
    timing = {"prompt": mismatch.several(), "late": mismatch.delay(model, "position", 4)}
    found = errors_and_innovations(model, {"kf": jf.kf(model)}, timing)
    (error, white), (late_error, late) = found["prompt", "kf"], found["late", "kf"]
    assert abs(lag_one(white)) < 4
    assert lag_one(late) > 10 if "velocity" in sensors else abs(lag_one(late)) < 4
    assert np.square(late_error).mean() > 2 * np.square(error).mean()


# --- the door ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda m: mismatch.outliers(m, "z", 1.2, 5.0), "probability: expected a number from 0 to 1, got 1.2"),
        (lambda m: mismatch.outliers(m, "z", float("nan"), 5.0), "probability: expected a number from 0 to 1, got nan"),
        (lambda m: mismatch.outliers(m, "z", 0.1, -5.0), "scale: expected a finite number >= 0, got -5.0"),
        (lambda m: mismatch.outliers(m, "z", np.ones(3), 5.0), r"probability: expected .*, got shape \(3,\)"),
        (lambda m: mismatch.heavy_tails(m, "z", 0.0), "dof: expected a finite number > 0, got 0.0"),
        (lambda m: mismatch.bias(m, "z", np.ones(3)), r"offset: expected shape \(2,\), got \(3,\)"),
        (lambda m: mismatch.bias(m, "z", np.array([0.0, np.inf])), "offset: expected finite numbers, got inf"),
        (lambda m: mismatch.delay(m, "z", 0), "rows: expected a whole number >= 1, got 0"),
        (lambda m: mismatch.delay(m, "z", 1.5), "rows: expected a whole number >= 1, got 1.5"),
        (lambda m: mismatch.drop_outs(m, "z", -0.1), "probability: expected a number from 0 to 1, got -0.1"),
        (lambda m: mismatch.drop_outs(m, "z", 0.1, 0.5), "length: expected a finite number >= 1, got 0.5"),
        (lambda m: mismatch.drop_outs(m, "z", 0.9, 2.0), r"length: expected at least p / \(1 - p\) for p = 0.9"),
        (lambda m: mismatch.scaled(m, Q=-1.0), "Q: expected a finite factor >= 0, got -1.0"),
        (lambda m: mismatch.scaled(m, R={"z": np.inf}), "R of 'z': expected a finite factor >= 0, got inf"),
    ],
)
def test_bad_numbers_are_named(make, text):
    with pytest.raises(ValueError, match=text):
        make(still())


@pytest.mark.parametrize(
    "make",
    [
        lambda m: mismatch.outliers(m, "sonar", 0.1, 5.0),
        lambda m: mismatch.heavy_tails(m, "sonar", 4.0),
        lambda m: mismatch.bias(m, "sonar", np.ones(2)),
        lambda m: mismatch.delay(m, "sonar", 1),
        lambda m: mismatch.drop_outs(m, "sonar", 0.1),
        lambda m: mismatch.scaled(m, R={"sonar": 2.0}),
    ],
)
def test_unknown_sensors_are_named(make):
    with pytest.raises(KeyError, match=r"expected one of .*'z'.*, got 'sonar'"):
        make(still())


def test_a_log_without_the_sensor_or_shorter_than_the_delay_is_refused(standing):
    truth, log = standing
    for make in (lambda m: mismatch.outliers(m, "z", 0.1, 5.0), lambda m: mismatch.drop_outs(m, "z", 0.1)):
        with pytest.raises(KeyError, match=r"log.z: expected readings of sensor 'z', got those of \[\]"):
            make(still())(truth, log._replace(z={}), KEY)
    with pytest.raises(ValueError, match="rows: expected fewer than the log's 20000, got 20000"):
        mismatch.delay(still(), "z", ROWS)(truth, log, KEY)
