"""Tuning on a walk that is read through noise, small enough for known answers: doors, splits, optimizers, refusals."""

import functools
import math
import re
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxfilt as jf
from jaxfilt import priors
from jaxfilt.tuning.parameters import parameters
from jaxfilt.tuning.setup import Uninfluential

TRUE = {"q": jnp.log(jnp.array([0.5])), "r": jnp.log(jnp.array([2.0])), "p": jnp.log(jnp.array([1.0]))}
WRONG = {"q": TRUE["q"] + math.log(10.0), "r": TRUE["r"] - math.log(10.0), "p": TRUE["p"]}
RUNS, STEPS = 12, 60


def walk(theta):
    one = jnp.eye(1, dtype=theta["q"].dtype)
    return jf.linear(A=one, H=one, Q=jf.log_std.cov(theta["q"]), R=jf.log_std.cov(theta["r"]))


def kf(theta):
    return jf.kf(walk(theta))


def start(theta):
    return jf.Gaussian(jnp.zeros(1, theta["p"].dtype), jf.log_std.cov(theta["p"]))


@functools.cache
def runs(number=RUNS, steps=STEPS):
    log = jf.schedule(walk(TRUE), steps, 1.0)
    keys = jax.random.split(jax.random.key(3), number)
    x, logs = jax.jit(jax.vmap(lambda key: jf.simulate(walk(TRUE), start(TRUE), log, key)))(keys)
    return jax.tree.map(np.asarray, (logs, jf.Truth(x, np.ones((number, steps), bool))))


@functools.cache
def fitted():
    logs, truth = runs()
    return jf.tune(kf, start, WRONG, logs, truth, truth_theta=TRUE, frozen=("p",))


def test_what_comes_back():
    fit = fitted()
    assert list(fit.scores) == ["before", "noise estimation", "tuned", "truth"]
    assert list(fit.scores["tuned"]) == ["train", "validation", "test"]
    assert [scores.runs for scores in fit.scores["tuned"].values()] == [7, 3, 2]
    assert fit.split == "by run: train 0 to 6, validation 7 to 9, test 10 and 11"
    assert [p.name for p in fit.parameters] == ["q[0]", "r[0]"]
    assert fit.theta["p"] == TRUE["p"]
    assert fit.frozen == ("p",)
    assert fit.errors_by == "sandwich over 30 blocks of time"
    np.testing.assert_allclose(fit.covariances["tuned"].R["z"], jnp.exp(2 * fit.theta["r"])[:, None])
    np.testing.assert_allclose(fit.covariances["before"].Q, jnp.exp(2 * WRONG["q"])[:, None])
    np.testing.assert_allclose(fit.model.Q(None, None, 1.0), fit.covariances["tuned"].Q)
    assert fit.history.theta.shape == (len(fit.history.loss), 2)
    for parameter in fit.parameters:
        assert abs(parameter.value - parameter.true) < 4 * parameter.error
        assert 0 < parameter.error < 0.5


def test_the_loss_falls_and_is_that_of_the_objective_called_by_hand():
    fit, (logs, truth) = fitted(), runs()
    assert (np.diff(fit.history.loss) <= 0).all()
    q, r = fit.history.theta[-1]
    last = TRUE | {"q": jnp.array([q]), "r": jnp.array([r])}
    for theta, loss in ((fit.theta, fit.scores["tuned"]["train"].loss), (last, fit.history.loss[-1])):
        each = [jf.log_score(kf(theta), start(theta), *pick(logs, truth, i)) for i in range(7)]
        assert loss == pytest.approx(float(np.mean(each)), rel=1e-12)


def pick(logs, truth, i):
    return jax.tree.map(lambda a: jnp.asarray(a[i]), (logs, truth))


def test_noise_estimation_gives_the_second_moments_of_the_residuals():
    """With the truth of the whole state known these are Q and R of greatest likelihood: computed here in NumPy."""
    fit, (logs, truth) = fitted(), runs()
    x, z = truth.x[:7, :, 0], logs.z["z"][:7, :, 0]
    first = x[:, :1]  # its residual is from the belief, whose P0 is known: Q is that of the others, as good as
    np.testing.assert_allclose(np.exp(2 * fit.estimated["r"][0]), ((z - x) ** 2).mean(), rtol=2e-3)
    increments = np.diff(x, axis=1)
    expected = (increments**2).mean()
    assert np.exp(2 * fit.estimated["q"][0]) == pytest.approx(expected, rel=0.03), first.shape


