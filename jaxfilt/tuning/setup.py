"""What a tuning begins with: its arguments checked, its optimizer, its starts, the estimate by the truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxfilt import checkpoint, doors
from jaxfilt.diagnose import diagnose
from jaxfilt.fold import Objective
from jaxfilt.run import scan
from jaxfilt.tuning.batches import Batches
from jaxfilt.tuning.descent import LBFGS, Descent
from jaxfilt.tuning.estimate import with_truth
from jaxfilt.tuning.identify import uninfluential
from jaxfilt.tuning.loss import PENALTY, Problem, losses, started
from jaxfilt.tuning.parameters import covers
from jaxfilt.tuning.pursuit import pursued
from jaxfilt.tuning.split import Case, apart, restricted
from jaxfilt.types import Array, Filter, PyTree

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


def checked(filter: Any, beliefs: Sequence[Any], theta: PyTree, objective: Any) -> tuple[PyTree, np.dtype]:
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


def planned(
    optimizer: Any,
    steps: int,
    learning_rate: float,
    patience: int,
    clip: Any,
    names: tuple[str, ...],
    batch: int | None,
    length: int | None,
) -> Descent:
    """How to go down, checked; an optimizer by its name is made."""
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


def validator(problem: Problem, case: Case, weight: np.ndarray | None, starts: int) -> Callable | None:
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


def check_influence(batches: Batches, v: np.ndarray, starts: int, problem: Problem, train: Case) -> None:
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


def estimate_of(problem: Problem, train: Case, v: np.ndarray, truth_std: Any) -> np.ndarray | None:
    """The parameters that the truth itself speaks of; None where that cannot be computed."""
    own, data = with_truth(problem, train, truth_std)
    batches = Batches(own, data)
    way, _ = pursued(Descent(LBFGS, ESTIMATE_STEPS, ESTIMATE_STEPS, None, own.parameters.names), v[None], batches, None)
    return way.best[0] if np.isfinite(way.best_score[0]) and not way.lost[0] else None


def starts_around(around: np.ndarray, given: np.ndarray, starts: int, spread: float, key: Array) -> np.ndarray:
    """Where the descents begin (S, p): at the noise estimate, if there is one, then where we were told, then around."""
    V = around + spread * np.asarray(jax.random.normal(key, (starts, len(around)), around.dtype))
    V[0] = around
    if starts > 1 and around is not given:
        V[1] = given
    return V


def about(
    problem: Problem, case: Case, own: Mapping[str, np.ndarray], V: np.ndarray, optimizer: Any, seed: int
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
