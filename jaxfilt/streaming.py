"""One row of a study: all filters step, and what a study wants to know of it is summed at once or carried on.

Straight-line code on the few numbers of one run, for `jaxfilt.loop.loop`: nothing is kept of a row but its sums.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import metrics
from jaxfilt.tally import Blocks, Columns, Moments, score
from jaxfilt.types import Array, Filter, Log, PyTree, Status

NO_FAULT = np.int32(2**31 - 1)
"""A fault that is none, later than all others."""


class Lags(NamedTuple):
    """Of one sensor: its ``recent`` normalised innovations (F, L, m), the latest first; the sums of their products with
    each later one, ``dots`` (F, L) by lag, and of how many components, ``pairs`` (F, L).
    """

    recent: Array
    dots: Array
    pairs: Array


class Told(NamedTuple):
    """What is known of a run so far, by filter.

    ``total`` and ``count`` (F, k) of what is averaged over time; the last ``nees`` (F,); whether it was ``sound``
    throughout; its first ``fault``, as the number ``row * sensors + sensor`` (`NO_FAULT`: none), with its ``status``;
    its ``worst`` (F, B) squared error by block; ``lags`` by sensor.
    """

    total: Array
    count: Array
    nees: Array
    sound: Array
    fault: Array
    status: Array
    worst: Array
    lags: dict[str, Lags]


class At(NamedTuple):
    """Where a row is in the schedule: its ``number``, and by sensor whether it ``reads`` (left out: always)."""

    number: Array
    reads: dict[str, Array]


class Row(NamedTuple):
    """What leaves a row, by filter: to be added up over runs ``sums`` (F, k) and ``outer`` (F, n (n + 1) / 2), which is
    the upper triangle of ``e e'``; to be kept at some rows ``normalised`` and ``error`` (F, n) and ``nees`` (F,).
    """

    sums: Moments
    outer: Array
    normalised: Array
    error: Array
    nees: Array


def instants(log: Log) -> At:
    """Those of a schedule, leading axis T."""
    steps = len(log.dt)
    reads = {name: jnp.asarray(valid).reshape(steps, -1).any(1) for name, valid in log.valid.items()}
    return At(jnp.arange(steps, dtype=jnp.int32), reads)


def nothing(place: Columns, filters: int, lags: int, sensors: dict[str, int], dtype: np.dtype) -> Told:
    """Before the first row; ``sensors`` name -> components of its reading."""
    zeros = lambda *shape: jnp.zeros((filters, *shape), dtype)  # noqa: E731
    pairs = jnp.zeros((filters, lags), jnp.int32)
    averaged, blocks = (at.stop - at.start for at in (place.averaged, place.at["square"]))
    return Told(
        total=zeros(averaged),
        count=zeros(averaged),
        nees=zeros(),
        sound=jnp.full(filters, True),
        fault=jnp.full(filters, NO_FAULT),
        status=jnp.full(filters, NO_FAULT),
        worst=zeros(blocks),
        lags={name: Lags(zeros(lags, m), zeros(lags), pairs) for name, m in sensors.items()},
    )


def judged(
    bank: dict[str, Filter],
    place: Columns,
    blocks: Blocks,
    sensors: Sequence[str],
    weight: Array,
    carry: tuple[dict[str, PyTree], Told],
    row: Log,
    truth: PyTree,
    at: At,
) -> tuple[tuple[dict[str, PyTree], Told], Row]:
    """What the filters carry and what is told after a row.

    ``truth`` is the true state, ``weight`` (F,) says which filters count.
    """
    beliefs, told = carry
    space = next(iter(bank.values())).model.space
    stepped = {name: filt.step(beliefs[name], row) for name, filt in bank.items()}
    beliefs = {name: b for name, (b, _) in stepped.items()}
    gaussians = [bank[name].gaussian(b) for name, b in beliefs.items()]
    error = jnp.stack([metrics.errors(space, truth, b.mean) for b in gaussians])
    cov = jnp.stack([b.cov for b in gaussians])
    infos = [{name: info[name] for name in sensors} for _, info in stepped.values()]
    info = jax.tree.map(lambda *a: jnp.stack(a), *infos)
    # One call for all filters: each factorization written out costs time to compile.
    values, white = jax.vmap(functools.partial(score, place, blocks))(error, cov, info)
    there = jnp.isfinite(values) & weight[:, None]
    kept = jnp.where(there, values, 0.0)
    sums = Moments(
        there[:, place.counted].astype(values.dtype), kept[:, place.summed], jnp.square(kept[:, place.squared])
    )
    whole = jnp.isfinite(error).all(1) & weight
    counted = jnp.where(whole[:, None], error, 0.0)
    outer = jnp.concatenate([counted[:, i : i + 1] * counted[:, i:] for i in range(space.dim)], 1)
    fault, status = _first_fault(told, at.number, jnp.stack([info[name].status for name in sensors], 1))
    nees = values[:, place.at["nees"].start]
    told = Told(
        total=told.total + kept[:, place.averaged],
        count=told.count + there[:, place.averaged].astype(told.count.dtype),
        nees=nees,
        sound=told.sound & jnp.isfinite(error).all(1) & jnp.isfinite(cov).all((1, 2)),
        fault=fault,
        status=status,
        worst=jnp.fmax(told.worst, values[:, place.at["square"]]),
        lags={
            name: _lagged(told.lags[name], jnp.where(weight[:, None], w, 0.0), at.reads.get(name))
            for name, w in white.items()
        },
    )
    return (beliefs, told), Row(sums, outer, values[:, place.at["normalised"]], error, nees)


def _first_fault(told: Told, row: Array, codes: Array) -> tuple[jax.Array, jax.Array]:
    """The fault and its status after one more row: ``codes`` (F, sensors) of `Status`."""
    fault, status, count = told.fault, told.status, codes.shape[1]
    for sensor in range(count):
        new = (codes[:, sensor] >= Status.BAD_BELIEF) & (fault == NO_FAULT)
        fault = jnp.where(new, row * count + sensor, fault)
        status = jnp.where(new, codes[:, sensor], status)
    return fault, status


def _lagged(lags: Lags, white: Array, reads: Array | None) -> Lags:
    """After one more row, of normalised innovations (F, m); lags count the readings of the schedule.

    What was not used is exactly 0 in ``white``, and what was used never is: the noise is continuous.
    """

    def moved(lags: Lags) -> Lags:
        products = lags.recent * white[:, None]
        return Lags(
            jnp.concatenate([white[:, None], lags.recent[:, :-1]], 1),
            lags.dots + products.sum(-1),
            lags.pairs + (products != 0).sum(-1, dtype=jnp.int32),
        )

    return moved(lags) if reads is None else jax.lax.cond(reads, moved, lambda lags: lags, lags)
