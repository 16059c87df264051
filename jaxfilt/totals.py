"""What a study has so far: the sums of its chunks, and what is compared between runs; host side."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from jaxfilt.chunk import Chunk, Each, Examples
from jaxfilt.streaming import NO_FAULT
from jaxfilt.tally import Sums
from jaxfilt.types import Array

NAMED = 16
"""How many of the diverged runs are named."""

NOBODY = np.iinfo(np.int64).max
"""A run that is none, after all others."""


class Records(NamedTuple):
    """What is not added up but compared, by filter (F,).

    How many runs ``diverged`` and the first of them, ``named`` (F, `NAMED`); how many were ``faulty``, and the earliest
    ``fault`` (see `jaxfilt.chunk.Each`), the first run that has it and its status; the ``worst`` (F, B) squared error
    by block, and the run that made it, of all runs and of those that did not diverge.
    """

    diverged: Array
    named: Array
    faulty: Array
    fault: Array
    fault_run: Array
    status: Array
    worst: Array
    worst_run: Array
    kept_worst: Array
    kept_worst_run: Array


class Totals(NamedTuple):
    """All that is known after ``done`` runs; with a sweep the rest has a leading axis of settings.

    ``all``: sums over all runs, of what is finite; ``kept``: over the runs that did not diverge. ``error``
    (F, rows, sample, n), ``nees`` (F, rows, sample) and ``lost`` (sample, F) of the first runs.
    """

    done: Array
    all: Sums
    kept: Sums
    records: Records
    error: Array
    nees: Array
    lost: Array
    examples: Examples


def totals(chunk: Chunk, numbers: np.ndarray, counts: np.ndarray, kept: Sums | None = None) -> Totals:
    """Those of one chunk, of the runs of these numbers (R,) that count; ``kept`` None: no run diverged."""
    sample = chunk.nees.shape[-1]
    real = min(sample, int(counts.sum()))
    return Totals(
        np.int64(counts.sum()),
        jax.tree.map(lambda a: np.asarray(a, np.float64), chunk.sums),
        jax.tree.map(lambda a: np.asarray(a, np.float64), chunk.sums if kept is None else kept),
        _records(chunk.each, numbers, counts),
        np.asarray(chunk.error)[..., :real, :],
        np.asarray(chunk.nees)[..., :real],
        np.asarray(chunk.each.diverged)[..., :real, :],
        jax.tree.map(np.asarray, chunk.examples),
    )


def added(a: Totals, b: Totals, sample: int) -> Totals:
    """Both together; ``a`` has the earlier runs, which win ties."""
    more = lambda x, y, axis: x if x.shape[axis] >= sample else np.concatenate([x, y], axis)  # noqa: E731
    cut = lambda x, axis: x[(..., slice(sample)) + (slice(None),) * (-1 - axis)]  # noqa: E731
    return Totals(
        a.done + b.done,
        jax.tree.map(np.add, a.all, b.all),
        jax.tree.map(np.add, a.kept, b.kept),
        _compared(a.records, b.records),
        cut(more(a.error, b.error, -2), -2),
        cut(more(a.nees, b.nees, -1), -1),
        cut(more(a.lost, b.lost, -2), -2),
        a.examples,
    )


def _records(each: Each, numbers: np.ndarray, counts: np.ndarray) -> Records:
    each = jax.tree.map(np.asarray, each)
    runs = numbers.astype(np.int64)[counts]
    diverged, fault, status = (a[..., counts, :] for a in (each.diverged, each.fault, each.status))
    worst = each.worst[..., counts, :, :]
    named = np.sort(np.where(np.moveaxis(diverged, -2, -1), runs, NOBODY), -1)[..., :NAMED]
    kept_worst = np.where(diverged[..., None], 0.0, worst)
    first = fault.argmin(-2)
    return Records(
        diverged=diverged.sum(-2),
        named=np.pad(named, [(0, 0)] * (named.ndim - 1) + [(0, NAMED - named.shape[-1])], constant_values=NOBODY),
        faulty=(fault != NO_FAULT).sum(-2),
        fault=fault.min(-2),
        fault_run=runs[first],
        status=np.take_along_axis(status, first[..., None, :], -2)[..., 0, :],
        worst=worst.max(-3),
        worst_run=runs[worst.argmax(-3)],
        kept_worst=kept_worst.max(-3),
        kept_worst_run=runs[kept_worst.argmax(-3)],
    )


def _compared(a: Records, b: Records) -> Records:
    sooner, larger, kept_larger = b.fault < a.fault, b.worst > a.worst, b.kept_worst > a.kept_worst
    return Records(
        diverged=a.diverged + b.diverged,
        named=np.sort(np.concatenate([a.named, b.named], -1), -1)[..., :NAMED],
        faulty=a.faulty + b.faulty,
        fault=np.where(sooner, b.fault, a.fault),
        fault_run=np.where(sooner, b.fault_run, a.fault_run),
        status=np.where(sooner, b.status, a.status),
        worst=np.where(larger, b.worst, a.worst),
        worst_run=np.where(larger, b.worst_run, a.worst_run),
        kept_worst=np.where(kept_larger, b.kept_worst, a.kept_worst),
        kept_worst_run=np.where(kept_larger, b.kept_worst_run, a.kept_worst_run),
    )
