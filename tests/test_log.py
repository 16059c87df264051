"""Logs: merging against plain Python, arrival orders, held inputs, schedules, padding, alignment."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

import jaxfilt as jf


class Where(NamedTuple):
    beacon: Any
    gain: Any


def cart(std: Any = 0.5) -> jf.Model:
    """Position and velocity on a line, acceleration as input; a fix, the whole state, a scaled range to a beacon."""

    def f(x, u, dt):
        return jnp.stack([x[0] + dt * x[1] + 0.5 * dt**2 * u["a"], x[1] + dt * u["a"]])

    def Q(x, u, dt):
        return 0.3 * jnp.stack([jnp.stack([dt**3 / 3, dt**2 / 2]), jnp.stack([dt**2 / 2, dt])])

    return jf.Model(
        f,
        Q,
        jf.vector(2),
        {
            "fix": jf.Sensor(lambda x, c: x[0], lambda x, c: jnp.array([[1.0]]) * std**2, jf.scalar),
            "both": jf.Sensor(lambda x, c: x, jf.const(jnp.array([[1.0, 0.1], [0.1, 0.5]])), jf.vector(2)),
            "beacon": jf.Sensor(
                lambda x, c: jnp.stack([(x[0] - c.beacon) / c.gain]), jf.const(jnp.eye(1)), jf.vector(1)
            ),
        },
    )


CART = cart()
START = jf.Gaussian(jnp.array([0.5, -1.0]), jnp.array([[4.0, 0.5], [0.5, 2.0]]))


def recorded(seed: int = 0, epoch: float = 0.0) -> tuple[dict[str, jf.Stream], tuple]:
    """Three streams in order of time, with stamps repeated within one and between them, with gaps; and an input."""
    rng = np.random.default_rng(seed)

    def stamps(count, step):
        return epoch + np.sort(rng.integers(0, 40, count)) * step

    fix, both, beacon = stamps(25, 0.25), stamps(40, 0.125), stamps(12, 0.5)
    return {
        "fix": jf.Stream(fix, np.round(rng.normal(size=25)), valid=rng.uniform(size=25) < 0.8),
        "both": jf.Stream(both, rng.normal(size=(40, 2)), valid=rng.uniform(size=(40, 2)) < 0.7),
        "beacon": jf.Stream(beacon, np.ones((12, 1)), Where(rng.integers(0, 2, 12) * 1.0, 1 + rng.uniform(size=12))),
    }, (epoch + np.array([0.0, 2.0, 2.05, 7.0]), {"a": rng.normal(size=4)})


def shuffled(streams: dict[str, jf.Stream], seed: int) -> dict[str, jf.Stream]:
    rng = np.random.default_rng(seed)
    out = {}
    for name in rng.permutation(list(streams)):
        order = rng.permutation(len(streams[name].t))
        out[str(name)] = jax.tree.map(lambda a, order=order: a[order], streams[name])
    return out


def plainly_merged(streams: dict[str, jf.Stream]) -> dict[tuple[float, int], dict[str, tuple]]:
    """(time, repeat) -> {sensor: (z, c, valid)}: readings sorted as tuples, one after another."""
    rows: dict[tuple[float, int], dict[str, tuple]] = {}
    for name, stream in streams.items():
        readings = []
        for k in range(len(stream.t)):
            z, c = np.atleast_1d(stream.z[k]), tuple(float(a[k]) for a in stream.c)
            valid = np.broadcast_to(True if stream.valid is None else stream.valid[k], z.shape)
            readings.append((float(stream.t[k]), tuple(map(float, z)), c, tuple(map(bool, valid))))
        for t, *reading in sorted(readings):
            repeat = 0
            while name in rows.get((t, repeat), {}):
                repeat += 1
            rows.setdefault((t, repeat), {})[name] = tuple(reading)
    return dict(sorted(rows.items()))


def assert_bit_equal(a: Any, b: Any) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)


def test_merge_against_plain_python():
    streams, u = recorded()
    rows = plainly_merged(streams)
    for t in u[0]:
        rows.setdefault((float(t), 0), {})
    rows = dict(sorted(rows.items()))
    log, t = jf.merge(CART, streams, u=u)
    jf.validate(CART, log)
    np.testing.assert_array_equal(t, [time for time, _ in rows])
    assert sum(repeat > 0 for _, repeat in rows) > 10  # stamps are repeated
    assert sum(len(row) > 1 for row in rows.values()) > 5  # and shared
    for k, row in enumerate(rows.values()):
        for name in streams:
            there = np.atleast_1d(log.valid[name][k])
            if name not in row:
                assert not there.any()
                continue
            z, c, valid = row[name]
            assert np.broadcast_to(there, len(valid)).tolist() == list(valid)
            assert np.atleast_1d(log.z[name][k]).tolist() == list(z)
            assert [a[k] for a in log.c.get(name, ())] == list(c)


def test_the_order_of_arrival_does_not_matter():
    streams, u = recorded(epoch=1.7e9)
    in_order = jf.merge(CART, streams, u=u)
    for seed in range(20):
        assert_bit_equal(jf.merge(CART, shuffled(streams, seed), u=u), in_order)


def test_a_filter_over_a_merged_log_is_a_plain_loop_over_sorted_readings():
    streams, (tu, a) = recorded(3)
    log, t = jf.merge(CART, shuffled(streams, 1), u=(tu, a), start=-0.7)
    track = jax.jit(lambda log: jf.scan(jf.kf(CART), START, log))(log)

    m, P, now = np.array(START.mean), np.array(START.cov), -0.7
    rows = plainly_merged(streams)
    for time in tu:
        rows.setdefault((float(time), 0), {})
    loglik = 0.0
    H = {"fix": np.array([[1.0, 0]]), "both": np.eye(2)}
    R = {"fix": np.array([[0.25]]), "both": np.array([[1.0, 0.1], [0.1, 0.5]]), "beacon": np.eye(1)}
    for k, ((time, _), row) in enumerate(sorted(rows.items())):
        dt = time - now
        held = a["a"][max(np.flatnonzero(tu <= now).max(initial=0), 0)]
        F = np.array([[1, dt], [0, 1]])
        m = F @ m + np.array([dt**2 / 2, dt]) * held
        P = F @ P @ F.T + 0.3 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        now = time
        for name in ("fix", "both", "beacon"):
            if name not in row:
                continue
            z, c, valid = row[name]
            seen = np.flatnonzero(valid)
            if not len(seen):
                continue
            M = H.get(name, np.array([[1 / c[1], 0]]) if c else None)[seen]
            r = np.array(z)[seen] - M @ m + (c[0] / c[1] if c else 0.0)
            S = M @ P @ M.T + R[name][np.ix_(seen, seen)]
            K = P @ M.T @ np.linalg.inv(S)
            m, P = m + K @ r, P - K @ S @ K.T
            loglik += -0.5 * (r @ np.linalg.solve(S, r) + np.linalg.slogdet(2 * np.pi * S)[1])
        np.testing.assert_allclose(track.belief.mean[k], m, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(track.belief.cov[k], P, rtol=1e-10)
    assert k == len(t) - 1
    assert sum(float(info.loglik.sum()) for info in track.info.values()) == pytest.approx(loglik, rel=1e-10)


def test_an_input_is_held_from_its_stamp_to_the_next():
    fixes = (np.array([0.0, 1.0, 2.0, 3.0]), np.zeros(4))
    log, t = jf.merge(CART, {"fix": fixes}, u=(np.array([0.5, 2.0, 2.5]), {"a": np.array([1.0, 2.0, 3.0])}))
    assert t.tolist() == [0, 0.5, 1, 2, 2.5, 3]
    assert log.dt.tolist() == [0, 0.5, 0.5, 1, 0.5, 0.5]
    # of the interval that ends in the row: before the first stamp the first value, then the one last given
    assert log.u["a"].tolist() == [1, 1, 1, 1, 2, 3]
    assert log.valid["fix"].tolist() == [True, False, True, True, False, True]


def test_the_start():
    fixes = (np.array([5.0, 6.0]), np.zeros(2))
    for start, first in [(None, 0.0), (5.0, 0.0), (4.25, 0.75)]:
        log, t = jf.merge(CART, {"fix": fixes}, u=(np.array([5.5]), {"a": np.ones(1)}), start=start)
        assert log.dt[0] == first
        assert log.dt.sum() == t[-1] - (5.0 if start is None else start)


def test_what_is_always_there_has_no_mask():
    t = np.arange(5.0)
    log = jf.merge(CART, {"fix": (t, t), "both": (t[::2], np.ones((3, 2)))}).log
    assert list(log.valid) == ["both"]
    assert log.valid["both"].tolist() == [True, False, True, False, True]
    assert log.u == ()
    assert log.c == {}
    all_seen = jf.Stream(t, t, valid=np.ones(5, bool))
    assert jf.merge(CART, {"fix": all_seen}).log.valid == {}


def test_an_epoch_in_float32_keeps_microseconds():
    """Doubles at 1.7e9 s are 0.24 us apart: that, and the rounding of dt itself, is all that is lost."""
    steps = np.random.default_rng(0).integers(1_000, 20_000, 1000) * 1e-6
    t = 1.7e9 + np.cumsum(steps)
    jax.config.update("jax_enable_x64", False)
    try:
        log, back = jf.merge(CART, {"fix": (t[::-1], np.zeros(1000))})
    finally:
        jax.config.update("jax_enable_x64", True)
    assert back.dtype == np.float64
    assert {leaf.dtype for leaf in jax.tree.leaves(log)} == {np.dtype(np.float32)}
    np.testing.assert_array_equal(back, t)
    np.testing.assert_allclose(log.dt[1:], steps[1:], rtol=1e-7, atol=2.4e-7)


def test_a_stream_without_readings_is_silent():
    nothing = jf.Stream(np.zeros(0), np.zeros((0, 1)), Where(np.zeros(0), np.zeros(0)))
    log = jf.merge(CART, {"fix": (np.arange(3.0), np.zeros(3)), "beacon": nothing}).log
    jf.validate(CART, log)
    assert not log.valid["beacon"].any()
    assert log.z["beacon"].shape == (3, 1)


def test_a_row_without_a_reading_holds_a_proper_one():
    """A quaternion of zeros or a division by a gain of zero would be computed, then dropped: but not its gradient."""
    streams, u = recorded()
    log = jf.merge(CART, streams, u=u, start=-1.0).log
    assert not log.valid["beacon"].all()
    assert (log.c["beacon"].gain > 0).all()
    attitude = jf.Sensor(lambda x, c: x, jf.const(jnp.eye(3)), jf.so3)
    pose = jf.Model(lambda x, u, dt: x, jf.const(jnp.eye(3)), jf.so3, {"att": attitude})
    q = Rotation.random(4, rng=0).as_quat(scalar_first=True)
    rest = (np.arange(9.0) / 2, np.zeros((9, 1)))
    for t in (np.array([2.0, 3.0, 4.0, 4.0]), np.zeros(0)):
        log = jf.merge(pose, {"att": (t, q[: len(t)])}, u=rest).log
        np.testing.assert_allclose(np.linalg.norm(log.z["att"], axis=1), 1)
        padded = jf.stack([log, jax.tree.map(lambda a: a[:5], log)])
        np.testing.assert_allclose(np.linalg.norm(padded.z["att"], axis=2), 1)


def logs_of_unequal_length(*sensors: str) -> list[jf.Log]:
    logs = []
    for seed, until in enumerate([10.0, 4.0]):
        streams, u = recorded(seed)
        kept = {name: streams[name] for name in sensors}
        kept = {name: jax.tree.map(lambda a, early=s.t < until: a[early], s) for name, s in kept.items()}
        logs.append(jf.merge(CART, kept, u=u).log)
    logs[1].valid.pop("fix")  # there in every row of this one
    return logs


def test_padded_runs_end_where_they_end_alone():
    logs = logs_of_unequal_length("fix", "both")
    filt = jf.kf(CART)
    batch = jf.stack(logs)
    longest = max(len(log.dt) for log in logs)
    assert {leaf.shape[:2] for leaf in jax.tree.leaves(batch)} == {(2, longest)}
    tracks = jax.jit(lambda logs: jf.scan_runs(filt, START, logs))(batch)
    for k, log in enumerate(logs):
        alone = jax.jit(lambda log: jf.scan(filt, START, log))(log)
        last = len(log.dt) - 1
        for got, want in zip(jax.tree.leaves(tracks), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(got[k, : last + 1], want, rtol=1e-11, atol=1e-12)
        for leaf in jax.tree.leaves(tracks.belief):
            np.testing.assert_array_equal(leaf[k, last:], np.broadcast_to(leaf[k, last], leaf[k, last:].shape))
        for info in tracks.info.values():
            assert (info.dof[k, last + 1 :] == 0).all()
            assert (info.status[k, last + 1 :] == jf.Status.ABSENT).all()


def test_padded_runs_have_a_gradient():
    logs = jf.stack(logs_of_unequal_length("fix", "beacon"))

    @jax.jit
    @jax.value_and_grad
    def loglik(std):
        return jax.vmap(lambda log: jf.log_likelihood(jf.kf(cart(std)), START, log))(logs).sum()

    difference = (loglik(0.7 + 1e-6)[0] - loglik(0.7 - 1e-6)[0]) / 2e-6
    assert float(loglik(0.7)[1]) == pytest.approx(float(difference), rel=1e-7)


def test_stacking_masks_by_component_where_any_is():
    t = np.arange(3.0)
    z = np.ones((3, 2))
    partly = jf.merge(CART, {"both": jf.Stream(t, z, valid=np.array([[True, False]] * 3))}).log
    wholly = jf.merge(CART, {"both": (t[:2], z[:2])}).log
    batch = jf.stack([wholly, partly])
    assert batch.valid["both"].tolist() == [[[True] * 2, [True] * 2, [False] * 2], [[True, False]] * 3]
    assert batch.dt.tolist() == [[0, 1, 0], [0, 1, 1]]
    same = jf.stack([wholly, wholly])
    assert same.valid == {}


def test_schedule():
    u, where = {"a": np.arange(12.0)}, Where(np.zeros(12), np.ones(12))
    log = jf.schedule(CART, 12, 0.1, every={"fix": 3, "both": 0}, u=u, c={"beacon": where})
    jf.validate(CART, log)
    np.testing.assert_allclose(np.diff(np.r_[0, np.cumsum(log.dt)]), 0.1)
    assert set(log.z) == {"fix", "beacon"}
    assert np.flatnonzero(log.valid["fix"]).tolist() == [2, 5, 8, 11]
    assert list(log.valid) == ["fix"]
    assert log.u["a"].tolist() == u["a"].tolist()
    assert log.c["beacon"].gain.tolist() == [1] * 12
    shapes = jax.tree.map(np.shape, jf.schedule(CART, 4, 0.1).z)
    assert shapes == {"fix": (4,), "both": (4, 2), "beacon": (4, 1)}


class Pose(NamedTuple):
    pos: Any
    yaw: Any


def test_align_interpolates_across_the_seam():
    space = jf.product(Pose(jf.vector(2), jf.angle))
    truth = (np.array([10.0, 11.0, 12.0]), Pose(np.array([[0.0, 0], [2, 4], [2, 4]]), np.array([3.0, -3.0, -2.0])))
    x, mask = jf.align(np.array([9.9, 10.0, 10.25, 10.5, 11.0, 11.75, 12.0, 12.1]), truth, space)
    assert mask.tolist() == [False, True, True, True, True, True, True, False]
    np.testing.assert_allclose(x.pos[1:5], [[0, 0], [0.5, 1], [1, 2], [2, 4]])
    half = 2 * math.pi - 6
    wrapped = np.angle(np.exp(1j * np.array([3, 3 + half / 4, 3 + half / 2, -3, -2.25, -2])))
    np.testing.assert_allclose(x.yaw[1:7], wrapped, atol=1e-12)


def test_align_interpolates_rotations():
    stamps = np.cumsum(np.random.default_rng(1).uniform(0.5, 1.5, 6)) + 1.7e9
    attitudes = Rotation.random(6, rng=2)
    t = np.linspace(stamps[0], stamps[-1], 31)
    signs = np.array([1, -1, -1, 1, -1, 1])[:, None]  # q and -q are the same
    x, mask = jf.align(t, (stamps, signs * attitudes.as_quat(scalar_first=True)), jf.so3)
    assert mask.all()
    got = Rotation.from_quat(x, scalar_first=True).as_matrix()
    np.testing.assert_allclose(got, Slerp(stamps, attitudes)(t).as_matrix(), atol=1e-9)


def test_align_masks_gaps_but_not_their_ends():
    stamps = np.array([0.0, 1.0, 2.0, 7.0, 8.0])
    t = np.array([0.5, 2.0, 2.5, 6.9, 7.0, 7.5])
    assert jf.align(t, (stamps, stamps), jf.scalar, gap=1.5).mask.tolist() == [True, True, False, False, True, True]
    assert jf.align(t, (stamps, stamps), jf.scalar).mask.all()
    np.testing.assert_allclose(jf.align(t, (stamps, 2 * stamps), jf.scalar).x, 2 * t)


def test_late_stamps_are_taken_back_to_the_time_of_their_validity():
    streams, u = recorded()
    moved = streams | {"fix": streams["fix"]._replace(t=streams["fix"].t + 0.625)}
    taken_back = jf.merge(CART, moved, u=u, late={"fix": 0.625})
    in_order = jf.merge(CART, streams, u=u)
    jax.tree.map(np.testing.assert_array_equal, taken_back, in_order)
    assert not np.array_equal(jf.merge(CART, moved, u=u).t, in_order.t)


@pytest.mark.parametrize(
    ("late", "error", "words"),
    [
        ({"sonar": 0.1}, KeyError, "late: expected sensors of"),
        ({"fix": math.nan}, ValueError, r"late\['fix'\]: expected a finite number of seconds, got nan"),
        ({"fix": "0.1"}, ValueError, r"late\['fix'\]: expected a finite number"),
    ],
)
def test_a_delay_is_a_number_of_seconds_of_a_sensor(late, error, words):
    with pytest.raises(error, match=words):
        jf.merge(CART, recorded()[0], late=late)
