"""All that a study computes in a row, of every scenario, lowers to scalars, and to the same numbers."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt import metrics
from jaxfilt.scenarios import SCENARIOS
from tests.graphs import size
from tests.lowering import evaluated, lowered

LARGEST = 100_000
"""Operations of a row: more would not be compiled in a reasonable time."""

TOO_LARGE = {"inertial"}
"""20 states and seven sensors in one row: left to XLA by "auto"."""


def _row(name: str, build: Callable) -> tuple[Callable, list[np.ndarray]]:
    """A row as a function of flat arrays: simulate, filter, score; and its arguments, one lane."""
    scenario = SCENARIOS[name]()
    theta = jax.tree.map(jnp.asarray, scenario.theta)
    model, belief = scenario.model(theta), jax.tree.map(jnp.asarray, scenario.belief(theta))
    log = jax.tree.map(jnp.asarray, scenario.schedule(1))
    blocks = tuple(indices for indices, _ in scenario.blocks.values())
    leaves, tree = jax.tree.flatten((belief, log, jnp.asarray([3, 5], jnp.uint32)))

    def row(*leaves: jax.Array) -> Any:
        belief, log, words = jax.tree.unflatten(tree, leaves)
        truth, log = jf.simulate(model, belief, log, jax.random.wrap_key_data(words), scenario.control)
        truth, log = jax.tree.map(lambda a: a[0], (truth, log))
        belief, info = build(model).step(belief, log)
        error = model.space.minus(truth, belief.mean)
        by_block = [metrics.nees(error[b,], belief.cov[np.ix_(b, b)]) for b in blocks]
        return belief, info, error, by_block, [metrics.used(i) for i in info.values()]

    return row, [np.asarray(leaf)[None] for leaf in leaves]


def _compared(function: Callable, args: list[np.ndarray], tolerance: float) -> None:
    graph, nodes = lowered(function, *args, strict=False)
    got = evaluated(graph, nodes, *args)
    want = jax.tree.leaves(jax.jit(function)(*(a[0] for a in args)))
    for ours, theirs in zip(got, want, strict=True):
        scale = np.max(np.abs(theirs), initial=1e-9)
        np.testing.assert_allclose(ours[0], theirs, rtol=tolerance, atol=tolerance * float(scale))


@pytest.mark.long
@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_lowers(name: str) -> None:
    function, args = _row(name, jf.ekf)
    graph, nodes = lowered(function, *args, strict=False)
    operations = size(graph, [int(node) for a in nodes for node in a.ravel()])
    print(f"{name}: {operations} operations")
    assert operations > 0
    assert (operations > LARGEST) == (name in TOO_LARGE)


@pytest.mark.parametrize(
    ("name", "build"),
    [("lti", jf.kf), ("car", jf.ekf), ("pendulum", jf.iekf), ("pendulum", jf.ukf), ("pendulum", jf.ckf)],
)
def test_every_filter_gives_the_numbers_of_jax(name: str, build: Callable) -> None:
    _compared(*_row(name, build), tolerance=1e-8)


def test_the_gradient_of_a_step() -> None:
    scenario = SCENARIOS["car"]()
    row = jax.tree.map(lambda a: jnp.asarray(a[0]), scenario.schedule(1))
    leaves, tree = jax.tree.flatten(scenario.theta)

    def gradient(*leaves: jax.Array) -> list[jax.Array]:
        def loss(leaves: tuple) -> jax.Array:
            theta = jax.tree.unflatten(tree, leaves)
            belief, info = jf.ekf(scenario.model(theta)).step(scenario.belief(theta), row)
            return jnp.trace(belief.cov) + sum(i.loglik for i in info.values())

        return list(jax.grad(loss)(leaves))

    _compared(gradient, [np.asarray([leaf]) for leaf in leaves], tolerance=1e-9)
