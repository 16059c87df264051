"""Studies: every score from plain numpy on the very same runs; the same numbers however the runs are dealt out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from jax.core import Tracer

import jaxfilt as jf
from jaxfilt import consistency, mismatch
from jaxfilt.consistency import Consistency
from jaxfilt.study import study

TRACED = []
"""Grows when a model is built for tracing: a program that is there already builds none."""

A = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.1], [0.0, 0.0, 0.95]])
Q = np.array([[0.02, 0.01, 0.0], [0.01, 0.04, 0.01], [0.0, 0.01, 0.05]])
H = {"near": np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.3]]), "far": np.array([[1.0, 0.2, 0.0]])}
R = {"near": np.array([[1.0, 0.3], [0.3, 2.0]]), "far": np.array([[0.5]])}
RIGHT = {"q": 0.0, "r": 0.0}


def model(theta):
    """Constant acceleration, almost; theta scales Q and R by exp. The sensors are in no alphabetical order."""
    if isinstance(theta["q"], Tracer):
        TRACED.append(theta)
    noise = {name: jnp.exp(theta["r"]) * cov for name, cov in R.items()}
    return jf.linear(jnp.asarray(A), {k: jnp.asarray(v) for k, v in H.items()}, jnp.exp(theta["q"]) * Q, noise)


def belief(theta):
    return jf.Gaussian(jnp.array([1.0, -1.0, 0.5]), jnp.array([[2.0, 0.5, 0.1], [0.5, 1.0, 0.2], [0.1, 0.2, 0.7]]))


FILTERS = {"kf": lambda theta: jf.kf(model(theta)), "gated": lambda theta: jf.kf(model(theta), gate={"near": 0.9})}
BLOCKS = {"position": ((0,), "m"), "motion": ((2, 1), ""), "all": ((0, 1, 2), "")}
INDEX = {"state": [0, 1, 2]} | {name: list(index) for name, (index, _) in BLOCKS.items()}
STEPS, RUNS, LAGS, SAMPLE = 211, 400, 4, 100
SOME = slice(1, None, 2)
"""Rows of the histograms and samples: each second of 211."""


def plan():
    """ "far" each row, "near" each third, there only its second component in the last ten rows."""
    log = jf.schedule(model(RIGHT), STEPS, 0.1, every={"near": 3})
    valid = np.repeat(log.valid["near"][:, None], 2, axis=1)
    valid[-10:, 0] = False
    return log._replace(valid={"near": valid})


def run(seed=0, runs=RUNS, chunk=200, workers=2, **options):
    options = {"theta": RIGHT, "blocks": BLOCKS, "examples": 3, "lags": LAGS, "sample": SAMPLE} | options
    return study(
        model, FILTERS, belief, plan(), jax.random.key(seed), runs=runs, chunk=chunk, workers=workers, **options
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


@pytest.fixture(params=FILTERS)
def both(request, consistent, by_hand):
    """Scores of one filter, with errors (runs, T, n), covariances and infos of the same runs."""
    truth, tracks = by_hand
    track = tracks[request.param]
    return consistent.scores[request.param], truth - track.belief.mean, track.belief.cov, track.info


def squares(error, cov, index):
    """NEES (runs, T) of some components."""
    e, P = error[..., index], cov[..., index, :][..., index]
    return np.einsum("nti,nti->nt", e, np.linalg.solve(P, e[..., None])[..., 0])


def estimate(a):
    """Mean over runs and its standard error."""
    return a.mean(0), a.std(0, ddof=1) / np.sqrt(len(a))


def close(got, want, rtol=1e-9, atol=1e-12):
    for x, y in zip(got, want, strict=True):
        np.testing.assert_allclose(x, y, rtol=rtol, atol=atol)


def chi_square(total, dof, count, confidence=0.999):
    """Mean, expectation, exact bounds and p-value of a sum of normalised squares."""
    low, high = scipy.stats.chi2.interval(confidence, dof)
    p = 2 * np.minimum(scipy.stats.chi2.cdf(total, dof), scipy.stats.chi2.sf(total, dof))
    return total / count, dof / count, low / count, high / count, np.minimum(p, 1.0)


def student(averages, expected, confidence=0.999):
    """Mean, expectation, bounds and p-value of the runs' own averages (runs,)."""
    mean, error = estimate(averages)
    reach = scipy.stats.t.ppf(0.5 + 0.5 * confidence, len(averages) - 1) * error
    p = 2 * scipy.stats.t.sf(abs(mean - expected) / error, len(averages) - 1)
    return mean, expected, expected - reach, expected + reach, p


