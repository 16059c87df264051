"""Laws of the filters: what must hold whatever the numbers."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2, kstest
from systems import CAR, SYSTEMS, Car, car_model, correlation, scaled

import jaxfilt as jf

system = functools.cache(lambda name: SYSTEMS[name]())


# --- scale -------------------------------------------------------------------------------------------------------

SCALED = [("linear", jf.kf), ("car", jf.ekf), ("car", jf.iekf)]


@pytest.fixture(scope="module", params=SCALED, ids=lambda case: f"{case[0]} {case[1].__name__}")
def at_scale(request):
    """Function of s: the track with P0, Q and R multiplied by s, for filters whose gains do not depend on it."""
    name, factory = request.param
    s = system(name)

    @jax.jit
    def run(scale):
        belief = jf.Gaussian(jax.tree.map(jnp.asarray, s.belief.mean), scale * jnp.asarray(s.belief.cov))
        return jf.scan(factory(scaled(s.model(s.theta), scale)), belief, jax.tree.map(jnp.asarray, s.log))

    return run


def test_a_power_of_two_scales_the_covariances_and_moves_no_mean_by_a_bit(at_scale):
    a, b = at_scale(1.0), at_scale(2.0**-40)
    jax.tree.map(np.testing.assert_array_equal, a.belief.mean, b.belief.mean)
    np.testing.assert_array_equal(2.0**-40 * a.belief.cov, b.belief.cov)
    for name, info in a.info.items():
        whole = np.asarray(info.dof) == info.S.shape[-1]
        np.testing.assert_array_equal(2.0**-40 * info.S[whole], b.info[name].S[whole])


def test_a_factor_of_1e_12_does_so_to_rounding(at_scale):
    a, b = at_scale(1.0), at_scale(1e-12)
    for x, y in zip(jax.tree.leaves(a.belief.mean), jax.tree.leaves(b.belief.mean), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(1e-12 * a.belief.cov, b.belief.cov, rtol=1e-9, atol=1e-24)


# --- rows --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def car():
    """The car's EKF with its functions jitted, as they are used by hand, and its scan."""
    s = system("car")
    filt = jf.ekf(s.model(s.theta))
    step, update = jax.jit(filt.step), jax.jit(filt.update, static_argnames="sensor")
    track = jax.jit(lambda b, log: jf.scan(filt, b, log))(s.belief, s.log)
    return s, filt, jax.jit(filt.predict), update, step, track


def close(a, b, rtol=1e-11):
    """Equal to rounding: two programs may fuse the same sums differently."""
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=rtol, atol=1e-12)


def row_of(log, k):
    return jax.tree.map(lambda a: a[k], log)


def test_by_hand_and_online_are_the_scan(car):
    """Predict and update called one by one, and step by step, as on a robot."""
    s, _, predict, update, step, track = car
    by_hand = online = s.belief
    for k in range(len(s.log.dt)):
        row = row_of(s.log, k)
        by_hand = predict(by_hand, row.u, row.dt)
        if row.valid["mark"]:
            by_hand, _ = update(by_hand, row.z["mark"], sensor="mark", c=row.c["mark"])
        if row.valid["gnss"].any():
            by_hand, _ = update(by_hand, row.z["gnss"], sensor="gnss", mask=row.valid["gnss"])
        online, info = step(online, row)
        close(by_hand, row_of(track.belief, k))
        close(online, row_of(track.belief, k))
        close(info, row_of(track.info, k))


def test_sensors_are_used_in_the_order_of_the_model_not_of_the_dict(car):
    s, _, predict, update, step, _ = car
    row = row_of(s.log, 5)._replace(valid={})
    there = predict(s.belief, row.u, row.dt)

    def updated(belief, *names):
        for name in names:
            belief, _ = update(belief, row.z[name], sensor=name, c=row.c.get(name, ()))
        return np.asarray(belief.cov)

    assert list(car_model(s.theta).sensors) == ["mark", "gnss"]
    for names in (["mark", "gnss"], ["gnss", "mark"]):
        shuffled = row._replace(z={name: row.z[name] for name in names})
        np.testing.assert_allclose(step(s.belief, shuffled)[0].cov, updated(there, "mark", "gnss"), rtol=1e-11)
    assert np.abs(updated(there, "gnss", "mark") - updated(there, "mark", "gnss")).max() > 1e-6


