"""The data of a tuning: runs as one batch, and which of their rows are to learn from, to stop by and to report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxfilt import doors
from jaxfilt import log as logs
from jaxfilt.fold import Objective, check_truth
from jaxfilt.types import Log, Model, Space, Truth

LEAST_RUNS = 5
"""So many runs are split by run, fewer by time."""


FEW = 16
"""Up to so many runs of different schedules are computed one after the other."""


class Split(NamedTuple):
    """Which data to learn from, to stop early by, and to report, never looked at before.

    With ``by="run"`` each is a fraction of the runs, in their order, or a sequence of their numbers; with ``by="time"``
    a fraction of each run's duration, one after the other. 0 or () leaves a part out."""

    train: float | Sequence[int] = 0.6
    validation: float | Sequence[int] = 0.2
    test: float | Sequence[int] = 0.2
    by: str = "run"


class Case(NamedTuple):
    """Runs to be scored, run axis R first: ``log``; ``truth``; ``weight`` (R, T), which rows count; ``run`` (R,), which
    of the beliefs is whose. Of pieces of runs, ``first`` (R,) says which are the first of theirs."""

    log: Log
    truth: Truth | None
    weight: np.ndarray
    run: np.ndarray
    first: np.ndarray | None = None


def gathered(
    data: Log | Sequence[Log],
    truth: Truth | Sequence[Truth] | None,
    model: Model,
    objective: Objective,
    space: Space,
    dtype: Any,
) -> tuple[Case, np.ndarray]:
    """Logs and truths as one batch that was checked, and the number of rows (R,) of each.

    Raises:
        ValueError, TypeError, KeyError: naming the run, the argument, what was expected and what came.
    """
    each = _runs(data) if isinstance(data, Log) else list(data)
    if not each:
        raise ValueError("logs: expected at least one, got none")
    truths = _truths(truth, len(each), batched=isinstance(data, Log) and np.ndim(data.dt) == 2)
    for i, (log, own) in enumerate(zip(each, truths, strict=True)):
        try:
            logs.validate(model, log, dtype)
            check_truth(objective, own, space, len(log.dt))
        except (ValueError, TypeError, KeyError) as bad:
            place = f"run {i}: " if len(each) > 1 else ""
            raise type(bad)(f"{place}{bad.args[0] if bad.args else bad}") from None
    lengths = np.array([len(log.dt) for log in each])
    whole = (
        jax.tree.map(np.asarray, logs.stack(each))
        if len(each) > 1
        else jax.tree.map(lambda a: np.asarray(a)[None], each[0])
    )
    known = (
        None
        if truths[0] is None
        else jax.tree.map(lambda *a: np.stack(a), *[_longer(t, lengths.max(), dtype) for t in truths])
    )
    weight = np.arange(lengths.max())[None, :] < lengths[:, None]
    return Case(whole, known, weight, np.arange(len(each), dtype=np.int32)), lengths


def _runs(log: Log) -> list[Log]:
    doors.instance("logs", log, Log)
    if np.ndim(log.dt) == 1:
        return [log]
    if np.ndim(log.dt) != 2:
        raise ValueError(f"logs: expected dt of shape (T,) or (runs, T), got {np.shape(log.dt)}")
    runs = len(log.dt)
    doors.leading("logs", log, runs)
    host = jax.tree.map(np.asarray, log)
    return [jax.tree.map(lambda a, i=i: a[i], host) for i in range(runs)]


def _truths(truth: Truth | Sequence[Truth] | None, runs: int, batched: bool) -> list[Truth | None]:
    if truth is None:
        return [None] * runs
    if isinstance(truth, Truth):
        if batched:
            if np.ndim(truth.mask) != 2 or len(truth.mask) != runs:
                raise ValueError(f"truth.mask: expected shape ({runs}, T) for {runs} runs, got {np.shape(truth.mask)}")
            doors.leading("truth", truth, runs)
            host = jax.tree.map(np.asarray, truth)
            return [jax.tree.map(lambda a, i=i: a[i], host) for i in range(runs)]
        truth = [truth]
    if len(truth) != runs:
        raise ValueError(f"truth: expected one for each of {runs} logs, got {len(truth)}")
    for i, own in enumerate(truth):
        doors.instance(f"truth[{i}]", own, Truth)
    return list(truth)


