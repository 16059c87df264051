"""How a Gaussian passes through a function: the one question in which KF, EKF, UKF and CKF differ.

A transform is a function ``transform(g, belief, space_in, space_out) -> Moments``. These are the only callers of a
model's f and h inside a Kalman filter. All calculus happens in tangent spaces, so that a vector, an angle and an
attitude are the same code.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import linalg
from jaxfilt.types import Gaussian, Moments, PyTree, Space

Transform = Callable[[Callable[[PyTree], PyTree], Gaussian, Space, Space], Moments]

MEAN_ITERATIONS = 3
"""Fixed-point iterations for the mean of points on a curved space; on a flat one the first is exact."""


def taylor(g: Callable, belief: Gaussian, space_in: Space, space_out: Space, at: jax.Array | None = None) -> Moments:
    """First-order expansion: ``g(x) ~ g(mean) + J (x - mean)``, with J by automatic differentiation. Makes the EKF.

    ``mean = g(mean)``, ``cov = J P J'``, ``cross = P J'``, ``remainder(K) = (I - K J) P (I - K J)'``.

    Args:
        g: function from space_in to space_out.
        belief: Gaussian on space_in, dimension n.
        space_in: the space of x.
        space_out: the space of g(x).
        at: (n,) tangent offset from the mean of the point to expand about, for iterated filters: the mean is then g
            there, and the shift ``J at``. Default: about the mean itself.

    Source: S. Sarkka, Bayesian Filtering and Smoothing (2013), eq. 5.26; in the tangent space as in Sola et al.,
    A micro Lie theory for state estimation in robotics (2018), eqs. 31 and 41.
    """
    P = belief.cov
    origin = jnp.zeros(space_in.dim, P.dtype)
    offset = origin if at is None else at
    y = g(belief.mean if at is None else space_in.plus(belief.mean, offset))
    J = jax.jacfwd(lambda d: space_out.minus(g(space_in.plus(belief.mean, d)), y))(offset)
    PJ = P @ J.T

    def remainder(K: jax.Array) -> jax.Array:
        A = jnp.eye(space_in.dim, dtype=P.dtype) - K @ J
        return A @ P @ A.T

    return Moments(y, J @ PJ, PJ, remainder, 0.0 if at is None else J @ offset)


def taylor_at(offset: jax.Array) -> Transform:
    """`taylor` about the point ``mean + offset`` instead of the mean."""
    return lambda g, belief, space_in, space_out: taylor(g, belief, space_in, space_out, at=offset)


def sigma_points(unit: np.ndarray, mean_weights: np.ndarray, cov_weights: np.ndarray) -> Transform:
    """The transform of a quadrature rule for the standard normal distribution.

    ``x_i = mean + L u_i`` with ``P = L L'``; mean and covariance of ``g(x_i)`` by weights, deviations taken in the
    tangent space. ``remainder(K) = E diag(w) E'`` with ``E = dX - K dZ``.

    Args:
        unit: (k, n) points u_i; the first is the centre, 0, of weight zero where the rule has none: deviations are
            taken from its image, far from the seam of an angle.
        mean_weights: (k,) weights of the mean, of sum 1.
        cov_weights: (k,) weights of the covariance.
    """

    def transform(g: Callable, belief: Gaussian, space_in: Space, space_out: Space) -> Moments:
        P = belief.cov
        wm, wc = jnp.asarray(mean_weights, P.dtype), jnp.asarray(cov_weights, P.dtype)
        dX = jnp.asarray(unit, P.dtype) @ linalg.semidefinite_cholesky(P).T
        images = jax.vmap(lambda d: g(space_in.plus(belief.mean, d)))(dX)
        minus = jax.vmap(space_out.minus, in_axes=(0, None))
        centre = jax.tree.map(lambda a: a[0], images)
        mean = centre
        for _ in range(1 if space_out.flat else MEAN_ITERATIONS):
            mean = space_out.plus(mean, wm @ minus(images, mean))
        dZ = minus(images, mean)

        def remainder(K: jax.Array) -> jax.Array:
            E = dX - dZ @ K.T
            return E.T @ (wc[:, None] * E)

        weighted = wc[:, None] * dZ
        return Moments(mean, dZ.T @ weighted, dX.T @ weighted, remainder)

    return transform


def unscented(alpha: float = 1.0, beta: float = 2.0, kappa: float = 0.0) -> Transform:
    """The unscented transform with 2n + 1 scaled sigma points. Makes the UKF.

    ``lambda = alpha^2 (n + kappa) - n``; points ``mean`` and ``mean +- sqrt(n + lambda) L_i``; weights
    ``lambda / (n + lambda)`` and ``1 / (2 (n + lambda))``, the centre's ``+ 1 - alpha^2 + beta`` in covariances.

    The centre's covariance weight is negative where ``alpha^2 (n + kappa) (2 + beta - alpha^2) < n`` ((n + kappa) = n
    and beta = 2: below alpha = 0.518); the covariance is then no longer positive semidefinite by construction.

    Args:
        alpha: spread of the points, > 0. Differences of images are divided by alpha^2, so a tiny alpha costs
            digits: it must be at least sqrt(10^4 eps) of the belief's dtype (0.035 in float32).
        beta: weight of the centre in covariances; 2 is best for a Gaussian.
        kappa: second spread parameter, n + kappa > 0.

    Raises:
        ValueError: a spread that is not positive, or an alpha too small for the dtype.

    Source: Wan, van der Merwe, The unscented Kalman filter for nonlinear estimation (2000), eqs. 15-18.
    """
    if not alpha > 0:
        raise ValueError(f"unscented(alpha): expected alpha > 0, got {alpha}")

    def transform(g: Callable, belief: Gaussian, space_in: Space, space_out: Space) -> Moments:
        n, dtype = space_in.dim, belief.cov.dtype
        least = (1e4 * float(jnp.finfo(dtype).eps)) ** 0.5
        if alpha < least:
            raise ValueError(
                f"unscented(alpha): expected alpha >= {least:.2g} in {dtype}, got {alpha}: rounding of the images is "
                "divided by alpha^2, which leaves fewer than four digits"
            )
        if not n + kappa > 0:
            raise ValueError(f"unscented(kappa): expected n + kappa > 0 with n = {n}, got kappa = {kappa}")
        spread = alpha**2 * (n + kappa)
        unit = np.concatenate([np.zeros((1, n)), np.sqrt(spread) * np.eye(n), -np.sqrt(spread) * np.eye(n)])
        wm = np.full(2 * n + 1, 0.5 / spread)
        wm[0] = 1 - n / spread
        wc = wm.copy()
        wc[0] += 1 - alpha**2 + beta
        return sigma_points(unit, wm, wc)(g, belief, space_in, space_out)

    return transform


def cubature(g: Callable, belief: Gaussian, space_in: Space, space_out: Space) -> Moments:
    """Third-degree spherical cubature: 2n points ``mean +- sqrt(n) L_i`` of equal weight. Makes the CKF.

    Source: Arasaratnam, Haykin, Cubature Kalman filters (2009), eqs. 17-24.
    """
    n = space_in.dim
    weights = np.r_[0.0, np.full(2 * n, 0.5 / n)]
    unit = np.sqrt(n) * np.concatenate([np.zeros((1, n)), np.eye(n), -np.eye(n)])
    return sigma_points(unit, weights, weights)(g, belief, space_in, space_out)


def gauss_hermite(order: int = 3) -> Transform:
    """Gauss-Hermite product rule with ``order`` points an axis, ``order^n`` in all: for small states.

    Exact for polynomials up to degree ``2 order - 1`` in each coordinate.

    Raises:
        ValueError: an order below 2, or more than 10,000 points.

    Source: Ito, Xiong, Gaussian filters for nonlinear filtering problems (2000), section III.
    """
    if order < 2:
        raise ValueError(f"gauss_hermite(order): expected order >= 2, got {order}")
    nodes, weights = np.polynomial.hermite_e.hermegauss(order)

    def transform(g: Callable, belief: Gaussian, space_in: Space, space_out: Space) -> Moments:
        n = space_in.dim
        if order**n > 10_000:
            raise ValueError(f"gauss_hermite(order): expected at most 10,000 points, got {order}^{n}")
        unit = np.stack(np.meshgrid(*[nodes] * n, indexing="ij"), -1).reshape(-1, n)
        w = np.stack(np.meshgrid(*[weights] * n, indexing="ij"), -1).reshape(-1, n).prod(1)
        unit, w = np.concatenate([np.zeros((1, n)), unit]), np.r_[0.0, w / w.sum()]
        return sigma_points(unit, w, w)(g, belief, space_in, space_out)

    return transform