def test_scores_are_those_of_numpy():
    fit, (logs, truth) = fitted(), runs()
    q, r = (float(np.exp(2 * fit.theta[name][0])) for name in ("q", "r"))
    errors, nees, density = [], [], []
    for z, x in zip(logs.z["z"][10:, :, 0], truth.x[10:, :, 0], strict=True):
        m, P = 0.0, 1.0
        for k in range(STEPS):
            P = P + q
            K = P / (P + r)
            m, P = m + K * (z[k] - m), (1 - K) * P
            errors.append(x[k] - m)
            nees.append(errors[-1] ** 2 / P)
            density.append(-0.5 * (nees[-1] + math.log(2 * math.pi * P)))
    tuned = fit.scores["tuned"]["test"]
    assert tuned.rmse["x[0]"] == pytest.approx(np.sqrt(np.mean(np.square(errors))), rel=1e-12)
    assert tuned.nees.mean == pytest.approx(np.mean(nees), rel=1e-12)
    assert tuned.log_score.value == pytest.approx(np.mean(density), rel=1e-12)
    assert tuned.rows == 2 * STEPS


def test_without_a_truth_the_innovations_are_the_judge():
    logs, _ = runs()
    fit = jf.tune(kf, start, WRONG, logs, frozen=("p",))
    assert fit.objective == "likelihood"
    assert fit.estimated is None
    assert fit.errors_by == "inverse Hessian"
    assert fit.scores["tuned"]["test"].rmse is None
    for name in ("q", "r"):
        assert abs(fit.theta[name] - TRUE[name]) < 0.5


def test_one_long_log_is_split_by_time_and_the_filter_runs_through():
    logs, truth = runs(1, 300)
    fit = jf.tune(kf, start, WRONG, *pick(logs, truth, 0), frozen=("p",), burn_in=10.5)
    assert fit.split == "by time: 60 % train, then 20 % validation, then 20 % test"
    assert [scores.rows for scores in fit.scores["tuned"].values()] == [170, 60, 60]
    track = jf.scan(kf(fit.theta), start(fit.theta), *pick(logs, truth, 0)[:1])
    error = (truth.x[0] - track.belief.mean)[240:]
    assert fit.scores["tuned"]["test"].rmse["x[0]"] == pytest.approx(float(jnp.sqrt((error**2).mean())), rel=1e-12)


def test_logs_of_different_lengths_with_beliefs_of_their_own_are_as_good_as_alone():
    logs, truth = runs()
    short, long = pick(logs, truth, 0), pick(logs, truth, 1)
    short = jax.tree.map(lambda a: a[:40], short)
    there = lambda theta: jf.Gaussian(jnp.full(1, 1.0), jf.log_std.cov(theta["p"]))  # noqa: E731
    fit = jf.tune(
        kf,
        [start, there],
        WRONG,
        [short[0], long[0]],
        [short[1], long[1]],
        frozen=("p",),
        split=jf.Split([0, 1], (), ()),
        noise_estimate=False,
        steps=3,
    )
    losses = [float(jf.log_score(kf(fit.theta), b(fit.theta), *own)) for b, own in ((start, short), (there, long))]
    assert fit.scores["tuned"]["train"].loss == pytest.approx((40 * losses[0] + 60 * losses[1]) / 100, rel=1e-12)
    assert fit.scores["tuned"]["train"].rows == 100


class Moving(NamedTuple):
    pos: jax.Array
    vel: jax.Array


