"""The Kalman filter of a linear model over all parts of a log at once.

The log is cut into segments. What a segment does to a belief, whatever that is, is a `Passage`, and passages compose
associatively: so the beliefs at the starts of all segments come from one associative scan, and from there the filter
itself runs over all segments at once. What it reports is hence its own, row by row.

Source: S. Sarkka, A. F. Garcia-Fernandez, Temporal parallelization of Bayesian smoothers, IEEE Trans. Automatic Control
66(1) (2021), lemmas 7 and 8; a segment's passage by the filter that is told where it starts, not by composing rows.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors, linalg
from jaxfilt.filters import kf
from jaxfilt.loop import checkpointed
from jaxfilt.parallel.affine import grade
from jaxfilt.prediction import advanced
from jaxfilt.types import Array, Filter, Gaussian, Info, Log, Model, PyTree, Space


class Passage(NamedTuple):
    """From a state e before some rows to the state e' after them, given their readings.

    ``p(e' | e, readings) = N(e'; A e + b, C)`` and ``p(readings | e) ~ exp(eta' e - e' J e / 2)``; states are tangent
    vectors (n,) at a fixed point of the space.
    """

    A: Array
    b: Array
    C: Array
    eta: Array
    J: Array


def filtered(
    filter: Filter,
    belief: Gaussian,
    log: Log,
    store: Callable[[Any, dict[str, Info]], PyTree],
    segment: int | None = None,
) -> PyTree:
    """What `jaxfilt.scan` returns, for a `kf` or `ekf` of a linear model; belief and log are checked arrays.

    Args:
        filter, belief, log, store: as there.
        segment: rows of a segment; None: about the root of as many as there are. 1 leaves all to
            the associative scan.

    Raises:
        ValueError: another filter, or a model that is not linear.
    """
    steps = len(log.dt)
    if segment is not None and segment < 1:
        raise ValueError(f"segment: expected at least one row, got {segment}")
    segment = segment or max(1, math.isqrt(steps))
    _supported(filter, belief, jax.tree.map(lambda a: a[0], log))

    def body(b: Gaussian, row: Log) -> tuple[Gaussian, PyTree]:
        b, info = filter.step(b, row)
        return b, store(b, info)

    many = steps // segment
    if many < 2:
        return checkpointed(body, belief, log)[1]
    whole = many * segment
    pieces = jax.tree.map(lambda a: a[:whole].reshape(many, segment, *a.shape[1:]), log)
    starts = _starts(filter.model, belief, pieces)
    ends, stored = jax.vmap(lambda b, rows: checkpointed(body, b, rows))(starts, pieces)
    stored = jax.tree.map(lambda a: a.reshape(whole, *a.shape[2:]), stored)
    if whole == steps:
        return stored
    last, rest = jax.tree.map(lambda a: a[-1], ends), jax.tree.map(lambda a: a[whole:], log)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), stored, checkpointed(body, last, rest)[1])


def _starts(model: Model, belief: Gaussian, pieces: Log) -> Gaussian:
    """The belief before each piece, leading axis of the pieces."""
    n, dtype = model.space.dim, belief.cov.dtype
    zero, nought = jnp.zeros((n, n), dtype), jnp.zeros(n, dtype)
    still = Passage(jnp.eye(n, dtype=dtype), nought, zero, nought, zero)

    def through(rows: Log) -> Passage:
        return checkpointed(lambda p, row: (_extended(model, belief.mean, p, row), ()), still, rows)[0]

    passages = jax.vmap(through)(jax.tree.map(lambda a: a[:-1], pieces))
    first = Passage(zero, nought, belief.cov, nought, zero)
    passages = jax.tree.map(lambda a, rest: jnp.concatenate([a[None], rest]), first, passages)
    before = _accumulated(passages)
    means = jax.vmap(lambda b: model.space.plus(belief.mean, b))(before.b)
    return Gaussian(means, before.C)


def _accumulated(passages: Passage) -> Passage:
    """Each passage after all before it, by doubling.

    `jax.lax.associative_scan` composes fewer of them, but compiles two programs for each level: 13 s, not 2 s, for a
    hundred of four states, to be 3 ms faster.

    Source: W. D. Hillis, G. L. Steele, Data parallel algorithms, Comm. ACM 29(12) (1986).
    """
    many = len(passages.b)

    def doubled(p: Passage, reach: jax.Array) -> tuple[Passage, tuple]:
        back = jax.tree.map(lambda a: jnp.roll(a, reach, axis=0), p)
        whole = jnp.arange(many) < reach  # from the first row on

        def chosen(done: jax.Array, more: jax.Array) -> jax.Array:
            return jnp.where(whole.reshape(-1, *[1] * (done.ndim - 1)), done, more)

        return jax.tree.map(chosen, p, jax.vmap(composed)(back, p)), ()

    return jax.lax.scan(doubled, passages, jnp.left_shift(1, jnp.arange((many - 1).bit_length())))[0]


def composed(i: Passage, j: Passage) -> Passage:
    """Passage j after passage i; covariances and informations as products, positive semidefinite by construction."""
    n, dtype = len(i.b), i.b.dtype
    size = jnp.diagonal(i.C) > 0
    D = jnp.where(size, jnp.sqrt(jnp.where(size, jnp.diagonal(i.C), 1.0)), 1.0)
    # Units are the user's: in those of C's standard deviations the elimination's pivots are as they should be.
    M = jnp.eye(n, dtype=dtype) + (i.C @ j.J) * (D[None, :] / D[:, None])
    T = linalg.general_solve(M, jnp.diag(1 / D)) * D[:, None]  # (I + C J)^-1
    TC, TA, JT = T @ i.C, T @ i.A, j.J @ T
    C = j.A @ (T @ TC.T + TC @ j.J @ TC.T) @ j.A.T + j.C
    J = TA.T @ j.J @ TA + i.A.T @ (JT.T @ i.C @ JT) @ i.A + i.J
    b = j.A @ (T @ i.b + TC @ j.eta) + j.b
    eta = TA.T @ (j.eta - j.J @ i.b) + i.eta
    return Passage(j.A @ TA, b, linalg.symmetrize(C), eta, linalg.symmetrize(J))


def _extended(model: Model, at: PyTree, p: Passage, row: Log) -> Passage:
    """The passage through one more row: a Kalman filter whose mean is still affine in the state that it began with."""
    F, g, Q = _dynamics(model, at, row)
    p = p._replace(A=F @ p.A, b=F @ p.b + g, C=linalg.symmetrize(F @ p.C @ F.T + Q))
    for name, sensor in model.sensors.items():
        if name in row.z:
            there = jnp.broadcast_to(row.valid.get(name, jnp.bool_(True)), (sensor.space.dim,))
            p = _heard(model, name, at, p, row.z[name], row.c.get(name, ()), there)
    return p


def _dynamics(model: Model, at: PyTree, row: Log) -> tuple[jax.Array, jax.Array, jax.Array]:
    """``e' = F e + g + w``, ``w ~ N(0, Q)``; where no time passes the identity."""
    n, dtype = model.space.dim, row.dt.dtype
    moves, nought = row.dt > 0, jnp.zeros(n, dtype)
    dt = jnp.where(moves, row.dt, 1.0)

    def f(e: jax.Array) -> jax.Array:
        return model.space.minus(advanced(model, model.space.plus(at, e), row.u, dt, dtype), at)

    F, g, Q = jax.jacfwd(f)(nought), f(nought), jnp.asarray(model.Q(at, row.u, dt), dtype)
    return jnp.where(moves, F, jnp.eye(n, dtype=dtype)), jnp.where(moves, g, nought), jnp.where(moves, Q, 0.0)


