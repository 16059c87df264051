"""Late readings: the answer is that of the readings in order, bit for bit, and of a recording merged afterwards."""

import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf


class Cart(NamedTuple):
    pos: jax.Array
    yaw: jax.Array


def rolled(x, u, dt):
    speed, rate = u
    return Cart(x.pos + dt * speed * jnp.stack([jnp.cos(x.yaw), jnp.sin(x.yaw)]), x.yaw + dt * rate)


MODEL = jf.Model(
    rolled,
    jf.white(0.1 * jnp.eye(3)),
    jf.product(Cart(jf.vector(2), jf.angle)),
    {
        "fix": jf.Sensor(lambda x, c: x.pos, jf.const(jnp.eye(2)), jf.vector(2)),
        "north": jf.Sensor(lambda x, c: x.yaw - c, jf.const(0.01 * jnp.eye(1)), jf.angle),
    },
)
OFFSET = np.array(0.3)
START = jf.Gaussian(Cart(jnp.zeros(2), jnp.array(0.0)), jnp.eye(3))
STILL = (np.array(0.0), np.array(0.0))


def events(seed=0, count=24):
    """(t, z, c, u) in order of time: odometry, fixes and compass readings, some of one instant."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(count):
        t = 0.25 * k
        out.append((t, None, None, tuple(np.asarray(a) for a in rng.normal(size=2))))
        if k % 3 == 1:
            out.append((t, {"fix": 3 * rng.normal(size=2)}, None, None))
        if k % 2 == 1:
            out.append((t + 0.125 * (k % 4 == 3), {"north": np.asarray(rng.normal())}, {"north": OFFSET}, None))
    return out


@functools.cache
def online(rows):
    """The filter that keeps so many rows, compiled once for each set of sensors."""
    plain = jf.out_of_sequence(jf.ekf(MODEL), rows, u=STILL, c={"north": OFFSET})
    return plain._replace(arrive=jax.jit(plain.arrive))


def arrived(online, sequence):
    backlog = online.begin(START, 0.0)
    for event in sequence:
        backlog, arrival = online.arrive(backlog, *event)
        assert arrival.taken
    return arrival.belief


def late(sequence, seed, most=6):
    """Each event delayed by up to so many places, at random."""
    rng = np.random.default_rng(seed)
    return [sequence[k] for k in np.argsort(np.arange(len(sequence)) + rng.uniform(0, most, len(sequence)))]


def same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize("seed", range(3))
def test_late_readings_and_inputs_give_the_answer_in_order_exactly(seed):
    sequence = events(seed)
    shuffled = late(sequence, seed)
    assert [e[0] for e in shuffled] != sorted(e[0] for e in sequence)
    same(arrived(online(20), shuffled), arrived(online(20), sequence))


def test_equals_the_recording_merged_afterwards():
    sequence = events()
    streams = {}
    for name in MODEL.sensors:
        hits = [(t, z[name], c) for t, z, c, _ in sequence if z and name in z]
        t, z = (np.array(column) for column in list(zip(*hits, strict=True))[:2])
        streams[name] = (t, z, np.tile(OFFSET, len(t))) if name == "north" else (t, z)
    turned = [(t, u) for t, _, _, u in sequence if u is not None]
    u = np.array([t for t, _ in turned]), jax.tree.map(lambda *a: np.stack(a), *[u for _, u in turned])
    recording = jf.merge(MODEL, streams, u=u, start=0.0)
    merged = jf.scan(jf.ekf(MODEL), START, recording.log).belief
    belief = arrived(online(20), late(sequence, 1))
    for a, b in zip(jax.tree.leaves(belief), jax.tree.leaves(merged), strict=True):
        np.testing.assert_allclose(a, b[-1], rtol=1e-10, atol=1e-12)


def test_the_order_of_sensors_within_an_instant_is_the_models():
    fix, north = (2.0, {"fix": np.ones(2)}, None, None), (2.0, {"north": np.array(1.0)}, {"north": OFFSET}, None)
    same(arrived(online(4), [fix, north]), arrived(online(4), [north, fix]))


def test_what_is_too_late_changes_nothing_and_says_so():
    backlog, arrive = online(3).begin(START, 0.0), online(3).arrive
    for t in (1.0, 2.0, 3.0, 4.0):
        backlog, arrival = arrive(backlog, t, {"fix": np.full(2, t)})
    before = arrival.belief
    backlog, arrival = arrive(backlog, 1.5, {"fix": np.full(2, 50.0)})
    assert not arrival.taken
    same(arrival.belief, before)
    backlog, arrival = arrive(backlog, 3.5, {"fix": np.full(2, 50.0)})
    assert arrival.taken
    assert (arrival.belief.mean.pos != before.mean.pos).any()


def test_all_orders_of_four_readings_agree():
    readings = [(t, {"fix": np.full(2, t)}, None, None) for t in (0.5, 1.0, 1.5, 2.0)]
    answers = [arrived(online(4), order) for order in itertools.permutations(readings)]
    for answer in answers[1:]:
        same(answer, answers[0])


def test_the_report_is_of_the_reading_that_came():
    backlog = online(4).begin(START, 0.0)
    backlog, _ = online(4).arrive(backlog, 2.0, {"fix": np.zeros(2)})
    _, late_one = online(4).arrive(backlog, 1.0, {"fix": np.array([5.0, 0.0])})
    alone = jf.ekf(MODEL)
    _, info = alone.update(alone.predict(START, jax.tree.map(jnp.asarray, STILL), 1.0), jnp.array([5.0, 0.0]), "fix")
    np.testing.assert_allclose(late_one.info["fix"].innovation, info.innovation, rtol=1e-12)
    assert list(late_one.info) == ["fix"]


def test_it_vmaps_and_differentiates():
    @jax.jit
    def last(scale, fix):
        step = jf.out_of_sequence(jf.ekf(MODEL), 3, u=STILL, c={"north": OFFSET})
        backlog = step.begin(START._replace(cov=scale * START.cov), 0.0)
        for t in (2.0, 1.0):
            backlog, arrival = step.arrive(backlog, t, {"fix": fix * t})
        return arrival.belief.mean.pos.sum()

    fixes = jnp.arange(4.0).reshape(2, 2)
    both = jax.jit(jax.vmap(last, (None, 0)))(1.0, fixes)
    np.testing.assert_allclose(both, [last(1.0, f) for f in fixes], rtol=1e-12)
    slope = (last(1.0 + 1e-5, fixes[1]) - last(1.0 - 1e-5, fixes[1])) / 2e-5
    np.testing.assert_allclose(jax.jit(jax.grad(last))(1.0, fixes[1]), slope, rtol=1e-6)


@pytest.mark.parametrize(
    ("event", "error", "words"),
    [
        ((1.0, {"gps": np.zeros(3)}), KeyError, "gps"),
        ((1.0, {"fix": np.zeros(3)}), ValueError, r"z\['fix'\]: expected shapes \(2,\), got \(3,\)"),
        ((1.0, {"north": np.array(0.0)}), ValueError, "c: expected the context of 'north'"),
        ((1.0, None, {"north": OFFSET}), KeyError, "c: expected contexts of"),
        ((1.0, None, None, np.zeros(3)), ValueError, "u: "),
    ],
)
def test_wrong_arrivals_raise(event, error, words):
    with pytest.raises(error, match=words):
        online(4).arrive(online(4).begin(START), *event)


@pytest.mark.parametrize(
    ("event", "words"),
    [((1.0, {"fix": np.full(2, np.nan)}), r"z\['fix'\]"), ((np.nan, {"fix": np.zeros(2)}), "t: ")],
)
def test_values_are_checked_where_they_can_be_seen(event, words):
    plain = jf.out_of_sequence(jf.ekf(MODEL), 3, u=STILL, c={"north": OFFSET})
    with pytest.raises(ValueError, match=words):
        plain.arrive(plain.begin(START), *event)


@pytest.mark.parametrize("rows", [0, -1, 2.5, True])
def test_the_number_of_rows_is_a_whole_number(rows):
    with pytest.raises(ValueError, match="rows: expected a whole number of at least 1"):
        jf.out_of_sequence(jf.ekf(MODEL), rows)


def test_an_input_stays_in_force_when_its_row_is_no_longer_kept():
    turned = (0.5, None, None, (np.array(2.0), np.array(0.3)))
    fixes = [(t, {"fix": np.full(2, t)}, None, None) for t in np.arange(1.0, 7.0)]
    same(arrived(online(4), [turned, *fixes]), arrived(online(20), [turned, *fixes]))
