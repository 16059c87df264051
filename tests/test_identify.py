"""Standard errors and flat directions: against dense Gaussians, closed forms, and the spread of many estimates."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.signal import lfilter

import jaxfilt as jf
from jaxfilt.fold import fold
from jaxfilt.models import car
from jaxfilt.noise import log_cholesky
from jaxfilt.objectives import likelihood, log_score, mse
from jaxfilt.tuning import curvature, identify
from jaxfilt.tuning.curvature import Hessian
from jaxfilt.tuning.identify import Effects
from jaxfilt.tuning.parameters import parameters

OBJECTIVES = {"likelihood": likelihood, "log_score": log_score, "mse": mse(1.0)}


def local_level(theta):
    """A level that walks, read with noise: logarithms of two standard deviations."""
    one = jnp.ones((1, 1), theta.dtype)
    return jf.linear(A=one, H=one, Q=jnp.exp(2 * theta[0]) * one, R=jnp.exp(2 * theta[1]) * one)


def known_start(theta):
    return jf.Gaussian(jnp.zeros(1, theta.dtype), jnp.ones((1, 1), theta.dtype))


def free_start(theta):
    return jf.Gaussian(jnp.zeros(1, theta.dtype), jnp.exp(2 * theta[2]) * jnp.ones((1, 1), theta.dtype))


def walks(runs, steps, q, r, seed=0):
    """Truth and readings (runs, steps, 1) of the local level."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(runs, 1)) + np.cumsum(q * rng.normal(size=(runs, steps)), axis=1)
    return x[..., None], (x + r * rng.normal(size=(runs, steps)))[..., None]


def run_sums(objective, belief, theta, x, z):
    """The objective's sums of one run of the local level, in the precision of theta."""
    model, T = local_level(theta), len(z)
    log = jf.Log(jnp.ones(T, theta.dtype), (), {"z": z}, {}, {})
    truth = jf.Truth(x, jnp.ones(T, bool))
    return fold(objective, jf.kf(model), belief(theta), log, truth, jnp.ones(T, bool), model.space)


@functools.cache
def compiled(name, belief=known_start):
    """Function of (theta, x (R, T, 1), z (R, T, 1)): the loss, its gradient and the sums of each run."""
    objective = OBJECTIVES[name]

    def loss(theta, x, z):
        sums = jax.vmap(lambda x, z: run_sums(objective, belief, theta, x, z))(x, z)
        return objective.loss(jax.tree.map(lambda s: s.sum(0), sums)), sums

    def everything(theta, x, z):
        (value, sums), gradient = jax.value_and_grad(loss, has_aux=True)(theta, x, z)
        return value, gradient, sums

    return jax.jit(everything)


def fisher(theta, steps):
    """Of one series, from its dense covariance S: ``1/2 tr(S^-1 dS_i S^-1 dS_j)``."""
    q, r = np.exp(2 * np.asarray(theta))
    k = np.arange(1, steps + 1)
    walk = np.minimum.outer(k, k).astype(float)
    precision = np.linalg.inv(1.0 + q * walk + r * np.eye(steps))
    parts = [precision @ (2 * q * walk), precision @ (2 * r * np.eye(steps))]
    return np.array([[0.5 * np.trace(a @ b) for b in parts] for a in parts])


TRUE, STEPS, SERIES = np.log([1.0, 1.0]), 300, 200


@functools.cache
def series():
    return walks(SERIES, STEPS, *np.exp(TRUE))


@functools.cache
def few():
    """Short ones, of a level that moves so slowly that errors stay for ten rows."""
    return walks(16, 60, *np.exp(SLOW), seed=1)


SLOW = np.log([0.1, 1.0])


