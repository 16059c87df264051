"""The discrete Bayes filter against sums over all paths, the Kalman filter, and what it refuses; and the corridor."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt.models.corridor import corridor, corridor_scenario, corridor_start, landing_zone

POINTS = jnp.linspace(0.0, 20.0, 41)


def test_the_lectures_landing_zone():
    """P(home | bright) = 0.6 0.5 / (0.6 0.5 + 0.3 0.5) = 2/3; and each later sight counts."""
    zone = jf.grid(landing_zone(), jnp.array([0.0, 1.0]))
    cells, info = zone.update(zone.begin(jf.Cells(jnp.zeros(2))), jnp.asarray(1.0), "bright")
    np.testing.assert_allclose(jnp.exp(cells.log_probability), [1 / 3, 2 / 3], rtol=1e-12)
    np.testing.assert_allclose(jnp.exp(info.loglik), 0.45, rtol=1e-12)
    cells, info = zone.update(cells, jnp.asarray(0.0), "bright")
    p = np.array([1 / 3 * 0.7, 2 / 3 * 0.4])
    np.testing.assert_allclose(jnp.exp(cells.log_probability), p / p.sum(), rtol=1e-12)
    np.testing.assert_allclose(jnp.exp(info.loglik), p.sum(), rtol=1e-12)


def hidden_markov(model, prior, log):
    """The forward recursion in plain probabilities, with its own densities."""
    x, p, found, total = np.asarray(POINTS), prior / prior.sum(), [], []
    for k in range(len(log.dt)):
        if log.dt[k] > 0:
            ahead = x + float(log.u[k] * log.dt[k])
            T = np.exp(-0.5 * (x[:, None] - ahead[None, :]) ** 2 / (0.01 * float(log.dt[k])))
            p = (T / T.sum(0)) @ p
        loglik = 0.0
        if log.valid["door"][k]:
            seen = 0.05 + 0.85 * (1 - np.prod([1 - np.exp(-0.5 * ((x - d) / 0.4) ** 2) for d in (2, 5, 12)], axis=0))
            weight = p * (seen if log.z["door"][k] else 1 - seen)
            loglik, p = loglik + np.log(weight.sum()), weight / weight.sum()
        if log.valid["wall"][k]:
            density = np.exp(-0.5 * ((float(log.z["wall"][k]) - 20 + x) / 0.05) ** 2) / (0.05 * np.sqrt(2 * np.pi))
            weight = p * density
            loglik, p = loglik + np.log(weight.sum()), weight / weight.sum()
        found.append(p)
        total.append(loglik)
    return np.array(found), np.array(total)


def test_it_is_the_sum_over_all_paths():
    rng, steps = np.random.default_rng(3), 30
    model = corridor()
    log = jf.Log(
        jnp.asarray(np.where(rng.random(steps) < 0.2, 0.0, 0.5)),
        jnp.asarray(rng.normal(size=steps)),
        {"door": jnp.asarray(rng.integers(0, 2, steps) * 1.0), "wall": jnp.full(steps, 9.8)},
        {},
        {"door": jnp.asarray(rng.random(steps) < 0.8), "wall": jnp.asarray(np.arange(steps) == 25)},
    )
    filt = jf.grid(model, POINTS)
    prior = np.exp(-0.5 * ((np.asarray(POINTS) - 10) / 4) ** 2)
    track = jax.jit(lambda log: jf.scan(filt, filt.begin(corridor_start()), log))(log)
    want, loglik = hidden_markov(model, prior, log)
    np.testing.assert_allclose(np.exp(track.belief.log_probability), want, rtol=1e-8, atol=1e-14)
    np.testing.assert_allclose(track.info["door"].loglik + track.info["wall"].loglik, loglik, rtol=1e-8, atol=1e-12)


def test_a_fine_grid_is_the_kalman_filter():
    one = jnp.eye(1)
    walk = jf.linear(0.9 * one, one, 0.3 * one, 0.5 * one)
    start = jf.Gaussian(jnp.array([1.0]), 2.0 * one)
    log = jf.simulate(walk, start, jf.schedule(walk, 15, 1.0, every={"z": 2}), jax.random.key(1)).log
    filt = jf.grid(walk, jf.lattice(walk.space, np.linspace(-9.0, 9.0, 301)))
    got = jax.jit(lambda: jf.scan(filt, filt.begin(start), log, lambda b, info: (filt.gaussian(b), info)))()
    want = jf.scan(jf.kf(walk), start, log)
    np.testing.assert_allclose(got[0].mean, want.belief.mean, atol=1e-4)
    np.testing.assert_allclose(got[0].cov, want.belief.cov, atol=1e-4)
    for field in ("loglik", "nis", "S"):
        np.testing.assert_allclose(getattr(got[1]["z"], field), getattr(want.info["z"], field), atol=1e-3)


def test_transitions_of_ones_own():
    """A ring of three rooms: with T as given, and dt = 0 moves nothing."""
    T = jnp.array([[0.1, 0.2, 0.7], [0.6, 0.5, 0.1], [0.3, 0.3, 0.2]])
    zone = corridor()
    filt = jf.grid(zone, jnp.array([2.0, 8.0, 16.0]), lambda u, dt: T)
    p = np.array([0.5, 0.2, 0.3])
    cells = filt.begin(jf.Cells(jnp.log(jnp.asarray(p))))
    moved = filt.predict(cells, jnp.array(0.0), 1.0)
    np.testing.assert_allclose(jnp.exp(moved.log_probability), np.asarray(T) @ p, rtol=1e-12)
    np.testing.assert_allclose(filt.predict(cells, jnp.array(0.0), 0.0).log_probability, cells.log_probability)
    with pytest.raises(ValueError, match="each column of sum 1"):
        jf.grid(zone, jnp.array([2.0, 8.0, 16.0]), lambda u, dt: T.T).predict(cells, jnp.array(0.0), 1.0)


def test_a_robot_finds_itself_where_an_ekf_does_not():
    scene = corridor_scenario()
    model, start = scene.model(scene.theta), scene.belief(scene.theta)
    filt, plan = jf.grid(model, jnp.linspace(0.0, 20.0, 101)), scene.schedule(300)

    def one(key):
        truth, log = jf.simulate(model, start, plan, key, scene.control)
        at = [f(log)[-1] for f in (
            lambda log: jf.scan(filt, filt.begin(start), log, lambda b, i: filt.gaussian(b).mean),
            lambda log: jf.scan(jf.ekf(model), start, log, jf.mean_only),
        )]  # fmt: skip
        return jnp.abs(jnp.stack(at) - truth[-1]) < 1.0

    grid, ekf = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 24))).mean(0)
    assert grid > 0.9
    assert ekf < grid - 0.2


def test_float32_gradients_and_bad_news():
    filt = jf.grid(corridor(), POINTS.astype(jnp.float32))
    cells, info = filt.update(filt.begin(jf.Cells(jnp.zeros(41, jnp.float32))), jnp.float32(1.0), "door")
    assert cells.log_probability.dtype == info.loglik.dtype == np.float32
    filt = jf.grid(corridor(), POINTS)
    _, info = jax.jit(lambda z: filt.update(jf.Cells(jnp.zeros(41)), z, "door"))(jnp.asarray(np.nan))
    assert info.status == jf.Status.BAD_MEASUREMENT

    def loss(wall):
        from jaxfilt.models.corridor import CORRIDOR_ROBOT

        filt = jf.grid(corridor(CORRIDOR_ROBOT | {"wall": wall}), POINTS)
        return filt.update(filt.begin(corridor_start()), jnp.asarray(9.9), "wall")[1].loglik

    np.testing.assert_allclose(jax.grad(loss)(-1.0), (loss(-1 + 1e-6) - loss(-1 - 1e-6)) / 2e-6, rtol=1e-5)


@pytest.mark.parametrize(
    ("what", "error", "words"),
    [
        (lambda: jf.grid(corridor(), jnp.zeros(1)), ValueError, "points: expected at least two, got 1"),
        (lambda: jf.grid(corridor(), jnp.zeros((4, 2))), ValueError, "points"),
        (lambda: jf.lattice(jf.vector(2), np.zeros(3)), ValueError, "axes: expected 2"),
        (lambda: jf.grid(corridor(), POINTS).begin(jf.Cells(jnp.zeros(7))), ValueError, r"expected shape \(41,\)"),
    ],
)
def test_wrong_use(what, error, words):
    with pytest.raises(error, match=words):
        what()