def test_a_truth_of_a_part_of_the_state_at_a_slower_rate():
    """Position known in every fourth row, with NaN where it is not; the wrong R is found all the same."""

    def model(theta):
        A = lambda x, u, dt: Moving(x.pos + dt * x.vel, x.vel)  # noqa: E731
        Q = jf.white(jnp.diag(jnp.stack([jnp.full((), 1e-4), jnp.exp(2 * theta["q"])])))
        z = jf.Sensor(lambda x, c: x.pos, lambda x, c: jnp.exp(2 * theta["r"])[None, None], jf.scalar)
        return jf.Model(A, Q, jf.product(Moving(jf.scalar, jf.scalar)), {"z": z})

    def belief(theta):
        return jf.Gaussian(Moving(jnp.asarray(0.0), jnp.asarray(0.0)), jnp.eye(2))

    true = {"q": jnp.log(0.3), "r": jnp.log(1.0)}
    log = jf.schedule(model(true), 150, 0.5)
    simulate = jax.jit(jax.vmap(lambda key: jf.simulate(model(true), belief(true), log, key)))
    x, logs = jax.tree.map(np.asarray, simulate(jax.random.split(jax.random.key(0), 12)))
    mask = np.arange(150) % 4 == 0
    truth = jf.Truth(np.where(mask, x.pos, np.nan), np.tile(mask, (12, 1)))
    fit = jf.tune(
        lambda theta: jf.ekf(model(theta)),
        belief,
        {"q": true["q"] + 2.0, "r": true["r"] - 2.0},
        logs,
        truth,
        space=jf.scalar,
        view=lambda x: x.pos,
        blocks={"position": ((0,), "m")},
    )
    assert abs(fit.theta["r"] - true["r"]) < 0.15
    assert abs(fit.theta["q"] - true["q"]) < 0.5
    assert abs(fit.estimated["r"] - true["r"]) < 0.15
    assert fit.scores["tuned"]["test"].rows == 2 * mask.sum()
    assert list(fit.scores["tuned"]["test"].rmse) == ["position"]


@pytest.mark.parametrize(
    "options",
    [
        {"optimizer": "adam", "learning_rate": 0.2, "steps": 80},
        {"optimizer": "adam", "learning_rate": 0.2, "steps": 120, "batch": 3, "patience": 120},
        {"optimizer": optax.adam(0.2), "steps": 120, "batch": 10, "length": 20, "patience": 120},
        {"starts": 3, "spread": 2.0},
    ],
    ids=["adam", "minibatches of runs", "minibatches of pieces", "three starts"],
)
def test_other_ways_end_at_the_same_place(options):
    logs, truth = runs()
    if options.get("length"):
        options = options | {"clip": {"q": 1.0}}
    fit = jf.tune(kf, start, WRONG, logs, truth, frozen=("p",), noise_estimate=False, **options)
    best = fitted().history.loss[-1]
    assert fit.scores["tuned"]["train"].loss - best < 0.05
    assert fit.starts.shape == (options.get("starts", 1),)
    assert fit.scores["before"]["train"].loss - best > 1.0  # or nothing would have been shown


def test_pieces_together_are_the_whole_run():
    """Their losses add up to that of the runs, when each goes on from what these very parameters say."""
    from jaxfilt.tuning import batches, loss, split

    logs, truth = runs()
    theta = jax.tree.map(jnp.asarray, TRUE)
    case, _ = split.gathered(logs, truth, walk(theta), jf.log_score, jf.vector(1), np.float64)
    free = parameters(theta)
    problem = loss.Problem(jf.log_score, kf, (start,), free, jf.vector(1), lambda x: x)
    V = free.start[None]
    whole = batches.Batches(problem, case)(V, 0, V)
    cut = batches.Batches(problem, case, length=25)(V, 0, V)
    assert cut.sound.shape == (1, 36)
    np.testing.assert_allclose(cut.loss, whole.loss, rtol=1e-12)
    assert (
        1e-3 < np.abs(cut.gradient - whole.gradient).max() < 0.5 * np.abs(whole.gradient).max()
    )  # what is not carried over


