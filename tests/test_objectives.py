"""Objectives: against the books' loops and SciPy's densities, laws of scores, gradients, what is missing, bad input."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from oracles import dense_posterior, ekf_correct, ekf_predict, log_density, rows_of
from systems import P_LINEAR, SYSTEMS, A, B, H, book_covariance, cast, linear_model, scaled

import jaxfilt as jf
from jaxfilt.objectives import held_back, likelihood, log_score, mix, mse, nees_match, nis_match

STEPS = 24
TURNS = {"linear": {"xy": ((0, 1), "m"), "rest": ((2,), "m")}, "car": {"xy": ((0, 1), "m")}}
WEIGHTS = {"linear": {"xy": 0.5, "rest": 20.0}, "car": {"xy": 3.0}}
HELD = {"linear": [("arm", 1), ("wide", 3)], "car": [("mark", 1), ("gnss", 2)]}


class Seen(NamedTuple):
    """What a loop kept of one row: the point, its covariance, sensor -> (innovation, S), and the row's time, s."""

    x: Any
    P: np.ndarray
    readings: dict[str, tuple]
    time: float


def by_hand(s, log, theta, held=()):
    """The book's extended Kalman filter, row by row; and (innovation, S) of the readings that were held back."""
    book, x, P = s.book(theta), s.start, np.asarray(s.belief.cov)
    rows, predictions, time, spoken = [], [], 0.0, 0
    for row in rows_of(log, book):
        time += row.dt
        if row.dt > 0:
            x, P = ekf_predict(book, x, P, row.u, row.dt)
        readings, kept = {}, None
        for name, sensor in book.sensors.items():
            if name not in row.readings:
                continue
            z, c, seen = row.readings[name]
            if held and name == held[0]:
                spoken += 1
                if spoken % held[1] == 0:
                    kept = sensor, z, c, seen
                    continue
            readings[name] = innovation(sensor, x, P, z, c, seen)
            x, P, _ = ekf_correct(book, sensor, x, P, z, c, seen)
        if kept:
            predictions.append(innovation(kept[0], x, P, *kept[1:]))
        rows.append(Seen(x, P, readings, time))
    return rows, predictions


def innovation(sensor, x, P, z, c, seen):
    h = sensor.H(x, c)[seen]
    return sensor.minus(z, sensor.h(x, c))[seen], h @ P @ h.T + sensor.R(x, c)[np.ix_(seen, seen)]


def square(e, P):
    return float(e @ np.linalg.inv(P) @ e)


def matched(values, dims):
    """Squared logarithms: of the mean, and of mean square over squared mean, against chi-square's moments."""
    values, dims = np.array(values), np.array(dims, float)
    mean, mean_square = values.sum() / dims.sum(), (values**2).sum() / (dims * (dims + 2)).sum()
    weight = (dims * (dims + 2)).sum() / (2 * dims.sum())
    return np.log(mean) ** 2 + (weight * np.log(mean_square / mean**2)) ** 2


def together(objectives):
    """One objective whose loss is a vector, that of each: one scan to compile and not six."""

    def row(seen):
        found = {(o.name, name): value for o in objectives for name, value in o.row(seen).items()}
        return {" ".join(key): value for key, value in found.items()}

    def loss(sums):
        return jnp.stack([o.loss({n.removeprefix(f"{o.name} "): sums[n] for n in sums}) for o in objectives])

    return objectives[0]._replace(name="together", row=row, loss=loss)


class Case(NamedTuple):
    """A system with a truth, and its objectives by name."""

    system: Any
    truth: jf.Truth
    view: Any
    space: Any
    objectives: dict


@functools.cache
def case(name):
    """The truth is the book's mean and a random error, unknown (NaN) in a third of the rows; of the car, its place."""
    s = SYSTEMS[name](STEPS)
    rng = np.random.default_rng(5)
    d = 3 if name == "linear" else 2
    x = np.array([row.x[:d] for row in by_hand(s, s.log, s.theta)[0]])
    mask = rng.random(STEPS) < 0.7
    x = np.where(mask[:, None], x + rng.normal(size=x.shape), np.nan)
    objectives = {o.name: o for o in (log_score, likelihood, nees_match, nis_match)}
    objectives["mse"] = mse(WEIGHTS[name], TURNS[name])
    objectives |= {o.name: o for o in (held_back(*held) for held in HELD[name])}
    objectives["mix"] = mix((log_score, 1.0), (mix((nis_match, 0.5), (objectives["mse"], 2.0)), 0.25))
    view = (lambda x: x) if name == "linear" else (lambda x: x.pos)
    return Case(s, jf.Truth(x, mask), view, jf.vector(d), objectives)


