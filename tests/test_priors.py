"""Log densities of parameters: against SciPy, as integrals, in gradients, where they peak, and bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

import jaxfilt as jf
from jaxfilt.priors import inverse_wishart, log_normal, normal

DTYPES = pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=["float32", "float64"])
SCALE = np.array([[2.0, 0.3, -0.5], [0.3, 1.0, 0.2], [-0.5, 0.2, 4.0]])


def tolerance(dtype):
    return {"rel": 1e-5 if dtype == np.float32 else 1e-12}


@DTYPES
def test_normal(dtype):
    x, mean, std = np.array([[1.0, -2.0], [0.3, 5.0]]), np.array([[0.5, -2.0], [0.0, 9.0]]), np.full((2, 2), 1.5)
    got = normal(jnp.asarray(x, dtype), mean, std)
    assert got.dtype == dtype
    assert got.shape == ()
    assert float(got) == pytest.approx(stats.norm.logpdf(x, mean, std).sum(), **tolerance(dtype))
    assert float(normal(jnp.asarray(x, dtype), 0.5, 2.0)) == pytest.approx(
        stats.norm.logpdf(x, 0.5, 2).sum(), **tolerance(dtype)
    )


@DTYPES
def test_log_normal_is_the_books_times_the_value(dtype):
    """SciPy's density is that of v; ours, of log v, is v times that."""
    v, median, factor = np.array([0.1, 2.0, 30.0]), np.array([0.3, 2.0, 4.0]), np.array([3.0, 1.2, 10.0])
    got = log_normal(jnp.asarray(np.log(v), dtype), median, factor)
    assert got.dtype == dtype
    of_v = stats.lognorm.logpdf(v, s=np.log(factor), scale=median)
    assert float(got) == pytest.approx((of_v + np.log(v)).sum(), **tolerance(dtype))


def test_log_normal_is_a_density_of_the_logarithm_and_peaks_at_the_median():
    density = jax.jit(lambda x: jnp.exp(log_normal(x, median=0.2, factor=5.0)))
    assert quad(lambda x: float(density(x)), -12, 9)[0] == pytest.approx(1.0, rel=1e-6)
    assert quad(lambda x: float(density(x)), np.log(0.2 / 5), np.log(0.2 * 5))[0] == pytest.approx(0.6827, abs=1e-4)
    assert float(jax.grad(lambda x: log_normal(x, 0.2, 5.0))(np.log(0.2))) == pytest.approx(0.0, abs=1e-12)


@DTYPES
@pytest.mark.parametrize("n", [1, 2, 3])
def test_inverse_wishart(n, dtype):
    rng = np.random.default_rng(n)
    for dof in (n - 0.5, n + 0.7, n + 40.0):
        root = rng.normal(size=(n, n)) + 2 * np.eye(n)
        cov, scale = root @ root.T, SCALE[:n, :n]
        got = inverse_wishart(jnp.asarray(cov, dtype), dof, scale)
        assert got.dtype == dtype
        want = written_out(cov, dof, scale) if dof < n else stats.invwishart.logpdf(cov, dof, scale)
        rel = 1e-4 if dtype == np.float32 else 1e-10
        assert float(got) == pytest.approx(float(want), rel=rel, abs=rel)


def written_out(cov, dof, scale):
    """SciPy wants dof >= n; between n - 1 and n the formula holds all the same."""
    from scipy.special import multigammaln

    n = len(cov)
    total = dof * np.linalg.slogdet(scale)[1] - (dof + n + 1) * np.linalg.slogdet(cov)[1]
    return 0.5 * (total - np.trace(scale @ np.linalg.inv(cov)) - dof * n * np.log(2)) - multigammaln(dof / 2, n)


def test_inverse_wishart_peaks_where_it_says():
    density = jax.jit(jax.value_and_grad(lambda cov: inverse_wishart(cov, 6.0, jnp.asarray(SCALE))))
    peak = SCALE / (6 + 3 + 1)
    top, slope = density(peak)
    np.testing.assert_allclose(slope + slope.T, 0.0, atol=1e-9)
    for change in (1.1, 0.9):
        assert density(change * peak)[0] < top


def test_a_prior_of_theta_and_its_gradient():
    """A sum of the three over parts of theta, one of them by way of a parametrisation; against differences."""
    full = jf.log_cholesky(2)

    @jax.jit
    @jax.value_and_grad
    def prior(theta):
        return (
            log_normal(theta["gnss"], 2.0, 3.0)
            + normal(theta["bias"], np.array([0.0, 1.0]), 0.5)
            + inverse_wishart(full.cov(theta["q"]), 5.0, SCALE[:2, :2])
        )

    theta = {"gnss": np.array(0.3), "bias": np.array([0.2, 0.4]), "q": np.array([0.1, -0.6, 0.4])}
    slope = prior(theta)[1]
    for name, value in theta.items():
        for i in np.ndindex(value.shape):
            h = np.zeros_like(value)
            h[i] = 1e-6
            above, below = (prior(theta | {name: value + sign * h})[0] for sign in (1, -1))
            assert float(slope[name][i]) == pytest.approx(float(above - below) / 2e-6, rel=1e-6, abs=1e-8)


def test_python_numbers_will_do():
    assert float(normal(1.0, 0.0, 2.0)) == pytest.approx(stats.norm.logpdf(1, 0, 2), rel=1e-6)


EYE = np.eye(2)


@pytest.mark.parametrize(
    ("make", "error", "text"),
    [
        (lambda: normal(1.0, 0.0, 0.0), ValueError, r"normal\(std\): expected numbers > 0, got 0"),
        (lambda: normal(1.0, np.nan, 1.0), ValueError, r"normal\(mean\): expected finite numbers, got nan"),
        (lambda: normal(1, 0.0, 1.0), TypeError, r"normal\(value\): expected floating numbers, got int 1"),
        (lambda: normal(np.ones(2), np.zeros(3), 1.0), ValueError, r"normal\(mean\): .* \(2,\), got shape \(3,\)"),
        (lambda: normal(1.0, np.zeros(3), 1.0), ValueError, r"normal\(mean\): .* \(\), got shape \(3,\)"),
        (lambda: log_normal(1.0, 0.0, 2.0), ValueError, r"log_normal\(median\): expected numbers > 0, got 0"),
        (lambda: log_normal(1.0, 1.0, 1.0), ValueError, r"log_normal\(factor\): expected numbers > 1, got 1"),
        (lambda: log_normal(1.0, 1.0, np.inf), ValueError, r"log_normal\(factor\): expected finite numbers, got inf"),
        (lambda: inverse_wishart(EYE, 1.0, EYE), ValueError, r"\(dof\): expected a finite number > 1, got 1.0"),
        (lambda: inverse_wishart(EYE, np.nan, EYE), ValueError, r"\(dof\): expected a finite number > 1, got nan"),
        (lambda: inverse_wishart(EYE, 3.0, np.eye(3)), ValueError, r"\(scale\): expected shape \(2, 2\), got \(3, 3\)"),
        (lambda: inverse_wishart(EYE, 3.0, np.ones((2, 2))), ValueError, r"\(scale\): .* positive definite .*singular"),
        (lambda: inverse_wishart(-EYE, 3.0, EYE), ValueError, r"\(cov\): expected variances >= 0 on the diagonal"),
    ],
)
def test_bad_input(make, error, text):
    with pytest.raises(error, match=text):
        make()
