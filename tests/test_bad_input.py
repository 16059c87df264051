"""Wrong use raises at the door, naming the argument, what was expected and what came; inside jit and vmap too."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf

SPACE = jf.product({"pos": jf.vector(2), "yaw": jf.angle})
STEPS = 4


def model(**changes):
    parts = {
        "f": lambda x, u, dt: {"pos": x["pos"] + dt * u, "yaw": x["yaw"]},
        "Q": jf.white(np.eye(3)),
        "h": lambda x, c: x["pos"],
        "R": jf.const(np.eye(2)),
    } | changes
    sensors = {
        "gnss": jf.Sensor(parts["h"], parts["R"], jf.vector(2)),
        "compass": jf.Sensor(lambda x, c: x["yaw"], jf.const(np.eye(1)), jf.angle),
    }
    return jf.Model(parts["f"], parts["Q"], SPACE, sensors)


def belief(pos=(0.0, 0.0), yaw=0.0, cov=None):
    return jf.Gaussian({"pos": np.asarray(pos), "yaw": yaw}, np.eye(3) if cov is None else cov)


def log(**changes):
    fields = {
        "dt": np.full(STEPS, 0.1),
        "u": np.zeros((STEPS, 2)),
        "z": {"gnss": np.zeros((STEPS, 2)), "compass": np.zeros(STEPS)},
        "c": {},
        "valid": {},
    }
    return jf.Log(**(fields | changes))


def scan(model_=None, belief_=None, log_=None):
    return jf.scan(jf.ekf(model_ or model()), belief_ or belief(), log_ or log())


def test_what_is_sound_passes():
    assert scan().belief.cov.shape == (STEPS, 3, 3)


def put(array, index, value):
    array = np.array(array, float)
    array[index] = value
    return array


ASYMMETRIC = np.array([[1.0, 0.5, 0], [0.1, 1, 0], [0, 0, 1]])
INDEFINITE = np.array([[1.0, 2.0, 0], [2.0, 1, 0], [0, 0, 1]])
GNSS, COMPASS = np.zeros((STEPS, 2)), np.zeros(STEPS)

BELIEFS = {
    "mean of wrong shape": (
        belief(pos=np.zeros(3)),
        ValueError,
        r"belief\.mean: expected shapes .*\(2,\).*, got .*\(3,\)",
    ),
    "mean of wrong structure": (jf.Gaussian(np.zeros(3), np.eye(3)), ValueError, r"belief\.mean: expected a pytree"),
    "mean of integers": (belief(yaw=0), TypeError, r"belief\.mean: expected floating numbers, got int 0"),
    "mean with NaN": (
        belief(pos=(0.0, np.nan)),
        ValueError,
        r"belief\.mean: expected finite numbers, got nan at \[1\]",
    ),
    "cov of wrong shape": (belief(cov=np.eye(2)), ValueError, r"belief\.cov: expected shape \(3, 3\), got \(2, 2\)"),
    "mean with a list": (
        jf.Gaussian({"pos": [0.0, 0.0], "yaw": 0.0}, np.eye(3)),
        ValueError,
        r"belief\.mean: expected a pytree of shapes {'pos': \(2,\), 'yaw': \(\)}, got {'pos': \[float 0\.0, float 0\.0\]",
    ),
    "cov a list": (belief(cov=[[1.0]]), TypeError, r"belief\.cov: expected an array, got list"),
    "cov of integers": (
        belief(cov=np.eye(3, dtype=int)),
        TypeError,
        r"belief\.cov: expected floating numbers, got int64",
    ),
    "cov with NaN": (
        belief(cov=np.full((3, 3), np.nan)),
        ValueError,
        r"belief\.cov: expected finite numbers, got nan at \[0, 0\] \(9 in all\)",
    ),
    "cov asymmetric": (belief(cov=ASYMMETRIC), ValueError, r"belief\.cov: expected a symmetric matrix, got 0\.5 at"),
    "cov indefinite": (belief(cov=INDEFINITE), ValueError, r"belief\.cov: expected a positive semidefinite matrix"),
    "cov negative": (belief(cov=-np.eye(3)), ValueError, r"belief\.cov: expected variances >= 0 .* got -1 at"),
    "mixed dtypes": (
        belief(pos=np.zeros(2, np.float32)),
        TypeError,
        r"belief\.mean: expected float64 .* got float32\[2\]",
    ),
    "not a Gaussian": ((np.zeros(3), np.eye(3)), TypeError, r"belief: expected a Gaussian\(mean, cov\), got tuple"),
}


def test_numpy_arrays_and_python_floats_make_a_belief():
    moved = jf.ekf(model()).predict(belief(pos=(1.0, 2.0), yaw=0.5), np.ones(2), 0.5)
    np.testing.assert_allclose(moved.mean["pos"], [1.5, 2.5])
    assert {leaf.dtype for leaf in jax.tree.leaves(moved)} == {np.dtype(np.float64)}


@pytest.mark.parametrize(("bad", "error", "words"), BELIEFS.values(), ids=BELIEFS)
def test_beliefs(bad, error, words):
    with pytest.raises(error, match=words):
        scan(belief_=bad)
    with pytest.raises(error, match=words):
        jf.ekf(model()).predict(bad, np.zeros(2), 0.1)
    with pytest.raises(error, match=words):
        jf.ekf(model()).update(bad, np.zeros(2), "gnss")


@pytest.mark.parametrize(
    "name", ["mean of wrong shape", "mean of wrong structure", "cov of wrong shape", "mixed dtypes"]
)
def test_beliefs_inside_jit_and_vmap(name):
    bad, error, words = BELIEFS[name]
    with pytest.raises(error, match=words):
        jax.jit(lambda b: jf.ekf(model()).predict(b, np.zeros(2), 0.1))(bad)
    with pytest.raises(error, match=words):
        jax.vmap(lambda b: jf.ekf(model()).update(b, np.zeros(2), "gnss"))(
            jax.tree.map(lambda a: np.stack([a, a]), bad)
        )


LOGS = {
    "no log": ({"dt": 0.1}, TypeError, r"log: expected a Log, got dict"),
    "a recording": (jf.Recording(log(), np.arange(4.0)), TypeError, r"log: expected a Log, got Recording"),
    "z no dict": (log(z=GNSS), TypeError, r"log\.z: expected a dict by sensor, got float64\[4, 2\]"),
    "valid no dict": (log(valid=()), TypeError, r"log\.valid: expected a dict by sensor, got \(\)"),
    "dt a list": (log(dt=[0.1] * STEPS), TypeError, r"log\.dt: expected an array, got list"),
    "dt of wrong shape": (log(dt=np.ones((STEPS, 1))), ValueError, r"log\.dt: expected shape \(T,\), got \(4, 1\)"),
    "dt of integers": (log(dt=np.ones(STEPS, int)), TypeError, r"log\.dt: expected floating numbers, got int64\[4\]"),
    "dt of another dtype": (
        log(dt=np.ones(STEPS, np.float32)),
        TypeError,
        r"log\.dt: expected float64 like the belief's cov, got float32\[4\]",
    ),
    "c too short": (
        log(c={"gnss": (np.zeros(3),)}),
        ValueError,
        r"log\.c\['gnss'\]\[0\]: expected leading axis 4, got shape \(3,\)",
    ),
    "c with NaN": (log(c={"gnss": put(COMPASS, 1, np.nan)}), ValueError, r"log\.c\['gnss'\]: expected finite numbers"),
    "c of no reading": (
        log(z={"gnss": GNSS}, c={"compass": COMPASS}),
        KeyError,
        r"log\.c: expected sensors of log\.z, \['gnss'\], got 'compass'",
    ),
    "empty": (jax.tree.map(lambda a: a[:0], log()), ValueError, r"log: expected at least one row, got none"),
    "negative dt": (
        log(dt=put(np.ones(STEPS), 2, -0.5)),
        ValueError,
        r"log\.dt: expected intervals >= 0 s, got -0\.5 at row 2",
    ),
    "NaN dt": (
        log(dt=put(np.ones(STEPS), 1, np.nan)),
        ValueError,
        r"log\.dt: expected finite numbers, got nan at \[1\]",
    ),
    "unknown sensor": (log(z={"radar": GNSS}), KeyError, r"sensor: expected one of \['gnss', 'compass'\], got 'radar'"),
    "z of wrong shape": (
        log(z={"gnss": np.zeros((STEPS, 3))}),
        ValueError,
        r"log\.z\['gnss'\]: expected shapes \(4, 2\), got \(4, 3\)",
    ),
    "z of wrong structure": (log(z={"gnss": (COMPASS, COMPASS)}), ValueError, r"log\.z\['gnss'\]: expected a pytree"),
    "z of integers": (log(z={"compass": np.zeros(STEPS, int)}), TypeError, r"log\.z\['compass'\]: expected floating"),
    "z with NaN": (
        log(z={"gnss": put(GNSS, (3, 0), np.nan)}),
        ValueError,
        r"log\.z\['gnss'\]: expected finite numbers, got nan at \[3, 0\]",
    ),
    "z with inf": (log(z={"gnss": put(GNSS, (3, 0), np.inf)}), ValueError, r"log\.z\['gnss'\]: expected finite .* inf"),
    "z of another dtype": (log(z={"gnss": GNSS.astype(np.float32)}), TypeError, r"log\.z\['gnss'\]: expected float64"),
    "u with NaN": (
        log(u=put(GNSS, (1, 1), np.nan)),
        ValueError,
        r"log\.u: expected finite numbers, got nan at \[1, 1\]",
    ),
    "u too short": (
        log(u=np.zeros((STEPS - 1, 2))),
        ValueError,
        r"log\.u: expected leading axis 4, got shape \(3, 2\)",
    ),
    "u of integers": (log(u=np.zeros((STEPS, 2), int)), TypeError, r"log\.u: expected floating numbers, got int64"),
    "valid not bool": (
        log(valid={"gnss": np.ones(STEPS)}),
        ValueError,
        r"log\.valid\['gnss'\]: expected bool of shape",
    ),
    "valid of wrong width": (
        log(valid={"gnss": np.ones((STEPS, 3), bool)}),
        ValueError,
        r"log\.valid\['gnss'\]: expected bool of shape \(4,\) or \(4, 2\), got bool\[4, 3\]",
    ),
    "valid of no sensor": (
        log(valid={"sonar": np.ones(STEPS, bool)}),
        KeyError,
        r"sensor: expected one of \['gnss', 'compass'\], got 'sonar'",
    ),
    "valid of no reading": (
        log(z={"gnss": GNSS}, valid={"compass": np.ones(STEPS, bool)}),
        KeyError,
        r"log\.valid: expected sensors of log\.z, \['gnss'\], got 'compass'",
    ),
}


@pytest.mark.parametrize(("bad", "error", "words"), LOGS.values(), ids=LOGS)
def test_logs(bad, error, words):
    with pytest.raises(error, match=words):
        scan(log_=bad)


STRUCTURE = ["z of wrong shape", "z of wrong structure", "z of another dtype", "u too short", "valid not bool"]


@pytest.mark.parametrize("name", STRUCTURE)
def test_logs_inside_jit_and_vmap(name):
    bad, error, words = LOGS[name]
    with pytest.raises(error, match=words):
        jax.jit(lambda rows: scan(log_=rows))(bad)
    with pytest.raises(error, match=words):
        jax.vmap(lambda rows: scan(log_=rows))(jax.tree.map(lambda a: np.stack([a, a]), bad))


MODELS = {
    "f of wrong shape": (
        {"f": lambda x, u, dt: {"pos": x["pos"][:1], "yaw": x["yaw"]}},
        r"f\(x, u, dt\): expected shapes",
    ),
    "f of wrong structure": ({"f": lambda x, u, dt: x["pos"]}, r"f\(x, u, dt\): expected a pytree of shapes"),
    "h of wrong shape": (
        {"h": lambda x, c: x["pos"][:1]},
        r"h\(x, c\) of sensor 'gnss': expected shapes \(2,\), got \(1,\)",
    ),
    "h of wrong structure": ({"h": lambda x, c: x}, r"h\(x, c\) of sensor 'gnss': expected a pytree of shapes \(2,\)"),
    "Q of wrong shape": ({"Q": lambda x, u, dt: jnp.eye(2)}, r"Q\(x, u, dt\): expected shape \(3, 3\), got \(2, 2\)"),
    "R of wrong shape": (
        {"R": lambda x, c: jnp.ones(2)},
        r"R\(x, c\) of sensor 'gnss': expected shape \(2, 2\), got \(2,\)",
    ),
}


@pytest.mark.parametrize(("changes", "words"), MODELS.values(), ids=MODELS)
@pytest.mark.parametrize("make", [jf.ekf, jf.ukf], ids=["ekf", "ukf"])
def test_models(changes, words, make):
    with pytest.raises(ValueError, match=words):
        jf.scan(make(model(**changes)), belief(), log())
    with pytest.raises(ValueError, match=words):
        jax.jit(lambda b: jf.scan(make(model(**changes)), b, log()))(belief())


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"f": lambda x, u, dt: {"pos": x["pos"], "yaw": 0}}, TypeError, r"f\(x, u, dt\): expected floating .* int 0"),
        (
            {"h": lambda x, c: x["pos"].astype(jnp.float32)},
            TypeError,
            r"h\(x, c\) .*: expected float64 .* float32\[2\]",
        ),
        ({"h": lambda x, c: None}, ValueError, r"h\(x, c\) of sensor 'gnss': expected a pytree of shapes .* got None"),
        ({"Q": lambda *_: [[1.0]]}, TypeError, r"Q\(x, u, dt\): expected an array, got list"),
        (
            {"Q": lambda *_: jnp.asarray(ASYMMETRIC)},
            ValueError,
            r"Q\(x, u, dt\): expected a symmetric matrix, got 0\.5",
        ),
        ({"Q": lambda *_: jnp.asarray(INDEFINITE)}, ValueError, r"Q\(x, u, dt\): expected a positive semidefinite"),
        ({"Q": lambda *_: jnp.eye(3, dtype=jnp.float32)}, TypeError, r"Q\(x, u, dt\): expected float64 .* float32"),
        ({"R": lambda *_: 1.0}, TypeError, r"R\(x, c\) of sensor 'gnss': expected an array, got float"),
        ({"R": lambda *_: -jnp.eye(2)}, ValueError, r"R\(x, c\) of sensor 'gnss': expected variances >= 0"),
        ({"R": lambda *_: jnp.ones((2, 2), int)}, TypeError, r"R\(x, c\) of sensor 'gnss': expected floating numbers"),
    ],
)
def test_models_by_hand(changes, error, words):
    filt = jf.ekf(model(**changes))
    with pytest.raises(error, match=words):
        filt.update(filt.predict(belief(), np.zeros(2), 0.1), np.zeros(2), "gnss")


WRONG_INPUTS = {
    "none": ((), r"x = {'pos': float64\[2\], 'yaw': float64\[\]}, u = \(\), dt = float64\[\]"),
    "too wide": (np.zeros((STEPS, 3)), r"x = .*, u = float64\[3\], dt"),
}


@pytest.mark.parametrize(("u", "words"), WRONG_INPUTS.values(), ids=WRONG_INPUTS)
@pytest.mark.parametrize("run", [scan, lambda log_: jax.jit(scan)(None, None, log_)], ids=["plain", "jit"])
def test_what_a_user_s_function_raises_says_for_what(u, words, run):
    """The model's own error, whatever it is, with a note: here the input is not there, or too wide."""
    with pytest.raises((TypeError, ValueError)) as caught:
        run(log_=log(u=u))
    assert any(re.search(r"raised by f\(x, u, dt\) for " + words, note) for note in caught.value.__notes__)
    with pytest.raises((TypeError, ValueError)) as caught:
        jf.simulate(model(), belief(), log(u=u), jax.random.key(0))
    assert any(re.search(r"raised by f\(x, u, dt\) for " + words, note) for note in caught.value.__notes__)