def test_a_run_of_nan_leaves_loss_and_gradient_of_the_others():
    """NaN comes back from it in reverse mode whatever is multiplied by 0; each run has a gradient of its own."""
    from jaxfilt.tuning import batches, loss, split

    logs, truth = runs()
    theta = jax.tree.map(jnp.asarray, TRUE)
    problem = loss.Problem(jf.log_score, kf, (start,), parameters(theta), jf.vector(1), lambda x: x)
    V = problem.parameters.start[None]

    def evaluated(logs, truth, spoil=None):
        case, _ = split.gathered(logs, truth, walk(theta), jf.log_score, jf.vector(1), np.float64)
        if spoil is not None:
            case.log.z["z"][spoil, 30] = np.nan
        return batches.Batches(problem, case)(V, 0, V)

    spoilt = evaluated(logs, truth, spoil=2)
    rest = evaluated(*jax.tree.map(lambda a: np.delete(a, 2, axis=0), (logs, truth)))
    assert spoilt.sound.sum() == RUNS - 1
    assert not spoilt.sound[0, 2]
    np.testing.assert_allclose(spoilt.gradient, rest.gradient, rtol=1e-10)
    np.testing.assert_allclose(spoilt.loss - loss.PENALTY / RUNS, rest.loss, rtol=1e-6)


def test_pieces_begin_where_the_parameters_at_the_start_of_their_epoch_say():
    from jaxfilt.tuning.descent import _anchor

    way = SimpleNamespace(origin="origin", path=[f"after {k + 1}" for k in range(9)])
    three = SimpleNamespace(each=3)
    found = [_anchor(way, three, step, f"at {step}") for step in range(8)]
    assert found == ["at 0", "origin", "origin", "at 3", "after 3", "after 3", "at 6", "after 6"]


def test_a_prior_holds_what_the_data_leave_open():
    logs, truth = runs()

    def prior(theta):
        return priors.log_normal(theta["p"][0], 3.0, 1.0001)

    fit = jf.tune(kf, start, WRONG, logs, truth, prior=prior, noise_estimate=False)
    assert float(fit.theta["p"][0]) == pytest.approx(math.log(3.0), abs=1e-3)


def test_the_same_twice_and_from_float32():
    logs, truth = runs()
    again = jf.tune(kf, start, WRONG, logs, truth, truth_theta=TRUE, frozen=("p",))
    np.testing.assert_array_equal(again.history.theta, fitted().history.theta)
    single = lambda tree: jax.tree.map(lambda a: jnp.asarray(a, jnp.float32) if a.dtype == np.float64 else a, tree)  # noqa: E731
    coarse = jf.tune(kf, start, single(WRONG), single(logs), single(truth), frozen=("p",))
    assert coarse.dtype == "float32"
    for name in ("q", "r"):
        np.testing.assert_allclose(coarse.theta[name], fitted().theta[name], atol=2e-2)


def test_a_run_that_diverges_at_the_start_harms_no_other_and_is_said():
    """Of a sensor with readings of 1e200 the squares are not finite."""
    logs, truth = runs()
    z = logs.z["z"].copy()
    z[2, 30] = 1e200
    fit = jf.tune(kf, start, WRONG, logs._replace(z={"z": z}), truth, frozen=("p",), noise_estimate=False)
    assert np.isfinite([p.value for p in fit.parameters]).all()
    assert any("1 runs of the training data diverge" in text for text in fit.findings)
    for name in ("q", "r"):
        assert abs(fit.theta[name] - TRUE[name]) < 0.5


def test_a_step_that_makes_filters_diverge_is_refused_and_said():
    """R is negative beyond a cliff next to the start, on the way to the optimum's other side."""

    def cliff(theta):
        model = walk(theta)
        z = model.sensors["z"]
        R = lambda x, c: jnp.where(theta["r"][0] > 3.0, -1e9, 1.0) * z.R(x, c)  # noqa: E731
        return jf.kf(model._replace(sensors={"z": z._replace(R=R)}))

    logs, truth = runs()
    begin = {"q": TRUE["q"], "r": jnp.array([2.9]), "p": TRUE["p"]}
    fit = jf.tune(
        cliff, start, begin, logs, truth, frozen=("p", "q"), optimizer=optax.sgd(-0.5), steps=6, noise_estimate=False
    )
    assert fit.history.refused.any()
    assert np.isfinite(fit.history.theta).all()
    assert (fit.history.theta <= 3.0).all()
    assert any("refused" in text for text in fit.findings)


