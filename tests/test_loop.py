"""The loop over many runs: both back ends do the same, `jax.vmap` of `jax.lax.scan`, derivatives included."""

import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt import loop as loops
from jaxfilt.lanes import Unsupported
from jaxfilt.lanes.batch import Parts
from jaxfilt.lanes.trace import Stored, program, traced
from jaxfilt.loop import Added, Kept, loop
from jaxfilt.scenarios import scenario

pytest.importorskip("llvmlite")
KEY = jax.random.key(3)


def swing(g, carry, row):
    """A body with what bodies have: a symmetric matrix, an integer, a flag, a mask, a constant of the run."""
    x, P, count, seen = carry
    u, there = row
    x = jnp.stack([x[0] + 0.1 * x[1], x[1] - 0.1 * g * jnp.sin(x[0]) + u[0]])
    F = jnp.array([[1.0, 0.1], [0.0, 1.0]], x.dtype) * jnp.cos(x[0])
    P = F @ P @ F.T + jnp.eye(2, dtype=x.dtype)
    P = jax.lax.cond(there, lambda P: P - jnp.outer(P[:, 0], P[0]) / (P[0, 0] + 1.0), lambda P: P, P)
    P = jnp.tril(P) + jnp.tril(P, -1).T
    carry = (x, P, count + there.astype(jnp.int32), seen | there)
    return carry, ({"x": x, "P": P}, jnp.square(x), there)


def case(runs, steps=7, dtype=jnp.float64, seed=0):
    keys = jax.random.split(jax.random.fold_in(KEY, seed), 4)
    start = (
        jax.random.normal(keys[0], (runs, 2), dtype),
        jnp.eye(2, dtype=dtype) * 2,
        jnp.int32(0),
        jnp.array(False),
    )
    rows = (jax.random.normal(keys[1], (runs, steps, 1), dtype), jax.random.bernoulli(keys[2], 0.6, (runs, steps)))
    g = jnp.linspace(0.5, 2.0, runs, dtype=dtype)
    return g, start, rows


AXES = (0, (0, None, None, None), (0, 0))
OUTPUTS = [Kept(), Added(), Added()]


def both(body, arguments, **options):
    runs = options.pop("runs")
    return [
        jax.jit(lambda *a, b=b: loop(body, *a, runs=runs, backend=b, **options))(*arguments) for b in ("lanes", "xla")
    ]


def assert_same(ours, theirs, rtol):
    assert jax.tree.structure(ours) == jax.tree.structure(theirs)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert a.shape == b.shape
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol)


@pytest.mark.parametrize("runs", [1, 3, 4, 37])
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_lanes_are_vmap_of_scan(runs, dtype):
    ours, theirs = both(swing, case(runs, dtype=dtype), runs=runs, axes=AXES, outputs=OUTPUTS)
    assert_same(ours, theirs, 1e-12 if dtype == jnp.float64 else 2e-5)


def test_a_mask_that_all_runs_share():
    g, start, (u, there) = case(9)
    ours, theirs = both(
        swing, (g, start, (u, there[0])), runs=9, axes=(0, (0, None, None, None), (0, None)), outputs=OUTPUTS
    )
    assert_same(ours, theirs, 1e-12)
    assert ours[0][2].dtype == jnp.int32


