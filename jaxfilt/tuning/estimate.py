"""Noise estimation: the parameters that the truth itself speaks of, with no filter to be tuned.

The truth is taken for one more sensor, all but free of noise. Where it knows the whole state, the innovations are the
residuals of the truth, ``x_k - f(x_(k-1))`` and ``z_k - h(x_k)``, and the most likely Q and R their second moments.
Where it knows a part, or comes at a slower rate, the rest is averaged over, as a filter does."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.filters import ekf
from jaxfilt.noise import const
from jaxfilt.objectives import likelihood
from jaxfilt.transforms import taylor
from jaxfilt.tuning.loss import Problem, started
from jaxfilt.tuning.split import Case
from jaxfilt.types import Array, Filter, Gaussian, Model, PyTree, Sensor

EXACT, LOOSE = 1e-3, 1e-6
"""Standard deviation of the truth, if nobody says: as a share of what the process noise adds in one step, and of what
the first belief does not know."""

KEPT = 3.0
"""Standard deviation of a prior about where each parameter began: for a logarithm, a factor of 20. What the truth says
nothing of stays where it was; what it speaks of does not feel it."""


def with_truth(problem: Problem, case: Case, truth_std: Sequence[float] | Array | None) -> tuple[Problem, Case]:
    """The problem whose solution is the noise estimation, and its data.

    Args:
        problem, case: to be tuned, with a truth.
        truth_std: (d,) standard deviations of the truth, on its space; None: as good as exact.

    Raises:
        ValueError: a truth_std that is not d positive numbers.
    """
    assert case.truth is not None
    begin = problem.parameters.tree(jnp.asarray(problem.parameters.start, case.log.dt.dtype))
    std = _least_std(problem, case, begin) if truth_std is None else np.asarray(truth_std, case.log.dt.dtype)
    if std.shape != (problem.space.dim,) or not (std > 0).all():
        raise ValueError(f"truth_std: expected {problem.space.dim} positive numbers, got {truth_std}")
    sensors = problem.filter(begin).model.sensors
    name = next(name for name in ("truth", *map("truth {}".format, range(99))) if name not in sensors)
    sensor = Sensor(lambda x, c: problem.view(x), const(np.diag(std**2)), problem.space)

    def filter(theta: PyTree) -> Filter:
        model: Model = problem.filter(theta).model
        return ekf(model._replace(sensors={name: sensor, **model.sensors}))

    def prior(theta: PyTree) -> jax.Array:
        moved = [jnp.sum(((a - b) / KEPT) ** 2) for a, b in zip(*map(jax.tree.leaves, (theta, begin)), strict=True)]
        own = 0.0 if problem.prior is None else problem.prior(theta)
        return own - 0.5 * jnp.sum(jnp.stack(moved))

    log = case.log._replace(
        z={name: case.truth.x, **case.log.z}, valid={name: case.truth.mask & case.weight, **case.log.valid}
    )
    return problem._replace(objective=likelihood, filter=filter, prior=prior), case._replace(log=log)


def _least_std(problem: Problem, case: Case, theta: PyTree) -> np.ndarray:
    """A standard deviation of the truth that changes nothing: far below what one step of the process noise adds."""
    first = jax.tree.map(lambda a: jnp.asarray(a[0]), case)
    model, belief = problem.filter(theta).model, started(problem, theta, first)
    dt = np.median(case.log.dt[case.log.dt > 0])
    u = jax.tree.map(lambda a: a[0], first.log.u)
    Q = model.Q(belief.mean, u, jnp.asarray(dt))
    seen = [taylor(problem.view, Gaussian(belief.mean, P), model.space, problem.space).cov for P in (Q, belief.cov)]
    added, unknown = (np.sqrt(np.diag(P)) for P in seen)
    return (EXACT * added + LOOSE * unknown).astype(belief.cov.dtype)
