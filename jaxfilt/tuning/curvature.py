"""How a loss bends at its minimum, and how sure that makes theta: Hessian and standard errors; host side, float64.

At a minimum of the loss, with Hessian H, each run has a say of its own in where the minimum is. Given a little more
weight, run i moves it by ``-H^-1 psi_i``, ``psi_i = d/dw_i grad L(sum_i w_i s_i(theta))`` at w = 1, s_i the run's sums.
The standard errors are those of such moves; where the loss is a log likelihood, H alone tells them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.types import Array

WEIGHT = 0.01
"""Share of a direction's largest entry below which a parameter is no part of it."""


class Hessian(NamedTuple):
    """``matrix`` (p, p), symmetric, and ``noise`` (p, p) >= 0, how large the error of each of its elements may be."""

    matrix: np.ndarray
    noise: np.ndarray


def hessian(gradient: Callable[[Array], Array], at: Array, step: float | None = None) -> Hessian:
    """Hessian by central differences of an exact gradient: 2 p calls of what is compiled already.

    ``H[:, j] = (g(at + h e_j) - g(at - h e_j)) / 2h``. Where the loss bends sharply, ``H[j, j] > 100``, as it does
    along a length or a time that each row tells to a tenth of its unit, the column is taken again with h times
    ``H[j, j]^-1/2``; where it is not finite so far away, with a tenth of h. An exact Hessian is symmetric; how much
    this one is not tells its noise.

    Args:
        gradient: (p,) -> (p,).
        at: (p,), in the precision of the gradient.
        step: h; default ``eps^(1/4)``, 1e-4 in float64 and 0.02 in float32, which makes errors of h^2 and eps / h.

    Returns:
        Hessian(matrix, noise); NaN where the gradient is.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> H = hessian(jax.grad(lambda x: x[0] ** 2 + 3 * x[0] * x[1]), jnp.array([1.0, 2.0]))
        >>> H.matrix.round(2).tolist()
        [[2.0, 3.0], [3.0, 0.0]]
    """
    return hessian_and_slopes(lambda v: (gradient(v), {}), at, step)[0]


def hessian_and_slopes(
    evaluate: Callable[[Array], tuple[Array, Mapping[str, Array]]], at: Array, step: float | None = None
) -> tuple[Hessian, dict[str, np.ndarray]]:
    """The Hessian, and by the same calls the derivatives of each run's sums, for `influence`.

    Args:
        evaluate: (p,) -> the gradient (p,) and the sums, name -> (R, ...).
        at, step: as in `hessian`.

    Returns:
        Hessian and slopes, name -> (R, ..., p).
    """
    at = np.asarray(at)
    h = float(np.finfo(at.dtype).eps ** 0.25) if step is None else step

    def column(j: int, h: float) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        ahead, behind = at.copy(), at.copy()
        ahead[j], behind[j] = at[j] + h, at[j] - h
        moved = float(ahead[j]) - float(behind[j])  # in float32 not quite 2 h
        with np.errstate(invalid="ignore"):  # sums of a run that has diverged
            return jax.tree.map(lambda a, b: (_float64(a) - _float64(b)) / moved, evaluate(ahead), evaluate(behind))

    columns = [column(j, h) for j in range(len(at))]
    for j, (own, _) in enumerate(columns):
        if not own[j] <= 100 or not np.isfinite(own).all():
            columns[j] = column(j, h * (own[j] ** -0.5 if 100 < own[j] < np.inf else 0.1))
    raw, slopes = jax.tree.map(lambda *each: np.stack(each, axis=-1), *columns)
    size = np.sqrt(np.abs(np.diag(raw)))
    noise = 0.5 * np.abs(raw - raw.T) + h**2 * np.outer(size, size)
    return Hessian(0.5 * (raw + raw.T), noise), slopes


def _float64(a: Array) -> np.ndarray:
    return np.asarray(a, np.float64)


def influence(
    loss: Callable[[dict[str, Array]], Array], sums: Mapping[str, Array], slopes: Mapping[str, Array]
) -> np.ndarray:
    """What each run, or each block of a long one, has to say: ``psi_i = d/dw_i grad L(sum_i w_i s_i(theta))``.

    ``psi_i = s_i' grad L + S' (hess L) s_i``, ' for the derivative by theta, S the sum of the s_i. The first term is
    the gradient of the run's own part. The second vanishes at the minimum of a mean over rows; but where the loss is
    the squared difference of a mean from what it should be, the first vanishes and the second is all there is.

    Args:
        loss: of an `Objective`: sums -> number.
        sums: name -> (R, ...), s_i of each run.
        slopes: name -> (R, ..., p), their derivatives by theta.

    Returns:
        (R, p).

    Example: the mean of a theta squared.
        >>> import jax.numpy as jnp
        >>> sums = {"count": jnp.array([1.0, 1.0]), "square": jnp.array([1.0, 3.0])}
        >>> slopes = {"count": jnp.zeros((2, 1)), "square": jnp.array([[1.0], [-1.0]])}
        >>> influence(lambda s: s["square"] / s["count"], sums, slopes).tolist()
        [[0.5], [-0.5]]

    Source: the infinitesimal jackknife; B. Efron, The Jackknife, the Bootstrap and Other Resampling Plans (1982),
    chapter 6.
    """
    gradient, turned = _derivatives(loss, {name: jnp.asarray(value) for name, value in sums.items()})
    psi = 0.0
    for name, own in slopes.items():
        slope = _float64(own)
        slope = slope.reshape(len(slope), -1, slope.shape[-1])
        psi = psi + np.einsum("rkp,k->rp", slope, np.ravel(_float64(gradient[name])))
        moved = _float64(turned[name]).reshape(len(slope), -1)
        psi = psi + np.einsum("kp,rk->rp", slope.sum(0), moved)
    return np.asarray(psi)


