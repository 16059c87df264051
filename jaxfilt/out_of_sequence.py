"""Filtering online, readings coming late: the last rows are kept, and run again when an older one arrives."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxfilt import doors
from jaxfilt.types import Array, Filter, Gaussian, Info, Log, PyTree


class Row(NamedTuple):
    """What came at one instant: ``t`` s, inf where nothing did; ``log``, its readings and the input from then on, if
    it ``turns`` (else the one before stays); ``rank``, its order within the instant; ``belief`` after it."""

    t: Array
    log: Log
    turns: Array
    rank: Array
    belief: Gaussian


class Backlog(NamedTuple):
    """The last rows in order of time, and the belief after each of them: what is carried from arrival to arrival.

    All of ``rows`` has leading axis n; ``begin``, with none, is what came before the oldest of them.
    """

    rows: Row
    begin: Row


class Arrival(NamedTuple):
    """What an arrival leads to: the ``belief`` at the latest time, the ``info`` of the readings that came (by sensor),
    and whether they were ``taken``: False where they are older than all rows that are kept, and change nothing."""

    belief: Gaussian
    info: dict[str, Info]
    taken: Array


class OutOfSequence(NamedTuple):
    """Pure functions: ``begin(belief, t) -> Backlog``; ``arrive(backlog, t, z, c, u) -> (Backlog, Arrival)``."""

    begin: Callable[..., Backlog]
    arrive: Callable[..., tuple[Backlog, Arrival]]


def out_of_sequence(filter: Filter, rows: int, u: PyTree = (), c: Mapping[str, PyTree] | None = None) -> OutOfSequence:
    """A filter for readings that arrive late, in any order: the answer is that of readings in order of time, exactly.

    It keeps the last rows with their beliefs. A reading goes where its time says, and all later rows are run again:
    no approximation, at the cost of one step for each row later than it. Rows of one instant are run in the order of
    ``model.sensors``; two readings of one sensor at one instant, in the order of their arrival.

    Args:
        filter: of `ekf`, `ukf` ...; its belief at the latest time is the answer.
        rows: how many rows are kept: a reading later than that many others is not taken.
        u: the input in force at the beginning, a pytree; ``()``: no input.
        c: sensor -> an example of its context, for those that have one.

    Returns:
        OutOfSequence(begin, arrive). ``begin(belief, t)`` starts at time t (s). ``arrive(backlog, t, z, c, u)`` takes
        the readings z (sensor -> reading, of the sensors that spoke at t) with their contexts c, and an input u that is
        in force from t on (None: it stays as it is). Jit ``arrive``: it compiles once for each set of sensors. Times
        are in the belief's dtype: in float32 count them from the beginning of the flight, not from 1970.

    Raises:
        KeyError, ValueError, TypeError: from the two functions, naming the argument, what was expected and what came.

    Example: the second reading comes first.
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> online = jf.out_of_sequence(jf.kf(walk), rows=10)
        >>> backlog = online.begin(jf.Gaussian(jnp.zeros(1), jnp.eye(1)), 0.0)
        >>> for t, z in ((2.0, 2.0), (1.0, 1.0)):
        ...     backlog, arrival = online.arrive(backlog, t, {"z": jnp.array([z])})
        >>> belief, row = jf.Gaussian(jnp.zeros(1), jnp.eye(1)), jf.schedule(walk, 2, 1.0)
        >>> track = jf.scan(jf.kf(walk), belief, row._replace(z={"z": jnp.array([[1.0], [2.0]])}))
        >>> bool(arrival.belief.mean == track.belief.mean[-1])
        True

    Source: reprocessing in Y. Bar-Shalom, Update with out-of-sequence measurements in tracking: exact solution (2002),
    section I, where it is the exact answer that cheaper algorithms approach.
    """
    if isinstance(rows, bool) or not isinstance(rows, int) or rows < 1:
        raise ValueError(f"rows: expected a whole number of at least 1, got {rows!r}")
    doors.instance("filter", filter, Filter)
    contexts = dict(c or {})
    for name in contexts:
        doors.sensor(filter.model, name)

    def silent(dtype: jnp.dtype) -> Log:
        z = {name: sensor.space.origin for name, sensor in filter.model.sensors.items()}
        z, held, context = _cast((z, u, contexts), dtype)
        return Log(jnp.zeros((), dtype), held, z, context, dict.fromkeys(z, jnp.asarray(False)))

    def begin(belief: Gaussian, t: Array | float = 0.0) -> Backlog:
        doors.belief("belief", belief, filter.model.space)
        dtype = jax.dtypes.canonicalize_dtype(belief.cov.dtype)
        belief = Gaussian(*_cast(tuple(belief), dtype))
        first = Row(jnp.asarray(t, dtype), silent(dtype), jnp.asarray(True), jnp.asarray(0, jnp.int32), belief)
        none = first._replace(t=jnp.asarray(jnp.inf, dtype), turns=jnp.asarray(False))
        return Backlog(jax.tree.map(lambda a: jnp.broadcast_to(a, (rows, *a.shape)), none), first)

    def arrive(
        backlog: Backlog,
        t: Array | float,
        z: Mapping[str, PyTree] | None = None,
        c: Mapping[str, PyTree] | None = None,
        u: PyTree = None,
    ) -> tuple[Backlog, Arrival]:
        dtype = backlog.begin.belief.cov.dtype
        log, names = silent(dtype), list(filter.model.sensors)
        z, c = _checked(filter, log, t, dict(z or {}), dict(c or {}), u)
        log = log._replace(
            u=log.u if u is None else _cast(u, dtype),
            z=log.z | _cast(z, dtype),
            c=log.c | _cast(c, dtype),
            valid=log.valid | dict.fromkeys(z, jnp.asarray(True)),
        )
        rank = jnp.asarray(min(map(names.index, z), default=len(names)), jnp.int32)
        room = _with_room(backlog)
        row = Row(jnp.asarray(t, dtype), log, jnp.asarray(u is not None), rank, room.begin.belief)
        taken = (row.t >= room.begin.t) & jnp.isfinite(row.t)
        place = ((room.rows.t < row.t) | ((room.rows.t == row.t) & (room.rows.rank <= rank))).sum(dtype=jnp.int32)
        ordered = _inserted(room.rows, row, place)
        beliefs, infos = _run_again(filter, room.begin, ordered, place)
        after = room._replace(rows=ordered._replace(belief=beliefs))
        backlog = jax.tree.map(lambda new, old: jnp.where(taken, new, old), after, backlog)
        info = {name: jax.tree.map(lambda a: a[place], infos[name]) for name in z}
        return backlog, Arrival(_latest(backlog), info, taken)

    return OutOfSequence(begin, arrive)


def _cast(tree: PyTree, dtype: jnp.dtype) -> PyTree:
    return jax.tree.map(lambda a: jnp.asarray(a, dtype), tree)


def _checked(
    filter: Filter, silent: Log, t: Array | float, z: dict[str, PyTree], c: dict[str, PyTree], u: PyTree
) -> tuple[dict[str, PyTree], dict[str, PyTree]]:
    if jnp.shape(t) != ():
        raise ValueError(f"t: expected a scalar, got shape {jnp.shape(t)}")
    doors.finite("t", jnp.asarray(t))
    for name, reading in z.items():
        doors.point(f"z[{name!r}]", reading, doors.sensor(filter.model, name).space)
        doors.finite(f"z[{name!r}]", reading)
        if (name in silent.c) != (name in c):
            raise ValueError(
                f"c: expected the context of {name!r} with its reading as at out_of_sequence(c=...), got {c}"
            )
    for name, context in c.items():
        if name not in z:
            raise KeyError(f"c: expected contexts of {list(z)}, which were read, got {name!r}")
        doors.alike(f"c[{name!r}]", context, silent.c[name])
    if u is not None:
        doors.alike("u", u, silent.u)
        doors.finite("u", u)
    return z, c


def _with_room(backlog: Backlog) -> Backlog:
    """Without its oldest row, if there is no place left: that becomes the beginning, with the input in force there."""
    oldest = jax.tree.map(lambda a: a[0], backlog.rows)
    held = jax.tree.map(lambda new, old: jnp.where(oldest.turns, new, old), oldest.log.u, backlog.begin.log.u)
    begin = oldest._replace(log=oldest.log._replace(u=held))
    rows = jax.tree.map(lambda a: jnp.roll(a, -1, axis=0), backlog.rows)
    rows = rows._replace(t=rows.t.at[-1].set(jnp.inf))
    full = jnp.isfinite(backlog.rows.t[-1])
    return jax.tree.map(lambda new, old: jnp.where(full, new, old), Backlog(rows, begin), backlog)


def _inserted(rows: Row, row: Row, place: jax.Array) -> Row:
    def among(many: jax.Array, one: jax.Array) -> jax.Array:
        k = jnp.arange(len(many), dtype=jnp.int32).reshape(-1, *[1] * one.ndim)
        return jnp.where(k < place, many, jnp.where(k == place, one, jnp.roll(many, 1, axis=0)))

    return jax.tree.map(among, rows, row)


def _run_again(filter: Filter, begin: Row, rows: Row, place: jax.Array) -> tuple[Gaussian, dict[str, Info]]:
    """Beliefs after each row and what was reported, the latter only from the new row on: those before it stand."""

    def one(carry: tuple, at: tuple) -> tuple:
        belief, t, held = carry
        row, k = at
        log = row.log._replace(dt=row.t - t, u=held)
        report = jax.eval_shape(filter.step, belief, log)[1]

        def kept() -> tuple:
            return row.belief, jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), report)

        there = jnp.isfinite(row.t)
        belief, infos = jax.lax.cond((k >= place) & there, lambda: filter.step(belief, log), kept)
        held = jax.tree.map(lambda new, old: jnp.where(there & row.turns, new, old), row.log.u, held)
        return (belief, jnp.where(there, row.t, t), held), (belief, infos)

    start = begin.belief, begin.t, begin.log.u
    return jax.lax.scan(one, start, (rows, jnp.arange(len(rows.t), dtype=jnp.int32)))[1]


def _latest(backlog: Backlog) -> Gaussian:
    last = jnp.isfinite(backlog.rows.t).sum() - 1
    return jax.tree.map(
        lambda first, many: jnp.where(last < 0, first, many[last]), backlog.begin.belief, backlog.rows.belief
    )
