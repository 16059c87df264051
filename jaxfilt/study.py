"""Studies: is a filter consistent, and how close does it come? Over thousands of simulated runs, or on one recording.

A study simulates, filters and scores many runs in one compiled program. It compiles a function of the parameters
theta, never a built model: other parameters compile nothing new.
"""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors, metrics
from jaxfilt import log as logs
from jaxfilt.metrics import CONFIDENCE, Blocks, Consistency, Whiteness
from jaxfilt.run import scan
from jaxfilt.simulate import simulate
from jaxfilt.types import Array, Filter, Gaussian, Info, Log, Model, PyTree, Replay, Space, Status, Truth

MEMORY = 32e6
"""Bytes that one chunk may take, about: what is simulated is kept until the filters have read it."""

Filters = Mapping[str, Callable[[PyTree], Filter]]


class Fault(NamedTuple):
    """The first update that went wrong: ``run``, ``step`` (row), ``sensor`` and `Status`."""

    run: int
    step: int
    sensor: str
    status: Status


class Scores(NamedTuple):
    """How one filter did over all runs of a study.

    ``rmse`` block -> (T,) over the runs at each step, ``rmse_total`` block -> over runs and steps, both of errors that
    are finite. ``nees`` Consistency with arrays (T,), ``nees_total`` with numbers; ``nis`` and ``nis_total`` the same
    by sensor. ``diverged`` (runs,) bool, see `jaxfilt.metrics.diverged`. ``fault`` the earliest, None if none.
    ``mean`` (examples, T, ...) and ``std`` (examples, T, n) of the first runs, to look at.
    """

    rmse: dict[str, np.ndarray]
    rmse_total: dict[str, float]
    nees: Consistency
    nees_total: Consistency
    nis: dict[str, Consistency]
    nis_total: dict[str, Consistency]
    diverged: np.ndarray
    fault: Fault | None
    mean: PyTree
    std: np.ndarray


class Study(NamedTuple):
    """What `study` returns: plain NumPy and numbers.

    ``scores`` by filter. ``truth`` (examples, T, ...) of the first runs. ``t`` (T,) s since the start. ``space`` and
    ``blocks`` as they were given. ``seed`` makes the key again, ``jax.random.key(seed)``, for JAX's default generator.
    ``compile_seconds`` is near 0 where the program was there already. ``confidence`` of all bounds.
    """

    scores: dict[str, Scores]
    truth: PyTree
    t: np.ndarray
    space: Space
    blocks: Blocks
    theta: PyTree
    truth_theta: PyTree
    runs: int
    steps: int
    seed: int
    dtype: str
    confidence: float
    chunk: int
    workers: int
    compile_seconds: float
    run_seconds: float


class _Sums(NamedTuple):
    """What is added up over the runs at one step."""

    squares: Array
    errors: Array
    nees: Array
    nees_count: Array
    nis: dict[str, Array]
    dof: dict[str, Array]
    readings: dict[str, Array]


class _PerRun(NamedTuple):
    """What is kept of each run; ``fault`` indexes (step, sensor) row by row, -1 if none, and ``status`` is its code."""

    nees_mean: Array
    nees_square: Array
    nees_last: Array
    sound: Array
    fault: Array
    status: Array


