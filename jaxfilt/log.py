"""Logs on the host, in float64: merging recorded streams, scheduling simulated ones, checking, padding, files.

Times are absolute float64 seconds until here; only their differences enter a `Log`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any

import jax
import numpy as np

from jaxfilt import doors
from jaxfilt.types import Array, Log, Model, PyTree, Recording, Space, Stream, Truth


def merge(
    model: Model,
    streams: Mapping[str, Stream | tuple[Any, ...]],
    u: tuple[np.ndarray, PyTree] | None = None,
    start: float | None = None,
    late: Mapping[str, float] | None = None,
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
        late: sensor -> s by which its stamps come after the instant that its readings speak of (negative: before). They
            are taken back by it, and ordered by the time of their validity.

    Returns:
        Recording(log, t): numbers in JAX's default float dtype, t absolute in float64.

    Raises:
        KeyError: a sensor that the model lacks, a late one without a stream.
        ValueError: NaN in t, z or u (mark what is missing by ``valid``), lengths that differ, input stamps out of
            order, nothing to merge, a stamp before ``start``.

    Example:
        >>> import numpy as np, jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> rec = jf.merge(walk, {"z": (np.array([0.5, 0.0]), np.array([[2.0], [1.0]]))})
        >>> rec.t.tolist(), rec.log.dt.tolist(), rec.log.z["z"][:, 0].tolist()
        ([0.0, 0.5], [0.0, 0.5], [1.0, 2.0])
    """
    delays = _delays(late, streams)
    named = {name: _sorted(_checked(model, name, stream, delays.get(name, 0.0))) for name, stream in streams.items()}
    tu, values = _checked_input(u)
    t, rows = _rows({name: stream.t for name, stream in named.items()}, tu)
    if not len(t):
        raise ValueError("streams: expected at least one reading or input, got none")
    start = float(t[0] if start is None else start)
    if not -np.inf < start <= t[0]:
        raise ValueError(f"start: expected a time not after the first stamp {t[0]}, got {start}")
    began = np.r_[start, t[:-1]]

    z, c, valid = {}, {}, {}
    for name, stream in named.items():
        z[name] = _held(stream.z, model.sensors[name].space.origin, rows[name], len(t))
        if jax.tree.leaves(stream.c):
            first = jax.tree.map(lambda a: a[0] if len(a) else np.zeros(a.shape[1:], a.dtype), stream.c)
            c[name] = _held(stream.c, first, rows[name], len(t))
        there = np.ones(len(stream.t), bool) if stream.valid is None else stream.valid
        valid[name] = np.zeros((len(t), *there.shape[1:]), bool)
        valid[name][rows[name]] = there
    held = np.clip(np.searchsorted(tu, began, side="right") - 1, 0, None)
    inputs = jax.tree.map(lambda a: a[held], values)
    log = Log(t - began, inputs, z, c, {name: there for name, there in valid.items() if not there.all()})
    return Recording(_in_default_dtype(log), t)


def _delays(late: Mapping[str, float] | None, streams: Mapping[str, Any]) -> dict[str, float]:
    delays = dict(late or {})
    for name, delay in delays.items():
        if name not in streams:
            raise KeyError(f"late: expected sensors of {list(streams)}, got {name!r}")
        if isinstance(delay, bool) or not isinstance(delay, Real) or not math.isfinite(delay):
            raise ValueError(f"late[{name!r}]: expected a finite number of seconds, got {delay!r}")
    return {name: float(delay) for name, delay in delays.items()}


def _checked(model: Model, name: str, stream: tuple[Any, ...], late: float) -> Stream:
    space = doors.sensor(model, name).space
    if not (isinstance(stream, tuple) and 2 <= len(stream) <= 4):
        raise TypeError(
            f"stream of {name!r}: expected Stream(t, z, c, valid) or (t, z[, c[, valid]]), got {type(stream).__name__}"
        )
    t, z, c, valid = Stream(*stream)
    t = _seconds(f"t of {name!r}", t)
    z, c = jax.tree.map(np.asarray, (z, c))
    valid = None if valid is None else np.asarray(valid)
    doors.finite(f"t of {name!r}", t)
    doors.point(f"z of {name!r}", z, space, leading=t.shape)
    if valid is not None:
        doors.mask(f"valid of {name!r}", valid, t.shape, (*t.shape, space.dim))
    try:
        doors.finite(f"z of {name!r}", z)
    except ValueError as bad:
        raise ValueError(f"{bad}; put any finite number there and mark it in valid") from None
    doors.leading(f"c of {name!r}", c, len(t))
    doors.finite(f"c of {name!r}", c)
    return Stream(t - late, z, c, valid)


