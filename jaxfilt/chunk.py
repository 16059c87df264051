"""The program of a chunk of runs: simulate, filter, score and sum, compiled once for all parameters."""

from __future__ import annotations

import contextlib
import functools
import hashlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxfilt import metrics
from jaxfilt.mismatch import Corruption
from jaxfilt.simulate import simulate
from jaxfilt.tally import (
    NEES_EDGES,
    Blocks,
    Moments,
    Sums,
    columns,
    error_histogram,
    every,
    histogram,
    lagged,
    moments,
    score,
)
from jaxfilt.types import Array, Filter, Gaussian, Log, Model, PyTree, Status


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


NO_FAULT = np.int32(2**31 - 1)
"""A fault that is none, later than all others."""

# What runs under vmap are thousands of small products; Eigen's thread pool costs more than it brings.
CPU_OPTIONS: dict[str, Any] = {"xla_cpu_multi_thread_eigen": False}


@functools.lru_cache(maxsize=32)
def compiled(plan: Plan, devices: tuple, structure: Any, leaves: tuple) -> Program:
    """The program for arguments of these shapes: kept, so that other values compile nothing.

    On one device it is called with NumPy arrays; on several, which share the runs evenly, with those of `placed`.
    """
    local = functools.partial(_settings, plan)
    if len(devices) == 1:
        jitted = jax.jit(local)
    else:
        mesh, specs = _mesh(devices), _specs(plan)
        lead = functools.partial(jax.tree.map, lambda a: a[None])
        parts = shard_map(lambda *a: lead(local(*a)), mesh, specs, PartitionSpec("runs"))
        inward = tuple(NamedSharding(mesh, spec) for spec in specs)
        everywhere = NamedSharding(mesh, PartitionSpec())
        jitted = jax.jit(lambda *a: _joined(plan, parts(*a)), in_shardings=inward, out_shardings=everywhere)
    lowered = jitted.lower(*structure.unflatten(leaves))
    digest = hashlib.sha256(lowered.as_text().encode()).hexdigest()[:16]
    return Program(finished(lowered, devices[0].platform), digest)


def finished(lowered: jax.stages.Lowered, platform: str) -> jax.stages.Compiled:
    """A lowered program, compiled; on a CPU without Eigen's threads."""
    if platform == "cpu":
        with contextlib.suppress(jax.errors.JaxRuntimeError):  # an XLA that does not know the option
            return lowered.compile(compiler_options=CPU_OPTIONS)
    return lowered.compile()


def placed(plan: Plan, devices: tuple, arguments: tuple, first: int = 0) -> tuple:
    """Arguments of a program, from number ``first`` on, as arrays that lie on its devices, also of other processes.

    One device takes them as they are.
    """
    if len(devices) == 1:
        return arguments
    mesh = _mesh(devices)

    def place(spec: PartitionSpec) -> Callable[[Array], jax.Array]:
        sharding = NamedSharding(mesh, spec)
        return lambda a: jax.make_array_from_callback(np.shape(a), sharding, lambda at: np.asarray(a)[at])

    return tuple(jax.tree.map(place(spec), a) for spec, a in zip(_specs(plan)[first:], arguments, strict=False))


def _mesh(devices: tuple) -> Mesh:
    return Mesh(np.array(devices), ("runs",))


def _specs(plan: Plan) -> tuple[PartitionSpec, ...]:
    """How each argument lies on the devices: what belongs to runs is split, the rest is everywhere."""
    weights = PartitionSpec(None, "runs") if any(plan.swept) else PartitionSpec("runs")
    return (PartitionSpec(),) * 4 + (PartitionSpec("runs"), weights)


def shard_map(f: Callable, mesh: Mesh, in_specs: Any, out_specs: Any) -> Callable:
    """`jax.shard_map`, by the name and the options that it has in this JAX."""
    if hasattr(jax, "shard_map"):
        return jax.shard_map(f, mesh=mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)
    from jax.experimental.shard_map import shard_map as early

    return early(f, mesh, in_specs=in_specs, out_specs=out_specs, check_rep=False)


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