@partial(jax.jit, static_argnums=0)
def _derivatives(loss: Callable, sums: dict[str, Array]) -> tuple[dict[str, Array], dict[str, Array]]:
    """grad L at the total, and (hess L) s_i for each run."""
    total = {name: value.sum(0) for name, value in sums.items()}
    return jax.grad(loss)(total), jax.vmap(lambda s: jax.jvp(jax.grad(loss), (total,), (s,))[1])(sums)


def standard_errors(hessian: Hessian, *, count: float | None = None, influence: Array | None = None) -> np.ndarray:
    """Standard deviations of the parameters that minimise a loss, by how it bends and, if need be, how runs differ.

    Of a negative log likelihood ``count L``: the roots of the diagonal of ``(count H)^-1``. Of any other loss the
    sandwich ``R / (R - 1) H^-1 sum_i (psi_i psi_i') H^-1``, which is right also where the model is wrong and errors are
    correlated within a run.

    Args:
        hessian: of the loss, at its minimum.
        count: of a likelihood, so that count times the loss is minus its logarithm.
        influence: (R, p) from `influence`, R independent runs, or blocks long against the time of correlation.

    Returns:
        (p,): inf where a parameter may move along a direction without curvature; NaN where neither count nor influence
        is given, there are no more runs than parameters, or the Hessian is not finite.

    Example: a bowl of curvature 4 a row, over 25 rows; and a parameter that does nothing.
        >>> import numpy as np
        >>> standard_errors(Hessian(np.diag([4.0, 0.0]), np.zeros((2, 2))), count=25).tolist()
        [0.1, inf]

    Source: P. J. Huber, The behavior of maximum likelihood estimates under nonstandard conditions (1967); H. White,
    Maximum likelihood estimation of misspecified models, Econometrica 50 (1982), theorem 3.2.
    """
    if not np.isfinite(hessian.matrix).all():
        return np.full(len(hessian.matrix), np.nan)
    axes, cov, flat, _ = modes(hessian, count, influence)
    own, cov = axes[:, ~flat], cov[np.ix_(~flat, ~flat)]
    error = np.sqrt(np.einsum("jk,kl,jl->j", own, cov, own))
    null = np.abs(axes[:, flat])
    loose = (null > WEIGHT * null.max(axis=0, initial=0.0)).any(1)
    return np.where(loose, np.inf, error)


class Modes(NamedTuple):
    """The eigenvectors of a Hessian: columns of ``axes`` (p, p), what theta does when a mode moves by 1.

    ``cov`` (p, p) of the modes, those without curvature taken for 1; ``flat`` (p,), those without curvature, as far as
    one can tell; ``down`` (p,), those of them along which the loss bends down.
    """

    axes: np.ndarray
    cov: np.ndarray
    flat: np.ndarray
    down: np.ndarray


def modes(hessian: Hessian, count: float | None = None, influence: Array | None = None) -> Modes:
    """The eigenvectors of a Hessian, and how far theta may move along them.

    A parameter with a curvature above 1 is measured in units of its own, ``H[j, j]^-1/2``, so that what is rounding is
    judged alike for millimetres and for logarithms.

    Args:
        hessian, count, influence: as in `standard_errors`.
    """
    H = hessian.matrix
    p = len(H)
    unit = 1 / np.sqrt(np.maximum(1.0, np.diag(H)))
    curvature, vectors = np.linalg.eigh(unit[:, None] * H * unit)
    axes = unit[:, None] * vectors
    noise = np.einsum("ik,ij,jk->k", np.abs(axes), hessian.noise, np.abs(axes))
    flat = curvature <= noise
    inverse = 1 / np.where(flat, 1.0, curvature)
    cov = np.full((p, p), np.nan)
    if count is not None:
        cov = np.diag(inverse) / count
    elif influence is not None and len(influence) > p:
        psi = _float64(influence)
        moves = (psi - psi.mean(0)) @ axes * inverse
        cov = len(psi) / (len(psi) - 1) * moves.T @ moves
    return Modes(axes, cov, flat, curvature < -noise)