@pytest.mark.parametrize(("every", "few"), [(1, 2), (3, None), (3, 2), (7, 100)])
def test_what_is_kept_of_some_rows_and_runs(every, few):
    outputs = [Kept(every, few), Kept(), Added()]
    ours, theirs = both(swing, case(6), runs=6, axes=AXES, outputs=outputs)
    assert ours[1][0]["P"].shape == (min(few or 6, 6), 7 // every, 2, 2)
    assert_same(ours, theirs, 1e-12)


def test_what_a_body_closes_over_is_an_input_inside_jit():
    def scaled(a, backend):
        def body(_, x, row):
            return a * jnp.sin(x) + row, (x,)

        return loop(body, (), jnp.ones(5), jnp.ones(4), runs=5, axes=(None, 0, None), outputs=[Kept()], backend=backend)

    compiled = jax.jit(scaled, static_argnums=1)
    for a in (0.3, 0.7):
        assert_same(compiled(a, "lanes"), compiled(a, "xla"), 1e-14)


def test_random_keys_are_rows_and_carried():
    def body(_, key, row):
        key, own = jax.random.split(key)
        return key, (jax.random.normal(row, (3,)), jax.random.uniform(own), jax.random.bits(own))

    keys = jax.random.split(KEY, 6)
    rows = jax.vmap(lambda k: jax.random.split(k, 5))(keys)
    ours, theirs = both(body, ((), keys, rows), runs=6, axes=(None, 0, 0), outputs=[Kept(), Kept(), Kept()])
    assert (jax.random.key_data(ours[0]) == jax.random.key_data(theirs[0])).all()
    assert (ours[1][2] == theirs[1][2]).all()
    assert (ours[1][1] == theirs[1][1]).all()
    np.testing.assert_allclose(ours[1][0], theirs[1][0], rtol=1e-14, atol=1e-15)


# What a run breaks of what the fast program takes for granted.


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["start", "row", "constant"])
def test_a_run_that_is_not_finite_ends_as_in_jax_and_harms_no_other(bad, where):
    g, start, (u, there) = case(10)
    if where == "start":
        start = (start[0].at[4, 0].set(bad), *start[1:])
    elif where == "row":
        u = u.at[4, 3].set(bad)
    else:
        g = g.at[4].set(bad)
    ours, theirs = both(swing, (g, start, (u, there)), runs=10, axes=AXES, outputs=OUTPUTS)
    assert not np.isfinite(theirs[1][0]["P"][4]).all()
    assert_same(ours, theirs, 1e-12)


def test_zero_times_what_is_not_finite_is_not_zero():
    def body(_, carry, row):
        y = jax.jvp(lambda x: jnp.stack([x * row, row]), (carry,), (jnp.zeros(()),))[1]
        return carry * 0.5, (y,)

    rows = jnp.ones((5, 4)).at[2, 1].set(jnp.inf).at[3, 3].set(jnp.nan)
    ours, theirs = both(body, ((), jnp.ones(5), rows), runs=5, axes=(None, 0, 0), outputs=[Kept()])
    assert np.isnan(theirs[1][0][2, 1, 0])
    assert_same(ours, theirs, 0)


def test_zero_times_what_is_not_finite_in_the_very_last_row():
    """What would be seen only in the row after it, had there been one."""

    def body(_, carry, row):
        before, total = carry
        product, nothing = jax.jvp(lambda x: row * row * x, (jnp.ones(()),), (jnp.zeros(()),))
        return (product, total + before), (nothing,)

    rows = jnp.ones((5, 4)).at[2, 3].set(jnp.inf)
    start = (jnp.ones(5), jnp.zeros(5))
    ours, theirs = both(body, ((), start, rows), runs=5, axes=(None, 0, 0), outputs=[Kept()])
    assert np.isnan(theirs[1][0][2, 3])
    assert_same(ours, theirs, 0)


def test_equal_and_constant_numbers_of_the_carry_are_found():
    def body(constants, carry, row):
        (P, c), (F,) = carry, row
        P = F @ P @ F.T
        return [jnp.tril(P) + jnp.tril(P, -1).T, jnp.full_like(c, 2.0)], [P[0]]

    matrix, number = jax.ShapeDtypeStruct((3, 3), jnp.float64), jax.ShapeDtypeStruct((), jnp.float64)
    avals, shared = Parts([], [matrix], [matrix, number]), Parts([], [False], [False, False])
    made = [program(traced(body, avals, [Stored()]), shared, False, strict)[0] for strict in (False, True)]
    assert [made[0].leaves[k].slots for k in (0, 1)] == [(0, 1, 2, 1, 3, 4, 2, 4, 5), (-1,)]
    assert made[0].leaves[1].constants == (2.0,)
    assert [made[1].leaves[k].slots for k in (0, 1)] == [tuple(range(9)), (9,)]


def test_a_start_that_is_not_symmetric_is_not_taken_for_it():
    def body(_, P, row):
        P = 0.5 * (P + P.T) * row
        return P, (P,)

    P = jnp.stack([jnp.eye(2), jnp.array([[1.0, 0.5], [0.0, 1.0]]), jnp.eye(2)])
    first = jnp.ones((3, 2))
    ours, theirs = both(body, ((), P, first), runs=3, axes=(None, 0, 0), outputs=[Kept()])
    assert_same(ours, theirs, 1e-15)

    def kept(_, P, row):
        return P * row, (P,)

    ours, theirs = both(kept, ((), P, first), runs=3, axes=(None, 0, 0), outputs=[Kept()])
    assert_same(ours, theirs, 0)