def _longer(truth: Any, length: int, dtype: Any) -> Truth:
    """A truth in the filter's dtype, padded with its last point, unknown; unknown points that are not finite are
    mended."""
    mask, rows = np.asarray(truth.mask, bool), np.arange(length)
    last = np.maximum.accumulate(np.where(mask, np.arange(len(mask)), int(np.argmax(mask))))
    nearest = last[np.minimum(rows, len(mask) - 1)]
    x = jax.tree.map(lambda a: np.asarray(a)[nearest].astype(dtype), truth.x)
    return Truth(x, (rows < len(mask)) & mask[np.minimum(rows, len(mask) - 1)])


def weights(case: Case, lengths: np.ndarray, split: Split | None, burn_in: float) -> tuple[dict[str, np.ndarray], str]:
    """Part -> which rows (R, T) are its own; and how the data were split, in words.

    Raises:
        ValueError: parts that overlap, that have no rows, that ask for runs that are not there, nothing to learn from.
    """
    if not burn_in >= 0:
        raise ValueError(f"burn_in: expected seconds >= 0, got {burn_in}")
    runs = len(lengths)
    split = Split(by="run" if runs >= LEAST_RUNS else "time") if split is None else split
    elapsed = np.cumsum(case.log.dt, axis=1, dtype=np.float64)
    settled = case.weight & (elapsed >= burn_in)
    wanted = dict(zip(Split._fields[:3], split[:3], strict=True))
    if split.by == "run":
        numbers = {name: n for name, n in _numbers(wanted, runs).items() if len(n)}
        own = {name: settled & np.isin(np.arange(runs), n)[:, None] for name, n in numbers.items()}
        words = "by run: " + ", ".join(f"{name} {_listed(n)}" for name, n in numbers.items())
    elif split.by == "time":
        shares = _shares(wanted)
        end = elapsed[np.arange(runs), lengths - 1][:, None]
        edges = np.cumsum([0.0, *shares.values()])
        own = {
            name: settled & (elapsed > low * end if low else True) & (elapsed <= high * end + 1e-9)
            for name, low, high in zip(shares, edges[:-1], edges[1:], strict=True)
            if high > low
        }
        words = "by time: " + ", then ".join(f"{100 * s:.3g} % {name}" for name, s in shares.items() if s)
    else:
        raise ValueError(f"split.by: expected 'run' or 'time', got {split.by!r}")
    for name, w in own.items():
        if not w.any():
            raise ValueError(f"split: expected rows in part {name!r}, got none ({words}; burn_in {burn_in:g} s)")
    return own, words


def _numbers(wanted: dict[str, Any], runs: int) -> dict[str, np.ndarray]:
    """Which runs are in which part."""
    if all(np.ndim(w) == 0 for w in wanted.values()):
        edges = np.round(np.cumsum([0.0, *_shares(wanted).values()]) * runs).astype(int)
        return {name: np.arange(a, b) for name, a, b in zip(wanted, edges[:-1], edges[1:], strict=True)}
    if any(np.ndim(w) == 0 and w != 0 for w in wanted.values()):
        raise ValueError(f"split: expected fractions in all parts, or numbers of runs in all, got {wanted}")
    numbers = {name: np.asarray(w, int) if np.ndim(w) else np.zeros(0, int) for name, w in wanted.items()}
    every = np.concatenate(list(numbers.values()))
    if not len(numbers["train"]):
        raise ValueError(f"split: expected runs to learn from, got {wanted}")
    if every.min() < 0 or every.max() >= runs:
        raise ValueError(f"split: expected numbers of runs from 0 to {runs - 1}, got {every.tolist()}")
    if len(np.unique(every)) != len(every):
        raise ValueError(f"split: expected each run in one part at most, got {every.tolist()}")
    return numbers


def _shares(wanted: dict[str, Any]) -> dict[str, float]:
    if any(np.ndim(w) for w in wanted.values()):
        raise ValueError(f"split: expected fractions, got {wanted}; numbers of runs are for by='run'")
    shares = {name: float(w) for name, w in wanted.items()}
    if min(shares.values()) < 0 or sum(shares.values()) > 1 + 1e-9 or not shares["train"] > 0:
        raise ValueError(f"split: expected fractions >= 0 of sum 1 at most and something to learn from, got {wanted}")
    return shares


