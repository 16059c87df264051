"""A filter that carries something other than a Gaussian goes wherever a Kalman filter goes, with the same scores."""

from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from systems import car_system

import jaxfilt as jf
from jaxfilt.prediction import stepper

S = car_system(60)
BLOCKS = {"position": ((0, 1), "m")}
LOG = jf.schedule(S.model(S.theta), 50, 0.1, every={"mark": 3}, u=S.log.u[:50], c={"mark": S.log.c["mark"][:50]})


class Wrapped(NamedTuple):
    """A Gaussian, the way other filters carry theirs: with a key, and in another order."""

    key: Any
    cov: Any
    mean: Any


def wrapped(model, spread=0.0):
    """The EKF, which carries a `Wrapped`, and moves its first mean at random by ``spread``."""
    inner = jf.ekf(model)

    def out(w):
        return jf.Gaussian(w.mean, w.cov)

    def begin(belief, key=None):
        if isinstance(belief, Wrapped):
            return Wrapped(belief.key, *out(inner.begin(out(belief)))[::-1])
        if key is None:
            raise ValueError("key: expected a key to draw with, got None")
        belief = inner.begin(belief)
        moved = model.space.plus(belief.mean, spread * jax.random.normal(key, (model.space.dim,), belief.cov.dtype))
        return Wrapped(key, belief.cov, moved)

    def predict(w, u=(), dt=0.0):
        return Wrapped(w.key, *inner.predict(out(w), u, dt)[::-1])

    def update(w, z, sensor, c=(), mask=None):
        belief, info = inner.update(out(w), z, sensor, c, mask)
        return Wrapped(w.key, *belief[::-1]), info

    return jf.Filter(predict, update, stepper(model, predict, update), model, begin, out)


def filters(spread=0.0):
    return {"ekf": lambda th: jf.ekf(S.model(th)), "wrapped": lambda th: wrapped(S.model(th), spread)}


def same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-14)


def test_a_scan_and_a_likelihood():
    filt, kalman = wrapped(S.model(S.theta)), jf.ekf(S.model(S.theta))
    begun = filt.begin(S.belief, jax.random.key(0))
    track, want = jf.scan(filt, begun, S.log), jf.scan(kalman, S.belief, S.log)
    assert isinstance(track.belief, Wrapped)
    same((track.belief.mean, track.belief.cov, track.info), (want.belief.mean, want.belief.cov, want.info))
    same(jf.log_likelihood(filt, begun, S.log), jf.log_likelihood(kalman, S.belief, S.log))
    with pytest.raises(ValueError, match="key: expected a key to draw with"):
        jf.scan(filt, S.belief, S.log)


@pytest.mark.parametrize("each", [True, False], ids=["each its own", "shared"])
def test_many_runs(each):
    filt = wrapped(S.model(S.theta), spread=0.1)
    keys = jax.random.split(jax.random.key(1), 3)
    logs = jax.tree.map(lambda a: np.stack([a] * 3), S.log)
    logs = logs._replace(dt=logs.dt * np.array([[1.0], [0.5], [2.0]]))
    begun = jax.vmap(lambda key: filt.begin(S.belief, key))(keys)
    one = [jax.tree.map(lambda a, i=i: a[i], begun) for i in range(3)]
    tracks = jf.scan_runs(filt, begun if each else one[0], logs, backend="xla")
    for i in range(3):
        want = jf.scan(filt, one[i if each else 0], jax.tree.map(lambda a, i=i: a[i], logs))
        got = jax.tree.map(lambda a, i=i: a[i], tracks)
        same((got.belief.mean, got.belief.cov, got.info), (want.belief.mean, want.belief.cov, want.info))


def studied(spread, **options):
    key = jax.random.key(3)
    options = {"theta": S.theta, "runs": 60, "blocks": BLOCKS, "examples": 2} | options
    return jf.study(S.model, filters(spread), lambda th: S.belief, LOG, key, **options)


def test_a_study_scores_it_as_it_scores_a_gaussian():
    found = studied(0.0)
    for name in ("rmse_total", "nees_total"):
        same(getattr(found.scores["wrapped"], name), getattr(found.scores["ekf"], name))
    same(found.tracks["wrapped"], found.tracks["ekf"])


def test_each_run_of_a_study_draws_for_itself_whatever_the_chunk():
    """A start moved at random by far too much: the first NEES says so, and not by one common move."""
    whole, pieces = studied(2.0), studied(2.0, chunk=20)
    first = whole.tracks["wrapped"].mean.pos[:, 0] - whole.tracks["ekf"].mean.pos[:, 0]
    assert np.abs(first[0] - first[1]).max() > 1e-3
    same(whole.scores["wrapped"].nees_total, pieces.scores["wrapped"].nees_total)
    assert whole.scores["wrapped"].nees_total["state"].mean > 1.5 * whole.scores["ekf"].nees_total["state"].mean


def test_a_replay_scores_it_and_takes_a_key():
    truth, log = jf.simulate(S.model(S.theta), S.belief, LOG, jax.random.key(5))
    recording = jf.Recording(jax.tree.map(np.asarray, log), np.cumsum(log.dt))
    replay = jf.Replay(
        S.model, lambda th: S.belief, S.theta, recording, jf.Truth(truth, np.full(50, True)),
        S.model(S.theta).space, lambda x: x, BLOCKS,
    )  # fmt: skip
    reviews = jf.replayed(replay, filters(), key=jax.random.key(0)).reviews
    same(reviews["wrapped"].rmse, reviews["ekf"].rmse)
    same(reviews["wrapped"].nees, reviews["ekf"].nees)
    with pytest.raises(ValueError, match="key: expected a key"):
        jf.replayed(replay, filters())


@pytest.mark.parametrize("objective", [jf.log_score, jf.likelihood, jf.mse(), jf.held_back("gnss", every=2)])
def test_an_objective_and_its_gradient(objective):
    truth, log = jf.simulate(S.model(S.theta), S.belief, LOG, jax.random.key(5))
    truth = jf.Truth(truth, np.full(50, True))

    def loss(make, theta, belief):
        return objective(make(theta), belief, log, truth)

    ekf, other = filters().values()
    want = jax.value_and_grad(lambda th: loss(ekf, th, S.belief))(S.theta)
    got = jax.value_and_grad(lambda th: loss(other, th, other(th).begin(S.belief, jax.random.key(0))))(S.theta)
    same(got, want)
