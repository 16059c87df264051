"""The most probable trajectory, all of its states at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors
from jaxfilt import log as logs
from jaxfilt.correction import Gate, thresholds_of
from jaxfilt.graph import chain as chains
from jaxfilt.graph.between import Between, check
from jaxfilt.graph.factors import Data, Frame, Problem
from jaxfilt.types import Array, Filter, Gaussian, Log, Model, PyTree, Sensor, Status

TOLERANCE = {4: 1e-3, 8: 1e-6}
"""Bytes of a float -> when offsets, in standard deviations of the filter, and residuals count as settled."""


class Trajectory(NamedTuple):
    """What `optimise` returns.

    ``belief`` the marginal Gaussians after each row (leading axis T), ``start`` that before the first; ``cost`` half
    the sum of squared whitened residuals, ``evaluations`` of them; ``converged`` bool, False where the search ran out
    of evaluations or met NaN.
    """

    belief: Gaussian
    start: Gaussian
    cost: Array
    evaluations: Array
    converged: Array


def optimise(
    filter: Filter,
    belief: Gaussian,
    log: Log,
    between: Sequence[Between] = (),
    robust: Gate = None,
    rounds: int = 2,
    iterations: int = 100,
    initial: PyTree | None = None,
) -> Trajectory:
    """The maximum a posteriori trajectory by nonlinear least squares: a factor graph over the filter's model.

    ``min |x_0 - m|^2_P + sum_k |x_k - f(x_{k-1}, u_k, dt_k)|^2_Q + sum |z - h(x_k)|^2_R + sum |z - h(x_i, x_j)|^2_R``,
    + and - those of the model's spaces. Covariances are those of the problem linearised at the solution. On a linear
    model that is the Rauch-Tung-Striebel smoother; elsewhere every factor is linearised at the smoothed states, where
    a smoother keeps the filter's.

    The search is Gauss-Newton of optimistix, each step halved until the cost goes down: begun far off, where headings
    are wrong by radians, it may end elsewhere or not at all, which ``converged`` tells. The normal equations of a
    trajectory are block tridiagonal; they are solved as a chain, in time and memory proportional to T, and the L
    numbers of factors between distant instants come on top by a dense correction (L, L), in time L T. No covariance is
    inverted: states without process noise and rows with dt = 0 are held exactly.

    Optimistix was chosen for being maintained, on PyPI, and open: its Gauss-Newton takes any descent direction. jaxls,
    which is made for such graphs, is not on PyPI (what is there under that name is another project).

    Not jitted: wrap it in `jax.jit`. Reverse mode solves a dense system of all T n numbers: for short logs only.

    Args:
        filter: of the Kalman family, on the model. It gives the first guess, and what its gate refuses is left out.
        belief: before the first row.
        log: T rows.
        between: factors between two instants, see `Between`, `planar`, `spatial`.
        robust: probability with which a true reading counts in full, for all sensors or by name; None: all do. Beyond
            that quantile of its whitened square e' R^-1 e, Huber's loss: the pull of an outlier is bounded, not nil.
        rounds: Q and R that depend on the state are taken at the states of the round before, at first at the filter's.
        iterations: evaluations at most, in each round.
        initial: T states to begin at; default the filter's means.

    Returns:
        Trajectory(belief, start, cost, evaluations, converged).

    Raises:
        ImportError: optimistix is not installed.
        ValueError, TypeError, KeyError: at the door, naming what was expected and received.

    Example: two steps of a walk that was seen once, at its end.
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> z, valid = jnp.array([[0.0], [4.0]]), jnp.array([False, True])
        >>> log = jf.Log(dt=jnp.ones(2), u=(), z={"z": z}, c={}, valid={"z": valid})
        >>> found = optimise(jf.kf(walk), jf.Gaussian(jnp.zeros(1), jnp.eye(1)), log)
        >>> [round(float(x), 3) for x in (*found.belief.mean[:, 0], *found.belief.cov[:, 0, 0])]
        [2.0, 3.0, 1.0, 0.75]

    Source: F. Dellaert, M. Kaess, Factor graphs for robot perception (2017), sections 2 and 4; B. M. Bell, The iterated
    Kalman smoother as a Gauss-Newton method (1994).
    """
    minimise = _solver()
    doors.instance("filter", filter, Filter)
    if filter.transition is None:
        raise ValueError("filter: expected a Kalman filter, one with a transition, got None for it")
    for name, count in (("rounds", rounds), ("iterations", iterations)):
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise ValueError(f"{name}: expected an integer >= 1, got {count!r}")
    prior = filter.begin(belief)
    dtype = prior.cov.dtype
    logs.validate(filter.model, log, dtype)
    log = jax.tree.map(jnp.asarray, log)
    data, means, scale = _prepared(filter, prior, log, between, robust)
    if initial is not None:
        doors.point("initial", initial, filter.model.space, leading=(len(log.dt),))
        doors.finite("initial", initial)
        means = jax.tree.map(lambda a: jnp.asarray(a, dtype), initial)
    base = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), prior.mean, means)
    problem, space = Problem(filter.model, data), filter.model.space

    def residuals(y: jax.Array, frame: Frame) -> PyTree:
        return problem.residuals(frame, y)

    def direction(y: jax.Array, frame: Frame) -> jax.Array:
        x = problem.points(frame, y)
        chain, ties = problem.linear(frame, x)
        d = chains.tied_solution(chain, chains.gains(chain), ties)

        def offset(base: PyTree, x: PyTree, d: jax.Array) -> jax.Array:
            zero = jnp.zeros_like(d)
            return jax.jvp(lambda d: space.minus(space.plus(x, d), base), (zero,), (d,))[1]

        return (d if space.flat else jax.vmap(offset)(frame.base, x, d)) / frame.scale

    def improve(base: PyTree, _: None) -> tuple[PyTree, tuple]:
        frame = problem.frame(base, scale)
        tolerance = TOLERANCE[jnp.dtype(dtype).itemsize]
        y, evaluations, converged = minimise(residuals, direction, jnp.zeros_like(scale), frame, tolerance, iterations)
        half = 0.5 * sum(jnp.vdot(e, e) for e in jax.tree.leaves(residuals(y, frame)))
        return problem.points(frame, y), (half, evaluations, converged)

    x, (cost, evaluations, converged) = jax.lax.scan(improve, base, None, length=rounds)
    chain, ties = problem.linear(problem.frame(x, scale), x)
    cov = chains.tied_covariances(chain, chains.gains(chain), ties)
    every = Gaussian(x, cov)
    start, after = (jax.tree.map(lambda a, part=part: a[part], every) for part in (0, slice(1, None)))
    return Trajectory(after, start, cost[-1], evaluations.sum(), converged[-1])


def _solver() -> Any:
    try:
        from jaxfilt.graph.search import minimise
    except ImportError as missing:
        raise ImportError(
            f"trajectories need optimistix: pip install 'jaxfilt[graph]' ({missing})", name=missing.name
        ) from missing
    return minimise


def _prepared(
    filter: Filter, prior: Gaussian, log: Log, between: Sequence[Between], robust: Gate
) -> tuple[Data, PyTree, jax.Array]:
    """What was measured and is used, the filter's means, and its standard deviations (T + 1, n), 1 where they are 0."""
    model, dtype = filter.model, prior.cov.dtype

    def step(b: Gaussian, row: Log) -> tuple[Gaussian, tuple]:
        b, info = filter.step(b, row)
        return b, (b.mean, jnp.diagonal(b.cov), {name: i.status for name, i in info.items()})

    _, (means, variances, statuses) = jax.lax.scan(step, prior, log)
    there = {}
    for name, status in statuses.items():
        shape = (len(log.dt), model.sensors[name].space.dim)
        valid = log.valid.get(name, jnp.ones(shape, bool))
        valid = valid if valid.ndim == 2 else jnp.broadcast_to(valid[:, None], shape)
        there[name] = valid & (status != Status.GATED)[:, None]
    ties = tuple(check(k, tie, len(log.dt), model, dtype) for k, tie in enumerate(between))
    tied = tuple(_limits(k, tie, model) for k, tie in enumerate(ties))
    data = Data(prior, log, there, ties, thresholds_of("robust", model, robust), tied)
    std = jnp.sqrt(jnp.concatenate([jnp.diagonal(prior.cov)[None], variances]))
    return data, means, jnp.where(std > 0, std, 1.0)


def _limits(k: int, tie: Between, model: Model) -> np.ndarray | None:
    if tie.robust is None:
        return None
    name = f"between[{k}]"
    sensors = {name: Sensor(lambda x, c: x, lambda x, c: x, tie.space)}  # whose space alone is looked at
    return thresholds_of(f"{name}.robust", model._replace(sensors=sensors), tie.robust)[name]