class _Carried(NamedTuple):
    """What one run carries from row to row, beside the beliefs."""

    row: Array
    total: Array
    count: Array
    sound: Array
    fault: Array
    status: Array
    worst: Array


def _chunk(
    plan: Plan, theta: PyTree, truth_theta: PyTree, log: Log, key: Array, numbers: Array, weights: Array
) -> Chunk:
    """Simulate, filter and score the runs of these numbers; in the sums are those with weights (R, F) True.

    Sums over runs are taken within each row, while its numbers are at hand. What runs share (schedule, inputs, a linear
    model's covariances) JAX computes once.
    """
    robot, origin, start = plan.model(truth_theta), plan.origin(truth_theta), plan.belief(theta)
    bank = {name: make(theta) for name, make in plan.filters}
    space, dtype = next(iter(bank.values())).model.space, origin.cov.dtype
    corrupt = None if plan.corrupt is None else plan.corrupt(truth_theta)
    sensors = [name for name in robot.sensors if name in log.z]
    place = columns(space.dim, len(plan.blocks), sorted(sensors))  # as JAX sorts a dict's keys

    def shown(tree: PyTree) -> PyTree:
        return jax.tree.map(lambda a: jax.lax.all_gather(a, "runs")[: plan.examples], tree)

    def one(number: Array, weight: Array) -> tuple:
        own = jax.random.fold_in(jax.random.wrap_key_data(key, impl=plan.generator), number)
        truth, readings = simulate(robot, origin, log, own, plan.control)
        if corrupt is not None:
            # Not fold_in(own, 1): that is the second key of split(own), with which the simulation draws its noises.
            readings = corrupt(truth, readings, jax.random.fold_in(own, 2))
        truth = jax.vmap(plan.view)(truth)

        def body(carry: tuple, row: tuple[Log, PyTree]) -> tuple:
            beliefs, told = carry
            stepped = {name: filt.step(beliefs[name], row[0]) for name, filt in bank.items()}
            beliefs = {name: b for name, (b, _) in stepped.items()}
            error = jnp.stack([metrics.errors(space, row[1], b.mean) for b in beliefs.values()])
            cov = jnp.stack([b.cov for b in beliefs.values()])
            infos = [{name: info[name] for name in sensors} for _, info in stepped.values()]
            info = jax.tree.map(lambda *a: jnp.stack(a), *infos)
            # One call for all filters: each factorization written out costs time to compile.
            values, white = jax.vmap(functools.partial(score, plan.blocks))(error, cov, info)
            there = jnp.isfinite(values) & weight[:, None]
            sums = jax.lax.psum(moments(values[None], there[None], 0), "runs")
            codes = jnp.stack([info[name].status for name in sensors], 1)
            sound = jnp.isfinite(error).all(1) & jnp.isfinite(cov).all((1, 2))
            told = _told(told, values, there, sound, codes, values[:, place["square"]])
            keep = {name: values[:, place[name]] for name in ("error", "normalised", "nees")}
            return (beliefs, told), (sums, keep, white, shown(beliefs))

        F, K = len(bank), max(at.stop for at in place.values())
        number_of = lambda *shape: jnp.zeros((F, *shape), dtype)  # noqa: E731
        none = jnp.full(F, NO_FAULT)
        told = _Carried(
            jnp.int32(0), number_of(K), number_of(K), jnp.full(F, True), none, none, number_of(len(plan.blocks))
        )
        beliefs = dict.fromkeys(bank, jax.tree.map(lambda a: jnp.asarray(a, dtype), start))
        (_, told), (sums, keep, white, tracks) = jax.lax.scan(body, (beliefs, told), (readings, truth))
        swap = functools.partial(jax.tree.map, lambda a: jnp.swapaxes(a, 0, 1))
        return sums, Examples(shown(truth), swap(tracks)), told, (keep, white)

    # Time before runs: a scan stores its rows that way, and turning them round would copy all of them.
    out_axes = (None, None, 0, 1)
    rows, examples, told, (keep, white) = jax.vmap(one, axis_name="runs", out_axes=out_axes)(numbers, weights)
    lost = (keep["nees"][-1, :, :, 0] > plan.limit) | ~told.sound | (told.fault != NO_FAULT)
    each = Each(lost, told.fault, told.status, told.worst)
    error, nees = (jnp.moveaxis(keep[name], 2, 0) for name in ("error", "nees"))
    averages = jnp.moveaxis(told.total / told.count, 1, 0)
    by_filter = jnp.moveaxis(weights, 1, 0)
    lag = {name: _lagged(jnp.where(weights[..., None], w, 0.0), log, name, plan.lags) for name, w in white.items()}
    sums = Sums(
        runs=by_filter.sum(1),
        rows=jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), rows),
        averages=moments(averages, jnp.isfinite(averages), 1),
        outer=_outer(jnp.where(by_filter[:, None, :, None], error, 0.0)),
        errors=jax.vmap(error_histogram, in_axes=(2, 1))(keep["normalised"], weights),
        run_nees=_spread(averages[..., place["nees"].start] / space.dim, by_filter),
        dots={name: dots for name, (dots, _) in lag.items()},
        pairs={name: pairs for name, (_, pairs) in lag.items()},
        paired=_paired(jnp.concatenate([averages[..., place["square"]], averages[..., place["log_score"]]], -1)),
    )
    some = slice(every(len(log.dt)) - 1, None, every(len(log.dt)))
    return Chunk(sums, each, error[:, some, : plan.sample], nees[:, some, : plan.sample, 0], examples)