def test_so_does_a_sensor_without_its_context():
    with pytest.raises(IndexError) as caught:
        scan(model(h=lambda x, c: x["pos"] - c[0]))
    assert any("raised by h(x, c) of sensor 'gnss' for x = " in note for note in caught.value.__notes__)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: jf.const(ASYMMETRIC), r"const\(cov\): expected a symmetric matrix"),
        (lambda: jf.const(INDEFINITE), r"const\(cov\): expected a positive semidefinite matrix"),
        (lambda: jf.white(-np.eye(2)), r"white\(density\): expected variances >= 0"),
        (
            lambda: jf.linear(np.eye(2), np.eye(2), INDEFINITE[:2, :2], np.eye(2)),
            r"Q: expected a positive semidefinite",
        ),
        (
            lambda: jf.linear(np.eye(2), np.eye(2), np.eye(2), ASYMMETRIC[:2, :2]),
            r"R of sensor 'z': expected a symmetric",
        ),
        (
            lambda: jf.linear(np.eye(2), np.eye(3), np.eye(2), np.eye(3)),
            r"H of sensor 'z': expected shape \(m, 2\), got",
        ),
        (
            lambda: jf.linear(np.ones((2, 3)), np.eye(2), np.eye(2), np.eye(2)),
            r"A: expected a square matrix, got shape",
        ),
        (
            lambda: jf.linear(np.eye(2), np.eye(2), np.eye(2), np.eye(2), B=np.ones((3, 1))),
            r"B: expected shape \(2, k\)",
        ),
    ],
)
def test_noise_and_linear_models(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_matrices_of_linear_models():
    one = np.eye(1)
    for k, name in enumerate(["A", "H of sensor 'z'", "Q", "R of sensor 'z'", "B"]):
        for bad, words in [
            ([[1.0]], "expected an array, got list"),
            (np.eye(1, dtype=int), "expected floating numbers"),
        ]:
            matrices = [one] * 5
            matrices[k] = bad
            with pytest.raises(TypeError, match=re.escape(f"{name}: {words}")):
                jf.linear(*matrices)
    with pytest.raises(ValueError, match=r"R: expected the sensors of H, \['a'\], got \['b'\]"):
        jf.linear(one, {"a": one}, one, {"b": one})


def test_an_indefinite_r_of_ones_a_lecture_s_mistake():
    """R = r * ones is of rank one: semidefinite, so accepted, and check says that it is singular."""
    R = np.ones((2, 2))
    found = jf.check(jf.linear(np.eye(2), np.eye(2), np.eye(2), R), np.zeros(2))
    assert "R positive semidefinite, singular" in str(found)


def test_dt_by_hand():
    filt = jf.ekf(model())
    with pytest.raises(ValueError, match=r"dt: expected a finite interval >= 0 s, got -0\.1"):
        filt.predict(belief(), np.zeros(2), -0.1)
    with pytest.raises(ValueError, match=r"dt: expected a finite interval >= 0 s, got nan"):
        filt.predict(belief(), np.zeros(2), float("nan"))
    with pytest.raises(ValueError, match=r"dt: expected a scalar, got shape \(3,\)"):
        filt.predict(belief(), np.zeros(2), np.ones(3))
    with pytest.raises(TypeError, match=r"dt: expected float64 .* got float32"):
        filt.predict(belief(), np.zeros(2), np.float32(0.1))


@pytest.mark.parametrize(
    ("u", "error", "words"),
    [
        (np.array([0.0, np.nan]), ValueError, r"u: expected finite numbers, got nan at \[1\]"),
        (np.zeros(2, int), TypeError, r"u: expected floating numbers, got int64\[2\]"),
        (np.zeros(2, np.float32), TypeError, r"u: expected float64 like the belief's cov, got float32\[2\]"),
    ],
)
def test_inputs_by_hand(u, error, words):
    with pytest.raises(error, match=words):
        jf.ekf(model()).predict(belief(), u, 0.1)


def row(**changes):
    return jax.tree.map(lambda a: a[0], log())._replace(**changes)


@pytest.mark.parametrize(
    ("bad", "error", "words"),
    [
        (tuple(row()), TypeError, r"row: expected a Log, got tuple"),
        (log(), ValueError, r"dt: expected a scalar, got shape \(4,\)"),
        (row(z={"radar": GNSS[0]}), KeyError, r"sensor: expected one of \['gnss', 'compass'\], got 'radar'"),
        (row(z=GNSS[0]), TypeError, r"row\.z: expected a dict by sensor, got float64\[2\]"),
        (
            row(z={"gnss": GNSS[0]}, valid={"compass": True}),
            KeyError,
            r"row\.valid: expected sensors of row\.z, \['gnss'\], got 'compass'",
        ),
        (row(valid={"gnss": 1}), ValueError, r"row\.valid\['gnss'\]: expected bool of shape \(\) or \(2,\), got int 1"),
        (row(z={"gnss": np.zeros(3)}), ValueError, r"z\['gnss'\]: expected shapes \(2,\), got \(3,\)"),
    ],
)
def test_rows_by_hand(bad, error, words):
    with pytest.raises(error, match=words):
        jf.ekf(model()).step(belief(), bad)


def test_a_row_may_say_valid_in_python():
    step = jf.ekf(model()).step
    _, info = step(belief(), row(valid={"gnss": True, "compass": False}))
    assert info["gnss"].dof == 2
    assert info["compass"].status == jf.Status.ABSENT


def test_updates_by_hand():
    filt = jf.ekf(model())
    with pytest.raises(KeyError, match=r"sensor: expected one of \['gnss', 'compass'\], got 'radar'"):
        filt.update(belief(), np.zeros(2), "radar")
    with pytest.raises(ValueError, match=r"z\['gnss'\]: expected shapes \(2,\), got \(3,\)"):
        filt.update(belief(), np.zeros(3), "gnss")
    with pytest.raises(TypeError, match=r"z\['gnss'\]: expected floating numbers, got int64"):
        filt.update(belief(), np.zeros(2, int), "gnss")
    with pytest.raises(TypeError, match=r"z\['gnss'\]: expected float64 like the belief's cov, got float32\[2\]"):
        filt.update(belief(), np.zeros(2, np.float32), "gnss")
    with pytest.raises(
        ValueError, match=r"z\['gnss'\]: expected a pytree of shapes \(2,\), got \[float 0\.0, float 0\.0\]"
    ):
        filt.update(belief(), [0.0, 0.0], "gnss")
    with pytest.raises(ValueError, match=r"z\['gnss'\]: expected finite numbers, got inf at \[1\]"):
        filt.update(belief(), np.array([0.0, np.inf]), "gnss")
    with pytest.raises(ValueError, match=r"mask of 'gnss': expected bool .*, got \[bool True, bool False\]"):
        filt.update(belief(), np.zeros(2), "gnss", mask=[True, False])
    with pytest.raises(ValueError, match=r"mask of 'gnss': expected bool of shape \(2,\), got bool\[3\]"):
        filt.update(belief(), np.zeros(2), "gnss", mask=np.ones(3, bool))
    with pytest.raises(ValueError, match=r"mask of 'gnss': expected bool of shape \(2,\), got float64\[2\]"):
        filt.update(belief(), np.zeros(2), "gnss", mask=np.ones(2))


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (
            lambda: jf.ekf(model(), gate=1.5),
            ValueError,
            r"gate: expected a probability between 0 and 1 for 'gnss', got 1\.5",
        ),
        (lambda: jf.ekf(model(), gate={"sonar": 0.9}), KeyError, r"gate: expected sensors of .* got 'sonar'"),
        (lambda: jf.ekf(model(), gate={"gnss": 0}), ValueError, r"gate: expected a probability .* 'gnss', got 0"),
        (lambda: jf.ekf(lambda theta: model()), TypeError, r"model: expected a Model, got function"),
        (lambda: jf.scan(jf.ekf, belief(), log()), TypeError, r"filter: expected a Filter, got function"),
        (lambda: jf.iekf(model(), iterations=0), ValueError, r"iekf\(iterations\): expected at least 1, got 0"),
        (lambda: jf.ukf(model(), alpha=0.0), ValueError, r"unscented\(alpha\): expected alpha > 0, got 0\.0"),
        (lambda: jf.gauss_hermite(1), ValueError, r"gauss_hermite\(order\): expected order >= 2, got 1"),
        (
            lambda: jf.ekf(model()._replace(sensors={})),
            ValueError,
            r"model\.sensors: expected at least one sensor, got none",
        ),
        (lambda: jf.vector(0), ValueError, r"vector\(n\): expected n >= 1, got 0"),
        (lambda: jf.product(()), TypeError, r"product\(tree\): expected a pytree of Space"),
        (lambda: jf.product({"a": 3}), TypeError, r"product\(tree\): expected a pytree of Space"),
        (lambda: jf.rk4(lambda x, u: u, jf.vector(2), substeps=0), ValueError, r"rk4\(substeps\): expected at least 1"),
    ],
)
def test_filters_and_spaces(make, error, words):
    with pytest.raises(error, match=words):
        make()