def test_a_number_that_becomes_constant_counts_from_its_start():
    def body(_, carry, row):
        x, c = carry
        return (x + c, jnp.full_like(c, 2.0)), (x,)

    start = (jnp.zeros(4), jnp.array([2.0, 2.0, 7.0, 2.0]))
    ours, theirs = both(body, ((), start, jnp.ones((4, 3))), runs=4, axes=(None, 0, 0), outputs=[Kept()])
    assert float(theirs[1][0][2, 1]) == 7.0
    assert_same(ours, theirs, 0)


# Derivatives.


def loss(arguments, backend, runs):
    (x, P, *_), (kept, added, _) = loop(swing, *arguments, runs=runs, axes=AXES, outputs=OUTPUTS, backend=backend)
    return jnp.sin(kept["x"]).sum() + (kept["P"] ** 2).mean() + (added**2).sum() + (x * x).sum() + jnp.trace(P.sum(0))


def of_floats(function, arguments):
    """A function of the float leaves alone, and those."""
    leaves, form = jax.tree.flatten(arguments)
    floats = [k for k, a in enumerate(leaves) if jnp.issubdtype(a.dtype, jnp.floating)]

    def of(values):
        full = list(leaves)
        for k, v in zip(floats, values, strict=True):
            full[k] = v
        return function(jax.tree.unflatten(form, full))

    return of, [leaves[k] for k in floats]


@pytest.mark.parametrize("runs", [1, 6, 40])
def test_reverse_mode(runs):
    found = []
    for backend in ("lanes", "xla"):
        of, values = of_floats(lambda a, b=backend: loss(a, b, runs), case(runs))
        found.append(jax.jit(jax.value_and_grad(of))(values))
    assert_same(*found, 1e-11)


def test_reverse_mode_of_shared_rows_and_of_a_closed_over_number():
    g, start, (u, there) = case(6)

    def of(a, row, start, backend):
        def body(g, carry, row):
            carry, found = swing(g * a, carry, row)
            return carry, found[:1]

        axes = (None, (0, None, None, None), (None, None))
        carry, (kept,) = loop(body, g[0], start, (row, there[0]), runs=6, axes=axes, outputs=[Kept()], backend=backend)
        return (kept["P"] * kept["x"][..., None]).sum() + carry[0].sum()

    gradients = [
        jax.jit(jax.grad(lambda a, row, x, b=b: of(a, row, (x, *start[1:]), b), (0, 1, 2)))(1.3, u[0], start[0])
        for b in ("lanes", "xla")
    ]
    assert_same(*gradients, 1e-11)


def test_forward_mode_and_its_batch():
    of = {b: of_floats(lambda a, b=b: loss(a, b, 5), case(5))[0] for b in ("lanes", "xla")}
    values = of_floats(None, case(5))[1]
    tangents = jax.tree.map(lambda a: jnp.cos(jnp.arange(a.size, dtype=a.dtype)).reshape(a.shape), values)
    assert_same(*(jax.jvp(of[b], (values,), (tangents,)) for b in of), 1e-11)
    jacobians = [jax.jit(jax.jacfwd(lambda g, b=b: of[b]([g, *values[1:]])))(values[0]) for b in of]
    assert_same(*jacobians, 1e-11)


def test_second_derivatives_are_refused_with_the_way_out():
    of, values = of_floats(lambda a: loss(a, "lanes", 2), case(2))
    with pytest.raises(NotImplementedError, match="backend='xla' has second derivatives"):
        jax.hessian(lambda g: of([g, *values[1:]]))(values[0])


def test_a_batch_of_gradients():
    of = {b: of_floats(lambda a, b=b: loss(a, b, 5), case(5))[0] for b in ("lanes", "xla")}
    values = of_floats(None, case(5))[1]
    scale = jnp.array([0.9, 1.0, 1.2])
    gradients = [jax.jit(jax.vmap(jax.grad(lambda s, b=b: of[b]([s * values[0], *values[1:]]))))(scale) for b in of]
    assert_same(*gradients, 1e-11)


def test_the_gradient_of_a_run_that_breaks_an_assumption():
    g, start, (u, there) = case(6)
    P = jnp.tile(start[1], (6, 1, 1)).at[2, 0, 1].set(0.3)  # not symmetric
    axes = (0, (0, 0, None, None), (0, 0))

    def of(g, P, u, backend):
        carry, (kept, *_) = loop(
            swing, g, (start[0], P, *start[2:]), (u, there), runs=6, axes=axes, outputs=OUTPUTS, backend=backend
        )
        return (kept["P"] ** 2).sum() + carry[0].sum()

    for rows in (u, u.at[4, 2].set(jnp.inf)):
        gradients = [jax.jit(jax.grad(lambda *a, b=b: of(*a, b), (0, 1)))(g, P, rows) for b in ("lanes", "xla")]
        assert_same(*gradients, 1e-11)
    assert np.isnan(gradients[1][0][4])


