"""The program of a chunk of runs: simulate, filter, score and sum, compiled once for all parameters."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from jaxfilt import devices as spreading
from jaxfilt.loop import Added, Backend, Kept, loop
from jaxfilt.mismatch import Corruption
from jaxfilt.simulate import simulated, started
from jaxfilt.streaming import NO_FAULT, Row, Told, instants, judged, nothing
from jaxfilt.tally import (
    NEES_EDGES,
    Blocks,
    Columns,
    Moments,
    Sums,
    columns,
    error_histogram,
    every,
    histogram,
    moments,
)
from jaxfilt.types import Array, Filter, Gaussian, Log, Model, PyTree


class Plan(NamedTuple):
    """All of a study that is compiled in, hashable: functions of theta, and sizes.

    ``swept``: whether theta and the truth's theta have a leading axis of settings to be run on the same noise.
    """

    model: Callable[[PyTree], Model]
    filters: tuple[tuple[str, Callable[[PyTree], Filter]], ...]
    belief: Callable[[PyTree], Gaussian]
    origin: Callable[[PyTree], Gaussian]
    view: Callable[[PyTree], PyTree]
    control: Callable[[PyTree, PyTree], PyTree] | None
    corrupt: Callable[[PyTree], Corruption] | None
    blocks: Blocks
    limit: float
    examples: int
    sample: int
    lags: int
    swept: tuple[bool, bool]
    generator: str
    backend: Backend


class Examples(NamedTuple):
    """The first runs of a chunk, kept whole: ``truth`` and by filter its belief, leading axes (examples, T)."""

    truth: PyTree
    tracks: dict[str, Gaussian]


class Each(NamedTuple):
    """What is known of each run, leading axes (R, F): whether it ``diverged``; its first ``fault``, as the number
    ``row * sensors + sensor`` (`NO_FAULT`: none) with its ``status``; its ``worst`` (B,) squared error by block.
    """

    diverged: Array
    fault: Array
    status: Array
    worst: Array


class Chunk(NamedTuple):
    """What leaves a chunk; with a sweep, all of it has a leading axis of settings.

    ``error`` (F, rows, sample, n) and ``nees`` (F, rows, sample) of its first runs, at some rows, see `every`.
    """

    sums: Sums
    each: Each
    error: Array
    nees: Array
    examples: Examples


class Program(NamedTuple):
    """A compiled chunk: ``call(theta, truth_theta, log, key data, numbers (R,), weights (R, F))``.

    With a sweep the weights are (settings, R, F). ``digest`` tells programs apart, also between processes.
    """

    call: jax.stages.Compiled
    digest: str


@functools.lru_cache(maxsize=32)
def compiled(plan: Plan, devices: tuple, structure: Any, leaves: tuple) -> Program:
    """The program for arguments of these shapes: kept, so that other values compile nothing.

    On one device it is called with NumPy arrays; on several, which share the runs evenly, with those of `placed`.
    """
    local = functools.partial(_settings, plan)
    if len(devices) == 1:
        jitted = jax.jit(local)
    else:
        jitted = spreading.spread(local, functools.partial(_joined, plan), devices, _specs(plan))
    lowered = jitted.lower(*structure.unflatten(leaves))
    digest = hashlib.sha256(lowered.as_text().encode()).hexdigest()[:16]
    return Program(spreading.finished(lowered, devices[0].platform), digest)


def placed(plan: Plan, devices: tuple, arguments: tuple, first: int = 0) -> tuple:
    """Arguments of a program, from number ``first`` on, as arrays that lie on its devices."""
    return spreading.placed(devices, _specs(plan)[first : first + len(arguments)], arguments)


def _specs(plan: Plan) -> tuple[PartitionSpec, ...]:
    """How each argument lies on the devices: what belongs to runs is split, the rest is everywhere."""
    runs = spreading.SPREAD
    weights = PartitionSpec(None, runs) if any(plan.swept) else PartitionSpec(runs)
    return (PartitionSpec(),) * 4 + (PartitionSpec(runs), weights)


def _joined(plan: Plan, parts: Chunk) -> Chunk:
    """The chunk from the parts of its devices, stacked along axis 0: sums over all, the first runs of the first."""
    lead = 1 if any(plan.swept) else 0

    def along(axis: int, count: int | None = None) -> Callable[[Array], Array]:
        def take(a: Array) -> Array:
            a = jnp.moveaxis(a, 0, axis)
            return a.reshape(*a.shape[:axis], -1, *a.shape[axis + 2 :])[(slice(None),) * axis + (slice(count),)]

        return take

    sample = along(lead + 2, plan.sample)
    return Chunk(
        jax.tree.map(lambda a: a.sum(0), parts.sums),
        jax.tree.map(along(lead), parts.each),
        sample(parts.error),
        sample(parts.nees),
        jax.tree.map(along(lead, plan.examples), parts.examples),
    )


def _settings(
    plan: Plan, theta: PyTree, truth_theta: PyTree, log: Log, key: Array, numbers: Array, weights: Array
) -> Chunk:
    """One chunk for each setting of a sweep, on the same noise; what settings share is simulated once."""
    one = functools.partial(_chunk, plan)
    if any(plan.swept):
        axes = tuple(0 if swept else None for swept in plan.swept)
        one = jax.vmap(one, in_axes=(*axes, None, None, None, 0))
    return one(theta, truth_theta, log, key, numbers, weights)


def _chunk(
    plan: Plan, theta: PyTree, truth_theta: PyTree, log: Log, key: Array, numbers: Array, weights: Array
) -> Chunk:
    """Simulate, filter and score the runs of these numbers; in the sums are those with weights (R, F) True."""
    robot, origin, start = plan.model(truth_theta), plan.origin(truth_theta), plan.belief(theta)
    bank = {name: make(theta) for name, make in plan.filters}
    own_model, dtype = next(iter(bank.values())).model, origin.cov.dtype
    space = own_model.space
    log, origin, start = jax.tree.map(jnp.asarray, (log, origin, start))
    origin, start = (jax.tree.map(lambda a: a.astype(dtype), belief) for belief in (origin, start))
    sensors = {name: own_model.sensors[name].space.dim for name in robot.sensors if name in log.z}
    place = columns(space.dim, len(plan.blocks), list(sensors))
    own = jax.vmap(lambda number: jax.random.fold_in(_key(plan, key), number))(numbers)
    draw, x, keys, rows, axes = _drawn(plan, robot, origin, truth_theta, log, own)

    def body(constants: tuple[Array, Array], carry: tuple, row: tuple) -> tuple:
        (weight, key), (x, held) = constants, carry
        # A fence: XLA would draw the noises anew for each of the many numbers that a reading goes into.
        x, read = jax.lax.optimization_barrier(draw(key, x, row[0]))
        truth = plan.view(x)
        held, found = judged(bank, place, plan.blocks, list(sensors), weight, held, read, truth, row[1])
        tracks = {name: filt.gaussian(held[0][name]) for name, filt in bank.items()}
        return (x, held), (found[:2], found[2:], Examples(truth, tracks))

    beliefs, shared = _begun(bank, start, own)
    told = nothing(place, len(bank), plan.lags, sensors, np.dtype(dtype))
    (_, (_, told)), (added, some, examples) = loop(
        body,
        (weights, keys),
        (x, (beliefs, told)),
        (rows, instants(log)),
        runs=len(numbers),
        axes=(0, (0, (shared, None)), (axes, None)),
        outputs=(Added(), Kept(every(len(log.dt))), Kept(runs=plan.examples)),
        backend=plan.backend,
    )
    return _summed(plan, place, space.dim, weights, told, Row(*added, *some), examples)


def _begun(bank: dict[str, Filter], start: Gaussian, own: Array) -> tuple[dict[str, PyTree], dict[str, int | None]]:
    """What each filter carries at the start, and its axis: runs share a Gaussian; anything else each draws for itself,
    with its ``own`` key.
    """
    beliefs, axes = {}, {}
    for i, (name, filt) in enumerate(bank.items()):
        # Not fold_in(key, 0 ... 2): the simulation and what happens to its readings draw from those.
        begun = jax.vmap(lambda key, filt=filt, i=i: filt.begin(start, jax.random.fold_in(key, 3 + i)))
        drawn = not isinstance(jax.eval_shape(begun, own), Gaussian)
        beliefs[name], axes[name] = (begun(own), 0) if drawn else (filt.begin(start), None)
    return beliefs, axes


def _key(plan: Plan, data: Array) -> Array:
    return jax.random.wrap_key_data(data, impl=plan.generator)


def _drawn(
    plan: Plan, robot: Model, origin: Gaussian, truth_theta: PyTree, log: Log, own: Array
) -> tuple[Callable[[Array, PyTree, tuple], tuple[PyTree, Log]], PyTree, Array, tuple, tuple]:
    """Where truth and readings come from, for runs with their ``own`` keys (R,): a function of (key, true state, row)
    that returns the next state and the row as it was read; the states before the first row and the keys of the runs;
    the rows, and their axes.

    They are drawn as they are needed, unless something happens to the readings: that may look at the whole run.
    """
    x, keys = jax.vmap(lambda key: started(robot.space, origin, key))(own)
    keys = jax.random.key_data(keys)
    rows = (log, jnp.arange(len(log.dt)))

    def draw(key: Array, x: PyTree, row: tuple[Log, Array]) -> tuple[PyTree, Log]:
        return simulated(robot, x, *row, _key(plan, key), plan.control)

    if plan.corrupt is None:
        return draw, x, keys, rows, (None, None)

    def body(key: Array, x: PyTree, row: tuple[Log, Array]) -> tuple:
        x, read = draw(key, x, row)
        return x, ((x, read.z, read.u if plan.control else ()),)

    _, ((truth, z, u),) = loop(
        body,
        keys,
        x,
        rows,
        runs=len(own),
        axes=(0, 0, (None, None)),
        outputs=(Kept(),),
        backend=plan.backend,
    )
    corrupt, shared = plan.corrupt(truth_theta), jax.tree.leaves(log)
    alike: list[Array | None] = []
    structures = []

    def spoil(truth: PyTree, z: PyTree, u: PyTree, key: Array) -> list[Array | None]:
        # Not fold_in(own, 1): that is the second key of split(own), with which the simulation draws its noises.
        read = log._replace(z=z, u=u if plan.control else log.u)
        leaves, structure = jax.tree.flatten(corrupt(truth, read, jax.random.fold_in(key, 2)))
        structures.append(structure)
        alike.extend(next((a for a in shared if a is leaf), None) for leaf in leaves)
        return [leaf if same is None else None for leaf, same in zip(leaves, alike, strict=True)]

    spoilt = jax.vmap(spoil)(truth, z, u, own)
    rows = structures[0].unflatten([b if a is None else a for a, b in zip(alike, spoilt, strict=True)])
    axes = structures[0].unflatten([0 if a is None else None for a in alike])
    return lambda key, x, row: (row[1], row[0]), x, keys, (rows, truth), (axes, 0)


def _summed(plan: Plan, place: Columns, dim: int, weights: Array, told: Told, row: Row, examples: Examples) -> Chunk:
    """The chunk, from what its runs end with (R, ...), sums over them at each row (T, ...), and some rows of each."""
    lost = (told.nees > plan.limit) | ~told.sound | (told.fault != NO_FAULT)
    number, first, second = (jnp.swapaxes(a, 0, 1) for a in row.sums)
    counted, squared = place.named(place.counted, number), place.named(place.squared, second)
    summed = place.named(place.summed, first)
    averages = place.named(place.averaged, jnp.moveaxis(told.total / told.count, 1, 0))
    by_filter = jnp.moveaxis(weights, 1, 0)
    sums = Sums(
        runs=by_filter.sum(1),
        rows={name: Moments(counted.get(name), a, squared.get(name)) for name, a in summed.items()},
        averages={name: moments(a, jnp.isfinite(a), 1) for name, a in averages.items()},
        outer=_outer(jnp.swapaxes(row.outer, 0, 1), dim),
        errors=jax.vmap(error_histogram, in_axes=(2, 1))(row.normalised, weights),
        run_nees=_spread(averages["nees"][..., 0] / dim, by_filter),
        dots={name: lags.dots.sum(0) for name, lags in told.lags.items()},
        pairs={name: lags.pairs.sum(0) for name, lags in told.lags.items()},
        paired=_paired(jnp.concatenate([averages["square"], averages["log_score"]], -1)),
    )
    each = Each(lost, told.fault, told.status, told.worst)
    error, nees = (jnp.moveaxis(a[: plan.sample], (0, 2), (2, 0)) for a in (row.error, row.nees))
    return Chunk(sums, each, error, nees, examples)


def _paired(averages: Array) -> Moments:
    """Over the runs that neither of two filters lost, the differences of their averages (F, R, k), by pair."""
    a, b = np.triu_indices(len(averages), 1)
    differences = averages[a] - averages[b]
    return moments(differences, jnp.isfinite(differences), 1)


def _spread(nees: Array, by_filter: Array) -> jax.Array:
    """By filter, counts (F, bins) of the runs' average NEES (F, R) over n."""
    return jax.vmap(histogram, in_axes=(0, 0, None))(nees, by_filter, NEES_EDGES)


def _outer(upper: Array, dim: int) -> jax.Array:
    """Symmetric matrices (..., n, n) from their upper triangles (..., n (n + 1) / 2), row after row."""
    index = np.zeros((dim, dim), int)
    index[np.triu_indices(dim)] = np.arange(upper.shape[-1])
    return upper[..., np.maximum(index, index.T)]