SCORES = ("log_score", "likelihood", "nees_match", "nis_match", "mse", "mix")


@functools.cache
def compiled(name, burn_in=0.0, held=True):
    """Function of (theta, belief, log, truth): every objective's loss, in one program."""
    c = case(name)
    scores = together([c.objectives[key]._replace(name=key) for key in SCORES])

    @jax.jit
    def losses(theta, belief, log, truth):
        def loss(objective):
            filter = jf.ekf(c.system.model(theta))
            return objective(filter, belief, log, truth, space=c.space, view=c.view, burn_in=burn_in)

        found = dict(zip(SCORES, loss(scores), strict=True))
        return found | {key: loss(o) for key, o in c.objectives.items() if held and key not in SCORES}

    return losses


def expected(name, burn_in=0.0):
    c, s = case(name), case(name).system
    rows = by_hand(s, s.log, s.theta)[0]
    late = np.array([row.time >= burn_in for row in rows])
    known = [k for k in range(STEPS) if c.truth.mask[k] and late[k]]
    d = c.space.dim
    e = {k: c.truth.x[k] - rows[k].x[:d] for k in known}
    P = {k: rows[k].P[:d, :d] for k in known}
    read = [pair for k in range(STEPS) if late[k] for pair in rows[k].readings.values()]
    sensors = [[rows[k].readings[n] for k in range(STEPS) if late[k] and n in rows[k].readings] for n in s.log.z]
    found = {
        "log_score": -np.mean([log_density(e[k], P[k]) for k in known]),
        "likelihood": -sum(log_density(*pair) for pair in read) / sum(len(r) for r, _ in read),
        "nees_match": matched([square(e[k], P[k]) for k in known], [d] * len(known)),
        "nis_match": np.mean([matched([square(*p) for p in own], [len(r) for r, _ in own]) for own in sensors]),
        "mse": sum(
            weight * np.mean([(e[k][list(TURNS[name][block][0])] ** 2).sum() for k in known])
            for block, weight in WEIGHTS[name].items()
        ),
    }
    for objective, held in zip(list(c.objectives)[5:-1], HELD[name], strict=True):
        predictions = by_hand(s, s.log, s.theta, held)[1]
        assert len(predictions) > 3
        found[objective] = -sum(log_density(*pair) for pair in predictions) / sum(len(r) for r, _ in predictions)
    found["mix"] = found["log_score"] + 0.25 * (0.5 * found["nis_match"] + 2 * found["mse"])
    return found


@pytest.mark.parametrize("name", ["linear", "car"])
def test_equal_the_loop_of_the_books(name):
    """Missing components, silent sensors, contexts, rows in no time, unknown truths, the place alone of a car."""
    c = case(name)
    got = compiled(name)(c.system.theta, c.system.belief, c.system.log, c.truth)
    want = expected(name)
    assert got.keys() == want.keys() == c.objectives.keys()
    for key in want:
        assert float(got[key]) == pytest.approx(want[key], rel=1e-9), key


def test_burn_in_does_not_count():
    c = case("linear")
    got = compiled("linear", 6.0, held=False)(c.system.theta, c.system.belief, c.system.log, c.truth)
    want, everything = expected("linear", 6.0), expected("linear")
    for key in SCORES:
        assert float(got[key]) == pytest.approx(want[key], rel=1e-9), key
        assert abs(want[key] - everything[key]) > 1e-3 * abs(everything[key])


def test_likelihood_is_that_of_the_joint_gaussian():
    s = case("linear").system
    Q, Rs = book_covariance(s.theta["q"], 2), {n: book_covariance(s.theta[n], 3 + i) for i, n in enumerate(H)}
    rows = rows_of(s.log, s.book(s.theta))
    joint = dense_posterior(A, B, Q, s.start, P_LINEAR, rows, H, Rs)[2]
    count = sum(len(seen) for row in rows for _, _, seen in row.readings.values())
    c = case("linear")
    got = compiled("linear")(s.theta, s.belief, s.log, c.truth)["likelihood"]
    assert float(got) * count == pytest.approx(-joint, rel=1e-10)


