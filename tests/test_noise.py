"""Covariances from parameters: closed forms from the books, quadrature, inverses, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.flatten_util import ravel_pytree
from scipy.integrate import quad_vec
from scipy.linalg import expm

import jaxfilt as jf
from jaxfilt.noise import floored, shared

DTYPES = pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=["float32", "float64"])


van_loan = jax.jit(lambda A, density, dt: jf.van_loan(A, density)(None, None, dt))


def integrated(A, density, dtype):
    return lambda dt: np.asarray(van_loan(np.asarray(A, dtype), np.asarray(density, dtype), dt))


def correlations(P: np.ndarray, like: np.ndarray) -> np.ndarray:
    """P relative to the standard deviations of another covariance, so that units do not matter."""
    std = np.sqrt(np.diag(like).astype(float))
    return np.asarray(P, float) / np.outer(std, std)


def rtol(dtype) -> float:
    return 2e-5 if dtype == np.float32 else 1e-12


@DTYPES
@pytest.mark.parametrize("dt", [1e-4, 0.1, 1.0, 30.0])
def test_constant_velocity_and_acceleration(dt, dtype):
    """Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), section 6.2."""
    q = 0.7
    cv = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    ca = q * np.array(
        [[dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2], [dt**3 / 6, dt**2 / 2, dt]]
    )
    for want in (cv, ca):
        n = len(want)
        density = np.zeros((n, n))
        density[-1, -1] = q
        got = integrated(np.eye(n, k=1), density, dtype)(dtype(dt))
        assert got.dtype == dtype
        np.testing.assert_allclose(got, want, rtol=rtol(dtype))


def singer(a: float, dt: float) -> np.ndarray:
    """Of unit density, Bar-Shalom et al., section 8.2.3; in 80 bits, since its terms cancel where a dt is small."""
    a, dt = np.longdouble(a), np.longdouble(dt)
    x, e = a * dt, np.exp(-a * dt)
    q11 = (1 - e * e + 2 * x + 2 * x**3 / 3 - 2 * x * x - 4 * x * e) / (2 * a**5)
    q12 = (e * e + 1 - 2 * e + 2 * x * e - 2 * x + x * x) / (2 * a**4)
    q13 = (1 - e * e - 2 * x * e) / (2 * a**3)
    q22 = (4 * e - 3 - e * e + 2 * x) / (2 * a**3)
    q23 = (e * e + 1 - 2 * e) / (2 * a**2)
    q33 = (1 - e * e) / (2 * a)
    return np.array([[q11, q12, q13], [q12, q22, q23], [q13, q23, q33]], np.longdouble)


@DTYPES
def test_singer_from_a_fraction_of_the_time_constant_to_thousands(dtype):
    """The block matrix of the textbooks returns noise from 30 time constants on: exp(+a dt) is one of its entries."""
    for a, dt in [(0.3, 1.0), (1.0, 1.0), (1.0, 10.0), (10.0, 3.0), (10.0, 10.0), (50.0, 10.0), (1000.0, 10.0)]:
        got = integrated(np.array([[0, 1, 0], [0, 0, 1], [0, 0, -a]]), np.diag([0.0, 0, 1]), dtype)(dtype(dt))
        want = singer(a, dt)
        np.testing.assert_allclose(
            correlations(got, want), correlations(want, want), atol=3e-5 if dtype == np.float32 else 1e-10
        )


def test_van_loan_is_its_integral():
    rng = np.random.default_rng(0)
    A, B = rng.normal(size=(2, 5, 5))
    for dt in (0.01, 0.5, 2.0):
        want, _ = quad_vec(lambda s: expm(A * s) @ B @ B.T @ expm(A * s).T, 0, dt, epsrel=1e-12)
        np.testing.assert_allclose(integrated(A, B @ B.T, np.float64)(dt), want, rtol=1e-9, atol=1e-12)


@DTYPES
def test_van_loan_in_two_steps_is_van_loan_in_one(dtype):
    rng = np.random.default_rng(1)
    A, B = rng.normal(size=(2, 4, 4))
    Q = integrated(A, B @ B.T, dtype)
    F = expm(A * 0.2)
    np.testing.assert_allclose(F @ Q(dtype(0.5)) @ F.T + Q(dtype(0.2)), Q(dtype(0.7)), rtol=50 * rtol(dtype))
    np.testing.assert_array_equal(Q(dtype(0)), 0)


@DTYPES
def test_van_loan_is_positive_definite_and_scales(dtype):
    """A chain of three integrators is the hardest case: its correlations are 1/7 % short of singular."""
    density = np.diag([0.0, 0.0, 1.0])
    Q, small = (integrated(np.eye(3, k=1), scale * density, dtype) for scale in (1.0, 2.0**-40))
    for dt in (1e-3, 0.01, 0.1, 1.0, 10.0):
        Qt = np.asarray(Q(dtype(dt)))
        np.testing.assert_array_equal(Qt, Qt.T)
        assert np.linalg.eigvalsh(correlations(Qt, Qt)).min() > 0.004
        np.testing.assert_allclose(small(dtype(dt)), Qt * dtype(2.0**-40), rtol=1e-6 if dtype == np.float32 else 0)


def test_gradients_of_van_loan():
    """With respect to a time constant, the density and dt: equal to finite differences, finite at dt = 0."""

    @jax.jit
    @jax.value_and_grad
    def f(theta):
        A = jnp.array([[0.0, 1.0], [0.0, 0.0]]) - jnp.diag(jnp.array([0.0, 1.0])) * theta[0]
        return jnp.sum(
            jnp.array([[1.0, 2.0], [3.0, 4.0]]) * jf.van_loan(A, jnp.eye(2) * theta[1])(None, None, theta[2])
        )

    theta = np.array([0.8, 0.3, 1.5])
    slope = f(theta)[1]
    for k, step in enumerate(1e-6 * np.eye(3)):
        assert slope[k] == pytest.approx(float(f(theta + step)[0] - f(theta - step)[0]) / 2e-6, rel=1e-7)
    assert np.isfinite(f(np.array([0.8, 0.3, 0.0]))[1]).all()


def test_const_and_white():
    P = jnp.array([[2.0, 1.0], [1.0, 3.0]])
    assert jf.const(P)("anything", "at all") is P
    assert jf.const(P)("x", "u", 0.1) is P
    np.testing.assert_allclose(jf.white(P)(None, None, 0.25), P / 4, rtol=1e-15)


@DTYPES
def test_diagonal(dtype):
    got = jf.diagonal(dtype(2), jnp.asarray([3, 4], dtype))
    assert got.dtype == dtype
    np.testing.assert_array_equal(got, np.diag([4, 9, 16]))
    assert jf.diagonal(1.0, 2.0).dtype == jnp.float64


# Parametrisations: numbers to covariances and back

PARAMETRISATIONS = {
    "log_std": (jf.log_std, np.diag([4.0, 1e-6, 9e4])),
    "log_cholesky": (jf.log_cholesky(3), np.array([[4.0, 1e-3, -1.0], [1e-3, 1e-6, 0.0], [-1.0, 0.0, 2.0]])),
    "blocks": (
        jf.blocks((jf.log_cholesky(2), 2), (jf.log_std, 1)),
        np.array([[4.0, 1.0, 0], [1.0, 3.0, 0], [0, 0, 1e-8]]),
    ),
    "shared": (shared(3), 0.25 * np.eye(3)),
    "floored": (
        floored(jf.blocks((jf.log_cholesky(2), 2), (shared(1), 1)), np.array([0.5, 0.1, 1e-5])),
        np.array([[4.0, 1.0, 0], [1.0, 3.0, 0], [0, 0, 1e-8]]),
    ),
}
EACH = pytest.mark.parametrize(("parametrisation", "P"), PARAMETRISATIONS.values(), ids=PARAMETRISATIONS.keys())


@DTYPES
@EACH
def test_there_and_back(parametrisation, P, dtype):
    theta = parametrisation.theta(jnp.asarray(P, dtype))
    back = parametrisation.cov(theta)
    assert {a.dtype for a in jax.tree.leaves((theta, back))} == {np.dtype(dtype)}
    np.testing.assert_allclose(correlations(back, P), correlations(P, P), atol=2e-6 if dtype == np.float32 else 1e-14)
    again = parametrisation.theta(back)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=2e-5 if dtype == np.float32 else 1e-9), again, theta
    )


@EACH
def test_any_numbers_make_a_covariance_and_gradients(parametrisation, P):
    template = parametrisation.theta(jnp.asarray(P))
    flat, unravel = ravel_pytree(template)
    W = np.random.default_rng(0).normal(size=P.shape)

    @jax.jit
    @jax.value_and_grad
    def f(numbers):
        return jnp.sum(W * parametrisation.cov(unravel(numbers)))

    rng = np.random.default_rng(1)
    for _ in range(10):
        numbers = 3 * rng.normal(size=len(flat))
        cov = np.asarray(parametrisation.cov(unravel(jnp.asarray(numbers))))
        np.testing.assert_array_equal(cov, cov.T)
        assert np.linalg.eigvalsh(correlations(cov, cov)).min() > -1e-14
        assert (np.diag(cov) > 0).all()
        direction = rng.normal(size=len(flat))
        difference = (f(numbers + 1e-6 * direction)[0] - f(numbers - 1e-6 * direction)[0]) / 2e-6
        assert f(numbers)[1] @ direction == pytest.approx(float(difference), rel=1e-6)


PER_AXIS = jf.blocks((shared(2), 2), (jf.log_std, 1))
ANY = st.floats(-15, 15)  # of a log-standard-deviation: nanometres to thousands of kilometres
SAME_SIZE = st.floats(-2, 2)  # of the rows of a Cholesky factor, whose products else are singular to rounding


def proper(cov):
    cov = np.asarray(cov)
    np.testing.assert_array_equal(cov, cov.T)
    np.linalg.cholesky(correlations(cov, cov))  # raises unless positive definite


@settings(deadline=None, max_examples=30, derandomize=True, database=None)
@given(st.tuples(ANY, st.lists(ANY, min_size=1, max_size=1).map(np.array)), st.floats(1e-6, 1e3))
def test_always_positive_definite_and_never_below_the_floor(theta, floor):
    proper(PER_AXIS.cov(theta))
    cov = floored(PER_AXIS, floor).cov(theta)
    proper(cov)
    assert (np.linalg.eigvalsh(np.asarray(cov)) >= floor**2 * (1 - 1e-12)).all()
    np.testing.assert_allclose(np.diag(cov), np.exp(2 * np.r_[theta[0], theta[0], theta[1]]) + floor**2, rtol=1e-12)


@settings(deadline=None, max_examples=30, derandomize=True, database=None)
@given(st.lists(SAME_SIZE, min_size=6, max_size=6).map(np.array), st.floats(-8, 8), st.floats(1e-3, 1e3))
def test_a_full_covariance_of_any_size_is_positive_definite(theta, size, relative_floor):
    """``log_cholesky`` moved by ``size`` in every logarithm, and rows with it: the correlations stay."""
    on_diagonal = np.array([0, 2, 5])
    scaled = np.exp(size) * theta
    scaled[on_diagonal] = theta[on_diagonal] + size
    cov = jf.log_cholesky(3).cov(jnp.asarray(scaled))
    proper(cov)
    floor = relative_floor * float(np.sqrt(np.trace(cov)))
    raised = np.asarray(floored(jf.log_cholesky(3), floor).cov(jnp.asarray(scaled)))
    proper(raised)
    assert np.linalg.eigvalsh(raised)[0] >= floor**2 * (1 - 1e-9)


@DTYPES
def test_one_number_for_many_axes(dtype):
    theta = jnp.asarray(np.log(3.0), dtype)
    assert shared(2).cov(theta).dtype == dtype
    np.testing.assert_allclose(shared(2).cov(theta), 9 * np.eye(2), rtol=rtol(dtype))
    unequal = shared(2).theta(jnp.diag(jnp.array([1.0, 7.0], dtype)))
    assert float(jnp.exp(2 * unequal)) == pytest.approx(4.0, rel=rtol(dtype))
    assert float(shared(1).cov(0.0)[0, 0]) == 1.0
    np.testing.assert_allclose(jax.jacfwd(shared(2).cov)(theta), 18 * np.eye(2), rtol=rtol(dtype))


@DTYPES
def test_a_floor_by_axis_and_its_gradient(dtype):
    """On the floor theta moves nothing; far above it, the floor is not felt."""
    R = floored(jf.log_std, np.array([0.01, 2.0]))
    low, high = jnp.asarray([-60.0, -60.0], dtype), jnp.asarray([5.0, 5.0], dtype)
    assert R.cov(low).dtype == dtype
    np.testing.assert_allclose(np.sqrt(np.diag(R.cov(low))), [0.01, 2.0], rtol=rtol(dtype))
    np.testing.assert_allclose(jax.jacfwd(R.cov)(low), 0.0, atol=1e-30)
    np.testing.assert_allclose(np.diag(R.cov(high)), np.exp(10) + np.array([1e-4, 4.0]), rtol=rtol(dtype))


def test_the_density_of_white_acceleration_is_tuned_through_van_loan():
    """Q is linear in the density: its derivative by the log-standard-deviation is 2 Q, and a likelihood has one too."""

    def model(theta):
        B = jnp.array([[0.0], [1.0]])
        density = B @ jf.log_std.cov(theta["q"]) @ B.T
        Q = jf.van_loan(jnp.array([[0.0, 1.0], [0.0, 0.0]]), density)
        z = jf.Sensor(lambda x, c: x[:1], jf.const(jnp.eye(1)), jf.vector(1))
        return jf.Model(lambda x, u, dt: jnp.stack([x[0] + dt * x[1], x[1]]), Q, jf.vector(2), {"z": z})

    theta = {"q": jnp.array([-0.4])}
    np.testing.assert_allclose(
        jax.jacfwd(lambda t: model(t).Q(None, None, 0.7))(theta)["q"][..., 0],
        2 * np.exp(-0.8) * np.array([[0.7**3 / 3, 0.7**2 / 2], [0.7**2 / 2, 0.7]]),
        rtol=1e-12,
    )
    z = np.random.default_rng(0).normal(size=(6, 1)).cumsum(0)
    log = jf.Log(np.full(6, 0.7), (), {"z": z}, {}, {})

    @jax.jit
    @jax.value_and_grad
    def likelihood(theta):
        return jf.log_likelihood(jf.kf(model(theta)), jf.Gaussian(jnp.zeros(2), jnp.eye(2)), log)

    above, below = (likelihood({"q": theta["q"] + h})[0] for h in (1e-5, -1e-5))
    slope = float(likelihood(theta)[1]["q"][0])
    assert abs(slope) > 1e-3
    assert slope == pytest.approx(float(above - below) / 2e-5, rel=1e-6)


def test_a_block_is_where_it_was_said():
    R = jf.blocks((jf.log_std, 1), (jf.log_cholesky(2), 2))
    theta = (jnp.log(jnp.array([3.0])), jnp.array([0.0, 2.0, jnp.log(5.0)]))
    np.testing.assert_allclose(R.cov(theta), [[9, 0, 0], [0, 1, 2], [0, 2, 29]], rtol=1e-14)


NOT_COVARIANCES = {
    "asymmetric": (
        np.array([[1.0, 0.5], [0.0, 1.0]]),
        r"expected a symmetric matrix, got 0.5 at \(0, 1\), 0 at \(1, 0\)",
    ),
    "negative": (np.diag([1.0, -2.0]), r"expected variances >= 0 on the diagonal, got -2 at \[1, 1\]"),
    "indefinite": (
        np.array([[1.0, 2.0], [2.0, 1.0]]),
        r"expected a positive semidefinite matrix, got .* eigenvalue -1",
    ),
    "nan": (np.array([[1.0, np.nan], [np.nan, 1.0]]), r"expected finite numbers, got nan at \[0, 1\] \(2 in all\)"),
    "vector": (np.ones(2), r"expected shape .*, got \(2,\)"),
    "not square": (np.ones((2, 3)), r"expected shape .*, got \(2, 3\)"),
}


@pytest.mark.parametrize(("bad", "text"), NOT_COVARIANCES.values(), ids=NOT_COVARIANCES.keys())
@pytest.mark.parametrize(
    ("name", "use"),
    [
        ("const(cov)", jf.const),
        ("white(density)", jf.white),
        ("van_loan(density)", lambda P: jf.van_loan(jnp.zeros((2, 2)), P)),
        ("cov", jf.log_std.theta),
        ("cov", jf.log_cholesky(2).theta),
        ("cov", jf.blocks((jf.log_std, 2)).theta),
        ("cov", shared(2).theta),
        ("cov", floored(jf.log_std, 0.1).theta),
    ],
    ids=["const", "white", "van_loan", "log_std", "log_cholesky", "blocks", "shared", "floored"],
)
def test_what_is_no_covariance_is_refused(name, use, bad, text):
    with pytest.raises(ValueError, match=text) as caught:
        use(jnp.asarray(bad))
    assert str(caught.value).startswith(name + ":")


def test_other_complaints():
    with pytest.raises(TypeError, match=r"const\(cov\): expected an array, got list"):
        jf.const([[1.0]])
    with pytest.raises(TypeError, match=r"const\(cov\): expected floating numbers, got int64\[2, 2\]"):
        jf.const(np.eye(2, dtype=int))
    with pytest.raises(ValueError, match=r"van_loan\(density\): expected shape \(2, 2\), got \(3, 3\)"):
        jf.van_loan(jnp.zeros((2, 2)), jnp.eye(3))
    with pytest.raises(ValueError, match=r"van_loan\(A\): expected a square matrix, got shape \(2, 3\)"):
        jf.van_loan(jnp.zeros((2, 3)), jnp.eye(2))
    with pytest.raises(ValueError, match=r"cov: expected positive variances, got 0"):
        jf.log_std.theta(jnp.diag(jnp.array([1.0, 0.0])))
    with pytest.raises(ValueError, match=r"cov: expected a positive definite matrix, got a singular one"):
        jf.log_cholesky(2).theta(jnp.ones((2, 2)))
    with pytest.raises(ValueError, match=r"theta: expected shape \(3,\), got \(2,\)"):
        jf.log_cholesky(2).cov(jnp.zeros(2))
    with pytest.raises(ValueError, match=r"cov: expected shape \(3, 3\), got \(2, 2\)"):
        jf.blocks((jf.log_std, 1), (jf.log_cholesky(2), 2)).theta(jnp.eye(2))
    with pytest.raises(ValueError, match=r"theta: expected a tuple of 2, one for each block, got 1"):
        jf.blocks((jf.log_std, 1), (jf.log_std, 1)).cov((jnp.zeros(1),))
    with pytest.raises(ValueError, match=r"shared\(n\): expected at least 1, got 0"):
        shared(0)
    with pytest.raises(ValueError, match=r"theta: expected one number, got shape \(2,\)"):
        shared(2).cov(jnp.zeros(2))
    with pytest.raises(ValueError, match=r"cov: expected a positive variance, got 0"):
        shared(2).theta(jnp.zeros((2, 2)))
    for bad in (-0.1, np.nan, np.inf, np.array([0.1, -1.0])):
        with pytest.raises(ValueError, match=r"floored\(std\): expected finite numbers >= 0, got"):
            floored(jf.log_std, bad)
    with pytest.raises(ValueError, match=r"floored\(std\): expected one number or shape \(3,\), got \(2,\)"):
        floored(jf.log_std, np.ones(2)).cov(jnp.zeros(3))


def test_what_is_below_the_floor_has_no_theta():
    R = floored(jf.log_cholesky(2), 1.0)
    for below in (np.diag([0.5, 4.0]), np.diag([1.0, 4.0]), np.array([[2.0, 1.5], [1.5, 3.0]])):
        with pytest.raises(ValueError, match=r"cov: expected one above the floor, variances 1.0, got"):
            R.theta(jnp.asarray(below))
    np.testing.assert_allclose(R.cov(R.theta(jnp.diag(jnp.array([1.1, 4.0])))), np.diag([1.1, 4.0]), rtol=1e-12)
