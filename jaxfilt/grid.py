"""The discrete Bayes filter: a probability for each of many points of the state space, and no Gaussian."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors, linalg
from jaxfilt.mixture import moments
from jaxfilt.prediction import advanced, branch, canonical, interval, stepper
from jaxfilt.types import Array, Filter, Gaussian, Info, Model, PyTree, Space
from jaxfilt.weighing import LOWEST, normalised, weighed

Moves = Callable[[PyTree, Array], Array]

NARROW = 1e-4
"""Standard deviation that stands for none, as a share of the grid's extent: the nearest point gets it all."""


class Cells(NamedTuple):
    """What a grid filter carries."""

    log_probability: Array
    """(N,), one for each point of the filter, their exponentials of sum 1."""


def lattice(space: Space, *axes: Array) -> PyTree:
    """Points for a `grid`: one for each combination of the coordinates along the axes of the tangent space.

    Args:
        space: of dimension n.
        axes: n arrays of coordinates: ``plus(origin, d)`` is the point of the tangent vector d.

    Returns:
        Points of the space, leading axis N, the product of the lengths; the last axis varies fastest.

    Raises:
        ValueError: more or fewer axes than the space has dimensions.

    Example:
        >>> import numpy as np, jaxfilt as jf
        >>> lattice(jf.vector(2), np.array([0.0, 1.0]), np.array([5.0, 6.0])).tolist()
        [[0.0, 5.0], [0.0, 6.0], [1.0, 5.0], [1.0, 6.0]]
    """
    if len(axes) != space.dim:
        raise ValueError(f"axes: expected {space.dim}, one for each dimension of the space, got {len(axes)}")
    d = jnp.stack([a.ravel() for a in jnp.meshgrid(*map(jnp.asarray, axes), indexing="ij")], axis=1)
    origin = jax.tree.map(lambda a: jnp.asarray(a, d.dtype), space.origin)
    return jax.vmap(lambda d: space.plus(origin, d))(d)


def grid(model: Model, points: PyTree, moves: Moves | None = None) -> Filter:
    """Discrete Bayes filter (histogram filter): any distribution whatever, on a grid of points.

    ``predict``  p_i <- sum_j T_ij p_j, with ``T_ij`` proportional to ``N(minus(x_i, f(x_j, u, dt)); 0, Q)``, each
    column of sum 1. ``update``  p_i <- p(z | x_i) p_i / sum_j p(z | x_j) p_j, p(z | x) the sensor's law, or normal.

    All in logarithms. Exact for a state that has these values and no others, else as good as the grid is fine: points
    at equal distances, no further apart than about the standard deviations of Q and R. The grid's end is a wall:
    nothing leaves. Where Q is singular the nearest point gets it all. A prediction costs N^2, an update N.

    It carries `Cells`; begun from a Gaussian, they have its density. ``Cells(jnp.zeros(N))`` knows nothing.

    Args:
        model: the robot and its sensors.
        points: of the state space, leading axis N; `lattice` makes them.
        moves: function of (u, dt) that returns T (N, N), column j the probabilities of what follows x_j, where f and Q
            do not tell.

    Returns:
        Filter(predict, update, step, model): ``loglik`` is exact on the grid. A gate it has none.

    Raises:
        ValueError, TypeError: points that are none of the state space, or fewer than two; at the first call a T that is
            no matrix of transition probabilities.

    Example: the lecture's drone sees a bright ground. Is it at home?
        >>> import jax.numpy as jnp
        >>> from jaxfilt.models.corridor import landing_zone
        >>> filt = grid(landing_zone(), jnp.array([0.0, 1.0]))
        >>> cells, info = filt.update(filt.begin(Cells(jnp.zeros(2))), jnp.asarray(1.0), "bright")
        >>> jnp.exp(cells.log_probability).round(4).tolist(), round(float(jnp.exp(info.loglik)), 4)
        ([0.33329999446868896, 0.666700005531311], 0.45)

    Source: Thrun, Burgard, Fox, Probabilistic Robotics (2005), table 4.1.
    """
    doors.instance("model", model, Model)
    leaves = jax.tree.leaves(points)
    count = len(leaves[0]) if leaves and np.ndim(leaves[0]) else 0
    doors.point("points", points, model.space, leading=(count,))
    doors.finite("points", points)
    if count < 2:
        raise ValueError(f"points: expected at least two, got {count}")

    def places(dtype: jnp.dtype) -> PyTree:
        return jax.tree.map(lambda a: jnp.asarray(a, dtype), points)

    def begin(belief: Gaussian | Cells, key: Array | None = None) -> Cells:
        if isinstance(belief, Cells):
            return Cells(normalised(held(belief).log_probability)[0])
        mean, cov = canonical(belief, model.space)
        x = places(cov.dtype)
        d = jax.vmap(model.space.minus, (0, None))(x, mean)
        return Cells(normalised(_log_shape(d, cov, _extent(x, model.space)))[0])

    def held(cells: Cells) -> Cells:
        doors.instance("cells", cells, Cells)
        doors.array("cells.log_probability", cells.log_probability)
        doors.floating("cells.log_probability", cells.log_probability)
        if np.shape(cells.log_probability) != (count,):
            raise ValueError(f"cells.log_probability: expected shape ({count},), got {np.shape(cells.log_probability)}")
        return Cells(jnp.maximum(jnp.asarray(cells.log_probability), LOWEST))

    def predict(cells: Cells, u: PyTree = (), dt: Array | float = 0.0) -> Cells:
        cells = held(cells)
        dtype = cells.log_probability.dtype
        doors.inputs("u", u, dtype)
        passes, dt = interval(dt, cells)

        def on(cells: Cells) -> Cells:
            T = _log_moves(model, places(dtype), u, dt) if moves is None else _given(moves, u, dt, count, dtype)
            return Cells(normalised(jax.nn.logsumexp(T + cells.log_probability[None, :], axis=1))[0])

        return branch(passes, on, lambda cells: cells, cells)

    def update(cells: Cells, z: PyTree, sensor: str, c: PyTree = (), mask: Array | None = None) -> tuple[Cells, Info]:
        before = held(cells).log_probability
        after, info = weighed(model, sensor, places(before.dtype), before, z, c, mask)
        return Cells(after), info

    def gaussian(cells: Cells) -> Gaussian:
        log_probability = held(cells).log_probability
        return moments(places(log_probability.dtype), jnp.exp(log_probability), model.space)

    return Filter(predict, update, stepper(model, predict, update), model, begin, gaussian)