def test_float32_stays_float32():
    c = case("linear")
    args = cast((c.system.theta, c.system.belief, c.system.log, c.truth), np.float32)
    args = (*args[:3], args[3]._replace(mask=c.truth.mask))
    got, want = compiled("linear")(*args), expected("linear")
    for key, value in got.items():
        assert value.dtype == np.float32
        assert float(value) == pytest.approx(want[key], rel=1e-3, abs=1e-3), key


# Gradients


@functools.cache
def jacobian():
    """Function of (vector, belief, log, truth): losses, and their gradients by the numbers of theta; and the vector."""
    c = case("linear")
    start, unravel = ravel_pytree(c.system.theta)
    losses = compiled("linear")

    @jax.jit
    def both(v, belief, log, truth):
        def of(v):
            found = losses(unravel(v), belief, log, truth)
            return found, found

        slopes, values = jax.jacrev(of, has_aux=True)(v)
        return values, slopes

    return both, np.asarray(start)


def test_gradients_equal_central_differences():
    c, s = case("linear"), case("linear").system
    both, start = jacobian()
    _, unravel = ravel_pytree(s.theta)
    slopes = both(start, s.belief, s.log, c.truth)[1]
    rng, h = np.random.default_rng(2), 1e-6
    for _ in range(3):
        direction = rng.normal(size=start.shape)
        above, below = (compiled("linear")(unravel(start + t * direction), s.belief, s.log, c.truth) for t in (h, -h))
        for key, slope in slopes.items():
            assert np.linalg.norm(slope) > 1e-3
            difference = (float(above[key]) - float(below[key])) / (2 * h)
            assert float(slope @ direction) == pytest.approx(difference, rel=1e-5, abs=1e-7), key


def nothing_known(s, truth):
    return s.belief, s.log, truth._replace(mask=np.zeros(STEPS, bool))


def all_silent(s, truth):
    return s.belief, s.log._replace(valid=jax.tree.map(np.zeros_like, s.log.valid)), truth


def no_error(s, truth):
    """At rest at the origin, and all readings say so: errors and innovations are 0 to the last bit."""
    log = s.log._replace(u=0 * s.log.u, z=jax.tree.map(np.zeros_like, s.log.z))
    return s.belief._replace(mean=np.zeros(3)), log, jf.Truth(np.zeros((STEPS, 3)), np.ones(STEPS, bool))


@pytest.mark.parametrize(
    ("happens", "silent"),
    [
        (nothing_known, {"log_score", "nees_match", "mse"}),
        (
            all_silent,
            {"likelihood", "nis_match", "held_back('arm')", "held_back('wide', every=3)"},
        ),
        (no_error, {"mse"}),
    ],
    ids=["nothing known", "all silent", "no error"],
)
def test_where_nothing_is_counted_losses_are_0_and_gradients_finite(happens, silent):
    both, start = jacobian()
    values, slopes = both(start, *happens(case("linear").system, case("linear").truth))
    for key, value in values.items():
        assert np.isfinite(value), key
        assert np.isfinite(slopes[key]).all(), key
        if key in silent:
            assert float(value) == pytest.approx(0.0, abs=1e-20)
            np.testing.assert_allclose(slopes[key], 0.0, atol=1e-10)
        elif key != "mix":
            assert float(value) != 0


def test_what_is_not_finite_is_not_hidden():
    c, s = case("linear"), case("linear").system
    got = compiled("linear")(s.theta | {"q": np.full(3, np.nan)}, s.belief, s.log, c.truth)
    for key, value in got.items():
        assert np.isnan(value), key


# Laws of scores, over many simulated runs

RUNS, ROWS = 300, 15


class Simulated(NamedTuple):
    """Losses of each run (R,) as a function of the logarithms of factors on (P0, Q, R); their derivatives (R, 3)."""

    losses: Any
    slopes: Any


@functools.cache
def simulated():
    """The linear system, true to itself: a start drawn from its belief, noises from its Q and R, some parts unseen."""
    s = SYSTEMS["linear"](ROWS)
    objectives = log_score, likelihood, nees_match, nis_match, mse()

    def filtered(factors, truth, log):
        p, q, r = jnp.exp(factors)
        model = linear_model(s.theta)
        sensors = scaled(model, r).sensors
        model = scaled(model, q)._replace(sensors=sensors)
        belief = jf.Gaussian(s.belief.mean, p * s.belief.cov)
        truth = jf.Truth(truth, jnp.ones(ROWS, bool))
        losses = together(objectives)(jf.kf(model), belief, log, truth)
        return {o.name: loss for o, loss in zip(objectives, losses, strict=True)}

    @jax.jit
    def drawn(keys):
        return jax.vmap(lambda key: jf.simulate(linear_model(s.theta), s.belief, s.log, key))(keys)

    truth, log = drawn(jax.random.split(jax.random.key(3), RUNS))
    over = jax.vmap(filtered, in_axes=(None, 0, 0))
    slopes = jax.vmap(jax.jacfwd(filtered), in_axes=(None, 0, 0))
    losses, slopes = jax.jit(over), jax.jit(slopes)
    return Simulated(
        lambda *factors: jax.tree.map(np.asarray, losses(np.log(np.array(factors, float)), truth, log)),
        lambda *factors: jax.tree.map(np.asarray, slopes(np.log(np.array(factors, float)), truth, log)),
    )


