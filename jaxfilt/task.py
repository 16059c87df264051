"""What a study is asked for, checked at the door and turned into a task for the machine."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import checkpoint, doors, metrics
from jaxfilt import log as logs
from jaxfilt.chunk import Plan
from jaxfilt.consistency import CONFIDENCE
from jaxfilt.fold import itself
from jaxfilt.loop import Backend
from jaxfilt.metrics import Blocks
from jaxfilt.mismatch import Corruption
from jaxfilt.scores import STATE
from jaxfilt.tally import every
from jaxfilt.types import Array, Filter, Gaussian, Log, Model, PyTree, Space

MEMORY = 64e6
"""Bytes that a chunk may take, about: what is kept of each run until all of them are done."""

MOST = 2000
"""Runs of a chunk on one device: from some hundreds on, more at a time are not faster (measured)."""

Filters = Mapping[str, Callable[[PyTree], Filter]]
"""name -> (theta -> filter)"""


class Options(NamedTuple):
    """The options of `study`, which says what they mean."""

    runs: int = 1000
    control: Callable[[PyTree, PyTree], PyTree] | None = None
    corrupt: Callable[[PyTree], Corruption] | None = None
    truth_belief: Callable[[PyTree], Gaussian] | None = None
    view: Callable[[PyTree], PyTree] = itself
    blocks: Blocks | None = None
    confidence: float = CONFIDENCE
    chunk: int | None = None
    workers: int | None = None
    devices: Sequence[Any] | None = None
    examples: int = 1
    sample: int = 100
    lags: int = 10
    out: str | Path | None = None
    resume: bool = False
    progress: Callable[[int, int], Any] | None = None
    backend: Backend = "auto"


class Task(NamedTuple):
    """What is to be run: ``theta``, ``truth_theta``, ``log`` and ``key`` (its data) are the arguments of a program.

    ``settings`` of a sweep, 1 without; ``about`` says in a checkpoint what the study is.
    """

    plan: Plan
    theta: PyTree
    truth_theta: PyTree
    log: Log
    key: np.ndarray
    runs: int
    sample: int
    settings: int
    chunk: int
    workers: int
    devices: tuple
    about: dict[str, Any]
    space: Space
    blocks: Blocks
    sensors: list[str]
    steps: int
    dtype: np.dtype
    confidence: float


def task_of(
    model: Callable[[PyTree], Model],
    filters: Filters,
    belief: Callable[[PyTree], Gaussian],
    log: Log,
    key: Array,
    settings: Sequence[tuple[PyTree, PyTree]],
    swept: tuple[bool, bool],
    o: Options,
) -> Task:
    """The task of `jaxfilt.study.study`, whose arguments these are, for each setting (theta, truth theta).

    Raises:
        ValueError, TypeError, KeyError: naming the argument, what was expected and what came.
    """
    theta, truth_theta = settings[0]
    space, dtype = checked(filters, belief, log, theta, o.confidence)
    robot, origin = model(truth_theta), belief if o.truth_belief is None else o.truth_belief
    logs.validate(robot, log, dtype)
    doors.belief("truth_belief(truth_theta)", origin(truth_theta), robot.space)
    doors.point("view(true state)", jax.eval_shape(o.view, origin(truth_theta).mean), space)
    if o.blocks is None:
        blocks: Blocks = {f"x[{i}]": ((i,), "") for i in range(space.dim)}
    else:
        blocks = checked_blocks(o.blocks, space.dim)
    devices = tuple(jax.devices() if o.devices is None else o.devices)
    workers = _workers(devices) if o.workers is None else o.workers
    carried = _carried(filters, belief, theta)
    chunk = o.chunk
    if chunk is None:
        chunk = _chunk(space, filters, log, o, dtype, workers, len(devices), len(settings), carried)
    given = o._asdict() | {"workers": workers, "chunk": chunk}
    for name, least in {"runs": 1, "workers": 1, "chunk": 1, "examples": 0, "sample": 0, "lags": 1}.items():
        if given[name] < least:
            raise ValueError(f"{name}: expected at least {least}, got {given[name]}")
    chunk = len(devices) * -(-min(chunk, o.runs) // len(devices))
    plan = Plan(
        model=model,
        filters=tuple(filters.items()),
        belief=belief,
        origin=origin,
        view=o.view,
        control=o.control,
        corrupt=o.corrupt,
        blocks=tuple(tuple(index) for index, _ in blocks.values()),
        limit=metrics.divergence_threshold(space.dim),
        examples=min(o.examples, chunk),
        sample=min(o.sample, chunk),
        lags=max(1, min(o.lags, len(log.dt) - 1)),
        swept=swept,
        generator=str(jax.random.key_impl(key)),
        backend=o.backend if len(devices) == 1 else "xla",
    )
    arguments = []
    for i in range(2):
        strongly = [strong(setting[i], dtype) for setting in settings]
        arguments.append(jax.tree.map(lambda *a: jnp.stack(a), *strongly) if swept[i] else strongly[0])
    about = {
        "seed": seed(key),
        "filters": list(filters),
        "steps": len(log.dt),
        "dtype": str(dtype),
        "theta": checkpoint.named([own for own, _ in settings] if swept[0] else theta),
        "truth_theta": checkpoint.named([true for _, true in settings] if swept[1] else truth_theta),
        "log": checkpoint.fingerprint(log),
    }
    return Task(
        plan=plan,
        theta=arguments[0],
        truth_theta=arguments[1],
        log=log,
        key=np.asarray(jax.random.key_data(key)),
        runs=o.runs,
        sample=min(o.sample, o.runs),
        settings=len(settings),
        chunk=chunk,
        workers=workers,
        devices=devices,
        about=about,
        space=space,
        blocks=blocks,
        sensors=[name for name in robot.sensors if name in log.z],
        steps=len(log.dt),
        dtype=dtype,
        confidence=o.confidence,
    )


def checked(
    filters: Filters, belief: Callable[[PyTree], Gaussian], log: Log, theta: PyTree, confidence: float
) -> tuple[Space, np.dtype]:
    """The filters' space and dtype, of arguments that fit each other: looked at with their values, before anything
    compiles.
    """
    if not filters:
        raise ValueError("filters: expected at least one, got none")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence: expected a number between 0 and 1, got {confidence}")
    start, models = belief(theta), {name: make(theta).model for name, make in filters.items()}
    (first, own), *others = models.items()
    doors.belief("belief(theta)", start, own.space)
    dtype = jax.dtypes.canonicalize_dtype(start.cov.dtype)
    for name, other in others:
        if other.space.dim != own.space.dim:
            raise ValueError(
                f"filters: expected all on one state space, got {own.space.dim} dimensions for {first!r} "
                f"and {other.space.dim} for {name!r}"
            )
    for each in models.values():
        logs.validate(each, log, dtype)
    if not log.z:
        raise ValueError("log.z: expected at least one sensor that reads, got none")
    return own.space, dtype


def strong(theta: PyTree, dtype: np.dtype) -> PyTree:
    """Parameters as arrays: a Python float is of another type to a compiled program than the array that follows it."""
    floating = lambda a: jnp.issubdtype(jnp.result_type(a), np.floating)  # noqa: E731
    return jax.tree.map(lambda a: jnp.asarray(a, dtype) if floating(a) else a, theta)


def checked_blocks(blocks: Blocks, dim: int) -> Blocks:
    """Blocks whose indices are some of the tangent space's."""
    for name, (index, _) in blocks.items():
        if not index or min(index) < 0 or max(index) >= dim:
            raise ValueError(f"blocks[{name!r}]: expected indices from 0 to {dim - 1}, got {index}")
        if name == STATE:
            raise ValueError(f"blocks: {STATE!r} is the name of the whole state, which is always scored")
    return blocks


