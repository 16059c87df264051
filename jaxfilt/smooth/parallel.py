"""The backward pass over all rows at once, wherever the state's space is flat.

``d_k = G_k (d_{k+1} + minus(m_{k+1}, m'_{k+1}))``, with d the smoothed mean less the filtered, is affine in d, whatever
the model: and affine maps compose associatively.

Source: S. Sarkka, A. F. Garcia-Fernandez, Temporal parallelization of Bayesian smoothers, IEEE Trans. Automatic Control
66(1) (2021), lemmas 9 and 10.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxfilt import linalg
from jaxfilt.smooth.links import link
from jaxfilt.types import Array, Filter, Gaussian, Log, PyTree


class Return(NamedTuple):
    """Back over some rows: ``d = E d' + g + N(0, D)`` with d' that of the row after them."""

    E: Array
    g: Array
    D: Array


def smoothed(filter: Filter, beliefs: Gaussian, log: Log) -> tuple[Gaussian, Array]:
    """The belief after each row given all, and the covariances (T - 1, n, n) of each row's state with the next row's.

    Args:
        filter: of a flat state space.
        beliefs: of the filter after each row, leading axis T.
        log: T rows.

    Raises:
        ValueError: a curved space.
    """
    space = filter.model.space
    if not space.flat:
        raise ValueError("filter: expected a state on a flat space for parallel=True, got one on a curved space")

    def back(before: Gaussian, after: Gaussian, u: PyTree, dt: jax.Array) -> Return:
        between = link(filter, before, u, dt)
        return Return(between.gain, between.gain @ space.minus(after.mean, between.mean), between.rest)

    now, then = jax.tree.map(lambda a: a[:-1], beliefs), jax.tree.map(lambda a: a[1:], beliefs)
    u, dt = jax.tree.map(lambda a: a[1:], (log.u, log.dt))
    returns = jax.vmap(back)(now, then, u, dt)
    nought = jnp.zeros_like(beliefs.cov[-1])
    last = Return(nought, nought[0], beliefs.cov[-1])
    from_end = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), returns, last)
    whole = jax.lax.associative_scan(jax.vmap(_composed), from_end, reverse=True)
    covs = jax.vmap(linalg.symmetrize)(whole.D)
    return Gaussian(jax.vmap(space.plus)(beliefs.mean, whole.g), covs), returns.E @ covs[1:]


def _composed(later: Return, earlier: Return) -> Return:
    """Back over the later rows, then over the earlier."""
    E = earlier.E
    return Return(E @ later.E, E @ later.g + earlier.g, E @ later.D @ E.T + earlier.D)
