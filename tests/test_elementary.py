"""Functions with removable singularities: against power series in 80-bit floats, with first and second derivatives.

The series here have 80 terms and no switch; those of the library are short, for near zero, and hand over to a quotient.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilt.elementary import atan_ratio, bearing, cos_and_sinc_of_root, cosc, norm, sinc, wrap

DTYPES = pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["float32", "float64"])
ROUNDING = {jnp.float32: [4e-7, 4e-6, 8e-5], jnp.float64: [8e-16, 8e-15, 4e-13]}
"""Of the value, the first and the second derivative: relative to 1, the size of all of them near zero."""


def series(coefficient, x: np.ndarray, order: int) -> np.ndarray:
    """The order-th derivative of sum_k coefficient(k) x^k, in 80 bits."""
    total = np.zeros(len(x), np.longdouble)
    for k in range(order, 80):
        total = total + np.longdouble(coefficient(k)) * math.perm(k, order) * x ** np.longdouble(k - order)
    return total


def reciprocal(n: int) -> np.longdouble:
    return np.longdouble(1) / np.longdouble(math.factorial(n))


def sinc_coefficient(k: int) -> np.longdouble:
    return np.longdouble(0) if k % 2 else (-1) ** (k // 2) * reciprocal(k + 1)


def cosc_coefficient(k: int) -> np.longdouble:
    return (-1) ** (k // 2) * reciprocal(k + 1) if k % 2 else np.longdouble(0)


def cos_of_root_coefficient(k: int) -> np.longdouble:
    return (-1) ** k * reciprocal(2 * k)


def sinc_of_root_coefficient(k: int) -> np.longdouble:
    return (-1) ** k * reciprocal(2 * k + 1)


def around(switch: float, dtype) -> np.ndarray:
    at = np.asarray(switch, dtype)
    return np.array([np.nextafter(at, dtype(0)), at, np.nextafter(at, dtype(10)), 0.98 * at, 1.02 * at], dtype)


def jet(f):
    """The value, the derivative by forward mode, the second by reverse over forward, as an EKF's gradient takes it."""
    return jax.jit(jax.vmap(lambda *x: (f(*x), jax.jacfwd(f)(*x), jax.grad(jax.jacfwd(f))(*x))))


def assert_jet(f, coefficient, x: np.ndarray) -> None:
    dtype = x.dtype.type
    for order, got in enumerate(jet(f)(x)):
        assert got.dtype == dtype
        want = series(coefficient, x.astype(np.longdouble), order)
        np.testing.assert_allclose(np.asarray(got, np.longdouble), want, rtol=0, atol=ROUNDING[dtype][order])


@DTYPES
def test_sinc_and_cosc(dtype):
    half = np.r_[0.0, 1e-30, 1e-12, 1e-8, 1e-4, 1e-2, 0.3, around(0.5, dtype), 1.0, 3.0, 6.0].astype(dtype)
    x = np.r_[-half, half]
    assert_jet(sinc, sinc_coefficient, x)
    assert_jet(cosc, cosc_coefficient, x)


@DTYPES
def test_cos_and_sinc_of_a_root(dtype):
    y = np.r_[0.0, 1e-30, 1e-12, 1e-6, 1e-2, 0.1, around(0.25, dtype), 1.0, math.pi**2 / 4, 9.0].astype(dtype)
    assert_jet(lambda y: cos_and_sinc_of_root(y)[0], cos_of_root_coefficient, y)
    assert_jet(lambda y: cos_and_sinc_of_root(y)[1], sinc_of_root_coefficient, y)


def atan_ratio_in_80_bits(s2, c):
    s = np.sqrt(s2)
    return np.arctan2(s, c) / s


@DTYPES
def test_the_ratio_of_an_angle_to_its_sine(dtype):
    switch = around(0.02, dtype)
    c = np.r_[np.ones(5), np.full(5, 0.7), 0.5, 1e-3, 1e-8, 0.0].astype(dtype)
    s2 = np.r_[switch, switch * dtype(0.49), 0.75, 1.0, 1.0, 1.0].astype(dtype)
    value, slopes = jax.jit(jax.vmap(jax.value_and_grad(atan_ratio, argnums=(0, 1))))(s2, c)
    s2, c, h = s2.astype(np.longdouble), c.astype(np.longdouble), np.longdouble(1e-5)
    rtol = 2 * ROUNDING[dtype][0]
    np.testing.assert_allclose(np.asarray(value, np.longdouble), atan_ratio_in_80_bits(s2, c), rtol=rtol)
    atol = 4e-5 if dtype == jnp.float32 else 1e-8
    for slope, (ds2, dc) in zip(slopes, [(h, 0), (0, h)], strict=True):
        difference = atan_ratio_in_80_bits(s2 + ds2, c + dc) - atan_ratio_in_80_bits(s2 - ds2, c - dc)
        np.testing.assert_allclose(np.asarray(slope, np.longdouble), difference / (2 * h), rtol=1e-5, atol=atol)