# --- the scores from plain numpy --------------------------------------------------------------------------------------


def test_rmse_is_that_of_plain_numpy_with_its_standard_error(both):
    scores, error, cov, _ = both
    assert list(scores.rmse) == list(scores.rmse_total) == list(scores.claimed) == list(scores.worst) == list(BLOCKS)
    for block, (index, _) in BLOCKS.items():
        length = np.linalg.norm(error[..., index], axis=-1)
        for got, of_runs in ((scores.rmse[block], length**2), (scores.rmse_total[block], (length**2).mean(1))):
            square, spread = estimate(of_runs)
            close(got, (np.sqrt(square), 0.5 * spread / np.sqrt(square)))
        variance = np.diagonal(cov, axis1=2, axis2=3)[..., index].sum(-1)
        np.testing.assert_allclose(scores.claimed[block], np.sqrt(variance.mean(0)), rtol=1e-9)
        assert scores.worst[block].value == pytest.approx(length.max(), rel=1e-9)
        assert scores.worst[block].run == length.max(1).argmax()


def test_the_standard_error_of_the_rmse_is_the_spread_between_studies(consistent):
    """From the runs of one study, that of the means of many: 8 studies of 50 runs in place of 400 runs."""
    many = [run(seed=20 + k, runs=200).scores["kf"].rmse_total["all"] for k in range(8)]
    spread = np.std([m.value for m in many], ddof=1)
    claimed = np.mean([m.error for m in many])
    low, high = np.sqrt(scipy.stats.chi2.interval(0.9999, 7) / np.array(7.0))
    assert low < spread / claimed < high
    assert claimed == pytest.approx(consistent.scores["kf"].rmse_total["all"].error * np.sqrt(2), rel=0.2)


def test_bias_and_mse_are_those_of_plain_numpy(both):
    scores, error, cov, _ = both
    close(scores.bias, estimate(error))
    np.testing.assert_allclose(scores.mse, np.einsum("nti,ntj->tij", error, error) / RUNS, rtol=1e-9, atol=1e-12)
    normalised = (error / np.sqrt(np.diagonal(cov, axis1=2, axis2=3))).mean(1)
    for i in range(3):
        close([a[i] for a in scores.normalised_error], student(normalised[:, i], 0.0))


def test_nees_and_its_bounds_are_those_of_plain_numpy(both):
    scores, error, cov, _ = both
    assert list(scores.nees) == list(scores.nees_total) == ["state", *BLOCKS]
    for block, index in INDEX.items():
        n, values = len(index), squares(error, cov, index)
        close(scores.nees[block], chi_square(values.sum(0), n * RUNS, RUNS))
        mean, between = values.mean(), values.mean(1).var(ddof=1)
        worth = RUNS * values.var() / between
        assert RUNS < worth < RUNS * STEPS
        t = scipy.stats.t(RUNS - 1)
        tail = scipy.stats.norm.sf(t.ppf(0.9995))
        low, high = scipy.stats.chi2.ppf(tail, n * worth) / worth, scipy.stats.chi2.isf(tail, n * worth) / worth
        z = scipy.stats.norm.isf(scipy.stats.chi2.sf(mean * worth, n * worth))
        close(scores.nees_total[block], (mean, n, low, high, 2 * t.sf(abs(z))), rtol=1e-7)


def test_coverage_is_that_of_plain_numpy(both):
    scores, error, cov, _ = both
    values = squares(error, cov, INDEX["state"])
    assert list(scores.coverage) == list(scores.coverage_total) == [0.5, 0.9, 0.99]
    for level in (0.5, 0.9, 0.99):
        hits = values <= scipy.stats.chi2.ppf(level, 3)
        count, share = hits.sum(0), scipy.stats.binom(RUNS, level)
        p = np.minimum(1.0, 2 * np.minimum(share.cdf(count), share.sf(count - 1)))
        low, high = share.ppf(0.0005) / RUNS, share.ppf(0.9995) / RUNS
        close(scores.coverage[level], (count / RUNS, np.full(STEPS, level), np.full(STEPS, low), high, p))
        mean, expected, low, high, p = student(hits.mean(1), level)
        close(scores.coverage_total[level], (mean, expected, max(low, 0.0), min(high, 1.0), p))


