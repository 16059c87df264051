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
from jaxfilt.types import Array, Gaussian, Info, Log, Model, PyTree, Space

Predict = Callable[..., Gaussian]
Update = Callable[..., tuple[Gaussian, Info]]


def predictor(transform: Transform, model: Model) -> Predict:
    """``predict(belief, u, dt)`` of a filter: nothing where no time passes."""

    def predict(belief: Gaussian, u: PyTree = (), dt: Array | float = 0.0) -> Gaussian:
        belief = canonical(belief, model.space)
        doors.inputs("u", u, belief.cov.dtype)
        moves, dt = interval(dt, belief)
        return branch(moves, lambda b: _predict(transform, model, b, u, dt), lambda b: b, belief)

    return predict


def stepper(model: Model, predict: Predict, update: Update) -> Callable[[Gaussian, Log], tuple[Gaussian, dict]]:
    """``step(belief, row)`` of a filter: predict, then update with each sensor that is there, in the model's order."""

    def step(belief: Gaussian, row: Log) -> tuple[Gaussian, dict[str, Info]]:
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


def interval(dt: Array | float, belief: Gaussian) -> tuple[Array | bool, jax.Array]:
    """Whether time passes, and how much, checked; 1 s where none does.

    Where vmap turns the branch on it into a select, f and Q run at dt = 0 too, and are to be kept off that point.
    """
    if np.shape(dt) != ():
        raise ValueError(f"dt: expected a scalar, got shape {np.shape(dt)}")
    if doors.is_concrete(dt) and not 0 <= float(dt) < math.inf:
        raise ValueError(f"dt: expected a finite interval >= 0 s, got {float(dt)}")
    doors.same_dtype(belief.cov.dtype, dt=dt)
    length = jnp.asarray(dt, belief.cov.dtype)
    return dt > 0, jnp.where(length > 0, length, 1.0)


def branch(predicate: Array | bool, then: Callable, otherwise: Callable, belief: Gaussian) -> Any:
    """`jax.lax.cond`, decided at once where the predicate is known: outside jit a cond would compile at every call."""
    if doors.is_concrete(predicate):
        return then(belief) if predicate else otherwise(belief)
    return jax.lax.cond(predicate, then, otherwise, belief)


def advanced(model: Model, x: PyTree, u: PyTree, dt: jax.Array, dtype: jnp.dtype) -> PyTree:
    """``f(x, u, dt)``, checked."""
    return image("f(x, u, dt)", doors.call("f(x, u, dt)", model.f, x=x, u=u, dt=dt), model.space, dtype)


def _predict(transform: Transform, model: Model, belief: Gaussian, u: PyTree, dt: jax.Array) -> Gaussian:
    m = transform(lambda x: advanced(model, x, u, dt, belief.cov.dtype), belief, model.space, model.space)
    Q = doors.call("Q(x, u, dt)", model.Q, x=belief.mean, u=u, dt=dt)
    doors.noise("Q(x, u, dt)", Q, model.space.dim, belief.cov.dtype)
    return Gaussian(m.mean, linalg.symmetrize(m.cov + Q))


def _update_if_there(update: Callable, model: Model, belief: Gaussian, row: Log, name: str) -> tuple[Gaussian, Info]:
    z, c = row.z[name], row.c.get(name, ())
    if name not in row.valid:
        return update(belief, z, name, c)
    valid = row.valid[name]
    doors.mask(f"row.valid[{name!r}]", valid, (), (model.sensors[name].space.dim,))
    valid = np.bool_(valid) if isinstance(valid, bool) else valid
    mask = valid if np.ndim(valid) else None
    silence = nothing(model.sensors[name].space.dim, belief.cov.dtype)
    return branch(valid.any(), lambda b: update(b, z, name, c, mask), lambda b: (b, silence), belief)