@pytest.mark.long
def test_the_spread_of_200_estimates_is_that_of_the_cramer_rao_bound():
    x, z = series()
    one = jax.jit(jax.vmap(lambda v, x, z: compiled("likelihood")(v, x[None], z[None])[1]))
    per_row = np.linalg.inv(fisher(TRUE, STEPS) / STEPS)
    V = np.tile(TRUE, (SERIES, 1))
    for _ in range(100):  # scoring
        V = V - np.clip(np.asarray(one(V, x, z)) @ per_row, -0.3, 0.3)
    assert np.abs(one(V, x, z)).max() < 1e-6
    bound = np.sqrt(np.diag(np.linalg.inv(fisher(TRUE, STEPS))))
    np.testing.assert_allclose(V.std(0, ddof=1), bound, rtol=0.15)
    assert (np.abs(V.mean(0) - TRUE) < 4 * bound / SERIES**0.5).all()
    said = []
    for k in range(20):
        H = curvature.hessian(lambda v, k=k: one(np.tile(v, (SERIES, 1)), x, z)[k], V[k])
        said.append(curvature.standard_errors(H, count=STEPS))
    np.testing.assert_allclose(np.mean(said, axis=0), bound, rtol=0.1)


def minimum(objective, x, z, start):
    def both(v):
        value, gradient, _ = compiled(objective)(v, x, z)
        return float(value), np.asarray(gradient)

    return minimize(both, start, jac=True, options={"gtol": 1e-9}).x


def bent(objective, x, z, at, belief=known_start):
    """Hessian and influence of each run."""
    everything = compiled(objective, belief)
    H, slopes = curvature.hessian_and_slopes(lambda v: everything(v, x, z)[1:], at)
    return H, curvature.influence(OBJECTIVES[objective].loss, everything(at, x, z)[2], slopes)


def dense_surprise(theta, z):
    """Minus the log density of one series (T,), a reading, by its dense covariance."""
    k = jnp.arange(1.0, len(z) + 1)
    S = 1 + jnp.exp(2 * theta[0]) * jnp.minimum(k[:, None], k[None, :]) + jnp.exp(2 * theta[1]) * jnp.eye(len(z))
    return -jnp.asarray(jax.scipy.stats.multivariate_normal.logpdf(z, jnp.zeros(len(z)), S)) / len(z)


def test_differences_of_gradients_are_the_hessian_also_in_float32():
    x, z = few()
    H = curvature.hessian(lambda v: compiled("likelihood")(v, x, z)[1], TRUE)
    exact = np.asarray(jax.jit(jax.hessian(lambda v: jax.vmap(dense_surprise, (None, 0))(v, z[..., 0]).mean()))(TRUE))
    np.testing.assert_allclose(H.matrix, exact, rtol=1e-6)
    assert (np.abs(H.matrix - exact) <= 3 * H.noise + 1e-9).all()
    x, z, at = (a.astype(np.float32) for a in (x, z, TRUE))
    single = curvature.hessian(lambda v: compiled("likelihood")(v, x, z)[1], at)
    np.testing.assert_allclose(single.matrix, exact, atol=2e-3 * np.abs(exact).max())
    assert (np.abs(single.matrix - exact) <= 3 * single.noise + 1e-4 * np.abs(exact).max()).all()


def test_of_a_true_model_likelihood_dense_gaussian_and_sandwich_agree():
    x, z = series()
    at = minimum("likelihood", x, z, TRUE)
    H, psi = bent("likelihood", x, z, at)
    by_hessian = curvature.standard_errors(H, count=SERIES * STEPS)
    bound = np.sqrt(np.diag(np.linalg.inv(SERIES * fisher(TRUE, STEPS))))
    np.testing.assert_allclose(by_hessian, bound, rtol=0.05)
    # Four standard errors of a standard deviation from 200 runs.
    np.testing.assert_allclose(curvature.standard_errors(H, influence=psi), by_hessian, rtol=0.2)