def seed(key: Array) -> int:
    """The number that made a key, ``jax.random.key(seed)``, with JAX's default generator."""
    words = jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key
    return sum(int(word) << 32 * i for i, word in enumerate(reversed(np.asarray(words).ravel())))


def _workers(devices: tuple) -> int:
    return 2 if len(devices) == 1 and devices[0].platform == "cpu" and (os.cpu_count() or 1) > 1 else 1


def _carried(filters: Filters, belief: Callable[[PyTree], Gaussian], theta: PyTree) -> int:
    """Bytes that the filters of one run carry from row to row."""

    def begun() -> list[PyTree]:
        return [make(theta).begin(belief(theta), jax.random.key(0)) for make in filters.values()]

    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(jax.eval_shape(begun)))


def _chunk(
    space: Space,
    filters: Filters,
    log: Log,
    o: Options,
    dtype: np.dtype,
    workers: int,
    devices: int,
    settings: int,
    carried: int,
) -> int:
    """Runs in a chunk: as many as memory allows, and evenly shared between the workers; that of a resumed study."""
    if o.resume and o.out is not None:
        old = checkpoint.read_manifest(Path(o.out))
        if old is not None:
            return old["chunk"]
    steps = len(log.dt)
    numbers = lambda tree: sum(np.size(leaf) // steps for leaf in jax.tree.leaves(tree))  # noqa: E731
    # Of each row, where something happens to the readings, all that was simulated, before and after.
    simulated = sum(np.size(leaf) for leaf in jax.tree.leaves(space.origin)) + numbers(log.u if o.control else ())
    row = dtype.itemsize * (0 if o.corrupt is None else simulated + 2 * numbers(log.z))
    # Of some rows, by filter: error, normalised error, NEES.
    some = dtype.itemsize * settings * len(filters) * (2 * space.dim + 1)
    size = row * steps + some * (steps // every(steps)) + carried * settings
    most = devices * max(1, min(MOST, int(MEMORY / size)))
    chunks = -(-o.runs // most)
    chunks = workers * -(-chunks // workers)
    return -(-o.runs // chunks)