def study(
    model: Callable[[PyTree], Model],
    filters: Filters,
    belief: Callable[[PyTree], Gaussian],
    log: Log,
    key: Array,
    *,
    theta: PyTree,
    truth_theta: PyTree = None,
    runs: int = 1000,
    control: Callable[[PyTree, PyTree], PyTree] | None = None,
    blocks: Blocks | None = None,
    confidence: float = CONFIDENCE,
    chunk: int | None = None,
    workers: int | None = None,
    examples: int = 1,
    progress: Callable[[int, int], Any] | None = None,
) -> Study:
    """Monte Carlo study: simulate runs, run every filter on the same truth and readings, score them.

    Each run draws its start from ``belief(truth_theta)`` and its noises from ``model(truth_theta)``; the filters know
    ``theta``. Run number i has the key ``fold_in(key, i)``, whatever the chunk.

    The functions are compiled once for all parameters; give the same functions again (not a new lambda) and a second
    study compiles nothing.

    Args:
        model: theta -> model of what is simulated.
        filters: name -> (theta -> filter).
        belief: theta -> Gaussian, where the truth is drawn from and the filters start.
        log: the schedule, see `jaxfilt.schedule`.
        key: of `jax.random`.
        theta: parameters that the filters assume.
        truth_theta: parameters of the truth; default theta.
        runs: how many, >= 1.
        control: as in `jaxfilt.simulate`. Without it, all runs share their inputs.
        blocks: name -> (indices of the tangent vector, unit), for the RMSE; default each component by itself.
        confidence: probability of all two-sided bounds.
        chunk: runs in one call of the program; default by memory.
        workers: threads that call it; default 2 on a CPU with more than one core, otherwise 1.
        examples: how many of the first runs to keep whole.
        progress: called with (runs done, runs) when the program is compiled and after each chunk.

    Returns:
        `Study`. The same arguments give the same numbers, bit for bit, whatever the number of workers.

    Raises:
        ValueError, TypeError, KeyError: naming the argument, what was expected and what came.

    Example: a filter on its own model is consistent.
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> def walk(theta):
        ...     return jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1) * theta, R=jnp.eye(1))
        >>> def start(theta):
        ...     return jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> log = jf.schedule(walk(1.0), steps=50, dt=1.0)
        >>> filters = {"kf": lambda theta: jf.kf(walk(theta))}
        >>> scores = study(walk, filters, start, log, jax.random.key(0), theta=1.0, runs=100).scores["kf"]
        >>> scores.nees_total.expected, metrics.verdict(scores.nees_total)
        (1.0, 'inside')
    """
    space, dtype = _checked(model, filters, belief, log, theta, confidence)
    if runs < 1:
        raise ValueError(f"runs: expected at least 1, got {runs}")
    truth_theta = theta if truth_theta is None else truth_theta
    blocks = {f"x[{i}]": ((i,), "") for i in range(space.dim)} if blocks is None else _checked_blocks(blocks, space.dim)
    workers = _workers() if workers is None else workers
    chunk = min(_chunk(space, filters, log, runs, dtype, workers, control) if chunk is None else chunk, runs)
    for name, value, least in (("workers", workers, 1), ("chunk", chunk, 1), ("examples", examples, 0)):
        if value < least:
            raise ValueError(f"{name}: expected at least {least}, got {value}")

    parameters = _strong(theta, dtype), _strong(truth_theta, dtype)

    def arguments(first: int) -> tuple:
        return *parameters, log, key, np.arange(first, first + chunk, dtype=np.int32), np.int32(runs)

    began = time.perf_counter()
    leaves, structure = jax.tree.flatten(jax.eval_shape(lambda *a: a, *arguments(0)))
    examples = min(examples, chunk)
    program = _compiled(model, tuple(filters.items()), belief, control, examples, structure, tuple(leaves))
    compiled = time.perf_counter()
    if progress:
        progress(0, runs)
    parts = []
    with ThreadPoolExecutor(workers) as pool:
        for part in pool.map(lambda first: jax.device_get(program(*arguments(first))), range(0, runs, chunk)):
            parts.append(part)
            if progress:
                progress(min(len(parts) * chunk, runs), runs)
    done = time.perf_counter()

    truth, shown = parts[0][0]
    sensors = {name: list(parts[0][1][name].nis) for name in filters}
    scores = {}
    for name in filters:
        sums = jax.tree.map(lambda *a: np.sum(np.asarray(a, np.float64), axis=0), *[part[1][name] for part in parts])
        each = jax.tree.map(lambda *a: np.concatenate(a)[:runs], *[part[2][name] for part in parts])
        scores[name] = _scores(sums, each, sensors[name], shown[name], blocks, space.dim, confidence)
    return Study(
        scores,
        truth,
        np.cumsum(np.asarray(log.dt, np.float64)),
        space,
        blocks,
        theta,
        truth_theta,
        runs,
        len(log.dt),
        _seed(key),
        str(dtype),
        confidence,
        chunk,
        workers,
        compiled - began,
        done - compiled,
    )