def in_float32(tree):
    return jax.tree.map(lambda a: np.float32(a) if np.asarray(a).dtype == np.float64 else a, tree)


def test_a_tiny_alpha_is_refused_in_float32_and_does_in_float64():
    small = model(Q=jf.white(np.eye(3, dtype=np.float32)), R=jf.const(np.eye(2, dtype=np.float32)))
    with pytest.raises(
        ValueError, match=r"unscented\(alpha\): expected alpha >= 0\.035 in float32, got 0\.001: .* digits"
    ):
        jf.ukf(small, alpha=1e-3).predict(in_float32(belief()), np.zeros(2, np.float32), 0.1)
    moved = jf.ukf(model(), alpha=1e-3).predict(belief(), np.ones(2), 0.1)
    np.testing.assert_allclose(moved.mean["pos"], [0.1, 0.1], rtol=1e-9)


T = np.array([0.0, 1.0, 2.0])
MERGES = {
    "NaN stamps": ({"streams": {"compass": (put(T, 1, np.nan), T)}}, ValueError, r"t of 'compass': expected finite"),
    "stamps of wrong shape": ({"streams": {"compass": (T[None], T)}}, ValueError, r"t of 'compass': expected seconds"),
    "z too short": (
        {"streams": {"compass": (T, T[:2])}},
        ValueError,
        r"z of 'compass': expected shapes \(3,\), got \(2,\)",
    ),
    "NaN in z": ({"streams": {"compass": (T, put(T, 2, np.nan))}}, ValueError, r"z of 'compass': .* mark it in valid"),
    "unknown sensor": ({"streams": {"sonar": (T, T)}}, KeyError, r"sensor: expected one of .* got 'sonar'"),
    "a wrong stream": ({"streams": {"compass": T}}, TypeError, r"stream of 'compass': expected Stream"),
    "stamps as dates": (
        {"streams": {"compass": (T.astype("datetime64[s]"), T)}},
        ValueError,
        r"t of 'compass': expected seconds as numbers of shape \(K,\), got datetime64\[s\]\[3\]",
    ),
    "integers in z": ({"streams": {"compass": (T, T.astype(int))}}, TypeError, r"z of 'compass': expected floating"),
    "c too short": (
        {"streams": {"compass": (T, T, {"where": T[:2]})}},
        ValueError,
        r"c of 'compass'\['where'\]: expected leading axis 3, got shape \(2,\)",
    ),
    "NaN in c": ({"streams": {"compass": (T, T, put(T, 1, np.nan))}}, ValueError, r"c of 'compass': expected finite"),
    "valid not bool": (
        {"streams": {"compass": (T, T, (), T)}},
        ValueError,
        r"valid of 'compass': expected bool of shape \(3,\) or \(3, 1\), got float64\[3\]",
    ),
    "valid of wrong width": (
        {"streams": {"gnss": (T, np.zeros((3, 2)), (), np.ones((3, 3), bool))}},
        ValueError,
        r"valid of 'gnss': expected bool of shape \(3,\) or \(3, 2\), got bool\[3, 3\]",
    ),
    "an infinite start": ({"streams": {"compass": (T, T)}, "start": -np.inf}, ValueError, r"start: .* got -inf"),
    "a NaN start": ({"streams": {"compass": (T, T)}, "start": np.nan}, ValueError, r"start: .* got nan"),
    "no pair": ({"streams": {}, "u": T}, TypeError, r"u: expected \(t, values\), got float64\[3\]"),
    "repeated stamps of the input": (
        {"streams": {}, "u": (np.array([0.0, 1, 1]), T)},
        ValueError,
        r"t of u: expected strictly increasing stamps, got 1\.0 and then 1\.0 at 2",
    ),
    "NaN stamps of the input": ({"streams": {}, "u": (put(T, 1, np.nan), T)}, ValueError, r"t of u: expected finite"),
    "integers as input": (
        {"streams": {}, "u": (T, T.astype(int))},
        TypeError,
        r"u: expected floating numbers, got int",
    ),
    "nothing": ({"streams": {}}, ValueError, r"streams: expected at least one reading or input, got none"),
    "late start": (
        {"streams": {"compass": (T, T)}, "start": 0.5},
        ValueError,
        r"start: expected a time not after .* got 0\.5",
    ),
    "unsorted input": (
        {"streams": {"compass": (T, T)}, "u": (T[::-1], np.zeros((3, 2)))},
        ValueError,
        r"t of u: expected strictly increasing stamps, got 2\.0 and then 1\.0 at 1",
    ),
    "NaN input": (
        {"streams": {}, "u": (T, put(np.zeros((3, 2)), (0, 1), np.nan))},
        ValueError,
        r"u: expected finite .* nan",
    ),
    "input too short": ({"streams": {}, "u": (T, np.zeros((2, 2)))}, ValueError, r"u: expected leading axis 3"),
}


