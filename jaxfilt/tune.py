"""Tuning: gradients find the parameters of a filter, by the truth or without it, and data they did not see judge
them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxfilt import doors
from jaxfilt.fit import BEFORE, ESTIMATED, TRAIN, TRUE, TUNED, VALIDATION, Fit, History, Parameter
from jaxfilt.fold import Objective, View, itself
from jaxfilt.loop import Backend
from jaxfilt.metrics import Blocks
from jaxfilt.objectives import likelihood, log_score
from jaxfilt.study import Interrupted
from jaxfilt.task import checked_blocks, seed, strong
from jaxfilt.tuning.assessment import certainty, definite, findings, matrices
from jaxfilt.tuning.batches import Batches
from jaxfilt.tuning.descent import LBFGS, Way
from jaxfilt.tuning.held_out import Rows, part_scores, scorer
from jaxfilt.tuning.loss import Problem
from jaxfilt.tuning.parameters import parameters
from jaxfilt.tuning.pursuit import INTERRUPTED, Kept, Progress, pursued
from jaxfilt.tuning.setup import about, check_influence, checked, estimate_of, planned, starts_around, validator
from jaxfilt.tuning.split import Case, Split, gathered, restricted, weights
from jaxfilt.types import Array, Filter, Gaussian, Log, PyTree, Space, Truth


def tune(
    filter: Callable[[PyTree], Filter],
    belief: Callable[[PyTree], Gaussian] | Sequence[Callable[[PyTree], Gaussian]],
    theta: PyTree,
    logs: Log | Sequence[Log],
    truth: Truth | Sequence[Truth] | None = None,
    objective: Objective | None = None,
    *,
    space: Space | None = None,
    view: View = itself,
    blocks: Blocks | None = None,
    split: Split | None = None,
    frozen: Sequence[str] = (),
    prior: Callable[[PyTree], Array] | None = None,
    burn_in: float = 0.0,
    optimizer: str | optax.GradientTransformation = LBFGS,
    steps: int = 100,
    learning_rate: float = 0.05,
    batch: int | None = None,
    length: int | None = None,
    patience: int = 20,
    clip: float | Mapping[str, float] | None = None,
    starts: int = 1,
    spread: float = 1.0,
    key: Array | None = None,
    noise_estimate: bool = True,
    truth_std: Sequence[float] | Array | None = None,
    truth_theta: PyTree = None,
    segment: int | None = None,
    backend: Backend = "auto",
    out: str | Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> Fit:
    """Find the parameters of a filter by gradients: Q, R, the first belief, a bias, a mass, whatever theta holds.

    ``theta = argmin L(sum over runs and rows of s(filter, belief, truth; theta)) - log prior(theta) / count``

    With a truth, the noise is estimated first from the truth itself, and tuning starts there. What was learned is
    judged on a part of the data that was not looked at.

    Args:
        filter: theta -> filter.
        belief: theta -> Gaussian where a run starts; or one such function for each log.
        theta: parameters to begin with: a pytree of unconstrained numbers, standard deviations as logarithms.
        logs: one log (T,), a batch (runs, T), or a sequence of logs of different lengths.
        truth: for each row of each log, see `jaxfilt.align`; of slower rate or with gaps by its mask.
        objective: what to minimise; default `log_score` with a truth, `likelihood` without.
        space: where the truth lives; default the state's.
        view: the part of the state that the truth knows.
        blocks: name -> (indices of the truth's tangent vector, unit), for the RMSE.
        split: which data to learn from, to stop by, to report; default 60 %, 20 %, 20 % of the runs, or of the time
            with fewer than five runs.
        frozen: names of numbers in theta that stay as they are, or what the names of several begin with.
        prior: theta -> log density, see `jaxfilt.priors`.
        burn_in: s at the start of each run that do not count.
        optimizer: "lbfgs" with a line search; or the name of an optimizer in optax, or one.
        steps: at most.
        learning_rate: of an optimizer that is named, but for lbfgs.
        batch: runs (or pieces) in a step; default all. Not with lbfgs.
        length: rows of the pieces that runs are cut into for minibatches; no gradient goes from piece to piece, so
            choose them long against the memory of the filter.
        patience: stop after so many steps without a better validation loss.
        clip: largest norm of the gradient, or name in theta -> largest norm of its part. Not with lbfgs.
        starts: how many descents, all in one program; the first from theta (or the noise estimate), the others around.
        spread: standard deviation of the starts around it.
        key: of `jax.random`, for starts and minibatches; default ``jax.random.key(0)``.
        noise_estimate: whether to estimate the noise from the truth, start there, and report it.
        truth_std: (d,) standard deviations of the truth itself, for the noise estimate; default: all but exact.
        truth_theta: the true parameters, of a simulation, to be compared with.
        segment: rows between beliefs that reverse mode keeps, see `jaxfilt.scan`: less memory, more time.
        backend: what computes the loss and its gradient, see `jaxfilt.scan_runs`.
        out: folder to keep the state in, after each step.
        resume: go on with what is in ``out``, to as many steps as asked for now.
        progress: called with (steps done, steps, loss, validation loss).

    Returns:
        `Fit`; ``print(fit.report())`` says it all. The same arguments give the same result, however often interrupted.

    Raises:
        ValueError, TypeError, KeyError: naming the argument, what was expected and what came; also for parameters
            that do not influence the loss.
        FileExistsError: ``out`` holds something else that is not finished. OSError: it cannot be written.
        Interrupted: Ctrl-C, with what was found.

    Example: the noise of a walk and of its readings, from the readings alone.
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> def walk(theta):
        ...     return jf.linear(jnp.eye(1), jnp.eye(1), Q=jf.log_std.cov(theta["q"]), R=jf.log_std.cov(theta["r"]))
        >>> def start(theta):
        ...     return jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> true = {"q": jnp.zeros(1), "r": jnp.ones(1)}
        >>> x, log = jf.simulate(walk(true), start(true), jf.schedule(walk(true), 500, 1.0), jax.random.key(0))
        >>> fit = jf.tune(lambda theta: jf.kf(walk(theta)), start, {"q": jnp.ones(1), "r": jnp.zeros(1)}, log)
        >>> bool(abs(fit.theta["r"][0] - 1.0) < 4 * fit.parameters[1].error)
        True
    """
    began = time.perf_counter()
    objective = (likelihood if truth is None else log_score) if objective is None else objective
    beliefs = (belief,) if callable(belief) else tuple(belief)
    theta, dtype = checked(filter, beliefs, theta, objective)
    if truth_theta is not None:
        truth_theta = strong(truth_theta, dtype)
        doors.alike("truth_theta", truth_theta, theta)
    model = filter(theta).model
    space = model.space if space is None else space
    blocks = None if blocks is None else checked_blocks(blocks, space.dim)
    case, lengths = gathered(logs, truth, model, objective, space, dtype)
    if len(beliefs) not in (1, len(lengths)):
        raise ValueError(f"belief: expected one, or one for each of {len(lengths)} logs, got {len(beliefs)}")
    for name in objective.held:
        if name not in case.log.z:
            raise ValueError(f"objective: expected readings of {name!r} to hold back, got logs without any")
    for name, value in {"steps": steps, "starts": starts, "patience": patience}.items():
        if value < 1:
            raise ValueError(f"{name}: expected at least 1, got {value}")
    own, words = weights(case, lengths, split, burn_in)
    free = parameters(theta, frozen)
    problem = Problem(objective, filter, beliefs, free, space, view, prior, segment, backend)
    plan = planned(optimizer, steps, learning_rate, patience, clip, free.names, batch, length)
    key = jax.random.key(0) if key is None else key
    definite("theta", matrices(problem, theta, case))

    train = restricted(case, own[TRAIN])
    v = free.start.astype(dtype)
    # What is needed later is compiled beside what is under way.
    with ThreadPoolExecutor(1) as beside:
        validating = beside.submit(validator, problem, case, own.get(VALIDATION), starts)
        batches = Batches(problem, train, starts, batch, length, seed(key))
        scoring = beside.submit(scorer, problem, case, theta)
        check_influence(batches, v, starts, problem, train)
        compiled = time.perf_counter()
        estimate = estimate_of(problem, train, v, truth_std) if truth is not None and noise_estimate else None
        V = starts_around(v if estimate is None else estimate, v, starts, spread, key)
        kept = None
        if out is not None:
            kept = Kept(Path(out), resume, about(problem, case, own, V, optimizer, seed(key)))
        way, why = pursued(plan, V, batches, validating.result(), kept, progress)
        rows = scoring.result()
    ran = time.perf_counter()
    found = _found(problem, case, own, blocks, way, batches, rows, theta, estimate, truth_theta, frozen)
    fit = Fit(
        **found,
        frozen=tuple(frozen),
        objective=objective.name,
        optimizer=optimizer if isinstance(optimizer, str) else "of optax",
        stopped=why,
        split=words,
        blocks=blocks,
        runs=len(lengths),
        dtype=str(dtype),
        seed=seed(key),
        compile_seconds=compiled - began,
        run_seconds=ran - compiled,
    )
    if why == INTERRUPTED:
        raise Interrupted(fit)
    return fit


def _found(
    problem: Problem,
    case: Case,
    own: dict[str, np.ndarray],
    blocks: Blocks | None,
    way: Way,
    batches: Batches,
    rows: Callable[[PyTree], Rows],
    theta: PyTree,
    estimate: np.ndarray | None,
    truth_theta: PyTree,
    frozen: Sequence[str],
) -> dict[str, Any]:
    """The fields of `Fit` that the descent and the scores fill."""
    free, done = problem.parameters, int(way.step)
    s = int(np.argmin(np.where(np.isfinite(way.best_score), way.best_score, np.inf)))
    tuned = way.best[s]
    estimated = None if estimate is None else free.tree(jnp.asarray(estimate))
    stages = {BEFORE: theta, ESTIMATED: estimated, TUNED: free.tree(jnp.asarray(tuned)), TRUE: truth_theta}
    thetas = {stage: one for stage, one in stages.items() if one is not None}
    seen = {stage: rows(one) for stage, one in thetas.items()}
    scores = {
        stage: {part: part_scores(problem, found, weight, blocks) for part, weight in own.items()}
        for stage, found in seen.items()
    }
    # A minibatch has no minimum to bend about.
    whole = batches if batches.full else Batches(problem, restricted(case, own[TRAIN]))
    sure = certainty(problem, whole, rows, seen[TUNED], case, own[TRAIN], tuned)
    true = None if truth_theta is None else parameters(truth_theta, frozen).start
    numbers = free.start, estimate, tuned, sure.errors, true
    columns: list[list[Any]] = [[None] * len(free.names) if a is None else a.tolist() for a in numbers]
    refused, lost = int(way.refused[:done, s].sum()), int(way.lost[s])
    return {
        "theta": thetas[TUNED],
        "start": theta,
        "estimated": estimated,
        "truth_theta": truth_theta,
        "model": problem.filter(thetas[TUNED]).model,
        "scores": scores,
        "parameters": tuple(Parameter(*each) for each in zip(free.names, *columns, strict=True)),
        "errors_by": sure.by,
        "flat": sure.flat,
        "covariances": {stage: matrices(problem, one, case) for stage, one in thetas.items()},
        "history": History(
            *(np.asarray(a[:done, s]) for a in (way.losses, way.validations, way.gradients, way.path, way.refused)),
            seconds=way.seconds[:done],
        ),
        "starts": way.best_score,
        "best": int(way.best_step[s]),
        "findings": findings(problem.objective, seen, scores, own, sure.flat, refused, lost, way.best_score),
    }