def _checked(
    model: Callable[[PyTree], Model],
    filters: Filters,
    belief: Callable[[PyTree], Gaussian],
    log: Log,
    theta: PyTree,
    confidence: float,
) -> tuple[Space, np.dtype]:
    """The space and dtype of arguments that fit each other: looked at with their values, before anything compiles."""
    if not filters:
        raise ValueError("filters: expected at least one, got none")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence: expected a number between 0 and 1, got {confidence}")
    built, start = model(theta), belief(theta)
    doors.belief("belief(theta)", start, built.space)
    dtype = jax.dtypes.canonicalize_dtype(start.cov.dtype)
    logs.validate(built, log, dtype)
    if not log.z:
        raise ValueError("log.z: expected at least one sensor that reads, got none")
    return built.space, dtype


def _strong(theta: PyTree, dtype: np.dtype) -> PyTree:
    """Parameters as arrays: a Python float is of another type to a compiled program than the array that follows it."""
    floating = lambda a: jnp.issubdtype(jnp.result_type(a), np.floating)  # noqa: E731
    return jax.tree.map(lambda a: jnp.asarray(a, dtype) if floating(a) else a, theta)


def _checked_blocks(blocks: Blocks, dim: int) -> Blocks:
    for name, (index, _) in blocks.items():
        if not index or min(index) < 0 or max(index) >= dim:
            raise ValueError(f"blocks[{name!r}]: expected indices from 0 to {dim - 1}, got {index}")
    return blocks


def _workers() -> int:
    return 2 if jax.default_backend() == "cpu" and (os.cpu_count() or 1) > 1 else 1