@pytest.mark.parametrize(("arguments", "error", "words"), MERGES.values(), ids=MERGES)
def test_merge(arguments, error, words):
    with pytest.raises(error, match=words):
        jf.merge(model(), **arguments)


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"steps": 0, "dt": 0.1}, ValueError, r"steps: expected at least 1, got 0"),
        ({"steps": 3, "dt": -0.1}, ValueError, r"dt: expected a finite interval > 0 s, got -0\.1"),
        ({"steps": 3, "dt": 0.1, "every": {"sonar": 2}}, KeyError, r"sensor: expected one of .* got 'sonar'"),
        (
            {"steps": 3, "dt": 0.1, "every": {"gnss": -1}},
            ValueError,
            r"every\['gnss'\]: expected a whole number of rows",
        ),
        (
            {"steps": 3, "dt": 0.1, "every": {"gnss": 1.5}},
            ValueError,
            r"every\['gnss'\]: expected a whole number of rows >= 0, got 1\.5",
        ),
        ({"steps": 3, "dt": 0.1, "c": {"sonar": T}}, KeyError, r"sensor: expected one of .* got 'sonar'"),
        ({"steps": 3, "dt": 0.1, "c": {"gnss": T[:2]}}, ValueError, r"log\.c\['gnss'\]: expected leading axis 3"),
        ({"steps": 3, "dt": 0.1, "u": np.zeros((2, 2))}, ValueError, r"u: expected leading axis 3, got shape \(2, 2\)"),
    ],
)
def test_schedule(arguments, error, words):
    with pytest.raises(error, match=words):
        jf.schedule(model(), **arguments)


