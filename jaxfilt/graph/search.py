"""Gauss-Newton of optimistix whose linear problem is a chain's: linear in the number of instants.

optimistix brings the iteration, its termination and its derivative by the implicit function theorem. Its own linear
solvers know the Jacobian as one dense or matrix-free operator; the direction here is that of `jaxfilt.graph.chain`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

SLOPE = 1e-4
"""Share of the decrease that the slope promises which a step must bring. Source: J. Nocedal, S. J. Wright, Numerical
Optimization (2006), section 3.1."""

ROUNDING = 10.0
"""Times eps of itself that the cost may rise and still count as no rise."""


class Directed(eqx.Module):
    """A direction (T + 1, n), held until the next is asked for."""

    direction: Any


class ChainDescent(optx.AbstractDescent):
    """The Gauss-Newton direction of a function (y, held) -> direction (T + 1, n); a step goes a share of it."""

    direction: Callable[[Any, Any], Any]
    held: Any

    def init(self, y: Any, f_info_struct: Any) -> Directed:
        return Directed(y)

    def query(self, y: Any, f_info: Any, state: Directed) -> Directed:
        return Directed(self.direction(y, self.held))

    def step(self, step_size: Any, state: Directed) -> tuple[Any, optx.RESULTS]:
        return step_size * state.direction, optx.RESULTS.successful


class Halving(optx.AbstractSearch):
    """The whole step, or half of it, and so on, until the cost goes down; a rise that is rounding is none."""

    def init(self, y: Any, f_info_struct: Any) -> Any:
        return jnp.ones((), y.dtype)

    def step(self, first_step: Any, y: Any, y_eval: Any, f_info: Any, f_eval_info: Any, state: Any) -> tuple:
        before, after = f_info.as_min(), f_eval_info.as_min()
        slack = ROUNDING * float(jnp.finfo(y.dtype).eps) * before
        accept = first_step | (after - before <= SLOPE * f_info.compute_grad_dot(y_eval - y) + slack)
        size = jnp.where(accept, jnp.ones_like(state), 0.5 * state)
        return size, accept, optx.RESULTS.successful, size


class ChainGaussNewton(optx.AbstractGaussNewton):
    """Gauss-Newton with `ChainDescent` and `Halving`."""

    rtol: float
    atol: float
    norm: Callable
    descent: optx.AbstractDescent
    search: optx.AbstractSearch
    verbose: Callable

    def __init__(self, tolerance: float, descent: ChainDescent):
        self.rtol = self.atol = tolerance
        self.norm = optx.max_norm
        self.descent = descent
        self.search = Halving()
        self.verbose = lambda **_: None


def minimise(
    residuals: Callable[[Any, Any], Any],
    direction: Callable[[Any, Any], Any],
    y: jax.Array,
    held: Any,
    tolerance: float,
    iterations: int,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Least squares from y on.

    Args:
        residuals: (y, held) -> their pytree.
        direction: (y, held) -> that of Gauss-Newton.
        y: (T + 1, n).
        held: arrays that do not move.
        tolerance: of y and of the residuals, absolute and relative.
        iterations: evaluations of the residuals at most.

    Returns:
        (y, evaluations, whether it converged).
    """
    # Whatever the way there, the optimum is the same: nothing is differentiated through the direction.
    descent = ChainDescent(eqx.filter_closure_convert(direction, y, held), held)
    descent = jax.tree.map(lambda a: jax.lax.stop_gradient(a) if eqx.is_array(a) else a, descent)
    solver = ChainGaussNewton(tolerance, descent)
    # What optimistix adds and multiplies within is not of the strict kind that this library's tests ask for.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        found = optx.least_squares(residuals, solver, y, args=held, max_steps=iterations, throw=False)
    return found.value, found.stats["num_steps"], found.result == optx.RESULTS.successful