BAD = {
    "no truth": (
        lambda logs, truth: {"truth": None, "objective": jf.log_score},
        "truth: the objective 'log_score' needs one",
    ),
    "short truth": (
        lambda logs, truth: {"truth": jax.tree.map(lambda a: a[:, :50], truth)},
        r"expected shape \(60,\), one for each row",
    ),
    "NaN truth": (
        lambda logs, truth: {"truth": truth._replace(x=np.full_like(truth.x, np.nan))},
        "run 0: truth.x: .*finite",
    ),
    "truths of other runs": (
        lambda logs, truth: {"truth": jax.tree.map(lambda a: a[:3], truth)},
        r"expected shape \(12, T\)",
    ),
    "indefinite Q": (
        lambda logs, truth: {"filter": lambda th: jf.kf(walk(th)._replace(Q=lambda x, u, dt: -jnp.eye(1)))},
        "theta: gives no covariance: Q",
    ),
    "unknown frozen": (lambda logs, truth: {"frozen": ("speed",)}, "frozen: expected some of"),
    "all frozen": (lambda logs, truth: {"frozen": ("q", "r", "p")}, "expected a free number, got none"),
    "split of nothing": (lambda logs, truth: {"split": jf.Split([0, 1], [1], [2])}, "each run in one part at most"),
    "split beyond": (lambda logs, truth: {"split": jf.Split([0, 1], [], [12])}, "numbers of runs from 0 to 11"),
    "split too much": (lambda logs, truth: {"split": jf.Split(0.8, 0.2, 0.2)}, "fractions >= 0 of sum 1"),
    "burn-in too long": (lambda logs, truth: {"burn_in": 1e3}, "expected rows in part 'train', got none"),
    "optimizer": (lambda logs, truth: {"optimizer": "no_such"}, "optimizer: expected lbfgs or the name"),
    "batch of lbfgs": (lambda logs, truth: {"batch": 3}, "batch: expected None with lbfgs"),
    "batch": (lambda logs, truth: {"batch": 99, "optimizer": "adam"}, "batch: expected 1 to 7 runs, got 99"),
    "clip": (lambda logs, truth: {"clip": {"speed": 1.0}, "optimizer": "adam"}, "clip: expected some of"),
    "beliefs": (
        lambda logs, truth: {"belief": [start, start]},
        "belief: expected one, or one for each of 12 logs, got 2",
    ),
    "steps": (lambda logs, truth: {"steps": 0}, "steps: expected at least 1"),
    "truth_theta": (
        lambda logs, truth: {"truth_theta": {"q": 1.0}, "steps": 1, "noise_estimate": False},
        "truth_theta: expected",
    ),
    "truth_std": (lambda logs, truth: {"truth_std": [-1.0]}, "truth_std: expected 1 positive numbers"),
    "theta": (lambda logs, truth: {"theta": WRONG | {"q": jnp.array([jnp.nan])}}, "theta: expected finite numbers"),
    "whole numbers": (lambda logs, truth: {"theta": WRONG | {"n": 3}, "frozen": ("n",)}, None),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(case):
    change, text = BAD[case]
    logs, truth = runs()
    options = {"filter": kf, "belief": start, "theta": WRONG, "logs": logs, "truth": truth} | change(logs, truth)
    if text is None:  # taken for a floating number, and left alone
        assert jf.tune(**options, steps=1, noise_estimate=False).theta["n"] == 3
        return
    with pytest.raises((ValueError, TypeError), match=text):
        jf.tune(**options)


def test_a_parameter_that_does_nothing_is_named():
    logs, truth = runs()
    with pytest.raises(Uninfluential, match=re.escape("got mark, which change nothing")) as caught:
        jf.tune(kf, start, WRONG | {"mark": 1.0}, logs, truth)
    assert caught.value.names == ("mark",)


def test_a_filter_that_diverges_everywhere_is_diagnosed():
    logs, truth = runs()
    logs = logs._replace(z={"z": np.full_like(logs.z["z"], 1e300)})
    with pytest.raises(ValueError, match="diverges on all of them"):
        jf.tune(kf, start, WRONG, logs, truth, frozen=("p",))
