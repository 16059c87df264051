"""Studies whose answer is known: nominal rates, uniform p-values, mismatched filters by Lyapunov's equation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.stats

import jaxfilt as jf
from jaxfilt.study import study

A = np.array([[0.95, 0.2], [-0.1, 0.9]])
H = np.array([[1.0, 0.0]])
Q = np.array([[0.05, 0.02], [0.02, 0.1]])
R = np.array([[0.5]])
NOISE = np.block([[Q, np.zeros((2, 1))], [np.zeros((1, 2)), R]])
RIGHT = {
    "A": A,
    "q": np.array(0.0),
    "r": np.array(0.0),
    "mean": np.array([1.0, -1.0]),
    "cov": np.array([[1.0, 0.2], [0.2, 0.5]]),
}
"""q and r: logarithms of the factors on Q and R."""

BLOCKS = {"position": ((0,), "m"), "velocity": ((1,), "m/s")}
STEPS, REPEATED = 40, 200


def model(theta):
    noise = {"z": jnp.exp(theta["r"]) * R}
    return jf.linear(jnp.asarray(theta["A"]), {"z": jnp.asarray(H)}, jnp.exp(theta["q"]) * Q, noise)


def belief(theta):
    return jf.Gaussian(jnp.asarray(theta["mean"]), jnp.asarray(theta["cov"]))


FILTERS = {"kf": lambda theta: jf.kf(model(theta))}


def run(seed, runs=50, theta=RIGHT, confidence=0.999):
    """Runs on one model, filtered by another: all of this file is one compiled program."""
    log = jf.schedule(model(RIGHT), STEPS, 1.0)
    return study(
        model, FILTERS, belief, log, jax.random.key(seed), theta=theta, truth_theta=RIGHT, runs=runs, chunk=50,
        blocks=BLOCKS, confidence=confidence, workers=1, lags=3,
    )  # fmt: skip


def changed(**parts):
    return RIGHT | {name: np.asarray(part) for name, part in parts.items()}


# --- a filter on its own model ----------------------------------------------------------------------------------------


def p_values(studies):
    """name -> p of each study."""
    scores = [s.scores["kf"] for s in studies]
    found = {f"NEES of {block}": [s.nees_total[block].p for s in scores] for block in ("state", *BLOCKS)}
    found |= {f"NEES of the state at step {k}": [s.nees["state"].p[k] for s in scores] for k in (0, STEPS - 1)}
    found |= {f"mean error of {block}": [s.normalised_error.p[i] for s in scores] for i, block in enumerate(BLOCKS)}
    return found | {"NIS": [s.nis_total["z"].p for s in scores]}


@pytest.fixture(scope="module")
def repeated():
    return [run(seed, confidence=0.95) for seed in range(REPEATED)]


def test_p_values_over_repeated_studies_are_uniform(repeated):
    for name, p in p_values(repeated).items():
        assert scipy.stats.kstest(p, "uniform").pvalue > 1e-3, name


def test_p_values_of_a_wrong_filter_are_not():
    wrong = changed(q=np.log(0.25), mean=[2.0, 1.0])
    for name, p in p_values([run(seed, theta=wrong) for seed in range(40)]).items():
        assert scipy.stats.kstest(p, "uniform").pvalue < 1e-6, name


def test_a_filter_on_its_own_model_is_inside_its_bounds_at_the_nominal_rate(repeated):
    def inside(c):
        return (c.low <= c.mean) & (c.mean <= c.high)

    scores = [s.scores["kf"] for s in repeated]
    found = {f"NEES of {block}": [inside(s.nees_total[block]) for s in scores] for block in ("state", *BLOCKS)}
    found |= {f"NEES at step {k}": [inside(s.nees["state"])[k] for s in scores] for k in (0, 20, STEPS - 1)}
    found |= {"NIS": [inside(s.nis_total["z"]) for s in scores]}
    found |= {"mean error": [inside(s.normalised_error)[0] for s in scores]}
    found |= {"autocorrelation": [abs(w.autocorrelation[0]) < w.bound[0] for w in (s.whiteness["z"] for s in scores)]}
    found |= {"coverage of 50 %": [inside(s.coverage_total[0.5]) for s in scores]}
    for name, hits in found.items():
        assert scipy.stats.binomtest(int(np.sum(hits)), REPEATED, 0.95).pvalue > 1e-3, name


def test_the_bounds_are_those_of_the_textbooks():
    """Two states, 95 %: 50 runs and 100."""
    for runs, low, high in ((50, 1.48, 2.59), (100, 1.63, 2.41)):
        nees = run(0, runs, confidence=0.95).scores["kf"].nees["state"]
        np.testing.assert_allclose(nees.low, low, atol=0.005)
        np.testing.assert_allclose(nees.high, high, atol=0.005)


# --- a filter on another model: Lyapunov ------------------------------------------------------------------------------

WRONG = {
    "right": RIGHT,
    "Q / 2": changed(q=np.log(0.5)),
    "2 R": changed(r=np.log(2.0)),
    "start": changed(mean=[3.0, -0.5], cov=0.3 * RIGHT["cov"]),
    "A": changed(A=[[0.9, 0.1], [-0.05, 0.95]]),
    "all": changed(A=[[0.9, 0.2], [-0.1, 0.8]], q=np.log(0.4), r=np.log(1.5), mean=[0.0, 0.0]),
}


class Joint:
    """Truth and error together, ``y = (x, e)``, driven by the true noises: ``y' = F y + G w``.

    With the filter's gain K at each row, ``e' = (I - K H) ((A - A_f) x + A_f e + w) - K v``.
    """

    def __init__(self, theta):
        self.theta = theta
        self.P = np.array(theta["cov"])
        e = RIGHT["mean"] - theta["mean"]
        mean = np.concatenate([RIGHT["mean"], e])
        self.M = np.outer(mean, mean) + np.kron(np.ones((2, 2)), RIGHT["cov"])

    def step(self):
        """F, G W G' and P of the next row."""
        Af, Qf, Rf = self.theta["A"], np.exp(self.theta["q"]) * Q, np.exp(self.theta["r"]) * R
        P = Af @ self.P @ Af.T + Qf
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + Rf)
        T = np.eye(2) - K @ H
        self.P = T @ P
        F = np.block([[A, np.zeros((2, 2))], [T @ (A - Af), T @ Af]])
        G = np.block([[np.eye(2), np.zeros((2, 1))], [T, -K]])
        W = G @ NOISE @ G.T
        self.M = F @ self.M @ F.T + W
        return F, W, self.P

    def errors(self, steps):
        """Second moments (T, 4, 4), transitions (T, 4, 4) and claimed covariances (T, 2, 2)."""
        rows = [(*self.step(), self.M) for _ in range(steps)]
        return (np.stack([row[k] for row in rows]) for k in (3, 0, 2))


