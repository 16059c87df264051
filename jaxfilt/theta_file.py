"""Parameters as JSON: what tuning found, for a study or a replay to use, and for a robot that runs no JAX.

``{"schema": "jaxfilt.theta/1", "theta": {"gnss": 0.05, "mark/0": -2.3}, ...}``: each leaf of theta by the way to it, a
number or nested lists of them. Whatever else there is, plain matrices Q and R for instance, is for others to read.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from jaxfilt.types import PyTree

SCHEMA = "jaxfilt.theta/1"


def theta_to_json(theta: PyTree, more: Mapping[str, Any] | None = None) -> str:
    """Parameters as text, every digit of them.

    Args:
        theta: a pytree of floating numbers and arrays.
        more: further entries, of what JSON can hold.

    Raises:
        ValueError: numbers that are not finite, or two leaves of one name.

    Example:
        >>> text = theta_to_json({"gnss": 0.5, "mark": (-2.0, -3.0)}, {"unit": "m"})
        >>> theta_from_json(text, like={"gnss": 0.0, "mark": (0.0, 0.0)})
        {'gnss': 0.5, 'mark': (-2.0, -3.0)}
    """
    named: dict[str, Any] = {}
    for way, leaf in jax.tree_util.tree_leaves_with_path(theta):
        name, value = _name(way), np.asarray(leaf)
        if name in named:
            raise ValueError(f"theta: expected one name for each leaf, got {name!r} twice")
        if not np.isfinite(value).all():
            raise ValueError(f"theta: expected finite numbers, got {value} for {name!r}")
        named[name] = value.tolist()
    return json.dumps({"schema": SCHEMA, "theta": named} | dict(more or {}), indent=1, allow_nan=False) + "\n"


def theta_from_json(text: str, like: PyTree) -> PyTree:
    """Parameters from what `theta_to_json` wrote.

    Args:
        text: of the file.
        like: a theta of the same structure; its numbers do not matter, its dtypes do.

    Returns:
        theta in the structure of ``like``: numbers where it has Python floats, NumPy arrays where it has arrays.

    Raises:
        ValueError: not such a text, or that of other parameters: an entry missing, unknown, of another shape or not
            finite. All names that differ are named.
    """
    try:
        found = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"expected parameters as JSON, got something else ({error})") from None
    if not isinstance(found, dict) or not isinstance(found.get("theta"), dict) or found.get("schema") != SCHEMA:
        schema = found.get("schema") if isinstance(found, dict) else None
        raise ValueError(f"expected parameters of schema {SCHEMA!r}, got schema {schema!r}")
    ways, structure = jax.tree_util.tree_flatten_with_path(like)
    names, given = [_name(way) for way, _ in ways], found["theta"]
    missing, unknown = [n for n in names if n not in given], [n for n in given if n not in names]
    if missing or unknown:
        told = [f"{what}: {', '.join(some)}" for what, some in (("missing", missing), ("unknown", unknown)) if some]
        raise ValueError(f"expected the parameters of this model, got those of another; {'; '.join(told)}")
    return structure.unflatten([_leaf(n, given[n], leaf) for n, (_, leaf) in zip(names, ways, strict=True)])


def _name(way: Any) -> str:
    return jax.tree_util.keystr(way, simple=True, separator="/") or "theta"


def _leaf(name: str, value: Any, like: Any) -> Any:
    try:
        numbers = np.asarray(value, np.float64)
    except (ValueError, TypeError):
        raise ValueError(f"{name}: expected numbers of shape {np.shape(like)}, got {value!r}") from None
    if numbers.shape != np.shape(like):
        raise ValueError(f"{name}: expected shape {np.shape(like)}, got {numbers.shape}")
    if not np.isfinite(numbers).all():
        raise ValueError(f"{name}: expected finite numbers, got {value!r}")
    return float(numbers) if isinstance(like, float | int) else numbers.astype(like.dtype)