@pytest.mark.long
def test_the_sandwich_knows_that_errors_are_correlated_in_time_and_the_hessian_does_not():
    sets, (runs, steps, _) = 100, few()[0].shape
    x, z = walks(runs * sets, steps, *np.exp(SLOW), seed=2)
    found, sandwich, naive = [], [], []
    for k in range(sets):
        own = slice(k * runs, (k + 1) * runs)
        at = minimum("log_score", x[own], z[own], SLOW)
        H, psi = bent("log_score", x[own], z[own], at)
        found.append(at)
        sandwich.append(curvature.standard_errors(H, influence=psi))
        naive.append(curvature.standard_errors(H, count=runs * steps))
    spread = np.std(found, axis=0, ddof=1)
    np.testing.assert_allclose(np.median(sandwich, axis=0), spread, rtol=0.25)
    assert (np.median(naive, axis=0) < 0.6 * spread).all()


def test_of_one_long_run_blocks_of_time_stand_for_runs():
    phi, T = 0.9, 40_000
    x = np.asarray(lfilter([1.0], [1.0, -phi], np.random.default_rng(5).normal(size=T)))

    def loss(s):
        return s["square"] / s["count"]

    def error(block):
        own = x.reshape(-1, block)

        def evaluate(v):
            square, count = ((own - v) ** 2).sum(1), np.full(len(own), float(block))
            return np.array([2 * (v[0] - x.mean())]), {"square": square, "count": count}

        at = np.array([x.mean()])
        H, slopes = curvature.hessian_and_slopes(evaluate, at)
        return curvature.standard_errors(H, influence=curvature.influence(loss, evaluate(at)[1], slopes))[0]

    exact = 1 / (1 - phi) / T**0.5  # the mean of an autoregressive series
    np.testing.assert_allclose(error(200), exact, rtol=0.15)
    assert error(1) < 0.3 * exact, "rows are not independent"


def test_influence_is_the_derivative_by_the_runs_weight():
    rng, R, p = np.random.default_rng(1), 5, 3
    A, B = rng.normal(size=(R, 2, p)), rng.uniform(1.0, 2.0, size=(R, 2))
    count = rng.uniform(5.0, 9.0, size=R)

    def sums(theta):
        return {"a": jnp.exp(A @ theta) * B, "count": jnp.asarray(count)}

    def loss(s):
        mean = s["a"] / s["count"]
        return jnp.log(mean[0]) ** 2 + mean[1] * mean[0] - jnp.sqrt(mean[1])

    def gradient(w, theta):
        return jax.grad(lambda v: loss({name: jnp.tensordot(w, s, 1) for name, s in sums(v).items()}))(theta)

    at = np.array([0.1, -0.2, 0.3])
    exact = jax.jit(jax.jacfwd(sums))(at)
    psi = curvature.influence(loss, sums(at), exact)
    np.testing.assert_allclose(psi, jax.jit(jax.jacfwd(gradient))(np.ones(R), at).T, rtol=1e-9)
    _, slopes = curvature.hessian_and_slopes(jax.jit(lambda v: (gradient(jnp.ones(R), v), sums(v))), at)
    np.testing.assert_allclose(slopes["a"], exact["a"], rtol=1e-6)


def test_matching_a_variance_is_as_sure_as_the_delta_method_says():
    rng = np.random.default_rng(2)
    count = rng.integers(20, 60, size=30)
    square = np.array([(rng.normal(size=n) ** 2).sum() for n in count])
    best = 0.5 * np.log(square.sum() / count.sum())

    def sums(v):
        return {"count": jnp.asarray(count, float), "square": jnp.asarray(square) * jnp.exp(-2 * v[0])}

    def loss(s):
        return (s["square"] / s["count"] - 1) ** 2

    def gradient(v):
        return jax.grad(lambda v: loss(jax.tree.map(jnp.sum, sums(v))))(v)

    H, slopes = curvature.hessian_and_slopes(lambda v: (gradient(v), sums(v)), np.array([best]))
    error = curvature.standard_errors(H, influence=curvature.influence(loss, sums(np.array([best])), slopes))
    moves = (square - square.sum() / count.sum() * count) / (2 * square.sum())  # of the ratio's logarithm, halved
    np.testing.assert_allclose(error, np.sqrt(30 / 29 * (moves**2).sum()), rtol=1e-6)
    # The gradient of each run's own part, which is all there is to a mean, is nothing here.
    own = slopes["square"] * jax.grad(loss)(jax.tree.map(jnp.sum, sums(np.array([best]))))["square"]
    assert np.abs(own).max() < 1e-9 * error


