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

from jaxfilt import checkpoint, doors
from jaxfilt.diagnose import diagnose
from jaxfilt.fit import BEFORE, ESTIMATED, TRAIN, TRUE, TUNED, VALIDATION, Fit, History, Parameter
from jaxfilt.fold import Objective, View, itself
from jaxfilt.metrics import Blocks
from jaxfilt.objectives import likelihood, log_score
from jaxfilt.run import scan
from jaxfilt.study import Interrupted
from jaxfilt.task import checked_blocks, seed, strong
from jaxfilt.tuning.assessment import certainty, definite, findings, matrices
from jaxfilt.tuning.batches import Batches
from jaxfilt.tuning.descent import LBFGS, Descent
from jaxfilt.tuning.estimate import with_truth
from jaxfilt.tuning.held_out import part_scores, scorer
from jaxfilt.tuning.identify import uninfluential
from jaxfilt.tuning.loss import PENALTY, Problem, losses, started
from jaxfilt.tuning.parameters import covers, parameters
from jaxfilt.tuning.pursuit import INTERRUPTED, Kept, Progress, pursued
from jaxfilt.tuning.split import Case, Split, apart, gathered, restricted, weights
from jaxfilt.types import Array, Filter, Gaussian, Log, PyTree, Space, Truth

ESTIMATE_STEPS = 60
"""Steps of the noise estimation at most."""


