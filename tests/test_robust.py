"""The robust update: Huber's weight against a plain NumPy loop, its bounded pull, its gradients, its likelihood."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxfilt as jf

A = np.array([[1.0, 0.5], [0.0, 0.9]])
H = np.array([[1.0, 0.0], [0.3, 1.0], [0.0, 0.5]])
Q = np.diag([0.1, 0.2])
R = np.diag([0.5, 0.3, 0.4])
PROBABILITY = 0.9


def model(scale=1.0):
    return jf.linear(A=jnp.asarray(A), H=jnp.asarray(H), Q=jnp.asarray(Q), R=scale * jnp.asarray(R))


def start(spread=1.0):
    return jf.Gaussian(jnp.array([1.0, -1.0]), spread * jnp.eye(2))


def log_of(z, valid=None):
    return jf.Log(jnp.ones(len(z)), (), {"z": jnp.asarray(z)}, {}, {} if valid is None else {"z": jnp.asarray(valid)})


def readings(steps=40, seed=0, share=0.2):
    rng = np.random.default_rng(seed)
    x, z = np.array([1.0, -1.0]), []
    for _ in range(steps):
        x = A @ x + np.sqrt(np.diag(Q)) * rng.normal(size=2)
        scale = 15.0 if rng.random() < share else 1.0
        z.append(H @ x + scale * np.sqrt(np.diag(R)) * rng.normal(size=3))
    return np.array(z)


def by_hand(z, probability=PROBABILITY):
    """The textbook's standard form, S widened where the reading is far off; no line shared with the library."""
    x, P, out = np.array([1.0, -1.0]), np.eye(2), []
    limit = stats.chi2.ppf(probability, 3)
    for reading in z:
        x, P = A @ x, A @ P @ A.T + Q
        r, S = reading - H @ x, H @ P @ H.T + R
        nis = r @ np.linalg.inv(S) @ r
        widened = S * max(1.0, np.sqrt(nis / limit))
        loss = 0.5 * nis if nis <= limit else np.sqrt(limit * nis) - 0.5 * limit
        loglik = -loss - 0.5 * np.log(np.linalg.det(2 * np.pi * S))
        K = P @ H.T @ np.linalg.inv(widened)
        x, P = x + K @ r, P - K @ widened @ K.T
        out.append((x, P, nis, loglik))
    return [np.array(column) for column in zip(*out, strict=True)]


@pytest.mark.parametrize("build", [jf.kf, jf.ukf, jf.ckf, lambda m, robust: jf.iekf(m, 3, robust=robust)])
def test_equals_a_plain_loop(build):
    z = readings()
    track = jf.scan(build(model(), robust=PROBABILITY), start(), log_of(z))
    x, P, nis, loglik = by_hand(z)
    assert (nis > stats.chi2.ppf(PROBABILITY, 3)).sum() > 5, "the log should hold outliers"
    np.testing.assert_allclose(track.belief.mean, x, atol=1e-11)
    np.testing.assert_allclose(track.belief.cov, P, atol=1e-11)
    np.testing.assert_allclose(track.info["z"].nis, nis, rtol=1e-10)
    np.testing.assert_allclose(track.info["z"].loglik, loglik, rtol=1e-10)
    np.testing.assert_allclose(track.info["z"].ratio, nis / stats.chi2.ppf(PROBABILITY, 3), rtol=1e-9)
    assert (track.info["z"].dof == 3).all()
    assert (track.info["z"].status == jf.Status.OK).all()


def test_is_the_plain_filter_where_nothing_is_far_off():
    z = readings(share=0.0)
    plain, robust = (jf.scan(jf.ekf(model(), robust=p), start(), log_of(z)) for p in (None, 1 - 1e-12))
    np.testing.assert_allclose(robust.belief.cov, plain.belief.cov, atol=1e-13)
    np.testing.assert_allclose(robust.belief.mean, plain.belief.mean, atol=1e-13)
    np.testing.assert_allclose(robust.info["z"].loglik, plain.info["z"].loglik, rtol=1e-12)


@pytest.mark.parametrize("far", [1e2, 1e5, 1e8])
def test_no_outlier_pulls_further_than_the_quantile(far):
    belief = start()
    moved, _ = jf.ekf(model(), robust=PROBABILITY).update(belief, jnp.array([far, 0.0, 0.0]), "z")
    d = np.asarray(moved.mean - belief.mean)
    pull = np.sqrt(d @ np.linalg.inv(np.asarray(belief.cov)) @ d)
    assert 0.1 < pull <= np.sqrt(stats.chi2.ppf(PROBABILITY, 3))
    plain, _ = jf.ekf(model()).update(belief, jnp.array([far, 0.0, 0.0]), "z")
    assert np.abs(plain.mean - belief.mean).max() > 0.1 * far