def test_standard_errors_of_what_cannot_be_told():
    H = Hessian(np.array([[2.0, -2.0, 0.0], [-2.0, 2.0, 0.0], [0.0, 0.0, 4.0]]), np.full((3, 3), 1e-9))
    np.testing.assert_allclose(curvature.standard_errors(H, count=100), [np.inf, np.inf, 0.05])
    assert np.isnan(curvature.standard_errors(H)).tolist() == [False, False, True]
    assert np.isnan(curvature.standard_errors(H, influence=np.ones((3, 3)))[2])
    broken = Hessian(np.full((2, 2), np.nan), np.zeros((2, 2)))
    assert np.isnan(curvature.standard_errors(broken, count=10)).all()
    assert identify.flat_directions(broken, Effects({}, {}), count=10) == ()


def test_a_sharp_parameter_in_float32_gets_steps_of_its_own_and_hides_nothing():
    def loss(v):
        return 1e6 * (1 - jnp.cos(10 * v[0])) + 0.01 * jnp.cosh(v[1] - 1) + v[0] * v[1]

    at = np.array([0.0, 1.0], np.float32)
    H = curvature.hessian(jax.grad(loss), at)
    np.testing.assert_allclose(H.matrix, [[1e8, 1.0], [1.0, 0.01]], rtol=2e-3, atol=2.0)
    np.testing.assert_allclose(np.diag(H.matrix), [1e8, 0.01], rtol=2e-3)
    assert np.isfinite(curvature.standard_errors(H, count=1e4)).all()


def test_a_loss_that_is_not_finite_far_away_is_looked_at_nearer():
    H = curvature.hessian(lambda v: np.where(np.abs(v) < 5e-5, 2 * v, np.nan), np.zeros(1))
    np.testing.assert_allclose(H.matrix, [[2.0]])


def test_uninfluential_parameters_are_named():
    g = np.array([[1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1e-30, 1.0]])
    assert identify.uninfluential(g, ("a", "b", "c", "d")) == ("b",)


def scaling(names, groups, blocks):
    """Effects of parameters on scalar variances: group -> {name: rate of its logarithm}."""
    ones = np.ones((1, 1, 1))
    covs = {g: (ones, np.array([rates.get(n, 0.0) for n in names]).reshape(1, 1, 1, -1)) for g, rates in blocks.items()}
    return Effects({n: frozenset(groups[n]) for n in names}, covs)


def test_directions_that_are_flat_together_are_told_apart():
    names = ["q0", "q1", "r", "start", "mark", "drag"]
    groups = {"q0": {"Q"}, "q1": {"Q"}, "r": {"R gnss"}, "start": {"P0"}, "mark": {"R mark"}, "drag": {"f"}}
    blocks = {"Q": {"q0": 2, "q1": 2}, "R gnss": {"r": 2}, "P0": {"start": 2}, "R mark": {"mark": 2}}
    rows = np.array([[1, 1, -1, 0, 0, 0], [1, 1, 0, -1, 0, 0], [0, 0, 0, 0, 0, 2.0]])
    H = Hessian(rows.T @ rows, np.full((6, 6), 1e-10))
    flat = identify.flat_directions(H, scaling(names, groups, blocks), count=1e4)
    assert [f.text for f in flat] == [
        "the common scale of Q, R of gnss and P0: this objective looks only at the mean, which does not "
        "change when all are multiplied alike",
        "q0 against q1: only their combination shows in these data",
        "mark: the data say nothing about it",
    ]
    assert all(f.std == np.inf and abs(f.curvature) < 1e-9 for f in flat)
    all_alike = [flat[0].direction[name] for name in ("q0", "q1", "r", "start")]
    np.testing.assert_allclose(np.array(all_alike) / all_alike[0], [1, 1, 2, 2], err_msg="Q is exp(2 q0 + 2 q1)")
    pair = flat[1].direction
    np.testing.assert_allclose([abs(v) for v in pair.values()], 0.5**0.5)
    errors = curvature.standard_errors(H, count=1e4)
    assert np.isinf(errors).tolist() == [True] * 5 + [False]