# Which back end.


def cumulated(backend, body=None, runs=300, steps=100):
    body = body or (lambda _, x, row: (x + row, (x,)))
    return loop(
        body, (), jnp.zeros(runs), jnp.ones((runs, steps)), runs=runs, axes=(None, 0, 0), outputs=[Kept()],
        backend=backend,
    )  # fmt: skip


def test_an_unknown_back_end_is_refused():
    with pytest.raises(ValueError, match="backend: expected 'auto', 'xla' or 'lanes', got 'gpu'"):
        cumulated("gpu")


def test_lanes_without_llvmlite(monkeypatch, caplog):
    monkeypatch.setattr(loops.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"llvmlite is not installed; pip install 'jaxfilt\[fast\]'"):
        cumulated("lanes")
    loops._say.cache_clear()
    with caplog.at_level(logging.WARNING, "jaxfilt"):
        for _ in range(2):
            cumulated("auto")
    assert [r.message for r in caplog.records] == [
        "computed by XLA, not by compiled lanes: llvmlite is not installed; pip install 'jaxfilt[fast]'"
    ]


def test_what_lanes_cannot_compute_is_named_and_computed_by_xla(caplog):
    def body(_, x, row):
        return x + jnp.linalg.svd(jnp.eye(2) * row)[1][0], (x,)

    with pytest.raises(Unsupported, match="svd"):
        cumulated("lanes", body)
    loops._say.cache_clear()
    with caplog.at_level(logging.WARNING, "jaxfilt"):
        _, (kept,) = cumulated("auto", body)
    np.testing.assert_allclose(kept[:, -1], 99.0)
    assert len(caplog.records) == 1
    assert "svd" in caplog.records[0].message
    assert __file__ in caplog.records[0].message


def test_auto_leaves_a_huge_row_to_xla(monkeypatch, caplog):
    def body(_, x, row):
        return x + jnp.sin(row), (x,)

    monkeypatch.setattr(loops, "LARGEST", 20)
    loops._say.cache_clear()
    with caplog.at_level(logging.WARNING, "jaxfilt"):
        _, (kept,) = cumulated("auto", body)
    np.testing.assert_allclose(kept[:, -1], 99 * np.sin(1.0))
    assert "more than the 20 that pay" in caplog.records[0].message
    assert cumulated("lanes", body)[1][0].shape == (300, 100)


def test_auto_leaves_small_work_to_xla(monkeypatch):
    def never(*_):
        raise AssertionError("compiled")

    monkeypatch.setattr(loops, "_lanes", never)
    cumulated("auto", runs=10, steps=10)
    with pytest.raises(AssertionError, match="compiled"):
        cumulated("auto")


def test_a_carry_that_changes_is_refused():
    def body(_, x, row):
        return x.astype(jnp.float32), (row,)

    with pytest.raises(TypeError, match=r"carry: expected float64\[\] after a row as before it"):
        cumulated("lanes", body)


# Filters.


@pytest.mark.parametrize("build", [jf.ekf, jf.ukf, jf.ckf, lambda m: jf.iekf(m, 2), lambda m: jf.ekf(m, gate=0.9)])
def test_a_filter_of_a_car_with_masks_and_reports(build):
    robot = scenario("car")
    model, start, log = robot.model(robot.theta), robot.belief(robot.theta), robot.schedule(12)
    runs = jax.vmap(lambda k: jf.simulate(model, start, log, k))(jax.random.split(KEY, 6)).log
    name = next(iter(model.sensors))
    lost = jax.random.bernoulli(KEY, 0.5, (6, 12))
    runs = runs._replace(dt=log.dt, u=log.u, c=log.c, valid={**runs.valid, name: lost})
    shared = log._replace(z=runs.z, valid=log.valid)
    for logs, batched in ((shared, ("z",)), (runs._replace(dt=runs.dt), ("z", "valid"))):
        found = [
            jax.jit(lambda logs, b=b, k=batched: jf.scan_runs(build(model), start, logs, k, backend=b))(logs)
            for b in ("lanes", "xla")
        ]
        assert_same(*found, 1e-9)