def test_align_and_stack():
    with pytest.raises(ValueError, match=r"t of truth: expected strictly increasing stamps, got 2\.0 and then 1\.0"):
        jf.align(T, (T[::-1], T), jf.angle)
    with pytest.raises(ValueError, match=r"t of truth: expected finite numbers, got nan"):
        jf.align(T, (put(T, 1, np.nan), T), jf.angle)
    with pytest.raises(ValueError, match=r"t of truth: expected at least two stamps, got 1"):
        jf.align(T, (T[:1], T[:1]), jf.angle)
    with pytest.raises(ValueError, match=r"truth: expected shapes \(3,\), got \(2,\)"):
        jf.align(T, (T, T[:2]), jf.angle)
    with pytest.raises(ValueError, match=r"truth: expected finite numbers, got nan at \[2\]"):
        jf.align(T, (T, put(T, 2, np.nan)), jf.angle)
    with pytest.raises(ValueError, match=r"logs: expected at least one, got none"):
        jf.stack([])
    with pytest.raises(ValueError, match=r"logs: expected one structure of u, got float64\[4, 2\] and \(\)"):
        jf.stack([log(), log(u=())])
    with pytest.raises(ValueError, match=r"logs: expected one structure of z, got .*compass.* and {'gnss': float64"):
        jf.stack([log(), log(z={"gnss": GNSS})])


def test_simulate():
    with pytest.raises(TypeError, match=r"belief: expected a Gaussian\(mean, cov\), got dict"):
        jf.simulate(model(), belief().mean, log(), jax.random.key(0))
    with pytest.raises(TypeError, match=r"log: expected a Log, got NoneType"):
        jf.simulate(model(), belief(), None, jax.random.key(0))
    with pytest.raises(KeyError, match=r"sensor: expected one of \['gnss', 'compass'\], got 'radar'"):
        jf.simulate(model(), belief(), log(z={"radar": GNSS}), jax.random.key(0))


def test_scan_runs():
    with pytest.raises(ValueError, match=r"batched: expected fields of .* got \['w'\]"):
        jf.scan_runs(jf.ekf(model()), belief(), log(), batched=("w",))