def test_no_time_is_no_prediction(car):
    """Bit for bit, outside jit and inside."""
    s, filt, predict, _, _, _ = car
    for function in (filt.predict, predict):
        jax.tree.map(np.testing.assert_array_equal, function(s.belief, s.log.u[0], 0.0), s.belief)


def test_a_prediction_splits_where_its_dynamics_do():
    """With f linear in dt and Q = density dt, one step of dt and the same in two are the same Gaussian."""
    model = jf.Model(
        lambda x, u, dt: x + dt * u,
        jf.white(jnp.asarray(correlation(2, 5))),
        jf.vector(2),
        {"z": jf.Sensor(lambda x, c: x, jf.const(jnp.eye(2)), jf.vector(2))},
    )
    filt, belief, u = jf.ukf(model), jf.Gaussian(jnp.ones(2), jnp.asarray(correlation(2, 6))), jnp.array([1.0, -2.0])
    once = filt.predict(belief, u, 0.7)
    close(filt.predict(filt.predict(belief, u, 0.3), u, 0.4), once)
    assert np.abs(once.cov - belief.cov).max() > 0.1


# --- likelihood and store ----------------------------------------------------------------------------------------


def test_the_log_likelihood_is_the_sum_of_what_was_reported(car):
    s, filt, _, _, _, track = car
    reported = sum(float(info.loglik.sum()) for info in track.info.values())
    np.testing.assert_allclose(jax.jit(lambda b, log: jf.log_likelihood(filt, b, log))(s.belief, s.log), reported)
    for name, info in track.info.items():
        used = np.asarray(info.dof) > 0
        np.testing.assert_array_equal(used, np.atleast_2d(s.log.valid[name].T).any(axis=0))
        assert not np.asarray(info.loglik)[~used].any()
        assert set(np.asarray(info.status)[~used]) == {jf.Status.ABSENT}
        assert set(np.asarray(info.status)[used]) == {jf.Status.OK}


def test_the_caller_chooses_what_is_stored(car):
    s, filt, _, _, _, track = car

    def store(belief, info):
        return {"yaw": belief.mean.yaw, "both": jf.mean_and_std(belief, info), "dof": info["gnss"].dof}

    got = jax.jit(lambda b, log: jf.scan(filt, b, log, store=store))(s.belief, s.log)
    close(got["yaw"], track.belief.mean.yaw)
    close(got["both"][0], track.belief.mean)
    close(got["both"][1], np.sqrt(np.diagonal(track.belief.cov, axis1=1, axis2=2)))
    np.testing.assert_array_equal(got["dof"], s.log.valid["gnss"].sum(axis=1))


def test_the_innovations_of_simulated_runs_are_white_and_of_the_size_that_they_claim():
    """Each NIS is chi-square with the number of components seen, and no innovation foretells the next."""
    s = system("linear")
    names, runs = ["wide", "arm"], 300

    def one(key, factor):
        model = s.model(s.theta)
        _, log = jf.simulate(model, s.belief, jax.tree.map(jnp.asarray, s.log), key)
        wrong = model._replace(Q=lambda x, u, dt: factor * model.Q(x, u, dt))
        return jf.scan(jf.kf(wrong), s.belief, log, store=lambda b, info: info)

    many = jax.jit(jax.vmap(one, in_axes=(0, None)))
    keys = jax.random.split(jax.random.key(1), runs)
    right, wrong = many(keys, 1.0), many(keys, 0.25)

    def chances(info):
        """Of each reading's NIS being at least this large: uniform, if the filter is right."""
        nis, dof = (np.concatenate([np.ravel(getattr(info[n], field)) for n in names]) for field in ("nis", "dof"))
        return chi2.sf(nis[dof > 0], dof[dof > 0])

    def correlation_with_the_next(info):
        whole = np.asarray(info["wide"].dof)[0] == 2
        r = np.asarray(info["wide"].innovation)[:, whole]
        white = np.linalg.solve(np.linalg.cholesky(np.asarray(info["wide"].S)[:, whole]), r[..., None])[..., 0]
        return np.mean(white[:, 1:] * white[:, :-1]) * np.sqrt(white[:, 1:].size)

    assert len(chances(right)) > 10_000
    assert kstest(chances(right), "uniform").pvalue > 1e-3
    assert kstest(chances(wrong), "uniform").pvalue < 1e-12
    assert abs(correlation_with_the_next(right)) < 3.3  # a standard normal number
    assert abs(correlation_with_the_next(wrong)) > 5