def _listed(numbers: np.ndarray) -> str:
    if len(numbers) > 2 and (np.diff(numbers) == 1).all():
        return f"{numbers[0]} to {numbers[-1]}"
    return " and ".join(map(str, numbers)) if len(numbers) < 3 else ", ".join(map(str, numbers))


def restricted(case: Case, weight: np.ndarray) -> Case:
    """The runs in which rows of this weight are, as far as to the last such row."""
    runs = np.flatnonzero(weight.any(1))
    length = int(np.flatnonzero(weight.any(0))[-1]) + 1
    log, truth, own = (jax.tree.map(lambda a: a[runs, :length], part) for part in (case.log, case.truth, weight))
    return Case(log, truth, own, case.run[runs])


def apart(case: Case) -> tuple[Any, Any]:
    """A case with what all its runs share taken out of the batch, and the axes for `jax.vmap`: 0, or None for that.

    Where the schedule is shared, a row without a reading costs nothing: its branch is a real one.
    """

    def axis(a: np.ndarray) -> int | None:
        return None if bool((a == a[:1]).all()) else 0

    leaves, structure = jax.tree.flatten(case)
    own = len(jax.tree.leaves((case.run, case.first)))  # the last ones; never shared
    of_leaves = [axis(leaf) for leaf in leaves[: len(leaves) - own]] + [0] * own
    axes = structure.unflatten(of_leaves)
    return structure.unflatten(
        [leaf[0] if k is None else leaf for leaf, k in zip(leaves, of_leaves, strict=True)]
    ), axes


def over_runs(function: Callable, data: Case, axes: Case) -> Callable:
    """(own arguments, with a leading run axis) -> ``function(own arguments, case)`` of each run of data taken `apart`.

    At once, under `jax.vmap`; but a few runs of different schedules one after the other: in a batch every row would
    compute what any of them reads, and then select.
    """
    runs = len(data.run)
    schedule = jax.tree.leaves((axes.log.dt, axes.log.valid))  # None, shared, is no leaf
    if not schedule or runs > FEW:
        return lambda *own: jax.vmap(function, in_axes=(*[0] * len(own), axes))(*own, data)
    leaves, structure = jax.tree.flatten(data)
    along = structure.flatten_up_to(axes)

    def one(given: tuple) -> Any:
        own, mine = given
        rest = iter(mine)
        case = structure.unflatten([leaf if k is None else next(rest) for leaf, k in zip(leaves, along, strict=True)])
        return function(*own, case)

    batched = [leaf for leaf, k in zip(leaves, along, strict=True) if k == 0]
    return lambda *own: jax.lax.map(one, (own, batched))


def some(case: Case, axes: Case, runs: np.ndarray) -> Case:
    """Some runs of a case that was taken `apart`."""
    leaves, structure = jax.tree.flatten(case)
    along = structure.flatten_up_to(axes)
    return structure.unflatten([leaf if k is None else leaf[runs] for leaf, k in zip(leaves, along, strict=True)])


def pieces(case: Case, length: int) -> Case:
    """The runs cut into pieces of ``length`` rows, in their order, as runs of their own; the last of each is padded.

    What a piece goes on from depends on the parameters, and is not said here.
    """
    R, T = case.weight.shape
    count = -(-T // length)
    more = count * length - T

    def cut(a: np.ndarray) -> np.ndarray:
        padded = np.concatenate([a, np.repeat(a[:, -1:], more, axis=1)], axis=1)
        return padded.reshape(R * count, length, *a.shape[2:])

    log, truth, weight = (jax.tree.map(cut, part) for part in (case.log, case.truth, case.weight))
    padding = np.arange(count * length)[None, :].repeat(R, 0).reshape(R * count, length) >= T
    valid = {name: np.ones((R * count, length), bool) for name in log.z} | dict(log.valid) if more else dict(log.valid)
    valid = {name: a & ~(padding if a.ndim == 2 else padding[..., None]) for name, a in valid.items()}
    log = log._replace(dt=np.where(padding, 0, log.dt).astype(log.dt.dtype), valid=valid)
    truth = None if truth is None else truth._replace(mask=truth.mask & ~padding)
    run = np.repeat(case.run, count)
    return Case(log, truth, weight & ~padding, run, np.tile(np.arange(count) == 0, R))