def test_the_log_score_is_that_of_plain_numpy(both):
    scores, error, cov, _ = both
    score = -0.5 * (squares(error, cov, [0, 1, 2]) + np.linalg.slogdet(2 * np.pi * cov)[1])
    assert score[5, 7] == pytest.approx(scipy.stats.multivariate_normal(cov=cov[5, 7]).logpdf(error[5, 7]))
    close(scores.log_score, estimate(score))
    close(scores.log_score_total, estimate(score.mean(1)))


def test_nis_counts_the_components_that_were_used(both):
    scores, _, _, infos = both
    assert set(scores.nis) == set(scores.nis_total) == set(scores.refused) == set(infos)
    for sensor, info in infos.items():
        used = (info.status == jf.Status.OK) & (info.dof > 0)
        count, dof = used.sum(0), np.where(used, info.dof, 0).sum(0)
        nis, some = np.where(used, info.nis, 0).sum(0), count > 0
        for row in scores.nis[sensor]:
            assert np.isnan(row[~some]).all()
        assert some.sum() == (STEPS if sensor == "far" else 70)
        close([row[some] for row in scores.nis[sensor]], chi_square(nis[some], dof[some], count[some]))
        close(scores.nis_total[sensor], chi_square(nis.sum(), dof.sum(), count.sum()), rtol=1e-7)
        assert scores.refused[sensor] == (info.status == jf.Status.GATED).sum()


def test_the_gate_refuses_a_tenth_of_its_readings(consistent):
    assert consistent.scores["kf"].refused == {"near": 0, "far": 0}
    refused = consistent.scores["gated"].refused
    assert refused["far"] == 0
    assert 0.09 < refused["near"] / (70 * RUNS) < 0.13


def whitened(info, seen):
    """``L^-1 r`` (runs, T, m) of what was used, else 0; and which components (runs, T, m) those are."""
    used = ((info.status == jf.Status.OK) & (info.dof > 0))[..., None] & seen
    one = np.eye(info.S.shape[-1])
    L = np.linalg.cholesky(np.where(used[..., None] & used[..., None, :], info.S, one))
    return np.linalg.solve(L, np.where(used, info.innovation, 0.0)[..., None])[..., 0], used


@pytest.mark.parametrize(("sensor", "rows"), [("far", slice(None)), ("near", slice(2, None, 3))])
def test_whiteness_counts_readings_and_the_components_that_both_have(both, sensor, rows):
    scores, _, _, infos = both
    seen = np.asarray(plan().valid.get(sensor, np.ones((STEPS, 1), bool)))
    assert seen[rows].any(1).all()
    assert seen.any(1).sum() == len(range(STEPS)[rows])
    e, used = (a[:, rows] for a in whitened(infos[sensor], seen))
    white = scores.whiteness[sensor]
    assert white.lags.tolist() == [1, 2, 3, 4]
    variance = (e**2).sum() / used.sum()
    for k, lag in enumerate(white.lags):
        pairs = np.logical_and(used[:, :-lag], used[:, lag:]).sum()
        rho = (e[:, :-lag] * e[:, lag:]).sum() / pairs / variance
        assert white.autocorrelation[k] == pytest.approx(rho, rel=1e-9)
        assert white.bound[k] == pytest.approx(scipy.stats.norm.ppf(0.9995) / np.sqrt(pairs), rel=1e-9)


def test_histograms_count_each_second_row_and_keep_what_is_beyond(both):
    scores, error, cov, _ = both
    normalised = (error / np.sqrt(np.diagonal(cov, axis1=2, axis2=3)))[:, SOME]
    edges, counts = scores.histogram
    np.testing.assert_array_equal(edges, np.linspace(-4, 4, 65))
    for i in range(3):
        np.testing.assert_array_equal(counts[i], np.histogram(np.clip(normalised[..., i], -3.99, 3.99), edges)[0])
    edges, counts = scores.run_nees
    assert (edges[0], edges[-1]) == (1 / 32, 128.0)
    np.testing.assert_array_equal(counts, np.histogram(squares(error, cov, [0, 1, 2]).mean(1) / 3, edges)[0])
    assert counts.sum() == RUNS