def test_missing_components_have_the_quantile_of_those_that_came():
    belief, z = start(), jnp.array([9.0, 123.0, 4.0])
    moved, info = jf.ekf(model(), robust=PROBABILITY).update(belief, z, "z", mask=jnp.array([True, False, True]))
    rows = np.array([0, 2])
    two = jf.linear(A=jnp.asarray(A), H=jnp.asarray(H[rows]), Q=jnp.asarray(Q), R=jnp.asarray(R[np.ix_(rows, rows)]))
    same, reported = jf.ekf(two, robust=PROBABILITY).update(belief, z[rows], "z")
    np.testing.assert_allclose(moved.mean, same.mean, rtol=1e-12)
    np.testing.assert_allclose(moved.cov, same.cov, rtol=1e-12)
    np.testing.assert_allclose([info.ratio, info.loglik], [reported.ratio, reported.loglik], rtol=1e-12)


def test_a_gate_refuses_what_is_further_still():
    filt = jf.ekf(model(), gate=0.9999, robust=0.9)
    near, middle, far = (filt.update(start(), jnp.array([a, 0.0, 0.0]), "z") for a in (1.0, 4.0, 100.0))
    assert [int(i.status) for _, i in (near, middle, far)] == [jf.Status.OK, jf.Status.OK, jf.Status.GATED]
    assert float(middle[1].nis) > stats.chi2.ppf(0.9, 3)
    np.testing.assert_array_equal(far[0].mean, start().mean)
    np.testing.assert_allclose(far[1].ratio, far[1].nis / stats.chi2.ppf(0.9999, 3), rtol=1e-9)


def test_by_sensor():
    filt = jf.ekf(model(), robust={"z": 0.9})
    _, info = filt.update(start(), jnp.array([100.0, 0.0, 0.0]), "z")
    assert info.ratio > 1


def test_gradients_agree_with_differences():
    log = log_of(readings())

    def loss(log_scale):
        filt = jf.ekf(model(jnp.exp(log_scale)), robust=PROBABILITY)
        track = jf.scan(filt, start(), log)
        return -track.info["z"].loglik.sum() + (track.belief.mean**2).sum() + track.belief.cov.sum()

    for at in (0.0, 0.7):
        step = 1e-5
        difference = (loss(at + step) - loss(at - step)) / (2 * step)
        np.testing.assert_allclose(jax.grad(loss)(at), difference, rtol=1e-6)
        np.testing.assert_allclose(jax.jacfwd(loss)(at), difference, rtol=1e-6)


def test_the_gradient_is_finite_at_a_perfect_prediction():
    def moved(z):
        belief, info = jf.ekf(model(), robust=PROBABILITY).update(start(), z, "z")
        return belief.mean.sum() + belief.cov.sum() + info.loglik

    perfect = jnp.asarray(H) @ start().mean
    assert jnp.isfinite(jax.grad(moved)(perfect)).all()


def test_outliers_spoil_the_plain_filter_and_not_the_robust_one():
    drive = model()
    spoil = jf.mismatch.outliers(drive, "z", probability=0.2, scale=15.0)
    truth, clean = jf.simulate(drive, start(), jf.schedule(drive, 400, 1.0), jax.random.key(3))
    log = spoil(truth, clean, jax.random.key(4))
    rmse = {}
    for name, p in {"plain": None, "robust": 0.95}.items():
        track = jf.scan(jf.ekf(drive, robust=p), start(), log)
        rmse[name] = float(np.sqrt(np.mean((np.asarray(track.belief.mean) - np.asarray(truth)) ** 2)))
    assert rmse["robust"] < 0.5 * rmse["plain"]


@pytest.mark.parametrize(
    ("value", "error", "words"),
    [
        (1.5, ValueError, "robust: expected a probability between 0 and 1 for 'z', got 1.5"),
        ({"gps": 0.9}, KeyError, "robust: expected sensors of"),
        ("0.9", TypeError, "robust: expected a probability for 'z', got str '0.9'"),
    ],
)
def test_wrong_use_raises(value, error, words):
    with pytest.raises(error, match=words):
        jf.ekf(model(), robust=value)


@pytest.mark.parametrize("backend", ["xla", "lanes"])
def test_batches_agree_with_single_runs(backend):
    logs = [log_of(readings(seed=k)) for k in range(5)]
    batch = jf.stack([jax.tree.map(np.asarray, log) for log in logs])
    run = jax.jit(lambda log: jf.scan_runs(jf.ekf(model(), robust=PROBABILITY), start(), log, backend=backend))
    tracks = run(batch)
    for k, log in enumerate(logs):
        alone = jf.scan(jf.ekf(model(), robust=PROBABILITY), start(), log)
        np.testing.assert_allclose(tracks.belief.mean[k], alone.belief.mean, atol=1e-11)
