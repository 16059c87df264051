"""Studies: known answers, the same scores from plain numpy, the same numbers however the runs are dealt out."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import jaxfilt as jf
from jaxfilt import metrics, report
from jaxfilt.study import replayed, study

TRACED = []
"""Grows when a model is built for tracing: a program that is there already builds none."""

A = np.array([[1.0, 0.1], [0.0, 1.0]])
Q = np.array([[0.02, 0.01], [0.01, 0.04]])
H = {"far": np.array([[1.0, 0.2]]), "near": np.eye(2)}
R = {"far": np.array([[0.5]]), "near": np.array([[1.0, 0.3], [0.3, 2.0]])}
RIGHT = {"q": 0.0, "r": 0.0}


def model(theta):
    """Constant velocity; theta scales Q and R by exp."""
    if isinstance(theta["q"], jax.core.Tracer):
        TRACED.append(theta)
    noise = {name: jnp.exp(theta["r"]) * cov for name, cov in R.items()}
    return jf.linear(jnp.asarray(A), {k: jnp.asarray(v) for k, v in H.items()}, jnp.exp(theta["q"]) * Q, noise)


def belief(theta):
    return jf.Gaussian(jnp.array([1.0, -1.0]), jnp.array([[2.0, 0.5], [0.5, 1.0]]))


FILTERS = {"kf": lambda theta: jf.kf(model(theta)), "gated": lambda theta: jf.kf(model(theta), gate={"near": 0.9})}
BLOCKS = {"position": ((0,), "m"), "both": ((0, 1), "")}
STEPS, RUNS = 30, 400


def plan():
    """ "far" each row, "near" each third, there only its second component in the last ten rows."""
    log = jf.schedule(model(RIGHT), STEPS, 0.1, every={"near": 3})
    valid = np.repeat(log.valid["near"][:, None], 2, axis=1)
    valid[-10:, 0] = False
    return log._replace(valid={"near": valid})


def run(seed=0, runs=RUNS, chunk=200, workers=2, filters=FILTERS, **options):
    options = {"theta": RIGHT, "blocks": BLOCKS, "examples": 3} | options
    return study(
        model, filters, belief, plan(), jax.random.key(seed), runs=runs, chunk=chunk, workers=workers, **options
    )


@pytest.fixture(scope="module")
def consistent():
    return run()


@pytest.fixture(scope="module")
def by_hand():
    """Truths and tracks of the very same runs, from simulate and scan, with a leading run axis."""

    @jax.jit
    @jax.vmap
    def one(number):
        truth, log = jf.simulate(model(RIGHT), belief(RIGHT), plan(), jax.random.fold_in(jax.random.key(0), number))
        return truth, {name: jf.scan(make(RIGHT), belief(RIGHT), log) for name, make in FILTERS.items()}

    return jax.device_get(one(np.arange(RUNS)))


@pytest.mark.parametrize("name", FILTERS)
def test_scores_are_those_of_plain_numpy(consistent, by_hand, name):
    truth, track = by_hand[0], by_hand[1][name]
    scores, error = consistent.scores[name], by_hand[0] - track.belief.mean
    nees = np.einsum("nti,nti->nt", error, np.linalg.solve(track.belief.cov, error[..., None])[..., 0])
    np.testing.assert_allclose(scores.rmse["position"], np.sqrt((error[..., 0] ** 2).mean(0)), rtol=1e-9)
    np.testing.assert_allclose(scores.rmse["both"], np.sqrt((error**2).sum(2).mean(0)), rtol=1e-9)
    assert scores.rmse_total["both"] == pytest.approx(np.sqrt((error**2).sum(2).mean()), rel=1e-9)
    np.testing.assert_allclose(scores.nees.mean, nees.mean(0), rtol=1e-9)
    np.testing.assert_allclose(scores.nees.high, scipy.stats.chi2.ppf(0.9995, 2 * RUNS) / RUNS, rtol=1e-9)
    assert scores.nees_total[:2] == pytest.approx((nees.mean(), 2.0), rel=1e-9)
    half = 3.2905 * np.sqrt(2 * 2 * (nees.mean(1).var() / nees.var()) / RUNS)
    assert scores.nees_total[2:] == pytest.approx((2.0 - half, 2.0 + half), rel=0.02)
    assert not scores.diverged.any()
    assert scores.fault is None
    np.testing.assert_allclose(scores.mean, track.belief.mean[:3], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(scores.std, np.sqrt(np.diagonal(track.belief.cov[:3], axis1=2, axis2=3)), rtol=1e-9)
    np.testing.assert_allclose(consistent.truth, truth[:3], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", FILTERS)
def test_nis_counts_the_components_that_were_used(consistent, by_hand, name):
    for sensor, info in by_hand[1][name].info.items():
        used = (info.status == jf.Status.OK) & (info.dof > 0)
        count, dof = used.sum(0), np.where(used, info.dof, 0).sum(0)
        scores, total = consistent.scores[name].nis[sensor], consistent.scores[name].nis_total[sensor]
        some = count > 0
        assert np.isnan(scores.mean[~some]).all()
        assert (~some).sum() == (0 if sensor == "far" else 20)
        np.testing.assert_allclose(scores.mean[some], np.where(used, info.nis, 0).sum(0)[some] / count[some], rtol=1e-9)
        low, high = scipy.stats.chi2.interval(0.999, dof[some])
        np.testing.assert_allclose(scores.low[some], low / count[some], rtol=1e-9)
        np.testing.assert_allclose(scores.high[some], high / count[some], rtol=1e-9)
        assert total.mean == pytest.approx(np.where(used, info.nis, 0).sum() / count.sum(), rel=1e-9)
        assert total.expected == pytest.approx(dof.sum() / count.sum(), rel=1e-9)


def test_a_filter_on_its_own_model_is_consistent(consistent):
    scores = consistent.scores["kf"]
    assert metrics.verdict(scores.nees_total) == "inside"
    assert [metrics.verdict(c) for c in scores.nis_total.values()] == ["inside", "inside"]
    assert metrics.share_inside(scores.nees) > 0.9


@pytest.mark.parametrize("wrong", [{"q": 0.0, "r": np.log(4.0)}, {"q": np.log(4.0), "r": 0.0}], ids=["R", "Q"])
def test_noise_wrong_by_four_is_found_both_ways_and_other_parameters_compile_nothing(consistent, wrong):
    TRACED.clear()
    over, under = (run(truth_theta=wrong), run(theta=wrong, truth_theta=RIGHT))
    assert not TRACED
    for found, verdict in ((over, "above"), (under, "below")):
        assert metrics.verdict(found.scores["kf"].nees_total) == verdict
        assert metrics.verdict(found.scores["kf"].nis_total["near"]) == verdict
    assert metrics.share_inside(over.scores["kf"].nees) < 0.2


def same(a, b, tolerance):
    for x, y in zip(jax.tree.leaves(a.scores), jax.tree.leaves(b.scores), strict=True):
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance)


def test_the_same_seed_gives_the_same_bits_whatever_the_workers(consistent):
    TRACED.clear()
    same(run(workers=1), consistent, 0)
    same(run(workers=3), consistent, 0)
    assert not TRACED
    assert consistent.seed == 0
    other = run(seed=7)
    assert other.seed == 7
    assert other.scores["kf"].nees_total.mean != consistent.scores["kf"].nees_total.mean


def test_the_chunk_changes_nothing_but_rounding(consistent):
    """Three chunks, the last one filled up, in place of two; of one filter, to compile less."""
    dealt = run(chunk=150, filters={"kf": FILTERS["kf"]})
    same(dealt, consistent._replace(scores={"kf": consistent.scores["kf"]}), 1e-9)


def test_more_runs_with_the_same_chunk_compile_nothing(consistent):
    TRACED.clear()
    more = run(runs=401)
    assert not TRACED
    assert more.scores["kf"].diverged.shape == (401,)


def test_progress_is_told(consistent):
    told = []
    run(progress=lambda done, runs: told.append((done, runs)))
    assert told == [(0, 400), (200, 400), (400, 400)]


# --- a robot that needs its controller, and a sensor that breaks ------------------------------------------------------


def unstable(theta):
    """x' = 1.2 x + u + w, held by u; its sensor knows no logarithm of a number below -1."""

    def h(x, c):
        return jnp.where(x > -1.0, x, jnp.nan)

    sensor = jf.Sensor(h, jf.const(jnp.full((1, 1), theta["r"])), jf.scalar)
    return jf.Model(lambda x, u, dt: 1.2 * x + u, jf.const(jnp.full((1, 1), 0.01)), jf.scalar, {"eye": sensor})