def test_scales_against_each_other_and_weak_parameters():
    groups = {"q": {"Q"}, "r": {"R gnss"}, "weak": {"h gnss"}}
    on = scaling(list(groups), groups, {"Q": {"q": 2}, "R gnss": {"r": 2}, "P0": {}})
    rows = np.array([[1.0, 1, 0], [0, 0, 0.03]])
    H = Hessian(rows.T @ rows, np.full((3, 3), 1e-10))
    against, weak = identify.flat_directions(H, on, count=100)
    assert against.text == "the scale of Q against that of R of gnss is not determined by this objective"
    assert weak.text == "weak: the data hardly tell"
    np.testing.assert_allclose(weak.std, 1 / (0.03 * 10))
    assert len(identify.flat_directions(H, on, count=10_000)) == 1, "with more data it is known"
    assert identify.flat_directions(Hessian(np.eye(3), np.zeros((3, 3))), on, count=100) == ()


def test_no_minimum_is_said_so():
    on = scaling(["q", "r"], {"q": {"Q"}, "r": {"R z"}}, {"Q": {"q": 2}, "R z": {"r": 2}})
    (found,) = identify.flat_directions(Hessian(np.diag([1.0, -0.5]), np.full((2, 2), 1e-9)), on, count=1000)
    assert found.text == "r: the loss bends down along it, so this is no minimum"
    assert found.curvature == -0.5


def level_effects(belief, free):
    rows = jf.Log(jnp.ones(2), (), {"z": jnp.zeros((2, 1))}, {}, {})
    return identify.effects(local_level, belief, free, free.start, jnp.zeros((2, 1)), rows)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_squared_errors_leave_the_common_scale_free(dtype):
    x, z = (a.astype(dtype) for a in few())
    free = parameters(np.array([*TRUE, 0.0]))
    at = free.start.astype(dtype)
    H, psi = bent("mse", x, z, at, free_start)
    flat = identify.flat_directions(H, level_effects(free_start, free), influence=psi)
    common = [f for f in flat if "common scale" in f.text]
    assert len(common) == 1
    assert common[0].text.startswith("the common scale of P0, Q and R of z: this objective looks only at the mean")
    np.testing.assert_allclose(list(common[0].direction.values()), 3**-0.5, rtol=1e-2)
    assert common[0].std == np.inf
    assert np.isinf(curvature.standard_errors(H, influence=psi)).all()


def test_the_log_score_fixes_the_scale():
    x, z = few()
    at = minimum("log_score", x, z, SLOW)
    H, psi = bent("log_score", x, z, at)
    assert identify.flat_directions(H, level_effects(known_start, parameters(at)), influence=psi) == ()


TREND = log_cholesky(2)


def trend(theta):
    return jf.linear(
        A=jnp.array([[1.0, 1.0], [0.0, 1.0]]),
        H=jnp.array([[1.0, 0.0]]),
        Q=TREND.cov(theta["q"]),
        R=jnp.exp(2 * theta["r"]) * jnp.ones((1, 1)),
    )


def trend_start(theta):
    return jf.Gaussian(jnp.zeros(2), 1e8 * jnp.eye(2))


