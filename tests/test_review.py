"""Replays: a recording's scores from plain numpy, with the part that the truth knows and without any."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import jaxfilt as jf
from jaxfilt import consistency
from jaxfilt.review import replayed

A = np.array([[1.0, 0.1], [0.0, 1.0]])
Q = np.array([[0.02, 0.01], [0.01, 0.04]])
H = {"near": np.eye(2), "far": np.array([[1.0, 0.2]])}
R = {"near": np.array([[1.0, 0.3], [0.3, 2.0]]), "far": np.array([[0.5]])}
RIGHT = {"q": 0.0, "r": 0.0}
ROWS = 300


def model(theta):
    """Constant velocity; theta scales Q and R by exp."""
    noise = {name: jnp.exp(theta["r"]) * cov for name, cov in R.items()}
    return jf.linear(jnp.asarray(A), {k: jnp.asarray(v) for k, v in H.items()}, jnp.exp(theta["q"]) * Q, noise)


def belief(theta):
    return jf.Gaussian(jnp.array([1.0, -1.0]), jnp.array([[2.0, 0.5], [0.5, 1.0]]))


FILTERS = {"kf": lambda theta: jf.kf(model(theta)), "gated": lambda theta: jf.kf(model(theta), gate={"near": 0.9})}


@pytest.fixture(scope="module")
def drive():
    """One simulated run as a recording; the truth knows the position alone, and not all the time."""
    truth, log = jf.simulate(model(RIGHT), belief(RIGHT), jf.schedule(model(RIGHT), ROWS, 0.1), jax.random.key(3))
    log = jax.tree.map(np.asarray, log)
    known = jf.Truth(np.asarray(truth[:, :1]), np.arange(ROWS) % 3 > 0)
    recording = jf.Recording(log, 1e9 + 0.1 * np.arange(ROWS))
    blocks = {"position": ((0,), "m")}
    return jf.Replay(model, belief, RIGHT, recording, known, jf.vector(1), lambda x: x[:1], blocks)


@pytest.fixture(scope="module")
def found(drive):
    return replayed(drive, FILTERS)


@pytest.fixture(scope="module")
def track(drive):
    run = jax.jit(lambda log: jf.scan(jf.kf(model(RIGHT)), belief(RIGHT), log))
    return jax.device_get(run(drive.recording.log))


def test_a_replay_is_scored_against_the_part_that_the_truth_knows(drive, found, track):
    review, mask = found.reviews["kf"], drive.truth.mask
    error, variance = drive.truth.x[:, 0] - track.belief.mean[:, 0], track.belief.cov[:, 0, 0]
    np.testing.assert_allclose(review.error[mask, 0], error[mask], rtol=1e-8, atol=1e-12)
    assert np.isnan(review.error[~mask]).all()
    np.testing.assert_allclose(review.nees[mask], error[mask] ** 2 / variance[mask], rtol=1e-8)
    assert np.isnan(review.nees[~mask]).all()
    np.testing.assert_allclose(review.mean[:, 0], track.belief.mean[:, 0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(review.std[:, 0], np.sqrt(variance), rtol=1e-8)
    assert review.rmse == {"position": pytest.approx(np.sqrt((error[mask] ** 2).mean()))}
    assert review.nees_mean.mean == pytest.approx((error[mask] ** 2 / variance[mask]).mean())
    assert review.nees_mean.expected == 1.0
    assert consistency.verdict(review.nees_mean) == "inside"
    assert not review.diverged
    assert review.fault is None
    assert (found.space.dim, found.dtype, found.theta, found.blocks) == (1, "float64", RIGHT, drive.blocks)
    np.testing.assert_array_equal(found.t, drive.recording.t)


def test_the_bounds_of_its_anees_are_wider_than_those_of_independent_steps(drive, found):
    """The error of the position lasts for some steps: a chi-square over all steps would be too sure."""
    mean, expected, low, high, p = found.reviews["kf"].nees_mean
    steps = drive.truth.mask.sum()
    narrow = scipy.stats.chi2.interval(found.confidence, steps) / steps
    assert low < narrow[0] < expected < narrow[1] < high
    assert low < mean < high
    assert p > 1 - found.confidence


def test_innovations_are_scored_as_by_hand(found, track):
    review = found.reviews["kf"]
    for sensor, dof in (("near", 2), ("far", 1)):
        info = track.info[sensor]
        total = info.nis.sum()
        nis = review.nis[sensor]
        assert (nis.mean, nis.expected) == pytest.approx((total / ROWS, dof))
        assert (nis.low, nis.high) == pytest.approx(
            tuple(b / ROWS for b in scipy.stats.chi2.interval(0.999, dof * ROWS))
        )
        cdf, sf = scipy.stats.chi2.cdf(total, dof * ROWS), scipy.stats.chi2.sf(total, dof * ROWS)
        assert nis.p == pytest.approx(2 * min(cdf, sf))
        assert consistency.verdict(nis) == "inside"
        white = review.whiteness[sensor]
        e = np.linalg.solve(np.linalg.cholesky(info.S), info.innovation[..., None])[..., 0]
        a, b = e[:-3], e[3:]
        assert white.lags[2] == 3
        assert white.autocorrelation[2] == pytest.approx((a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum()))
        assert white.bound[2] == pytest.approx(scipy.stats.norm.ppf(0.9995) / np.sqrt(dof * (ROWS - 3)))
        assert (np.abs(white.autocorrelation) < white.bound).all()


def test_what_a_gate_refuses_is_counted(found):
    gated = found.reviews["gated"]
    assert gated.refused["near"] == (gated.info["near"].status == jf.Status.GATED).sum()
    assert 0.05 < gated.refused["near"] / ROWS < 0.15
    assert gated.refused["far"] == found.reviews["kf"].refused["near"] == 0


def test_a_replay_without_truth_is_judged_by_its_innovations_alone(drive):
    blind = drive._replace(truth=None, space=jf.vector(2), view=lambda x: x)
    blind = blind._replace(blocks={"whole": ((0, 1), "")})
    wrong = replayed(blind, {"kf": FILTERS["kf"]}, theta={"q": 0.0, "r": np.log(4.0)}).reviews["kf"]
    assert wrong.error is wrong.nees is wrong.rmse is wrong.nees_mean is None
    assert consistency.verdict(wrong.nis["near"]) == "below"
    assert wrong.std.shape == (ROWS, 2)
    assert not wrong.diverged


def test_a_prediction_that_is_no_number_is_named_and_the_filter_has_diverged(drive):

    def fragile(theta):
        far = model(theta).sensors["far"]
        h = lambda x, c: jnp.where(c > 0, far.h(x, ()), jnp.nan)  # noqa: E731
        return model(theta)._replace(sensors=model(theta).sensors | {"far": far._replace(h=h)})

    c = {"far": np.where(np.arange(ROWS) == 120, -1.0, 1.0)}
    broken = drive.recording._replace(log=drive.recording.log._replace(c=c))
    review = replayed(
        drive._replace(model=fragile, recording=broken), {"kf": lambda theta: jf.kf(fragile(theta))}
    ).reviews["kf"]
    assert review.fault == (0, 120, "far", jf.Status.BAD_PREDICTION, 1)
    assert review.diverged
    sound = drive.truth.mask & (np.arange(ROWS) < 120)
    assert review.error is not None
    np.testing.assert_array_equal(np.isfinite(review.error[:, 0]), sound)
    assert review.rmse == {"position": pytest.approx(np.sqrt((review.error[sound] ** 2).mean()))}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"filters": {}}, "filters: expected at least one, got none"),
        ({"confidence": 0.0}, "confidence: expected a number between 0 and 1, got 0.0"),
        ({"blocks": {"yaw": ((1,), "rad")}}, r"blocks\['yaw'\]: expected indices from 0 to 0, got \(1,\)"),
    ],
)
def test_bad_arguments_are_named(drive, change, text):
    drive = drive._replace(blocks=change.pop("blocks", drive.blocks))
    with pytest.raises(ValueError, match=text):
        replayed(drive, change.pop("filters", FILTERS), **change)
