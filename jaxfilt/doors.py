"""Checks at the door: every complaint names the argument, what was expected and what came.

Structure, shapes and dtypes are known while tracing, so they are checked everywhere, at no cost to the compiled
program. Values are checked where they are there to see: outside `jit`. What goes wrong inside is reported in
`Info.status`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from jaxfilt.types import Gaussian, Log, Model, PyTree, Sensor, Space

ROUNDING = 1e3
"""Times n * eps of its own size that a covariance may be off symmetry or below zero and still count as rounding."""


def is_concrete(x: Any) -> bool:
    """Whether the values of every leaf can be read now."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(x))


def describe(x: PyTree) -> str:
    """A pytree in a few words: its structure with a dtype and shape for every leaf."""

    def leaf(a: Any) -> str:
        if isinstance(a, (bool, int, float)):
            return f"{type(a).__name__} {a}"
        return f"{a.dtype}{list(a.shape)}" if hasattr(a, "dtype") else type(a).__name__

    described = [leaf(a) for a in jax.tree.leaves(x)]
    structure = jax.tree.structure(x)
    if structure == jax.tree.structure(0):
        return described[0]
    words = iter(described)
    return str(jax.tree.unflatten(structure, [_Word(next(words)) for _ in described]))


class _Word(str):
    __repr__ = str.__str__


def point(name: str, x: PyTree, space: Space, leading: tuple[int, ...] = ()) -> None:
    """Raise unless x is a point of the space: same structure, shapes and floating dtype."""
    template = space.origin
    if jax.tree.structure(x) != jax.tree.structure(template):
        raise ValueError(f"{name}: expected a pytree of shapes {_shapes(template, leading)}, got {describe(x)}")
    for want, got in zip(jax.tree.leaves(template), jax.tree.leaves(x), strict=True):
        expected = leading + np.shape(want)
        if np.shape(got) != expected:
            raise ValueError(f"{name}: expected shapes {_shapes(template, leading)}, got {_shapes(x)}")
        floating(name, got)


def _shapes(x: PyTree, leading: tuple[int, ...] = ()) -> str:
    return str(jax.tree.map(lambda a: _Word(leading + np.shape(a)), x))


def instance(name: str, x: Any, kind: type) -> None:
    """Raise unless x is of this kind."""
    if not isinstance(x, kind):
        raise TypeError(f"{name}: expected a {kind.__name__}, got {type(x).__name__}")


def alike(name: str, x: PyTree, like: PyTree) -> None:
    """Raise unless x has the structure and the shapes of another tree."""
    same = jax.tree.structure(x) == jax.tree.structure(like)
    if not same or [np.shape(a) for a in jax.tree.leaves(x)] != [np.shape(a) for a in jax.tree.leaves(like)]:
        raise ValueError(f"{name}: expected {describe(like)}, got {describe(x)}")


def array(name: str, x: Any) -> None:
    """Raise unless x is an array: a list would only be found out later, inside."""
    if not (hasattr(x, "shape") and hasattr(x, "dtype")):
        raise TypeError(f"{name}: expected an array, got {type(x).__name__}")


def matrix(name: str, M: Any) -> None:
    """Raise unless M is a matrix of a floating dtype."""
    array(name, M)
    floating(name, M)
    if np.ndim(M) != 2:
        raise ValueError(f"{name}: expected a matrix, got shape {np.shape(M)}")


def floating(name: str, x: PyTree) -> None:
    """Raise unless all of x is of a floating dtype; a Python float will do, an int will not."""
    for leaf in jax.tree.leaves(x):
        dtype = getattr(leaf, "dtype", type(leaf))
        if not (dtype is float or np.issubdtype(dtype, np.floating)):
            raise TypeError(f"{name}: expected floating numbers, got {describe(leaf)}")


def same_dtype(dtype: Any, **named: PyTree) -> None:
    """Raise unless every array leaf has this dtype; Python floats take any."""
    for name, tree in named.items():
        for leaf in jax.tree.leaves(tree):
            got = getattr(leaf, "dtype", None)
            if got is not None and np.issubdtype(got, np.floating) and jax.dtypes.canonicalize_dtype(got) != dtype:
                raise TypeError(f"{name}: expected {dtype} like the belief's cov, got {describe(leaf)}")


def finite(name: str, x: PyTree) -> None:
    """Raise where a visible value is NaN or inf."""
    if not is_concrete(x):
        return
    for leaf in jax.tree.leaves(x):
        bad = ~np.isfinite(np.asarray(leaf))
        if bad.any():
            where = np.argwhere(bad)[0].tolist()
            value = np.asarray(leaf)[tuple(where)]
            raise ValueError(f"{name}: expected finite numbers, got {value} at {where} ({bad.sum()} in all)")


def leading(name: str, x: PyTree, length: int) -> None:
    """Raise unless all of x has this leading axis."""
    for path, leaf in jax.tree.leaves_with_path(x):
        if np.shape(leaf)[:1] != (length,):
            where = name + jax.tree_util.keystr(path)
            raise ValueError(f"{where}: expected leading axis {length}, got shape {np.shape(leaf)}")