def test_full_q_of_a_local_linear_trend_cannot_be_told_from_innovations():
    rng, steps, runs = np.random.default_rng(3), 100, 6
    Q = np.array([[0.5, 0.2], [0.2, 0.3]])
    A, x, z = np.array([[1.0, 1.0], [0.0, 1.0]]), np.zeros((runs, 2)), []
    for _ in range(steps):
        x = x @ A.T + rng.multivariate_normal(np.zeros(2), Q, size=runs)
        z.append(x[:, :1] + rng.normal(size=(runs, 1)))
    z = jnp.asarray(np.stack(z, axis=1))
    L = np.linalg.cholesky(Q)
    free = parameters({"q": np.array([np.log(L[0, 0]), L[1, 0], np.log(L[1, 1])]), "r": 0.0})

    def loss(v):
        theta = free.tree(v)

        def one(z):
            log = jf.Log(jnp.ones(steps), (), {"z": z}, {}, {})
            return likelihood(jf.kf(trend(theta)), trend_start(theta), log)

        return jax.vmap(one)(z).mean()

    both = jax.jit(jax.value_and_grad(loss))
    found = minimize(lambda v: tuple(map(np.asarray, both(v))), free.start, jac=True, options={"gtol": 1e-9})
    at = found.x
    rows = jf.Log(jnp.ones(1), (), {"z": jnp.zeros((1, 1))}, {}, {})
    on = identify.effects(trend, trend_start, free, at, jnp.zeros((1, 2)), rows)
    H = curvature.hessian(lambda v: both(v)[1], at)
    (flat,) = identify.flat_directions(H, on, count=runs * steps, needs_truth=False)
    assert flat.text.endswith("full Q cannot be identified from innovations alone: 1 of its directions are flat")
    assert set(flat.direction) <= {"q[0]", "q[1]", "q[2]"}
    # Second differences of the readings know Q_11 - Q_12 and Q_22 only: the autocovariances at lags 0, 1, 2.
    d, L = (
        np.array([v.get(name, 0.0) for name in free.names[:3]])
        for v in (flat.direction, dict(zip(free.names, at, strict=True)))
    )
    L, dL = np.array([[np.exp(L[0]), 0.0], [L[1], np.exp(L[2])]]), np.array([[d[0], 0.0], [d[1], d[2]]])
    dL[[0, 1], [0, 1]] *= L[[0, 1], [0, 1]]
    dQ = dL @ L.T + L @ dL.T
    np.testing.assert_allclose(dQ / dQ[0, 0], [[1.0, 1.0], [1.0, 0.0]], atol=0.05)


def test_effects_of_a_car():
    free = parameters(car.CITY_CAR, frozen=["mark"])
    log = car.scenario().schedule(6)
    log = log._replace(c={"mark": np.tile([3.0, 4.0], (6, 1))})
    x = car.Bicycle(jnp.ones((6, 2)), jnp.full(6, 0.2), jnp.full(6, 8.0))
    on = identify.effects(car.bicycle, car.bicycle_start, free, free.start, x, log)
    assert on.groups == {
        "gnss": {"R gnss"},
        "odometer": {"R odometer"},
        "slip": {"Q"},
        "speed": {"Q"},
        "start/0": {"P0"},
        "start/1": {"P0"},
        "start/2": {"P0"},
        "start/3": {"P0"},
        "turn": {"Q"},
        "wheel_base": {"f"},
    }
    assert on.covariances["Q"][0].shape == (6, 4, 4)
    assert on.covariances["Q"][1].shape == (6, 4, 4, 10)


def test_one_number_may_act_on_several_things():
    def model(theta):
        return local_level(jnp.stack([theta["noise"], theta["noise"]]))._replace(
            f=lambda x, u, dt: theta["drag"] * x, sensors=sensors(theta)
        )

    def sensors(theta):
        own = local_level(jnp.stack([theta["noise"], theta["noise"]])).sensors["z"]
        return {"z": own._replace(h=lambda x, c: x + theta["bias"])}

    def belief(theta):
        return jf.Gaussian(theta["bias"] * jnp.ones(1), jnp.eye(1))

    free = parameters({"noise": 0.0, "drag": 0.5, "bias": 1.0, "idle": 2.0})
    rows = jf.Log(jnp.array([0.0, 1.0]), (), {"z": jnp.zeros((2, 1))}, {}, {})
    on = identify.effects(model, belief, free, free.start, jnp.ones((2, 1)), rows)
    assert on.groups == {"bias": {"h z", "mean"}, "drag": {"f"}, "idle": set(), "noise": {"Q", "R z"}}