def _heard(model: Model, name: str, at: PyTree, p: Passage, z: PyTree, c: PyTree, there: jax.Array) -> Passage:
    """The passage with one more reading, of which the components that are not there say nothing."""
    sensor, n, dtype = model.sensors[name], len(p.b), p.b.dtype
    m, nought = sensor.space.dim, jnp.zeros(n, dtype)
    expected = sensor.h(at, c)

    def h(e: jax.Array) -> jax.Array:
        return sensor.space.minus(sensor.h(model.space.plus(at, e), c), expected)

    H = jnp.where(there[:, None], jax.jacfwd(h)(nought), 0.0)
    r = jnp.where(there, sensor.space.minus(z, expected) - H @ p.b, 0.0)
    R = jnp.asarray(sensor.R(at, c), dtype)
    R = jnp.where(there[:, None] & there[None, :], R, jnp.eye(m, dtype=dtype))
    L = linalg.cholesky(linalg.symmetrize(H @ p.C @ H.T + R))
    found = linalg.forward_solve(L, jnp.concatenate([H @ p.A, H @ p.C, r[:, None]], axis=1))
    V, gain, v = found[:, :n], linalg.backward_solve(L, found[:, n:-1]).T, found[:, -1]
    rest = jnp.eye(n, dtype=dtype) - gain @ H
    C = linalg.symmetrize(rest @ p.C @ rest.T + gain @ R @ gain.T)
    return Passage(rest @ p.A, p.b + gain @ r, C, p.eta + V.T @ v, linalg.symmetrize(p.J + V.T @ V))