def unstable_start(theta):
    return jf.Gaussian(jnp.asarray(0.0), jnp.full((1, 1), 0.01))


@pytest.fixture(scope="module")
def controlled():
    log = jf.schedule(unstable({"r": 0.1}), 40, 1.0, u=np.zeros(40))
    # In the second half the reference is -2, where the sensor breaks.
    log = log._replace(u=np.where(np.arange(40) < 20, 0.0, -0.5))
    filters = {"ekf": lambda theta: jf.ekf(unstable(theta))}
    return study(
        unstable, filters, unstable_start, log, jax.random.key(1), theta={"r": 0.1}, runs=16, examples=16,
        control=lambda x, u: -0.9 * x + u, chunk=16,
    )  # fmt: skip


def test_the_controller_holds_what_would_run_away(controlled):
    assert np.abs(controlled.truth[:, :20]).max() < 1.0
    assert np.abs(1.2**20 * 0.1) > 3.0


def test_the_first_fault_is_named_and_broken_runs_do_not_spoil_the_rest(controlled):
    scores = controlled.scores["ekf"]
    broken = ~np.isfinite(scores.mean)
    first = np.where(broken.any(1), broken.argmax(1), 99)
    assert broken.any()
    assert scores.fault is not None
    assert scores.fault.step == first.min()
    assert scores.fault.run == np.argmin(first)
    assert scores.fault.sensor == "eye"
    assert scores.fault.status in (jf.Status.BAD_MEASUREMENT, jf.Status.BAD_PREDICTION)
    np.testing.assert_array_equal(scores.diverged, broken.any(1))
    good = np.isfinite(scores.mean)
    error = np.where(good, controlled.truth - np.where(good, scores.mean, 0.0), np.nan)
    step = 15
    assert scores.rmse["x[0]"][step] == pytest.approx(np.sqrt(np.nanmean(error[:, step] ** 2)))