def _paired(averages: Array) -> Moments:
    """Over the runs that neither of two filters lost, the differences of their averages (F, R, k), by pair."""
    a, b = np.triu_indices(len(averages), 1)
    differences = averages[a] - averages[b]
    return moments(differences, jnp.isfinite(differences), 1)


def _spread(nees: Array, by_filter: Array) -> jax.Array:
    """By filter, counts (F, bins) of the runs' average NEES (F, R) over n."""
    return jax.vmap(histogram, in_axes=(0, 0, None))(nees, by_filter, NEES_EDGES)


def _told(told: _Carried, values: Array, there: Array, sound: Array, codes: Array, square: Array) -> _Carried:
    """What the run is known to be after one more row: ``values`` (F, K), ``codes`` (F, sensors) of `Status`."""
    faulty = codes >= Status.BAD_BELIEF
    new = faulty.any(1) & (told.fault == NO_FAULT)
    sensor = faulty.argmax(1).astype(jnp.int32)
    return _Carried(
        row=told.row + 1,
        total=told.total + jnp.where(there, values, 0.0),
        count=told.count + there.astype(told.count.dtype),
        sound=told.sound & sound,
        fault=jnp.where(new, told.row * codes.shape[1] + sensor, told.fault),
        status=jnp.where(new, jnp.take_along_axis(codes, sensor[:, None], 1)[:, 0], told.status),
        worst=jnp.fmax(told.worst, square),
    )


def _outer(error: Array) -> jax.Array:
    """Sums over runs (F, T, n, n) of ``e e'`` for errors (F, T, R, n); of what is not finite, nothing."""
    error = jnp.where(jnp.isfinite(error).all(-1, keepdims=True), error, 0.0)
    return jnp.einsum("ftri,ftrj->ftij", error, error)


def _lagged(white: Array, log: Log, name: str, lags: int) -> tuple[jax.Array, jax.Array]:
    """By filter (F, L), of (T, R, F, m): see `lagged`, over all runs; lags count the readings of the schedule."""
    order = jnp.arange(len(log.dt))
    valid = log.valid.get(name)
    if valid is not None:
        order = jnp.argsort(~jnp.asarray(valid).reshape(len(order), -1).any(1), stable=True)
    return jax.vmap(lagged, in_axes=(2, None, None))(white, order, lags)