@DTYPES
def test_the_ratio_of_an_angle_to_its_sine_near_zero(dtype):
    """atan(sqrt t) / sqrt t = 1 - t/3 + t^2/5 - t^3/7 ..., and the ratio is of degree -1 in (s, c)."""
    s2 = np.tile([0.0, 1e-35, 1e-16, 1e-8], 2).astype(dtype)
    c = np.repeat([1.0, 0.6], 4).astype(dtype)
    got = jet(atan_ratio)(s2, c)
    c = c.astype(float)
    t = s2.astype(float) / c**2
    want = [(1 - t / 3) / c, (-1 / 3 + 2 * t / 5) / c**3, (2 / 5 - 6 * t / 7) / c**5]
    for a, b in zip(got, want, strict=True):
        np.testing.assert_allclose(a, b, rtol=5e-15 if dtype == jnp.float64 else 2e-6)


@DTYPES
def test_wrap(dtype):
    x = np.concatenate([np.linspace(-20, 20, 401), [-math.pi, math.pi, 3 * math.pi, 0.0]]).astype(dtype)
    y = np.asarray(jax.vmap(wrap)(x))
    slack = 20 * np.finfo(dtype).eps
    assert y.dtype == dtype
    assert (np.abs(y) <= math.pi * (1 + np.finfo(dtype).eps)).all()
    np.testing.assert_allclose(np.cos(y.astype(float)), np.cos(x.astype(float)), atol=slack)
    np.testing.assert_allclose(np.sin(y.astype(float)), np.sin(x.astype(float)), atol=slack)
    inside = np.abs(x) < 3.14
    np.testing.assert_array_equal(y[inside], x[inside])
    np.testing.assert_array_equal(jax.vmap(jax.grad(wrap))(x), 1)
    np.testing.assert_array_equal(jax.vmap(jax.jacfwd(wrap))(x), 1)


POINTS = [(3.0, 4.0), (-3.0, 4.0), (-1e-9, -1e-9), (0.0, -2.0), (-1.0, 0.0), (1e-4, 0.0), (1e15, -1e15)]
BOTH = pytest.mark.parametrize("f", [norm, bearing], ids=["norm", "bearing"])


@DTYPES
@BOTH
def test_norm_and_bearing(f, dtype):
    p = jnp.asarray(POINTS, dtype)
    x, y = np.asarray(p, float).T
    r = np.hypot(x, y)
    if f is norm:
        value, slope = r, np.stack([x, y], 1) / r[:, None]
    else:
        value, slope = np.arctan2(y, x), np.stack([-y, x], 1) / r[:, None] ** 2
    got, forward, reverse = jax.jit(jax.vmap(lambda p: (f(p), jax.jacfwd(f)(p), jax.grad(f)(p))))(p)
    rtol = 8 * float(jnp.finfo(dtype).eps)
    assert got.dtype == dtype
    np.testing.assert_allclose(got, value, rtol=rtol)
    np.testing.assert_allclose(forward, slope, rtol=rtol)
    np.testing.assert_allclose(reverse, slope, rtol=rtol)


@DTYPES
@BOTH
def test_norm_and_bearing_at_no_distance_are_zero_with_zero_derivatives(f, dtype):
    everything = [f, jax.grad(f), jax.jacfwd(f), jax.jacrev(jax.jacfwd(f)), jax.hessian(f)]
    for value in jax.jit(lambda p: [g(p) for g in everything])(jnp.zeros(2, dtype)):
        np.testing.assert_array_equal(value, 0)
        assert value.dtype == dtype


@DTYPES
@BOTH
def test_norm_and_bearing_where_squares_underflow(f, dtype):
    size = np.array([1e-15, 1e-19, 1e-20, 1e-23, 1e-30, 1e-38, 1e-155, 1e-162, 1e-200, 1e-308])
    p = np.stack([size, -size], 1).astype(dtype)
    for value in jax.jit(jax.vmap(lambda p: [f(p), jax.grad(f)(p), jax.jacfwd(f)(p)]))(p):
        assert np.isfinite(value).all()