def variance_of_the_average(M, F, P):
    """Of the time average of ``e' P^-1 e`` over one run: ``cov(j, k) = 2 tr(P_k^-1 E[e_k e_j'] P_j^-1 E[e_j e_k'])``.

    That is for Gaussian errors of mean 0; with a mean it is less.
    """
    total, inverse = 0.0, np.linalg.inv(P)
    for j in range(len(M)):
        C = M[j]
        for k in range(j, len(M)):
            C = C if k == j else F[k] @ C
            e = C[2:, 2:]
            total += (1 if k == j else 2) * 2 * np.trace(inverse[k] @ e @ inverse[j] @ e.T)
    return total / len(M) ** 2


@pytest.mark.parametrize("name", WRONG)
def test_the_anees_of_a_mismatched_filter_is_that_of_lyapunov(name):
    """Each step within 4.5 standard errors of what the recursion says: one time in 3000 one of the 40 is not."""
    theta, runs = WRONG[name], 4000
    scores = run(1, runs, theta).scores["kf"]
    M, F, P = Joint(theta).errors(STEPS)
    second = M[:, 2:, 2:]
    for block, index in {"state": [0, 1], "position": [0], "velocity": [1]}.items():
        at = np.ix_(range(STEPS), index, index)
        ratio = np.linalg.solve(P[at], second[at])
        expected = np.trace(ratio, axis1=1, axis2=2)
        spread = np.sqrt(2 * np.trace(ratio @ ratio, axis1=1, axis2=2) / runs)
        assert (np.abs(scores.nees[block].mean - expected) < 4.5 * spread).all(), block
    error = np.sqrt(variance_of_the_average(M, F, P) / runs)
    expected = np.trace(np.linalg.solve(P, second), axis1=1, axis2=2).mean()
    assert abs(scores.nees_total["state"].mean - expected) < 4 * error
    np.testing.assert_allclose(scores.mse, second, atol=6 * np.max(second) / np.sqrt(runs))
    if name == "right":
        assert expected == pytest.approx(2.0)
    else:
        low, high = scores.nees_total["state"].low, scores.nees_total["state"].high
        assert not low < expected < high


