"""Many points, or many Gaussians, with weights: their mean and covariance on a space."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxfilt import linalg
from jaxfilt.correction import carried
from jaxfilt.transforms import MEAN_ITERATIONS
from jaxfilt.types import Array, Gaussian, PyTree, Space


def moments(points: PyTree, weights: Array, space: Space) -> Gaussian:
    """Mean and covariance of weighted points: ``sum_i w_i minus(x_i, mean) = 0``, ``sum_i w_i d_i d_i'``.

    On a curved space the mean is sought from the heaviest point on, by the fixed-point iteration of the sigma points.

    Args:
        points: leading axis N.
        weights: (N,), of sum 1.
        space: of dimension n.

    Example: two angles on either side of the seam.
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> mean, cov = moments(jnp.array([3.1, -3.1]), jnp.array([0.5, 0.5]), jf.angle)
        >>> round(abs(float(mean)), 4), round(float(cov[0, 0]) ** 0.5, 4)
        (3.1416, 0.0416)
    """
    minus = jax.vmap(space.minus, in_axes=(0, None))
    heaviest = jnp.argmax(weights)
    mean = jax.tree.map(lambda a: a[heaviest], points)
    for _ in range(1 if space.flat else MEAN_ITERATIONS):
        mean = space.plus(mean, weights @ minus(points, mean))
    d = minus(points, mean)
    return Gaussian(mean, linalg.symmetrize(d.T @ (weights[:, None] * d)))


def collapsed(beliefs: Gaussian, weights: Array, space: Space) -> Gaussian:
    """The Gaussian with mean and covariance of a mixture of Gaussians.

    ``P = sum_i w_i (P_i + d_i d_i')``, each P_i carried to the tangent space at the common mean.

    Args:
        beliefs: leading axis N.
        weights: (N,), of sum 1.
        space: of dimension n.

    Example:
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> two = jf.Gaussian(jnp.array([[0.0], [2.0]]), jnp.ones((2, 1, 1)))
        >>> collapsed(two, jnp.array([0.5, 0.5]), jf.vector(1)).cov.tolist()
        [[2.0]]
    """
    centre = moments(beliefs.mean, weights, space)
    here = jax.vmap(lambda belief: carried(space, belief, centre.mean))(beliefs)
    return centre._replace(cov=linalg.symmetrize(centre.cov + jnp.tensordot(weights, here, axes=1)))
