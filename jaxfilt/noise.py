"""From parameters to covariances: what Q and R are made of.

`const`, `white` and `van_loan` lift a matrix to the function that a `Model` or a `Sensor` wants. A `Parametrisation`
maps unconstrained numbers to a covariance and back, for tuning.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors, linalg
from jaxfilt.types import Array, PyTree

DOUBLINGS, TERMS = 20, 8
"""Of `van_loan`: good to ten digits up to dt = 100,000 time constants, in float64."""


def const(cov: Array) -> Callable[..., Array]:
    """The same covariance always: as R of a sensor, or as a Q that is one per step, whatever dt.

    Raises:
        ValueError: not a symmetric positive semidefinite matrix.
    """
    doors.covariance("const(cov)", cov)
    return lambda *_: cov


def white(density: Array) -> Callable[[PyTree, PyTree, Array], Array]:
    """Q of white noise on the state's rate: ``Q(x, u, dt) = density dt``, first order in dt.

    Args:
        density: (n, n) power spectral density, the unit of the state squared per second.
    """
    doors.covariance("white(density)", density)
    return lambda x, u, dt: density * dt


def van_loan(A: Array, density: Array) -> Callable[[PyTree, PyTree, Array], Array]:
    """Exact Q of ``dx = A x dt + white noise``: ``integral_0^dt exp(A s) density exp(A s)' ds``.

    Args:
        A: (n, n) continuous-time dynamics matrix, 1/s.
        density: (n, n) power spectral density, the unit of the state squared per second.

    Example: a position driven by white acceleration.
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> Q = jf.van_loan(jnp.array([[0.0, 1.0], [0.0, 0.0]]), jnp.diag(jnp.array([0.0, 3.0])))
        >>> [[round(float(q), 4) for q in row] for row in Q(None, None, 1.0)]
        [[1.0, 1.5], [1.5, 3.0]]

    Example: tuning the density, of the unit m/s^2 per root Hz. What theta adds to its logarithm, Q feels twice.
        >>> import jax
        >>> A, B = jnp.array([[0.0, 1.0], [0.0, 0.0]]), jnp.array([[0.0], [1.0]])
        >>> def variance_of_position(theta):
        ...     return jf.van_loan(A, B @ jf.log_std.cov(theta["acceleration"]) @ B.T)(None, None, 1.0)[0, 0]
        >>> value, slope = jax.value_and_grad(variance_of_position)({"acceleration": 0.5 * jnp.log(jnp.array([3.0]))})
        >>> round(float(value), 4), round(float(slope["acceleration"][0]), 4)
        (1.0, 2.0)

    The usual block matrix holds exp(-A dt), which at 30 time constants has cost float64 all its digits. Here the
    integral over a small h, a power series, is doubled until it covers dt, by sums of what is positive only:
    ``Q(2h) = Q(h) + F Q(h) F'`` with ``F = exp(A h)``, kept as ``N = F - I``.

    Source: C. F. Van Loan, Computing integrals involving the matrix exponential (1978), eq. 1.2.
    """
    n = A.shape[0]
    if A.shape != (n, n):
        raise ValueError(f"van_loan(A): expected a square matrix, got shape {A.shape}")
    doors.covariance("van_loan(density)", density, n)

    def Q(x: PyTree, u: PyTree, dt: Array) -> Array:
        h = dt / 2**DOUBLINGS
        power, term = jnp.eye(n, dtype=A.dtype), density * h
        N, S = jnp.zeros_like(A), term
        for k in range(1, TERMS):
            power = h / k * (A @ power)
            term = h / (k + 1) * (A @ term + term @ A.T)
            N, S = N + power, S + term

        def double(_: int, both: tuple[Array, Array]) -> tuple[Array, Array]:
            N, S = both
            FS = S + N @ S
            return 2 * N + N @ N, S + FS + FS @ N.T

        return linalg.symmetrize(jax.lax.fori_loop(0, DOUBLINGS, double, (N, S))[1])

    return Q


def diagonal(*stds: Array | float) -> Array:
    """``diag(std^2)``: a covariance from standard deviations, given one by one or as vectors, concatenated.

    Example:
        >>> import jaxfilt as jf
        >>> jf.diagonal(1.0, 3.0).tolist()
        [[1.0, 0.0], [0.0, 9.0]]
    """
    std = jnp.concatenate([jnp.atleast_1d(jnp.asarray(s)) for s in stds])
    return jnp.diag(std * std)


class Parametrisation(NamedTuple):
    """A covariance as unconstrained numbers: ``cov(theta)``, and its inverse ``theta(cov)``."""

    cov: Callable[[PyTree], Array]
    theta: Callable[[Array], PyTree]


def _log_std_inverse(cov: Array) -> Array:
    doors.covariance("cov", cov)
    if doors.is_concrete(cov) and (np.diag(cov) <= 0).any():
        raise ValueError(f"cov: expected positive variances, got {np.diag(cov).min():.6g}")
    return 0.5 * jnp.log(jnp.diagonal(cov))


log_std = Parametrisation(lambda theta: jnp.diag(jnp.exp(2 * theta)), _log_std_inverse)
"""A diagonal covariance from the logarithms (n,) of its standard deviations; the inverse drops correlations."""


def shared(n: int) -> Parametrisation:
    """The same variance on n axes, without correlations, from one number (): the logarithm of the standard deviation.

    The inverse takes the mean of the variances.

    Example: GNSS, as good north as east.
        >>> import math
        >>> shared(2).cov(math.log(3.0)).round(4).tolist()
        [[9.0, 0.0], [0.0, 9.0]]

    Raises:
        ValueError: n < 1; a theta that is not one number; for the inverse, what is no covariance, or 0.
    """
    if n < 1:
        raise ValueError(f"shared(n): expected at least 1, got {n}")

    def cov(theta: Array) -> Array:
        if np.shape(theta) != ():
            raise ValueError(f"theta: expected one number, got shape {np.shape(theta)}")
        variance = jnp.exp(2 * jnp.asarray(theta))
        return variance * jnp.eye(n, dtype=variance.dtype)

    def theta(cov: Array) -> Array:
        doors.covariance("cov", cov, n)
        variance = jnp.mean(jnp.diagonal(cov))
        if doors.is_concrete(variance) and not variance > 0:
            raise ValueError(f"cov: expected a positive variance, got {variance:.6g}")
        return 0.5 * jnp.log(variance)

    return Parametrisation(cov, theta)


def log_cholesky(n: int) -> Parametrisation:
    """A full (n, n) covariance ``L L'`` from n (n + 1) / 2 numbers: L row by row, its diagonal as logarithms.

    Source: Pinheiro, Bates, Unconstrained parametrizations for variance-covariance matrices (1996), section 2.2.
    """
    rows, columns = np.tril_indices(n)
    on_diagonal = rows == columns

    def cov(theta: Array) -> Array:
        if theta.shape != (len(rows),):
            raise ValueError(f"theta: expected shape ({len(rows)},), got {theta.shape}")
        elements = jnp.where(on_diagonal, jnp.exp(jnp.where(on_diagonal, theta, 0.0)), theta)
        L = jnp.zeros((n, n), theta.dtype).at[rows, columns].set(elements)
        return L @ L.T

    def theta(cov: Array) -> Array:
        doors.covariance("cov", cov, n)
        elements = linalg.cholesky(jnp.asarray(cov))[rows, columns]
        if doors.is_concrete(elements) and np.isnan(elements).any():
            raise ValueError("cov: expected a positive definite matrix, got a singular one")
        return jnp.where(on_diagonal, jnp.log(jnp.where(on_diagonal, elements, 1.0)), elements)

    return Parametrisation(cov, theta)


def blocks(*parts: tuple[Parametrisation, int]) -> Parametrisation:
    """A block-diagonal covariance: each part a parametrisation and its dimension; theta is a tuple of their thetas.

    Example: a full block for the position, one number for the clock.
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> R = jf.blocks((jf.log_cholesky(2), 2), (jf.log_std, 1))
        >>> R.cov(R.theta(jnp.diag(jnp.array([4.0, 1.0, 9.0])))).diagonal().round(4).tolist()
        [4.0, 1.0, 9.0]
    """
    ends = np.cumsum([dim for _, dim in parts]).tolist()
    starts = [end - dim for end, (_, dim) in zip(ends, parts, strict=True)]

    def cov(theta: tuple) -> Array:
        if len(theta) != len(parts):
            raise ValueError(f"theta: expected a tuple of {len(parts)}, one for each block, got {len(theta)}")
        return jax.scipy.linalg.block_diag(*[p.cov(t) for (p, _), t in zip(parts, theta, strict=True)])

    def theta(cov: Array) -> tuple:
        doors.covariance("cov", cov, ends[-1])
        return tuple(p.theta(cov[i:j, i:j]) for (p, _), i, j in zip(parts, starts, ends, strict=True))

    return Parametrisation(cov, theta)


def floored(parametrisation: Parametrisation, std: Array | float) -> Parametrisation:
    """A covariance that never falls below a floor: ``cov(theta) + diag(std^2)``, whatever theta.

    Args:
        parametrisation: of what comes on top of the floor.
        std: standard deviation of the floor, one number or (n,), >= 0, in the unit of each axis: a sensor's resolution,
            say. What lies on the floor is not moved by theta any more.

    Returns:
        A `Parametrisation` whose theta is that of the one given.

    Raises:
        ValueError: a std that is negative or not finite; for the inverse, a covariance that is not above the floor.

    Example: a range finder that resolves 1 cm.
        >>> import jax.numpy as jnp
        >>> R = floored(log_std, 0.01)
        >>> round(float(R.cov(jnp.array([-50.0]))[0, 0] ** 0.5), 4)
        0.01
    """
    std = np.asarray(std, np.float64)
    if not (np.isfinite(std) & (std >= 0)).all():
        raise ValueError(f"floored(std): expected finite numbers >= 0, got {std}")

    def floor(like: Array) -> jax.Array:
        if std.shape not in ((), like.shape[:1]):
            raise ValueError(f"floored(std): expected one number or shape {like.shape[:1]}, got {std.shape}")
        return jnp.diag(jnp.asarray(np.broadcast_to(std**2, like.shape[:1]), like.dtype))

    def cov(theta: PyTree) -> Array:
        above = parametrisation.cov(theta)
        return above + floor(above)

    def theta(cov: Array) -> PyTree:
        doors.covariance("cov", cov)
        above = jnp.asarray(cov) - floor(cov)
        if doors.is_concrete(above) and np.isnan(linalg.cholesky(above)).any():
            raise ValueError(f"cov: expected one above the floor, variances {std**2}, got {np.asarray(cov).tolist()}")
        return parametrisation.theta(above)

    return Parametrisation(cov, theta)