# --- gates -------------------------------------------------------------------------------------------------------


def test_a_gate_refuses_beyond_the_chi_square_threshold_and_leaves_the_belief_as_it_was(car):
    s, _, _, update, _, _ = car
    filt = jf.ekf(car_model(s.theta), gate={"gnss": 0.99})
    gated = jax.jit(filt.update, static_argnames="sensor")
    _, open_info = update(s.belief, s.belief.mean.pos, sensor="gnss")
    direction = np.linalg.cholesky(open_info.S)[:, 0]
    for mask, dof in ((np.array([True, True]), 2), (np.array([True, False]), 1)):
        threshold = chi2.ppf(0.99, dof)
        for nis, passes in ((0.999 * threshold, True), (1.001 * threshold, False)):
            z = s.belief.mean.pos + np.sqrt(nis) * direction
            after, info = gated(s.belief, z, sensor="gnss", mask=mask)
            want, want_info = update(s.belief, z, sensor="gnss", mask=mask)
            np.testing.assert_allclose(info.ratio, nis / threshold, rtol=1e-10)
            np.testing.assert_allclose(info.nis, nis, rtol=1e-10)
            close(info.S, want_info.S)
            if passes:
                close(after, want)
                assert (info.status, info.dof) == (jf.Status.OK, dof)
                np.testing.assert_allclose(info.loglik, want_info.loglik)
            else:
                jax.tree.map(np.testing.assert_array_equal, after, s.belief)
                assert (info.status, info.dof, info.loglik) == (jf.Status.GATED, 0, 0.0)
    far = (np.array(1e4), np.array(0.1))
    after, info = gated(s.belief, far, sensor="mark", c=np.array([30.0, 5.0]))
    assert (info.status, info.ratio) == (jf.Status.OK, 0.0)  # the other sensor has no gate
    assert np.abs(after.mean.pos - s.belief.mean.pos).max() > 1


# --- the iterated filter -----------------------------------------------------------------------------------------


