"""What the command line tunes on: runs that it simulates, or recordings; and where the tuning begins."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import objectives
from jaxfilt.fold import Objective
from jaxfilt.simulate import simulate
from jaxfilt.tuning import identify
from jaxfilt.tuning.parameters import covers, parameters
from jaxfilt.tuning.split import Split
from jaxfilt.types import Filter, Gaussian, Log, Model, PyTree, Replay, Scenario, Space, Truth

OBJECTIVES: dict[str, Objective] = {
    "log-score": objectives.log_score,
    "likelihood": objectives.likelihood,
    "mse": objectives.mse(),
    "nees": objectives.nees_match,
    "nis": objectives.nis_match,
}
"""By the names that the command line has for them."""

LOOKS, SPREAD = 8, 0.3
"""States at which is looked up what a parameter acts on, and their standard deviation about the first belief's mean:
at a state full of zeros much is silent."""

SILENT, BEGINNING = "changes nothing in these data", "a few beginnings do not determine it"
"""Why a parameter is left alone."""


class Job(NamedTuple):
    """What is tuned, and on what: the arguments of `jaxfilt.tune`, with a ``model`` in place of the filter.
    ``truth_theta`` None: it was not simulated. ``acts_on``: parameter -> what it acts on, see
    `jaxfilt.tuning.identify.effects`."""

    model: Callable[[PyTree], Model]
    belief: Callable[[PyTree], Gaussian] | Sequence[Callable[[PyTree], Gaussian]]
    theta: PyTree
    logs: Log | Sequence[Log]
    truth: Truth | Sequence[Truth] | None
    space: Space
    view: Callable[[PyTree], PyTree]
    blocks: dict[str, tuple[tuple[int, ...], str]]
    split: Split
    truth_theta: PyTree
    acts_on: dict[str, frozenset[str]]


def of_scenario(scenario: Scenario, runs: int, rows: int, wrong: float, seed: int) -> Job:
    """Simulated runs: ``runs`` to learn from, a quarter as many to stop by, and as many to report on, all with the
    scenario's own theta. The start: each parameter of the noise, taken for the logarithm of a standard deviation, is
    off by the factor ``wrong``, in turn above and below."""
    space = scenario.model(scenario.theta).space
    held, every = max(2, -(-runs // 4)), 2 * runs + max(2, -(-runs // 4))
    log = scenario.schedule(rows)
    keys = jax.random.split(jax.random.key(seed), every)
    robot, begin = scenario.model(scenario.theta), scenario.belief(scenario.theta)
    truth, logs = jax.jit(jax.vmap(lambda key: simulate(robot, begin, log, key, scenario.control)))(keys)
    job = Job(
        scenario.model,
        scenario.belief,
        scenario.theta,
        jax.tree.map(np.asarray, logs),
        Truth(jax.tree.map(np.asarray, truth), np.full((every, rows), True)),
        space,
        lambda x: x,
        scenario.blocks,
        Split(range(runs), range(runs, runs + held), range(runs + held, every)),
        scenario.theta,
        _acts_on(scenario.model, scenario.belief, scenario.theta, jax.tree.map(lambda a: np.asarray(a[0]), logs)),
    )
    free = parameters(scenario.theta)
    noise = np.array([_is_noise(on) for on in job.acts_on.values()])
    signs = np.where(noise, np.where(np.cumsum(noise) % 2 == 1, 1.0, -1.0), 0.0)
    start = np.round(free.start + signs * math.log(wrong), 12)  # log(0.1) + log(10) is 0, and not 4e-16
    return job._replace(theta=free.tree(jnp.asarray(start, jnp.result_type(float))))


def _is_noise(acts_on: frozenset[str]) -> bool:
    return bool(acts_on) and not any(what in ("f", "mean") or what.startswith("h ") for what in acts_on)


def of_recordings(train: Sequence[Replay], test: Sequence[Replay]) -> Job:
    """Recordings of one model: to learn from and to report on; without the latter each is cut in three by time."""
    every = [*train, *test]
    first = every[0]
    known = [r.truth for r in every if r.truth is not None]
    n = len(train)
    by_run, by_time = Split(range(n), (), range(n, len(every))), Split(1 / 3, 1 / 3, 1 / 3, "time")
    return Job(
        first.model,
        [r.belief for r in every],
        first.theta,
        [r.recording.log for r in every],
        known if len(known) == len(every) else None,
        first.space,
        first.view,
        first.blocks,
        by_run if test else by_time,
        None,
        _acts_on(first.model, first.belief, first.theta, first.recording.log),
    )


def undetermined(job: Job, frozen: Sequence[str]) -> dict[str, str]:
    """Parameters that are better left alone, and why: those that act on nothing, and, of recordings, of which there are
    few, those that act on their beginning alone."""
    found = {}
    for name, on in job.acts_on.items():
        if any(covers(own, name) for own in frozen):
            continue
        if not on:
            found[name] = SILENT
        elif job.truth_theta is None and on <= {"P0", "mean"}:
            found[name] = BEGINNING
    return found


def _acts_on(
    model: Callable[[PyTree], Model], belief: Callable[[PyTree], Gaussian], theta: PyTree, log: Log
) -> dict[str, frozenset[str]]:
    """Parameter -> what it acts on, of the sensors that read: see `jaxfilt.tuning.identify.effects`."""
    there = [name for name in log.z if np.any(log.valid.get(name, True))]
    moving = np.flatnonzero(np.asarray(log.dt) > 0)
    rows = moving[np.linspace(0, len(moving) - 1, LOOKS).astype(int)]
    seen = log._replace(z={name: log.z[name] for name in there}, valid={})
    free, space, dtype = parameters(theta), model(theta).space, jnp.result_type(float)
    mean = jax.tree.map(lambda a: jnp.asarray(a, dtype), belief(theta).mean)
    offsets = SPREAD * np.random.default_rng(0).standard_normal((LOOKS, space.dim))
    x = jax.vmap(lambda d: space.plus(mean, d))(jnp.asarray(offsets, dtype))
    some = jax.tree.map(lambda a: np.asarray(a)[rows], seen)
    return identify.effects(model, belief, free, free.start, x, some).groups


def objective(name: str, job: Job, filter: Callable[[PyTree], Filter], burn_in: float) -> Objective | None:
    """The objective of this name, None for the default. Of mse a block weighs one over the variance of its error before
    tuning, on the training data."""
    if name != "mse" or job.truth is None:
        return OBJECTIVES.get(name)
    squares = objectives.mse()._replace(loss=lambda sums: sums["square"] / jnp.maximum(sums["count"], 1.0))
    begins = (job.belief,) if callable(job.belief) else job.belief

    @jax.jit
    def one(log: Log, truth: Truth, begin: Gaussian) -> Any:
        robot = filter(job.theta)
        return squares(robot, begin, log, truth, space=job.space, view=job.view, burn_in=burn_in)

    found, share = [], job.split.train
    for k, (log, truth) in enumerate(zip(_runs(job.logs, Log), _runs(job.truth, Truth), strict=True)):
        if isinstance(share, float):
            elapsed = np.cumsum(log.dt, dtype=np.float64)
            truth = truth._replace(mask=truth.mask & (elapsed <= share * elapsed[-1]))
        elif not np.isin(k, share):
            continue
        found.append(np.asarray(one(log, truth, begins[k % len(begins)](job.theta))))
    finite = [square for square in found if np.isfinite(square).all()]
    if not finite:
        raise ValueError("theta: expected a filter that gets through a run, got one that diverges on all of them")
    total = {block: float(np.mean(finite, 0)[list(index)].sum()) for block, (index, _) in job.blocks.items()}
    return objectives.mse({block: 1.0 / square for block, square in total.items() if square > 0}, job.blocks)


def _runs(data: Any, kind: type) -> list[Any]:
    """One after the other, of a batch or of a sequence."""
    if not isinstance(data, kind):
        return list(data)
    return [jax.tree.map(lambda a, k=k: a[k], data) for k in range(len(jax.tree.leaves(data)[0]))]
