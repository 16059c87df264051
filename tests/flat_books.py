"""Books of systems whose state is one flat vector and that have one sensor: see `oracles`.

Their Jacobians are central differences of the book's own functions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from oracles import Book, BookSensor, Result, filters, loop, no_carry, rows_of

import jaxfilt as jf


def book(f: Callable, h: Callable, Q: Any, R: Any, name: str, angles: tuple[int, ...] = (), scale: Any = 1.0) -> Book:
    """``f(x, u, dt)``, ``Q(dt)``, ``h(x, c)``, R (m, m); which readings are angles; scale: of x, for differences."""

    def minus(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        d = a - b
        for i in angles:
            d[i] = np.angle(np.exp(1j * d[i]))
        return d

    def slope(g: Callable, x: np.ndarray, subtract: Callable) -> np.ndarray:
        E = np.diag(1e-5 * scale * np.ones(len(x)))
        return np.stack([subtract(g(x + e), g(x - e)) / (2 * e.sum()) for e in E], axis=1)

    def read(z: Any, k: int) -> np.ndarray:
        return np.concatenate([np.atleast_1d(leaf[k]) for leaf in jax.tree.leaves(z)])

    sensor = BookSensor(
        h, lambda x, c: slope(lambda y: h(y, c), x, minus), lambda x, c: R, lambda z, d: z + d, minus, read
    )

    def F(x: np.ndarray, u: Any, dt: float) -> np.ndarray:
        return slope(lambda y: f(y, u, dt), x, np.subtract)

    return Book(f, F, lambda x, u, dt: Q(dt), np.add, np.subtract, no_carry, {name: sensor})


def flat(x: Any) -> np.ndarray:
    """Points with a leading axis T as vectors (T, n)."""
    return np.concatenate([np.asarray(a).reshape(len(a), -1) for a in jax.tree.leaves(x)], axis=1)


def both(scenario: jf.Scenario, book: Book, filter: str, steps: int, seed: int = 0) -> tuple[jf.Gaussian, Result]:
    """The beliefs of jaxfilt's filter and of the book's loop, on the same simulated readings."""
    make = {"ekf": jf.ekf, "ukf 1.0": jf.ukf, "ckf": jf.ckf}[filter]

    @jax.jit
    def run(key):
        model, belief = scenario.model(scenario.theta), scenario.belief(scenario.theta)
        log = jf.simulate(model, belief, scenario.schedule(steps), key).log
        return belief, log, jf.scan(make(model), belief, log).belief

    start, log, got = jax.tree.map(np.asarray, run(jax.random.key(seed)))
    x = flat(jax.tree.map(lambda a: a[None], start.mean))[0]
    return got, loop(book, x, start.cov, rows_of(log, book), *filters()[filter])


def assert_same(got: jf.Gaussian, want: Result, rtol: float) -> None:
    """Means and covariances agree, each measured by the standard deviations."""
    std = np.sqrt(np.einsum("tii->ti", want.covs))
    assert (np.abs(flat(got.mean) - np.stack(want.means)) / std).max() < rtol
    assert (np.abs(got.cov - want.covs) / (std[:, :, None] * std[:, None, :])).max() < rtol