def test_noncredibility_is_that_of_the_first_runs(both):
    scores, error, cov, _ = both
    claimed = squares(error[:SAMPLE], cov[:SAMPLE], [0, 1, 2])
    mse = np.einsum("nti,ntj->tij", error, error) / RUNS
    actual = squares(error[:SAMPLE], np.broadcast_to(mse, cov[:SAMPLE].shape), [0, 1, 2])
    difference = 10 * (np.log10(claimed) - np.log10(actual))
    for got, want in (
        (scores.noncredibility, np.abs(difference).mean(0)),
        (scores.inclination, difference.mean(0)),
    ):
        np.testing.assert_allclose(got[SOME], want[SOME], rtol=1e-7, atol=1e-9)
        assert np.isnan(got[::2]).all()


def test_differences_are_paired(consistent, by_hand):
    truth, tracks = by_hand
    errors = [truth - tracks[name].belief.mean for name in FILTERS]
    covs = [tracks[name].belief.cov for name in FILTERS]
    ((pair, found),) = consistent.paired.items()
    assert pair == ("kf", "gated")
    assert found.runs == RUNS
    for block, (index, _) in BLOCKS.items():
        a, b = ((e[..., index] ** 2).sum(-1).mean(1) for e in errors)
        close(found.square[block], estimate(a - b))
        assert found.square[block].error < 0.7 * estimate(a)[1]
    a, b = (
        -0.5 * (squares(e, P, [0, 1, 2]) + np.linalg.slogdet(2 * np.pi * P)[1]).mean(1)
        for e, P in zip(errors, covs, strict=True)
    )
    close(found.log_score, estimate(a - b))
    assert found.log_score.value > 0