class Uninfluential(ValueError):
    """Parameters that do not influence the loss; ``names`` of them."""

    def __init__(self, objective: str, names: Sequence[str]) -> None:
        super().__init__(
            f"theta: expected parameters that influence the objective {objective!r}, got {', '.join(names)}, which "
            f"change nothing in these data; freeze them: frozen={list(names)}"
        )
        self.names = tuple(names)


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
    theta, dtype = _checked(filter, beliefs, theta, objective)
    model = filter(theta).model
    space = model.space if space is None else space
    blocks = None if blocks is None else checked_blocks(blocks, space.dim)
    case, lengths = gathered(logs, truth, model, objective, space, dtype)
    if len(beliefs) not in (1, len(lengths)):
        raise ValueError(f"belief: expected one, or one for each of {len(lengths)} logs, got {len(beliefs)}")
    for name in objective.held:
        if name not in case.log.z:
            raise ValueError(f"objective: expected readings of {name!r} to hold back, got logs without any")
    own, words = weights(case, lengths, split, burn_in)
    free = parameters(theta, frozen)
    problem = Problem(objective, filter, beliefs, free, space, view, prior, segment)
    plan = _plan(optimizer, steps, learning_rate, patience, clip, free.names, batch, length)
    for name, value in {"steps": steps, "starts": starts, "patience": patience}.items():
        if value < 1:
            raise ValueError(f"{name}: expected at least 1, got {value}")
    key = jax.random.key(0) if key is None else key
    definite("theta", matrices(problem, theta, case))

    train = restricted(case, own[TRAIN])
    # What is needed later is compiled beside what is under way.
    with ThreadPoolExecutor(1) as beside:
        validating = beside.submit(_validator, problem, case, own.get(VALIDATION), starts)
        batches = Batches(problem, train, starts, batch, length, seed(key))
        scoring = beside.submit(scorer, problem, case, theta)
        v = free.start.astype(dtype)
        _influential(batches, v, starts, problem, train)
        compiled = time.perf_counter()
        estimate = None
        if truth is not None and noise_estimate:
            estimate = _estimated(problem, train, v, truth_std)
        around = v if estimate is None else estimate
        V = _starts(around, v, starts, spread, key)
        kept = None
        if out is not None:
            about = _about(problem, case, own, V, plan, optimizer, seed(key))
            kept = Kept(Path(out), resume, about)
        way, why = pursued(plan, V, batches, validating.result(), kept, progress)
        rows = scoring.result()
    ran = time.perf_counter()
    s = int(np.argmin(np.where(np.isfinite(way.best_score), way.best_score, np.inf)))
    tuned = way.best[s]
    thetas = {BEFORE: theta, TUNED: free.tree(jnp.asarray(tuned))}
    if estimate is not None:
        thetas[ESTIMATED] = free.tree(jnp.asarray(estimate))
    if truth_theta is not None:
        thetas[TRUE] = strong(truth_theta, dtype)
        doors.alike("truth_theta", thetas[TRUE], theta)
    thetas = {stage: thetas[stage] for stage in (BEFORE, ESTIMATED, TUNED, TRUE) if stage in thetas}
    seen = {stage: rows(one) for stage, one in thetas.items()}
    scores = {
        stage: {part: part_scores(problem, found, weight, blocks) for part, weight in own.items()}
        for stage, found in seen.items()
    }
    sure = certainty(
        problem,
        batches if batches.full else Batches(problem, train),
        starts if batches.full else 1,
        rows,
        seen[TUNED],
        case,
        own[TRAIN],
        tuned,
    )
    done = int(way.step)
    history = History(
        *(np.asarray(a[:done, s]) for a in (way.losses, way.validations, way.gradients, way.path, way.refused)),
        seconds=way.seconds[:done],
    )
    true = None if truth_theta is None else parameters(thetas[TRUE], frozen).start
    listed = tuple(
        Parameter(
            name,
            float(v[j]),
            None if estimate is None else float(estimate[j]),
            float(tuned[j]),
            float(sure.errors[j]),
            None if true is None else float(true[j]),
        )
        for j, name in enumerate(free.names)
    )
    fit = Fit(
        theta=thetas[TUNED],
        start=theta,
        estimated=thetas.get(ESTIMATED),
        truth_theta=thetas.get(TRUE),
        model=filter(thetas[TUNED]).model,
        scores=scores,
        parameters=listed,
        errors_by=sure.by,
        flat=sure.flat,
        covariances={stage: matrices(problem, one, case) for stage, one in thetas.items()},
        history=history,
        starts=way.best_score,
        best=int(way.best_step[s]),
        findings=findings(
            objective, seen, scores, own, sure.flat, int(way.refused[:done, s].sum()), int(way.lost[s]), way.best_score
        ),
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


def _checked(filter: Any, beliefs: Sequence[Any], theta: PyTree, objective: Any) -> tuple[PyTree, np.dtype]:
    """Theta as arrays of the beliefs' dtype."""
    doors.instance("objective", objective, Objective)
    doors.finite("theta", theta)
    if not beliefs:
        raise ValueError("belief: expected at least one, got none")
    made = filter(theta)
    doors.instance("filter(theta)", made, Filter)
    for name in objective.held:
        doors.sensor(made.model, name)
    for i, belief in enumerate(beliefs):
        doors.belief("belief(theta)" if len(beliefs) == 1 else f"belief[{i}](theta)", belief(theta), made.model.space)
    dtype = jax.dtypes.canonicalize_dtype(beliefs[0](theta).cov.dtype)
    return jax.tree.map(lambda a: jnp.asarray(a, dtype), theta), dtype


def _plan(
    optimizer: Any,
    steps: int,
    learning_rate: float,
    patience: int,
    clip: Any,
    names: tuple[str, ...],
    batch: int | None,
    length: int | None,
) -> Descent:
    if optimizer == LBFGS:
        for name, given in {"batch": batch, "length": length, "clip": clip}.items():
            if given is not None:
                raise ValueError(
                    f"{name}: expected None with lbfgs, which wants the same loss at each step and bounds its own "
                    f"steps, got {given}; optimizer='adam' takes it"
                )
        return Descent(LBFGS, steps, patience, None, names)
    if length is not None and length < 1:
        raise ValueError(f"length: expected at least 1 row, got {length}")
    for name in clip if isinstance(clip, Mapping) else ():
        if not any(covers(name, own) for own in names):
            raise ValueError(f"clip: expected some of {', '.join(names)}, or what they begin with, got {name!r}")
    if isinstance(optimizer, str):
        make = getattr(optax, optimizer, None)
        if not callable(make) or optimizer.startswith(("scale", "_")):
            raise ValueError(f"optimizer: expected lbfgs or the name of an optimizer in optax, got {optimizer!r}")
        optimizer = make(learning_rate)
    doors.instance("optimizer", optimizer, optax.GradientTransformation)
    return Descent(optimizer, steps, patience, clip, names)


def _validator(problem: Problem, case: Case, weight: np.ndarray | None, starts: int) -> Callable | None:
    """Parameters (S, p) -> validation losses by run (S, R); None without such data."""
    if weight is None:
        return None
    data, axes = apart(restricted(case, weight))
    program, dtype = losses(problem, data, axes, starts, gradient=False), data.log.dt.dtype
    each = jax.jit(jax.vmap(jax.vmap(problem.objective.loss)))

    def validate(V: np.ndarray) -> np.ndarray:
        found = program(jnp.asarray(V, dtype), data, None)
        return np.where(found.sound, each(found.sums), PENALTY)

    return validate


def _influential(batches: Batches, v: np.ndarray, starts: int, problem: Problem, train: Case) -> None:
    """Raise where every run diverges at the start, and for parameters that the loss does not know."""
    first, second = (
        batches(np.tile(at, (starts, 1)), 0, np.tile(at, (starts, 1))) for at in (v, v + v.dtype.type(0.01))
    )
    if not first.sound.any():
        why = _where(problem, train)
        raise ValueError(f"theta: expected a filter that gets through a run, got one that diverges on all of them{why}")
    nothing = uninfluential(np.stack([first.gradient[0], second.gradient[0]]), problem.parameters.names)
    if nothing:
        raise Uninfluential(problem.objective.name, nothing)


def _where(problem: Problem, train: Case) -> str:
    """What first went wrong in the first run."""
    theta = problem.parameters.tree(jnp.asarray(problem.parameters.start, train.log.dt.dtype))
    one = jax.tree.map(lambda a: jnp.asarray(a[0]), train)
    found = diagnose(jax.jit(lambda log: scan(problem.filter(theta), started(problem, theta, one), log))(one.log))
    return "" if found is None else f"; of the first, {found.message}"


def _estimated(problem: Problem, train: Case, v: np.ndarray, truth_std: Any) -> np.ndarray | None:
    """The parameters that the truth itself speaks of; None where that cannot be computed."""
    own, data = with_truth(problem, train, truth_std)
    batches = Batches(own, data)
    way, _ = pursued(Descent(LBFGS, ESTIMATE_STEPS, ESTIMATE_STEPS, None, own.parameters.names), v[None], batches, None)
    return way.best[0] if np.isfinite(way.best_score[0]) and not way.lost[0] else None


def _starts(around: np.ndarray, given: np.ndarray, starts: int, spread: float, key: Array) -> np.ndarray:
    """Where the descents begin (S, p): at the noise estimate, if there is one, then where we were told, then around."""
    V = around + spread * np.asarray(jax.random.normal(key, (starts, len(around)), around.dtype))
    V[0] = around
    if starts > 1 and around is not given:
        V[1] = given
    return V


def _about(
    problem: Problem, case: Case, own: Mapping[str, np.ndarray], V: np.ndarray, plan: Descent, optimizer: Any, seed: int
) -> dict[str, Any]:
    """What a checkpoint says of the tuning."""
    return {
        "objective": problem.objective.name,
        "optimizer": optimizer if isinstance(optimizer, str) else "of optax",
        "parameters": list(problem.parameters.names),
        "starts": checkpoint.fingerprint(V),
        "seed": seed,
        "dtype": str(V.dtype),
        "data": checkpoint.fingerprint((case, dict(own))),
    }
