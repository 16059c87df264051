"""A trajectory's residuals and their linearisation: each factor on its own, all instants at once.

Unknown are the states before the first row and after each, T + 1 of them, as offsets y (T + 1, n) from a base, in
units of ``Frame.scale``. Factors: the prior belief, the dynamics over each row, each reading, each `Between`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors, linalg
from jaxfilt.correction import image
from jaxfilt.graph.between import Between
from jaxfilt.graph.chain import Chain, Ties
from jaxfilt.types import Array, Gaussian, Log, Model, PyTree

LOOSE = 1e-3
"""Of a standard deviation: how far a state that has no process noise may be off its dynamics at the price of one unit
of cost, while the solver is on its way. In the solution it is not off at all."""


class Data(NamedTuple):
    """What was believed and measured: ``there``, sensor -> (T, m) bool; ``limits``, sensor -> thresholds of robust
    losses, and ``tied``, those of each `Between`, None where the loss is quadratic."""

    prior: Gaussian
    log: Log
    there: dict[str, Array]
    between: tuple[Between, ...]
    limits: dict[str, np.ndarray]
    tied: tuple[np.ndarray | None, ...]


class Frame(NamedTuple):
    """Where offsets count from, and the noises there: what is held while the solver moves.

    ``start`` and ``Q`` (T, n, n) are covariances, ``whiten`` lower factors that residuals are divided by: of the start,
    of the dynamics, sensor -> of readings, and of each `Between`.
    """

    base: PyTree
    scale: Array
    start: Array
    Q: Array
    whiten: tuple[Array, Array, dict[str, Array], tuple[Array, ...]]


class Problem(NamedTuple):
    """The functions of one trajectory, over a model. Nothing of it but what JAX traces changes."""

    model: Model
    data: Data

    def points(self, frame: Frame, y: jax.Array) -> PyTree:
        """The states (T + 1) at offsets y."""
        return jax.vmap(self.model.space.plus)(frame.base, frame.scale * y)

    def frame(self, base: PyTree, scale: jax.Array) -> Frame:
        """The noises at these states."""
        log, prior, dtype, n = self.data.log, self.data.prior, self.data.prior.cov.dtype, self.model.space.dim

        def process(x: PyTree, u: PyTree, dt: jax.Array) -> jax.Array:
            Q = doors.call("Q(x, u, dt)", self.model.Q, x=x, u=u, dt=jnp.where(dt > 0, dt, 1.0))
            doors.noise("Q(x, u, dt)", Q, n, dtype)
            return jnp.where(dt > 0, jnp.asarray(Q, dtype), 0.0)

        def loose(cov: jax.Array, scale: jax.Array) -> jax.Array:
            L = linalg.semidefinite_cholesky(cov)
            return L + jnp.diag(jnp.where(jnp.diagonal(L) == 0, LOOSE * scale, 0.0))

        def noise(name: str) -> jax.Array:
            sensor = self.model.sensors[name]

            def of(x: PyTree, c: PyTree, there: jax.Array) -> jax.Array:
                R = doors.call(f"R(x, c) of sensor {name!r}", sensor.R, x=x, c=c)
                doors.noise(f"R(x, c) of sensor {name!r}", R, sensor.space.dim, dtype)
                both = there[:, None] & there[None, :]
                return linalg.cholesky(jnp.where(both, R, jnp.eye(len(there), dtype=dtype)))

            return jax.vmap(of)(_after(base), log.c.get(name, ()), self.data.there[name])

        def between(k: int, tie: Between) -> jax.Array:
            def of(a: PyTree, b: PyTree, c: PyTree) -> jax.Array:
                R = doors.call(f"R(a, b, c) of between[{k}]", tie.R, a=a, b=b, c=c)
                doors.noise(f"R(a, b, c) of between[{k}]", R, tie.space.dim, dtype)
                return linalg.cholesky(jnp.asarray(R, dtype))

            return jax.vmap(of)(_at(base, tie.rows[:, 0]), _at(base, tie.rows[:, 1]), tie.c)

        Q = jax.vmap(process)(_before(base), log.u, log.dt)
        whiten = (
            loose(prior.cov, scale[0]),
            jax.vmap(loose)(Q, scale[1:]),
            {name: noise(name) for name in self.data.there},
            tuple(between(k, tie) for k, tie in enumerate(self.data.between)),
        )
        return Frame(base, scale, prior.cov, Q, whiten)

    def residuals(self, frame: Frame, y: jax.Array) -> PyTree:
        """Whitened residuals, of which half the sum of squares is the cost: prior, dynamics, readings, between."""
        x, data = self.points(frame, y), self.data
        of_start, of_dynamics, of_readings, of_between = frame.whiten
        whitened = jax.vmap(linalg.forward_solve)
        start = linalg.forward_solve(of_start, self.model.space.minus(_at(x, 0), data.prior.mean))
        dynamics = whitened(of_dynamics, self._dynamics(x))
        readings = {}
        for name, L in of_readings.items():
            e = whitened(L, self._reading(name, x))
            readings[name] = _robust(e, data.there[name].sum(1), data.limits.get(name))
        ties = []
        for L, tie, limits in zip(of_between, data.between, data.tied, strict=True):
            e = whitened(L, _seen(tie, _at(x, tie.rows[:, 0]), _at(x, tie.rows[:, 1])))
            ties.append(_robust(e, jnp.full(len(e), e.shape[1]), limits))
        return start, dynamics, readings, tuple(ties)

    def linear(self, frame: Frame, x: PyTree) -> tuple[Chain, Ties | None]:
        """The linear problem for tangent offsets d (T + 1, n) at the states x; robust losses as weights."""
        data, space = self.data, self.model.space
        e0 = space.minus(_at(x, 0), data.prior.mean)
        G0 = _slope(lambda e: space.minus(space.plus(data.prior.mean, e), _at(x, 0)), e0)

        def step(a: PyTree, b: PyTree, u: PyTree, dt: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            # b's offset is a function of a's offset and of the noise e: no residual has to be inverted.
            e = space.minus(b, self._next(a, u, dt))

            def offset(d: jax.Array, e: jax.Array) -> jax.Array:
                return space.minus(space.plus(self._next(space.plus(a, d), u, dt), e), b)

            F = _slope(lambda d: offset(d, e), jnp.zeros_like(e))
            G = _slope(lambda e: offset(jnp.zeros_like(e), e), e)
            return F, -G @ e, G

        F, g, G = jax.vmap(step)(_before(x), _after(x), data.log.u, data.log.dt)
        Q = jax.vmap(lambda G, Q: linalg.symmetrize(G @ Q @ G.T))(G, frame.Q)
        H, r = self._linear_readings(frame, _after(x))
        chain = Chain(-G0 @ e0, linalg.symmetrize(G0 @ frame.start @ G0.T), F, g, Q, H, r, data.log.dt > 0)
        return chain, self._linear_ties(frame, x)

    def _linear_readings(self, frame: Frame, x: PyTree) -> tuple[jax.Array, jax.Array]:
        pieces = [self._linear_reading(name, L, x) for name, L in frame.whiten[2].items()]
        if not pieces:
            steps, n, dtype = len(self.data.log.dt), self.model.space.dim, self.data.prior.cov.dtype
            return jnp.zeros((steps, 1, n), dtype), jnp.zeros((steps, 1), dtype)
        H, r = (jnp.concatenate(parts, 1) for parts in zip(*pieces, strict=True))
        return H, r

    def _linear_reading(self, name: str, L: jax.Array, x: PyTree) -> tuple[jax.Array, jax.Array]:
        data, space, minus = self.data, self.model.space, self.model.sensors[name].space.minus
        zero = jnp.zeros(space.dim, L.dtype)

        def of(x: PyTree, z: PyTree, c: PyTree, there: jax.Array, L: jax.Array) -> tuple[jax.Array, jax.Array]:
            def e(d: jax.Array) -> jax.Array:
                return jnp.where(there, minus(z, self._expected(name, space.plus(x, d), c)), 0.0)

            return linalg.forward_solve(L, -_slope(e, zero)), linalg.forward_solve(L, e(zero))

        there = data.there[name]
        H, e = jax.vmap(of)(x, data.log.z[name], data.log.c.get(name, ()), there, L)
        w = _root_weight(e, there.sum(1), data.limits.get(name))
        return w[:, None, None] * H, w[:, None] * e

    def _linear_ties(self, frame: Frame, x: PyTree) -> Ties | None:
        factors = zip(self.data.between, frame.whiten[3], self.data.tied, strict=True)
        pieces = [self._linear_tie(tie, L, limits, x) for tie, L, limits in factors]
        return jax.tree.map(lambda *parts: jnp.concatenate(parts), *pieces) if pieces else None

    def _linear_tie(self, tie: Between, L: jax.Array, limits: np.ndarray | None, x: PyTree) -> Ties:
        space, m = self.model.space, tie.space.dim
        zero = jnp.zeros(space.dim, L.dtype)

        def of(a: PyTree, b: PyTree, z: PyTree, c: PyTree, L: jax.Array) -> tuple:
            def e(da: jax.Array, db: jax.Array) -> jax.Array:
                return tie.space.minus(z, _call(tie, space.plus(a, da), space.plus(b, db), c))

            A, B = jax.jacfwd(e, (0, 1))(zero, zero)
            return tuple(linalg.forward_solve(L, part) for part in (-A, -B, e(zero, zero)))

        A, B, e = jax.vmap(of)(_at(x, tie.rows[:, 0]), _at(x, tie.rows[:, 1]), tie.z, tie.c, L)
        w = _root_weight(e, jnp.full(len(e), m), limits)
        i, j = (jnp.repeat(tie.rows[:, k], m) for k in (0, 1))
        A, B = ((w[:, None, None] * part).reshape(-1, space.dim) for part in (A, B))
        return Ties(i, j, A, B, (w[:, None] * e).reshape(-1))

    def _next(self, x: PyTree, u: PyTree, dt: jax.Array) -> PyTree:
        moves = dt > 0
        y = doors.call("f(x, u, dt)", self.model.f, x=x, u=u, dt=jnp.where(moves, dt, 1.0))
        y = image("f(x, u, dt)", y, self.model.space, self.data.prior.cov.dtype)
        return jax.tree.map(lambda new, old: jnp.where(moves, new, old), y, x)

    def _dynamics(self, x: PyTree) -> jax.Array:
        after = jax.vmap(self._next)(_before(x), self.data.log.u, self.data.log.dt)
        return jax.vmap(self.model.space.minus)(_after(x), after)

    def _expected(self, name: str, x: PyTree, c: PyTree) -> PyTree:
        sensor = self.model.sensors[name]
        y = doors.call(f"h(x, c) of sensor {name!r}", sensor.h, x=x, c=c)
        return image(f"h(x, c) of sensor {name!r}", y, sensor.space, self.data.prior.cov.dtype)

    def _reading(self, name: str, x: PyTree) -> jax.Array:
        log = self.data.log
        expected = jax.vmap(lambda x, c: self._expected(name, x, c))(_after(x), log.c.get(name, ()))
        e = jax.vmap(self.model.sensors[name].space.minus)(log.z[name], expected)
        return jnp.where(self.data.there[name], e, 0.0)


def _call(tie: Between, a: PyTree, b: PyTree, c: PyTree) -> PyTree:
    return image("h(a, b, c)", doors.call("h(a, b, c)", tie.h, a=a, b=b, c=c), tie.space, _dtype(tie.z))


def _dtype(tree: PyTree) -> jnp.dtype:
    return jax.tree.leaves(tree)[0].dtype


def _seen(tie: Between, a: PyTree, b: PyTree) -> jax.Array:
    return jax.vmap(lambda a, b, z, c: tie.space.minus(z, _call(tie, a, b, c)))(a, b, tie.z, tie.c)


def _slope(function: Callable[[jax.Array], jax.Array], at: jax.Array) -> jax.Array:
    return jax.jacfwd(function)(at)


def _robust(e: jax.Array, dof: jax.Array, limits: np.ndarray | None) -> jax.Array:
    """Whitened residuals (K, m) so scaled that their squares add up to Huber's loss."""
    if limits is None:
        return e
    nis, limit = _sizes(e, dof, limits)
    loss = 2 * jnp.sqrt(limit * nis) - limit
    return jnp.where(nis > limit, jnp.sqrt(jnp.where(nis > limit, loss, 1.0) / nis), 1.0)[:, None] * e


def _root_weight(e: jax.Array, dof: jax.Array, limits: np.ndarray | None) -> jax.Array:
    """The roots (K,) of Huber's weights ``min(1, sqrt(limit / nis))``."""
    if limits is None:
        return jnp.ones(len(e), e.dtype)
    nis, limit = _sizes(e, dof, limits)
    return (limit / nis) ** 0.25


def _sizes(e: jax.Array, dof: jax.Array, limits: np.ndarray) -> tuple[jax.Array, jax.Array]:
    """``e' e``, at least the limit, and the limit for so many components."""
    limit = jnp.asarray(limits, e.dtype)[dof]
    return jnp.maximum(jnp.sum(e * e, axis=1), limit), limit


def _at(x: PyTree, k: Any) -> PyTree:
    return jax.tree.map(lambda a: a[k], x)


def _before(x: PyTree) -> PyTree:
    return jax.tree.map(lambda a: a[:-1], x)


def _after(x: PyTree) -> PyTree:
    return jax.tree.map(lambda a: a[1:], x)
