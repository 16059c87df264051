"""What the contestants in JAX have in common: f and h of one run, a batch under jit, a loss and its gradient."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.contestants import Entry
from benchmarks.systems import transition
from benchmarks.workloads import Problem


def functions(problem: Problem) -> tuple[Callable, Callable]:
    """f(x, u) and h(x) on arrays."""
    system, dtype = problem.system, problem.dtype
    H = system.H.astype(dtype)
    if system.linear:
        F = transition(system, np.zeros(system.n), []).astype(dtype)
        return (lambda x, u: F @ x), (lambda x: H @ x)
    seen = np.array(system.seen)
    return (lambda x, u: jnp.stack(system.f(list(x), list(u), jnp))), (lambda x: x[seen])


def noise(problem: Problem) -> tuple[jax.Array, jax.Array]:
    """Q and R."""
    return jnp.asarray(problem.system.Q, problem.dtype), jnp.asarray(problem.system.R, problem.dtype)


def logarithms(problem: Problem) -> tuple[jax.Array, jax.Array]:
    """Of the diagonals of Q and R: what the gradient is taken in."""
    Q, R = noise(problem)
    return jnp.log(jnp.diagonal(Q)), jnp.log(jnp.diagonal(R))


def filtered(batch: Callable, arrays: tuple, note: str = "") -> Entry:
    """``batch(*arrays)`` -> means, variances (N, T, n), under jit."""
    program, arrays = jax.jit(batch), jax.device_put(arrays)

    def fetch(found: Any, k: int) -> tuple:
        return np.asarray(found[0][:k]), np.asarray(found[1][:k])

    return Entry(lambda: jax.block_until_ready(program(*arrays)), fetch, note=note)


def differentiated(problem: Problem, means: Callable, arrays: tuple, note: str = "") -> Entry:
    """Reverse mode through ``means(q, r, *arrays)`` -> (N, T, n), q and r the diagonals of Q and R."""

    def loss(at: tuple, truth: jax.Array, *arrays: jax.Array) -> jax.Array:
        return ((means(jnp.exp(at[0]), jnp.exp(at[1]), *arrays) - truth) ** 2).sum()

    program = jax.jit(jax.value_and_grad(loss))
    at, arrays = logarithms(problem), jax.device_put((problem.truth, *arrays))

    def fetch(found: Any, k: int) -> tuple:
        return float(found[0]), np.concatenate([np.asarray(part) for part in found[1]])

    return Entry(lambda: jax.block_until_ready(program(at, *arrays)), fetch, note=note)
