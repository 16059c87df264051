"""Interacting multiple models against a loop in NumPy from the book, and on a target that turns now and then."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import car_system

import jaxfilt as jf
from jaxfilt.imm import Modes, imm
from jaxfilt.particle import particle

DT, STEPS = 1.0, 80
F = np.kron(np.eye(2), np.array([[1.0, DT], [0.0, 1.0]]))
G = np.kron(np.eye(2), np.array([[DT**2 / 2], [DT]]))
H, R = np.kron(np.eye(2), np.array([[1.0, 0.0]])), 100.0 * np.eye(2)
CALM, WILD = 0.01 * G @ G.T, 25.0 * G @ G.T
T = np.array([[0.95, 0.05], [0.1, 0.9]])
START = jf.Gaussian(jnp.array([0.0, 50.0, 0.0, 0.0]), jnp.diag(jnp.array([100.0, 4.0, 100.0, 4.0])))


def of(Q):
    return jf.kf(jf.linear(*(jnp.asarray(a) for a in (F, H, Q, R))))


BANK = imm([of(CALM), of(WILD)], jnp.asarray(T))


def manoeuvring(seed):
    """Straight on, but for two stretches of 10 s at up to 0.6 g to the side."""
    rng = np.random.default_rng(seed)
    x, truth = np.array(START.mean) + np.sqrt(np.diag(START.cov)) * rng.normal(size=4), []
    for k in range(STEPS):
        push = 6.0 * (20 <= k < 30) - 6.0 * (50 <= k < 60)
        x = F @ x + G @ np.array([0.0, push])
        truth.append(x)
    truth = np.array(truth)
    return truth, truth @ H.T + 10.0 * rng.normal(size=(STEPS, 2))


def log_of(z):
    return jf.Log(jnp.full(len(z), DT), (), {"z": jnp.asarray(z)}, {}, {})


def book(z):
    """Mixing, filtering, mode probabilities, combination: written out, and in probabilities, not in logarithms."""
    x, P = [np.array(START.mean)] * 2, [np.array(START.cov)] * 2
    mu, means, covs, modes, loglik = np.array([0.5, 0.5]), [], [], [], []
    for reading in z:
        c = T.T @ mu
        mixed = []
        for j in range(2):
            w = T[:, j] * mu / c[j]
            m = w[0] * x[0] + w[1] * x[1]
            mixed.append((m, sum(w[i] * (P[i] + np.outer(x[i] - m, x[i] - m)) for i in range(2))))
        likelihood = np.zeros(2)
        for j, Q in enumerate((CALM, WILD)):
            m, V = F @ mixed[j][0], F @ mixed[j][1] @ F.T + Q
            S, r = H @ V @ H.T + R, reading - H @ m
            K = V @ H.T @ np.linalg.inv(S)
            x[j], P[j] = m + K @ r, V - K @ S @ K.T
            likelihood[j] = np.exp(-0.5 * r @ np.linalg.solve(S, r)) / np.sqrt(np.linalg.det(2 * np.pi * S))
        loglik.append(np.log(c @ likelihood))
        mu = c * likelihood / (c @ likelihood)
        m = mu[0] * x[0] + mu[1] * x[1]
        means.append(m)
        covs.append(sum(mu[i] * (P[i] + np.outer(x[i] - m, x[i] - m)) for i in range(2)))
        modes.append(mu)
    return np.array(means), np.array(covs), np.array(modes), np.array(loglik)


def tracked(filt, log, belief=START):
    return jf.scan(filt, filt.begin(belief), log, lambda b, info: (filt.gaussian(b), b, info))


def test_it_is_the_book():
    _, z = manoeuvring(1)
    belief, modes, info = tracked(BANK, log_of(z))
    means, covs, mu, loglik = book(z)
    np.testing.assert_allclose(belief.mean, means, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(belief.cov, covs, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(np.exp(modes.log_probability), mu, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(info["z"].loglik, loglik, rtol=1e-9)


def test_modes_that_are_alike_are_one_filter():
    """On the car too, with its wrapped yaw, its missing readings and rows of dt = 0."""
    s = car_system(20)
    one = jf.ekf(s.model(s.theta))
    belief, _, info = tracked(imm([one, one], jnp.asarray(T), jnp.array([0.3, 0.7])), s.log, s.belief)
    want = jf.scan(one, s.belief, s.log)
    for a, b in zip(jax.tree.leaves(belief), jax.tree.leaves(want.belief), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)
    for name in info:
        np.testing.assert_allclose(info[name].loglik, want.info[name].loglik, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(info[name].nis, want.info[name].nis, rtol=1e-8, atol=1e-12)
        np.testing.assert_array_equal(info[name].status, want.info[name].status)


def test_a_manoeuvring_target():
    """Better than either filter alone: calm where nothing happens, quick where something does; and it knows which."""
    runs = [manoeuvring(seed) for seed in range(60)]
    truth, z = (np.stack(a) for a in zip(*runs, strict=True))
    logs = log_of(z[0])._replace(z={"z": jnp.asarray(z)})
    error, nees = {}, {}
    for name, filt in {"imm": BANK, "calm": of(CALM), "wild": of(WILD)}.items():
        store = lambda b, info, filt=filt: filt.gaussian(b)  # noqa: E731
        belief = jf.scan_runs(filt, filt.begin(START), logs, batched=("z",), store=store)
        e = np.asarray(belief.mean) - truth
        error[name] = np.sqrt(np.mean(e[..., [0, 2]] ** 2))
        nees[name] = np.mean(np.einsum("rti,rtij,rtj->rt", e, np.linalg.inv(belief.cov), e)) / 4
    assert error["imm"] < 0.96 * error["wild"] < error["calm"]
    assert nees["calm"] > 10
    assert 0.3 < nees["imm"] < 1.6
    modes = jf.scan_runs(BANK, BANK.begin(START), logs, batched=("z",)).belief
    turning = np.exp(modes.log_probability[:, :, 1]).mean(0)
    assert turning[24:30].min() > 0.7
    assert turning[10:19].max() < 0.35


def test_gradients_equal_differences():
    _, z = manoeuvring(2)
    log = log_of(z[:40])

    def loss(q):
        filt = imm(
            [of(CALM), jf.kf(jf.linear(jnp.asarray(F), jnp.asarray(H), q * WILD, jnp.asarray(R)))], jnp.asarray(T)
        )
        return jf.log_likelihood(filt, filt.begin(START), log)

    slope = jax.jit(jax.grad(loss))(1.3)
    np.testing.assert_allclose(slope, (loss(1.3 + 1e-5) - loss(1.3 - 1e-5)) / 2e-5, rtol=1e-5)


def test_float32_and_bad_news():
    cast = lambda tree: jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), tree)  # noqa: E731
    bank = imm([jf.kf(jf.linear(*cast((F, H, Q, R)))) for Q in (CALM, WILD)], T)
    belief, modes, info = tracked(bank, cast(log_of(manoeuvring(3)[1])), cast(START))
    assert {leaf.dtype for leaf in jax.tree.leaves((belief, modes))} == {jnp.dtype("float32")}
    assert np.isfinite(info["z"].loglik).all()
    _, bad = jax.jit(lambda b, z: BANK.update(b, z, "z"))(BANK.begin(START), jnp.array([np.nan, 0.0]))
    assert bad.status == jf.Status.BAD_MEASUREMENT


@pytest.mark.parametrize(
    ("what", "error", "words"),
    [
        (lambda: imm([of(CALM)], jnp.eye(1)), ValueError, "filters: expected at least two"),
        (lambda: imm([of(CALM), of(WILD)], jnp.eye(3)), ValueError, r"transition: expected shape \(2, 2\)"),
        (lambda: imm([of(CALM), of(WILD)], 0.4 * jnp.ones((2, 2))), ValueError, "transition: expected probabilities"),
        (lambda: imm([of(CALM), of(WILD)], jnp.eye(2), jnp.array([0.2, 0.2])), ValueError, "probability: expected"),
        (lambda: imm([of(CALM), particle(of(CALM).model)], jnp.eye(2)), TypeError, "expected Kalman filters"),
        (
            lambda: imm([of(CALM), jf.kf(jf.linear(*[jnp.eye(1)] * 4))], jnp.eye(2)),
            ValueError,
            "filters: expected one state space",
        ),
        (lambda: BANK.begin(Modes(START, jnp.zeros(3))), ValueError, r"log_probability: expected shape \(2,\)"),
    ],
)
def test_wrong_use(what, error, words):
    with pytest.raises(error, match=words):
        what()
