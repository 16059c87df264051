"""Logs on the host, in float64: merging recorded streams, scheduling simulated ones, checking, padding, files.

Times are absolute float64 seconds until here; only their differences enter a `Log`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jaxfilt import doors
from jaxfilt.types import Log, Model, PyTree, Recording, Space, Stream, Truth


def merge(
    model: Model,
    streams: Mapping[str, Stream | tuple],
    u: tuple[np.ndarray, PyTree] | None = None,
    start: float | None = None,
) -> Recording:
    """One log from recorded streams: rows in order of time, whatever the order of arrival.

    Readings of different sensors with the same stamp share a row. A sensor's repeated stamp makes another row with
    dt = 0, ordered by value, so that a shuffled recording gives the very same log. Each stamp of the input makes a
    row too, since the input changes there; it is held until its next stamp, and its first value holds before.

    Args:
        model: whose sensors the streams belong to.
        streams: sensor -> Stream(t, z, c, valid), or the tuple (t, z[, c[, valid]]). t in s, any order.
        u: (t, values): the input at increasing stamps, values a pytree with leading axis K.
        start: time of the initial belief, s; default the first stamp, whose row then has dt = 0 (update-first).

    Returns:
        Recording(log, t): numbers in JAX's default float dtype, t absolute in float64.

    Raises:
        KeyError: a sensor that the model lacks.
        ValueError: NaN in t, z or u (mark what is missing by ``valid``), lengths that differ, input stamps out of
            order, nothing to merge, a stamp before ``start``.

    Example:
        >>> import numpy as np, jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> rec = jf.merge(walk, {"z": (np.array([0.5, 0.0]), np.array([[2.0], [1.0]]))})
        >>> rec.t.tolist(), rec.log.dt.tolist(), rec.log.z["z"][:, 0].tolist()
        ([0.0, 0.5], [0.0, 0.5], [1.0, 2.0])
    """
    named = {name: Stream(*stream) for name, stream in streams.items()}
    events = []
    for name in sorted(named):
        stream = named[name] = _checked(model, name, named[name])
        events += _events(name, stream)
    tu, values = _checked_input(u)
    events += [(t, 0, "", -1) for t in tu]
    if not events:
        raise ValueError("streams: expected at least one reading or input, got none")
    rows = sorted({(t, repeat) for t, repeat, _, _ in events})
    row_of = {row: k for k, row in enumerate(rows)}
    t = np.array([row[0] for row in rows])
    start = float(t[0]) if start is None else float(start)
    if not t[0] >= start:
        raise ValueError(f"start: expected a time not after the first stamp {t[0]}, got {start}")
    began = np.r_[start, t[:-1]]

    z, c, valid = {}, {}, {}
    for name, stream in named.items():
        at = np.array([row_of[when, repeat] for when, repeat, who, _ in events if who == name], int)
        order = np.array([index for _, _, who, index in events if who == name], int)
        z[name] = _scatter(stream.z, at, order, len(t))
        if jax.tree.leaves(stream.c):
            c[name] = _scatter(stream.c, at, order, len(t))
        there = np.ones(len(stream.t), bool) if stream.valid is None else stream.valid
        there = _scatter(there, at, order, len(t))
        if not there.all():
            valid[name] = there
    held = np.clip(np.searchsorted(tu, began, side="right") - 1, 0, None)
    inputs = jax.tree.map(lambda a: np.asarray(a)[held], values)
    return Recording(_in_default_dtype(Log(t - began, inputs, z, c, valid)), t)


def _checked(model: Model, name: str, stream: Stream) -> Stream:
    space = doors.sensor(model, name).space
    t = np.asarray(stream.t, np.float64)
    if t.ndim != 1:
        raise ValueError(f"t of {name!r}: expected shape (K,), got {t.shape}")
    doors.finite(f"t of {name!r}", t)
    z = jax.tree.map(np.asarray, stream.z)
    valid = None if stream.valid is None else _checked_valid(name, np.asarray(stream.valid), len(t), space)
    doors.point(f"z of {name!r}", z, space, leading=(len(t),))
    try:
        doors.finite(f"z of {name!r}", z)
    except ValueError as bad:
        raise ValueError(f"{bad}; put any finite number there and mark it in valid") from None
    for leaf in jax.tree.leaves(stream.c):
        if np.shape(leaf)[:1] != (len(t),):
            raise ValueError(f"c of {name!r}: expected leading axis {len(t)}, got shape {np.shape(leaf)}")
    doors.finite(f"c of {name!r}", stream.c)
    return Stream(t, z, jax.tree.map(np.asarray, stream.c), valid)


def _checked_valid(name: str, valid: np.ndarray, length: int, space: Space) -> np.ndarray:
    if valid.dtype != bool or valid.shape not in ((length,), (length, space.dim)):
        raise ValueError(
            f"valid of {name!r}: expected bool of shape {(length,)} or {(length, space.dim)}, got {doors.describe(valid)}"
        )
    return valid


def _checked_input(u: tuple[np.ndarray, PyTree] | None) -> tuple[np.ndarray, PyTree]:
    if u is None:
        return np.zeros(0), ()
    t = np.asarray(u[0], np.float64)
    doors.finite("t of u", t)
    if t.ndim != 1 or not len(t) or (np.diff(t) <= 0).any():
        raise ValueError(f"t of u: expected strictly increasing stamps, got {t}")
    for leaf in jax.tree.leaves(u[1]):
        if np.shape(leaf)[:1] != (len(t),):
            raise ValueError(f"u: expected leading axis {len(t)} like its stamps, got shape {np.shape(leaf)}")
        doors.floating("u", np.asarray(leaf))
    doors.finite("u", u[1])
    return t, u[1]


def _events(name: str, stream: Stream) -> list[tuple[float, int, str, int]]:
    """(time, how many of this sensor's readings share it and come before, sensor, index), ties by value."""
    keys = [np.reshape(leaf, (len(stream.t), -1)).T for leaf in jax.tree.leaves((stream.z, stream.c))]
    keys += [] if stream.valid is None else [np.reshape(stream.valid, (len(stream.t), -1)).T]
    order = np.lexsort([*np.concatenate(keys)[::-1], stream.t])
    events, repeat = [], 0
    for before, index in zip([None, *order[:-1]], order, strict=False):
        repeat = repeat + 1 if before is not None and stream.t[before] == stream.t[index] else 0
        events.append((float(stream.t[index]), repeat, name, int(index)))
    return events


def _scatter(tree: PyTree, rows: np.ndarray, order: np.ndarray, length: int) -> PyTree:
    def one(values: np.ndarray) -> np.ndarray:
        out = np.zeros((length, *values.shape[1:]), values.dtype)
        out[rows] = values[order]
        return out

    return jax.tree.map(one, tree)


def _in_default_dtype(log: Log) -> Log:
    dtype = jax.dtypes.canonicalize_dtype(float)
    return jax.tree.map(lambda a: a.astype(dtype) if np.issubdtype(a.dtype, np.floating) else a, log)


def schedule(
    model: Model,
    steps: int,
    dt: float,
    every: Mapping[str, int] | None = None,
    u: PyTree = (),
    c: Mapping[str, PyTree] | None = None,
) -> Log:
    """The log of a simulation that is still to run: which sensor reads in which row.

    Args:
        model: whose sensors read.
        steps: number of rows T.
        dt: interval, s.
        every: sensor -> k: it reads in rows k-1, 2k-1, ...; default every row. 0: never, the sensor is left out.
        u: input, leading axis T on every leaf.
        c: sensor -> context, leading axis T.

    Raises:
        ValueError: steps < 1, dt <= 0, a negative interval, leading axes that are not T.
        KeyError: a sensor that the model lacks.

    Example: an odometer at 50 Hz, GNSS at 10 Hz.
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> one = jnp.eye(1)
        >>> two = jf.linear(one, {"odo": one, "gnss": one}, one, {"odo": one, "gnss": one})
        >>> jf.schedule(two, steps=10, dt=0.02, every={"gnss": 5}).valid["gnss"].sum().item()
        2
    """
    if steps < 1:
        raise ValueError(f"steps: expected at least 1, got {steps}")
    if not 0 < dt < np.inf:
        raise ValueError(f"dt: expected a finite interval > 0 s, got {dt}")
    every = dict(every or {})
    for name, k in every.items():
        doors.sensor(model, name)
        if k < 0:
            raise ValueError(f"every[{name!r}]: expected a number of rows >= 0, got {k}")
    z, valid = {}, {}
    for name, sensor in model.sensors.items():
        k = every.get(name, 1)
        if k == 0:
            continue
        z[name] = jax.tree.map(lambda a: np.broadcast_to(a, (steps, *np.shape(a))).copy(), sensor.space.origin)
        if k > 1:
            valid[name] = np.arange(1, steps + 1) % k == 0
    for name, tree in {"u": u, **{f"c[{name!r}]": tree for name, tree in (c or {}).items()}}.items():
        for leaf in jax.tree.leaves(tree):
            if np.shape(leaf)[:1] != (steps,):
                raise ValueError(f"{name}: expected leading axis {steps}, got shape {np.shape(leaf)}")
    log = Log(np.full(steps, dt), jax.tree.map(np.asarray, u), z, jax.tree.map(np.asarray, dict(c or {})), valid)
    return _in_default_dtype(log)


def validate(model: Model, log: Log, dtype: Any = None) -> None:
    """Raise unless the log fits the model: sensors, structure, shapes, dtypes; and, where they can be seen, values.

    Args:
        model: the robot and its sensors.
        log: T rows.
        dtype: floating dtype that all of it should have; default that of ``log.dt``.

    Raises:
        ValueError, TypeError, KeyError: naming the field, what was expected and what came.
    """
    if not isinstance(log, Log):
        raise TypeError(f"log: expected a Log, got {type(log).__name__}")
    if np.ndim(log.dt) != 1:
        raise ValueError(f"log.dt: expected shape (T,), got {np.shape(log.dt)}")
    length = np.shape(log.dt)[0]
    if length == 0:
        raise ValueError("log: expected at least one row, got none")
    dtype = jax.dtypes.canonicalize_dtype(log.dt.dtype if dtype is None else dtype)
    doors.floating("log.dt", log.dt)
    doors.finite("log.dt", log.dt)
    if doors.is_concrete(log.dt) and (np.asarray(log.dt) < 0).any():
        k = int(np.argmax(np.asarray(log.dt) < 0))
        raise ValueError(f"log.dt: expected intervals >= 0 s, got {np.asarray(log.dt)[k]} at row {k}")
    for leaf in jax.tree.leaves(log):
        if np.shape(leaf)[:1] != (length,):
            raise ValueError(f"log: expected leading axis {length} everywhere, got shape {np.shape(leaf)}")
    for name, z in log.z.items():
        space = doors.sensor(model, name).space
        doors.point(f"log.z[{name!r}]", z, space, leading=(length,))
        doors.finite(f"log.z[{name!r}]", z)
    for field, table in {"c": log.c, "valid": log.valid}.items():
        for name in table:
            if name not in log.z:
                raise KeyError(f"log.{field}: expected sensors of log.z, {list(log.z)}, got {name!r}")
    for name, valid in log.valid.items():
        dim = model.sensors[name].space.dim
        if valid.dtype != bool or valid.shape not in ((length,), (length, dim)):
            raise ValueError(
                f"log.valid[{name!r}]: expected bool of shape {(length,)} or {(length, dim)}, got {doors.describe(valid)}"
            )
    doors.finite("log.u", log.u)
    doors.finite("log.c", log.c)
    doors.same_dtype(dtype, **{"log.dt": log.dt, "log.u": log.u, "log.z": log.z, "log.c": log.c})


def stack(logs: Sequence[Log]) -> Log:
    """Logs of unequal length as one batch, run axis first: padded at the end with dt = 0 and nothing valid.

    Args:
        logs: with the same sensors; a sensor present in every row of one and not of another will do.

    Raises:
        ValueError: no logs, or logs whose fields differ in structure.
    """
    if not logs:
        raise ValueError("logs: expected at least one, got none")
    length = max(len(log.dt) for log in logs)
    ragged = any(len(log.dt) != length for log in logs)
    masked = [name for name in logs[0].z if ragged or any(name in log.valid for log in logs)]
    full = [log._replace(valid={name: _explicit(logs, log, name) for name in masked}) for log in logs]
    for log in full[1:]:
        if jax.tree.structure(log) != jax.tree.structure(full[0]):
            raise ValueError(
                f"logs: expected one structure, got {jax.tree.structure(full[0])} and {jax.tree.structure(log)}"
            )

    def padded(a: np.ndarray) -> np.ndarray:
        return np.concatenate([a, np.zeros((length - len(a), *a.shape[1:]), a.dtype)])

    return jax.tree.map(lambda *rows: np.stack([padded(np.asarray(a)) for a in rows]), *full)


def _explicit(logs: Sequence[Log], log: Log, name: str) -> np.ndarray:
    """The mask of a sensor written out, by component if any of the logs has it so."""
    by_component = [other.valid[name].shape[1] for other in logs if np.ndim(other.valid.get(name)) == 2]
    valid = np.asarray(log.valid.get(name, np.ones(len(log.dt), bool)))
    if by_component and valid.ndim == 1:
        return np.repeat(valid[:, None], by_component[0], axis=1)
    return valid


def align(t: np.ndarray, truth: tuple[np.ndarray, PyTree], space: Space, gap: float = np.inf) -> Truth:
    """The truth at the rows of a recording, interpolated on its space: ``plus(a, s minus(b, a))``.

    Args:
        t: (T,) times of the rows, s: ``Recording.t``.
        truth: (times (K,), strictly increasing, and points with leading axis K).
        space: where the truth lives: of the state, or of the part of it that is known.
        gap: s; between truth samples further apart than this, the mask is False.

    Returns:
        Truth(x, mask): x with leading axis T; mask False outside the truth's time and within gaps.

    Raises:
        ValueError: stamps that are not finite or not increasing, fewer than two samples.
    """
    stamps = np.asarray(truth[0], np.float64)
    doors.finite("t of truth", stamps)
    if len(stamps) < 2 or (np.diff(stamps) <= 0).any():
        raise ValueError(f"t of truth: expected at least two strictly increasing stamps, got {stamps}")
    doors.point("truth", jax.tree.map(np.asarray, truth[1]), space, leading=(len(stamps),))
    t = np.asarray(t, np.float64)
    after = np.clip(np.searchsorted(stamps, t, side="right"), 1, len(stamps) - 1)
    width = stamps[after] - stamps[after - 1]
    share = np.clip((t - stamps[after - 1]) / width, 0.0, 1.0)
    dtype = jax.dtypes.canonicalize_dtype(float)
    a, b = (jax.tree.map(lambda x, i=i: np.asarray(x, dtype)[i], truth[1]) for i in (after - 1, after))
    between = jax.vmap(lambda a, b, s: space.plus(a, s * space.minus(b, a)))
    inside = (t >= stamps[0]) & (t <= stamps[-1]) & (width <= gap)
    return Truth(jax.tree.map(np.asarray, between(a, b, share.astype(dtype))), inside)
