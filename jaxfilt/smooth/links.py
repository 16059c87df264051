"""One step of a smoother: from what is known after an interval to what is known before it.

With the filter's belief ``(m, P)`` after a row, the next row's prediction ``(m', P')``
from it, and the covariance C of the state before with the state after (Rauch, Tung, Striebel):
``G = C P'^-1;  m_s = m + G (m_s' - m');  P_s = remainder(G) + G P_s' G'``.

``remainder(G)`` is the covariance of ``x - G x'``, a product like Joseph's form, so ``P_s`` is positive semidefinite by
construction; the book's ``P + G (P_s' - P') G'`` is the same and is not. Which filter it was is in its `Transition`
alone. + and - are those of the state's space.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxfilt import doors, linalg
from jaxfilt.correction import moved
from jaxfilt.prediction import branch, interval
from jaxfilt.types import Array, Filter, Gaussian, PyTree, Space


class Link(NamedTuple):
    """How a row's state follows from the next row's: ``x = m + gain minus(x', mean) + N(0, rest)``.

    ``mean`` is that predicted for the next row, ``gain`` (n, n) is G, ``rest`` (n, n) remainder(G). Where no time
    passes in between (``moves`` False) the two states are one.
    """

    moves: Array
    mean: PyTree
    gain: Array
    rest: Array


def with_transition(filter: Filter) -> None:
    doors.instance("filter", filter, Filter)
    if filter.transition is None:
        raise TypeError("filter: expected one with a transition (kf, ekf, iekf, ukf, ckf, build), got one without")


def link(filter: Filter, before: Gaussian, u: PyTree, dt: Array) -> Link:
    """The link between the belief before an interval and that predicted after it."""
    moves, length = interval(dt, before)

    def of(belief: Gaussian) -> Link:
        passed = filter.transition(belief, u, length)  # pyright: ignore[reportOptionalCall]
        gain = _gain(passed.cross, passed.belief.cov)
        return Link(jnp.asarray(True), passed.belief.mean, gain, linalg.symmetrize(passed.remainder(gain)))

    return branch(moves, of, no_time, before)


def back(space: Space, before: Gaussian, link: Link, after: Gaussian) -> tuple[Gaussian, Array]:
    """The belief before an interval given all that is known after it, and the covariance of the two states."""
    offset = space.minus(after.mean, link.mean)
    delta = link.gain @ offset
    # What is known of the state after is written at its own mean; the link speaks of errors at the mean predicted.
    there = _carried(space, after.mean, jnp.zeros_like(offset), link.mean, after.cov)
    spread = _carried(space, after.mean, jnp.zeros_like(offset), link.mean, there.T)
    belief = moved(space, before, delta, link.rest + link.gain @ spread @ link.gain.T)
    cross = _carried(space, before.mean, delta, belief.mean, link.gain @ there)
    return jax.tree.map(lambda a, b: jnp.where(link.moves, a, b), (belief, cross), (after, after.cov))


def _carried(space: Space, base: PyTree, delta: Array, mean: PyTree, M: Array) -> Array:
    """``J M``: errors about ``plus(base, delta)``, written at base, as they are written at another mean."""
    if space.flat:
        return M
    return jax.jacfwd(lambda d: space.minus(space.plus(base, d), mean))(delta) @ M


def no_time(belief: Gaussian) -> Link:
    eye = jnp.eye(len(belief.cov), dtype=belief.cov.dtype)
    return Link(jnp.asarray(False), belief.mean, eye, jnp.zeros_like(eye))


def _gain(cross: Array, P: Array) -> Array:
    """``C P^-1``; where a state is a linear function of others after the interval, or known, it is left out."""
    L = linalg.semidefinite_cholesky(P)
    counts = jnp.diagonal(L) != 0
    both = counts[:, None] & counts[None, :]
    eye = jnp.eye(len(P), dtype=P.dtype)
    return linalg.solve(jnp.where(both, P, eye), jnp.where(both, L, eye), jnp.where(counts, cross, 0.0).T).T