def increasing(name: str, t: np.ndarray) -> None:
    """Raise unless t (K,) are finite, strictly increasing stamps, at least one."""
    if t.ndim != 1 or not len(t):
        raise ValueError(f"{name}: expected stamps of shape (K,), K >= 1, got shape {t.shape}")
    finite(name, t)
    if (np.diff(t) <= 0).any():
        k = int(np.argmax(np.diff(t) <= 0))
        raise ValueError(f"{name}: expected strictly increasing stamps, got {t[k]} and then {t[k + 1]} at {k + 1}")


def mask(name: str, x: Any, *shapes: tuple[int, ...]) -> None:
    """Raise unless x is bool, of one of these shapes."""
    if not np.issubdtype(getattr(x, "dtype", type(x)), np.bool_) or np.shape(x) not in shapes:
        raise ValueError(f"{name}: expected bool of shape {' or '.join(map(str, shapes))}, got {describe(x)}")


def covariance(name: str, P: Any, dim: int | None = None) -> None:
    """Raise unless P is a (dim, dim) symmetric positive semidefinite matrix, to rounding relative to its own size."""
    array(name, P)
    shape = np.shape(P)
    if len(shape) != 2 or shape[0] != shape[1] or (dim is not None and shape[0] != dim):
        expected = "square" if dim is None else (dim, dim)
        raise ValueError(f"{name}: expected shape {expected}, got {shape}")
    floating(name, P)
    finite(name, P)
    if not is_concrete(P):
        return
    P = np.asarray(P)
    slack = ROUNDING * len(P) * float(np.finfo(P.dtype).eps)
    size = np.sqrt(np.abs(np.diag(P)))
    scale = np.where(size > 0, size, 1.0)
    scaled = P / np.outer(scale, scale)
    if (np.diag(P) < 0).any():
        i = int(np.argmin(np.diag(P)))
        raise ValueError(f"{name}: expected variances >= 0 on the diagonal, got {P[i, i]:.6g} at [{i}, {i}]")
    skew = np.abs(scaled - scaled.T)
    if skew.max() > slack:
        i, j = divmod(int(np.argmax(skew)), len(P))
        raise ValueError(
            f"{name}: expected a symmetric matrix, got {P[i, j]:.6g} at {(i, j)}, {P[j, i]:.6g} at {(j, i)}"
        )
    lowest = float(np.linalg.eigvalsh(0.5 * (scaled + scaled.T))[0])
    if lowest < -slack:
        raise ValueError(
            f"{name}: expected a positive semidefinite matrix, got correlations with eigenvalue {lowest:.6g}"
        )


def belief(name: str, b: Any, space: Space) -> None:
    """Raise unless b is a Gaussian on the space with a proper covariance."""
    if not (isinstance(b, Gaussian) or (hasattr(b, "mean") and hasattr(b, "cov"))):
        raise TypeError(f"{name}: expected a Gaussian(mean, cov), got {type(b).__name__}")
    point(f"{name}.mean", b.mean, space)
    finite(f"{name}.mean", b.mean)
    covariance(f"{name}.cov", b.cov, space.dim)
    same_dtype(jax.dtypes.canonicalize_dtype(b.cov.dtype), **{f"{name}.mean": b.mean})


def noise(name: str, P: Any, dim: int, dtype: Any) -> None:
    """Raise unless a model's Q or R came out as a (dim, dim) covariance of the belief's dtype."""
    covariance(name, P, dim)
    same_dtype(dtype, **{name: P})


def inputs(name: str, u: PyTree, dtype: Any) -> None:
    """Raise unless an input is made of finite floating numbers of the belief's dtype."""
    floating(name, u)
    finite(name, u)
    same_dtype(dtype, **{name: u})


def tables(name: str, log: Log, model: Model) -> None:
    """Raise unless z, c and valid of a log, or of one row, are dicts by the model's sensors."""
    instance(name, log, Log)
    for field in ("z", "c", "valid"):
        table = getattr(log, field)
        if not isinstance(table, Mapping):
            raise TypeError(f"{name}.{field}: expected a dict by sensor, got {describe(table)}")
        for key in table:
            sensor(model, key)
            if key not in log.z:
                raise KeyError(f"{name}.{field}: expected sensors of {name}.z, {list(log.z)}, got {key!r}")


def call(name: str, function: Callable, **arguments: Any) -> Any:
    """What a user's function returns; where it raises, a note on the error says for what."""
    try:
        return function(*arguments.values())
    except Exception as error:
        given = ", ".join(f"{key} = {describe(value)}" for key, value in arguments.items())
        error.add_note(f"raised by {name} for {given}")
        raise


def sensor(model: Model, name: str) -> Sensor:
    """The model's sensor of this name."""
    if name not in model.sensors:
        raise KeyError(f"sensor: expected one of {list(model.sensors)}, got {name!r}")
    return model.sensors[name]