def _seconds(name: str, t: Any) -> np.ndarray:
    t = np.asarray(t)
    if t.ndim != 1 or not np.issubdtype(t.dtype, np.number):
        raise ValueError(f"{name}: expected seconds as numbers of shape (K,), got {doors.describe(t)}")
    return t.astype(np.float64)


def _checked_input(u: tuple[np.ndarray, PyTree] | None) -> tuple[np.ndarray, PyTree]:
    if u is None:
        return np.zeros(0), ()
    if not (isinstance(u, tuple) and len(u) == 2):
        raise TypeError(f"u: expected (t, values), got {doors.describe(u)}")
    t, values = _seconds("t of u", u[0]), jax.tree.map(np.asarray, u[1])
    doors.increasing("t of u", t)
    doors.leading("u", values, len(t))
    doors.floating("u", values)
    doors.finite("u", values)
    return t, values


def _sorted(stream: Stream) -> Stream:
    """In order of time; readings with the same stamp in order of value, so that arrival does not matter."""
    leaves = jax.tree.leaves((stream.z, stream.c, stream.valid))
    keys = np.concatenate([leaf.reshape(len(stream.t), math.prod(leaf.shape[1:])).T for leaf in leaves])
    order = np.lexsort([*keys[::-1], stream.t])
    return jax.tree.map(lambda a: a[order], stream)


