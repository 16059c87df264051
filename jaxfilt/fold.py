"""An objective, and its sums over one run: what tuning differentiates.

What is taken of a row is taken inside the scan, whose body is checkpointed: reverse mode keeps one belief a row.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors
from jaxfilt import log as logs
from jaxfilt.loop import checkpointed
from jaxfilt.prediction import dtype_of
from jaxfilt.transforms import taylor
from jaxfilt.types import Array, Filter, Info, Log, PyTree, Space, Truth

View = Callable[[PyTree], PyTree]


def itself(x: PyTree) -> PyTree:
    """What the truth and the filter have in common, unless told otherwise: all of it."""
    return x


class Seen(NamedTuple):
    """What an objective sees of one row of one run, after the filter's step.

    With a truth: ``error`` (d,) is ``minus(truth, view(mean))``, ``cov`` (d, d) its covariance as the belief has it,
    and ``known`` () whether the truth is known in this row; where it is not, the error is 0 and cov the identity. All
    three are None for an objective that needs no truth. ``held`` is the row with the readings that were kept from the
    filter, and with nothing else."""

    filter: Filter
    belief: Any
    info: dict[str, Info]
    error: Array
    cov: Array
    known: Array
    held: Log


class Objective(NamedTuple):
    """What tuning minimises: a function of sums, over rows and runs, of statistics of each row.

    ``row(seen)`` is a dict of numbers, finite and with a "count" among them; ``loss(sums)`` is a number, finite also
    where nothing was counted. ``needs_truth`` says whether there must be a truth. ``likelihood``: count times the loss
    is a negative log likelihood, so that the inverse of its Hessian is the covariance of the parameters. ``held``:
    sensor -> k, each k-th of its readings is kept from the filter, to be predicted."""

    name: str
    row: Callable[[Seen], dict[str, Array]]
    loss: Callable[[dict[str, Array]], Array]
    needs_truth: bool
    likelihood: bool = False
    held: Mapping[str, int] = {}

    def __call__(
        self,
        filter: Filter,
        belief: Any,
        log: Log,
        truth: Truth | None = None,
        *,
        space: Space | None = None,
        view: View = itself,
        burn_in: float = 0.0,
    ) -> jax.Array:
        """The loss of one run: smaller is better; differentiable in everything.

        Args:
            filter, belief, log: as in `jaxfilt.scan`.
            truth: leading axis T, see `jaxfilt.align`.
            space: where the truth lives; default the state's.
            view: the part of the state that the truth knows.
            burn_in: s at the start of the log that do not count.

        Raises:
            ValueError, TypeError, KeyError: naming the argument, what was expected and what came.
        """
        doors.instance("filter", filter, Filter)
        belief = filter.begin(belief)
        logs.validate(filter.model, log, dtype_of(belief))
        space = filter.model.space if space is None else space
        check_truth(self, truth, space, len(log.dt))
        for name in self.held:
            doors.sensor(filter.model, name)
        log = jax.tree.map(jnp.asarray, log)
        return self.loss(fold(self, filter, belief, log, truth, settled(log.dt, burn_in), space, view))


def check_truth(objective: Objective, truth: Truth | None, space: Space, rows: int) -> None:
    """Raise unless there is a truth where the objective needs one, on its space, for each row of the log."""
    if truth is None:
        if objective.needs_truth:
            raise ValueError(f"truth: the objective {objective.name!r} needs one, got None; `likelihood` needs none")
        return
    doors.instance("truth", truth, Truth)
    if np.shape(truth.mask) != (rows,):
        raise ValueError(
            f"truth.mask: expected shape ({rows},), one for each row of the log, got {np.shape(truth.mask)}; "
            "jaxfilt.align brings a truth with stamps of its own to the rows of a log"
        )
    doors.point("truth.x", truth.x, space, leading=(rows,))
    if doors.is_concrete(truth.mask):
        doors.finite("truth.x", jax.tree.map(lambda a: np.asarray(a)[np.asarray(truth.mask)], truth.x))


def settled(dt: Array, burn_in: float) -> jax.Array:
    """Which rows (T,) count: those at least ``burn_in`` seconds after the start."""
    if not burn_in >= 0:
        raise ValueError(f"burn_in: expected seconds >= 0, got {burn_in}")
    return jnp.cumsum(jnp.asarray(dt)) >= burn_in


def withheld(log: Log, held: Mapping[str, int]) -> tuple[Log, Log]:
    """A log without the readings that are to be kept from the filter, and the log of those alone."""
    kept_z, kept_c, kept_valid = dict(log.z), dict(log.c), dict(log.valid)
    z, c, valid = {}, {}, {}
    for name, every in held.items():
        if name not in log.z:
            continue
        z[name], there = log.z[name], jnp.asarray(log.valid.get(name, jnp.ones(len(log.dt), bool)))
        if name in log.c:
            c[name] = log.c[name]
        some = there if there.ndim == 1 else there.any(1)
        chosen = some & (jnp.cumsum(some) % every == 0)
        chosen = chosen if there.ndim == 1 else chosen[:, None] & there
        valid[name] = chosen
        if every == 1:
            for table in (kept_z, kept_c, kept_valid):
                table.pop(name, None)
        else:
            kept_valid[name] = there & ~chosen
    return log._replace(z=kept_z, c=kept_c, valid=kept_valid), log._replace(z=z, c=c, valid=valid)


def fold(
    objective: Objective,
    filter: Filter,
    belief: Any,
    log: Log,
    truth: Truth | None,
    weight: Array,
    space: Space,
    view: View = itself,
    segment: int | None = None,
) -> dict[str, jax.Array]:
    """Sums over one run of what the objective takes of each row; rows of weight False do not count.

    Args:
        objective: whose sums.
        filter, belief, log: as in `jaxfilt.scan`, checked already.
        truth: leading axis T; not looked at where the objective needs none.
        weight: (T,) bool.
        space: where the truth lives.
        view: the part of the state that the truth knows.
        segment: as in `jaxfilt.scan`.
    """
    each = by_row(objective, filter, belief, log, truth, space, view, segment)
    return {name: jnp.where(weight.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0).sum(0) for name, a in each.items()}


def by_row(
    objective: Objective,
    filter: Filter,
    belief: Any,
    log: Log,
    truth: Truth | None,
    space: Space,
    view: View = itself,
    segment: int | None = None,
) -> dict[str, jax.Array]:
    """What the objective takes of each row, leading axis T: the terms of `fold`."""
    belief = filter.begin(belief)
    take = taken(objective, filter, space, view, dtype_of(belief))
    return checkpointed(take, belief, rows_of(objective, log, truth), segment)[1]


def rows_of(objective: Objective, log: Log, truth: Truth | None) -> tuple[Log, Log, Truth | None]:
    """What an objective looks at, row by row: what the filter reads, what was kept from it, and the truth."""
    return *withheld(log, objective.held), truth if objective.needs_truth else None


def taken(objective: Objective, filter: Filter, space: Space, view: View, dtype: Any) -> Callable:
    """(belief, one of `rows_of`) -> (belief, what the objective takes of the row)."""
    whole = filter.model.space

    def compared(b: PyTree, truth: Truth) -> tuple[jax.Array, jax.Array]:
        # The belief as the truth sees it; of the whole state there is nothing to differentiate.
        seen = filter.gaussian(b)
        x, P = seen if view is itself else taylor(view, seen, whole, space)[:2]
        there = jnp.asarray(truth.mask)
        point = jax.tree.map(lambda a, own: jnp.where(there, jnp.asarray(a, dtype), own), truth.x, x)
        return space.minus(point, x), jnp.where(there, P, jnp.eye(space.dim, dtype=dtype))

    def take(b: PyTree, xs: tuple) -> tuple[PyTree, dict[str, Array]]:
        row, held_row, truth_row = xs
        b, info = filter.step(b, row)
        error, cov = (None, None) if truth_row is None else compared(b, truth_row)
        known = None if truth_row is None else jnp.asarray(truth_row.mask)
        found = objective.row(Seen(filter, b, info, error, cov, known, held_row))
        return b, {name: jnp.asarray(value, dtype) for name, value in found.items()}

    return take