def _supported(filter: Filter, belief: Any, row: Log) -> None:
    """Raise unless the filter is the Kalman filter of its model, and that linear."""
    model = filter.model
    if not isinstance(belief, Gaussian) or not _same_program(filter.step, kf(model).step, belief, row):
        raise ValueError("filter: expected kf or ekf without gate and robust for parallel=True, got another filter")
    _flat("the state", model.space, belief.mean)
    dynamics = (belief.mean, row.u, row.dt)
    _graded("f(x, u, dt)", 1, model.f, *dynamics)
    _graded("Q(x, u, dt)", 0, model.Q, *dynamics)
    for name, sensor in model.sensors.items():
        if name in row.z:
            c = row.c.get(name, ())
            _flat(f"sensor {name!r}", sensor.space, row.z[name])
            _graded(f"h(x, c) of sensor {name!r}", 1, sensor.h, belief.mean, c)
            _graded(f"R(x, c) of sensor {name!r}", 0, sensor.R, belief.mean, c)


def _flat(name: str, space: Space, x: PyTree) -> None:
    d = jax.eval_shape(lambda: jnp.zeros(space.dim, jax.tree.leaves(x)[0].dtype))
    _graded(f"plus of {name}", 1, lambda both: space.plus(*both), (x, d))
    _graded(f"minus of {name}", 1, lambda both: space.minus(*both), (x, x))


def _graded(name: str, most: int, function: Callable, x: PyTree, *others: PyTree) -> None:
    found = grade(function, x, *others)
    if found.level > most:
        expected = "affine in x" if most else "that does not depend on x"
        got = f"one with {found.by} of x" if found.level > 1 else "one that does"
        raise ValueError(f"model: expected {name} {expected} for parallel=True, got {got}")


def _same_program(a: Callable, b: Callable, *arguments: PyTree) -> bool:
    """Whether two functions are the same operations on the same constants."""
    one, other = jax.make_jaxpr(a)(*arguments), jax.make_jaxpr(b)(*arguments)
    without_addresses = [re.sub(r"0x[0-9a-f]+", "", str(program)) for program in (one, other)]
    return without_addresses[0] == without_addresses[1] and all(
        x is y or _equal(x, y) for x, y in zip(one.consts, other.consts, strict=True)
    )


def _equal(x: Any, y: Any) -> bool:
    return doors.is_concrete((x, y)) and np.array_equal(x, y, equal_nan=True)
