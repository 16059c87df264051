"""A recording, replayed through filters and scored: by the truth where it is known, by its innovations always."""

from __future__ import annotations

import functools
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import metrics
from jaxfilt.bootstrap import anees_of_one_run
from jaxfilt.consistency import CONFIDENCE, Consistency
from jaxfilt.metrics import Blocks, Whiteness
from jaxfilt.run import scan
from jaxfilt.scores import Fault
from jaxfilt.task import Filters, checked, checked_blocks, strong
from jaxfilt.transforms import taylor
from jaxfilt.types import Array, Filter, Info, Log, PyTree, Replay, Space, Status, Truth
from jaxfilt.verdict import Verdict, innovation_verdict


class Review(NamedTuple):
    """How one filter did on a recording: the ``verdict`` in words, and what it stands on.

    ``mean`` (T, ...) the part of the state that the truth knows, ``std`` (T, d) of its tangent, ``info`` sensor ->
    `Info`, leading axis T. With a truth, else None: ``error`` (T, d), NaN where it is unknown, ``nees`` (T,), ``rmse``
    by block and ``nees_mean``, with bounds of a block bootstrap: the NEES of one run is correlated in time. ``nis``,
    ``whiteness`` and ``refused`` (readings that a gate refused) by sensor. ``diverged`` as `jaxfilt.metrics.diverged`
    defines it.
    """

    verdict: Verdict
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
    replay: Replay,
    filters: Filters,
    *,
    theta: PyTree = None,
    lags: int = 20,
    confidence: float = CONFIDENCE,
    key: Array | None = None,
) -> Replayed:
    """Run filters over a recording and score them: against the truth where it is known, by their innovations always.

    Args:
        replay: from `jaxfilt.recordings`, or your own; without a truth, ``space`` and ``view`` say what to look at.
        filters: name -> (theta -> filter).
        theta: parameters; default the replay's.
        lags: as in `jaxfilt.metrics.whiteness`.
        confidence: probability of all two-sided bounds.
        key: of `jax.random`, for filters that draw: particles.

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
        >>> jf.consistency.verdict(replayed(r, {"kf": lambda theta: jf.kf(walk(theta))}).reviews["kf"].nis["z"])
        'inside'
    """
    theta = replay.theta if theta is None else theta
    log, truth = replay.recording.log, replay.truth
    _, dtype = checked(filters, replay.belief, log, theta, confidence)
    blocks = checked_blocks(replay.blocks, replay.space.dim)
    known = () if truth is None else jax.tree.map(lambda a: jnp.asarray(a, dtype), truth.x)
    arguments = strong(theta, dtype), log, known
    began = time.perf_counter()
    program = jax.jit(functools.partial(_one, replay, dict(filters), key)).lower(*arguments).compile()
    compiled = time.perf_counter()
    out = jax.device_get(program(*arguments))
    done = time.perf_counter()
    reviews = {name: _review(name, out[name], truth, blocks, replay.space.dim, lags, confidence) for name in filters}
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


def _one(replay: Replay, filters: Filters, key: Array | None, theta: PyTree, log: Log, known: PyTree) -> dict[str, Any]:
    """Each filter's track as the truth sees it: (mean, std, info, sound, error, nees), the last two None without it."""
    start, whole, part = replay.belief(theta), replay.model(theta).space, replay.space

    def store(filter: Filter, carried: PyTree, info: dict[str, Info]) -> tuple:
        b = filter.gaussian(carried)
        x, P = taylor(replay.view, b, whole, part)[:2]
        spread = jnp.diagonal(P) if replay.truth is None else P
        return x, spread, info, jnp.all(jnp.isfinite(b.cov)) & jnp.all(jnp.isfinite(spread))

    out = {}
    for name, make in filters.items():
        filter = make(theta)
        begun = filter.begin(start, key)
        x, spread, info, sound = scan(filter, begun, log, functools.partial(store, filter))
        if replay.truth is None:
            out[name] = x, jnp.sqrt(spread), info, sound, None, None
        else:
            error = metrics.errors(part, known, x)
            std = jnp.sqrt(jnp.diagonal(spread, axis1=1, axis2=2))
            out[name] = x, std, info, sound, error, metrics.nees(error, spread)
    return out


def _review(
    name: str, seen: tuple, truth: Truth | None, blocks: Blocks, dim: int, lags: int, confidence: float
) -> Review:
    state, std, info, sound, error, nees = seen
    statuses = np.stack([i.status for i in info.values()], 1)
    bad = np.argwhere(statuses >= Status.BAD_BELIEF)
    fault = None
    if len(bad):
        step, sensor = bad[0]
        fault = Fault(0, int(step), list(info)[sensor], Status(int(statuses[step, sensor])), 1)
    scores, last = None, 0.0
    if truth is not None:
        error = np.where(truth.mask[:, None], error, np.nan)
        nees = np.where(truth.mask, nees, np.nan)
        normal = nees[np.isfinite(nees)]
        last = normal[-1] if len(normal) else np.nan
        scores = anees_of_one_run(nees, dim, confidence)
    nis = {sensor: metrics.anis(i, confidence) for sensor, i in info.items()}
    white = {sensor: metrics.whiteness(i, lags, confidence) for sensor, i in info.items()}
    refused = {sensor: int((i.status == Status.GATED).sum()) for sensor, i in info.items()}
    return Review(
        verdict=innovation_verdict(nis, white, scores, confidence, name=name, refused=refused),
        mean=state,
        std=std,
        info=info,
        error=error,
        nees=nees,
        rmse=None if error is None else metrics.rmse(error, blocks, np.isfinite(error).all(1)),
        nees_mean=scores,
        nis=nis,
        whiteness=white,
        refused=refused,
        diverged=bool(metrics.diverged(last, sound.all() and fault is None, dim)),
        fault=fault,
    )
