"""A descent from start to end: shown, interrupted, killed and gone on with."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxfilt import checkpoint
from jaxfilt.tuning.batches import Batches
from jaxfilt.tuning.descent import Descent, Way, begun, steps

Progress = Callable[[int, int, float, float], Any]
"""Called with the steps done, the steps planned, the loss, and that on the validation part (NaN: there is none)."""


INTERRUPTED = "interrupted"


class Kept(NamedTuple):
    """Where a descent keeps its state, whether it goes on with what is there, and what it is about."""

    folder: Path
    resume: bool
    about: dict[str, Any]


def pursued(
    plan: Descent,
    V: np.ndarray,
    batches: Batches,
    validate: Callable[[np.ndarray], np.ndarray] | None,
    kept: Kept | None = None,
    progress: Progress | None = None,
) -> tuple[Way, str]:
    """Where the descent ended, and why, in words.

    Raises:
        ValueError: what is to be resumed is something else. OSError: the state cannot be kept.
    """
    way = begun(plan, V, batches, validate)
    book = None
    if kept is not None:
        structure = jax.tree.structure(way)
        state = checkpoint.load(kept.folder, kept.about, structure, checkpoint.TUNING) if kept.resume else None
        book = checkpoint.begin(kept.folder, kept.about, plan.steps, kept.resume, checkpoint.TUNING)
        way = way if state is None else _lengthened(state, plan.steps)
    why = INTERRUPTED
    # Ctrl-C strikes the main thread alone: what another one has begun to write is written whole.
    with ThreadPoolExecutor(1) as writer:
        try:
            for after in steps(plan, way, batches, validate):
                way = after
                if book is not None:
                    writer.submit(checkpoint.save, book, way, int(way.step)).result()
                if progress:
                    k, best = int(way.step) - 1, int(np.argmin(way.best_score))
                    progress(k + 1, plan.steps, float(way.losses[k, best]), float(way.validations[k, best]))
            why = _why(plan, way)
        except KeyboardInterrupt:
            pass
    return way, why


def _lengthened(way: Way, planned: int) -> Way:
    """With a history long enough for more steps than were planned; not shorter than what is done."""
    more = planned - len(way.losses)
    if more <= 0:
        return way
    longer = lambda a: np.concatenate([a, np.full((more, *a.shape[1:]), np.nan if a.dtype.kind == "f" else 0, a.dtype)])  # noqa: E731
    histories = ("losses", "validations", "gradients", "path", "refused", "seconds")
    return way._replace(**{name: longer(getattr(way, name)) for name in histories})


def _why(plan: Descent, way: Way) -> str:
    if not way.done.all():
        return f"all {plan.steps} steps were done"
    best = int(np.argmin(way.best_score))
    if way.waited[best] >= plan.patience:
        return f"no better for {plan.patience} steps"
    return "no step goes further down"