def test_a_score_is_proper():
    """Its expected gradient at the true covariances is 0: within 4 standard errors, which are small beside the
    curvature; any common factor makes it worse, by much more than the error of the difference."""
    slopes, at = simulated().slopes(1, 1, 1), simulated().losses(1, 1, 1)
    for key in ("log_score", "likelihood"):
        mean, error = slopes[key].mean(0), slopes[key].std(0) / np.sqrt(RUNS)
        assert (np.abs(mean) < 4 * error).all(), key
        for factor in (0.25, 0.6, 1.7, 4.0):
            worse = simulated().losses(factor, factor, factor)[key] - at[key]
            assert worse.mean() > 4 * worse.std() / np.sqrt(RUNS), (key, factor)
        for factors in ((4, 1, 1), (0.25, 1, 1), (1, 4, 1), (1, 0.25, 1), (1, 1, 4), (1, 1, 0.25)):
            worse = simulated().losses(*factors)[key] - at[key]
            assert worse.mean() > 3 * worse.std() / np.sqrt(RUNS), (key, factors)


def test_squared_error_leaves_the_scale_free_and_the_log_score_does_not():
    """The negative control: P0, Q and R times 1000, and the squared error is the same to rounding."""
    at, away, slopes = simulated().losses(1, 1, 1), simulated().losses(1e3, 1e3, 1e3), simulated().slopes(1, 1, 1)
    np.testing.assert_allclose(away["mse"], at["mse"], rtol=1e-9)
    np.testing.assert_allclose(slopes["mse"].sum(1), 0.0, atol=1e-10)
    assert np.abs(slopes["mse"]).max() > 1e-3
    assert away["log_score"].mean() > at["log_score"].mean() + 1
    np.testing.assert_array_less(0.1, np.abs(slopes["log_score"].sum(1)).mean())


def test_matching_is_a_parabola_in_the_logarithm_of_the_scale():
    """A common factor c divides every NEES by it: the loss becomes (a - log c)^2 + the shape's, from 1e-4 to 1e4."""
    log_c = np.log([1e-4, 1e-2, 1.0, 1e2, 1e4])
    for key in ("nees_match", "nis_match"):
        values = np.array([simulated().losses(c, c, c)[key] for c in np.exp(log_c)])
        second = np.polynomial.polynomial.polyfit(log_c, values, 2)[2]
        np.testing.assert_allclose(second, 1.0, rtol=1e-6)
        fitted = np.polynomial.polynomial.polyfit(log_c, values, 2)
        np.testing.assert_allclose(np.polynomial.polynomial.polyval(log_c, fitted).T, values, rtol=1e-6, atol=1e-6)


def test_a_consistent_filter_matches():
    """Sums over all runs of what a true filter shows: mean and variance of chi-square, also with components missing."""
    rng = np.random.default_rng(0)
    for dims in (np.full(200_000, 3.0), rng.integers(0, 4, 200_000).astype(float)):
        x = rng.chisquare(np.maximum(dims, 1)) * (dims > 0)
        sums = {"value": x, "square": x**2, "dof": dims, "dof_square": dims * (dims + 2), "count": dims > 0}
        sums = {name: jnp.asarray(value.sum(), float) for name, value in sums.items()}
        for objective in (nees_match, nis_match):
            assert float(objective.loss(sums)) < 1e-3
            assert float(objective.loss(sums | {"value": 1.2 * sums["value"]})) > 0.02
            assert float(objective.loss(sums | {"square": 1.2 * sums["square"]})) > 0.02


def test_a_gate_does_not_excuse_a_prediction():
    c, s = case("linear"), case("linear").system
    plain = compiled("linear")(s.theta, s.belief, s.log, c.truth)["held_back('arm')"]
    tight = jf.ekf(s.model(s.theta), gate={"arm": 1e-6})
    gated = jax.jit(lambda: held_back("arm")(tight, s.belief, s.log))()
    assert float(gated) == pytest.approx(float(plain), rel=1e-12)