def _extent(points: PyTree, space: Space) -> jax.Array:
    """(n,): how far from one point the others reach, in each direction; 1 where they do not."""
    first = jax.tree.map(lambda a: a[0], points)
    reach = jnp.abs(jax.vmap(space.minus, (0, None))(points, first)).max(0)
    return jnp.where(reach > 0, reach, 1.0)


def _log_shape(d: jax.Array, cov: jax.Array, extent: jax.Array) -> jax.Array:
    """log N(d; 0, cov) of many d (N, n), but for a constant; directions without variance count as narrow."""
    L = linalg.semidefinite_cholesky(cov)
    L = L + jnp.diag(jnp.where(jnp.diagonal(L) == 0, NARROW * extent, 0.0))
    e = linalg.forward_solve(L, d.T)
    return -0.5 * (e * e).sum(0)


def _log_moves(model: Model, points: PyTree, u: PyTree, dt: jax.Array) -> jax.Array:
    """log T (N, N), from f and Q."""
    dtype = dt.dtype
    extent = _extent(points, model.space)

    def column(x: PyTree) -> jax.Array:
        ahead = advanced(model, x, u, dt, dtype)
        Q = doors.call("Q(x, u, dt)", model.Q, x=x, u=u, dt=dt)
        doors.noise("Q(x, u, dt)", Q, model.space.dim, dtype)
        d = jax.vmap(model.space.minus, (0, None))(points, ahead)
        return jax.nn.log_softmax(_log_shape(d, jnp.asarray(Q, dtype), extent))

    return jax.vmap(column, out_axes=1)(points)


def _given(moves: Moves, u: PyTree, dt: jax.Array, count: int, dtype: jnp.dtype) -> jax.Array:
    """log T (N, N), from the user's function."""
    T = doors.call("moves(u, dt)", moves, u=u, dt=dt)
    doors.array("moves(u, dt)", T)
    doors.same_dtype(dtype, **{"moves(u, dt)": T})
    if np.shape(T) != (count, count):
        raise ValueError(f"moves(u, dt): expected shape {(count, count)}, got {np.shape(T)}")
    if doors.is_concrete(T):
        sums = np.asarray(T, np.float64).sum(0)
        if not (np.asarray(T) >= 0).all() or not np.allclose(sums, 1, atol=1e-4):
            worst = sums[np.abs(sums - 1).argmax()]
            raise ValueError(f"moves(u, dt): expected probabilities, each column of sum 1, got a sum of {worst:.6g}")
    T = jnp.asarray(T, dtype)
    return jnp.where(T > 0, jnp.log(jnp.where(T > 0, T, 1.0)), LOWEST)