def test_a_report_of_broken_runs_is_still_json_and_a_picture(controlled, tmp_path):
    out = report.write(controlled, tmp_path / "new" / "folder", "unstable")
    found = json.loads((out / "summary.json").read_text())
    assert found["name"] == "unstable"
    ekf = found["filters"]["ekf"]
    assert ekf["diverged"] == controlled.scores["ekf"].diverged.sum()
    assert ekf["first_fault"]["step"] == controlled.scores["ekf"].fault.step
    assert ekf["rmse"]["x[0]"] == {
        "value": pytest.approx(controlled.scores["ekf"].rmse_total["x[0]"], rel=1e-5),
        "unit": "",
    }
    assert found["settings"]["theta"] == {"r": 0.1}
    assert (out / "study.png").stat().st_size > 20_000


def test_single_precision_stays_single():
    log = jax.tree.map(lambda a: a.astype(np.float32), jf.schedule(unstable({"r": 0.1}), 10, 1.0, u=np.zeros(10)))
    start = lambda theta: jf.Gaussian(jnp.float32(0.0), jnp.full((1, 1), 0.01, jnp.float32))  # noqa: E731

    def single(theta):
        m = unstable(theta)
        small = jf.const(jnp.full((1, 1), 0.01, jnp.float32))
        return m._replace(Q=small, f=lambda x, u, dt: 0.9 * x)

    filters = {"ekf": lambda theta: jf.ekf(single(theta))}

    found = study(single, filters, start, log, jax.random.key(0), theta={"r": np.float32(0.1)}, runs=50)
    assert found.dtype == "float32"
    assert found.scores["ekf"].mean.dtype == np.float32
    assert 0.5 < found.scores["ekf"].nees_total.mean < 2.0


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"runs": 0}, "runs: expected at least 1, got 0"),
        ({"chunk": 0}, "chunk: expected at least 1, got 0"),
        ({"workers": 0}, "workers: expected at least 1, got 0"),
        ({"examples": -1}, "examples: expected at least 0, got -1"),
        ({"confidence": 1.0}, "confidence: expected a number between 0 and 1, got 1.0"),
        ({"blocks": {"yaw": ((2,), "rad")}}, r"blocks\['yaw'\]: expected indices from 0 to 1, got \(2,\)"),
    ],
)
def test_bad_arguments_are_named(change, text):
    with pytest.raises(ValueError, match=text):
        run(**change)