def test_the_iterated_filter_finds_the_most_probable_state():
    """Of one vague prior and one precise reading of a landmark: found here by SciPy on the negative log density."""
    s = system("car")
    P, R = s.belief.cov, np.diag([0.01, 1e-4])
    theta = dict(s.theta, mark=0.5 * np.log(np.diag(R)))
    R = np.asarray(car_model(theta).sensors["mark"].R(None, None))
    mark, mean = np.array([9.0, 3.0]), np.array([0.0, 0.0, 3.0, 5.0])
    z = s.book(theta).sensors["mark"].h(np.array([2.5, -1.0, 2.7, 5.5]), mark)
    white_P, white_R = np.linalg.inv(np.linalg.cholesky(P)), np.linalg.inv(np.linalg.cholesky(R))
    book = s.book(theta).sensors["mark"]

    def residuals(d):
        return np.concatenate([white_P @ d, white_R @ book.minus(z, book.h(mean + d, mark))])

    best = least_squares(residuals, np.zeros(4), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    reading = (np.array(z[0]), np.array(z[1]))
    after, info = jax.jit(lambda b, z: jf.iekf(car_model(theta), iterations=8).update(b, z, "mark", mark))(
        s.belief, reading
    )
    np.testing.assert_allclose(CAR.minus(after.mean, s.belief.mean), best.x, rtol=1e-6)
    np.testing.assert_allclose(after.cov, np.linalg.inv(best.jac.T @ best.jac), rtol=1e-4, atol=1e-7)
    once, once_info = jf.ekf(car_model(theta)).update(s.belief, reading, "mark", mark)
    assert np.abs(np.asarray(CAR.minus(once.mean, after.mean))).max() > 0.01
    close(info.nis, once_info.nis)  # reported of the prediction, not of the last iteration
    first, _ = jf.iekf(car_model(theta), iterations=1).update(s.belief, reading, "mark", mark)
    jax.tree.map(np.testing.assert_array_equal, first, once)


def test_the_iterated_filter_knows_an_angle_from_its_linearisation():
    """A landmark two metres away and a prior of two metres: its bearing turns by more than half a turn on the way, and
    ``H d`` with it. Against the book's Gauss-Newton, whose residual alone is an angle."""
    s = system("car")
    theta = dict(s.theta, mark=np.log([0.3, 0.05]))
    book, mark = s.book(theta), np.array([2.0, 0.0])
    correct, sensor = oracles.iekf_correct(6), book.sensors["mark"]
    P = np.diag([4.0, 4.0, 0.01, 1.0])
    belief = jf.Gaussian(Car(np.zeros(2), np.array(0.0), np.array(1.0)), P)
    update = jax.jit(lambda z: jf.iekf(car_model(theta), iterations=6).update(belief, z, "mark", mark)[0].mean)
    rng, beyond = np.random.default_rng(6), 0
    for _ in range(100):
        x = np.append(rng.normal(0, 2, 2), [0.0, 1.0])
        z = sensor.h(x, mark) + rng.normal(size=2) * [0.3, 0.05]
        z[1] = np.angle(np.exp(1j * z[1]))
        want = correct(book, sensor, np.array([0.0, 0.0, 0.0, 1.0]), P, z, mark, np.arange(2))[0]
        got = update((z[0], z[1]))
        np.testing.assert_allclose(CAR.minus(got, Car(want[:2], np.array(want[2]), want[3])), 0.0, atol=1e-6)
        d = want - [0.0, 0.0, 0.0, 1.0]
        beyond += abs(sensor.minus(z, sensor.h(want, mark))[1] + sensor.H(want, mark)[1] @ d) > np.pi
    assert beyond > 0


# --- models that change with the row -----------------------------------------------------------------------------


def test_matrices_may_come_with_the_row():
    """A through u, H and R through c, Q through u: against the book's loop with the matrices of each instant."""
    rng = np.random.default_rng(5)
    steps = 15
    As = np.eye(2) + 0.2 * rng.normal(size=(steps, 2, 2))
    Hs, stds = rng.normal(size=(steps, 1, 2)), rng.uniform(0.1, 1.0, (steps, 1))
    z = rng.normal(size=(steps, 1))
    noise = correlation(2, 7)
    sensor = jf.Sensor(lambda x, c: c["H"] @ x, lambda x, c: jnp.diag(c["std"] ** 2), jf.vector(1))
    model = jf.Model(
        lambda x, u, dt: u["A"] @ x,
        lambda x, u, dt: u["A"] @ jnp.asarray(noise) @ u["A"].T,
        jf.vector(2),
        {"z": sensor},
    )
    log = jf.Log(np.ones(steps), {"A": As}, {"z": z}, {"z": {"H": Hs, "std": stds}}, {})
    track = jf.scan(jf.kf(model), jf.Gaussian(np.ones(2), 2 * noise), log)

    x, P = np.ones(2), 2 * noise
    for k in range(steps):
        x, P = As[k] @ x, As[k] @ P @ As[k].T + As[k] @ noise @ As[k].T
        S = Hs[k] @ P @ Hs[k].T + np.diag(stds[k] ** 2)
        K = P @ Hs[k].T @ np.linalg.inv(S)
        loglik = oracles.log_density(z[k] - Hs[k] @ x, S)
        x, P = x + K @ (z[k] - Hs[k] @ x), (np.eye(2) - K @ Hs[k]) @ P
        np.testing.assert_allclose(track.belief.mean[k], x, rtol=1e-9)
        np.testing.assert_allclose(track.belief.cov[k], P, rtol=1e-9, atol=1e-13)
        np.testing.assert_allclose(track.info["z"].loglik[k], loglik, rtol=1e-9)


def test_noise_that_depends_on_the_state_is_taken_at_the_mean_before():
    model = jf.Model(
        lambda x, u, dt: 2 * x,
        lambda x, u, dt: jnp.diag(x**2),
        jf.vector(1),
        {"z": jf.Sensor(lambda x, c: x, lambda x, c: jnp.diag(x**2), jf.vector(1))},
    )
    filt = jf.ekf(model)
    belief = filt.predict(jf.Gaussian(jnp.array([3.0]), jnp.eye(1)), (), 1.0)
    np.testing.assert_allclose(belief.cov, 4 * 1.0 + 3.0**2)
    _, info = filt.update(belief, jnp.array([0.0]), "z")
    np.testing.assert_allclose(info.S, 13.0 + 6.0**2)


# --- curved and closed spaces ------------------------------------------------------------------------------------


def test_an_angle_and_a_rotation_filter_alike_across_the_seam():
    """A heading as an angle, as (cos, sin), and on the line: one filter, wherever the numbers wrap."""
    headings = np.linspace(2.0, 5.0, 20)
    P = np.array([[0.3]])

    def run(space, lift):
        sensor = jf.Sensor(lambda x, c: x, jf.const(jnp.array([[0.05]])), space)
        model = jf.Model(lambda x, u, dt: space.plus(x, dt * u), jf.white(jnp.array([[0.1]])), space, {"z": sensor})
        log = jf.Log(np.full(20, 0.1), np.full((20, 1), 1.5), {"z": lift(headings)}, {}, {})
        return jf.scan(jf.ukf(model), jf.Gaussian(lift(np.array(1.8)), P), log)

    line = run(jf.scalar, lambda a: a)
    wrapped = run(jf.angle, lambda a: np.arctan2(np.sin(a), np.cos(a)))
    circle = run(jf.so2, lambda a: np.stack([np.cos(a), np.sin(a)], -1))
    close(np.exp(1j * np.asarray(line.belief.mean)), np.exp(1j * np.asarray(wrapped.belief.mean)))
    close(np.exp(1j * np.asarray(line.belief.mean)), np.asarray(circle.belief.mean) @ np.array([1, 1j]))
    close(line.belief.cov, wrapped.belief.cov)
    close(line.belief.cov, circle.belief.cov)
    assert np.abs(np.diff(wrapped.belief.mean)).max() > 6  # it did cross


def test_a_world_turned_beforehand_is_the_result_turned_afterwards():
    """The errors live in the body frame, so where the world's axes point changes no covariance."""
    s = system("body")
    q = jf.so3_exp(jnp.array([2.0, -1.0, 0.5]))
    sensors = {"camera": s.model(s.theta).sensors["camera"]}
    model = s.model(s.theta)._replace(sensors=sensors)
    turned = jax.vmap(lambda p: jf.so3.plus(q, jf.so3_log(p)))(jnp.asarray(s.log.z["camera"]))
    log = s.log._replace(z={"camera": s.log.z["camera"]}, valid={"camera": s.log.valid["camera"]})
    run = jax.jit(lambda b, log: jf.scan(jf.ekf(model), b, log))
    a = run(s.belief, log)
    start = s.belief.mean._replace(att=jf.so3.plus(q, jf.so3_log(jnp.asarray(s.belief.mean.att))))
    b = run(s.belief._replace(mean=start), log._replace(z={"camera": turned}))
    np.testing.assert_allclose(a.belief.cov, b.belief.cov, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(a.info["camera"].loglik, b.info["camera"].loglik, rtol=1e-9)


# --- bad news is reported where it happens, and only there --------------------------------------------------------

GOOD, STEPS, AT = 0.5, 12, 7


@pytest.fixture(scope="module")
def runs():
    """Twelve rows of a walk whose f, h and R fail at the row's bidding (u, c); jitted and batched, so that values are
    not seen at the door. Function of (z, u, c), leading axes (runs, rows)."""
    sensor = jf.Sensor(
        lambda x, c: jnp.where(c[0] > 0, jnp.nan, x), lambda x, c: (1 - 100 * c[1]) * jnp.eye(1), jf.vector(1)
    )
    other = jf.Sensor(lambda x, c: x, jf.const(jnp.eye(1)), jf.vector(1))
    model = jf.Model(
        lambda x, u, dt: jnp.where(u[0] > 0, jnp.nan, x),
        jf.const(0.1 * jnp.eye(1)),
        jf.vector(1),
        {"bad": sensor, "after": other},
    )

    @jax.jit
    def run(z, u, c):
        fields = [jnp.ones(z.shape[:2]), u, {"bad": z, "after": jnp.zeros_like(z)}, {"bad": c}, {}]
        return jf.scan_runs(jf.ekf(model), jf.Gaussian(jnp.zeros(1), jnp.eye(1)), jf.Log(*fields))

    return run


def quiet(runs):
    """Readings, inputs and contexts of that many runs with nothing wrong."""
    rng = np.random.default_rng(3)
    return rng.normal(size=(runs, STEPS, 1)), np.zeros((runs, STEPS, 1)), np.zeros((runs, STEPS, 2))


def with_nan_reading(z, u, c):
    z[1, AT] = np.nan


def with_infinite_reading(z, u, c):
    z[1, AT] = np.inf


def with_nan_prediction(z, u, c):
    u[1, AT] = 1.0


def with_nan_image(z, u, c):
    c[1, AT, 0] = 1.0


def with_indefinite_noise(z, u, c):
    c[1, AT, 1] = 1.0


@pytest.mark.parametrize(
    ("spoil", "status"),
    [
        (with_nan_reading, jf.Status.BAD_MEASUREMENT),
        (with_infinite_reading, jf.Status.BAD_MEASUREMENT),
        (with_nan_prediction, jf.Status.BAD_BELIEF),
        (with_nan_image, jf.Status.BAD_PREDICTION),
        (with_indefinite_noise, jf.Status.INDEFINITE_INNOVATION),
    ],
)
def test_what_goes_wrong_is_reported_at_its_row_and_in_its_run(runs, spoil, status):
    clean = runs(*quiet(3))
    assert not np.asarray(clean.info["bad"].status).any()
    assert not np.asarray(clean.info["after"].status).any()
    inputs = quiet(3)
    spoil(*inputs)
    track = runs(*inputs)
    bad, after = (np.asarray(track.info[name].status) for name in ("bad", "after"))
    assert not bad[1, :AT].any()
    assert not after[1, :AT].any()
    assert bad[1, AT] == status
    assert after[1, AT] == jf.Status.BAD_BELIEF
    assert np.all(bad[1, AT + 1 :] == jf.Status.BAD_BELIEF)
    for harmless in (0, 2):
        jax.tree.map(lambda a, b, k=harmless: np.testing.assert_array_equal(a[k], b[k]), track, clean)


def test_a_posterior_that_overflows_is_reported_as_such():
    """The gain is sound and the step to the new mean is not: 1e300 times 1e10."""
    sensor = jf.Sensor(lambda x, c: 1e-10 * x, jf.const(jnp.full((1, 1), 1e-30)), jf.vector(1))
    model = jf.Model(lambda x, u, dt: x, jf.const(jnp.eye(1)), jf.vector(1), {"z": sensor})
    _, info = jf.ekf(model).update(jf.Gaussian(jnp.zeros(1), jnp.eye(1)), jnp.array([1e300]), "z")
    assert info.status == jf.Status.BAD_POSTERIOR
    assert np.isfinite(info.innovation[0])


def test_a_car_is_a_tuple_of_its_parts(car):
    """What comes out has the structure that went in."""
    track = car[-1]
    assert isinstance(track.belief.mean, Car)
    assert track.belief.mean.pos.shape == (len(track.belief.cov), 2)
