"""Sweeps: the same study over a grid of parameters, on the same noise, in one compiled program."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxfilt.study import Interrupted, Study, conducted
from jaxfilt.task import Filters, Options
from jaxfilt.types import Array, Gaussian, Log, Model, PyTree


class Sweep(NamedTuple):
    """What `sweep` returns: ``over``, name -> values (K,), and ``studies``, an object array with an axis for each."""

    over: dict[str, np.ndarray]
    studies: np.ndarray

    def curve(self, score: Callable[[Study], float]) -> np.ndarray:
        """A number of each study, as an array like ``studies``."""
        return np.array([score(study) for study in self.studies.flat]).reshape(self.studies.shape)


def sweep(
    model: Callable[[PyTree], Model],
    filters: Filters,
    belief: Callable[[PyTree], Gaussian],
    log: Log,
    key: Array,
    over: Mapping[str, Array],
    *,
    theta: PyTree | Callable[..., PyTree],
    truth_theta: PyTree | Callable[..., PyTree] = None,
    **options: Any,
) -> Sweep:
    """Studies over a grid, on common noise: how errors and consistency change with a parameter of truth or filter.

    All settings of the grid run side by side under `jax.vmap`; where only the filters' theta changes, each run is
    simulated once for all of them.

    Args:
        model, filters, belief, log, key: as in `jaxfilt.study`.
        over: name -> values (K,); several names make a grid.
        theta: what the filters assume: a function of one value by name each, ``theta(q=..., r=...)``, or parameters
            that all settings share.
        truth_theta: the same for the truth; default: what ``theta`` is.
        options: as in `jaxfilt.study`: runs, control, blocks, out, ...

    Returns:
        `Sweep`.

    Raises:
        ValueError: no values, or nothing that depends on them. As `jaxfilt.study` otherwise.

    Example: the RMSE is least where the filter's Q is the truth's.
        >>> import jax, jax.numpy as jnp, numpy as np, jaxfilt as jf
        >>> def walk(theta):
        ...     return jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1) * theta, R=jnp.eye(1))
        >>> def start(theta):
        ...     return jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> log = jf.schedule(walk(1.0), steps=50, dt=1.0)
        >>> filters = {"kf": lambda theta: jf.kf(walk(theta))}
        >>> q = {"q": np.array([0.01, 1.0, 100.0])}
        >>> found = sweep(walk, filters, start, log, jax.random.key(0), q, theta=lambda q: q, truth_theta=1.0, runs=50)
        >>> int(found.curve(lambda s: s.scores["kf"].rmse_total["x[0]"].value).argmin())
        1
    """
    axes = {name: np.asarray(values) for name, values in over.items()}
    for name, values in axes.items():
        if values.ndim != 1 or not len(values):
            raise ValueError(f"over[{name!r}]: expected values (K,), got shape {values.shape}")
    truth_theta = theta if truth_theta is None else truth_theta
    swept = callable(theta), callable(truth_theta)
    if not axes or not any(swept):
        raise ValueError("over: expected values that theta or truth_theta is a function of, got none")
    points = [dict(zip(axes, point, strict=True)) for point in itertools.product(*axes.values())]
    at_point = lambda p, at: p(**at) if callable(p) else p  # noqa: E731
    settings = [(at_point(theta, at), at_point(truth_theta, at)) for at in points]
    studies, interrupted = conducted(model, filters, belief, log, key, settings, swept, Options(**options))
    grid = np.empty(len(studies), object)
    grid[:] = studies
    result = Sweep(axes, grid.reshape([len(values) for values in axes.values()]))
    if interrupted:
        raise Interrupted(result)
    return result
