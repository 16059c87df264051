"""How a belief moves with time, and how a row of a log goes: predict, then update with each sensor that is there."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors, linalg
from jaxfilt.correction import image, nothing
from jaxfilt.transforms import Transform
from jaxfilt.types import Array, Filter, Gaussian, Info, Log, Model, Moments, PyTree, Space, Transition

Predict = Callable[..., Any]
Update = Callable[..., tuple[Any, Info]]


def kalman(model: Model, predict: Predict, update: Update, transition: Callable[..., Transition] | None) -> Filter:
    """The filter of these functions: it carries a Gaussian."""

    def begin(belief: Gaussian, key: Array | None = None) -> Gaussian:
        belief = canonical(belief, model.space)
        # Symmetric to the last bit, as each step leaves it: then half of it is enough for compiled lanes.
        return belief._replace(cov=linalg.symmetrize(belief.cov))

    return Filter(predict, update, stepper(model, predict, update), model, begin, lambda belief: belief, transition)


def predictor(transform: Transform, model: Model) -> Predict:
    """``predict(belief, u, dt)`` of a filter: nothing where no time passes."""

    def predict(belief: Gaussian, u: PyTree = (), dt: Array | float = 0.0) -> Gaussian:
        belief = canonical(belief, model.space)
        doors.inputs("u", u, belief.cov.dtype)
        moves, dt = interval(dt, belief)
        return branch(moves, lambda b: _after(*_passed(transform, model, b, u, dt)), lambda b: b, belief)

    return predict


def transitioner(transform: Transform, model: Model) -> Callable[..., Transition]:
    """``transition(belief, u, dt)`` of a filter, for an interval > 0."""

    def transition(belief: Gaussian, u: PyTree, dt: jax.Array) -> Transition:
        m, Q = _passed(transform, model, belief, u, dt)
        return Transition(_after(m, Q), m.cross, lambda K: m.remainder(K) + K @ Q @ K.T)

    return transition


def stepper(model: Model, predict: Predict, update: Update) -> Callable[[Any, Log], tuple[Any, dict]]:
    """``step(belief, row)`` of a filter: predict, then update with each sensor that is there, in the model's order."""

    def step(belief: Any, row: Log) -> tuple[Any, dict[str, Info]]:
        doors.tables("row", row, model)
        belief = predict(belief, row.u, row.dt)
        infos = {}
        for name in model.sensors:
            if name in row.z:
                belief, infos[name] = _update_if_there(update, model, belief, row, name)
        return belief, infos

    return step


def canonical(belief: Gaussian, space: Space) -> Gaussian:
    """The belief as arrays of one dtype, that of its covariance; a Python float in the mean is taken along."""
    doors.belief("belief", belief, space)
    dtype = jax.dtypes.canonicalize_dtype(belief.cov.dtype)
    return Gaussian(*jax.tree.map(lambda a: jnp.asarray(a, dtype), tuple(belief)))


def dtype_of(belief: PyTree) -> jnp.dtype:
    """The floating dtype of what a filter carries, which has only one."""
    dtypes = [jnp.result_type(leaf) for leaf in jax.tree.leaves(belief)]
    return next(dtype for dtype in dtypes if jnp.issubdtype(dtype, jnp.floating))


def interval(dt: Array | float, belief: PyTree) -> tuple[Array | bool, jax.Array]:
    """Whether time passes, and how much, checked; 1 s where none does.

    Where vmap turns the branch on it into a select, f and Q run at dt = 0 too, and are to be kept off that point.
    """
    if np.shape(dt) != ():
        raise ValueError(f"dt: expected a scalar, got shape {np.shape(dt)}")
    if doors.is_concrete(dt) and not 0 <= float(dt) < math.inf:
        raise ValueError(f"dt: expected a finite interval >= 0 s, got {float(dt)}")
    dtype = dtype_of(belief)
    doors.same_dtype(dtype, dt=dt)
    length = jnp.asarray(dt, dtype)
    return dt > 0, jnp.where(length > 0, length, 1.0)


def branch(predicate: Array | bool, then: Callable, otherwise: Callable, belief: PyTree) -> Any:
    """`jax.lax.cond`, decided at once where the predicate is known: outside jit a cond would compile at every call."""
    if doors.is_concrete(predicate):
        return then(belief) if predicate else otherwise(belief)
    return jax.lax.cond(predicate, then, otherwise, belief)


def advanced(model: Model, x: PyTree, u: PyTree, dt: jax.Array, dtype: jnp.dtype) -> PyTree:
    """``f(x, u, dt)``, checked."""
    return image("f(x, u, dt)", doors.call("f(x, u, dt)", model.f, x=x, u=u, dt=dt), model.space, dtype)


def _passed(
    transform: Transform, model: Model, belief: Gaussian, u: PyTree, dt: jax.Array
) -> tuple[Moments, jax.Array]:
    m = transform(lambda x: advanced(model, x, u, dt, belief.cov.dtype), belief, model.space, model.space)
    Q = doors.call("Q(x, u, dt)", model.Q, x=belief.mean, u=u, dt=dt)
    doors.noise("Q(x, u, dt)", Q, model.space.dim, belief.cov.dtype)
    return m, Q


def _after(m: Moments, Q: jax.Array) -> Gaussian:
    return Gaussian(m.mean, linalg.symmetrize(m.cov + Q))


def _update_if_there(update: Callable, model: Model, belief: Any, row: Log, name: str) -> tuple[Any, Info]:
    z, c = row.z[name], row.c.get(name, ())
    if name not in row.valid:
        return update(belief, z, name, c)
    valid = row.valid[name]
    doors.mask(f"row.valid[{name!r}]", valid, (), (model.sensors[name].space.dim,))
    valid = np.bool_(valid) if isinstance(valid, bool) else valid
    mask = valid if np.ndim(valid) else None
    silence = nothing(model.sensors[name].space.dim, dtype_of(belief))
    return branch(valid.any(), lambda b: update(b, z, name, c, mask), lambda b: (b, silence), belief)