def test_the_first_runs_are_kept_whole_and_the_rest_is_said(consistent, by_hand):
    truth, tracks = by_hand
    np.testing.assert_allclose(consistent.truth, truth[:3], rtol=1e-9, atol=1e-9)
    for name, track in consistent.tracks.items():
        np.testing.assert_allclose(track.mean, tracks[name].belief.mean[:3], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(track.cov, tracks[name].belief.cov[:3], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(consistent.t, 0.1 * np.arange(1, STEPS + 1))
    said = consistent.runs, consistent.planned, consistent.steps, consistent.chunk, consistent.sample, consistent.dtype
    assert said == (RUNS, RUNS, STEPS, 200, SAMPLE, "float64")
    assert consistent.faults == {"kf": None, "gated": None}
    assert consistent.diverged == dict.fromkeys(FILTERS, (0, ()))
    same(consistent.kept, consistent.scores, 0)


# --- however the runs are dealt out -----------------------------------------------------------------------------------


def same(a, b, tolerance):
    leaves, structure = jax.tree.flatten(a)
    assert structure == jax.tree.structure(b)
    for x, y in zip(leaves, jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance)


def test_the_same_seed_gives_the_same_bits_whatever_the_workers(consistent):
    TRACED.clear()
    for workers in (1, 3):
        other = run(workers=workers)
        for field in ("scores", "kept", "paired", "truth", "tracks"):
            same(getattr(other, field), getattr(consistent, field), 0)
    assert not TRACED
    assert consistent.seed == 0
    other = run(seed=7)
    assert other.seed == 7
    assert other.scores["kf"].nees_total["state"].mean != consistent.scores["kf"].nees_total["state"].mean


def test_more_runs_with_the_same_chunk_compile_nothing_and_count_each_run_once(consistent):
    TRACED.clear()
    more, fewer = run(runs=401), run(runs=399, chunk=200)
    assert not TRACED
    for found, runs in ((more, 401), (fewer, 399)):
        assert found.runs == found.scores["kf"].runs == runs
        assert found.scores["kf"].run_nees.counts.sum() == runs
    total = [study.scores["kf"].mse * study.runs for study in (fewer, consistent, more)]
    assert np.linalg.eigvalsh(total[1] - total[0]).min() > -1e-9 * np.abs(total[0]).max()
    assert (np.trace(total[2] - total[1], axis1=1, axis2=2) > 0).all()


@pytest.mark.parametrize("wrong", [{"q": 0.0, "r": np.log(4.0)}, {"q": np.log(4.0), "r": 0.0}], ids=["R", "Q"])
def test_noise_wrong_by_four_is_found_both_ways_and_other_parameters_compile_nothing(consistent, wrong):
    TRACED.clear()
    over, under = (run(truth_theta=wrong), run(theta=wrong, truth_theta=RIGHT))
    assert not TRACED
    for found, verdict in ((over, "above"), (under, "below")):
        assert consistency.verdict(found.scores["kf"].nees_total["state"]) == verdict
        assert consistency.verdict(found.scores["kf"].nis_total["near"]) == verdict
    assert consistency.share_inside(over.scores["kf"].nees["state"]) < 0.2
    assert over.truth_theta == under.theta == wrong
    assert over.theta == under.truth_theta == RIGHT


def test_progress_is_told(consistent):
    told = []
    run(progress=lambda done, runs: told.append((done, runs)))
    assert told == [(0, 400), (200, 400), (400, 400)]


# --- a robot that needs its controller, a sensor that breaks, a filter that gets lost ---------------------------------

DRIVEN = 40
DRIVE = {"q": 0.01}


def unstable(theta, claim=1.0):
    """x' = 1.2 x + u + w, held by u; its eye, used before its axis, knows no number below -1."""

    def h(x, c):
        return jnp.where(x > -1.0, x, jnp.nan)

    eye = jf.Sensor(h, jf.const(jnp.full((1, 1), 0.1 * claim)), jf.scalar)
    axis = jf.Sensor(lambda x, c: x, jf.const(jnp.full((1, 1), 0.9 * claim)), jf.scalar)
    noise = jf.const(jnp.full((1, 1), theta["q"] * claim))
    return jf.Model(lambda x, u, dt: 1.2 * x + u, noise, jf.scalar, {"eye": eye, "axis": axis})


def unstable_start(theta):
    return jf.Gaussian(jnp.asarray(0.0), jnp.full((1, 1), 0.01))


def steered(x, u):
    return -0.9 * x + u


LOST = {
    "ekf": lambda theta: jf.ekf(unstable(theta)),
    "bold": lambda theta: jf.ekf(unstable(theta, claim=0.05)),
}


def controlled(chunk):
    """From the 20th row on the reference is -0.4: some of the runs come to where the sensor breaks."""
    log = jf.schedule(unstable(DRIVE), DRIVEN, 1.0, u=np.zeros(DRIVEN))
    log = log._replace(u=np.where(np.arange(DRIVEN) < 20, 0.0, -0.4))
    return study(
        unstable, LOST, unstable_start, log, jax.random.key(1), theta=DRIVE, runs=64, examples=64, control=steered,
        chunk=chunk, lags=3,
    )  # fmt: skip


@pytest.fixture(scope="module")
def lost():
    return controlled(64)


@pytest.fixture(scope="module")
def lost_by_hand(lost):
    """name -> error, variance, which runs diverged, infos; from the runs themselves."""

    @jax.jit
    @jax.vmap
    def one(number):
        log = jf.schedule(unstable(DRIVE), DRIVEN, 1.0, u=np.zeros(DRIVEN))
        log = log._replace(u=np.where(np.arange(DRIVEN) < 20, 0.0, -0.4))
        own = jax.random.fold_in(jax.random.key(1), number)
        truth, log = jf.simulate(unstable(DRIVE), unstable_start(DRIVE), log, own, steered)
        return truth, {name: jf.scan(make(DRIVE), unstable_start(DRIVE), log) for name, make in LOST.items()}

    truth, tracks = jax.device_get(one(np.arange(64)))
    out = {}
    for name, track in tracks.items():
        error, variance = truth - track.belief.mean, track.belief.cov[..., 0, 0]
        broken = ~np.isfinite(error + variance) | (track.info["eye"].status >= jf.Status.BAD_BELIEF)
        beyond = (error**2 / variance)[:, -1] > scipy.stats.chi2.isf(1e-9, 1)
        out[name] = error, variance, broken, broken.any(1) | beyond, track.info["eye"]
    return out


def test_the_controller_holds_what_would_run_away(lost):
    assert np.abs(lost.truth[:, :20]).max() < 1.0
    assert np.abs(1.2**20 * 0.1) > 3.0


@pytest.mark.parametrize("name", LOST)
def test_the_first_fault_is_named(lost, lost_by_hand, name):
    _, _, broken, _, info = lost_by_hand[name]
    first = np.where(broken.any(1), broken.argmax(1), 99)
    assert 3 < broken.any(1).sum() < 60
    fault = lost.faults[name]
    assert fault[:3] == (np.argmin(first), first.min(), "eye")
    assert fault.status == info.status[fault.run, fault.step] >= jf.Status.BAD_BELIEF
    assert fault.runs == broken.any(1).sum()


@pytest.mark.parametrize("name", LOST)
def test_diverged_runs_are_counted_and_the_first_are_named(lost, lost_by_hand, name):
    _, _, broken, gone, _ = lost_by_hand[name]
    if name == "bold":
        assert (gone & ~broken.any(1)).sum() > 3  # not by faults alone
    assert lost.diverged[name].runs == gone.sum()
    assert lost.diverged[name].first == tuple(np.flatnonzero(gone)[:16])


@pytest.mark.parametrize("name", LOST)
@pytest.mark.parametrize("kept", [False, True], ids=["scores", "kept"])
def test_broken_runs_do_not_spoil_the_rest(lost, lost_by_hand, name, kept):
    """Scores are over all rows that are finite; kept are over the runs that did not diverge."""
    error, variance, _, gone, info = lost_by_hand[name]
    scores = (lost.kept if kept else lost.scores)[name]
    there = np.isfinite(error) & ~(kept & gone)[:, None]
    error = np.where(there, error, np.nan)
    assert scores.runs == (64 - gone.sum() if kept else 64)
    square, count = error**2, there.sum(0)
    spread = np.nanstd(square, 0, ddof=1) / np.sqrt(count)
    rmse = np.sqrt(np.nanmean(square, 0))
    close(scores.rmse["x[0]"], (rmse, 0.5 * spread / rmse), rtol=1e-8)
    some = there.any(1)
    assert scores.rmse_total["x[0]"].value == pytest.approx(np.sqrt(np.nanmean(square[some], 1).mean()), rel=1e-8)
    assert scores.worst["x[0]"] == (pytest.approx(np.nanmax(np.abs(error))), np.nanmax(square, 1, initial=0).argmax())
    nees = square / variance
    close(scores.nees["state"], chi_square(np.nansum(nees, 0), count, count), rtol=1e-8)
    assert scores.nees_total["state"].mean == pytest.approx(np.nanmean(nees[some], 1).mean(), rel=1e-8)
    np.testing.assert_allclose(scores.mse[:, 0, 0], np.nanmean(square, 0), rtol=1e-8)
    used = (info.status == jf.Status.OK) & ~(kept & gone)[:, None]
    assert scores.nis_total["eye"].mean == pytest.approx(info.nis[used].mean(), rel=1e-8)
    pairs = (used[:, :-1] & used[:, 1:]).sum()
    assert scores.whiteness["eye"].bound[0] == pytest.approx(scipy.stats.norm.ppf(0.9995) / np.sqrt(pairs))
    assert scores.histogram.counts.sum() == there.sum()
    assert scores.run_nees.counts.sum() == some.sum()
    sampled = np.where(np.isfinite(nees), nees, np.nan)
    difference = 10 * np.log10(np.nanmean(square, 0) / variance)
    inclination = np.nanmean(np.where(np.isfinite(sampled), difference, np.nan), 0)
    np.testing.assert_allclose(scores.inclination, inclination, rtol=1e-7, atol=1e-9)


def test_differences_are_over_the_runs_that_neither_lost(lost, lost_by_hand):
    (error, _, _, one, _), (other, _, _, two, _) = lost_by_hand["ekf"], lost_by_hand["bold"]
    good = ~one & ~two
    found = lost.paired["ekf", "bold"]
    assert 3 < found.runs == good.sum() < 64
    close(found.square["x[0]"], estimate((error[good] ** 2 - other[good] ** 2).mean(1)), rtol=1e-8)


def test_the_chunk_changes_nothing_but_rounding(lost):
    """Four chunks, the last one filled up, in place of one; nothing of it is lost with the runs that diverge."""
    dealt = controlled(17)
    assert dealt.chunk == 17
    same(dealt.kept, lost.kept, 1e-9)
    same(dealt.paired, lost.paired, 1e-9)
    assert (dealt.diverged, dealt.faults) == (lost.diverged, lost.faults)
    np.testing.assert_array_equal(dealt.truth, lost.truth[:17])


# --- a truth that the filter does not know ----------------------------------------------------------------------------


def whole(theta):
    """Position, velocity, and a disturbance of the sensor that the filter knows nothing of."""
    A = jnp.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.9]])
    eye = jnp.array([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    return jf.linear(A, {"eye": eye}, jnp.diag(jnp.array([0.02, 0.04, 0.1])), {"eye": jnp.eye(2) * theta["r"]})


def part(theta):
    A = jnp.array([[1.0, 0.1], [0.0, 1.0]])
    return jf.linear(A, {"eye": jnp.eye(2)}, jnp.diag(jnp.array([0.02, 0.04])), {"eye": jnp.eye(2) * theta["r"]})


def part_start(theta):
    return jf.Gaussian(jnp.zeros(2), jnp.eye(2))


def whole_start(theta):
    return jf.Gaussian(jnp.array([0.5, 0.0, -1.0]), jnp.diag(jnp.array([2.0, 1.0, 0.5])))


def seen(x):
    return x[:2]


def spoilt(theta):
    """Outliers, and readings lost that differ from run to run."""
    robot = whole(theta)
    return mismatch.several(
        mismatch.outliers(robot, "eye", 0.1, 5.0), mismatch.drop_outs(robot, "eye", theta["lost"], length=2.0)
    )


NARROW = {"part": lambda theta: jf.kf(part(theta))}


def test_another_truth_with_spoilt_readings_is_scored_as_by_hand():
    theta, true = {"r": 0.5, "lost": 0.0}, {"r": 0.3, "lost": 0.4}
    log = jf.schedule(whole(true), 50, 0.1)
    found = study(
        whole, NARROW, part_start, log, jax.random.key(2), theta=theta, truth_theta=true, runs=100, chunk=50,
        corrupt=spoilt, truth_belief=whole_start, view=seen, examples=2, lags=2,
    )  # fmt: skip

    @jax.jit
    @jax.vmap
    def one(number):
        own = jax.random.fold_in(jax.random.key(2), number)
        truth, readings = jf.simulate(whole(true), whole_start(true), log, own)
        readings = spoilt(true)(truth, readings, jax.random.fold_in(own, 2))
        return seen(truth.T).T, readings.valid["eye"], jf.scan(jf.kf(part(theta)), part_start(theta), readings)

    truth, valid, track = jax.device_get(one(np.arange(100)))
    assert 0.5 < valid.mean() < 0.7
    assert len(np.unique(valid, axis=0)) == 100
    scores, info, error = found.scores["part"], track.info["eye"], truth - track.belief.mean
    close(scores.bias, estimate(error), rtol=1e-8)
    np.testing.assert_allclose(scores.rmse["x[1]"].value, np.sqrt((error[..., 1] ** 2).mean(0)), rtol=1e-8)
    nees = squares(error, track.belief.cov, [0, 1])
    close(scores.nees["state"], chi_square(nees.sum(0), 200, 100), rtol=1e-8)
    dof, nis = np.where(valid, info.dof, 0), np.where(valid, info.nis, 0.0)
    assert (dof == 2 * valid).all()
    close(scores.nis["eye"], chi_square(nis.sum(0), dof.sum(0), valid.sum(0)), rtol=1e-8)
    e, used = whitened(info, np.ones((50, 2), bool))
    for k in (1, 2):
        pairs = (used[:, :-k] & used[:, k:]).sum()
        rho = (e[:, :-k] * e[:, k:]).sum() / pairs / ((e**2).sum() / used.sum())
        assert scores.whiteness["eye"].autocorrelation[k - 1] == pytest.approx(rho, rel=1e-8)
    assert scores.nis_total["eye"].p < 1e-6
    np.testing.assert_allclose(found.truth, truth[:2], rtol=1e-9, atol=1e-9)


def test_the_key_of_a_corruption_is_not_one_that_the_simulation_used():
    """`simulate` splits the run's key in two: with the default generator ``fold_in(key, 1)`` is one of these halves."""
    own = jax.random.fold_in(jax.random.key(2), 5)
    corruption, simulation = jax.random.fold_in(own, 2), jax.random.split(own)
    assert not (jax.random.key_data(simulation) == jax.random.key_data(corruption)[None]).all(1).any()


def test_single_precision_stays_single():
    def walk(theta):
        one = jnp.ones((1, 1), jnp.float32)
        return jf.linear(0.9 * one, one, theta * one, one)

    log = jax.tree.map(lambda a: a.astype(np.float32), jf.schedule(walk(1.0), 30, 1.0))
    start = lambda theta: jf.Gaussian(jnp.zeros(1, jnp.float32), jnp.ones((1, 1), jnp.float32))  # noqa: E731
    filters = {"kf": lambda theta: jf.kf(walk(theta))}
    found = study(walk, filters, start, log, jax.random.key(0), theta=1.0, runs=50, chunk=50, examples=50)
    assert found.dtype == "float32"
    track = found.tracks["kf"]
    assert found.truth.dtype == track.mean.dtype == track.cov.dtype == np.float32
    error, cov = (found.truth - track.mean).astype(float), track.cov.astype(float)
    nees = squares(error, cov, [0])
    scores = found.scores["kf"]
    np.testing.assert_allclose(scores.rmse["x[0]"].value, np.sqrt((error[..., 0] ** 2).mean(0)), rtol=1e-5)
    np.testing.assert_allclose(scores.nees["state"].mean, nees.mean(0), rtol=1e-5)
    assert isinstance(scores.nees_total["state"], Consistency)
    assert scores.nees_total["state"].mean == pytest.approx(nees.mean(), rel=1e-5)
    assert consistency.verdict(scores.nees_total["state"]) == "inside"


# --- at the door ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"runs": 0}, "runs: expected at least 1, got 0"),
        ({"chunk": 0}, "chunk: expected at least 1, got 0"),
        ({"workers": 0}, "workers: expected at least 1, got 0"),
        ({"examples": -1}, "examples: expected at least 0, got -1"),
        ({"sample": -1}, "sample: expected at least 0, got -1"),
        ({"lags": 0}, "lags: expected at least 1, got 0"),
        ({"confidence": 1.0}, "confidence: expected a number between 0 and 1, got 1.0"),
        ({"blocks": {"yaw": ((3,), "rad")}}, r"blocks\['yaw'\]: expected indices from 0 to 2, got \(3,\)"),
        ({"blocks": {"nothing": ((), "")}}, r"blocks\['nothing'\]: expected indices from 0 to 2, got \(\)"),
        ({"blocks": {"state": ((0,), "")}}, "blocks: 'state' is the name of the whole state"),
        ({"view": lambda x: x[:2]}, r"view\(true state\): expected shapes \(3,\), got \(2,\)"),
        (
            {"truth_belief": lambda theta: belief(theta)._replace(cov=-jnp.eye(3))},
            r"truth_belief\(truth_theta\).cov: expected variances >= 0",
        ),
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
    indefinite = lambda theta: belief(theta)._replace(cov=-jnp.eye(3))  # noqa: E731
    with pytest.raises(ValueError, match=r"belief\(theta\).cov: expected variances >= 0"):
        study(model, FILTERS, indefinite, plan(), key, theta=RIGHT)
    mixed = FILTERS | {"unstable": lambda theta: jf.ekf(unstable(DRIVE))}
    with pytest.raises(ValueError, match="filters: expected all on one state space, got 3 dimensions for 'kf' and 1"):
        study(model, mixed, belief, plan(), key, theta=RIGHT)


def test_a_corruption_that_makes_no_log_of_the_filters_is_found_before_it_runs():
    broken = lambda theta: lambda truth, log, key: log._replace(z={})  # noqa: E731
    with pytest.raises(KeyError):
        run(corrupt=broken)