def _chunk(
    space: Space, filters: Filters, log: Log, runs: int, dtype: np.dtype, workers: int, control: Callable | None
) -> int:
    """Runs in a chunk: as many as memory allows, and evenly shared between the workers."""
    size = sum(np.size(leaf) for leaf in jax.tree.leaves(space.origin))
    size += sum(np.size(leaf) // len(log.dt) for leaf in jax.tree.leaves((log.z, log.u if control else ())))
    size += len(filters) * (1 + len(log.z))
    most = max(1, int(MEMORY / (size * len(log.dt) * dtype.itemsize)))
    chunks = -(-runs // most)
    chunks = workers * -(-chunks // workers)
    return -(-runs // chunks)


def _seed(key: Array) -> int:
    words = jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key
    return sum(int(word) << 32 * i for i, word in enumerate(reversed(np.asarray(words).ravel())))


@functools.lru_cache(maxsize=32)
def _compiled(
    model: Callable,
    filters: tuple,
    belief: Callable,
    control: Callable | None,
    examples: int,
    structure: Any,
    leaves: tuple,
) -> Callable:
    """The program of a chunk, compiled for arguments of these shapes: kept, so that other values compile nothing."""
    program = jax.jit(functools.partial(_many, model, dict(filters), belief, control, examples))
    return program.lower(*structure.unflatten(leaves)).compile()


def _many(
    model: Callable,
    filters: Filters,
    belief: Callable,
    control: Callable | None,
    examples: int,
    theta: PyTree,
    truth_theta: PyTree,
    log: Log,
    key: Array,
    numbers: Array,
    runs: Array,
) -> tuple:
    """Simulate, filter and score the runs of these numbers; those from ``runs`` on only fill up and do not count.

    Returns ((truth, {filter: (mean, std)}) of the examples, {filter: sums over the runs}, {filter: what is kept of
    each}). Sums over runs are taken within the step: no more than the simulation is ever stored for all of them. What
    runs share (schedule, inputs, a linear model's covariances) JAX computes once.
    """
    robot, origin = model(truth_theta), belief(truth_theta)
    bank = {name: make(theta) for name, make in filters.items()}
    start = belief(theta)

    def shown(tree: PyTree) -> PyTree:
        return jax.tree.map(lambda a: jax.lax.all_gather(a, "runs")[:examples], tree)

    def one(number: Array) -> tuple:
        truth, readings = simulate(robot, origin, log, jax.random.fold_in(key, number), control)
        counts = number < runs

        def body(beliefs: dict[str, Any], row: tuple[Log, PyTree]) -> tuple:
            moved, infos = {}, {}
            for name, filt in bank.items():
                moved[name], infos[name] = filt.step(beliefs[name], row[0])
            error = jnp.stack([metrics.errors(robot.space, row[1], b.mean) for b in moved.values()])
            # One call for all filters: each factorization written out costs time to compile.
            nees = metrics.nees(error, jnp.stack([b.cov for b in moved.values()]))
            sums, kept, pictures = {}, {}, {}
            for i, (name, b) in enumerate(moved.items()):
                sums[name] = jax.lax.psum(_row_sums(error[i], nees[i], infos[name], counts), "runs")
                kept[name] = nees[i], _sound(error[i], b), jnp.stack([info.status for info in infos[name].values()])
                pictures[name] = shown((b.mean, jnp.sqrt(jnp.diagonal(b.cov))))
            return moved, (sums, kept, pictures)

        beliefs = dict.fromkeys(bank, jax.tree.map(lambda a: jnp.asarray(a, origin.cov.dtype), start))
        _, (sums, kept, pictures) = jax.lax.scan(body, beliefs, (readings, truth))
        pictures = jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), pictures)
        return (shown(truth), pictures), sums, {name: _kept(*rest) for name, rest in kept.items()}

    return jax.vmap(one, axis_name="runs", out_axes=(None, None, 0))(numbers)


def _row_sums(error: Array, nees: Array, info: dict[str, Info], counts: Array) -> _Sums:
    """One run's share in the sums of a step: 0 where it does not count or is not finite."""
    good = jnp.all(jnp.isfinite(error)) & counts
    normal = jnp.isfinite(nees) & counts
    used = {name: metrics.used(i) for name, i in info.items()}
    return _Sums(
        squares=jnp.where(good, error * error, 0.0),
        errors=good.astype(jnp.int32),
        nees=jnp.where(normal, nees, 0.0),
        nees_count=normal.astype(jnp.int32),
        nis={name: jnp.where(counts, nis, 0.0) for name, (nis, _) in used.items()},
        dof={name: jnp.where(counts, dof, 0) for name, (_, dof) in used.items()},
        readings={name: (counts & (dof > 0)).astype(jnp.int32) for name, (_, dof) in used.items()},
    )


def _sound(error: Array, belief: Gaussian) -> Array:
    return jnp.all(jnp.isfinite(error)) & jnp.all(jnp.isfinite(belief.cov))


def _kept(nees: Array, sound: Array, statuses: Array) -> _PerRun:
    normal = jnp.isfinite(nees)
    count, values = normal.sum().astype(nees.dtype), jnp.where(normal, nees, 0.0)
    codes = statuses.reshape(-1)
    bad = codes >= Status.BAD_BELIEF
    first = jnp.argmax(bad)
    return _PerRun(
        nees_mean=values.sum() / count,
        nees_square=(values * values).sum() / count,
        nees_last=nees[-1],
        sound=jnp.all(sound) & ~jnp.any(bad),
        fault=jnp.where(jnp.any(bad), first, -1),
        status=codes[first],
    )


def _scores(
    sums: _Sums, each: _PerRun, sensors: list[str], shown: tuple, blocks: Blocks, dim: int, confidence: float
) -> Scores:
    with np.errstate(invalid="ignore", divide="ignore"):
        square = sums.squares / sums.errors[:, None]
        square_total = sums.squares.sum(0) / sums.errors.sum()
    nis, nis_total = {}, {}
    for name in sensors:
        total, dof, readings = sums.nis[name], sums.dof[name], sums.readings[name]
        nis[name] = metrics.mean_of_squares(total, dof, readings, confidence)
        overall = metrics.mean_of_squares(total.sum(), dof.sum(), readings.sum(), confidence)
        nis_total[name] = Consistency(*map(float, overall))
    return Scores(
        rmse={name: np.sqrt(square[:, list(index)].sum(1)) for name, (index, _) in blocks.items()},
        rmse_total={name: float(np.sqrt(square_total[list(index)].sum())) for name, (index, _) in blocks.items()},
        nees=metrics.mean_of_squares(sums.nees, dim * sums.nees_count, sums.nees_count, confidence),
        nees_total=metrics.anees_total(each.nees_mean, each.nees_square, dim, confidence),
        nis=nis,
        nis_total=nis_total,
        diverged=metrics.diverged(each.nees_last, each.sound, dim),
        fault=_first_fault(each, sensors),
        mean=shown[0],
        std=shown[1],
    )


def _first_fault(each: _PerRun, sensors: list[str]) -> Fault | None:
    faulty = np.flatnonzero(each.fault >= 0)
    if not len(faulty):
        return None
    run = int(faulty[np.argmin(each.fault[faulty])])
    step, sensor = divmod(int(each.fault[run]), len(sensors))
    return Fault(run, step, sensors[sensor], Status(int(each.status[run])))


class Review(NamedTuple):
    """How one filter did on a recording.

    ``mean`` (T, ...) the part of the state that the truth knows, ``std`` (T, d) of its tangent, ``info`` sensor ->
    `Info`, leading axis T. With a truth, else None: ``error`` (T, d), NaN where it is unknown, ``nees`` (T,), ``rmse``
    by block and ``nees_mean``, whose bounds are NaN: the NEES of one run is correlated in time. ``nis``,
    ``whiteness`` and ``refused`` (readings that a gate refused) by sensor. ``diverged`` as in `Scores`.
    """

    mean: PyTree
    std: np.ndarray
    info: dict[str, Info]
    error: np.ndarray | None
    nees: np.ndarray | None
    rmse: dict[str, float] | None
    nees_mean: Consistency | None
    nis: dict[str, Consistency]
    whiteness: dict[str, Whiteness]
    refused: dict[str, int]
    diverged: bool
    fault: Fault | None


class Replayed(NamedTuple):
    """What `replayed` returns: ``reviews`` by filter; ``t`` (T,) s, absolute; the rest as in `Study` and `Replay`."""

    reviews: dict[str, Review]
    t: np.ndarray
    truth: Truth | None
    space: Space
    blocks: Blocks
    theta: PyTree
    dtype: str
    confidence: float
    compile_seconds: float
    run_seconds: float


def replayed(
    replay: Replay, filters: Filters, *, theta: PyTree = None, lags: int = 20, confidence: float = CONFIDENCE
) -> Replayed:
    """Run filters over a recording and score them: against the truth where it is known, by their innovations always.

    Args:
        replay: from `jaxfilt.recordings`, or your own; without a truth, ``space`` and ``view`` say what to look at.
        filters: name -> (theta -> filter).
        theta: parameters; default the replay's.
        lags: as in `jaxfilt.metrics.whiteness`.
        confidence: probability of all two-sided bounds.

    Raises:
        ValueError, TypeError, KeyError: naming the argument, what was expected and what came.

    Example:
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> walk = lambda theta: jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> start = lambda theta: jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> x, log = jf.simulate(walk(()), start(()), jf.schedule(walk(()), 200, 1.0), jax.random.key(0))
        >>> drive = jf.Recording(jax.tree.map(np.asarray, log), np.arange(200.0))
        >>> truth = jf.Truth(x, np.full(200, True))
        >>> r = jf.Replay(walk, start, (), drive, truth, jf.vector(1), lambda x: x, {"position": ((0,), "m")})
        >>> metrics.verdict(replayed(r, {"kf": lambda theta: jf.kf(walk(theta))}).reviews["kf"].nis["z"])
        'inside'
    """
    theta = replay.theta if theta is None else theta
    log, truth = replay.recording.log, replay.truth
    _, dtype = _checked(replay.model, filters, replay.belief, log, theta, confidence)
    blocks = _checked_blocks(replay.blocks, replay.space.dim)
    known = () if truth is None else jax.tree.map(lambda a: jnp.asarray(a, dtype), truth.x)
    arguments = _strong(theta, dtype), log, known
    began = time.perf_counter()
    program = jax.jit(functools.partial(_one, replay, dict(filters))).lower(*arguments).compile()
    compiled = time.perf_counter()
    out = jax.device_get(program(*arguments))
    done = time.perf_counter()
    reviews = {name: _review(out[name], truth, blocks, replay.space.dim, lags, confidence) for name in filters}
    return Replayed(
        reviews,
        np.asarray(replay.recording.t),
        truth,
        replay.space,
        blocks,
        theta,
        str(dtype),
        confidence,
        compiled - began,
        done - compiled,
    )


def _one(replay: Replay, filters: Filters, theta: PyTree, log: Log, known: PyTree) -> dict[str, Any]:
    """Each filter's track as the truth sees it: (mean, std, info, sound, error, nees), the last two None without it."""
    start, whole, part = replay.belief(theta), replay.model(theta).space, replay.space

    def store(b: Gaussian, info: dict[str, Info]) -> tuple:
        x = replay.view(b.mean)
        origin = jnp.zeros(whole.dim, b.cov.dtype)
        G = jax.jacfwd(lambda d: part.minus(replay.view(whole.plus(b.mean, d)), x))(origin)
        P = G @ b.cov @ G.T
        spread = jnp.diagonal(P) if replay.truth is None else P
        return x, spread, info, jnp.all(jnp.isfinite(b.cov)) & jnp.all(jnp.isfinite(spread))

    out = {}
    for name, make in filters.items():
        x, spread, info, sound = scan(make(theta), start, log, store)
        if replay.truth is None:
            out[name] = x, jnp.sqrt(spread), info, sound, None, None
        else:
            error = metrics.errors(part, known, x)
            std = jnp.sqrt(jnp.diagonal(spread, axis1=1, axis2=2))
            out[name] = x, std, info, sound, error, metrics.nees(error, spread)
    return out


def _review(seen: tuple, truth: Truth | None, blocks: Blocks, dim: int, lags: int, confidence: float) -> Review:
    state, std, info, sound, error, nees = seen
    statuses = np.stack([i.status for i in info.values()], 1)
    bad = np.argwhere(statuses >= Status.BAD_BELIEF)
    fault = None
    if len(bad):
        step, sensor = bad[0]
        fault = Fault(0, int(step), list(info)[sensor], Status(int(statuses[step, sensor])))
    scores, last = None, 0.0
    if truth is not None:
        error = np.where(truth.mask[:, None], error, np.nan)
        nees = np.where(truth.mask, nees, np.nan)
        normal = nees[np.isfinite(nees)]
        mean, last = (float(normal.mean()), normal[-1]) if len(normal) else (np.nan, np.nan)
        scores = Consistency(mean, float(dim), np.nan, np.nan)
    return Review(
        state,
        std,
        info,
        error,
        nees,
        None if error is None else metrics.rmse(error, blocks, np.isfinite(error).all(1)),
        scores,
        {name: metrics.anis(i, confidence) for name, i in info.items()},
        {name: metrics.whiteness(i, lags, confidence) for name, i in info.items()},
        {name: int((i.status == Status.GATED).sum()) for name, i in info.items()},
        bool(metrics.diverged(last, sound.all() and fault is None, dim)),
        fault,
    )