def test_bad_filters_logs_and_beliefs_are_named():
    key = jax.random.key(0)
    with pytest.raises(ValueError, match="filters: expected at least one, got none"):
        study(model, {}, belief, plan(), key, theta=RIGHT)
    with pytest.raises(ValueError, match=r"log.z: expected at least one sensor that reads, got none"):
        study(model, FILTERS, belief, plan()._replace(z={}, valid={}), key, theta=RIGHT)
    with pytest.raises(KeyError, match="expected one of"):
        study(model, FILTERS, belief, plan()._replace(z={"sonar": np.zeros(STEPS)}, valid={}), key, theta=RIGHT)
    indefinite = lambda theta: belief(theta)._replace(cov=-jnp.eye(2))  # noqa: E731
    with pytest.raises(ValueError, match=r"belief\(theta\).cov: expected variances >= 0"):
        study(model, FILTERS, indefinite, plan(), key, theta=RIGHT)


# --- a recording ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drive():
    """One simulated run as a recording; the truth knows the position alone, and not all the time."""
    truth, log = jf.simulate(model(RIGHT), belief(RIGHT), jf.schedule(model(RIGHT), 300, 0.1), jax.random.key(3))
    log = jax.tree.map(np.asarray, log)
    known = jf.Truth(np.asarray(truth[:, :1]), np.arange(300) % 3 > 0)
    recording = jf.Recording(log, 1e9 + 0.1 * np.arange(300))
    blocks = {"position": ((0,), "m")}
    return jf.Replay(model, belief, RIGHT, recording, known, jf.vector(1), lambda x: x[:1], blocks)


def test_a_replay_is_scored_against_the_part_that_the_truth_knows(drive):
    found = replayed(drive, FILTERS)
    track = jf.scan(jf.kf(model(RIGHT)), belief(RIGHT), drive.recording.log)
    review, mask = found.reviews["kf"], drive.truth.mask
    error = drive.truth.x[:, 0] - np.asarray(track.belief.mean[:, 0])
    variance = np.asarray(track.belief.cov[:, 0, 0])
    np.testing.assert_allclose(review.error[mask, 0], error[mask], rtol=1e-8, atol=1e-12)
    assert np.isnan(review.error[~mask]).all()
    np.testing.assert_allclose(review.std[:, 0], np.sqrt(variance), rtol=1e-8)
    assert review.rmse["position"] == pytest.approx(np.sqrt((error[mask] ** 2).mean()))
    assert review.nees_mean.mean == pytest.approx((error[mask] ** 2 / variance[mask]).mean())
    assert metrics.verdict(review.nees_mean) == "unknown"
    assert review.nis["near"].mean == pytest.approx(float(track.info["near"].nis.mean()))
    assert [metrics.verdict(c) for c in review.nis.values()] == ["inside", "inside"]
    white = review.whiteness["near"]
    assert (np.abs(white.autocorrelation) < white.bound).all()
    assert not review.diverged
    gated = found.reviews["gated"]
    assert 0.05 < gated.refused["near"] / 300 < 0.15
    assert gated.refused["far"] == review.refused["near"] == 0


def test_a_replay_without_truth_is_judged_by_its_innovations_alone(drive):
    blind = drive._replace(truth=None, space=jf.vector(2), view=lambda x: x)
    blind = blind._replace(blocks={"state": ((0, 1), "")})
    wrong = replayed(blind, {"kf": FILTERS["kf"]}, theta={"q": 0.0, "r": np.log(4.0)}).reviews["kf"]
    assert wrong.error is wrong.nees is wrong.rmse is wrong.nees_mean is None
    assert metrics.verdict(wrong.nis["near"]) == "below"
    assert wrong.std.shape == (300, 2)