@pytest.mark.parametrize("name", ["Q / 2", "2 R", "A", "all"])
def test_the_anees_settles_where_the_lyapunov_equation_says(name):
    theta, runs = WRONG[name], 4000
    Qf, Rf = np.exp(theta["q"]) * Q, np.exp(theta["r"]) * R
    predicted = scipy.linalg.solve_discrete_are(theta["A"].T, H.T, Qf, Rf)
    K = predicted @ H.T @ np.linalg.inv(H @ predicted @ H.T + Rf)
    T = np.eye(2) - K @ H
    F = np.block([[A, np.zeros((2, 2))], [T @ (A - theta["A"]), T @ theta["A"]]])
    G = np.block([[np.eye(2), np.zeros((2, 1))], [T, -K]])
    M = scipy.linalg.solve_discrete_lyapunov(F, G @ NOISE @ G.T)
    ratio = np.linalg.solve(T @ predicted, M[2:, 2:])
    found = run(1, runs, theta).scores["kf"].nees["state"]
    spread = np.sqrt(2 * np.trace(ratio @ ratio) / runs)
    assert abs(np.trace(ratio) - 2.0) > 5 * spread
    assert (np.abs(found.mean[-5:] - np.trace(ratio)) < 4.5 * spread).all()


# --- what the verdict says --------------------------------------------------------------------------------------------


def spoken(theta, runs=1000, seed=3):
    return run(seed, runs, theta).verdicts["kf"]


def test_the_right_filter_is_said_to_be_consistent():
    for seed in range(20):
        said = spoken(RIGHT, runs=100, seed=seed)
        assert said.consistent
        assert said.headline.startswith("kf consistent")


@pytest.mark.parametrize(
    ("theta", "kind", "block", "cause"),
    [
        (changed(q=np.log(0.5)), "overconfident", "velocity", "Q or R too small"),
        (changed(q=np.log(2.0)), "underconfident", "velocity", "Q or R too large"),
        (changed(r=np.log(0.5)), "overconfident", "position", "Q or R too small"),
        (changed(r=np.log(2.0)), "underconfident", "position", "Q or R too large"),
    ],
    ids=["Q / 2", "2 Q", "R / 2", "2 R"],
)
def test_noise_wrong_by_two_is_found_and_said(theta, kind, block, cause):
    """In the block that it spoils most, by as much as the recursion says."""
    said = spoken(theta)
    assert not said.consistent
    assert said.headline.startswith(f"kf {kind} in {block}: ANEES ")
    assert "x expected throughout" in said.headline
    M, _, P = Joint(theta).errors(STEPS)
    i = list(BLOCKS).index(block)
    assert said.findings[0].ratio == pytest.approx((M[:, 2 + i, 2 + i] / P[:, i, i]).mean(), rel=0.05)
    assert {f.kind for f in said.findings} <= {kind, "inconsistent innovations", "correlated", "cause"}
    assert any(cause in f.text for f in said.findings)


def test_a_wrong_start_is_found_and_said_to_be_over():
    said = spoken(WRONG["start"])
    assert not said.consistent
    assert said.headline.startswith("kf overconfident in position: ANEES ")
    assert "x expected up to step" in said.headline
    assert "biased in position" in said.headline
