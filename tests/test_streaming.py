"""What a study keeps and carries from row to row, beside the same taken from whole runs at once; and its chunks."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt import chunk, metrics, mismatch, streaming, tally
from jaxfilt.loop import Added, Kept, loop
from jaxfilt.task import MEMORY, MOST, Options, task_of

RNG = np.random.default_rng(5)


# --- the loop ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("steps", "every"), [(12, 3), (13, 3), (12, 1)], ids=["groups", "a rest", "all"])
def test_a_loop_keeps_the_last_row_of_each_group_and_the_first_runs(steps, every):
    start, rows, gain = RNG.normal(size=5), RNG.normal(size=(5, steps)), RNG.normal(size=steps)

    def body(constant, carry, row):
        carry = 0.9 * carry + row[0] * row[1] + constant
        return carry, (carry, {"square": carry**2}, carry, -carry)

    outputs = (Added(), Kept(every), Kept(runs=2), Kept(every, runs=2))
    got = jax.jit(lambda *a: loop(body, 0.5, *a, runs=5, axes=(None, 0, (0, None)), outputs=outputs, backend="xla"))(
        start, (rows, gain)
    )
    states, x = [], start
    for t in range(steps):
        x = 0.9 * x + rows[:, t] * gain[t] + 0.5
        states.append(x)
    states = np.stack(states, 1)
    want = states[:, -1], (states.sum(0), {"square": states[:, every - 1 :: every] ** 2}, states[:2])
    for a, b in zip(jax.tree.leaves(got), [*jax.tree.leaves(want), -states[:2, every - 1 :: every]], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13)


# --- one row ----------------------------------------------------------------------------------------------------------


def test_the_parts_of_a_row_are_what_scores_ask_for():
    place = tally.columns(3, 2, ["gnss", "odometer"])
    values = np.arange(place.at["nees_square"].stop)
    everything = np.concatenate([values[at] for at in place.at.values()])
    np.testing.assert_array_equal(np.sort(everything), values)
    sizes = {name: len(a) for name, a in place.named(place.summed, values[place.summed]).items()}
    assert sizes | {"nis gnss": 1, "error": 3, "square": 2, "nees": 3, "covered": 3, "variance": 3} == sizes
    assert not {"normalised", "nees_square"} & set(sizes)
    assert set(place.named(place.squared, values[place.squared])) == {"error", "square", "log_score"}
    averaged = place.named(place.averaged, values[place.averaged])
    assert set(averaged) == {"square", "log_score", "nees", "covered", "normalised", "nees_square"}
    for name, a in averaged.items():
        np.testing.assert_array_equal(a, values[place.at[name]])


@pytest.mark.parametrize("block", [(0,), (1, 0), (0, 1, 2), (2,), (2, 0), (1, 2)])
def test_the_nees_of_a_block_is_that_of_its_own_covariance(block):
    A, error = RNG.normal(size=(3, 3)), RNG.normal(size=3)
    cov = A @ A.T + np.eye(3)
    index = list(block)
    want = error[index] @ np.linalg.solve(cov[np.ix_(index, index)], error[index])
    values, _ = tally.score(tally.columns(3, 1, []), (block,), jnp.asarray(error), jnp.asarray(cov), {})
    nees = values[tally.columns(3, 1, []).at["nees"]]
    np.testing.assert_allclose(nees, [error @ np.linalg.solve(cov, error), want], rtol=1e-12)


def test_lags_are_those_of_the_schedule_whatever_was_used():
    """Products of readings k apart, also where rows lie between them; what was not used counts for nothing."""
    steps, lags = 40, 3
    reads = np.arange(steps) % 3 != 0
    white = np.where((reads & (RNG.random(steps) > 0.2))[:, None], RNG.normal(size=(steps, 2)), 0.0)
    white[7, 1] = 0.0
    begin = streaming.Lags(jnp.zeros((1, lags, 2)), jnp.zeros((1, lags)), jnp.zeros((1, lags), jnp.int32))

    def body(carry, row):
        return streaming._lagged(carry, row[0][None], row[1]), None

    found, _ = jax.lax.scan(body, begin, (jnp.asarray(white), jnp.asarray(reads)))
    w = white[reads]
    for k in range(1, lags + 1):
        products = w[k:] * w[:-k]
        assert found.dots[0, k - 1] == pytest.approx(products.sum(), rel=1e-12)
        assert int(found.pairs[0, k - 1]) == (products != 0).sum() > 20


def test_the_first_fault_of_all_is_told():
    place, bad = tally.columns(1, 1, []), jf.Status.BAD_MEASUREMENT
    told = streaming.nothing(place, 2, 1, {}, np.dtype(float))
    codes = np.full((4, 2, 3), jf.Status.GATED, np.int32)
    codes[1, 0, 2], codes[1, 0, 1], codes[3, 0, 0] = jf.Status.BAD_POSTERIOR, bad, jf.Status.BAD_BELIEF
    for row in range(4):
        fault, status = streaming._first_fault(told, jnp.int32(row), jnp.asarray(codes[row]))
        told = told._replace(fault=fault, status=status)
    assert told.fault.tolist() == [1 * 3 + 1, streaming.NO_FAULT]
    assert told.status[0] == bad


# --- chunks -----------------------------------------------------------------------------------------------------------


def walk(theta):
    return jf.linear(jnp.eye(1), jnp.eye(1), theta * jnp.eye(1), jnp.eye(1))


def start(theta):
    return jf.Gaussian(jnp.zeros(1), jnp.eye(1))


def spoilt(theta):
    return mismatch.drop_outs(walk(theta), "z", 0.2)


FILTERS = {"kf": lambda theta: jf.kf(walk(theta))}


def task(steps, **options):
    log = jf.schedule(walk(1.0), steps, 1.0)
    return task_of(
        walk, FILTERS, start, log, jax.random.key(0), [(1.0, 1.0)], (False, False), Options(workers=2, **options)
    )


def test_a_chunk_is_as_large_as_memory_allows_and_shared_evenly():
    size = 10_000 * 8 * 3 + 100 * 8 * 3
    most = MEMORY // size
    assert 100 < most < MOST
    found = task(10_000, runs=10_000, corrupt=spoilt).chunk
    chunks = -(-10_000 // found)
    assert found <= most < 1.3 * found
    assert chunks % 2 == 0
    assert task(10_000, runs=3 * MOST).chunk == task(100, runs=3 * MOST).chunk == 1500
    assert task(100, runs=10).chunk == 5


def test_what_a_chunk_keeps_of_a_run_does_not_grow_with_its_rows():
    """Not one number a row; the sums over runs are not of a run."""

    def temporary(steps):
        t = task(steps, runs=500, chunk=500, examples=0, backend="xla")
        shapes = (t.theta, t.truth_theta, t.log, t.key, np.zeros(500, np.int32), np.zeros((500, 1), bool))
        leaves, structure = jax.tree.flatten(jax.eval_shape(lambda *a: a, *shapes))
        program = chunk.compiled(t.plan, t.devices, structure, tuple(leaves))
        memory: Any = program.call.memory_analysis()
        return memory.temp_size_in_bytes

    few, many = temporary(200), temporary(2000)
    assert many - few < 500 * 1800 * 4


def test_readings_that_a_corruption_leaves_alone_stay_shared():
    """Without them a sensor that all runs lack at a row would be computed there for nothing."""
    t = task(7, runs=4, corrupt=lambda theta: mismatch.bias(walk(theta), "z", jnp.ones(1)))
    own = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(0), i))(np.arange(4))
    log = jax.tree.map(jnp.asarray, t.log)
    draw, _, _, (rows, truth), (axes, _) = chunk._drawn(t.plan, walk(1.0), start(1.0), 1.0, log, own)
    assert axes.dt is None
    assert axes.z["z"] == 0
    assert rows.dt is log.dt
    x, read = draw(None, None, jax.tree.map(lambda a: a[2, 3], (rows._replace(dt=rows.dt[None].repeat(4, 0)), truth)))
    want, plain = jf.simulate(walk(1.0), start(1.0), t.log, own[2])
    np.testing.assert_allclose(x, want[3], rtol=1e-12)
    np.testing.assert_allclose(read.z["z"], plain.z["z"][3] + 1.0, rtol=1e-12)
    assert metrics.divergence_threshold(1) == t.plan.limit