# What objectives say of themselves, and bad input


def test_what_an_objective_needs():
    assert [o.needs_truth for o in (log_score, likelihood, nees_match, nis_match, mse(), held_back("z"))] == [
        *(True, False, True, False, True, False)
    ]
    assert likelihood.likelihood
    assert not any(o.likelihood for o in (log_score, nis_match, held_back("z"), mix((likelihood, 1.0))))
    assert not mix((likelihood, 1.0), (nis_match, 2.0)).needs_truth
    assert mix((likelihood, 1.0), (log_score, 2.0)).needs_truth
    both = mix((held_back("gnss", 5), 1.0), (held_back("mark"), 0.5), (held_back("gnss", 5), 2.0))
    assert both.held == {"gnss": 5, "mark": 1}
    assert both.name == "held_back('gnss', every=5) + 0.5 held_back('mark') + 2 held_back('gnss', every=5)"
    assert mix((both, 1.0), (log_score, 1.0)).held == both.held


def test_an_objective_without_its_truth():
    s = case("linear").system
    with pytest.raises(ValueError, match="truth: the objective 'log_score' needs one, got None"):
        log_score(jf.kf(s.model(s.theta)), s.belief, s.log)


def test_a_sensor_that_the_model_lacks():
    s = case("linear").system
    with pytest.raises(KeyError, match=r"expected one of \['wide', 'arm'\], got 'sonar'"):
        held_back("sonar")(jf.kf(s.model(s.theta)), s.belief, s.log)


def test_an_index_beyond_the_truth():
    s = case("linear").system
    truth = jf.Truth(np.zeros((STEPS, 3)), np.ones(STEPS, bool))
    with pytest.raises(ValueError, match=r"mse\(blocks\): expected indices below 3, the truth's, got 3 of 'yaw'"):
        mse({"yaw": 1.0}, {"yaw": ((3,), "rad")})(jf.kf(s.model(s.theta)), s.belief, s.log, truth)


POSITION = {"position": ((0, 1), "m")}


@pytest.mark.parametrize(
    ("make", "error", "text"),
    [
        (lambda: mse({"position": 1.0}), TypeError, r"mse\(weights\): expected a number without blocks"),
        (lambda: mse(1.0, POSITION), TypeError, r"mse\(weights\): expected a dict with blocks, got 1.0"),
        (lambda: mse({"yaw": 1.0}, POSITION), KeyError, r"expected blocks of \['position'\], got 'yaw'"),
        (lambda: mse(-1.0), ValueError, r"mse\(weights\): expected finite numbers >= 0, not all 0, got -1.0"),
        (lambda: mse(np.nan), ValueError, r"mse\(weights\): expected finite numbers >= 0"),
        (lambda: mse({"position": np.inf}, POSITION), ValueError, r"mse\(weights\): expected finite numbers >= 0"),
        (lambda: mse({"position": 0.0}, POSITION), ValueError, r"mse\(weights\): .* not all 0"),
        (lambda: mse({}, POSITION), ValueError, r"mse\(weights\): .* not all 0, got \{\}"),
        (lambda: held_back("z", 0), ValueError, r"held_back\(every\): expected a whole number >= 1, got 0"),
        (lambda: held_back("z", 2.0), ValueError, r"held_back\(every\): expected a whole number >= 1, got 2.0"),
        (lambda: mix(), ValueError, r"mix\(parts\): expected at least one \(objective, weight\), got none"),
        (lambda: mix(log_score), TypeError, r"mix\(parts\): expected \(objective, weight\), got Objective"),
        (lambda: mix((mse, 1.0)), TypeError, r"mix\(parts\): expected \(objective, weight\), got \(<function mse"),
        (lambda: mix((log_score, -0.5)), ValueError, r"expected finite weights >= 0, got -0.5 for 'log_score'"),
        (lambda: mix((log_score, np.nan)), ValueError, r"expected finite weights >= 0, got nan for 'log_score'"),
        (
            lambda: mix((held_back("z", 2), 1.0), (held_back("z", 3), 1.0)),
            ValueError,
            r"hold back the same readings of 'z', got each 2\. and each 3\.",
        ),
    ],
)
def test_bad_input(make, error, text):
    with pytest.raises(error, match=text):
        make()
