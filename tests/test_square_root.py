"""What covariances kept as products can do in an ill-conditioned update, and what they cannot: and then say so."""

import jax
import numpy as np
import pytest

import jaxfilt as jf
from benchmarks.square_root import exactly, joseph, judged, problem, product, rounded, short, square_root

HELD = [(np.float32, 1e-3), (np.float64, 1e-6)]
LOST = [(np.float32, 1e-4), (np.float64, 1e-9)]


@pytest.mark.parametrize(("dtype", "d"), HELD)
def test_the_product_form_holds_where_other_covariance_forms_are_lost(dtype, d):
    given = problem(dtype, d)
    want = exactly(*given)
    _, lowest, along = judged(product(*given), *want)
    assert lowest > 0
    np.testing.assert_allclose(along, 1, atol=0.1)
    for other in (short, joseph):
        _, _, along = judged(other(*given), *want)
        assert abs(along[0] - 1) > 50


@pytest.mark.parametrize(("dtype", "d"), LOST)
def test_beyond_that_it_is_said(dtype, d):
    """S is singular to rounding: no belief that looks sound comes out, and the report names the cause."""
    P, H, R = problem(dtype, d)
    filt = jf.kf(jf.linear(np.eye(3, dtype=dtype), H, np.eye(3, dtype=dtype), R))
    start = jf.Gaussian(np.zeros(3, dtype), P)
    belief, info = jax.jit(lambda b, z: filt.update(b, z, "z"))(start, np.zeros(2, dtype))
    assert info.status == jf.Status.INDEFINITE_INNOVATION
    assert np.isnan(belief.cov).all()


@pytest.mark.parametrize(("dtype", "d"), LOST)
def test_no_covariance_could_hold_it_and_a_root_could(dtype, d):
    """The right answer, rounded to this precision, is wrong by a factor; the root that QR makes is not."""
    given = problem(dtype, d)
    want = exactly(*given)
    _, _, along = judged(rounded(*given), *want)
    assert abs(along[0] - 1) > 0.9
    _, _, along = judged(square_root(*given), *want)
    # The root is squared in float64, which at d = 1e-9 cannot hold the direction measured: look at the other one.
    np.testing.assert_allclose(along[0 if dtype == np.float32 else 1 :], 1, atol=0.01)