def _rows(stamps: Mapping[str, np.ndarray], inputs: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The times of the rows, and for each sensor the rows of its readings, whose sorted stamps are given.

    A time has as many rows as the sensor with the most readings there: the k-th of each sensor share the k-th row.
    """
    times = np.unique(np.concatenate([inputs, *stamps.values()]))
    at = {name: np.searchsorted(times, t) for name, t in stamps.items()}
    repeat = {name: np.arange(len(t)) - np.searchsorted(t, t) for name, t in stamps.items()}
    count = np.ones(len(times), int)
    for name in stamps:
        np.maximum.at(count, at[name], repeat[name] + 1)
    first = np.cumsum(count) - count
    return np.repeat(times, count), {name: first[at[name]] + repeat[name] for name in stamps}


def _held(readings: PyTree, before: PyTree, rows: np.ndarray, length: int) -> PyTree:
    """Each row's latest reading, ``before`` where there is none yet.

    It stands in rows that are marked invalid. A batch computes their updates too before it drops them, and from
    anything but a proper reading (a quaternion of zeros) reverse mode would bring back NaN.
    """
    latest = np.searchsorted(rows, np.arange(length), side="right")
    return jax.tree.map(lambda a, a0: np.concatenate([np.asarray(a0, a.dtype)[None], a])[latest], readings, before)


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
        ValueError: steps < 1, dt <= 0, ``every`` negative or no whole number, leading axes that are not T.
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
    every, c = dict(every or {}), dict(c or {})
    for name in (*every, *c):
        doors.sensor(model, name)
    for name, k in every.items():
        if k < 0 or k != int(k):
            raise ValueError(f"every[{name!r}]: expected a whole number of rows >= 0, got {k}")
    z, valid = {}, {}
    for name, sensor in model.sensors.items():
        k = every.get(name, 1)
        if k == 0:
            continue
        z[name] = jax.tree.map(lambda a: np.broadcast_to(a, (steps, *np.shape(a))).copy(), sensor.space.origin)
        if k > 1:
            valid[name] = np.arange(1, steps + 1) % k == 0
    log = Log(np.full(steps, dt), jax.tree.map(np.asarray, u), z, jax.tree.map(np.asarray, c), valid)
    doors.leading("log", log, steps)
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
    doors.tables("log", log, model)
    doors.array("log.dt", log.dt)
    if log.dt.ndim != 1:
        raise ValueError(f"log.dt: expected shape (T,), got {log.dt.shape}")
    length = len(log.dt)
    if length == 0:
        raise ValueError("log: expected at least one row, got none")
    doors.leading("log", log, length)
    doors.floating("log.dt", log.dt)
    doors.finite("log.dt", log.dt)
    if doors.is_concrete(log.dt) and (np.asarray(log.dt) < 0).any():
        k = int(np.argmax(np.asarray(log.dt) < 0))
        raise ValueError(f"log.dt: expected intervals >= 0 s, got {np.asarray(log.dt)[k]} at row {k}")
    for name, z in log.z.items():
        doors.point(f"log.z[{name!r}]", z, model.sensors[name].space, leading=(length,))
    for name, valid in log.valid.items():
        doors.mask(f"log.valid[{name!r}]", valid, (length,), (length, model.sensors[name].space.dim))
    dtype = jax.dtypes.canonicalize_dtype(log.dt.dtype if dtype is None else dtype)
    doors.same_dtype(dtype, **{"log.dt": log.dt})
    doors.inputs("log.u", log.u, dtype)
    for field, table in {"z": log.z, "c": log.c}.items():
        for name, tree in table.items():
            doors.finite(f"log.{field}[{name!r}]", tree)
            doors.same_dtype(dtype, **{f"log.{field}[{name!r}]": tree})


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
        for field, a, b in zip(Log._fields, full[0], log, strict=True):
            if jax.tree.structure(a) != jax.tree.structure(b):
                found = f"{doors.describe(a)} and {doors.describe(b)}"
                raise ValueError(f"logs: expected one structure of {field}, got {found}")

    return jax.tree.map(lambda *leaves: np.stack(leaves), *[_padded(log, length) for log in full])


def _padded(log: Log, length: int) -> Log:
    """More rows in which nothing happens; for what `_held` says, they repeat the last one's input and readings."""
    more = length - len(log.dt)

    def repeated(a: Array) -> np.ndarray:
        return np.concatenate([a, np.repeat(np.asarray(a)[-1:], more, axis=0)])

    log = jax.tree.map(repeated, log)
    log.dt[length - more :] = 0
    for valid in log.valid.values():
        valid[length - more :] = False
    return log


def _explicit(logs: Sequence[Log], log: Log, name: str) -> np.ndarray:
    """The mask of a sensor written out, by component if any of the logs has it so."""
    masks = [np.asarray(other.valid[name]) for other in logs if name in other.valid]
    by_component = [mask.shape[1] for mask in masks if mask.ndim == 2]
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
        Truth(x, mask): x with leading axis T; mask False outside the truth's time and inside gaps.

    Raises:
        ValueError: stamps that are not finite or not increasing, fewer than two samples, NaN in the points (leave such
            samples out; ``gap`` masks where they were).
    """
    stamps = _seconds("t of truth", truth[0])
    doors.increasing("t of truth", stamps)
    if len(stamps) < 2:
        raise ValueError(f"t of truth: expected at least two stamps, got {len(stamps)}")
    points = jax.tree.map(np.asarray, truth[1])
    doors.point("truth", points, space, leading=stamps.shape)
    doors.finite("truth", points)
    t = _seconds("t", t)
    after = np.clip(np.searchsorted(stamps, t, side="right"), 1, len(stamps) - 1)
    width = stamps[after] - stamps[after - 1]
    share = np.clip((t - stamps[after - 1]) / width, 0.0, 1.0)
    dtype = jax.dtypes.canonicalize_dtype(float)
    a, b = (jax.tree.map(lambda x, i=i: x[i].astype(dtype), points) for i in (after - 1, after))
    between = jax.jit(jax.vmap(lambda a, b, s: space.plus(a, s * space.minus(b, a))))
    inside = (t >= stamps[0]) & (t <= stamps[-1])
    known = (width <= gap) | (share == 0) | (share == 1)
    return Truth(jax.tree.map(np.asarray, between(a, b, share.astype(dtype))), inside & known)
