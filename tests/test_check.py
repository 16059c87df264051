"""check: a model's faults in words, and what its sensors can see."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf


def hidden_bias(H):
    """State [r, r_dot, b, i] of the lecture: r_dot is driven by the bias b and the decaying i."""
    A = np.array([[1, 0.01, 0, 0], [0, 0, 1, 1], [0, 0, 1, 0], [0, 0, 0, 0.99]])
    return jf.linear(A, H=np.atleast_2d(H), Q=1e-4 * np.eye(4), R=np.eye(len(np.atleast_2d(H))))


def textbook_rank(A, H):
    return np.linalg.matrix_rank(np.concatenate([H @ np.linalg.matrix_power(A, k) for k in range(len(A))]))


@pytest.mark.parametrize(("H", "rank"), [([1.0, 0, 0, 0], 4), ([0, 1.0, 0, 0], 3)])
def test_observability_of_the_hidden_bias(H, rank):
    model = hidden_bias(H)
    found = jf.check(model, np.zeros(4), dt=0.01)
    A = np.stack([model.f(e, (), 0.01) for e in np.eye(4)], axis=1)
    assert found.rank == rank == textbook_rank(A, np.atleast_2d(H))
    assert found.ok
    assert ("not determined: x[0]" in str(found)) == (rank == 3)


def test_a_car_without_a_heading_sensor_sees_its_heading_only_when_it_moves():
    space = jf.product({"pos": jf.vector(2), "yaw": jf.angle, "speed": jf.scalar})

    def f(x, u, dt):
        step = dt * x["speed"] * jnp.stack([jnp.cos(x["yaw"]), jnp.sin(x["yaw"])])
        return {"pos": x["pos"] + step, "yaw": x["yaw"], "speed": x["speed"]}

    gnss = jf.Sensor(lambda x, c: x["pos"], jf.const(np.eye(2)), jf.vector(2))
    model = jf.Model(f, jf.white(np.eye(4)), space, {"gnss": gnss})
    moving = {"pos": np.zeros(2), "yaw": np.array(0.3), "speed": np.array(5.0)}
    assert jf.check(model, moving).rank == 4
    parked = jf.check(model, {**moving, "speed": np.array(0.0)})
    assert parked.rank == 3
    assert "not determined: yaw" in str(parked)


def test_attitude_components_are_named():
    space = jf.product({"att": jf.so3, "pos": jf.vector(3)})
    sensor = jf.Sensor(
        lambda x, c: jf.rotate_back(x["att"], jnp.array([0.0, 0.0, 9.81])), jf.const(np.eye(3)), jf.vector(3)
    )
    model = jf.Model(lambda x, u, dt: x, jf.const(np.eye(6)), space, {"accelerometer": sensor})
    found = jf.check(model, {"att": np.array([1.0, 0, 0, 0]), "pos": np.zeros(3)})
    assert found.rank == 2
    assert "not determined: att[2], pos[0], pos[1], pos[2]" in str(found)
    assert "a covariance per step" in str(found)


def faulty(**changes):
    good = {"f": lambda x, u, dt: x, "Q": jf.white(np.eye(2)), "h": lambda x, c: x[:1], "R": lambda x, c: np.eye(1)}
    parts = {**good, **changes}
    sensor = jf.Sensor(parts["h"], parts["R"], jf.vector(1))
    return jf.check(jf.Model(parts["f"], parts["Q"], jf.vector(2), {"z": sensor}), np.zeros(2))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"f": lambda x, u, dt: x[:1]}, r"f: expected shapes (2,), got (1,)"),
        ({"f": lambda x, u, dt: x / 0.0}, "f: returned"),
        ({"f": lambda x, u, dt: jnp.sqrt(jnp.abs(x))}, "f: its derivative with respect to x[0], x[1] is not finite"),
        ({"Q": lambda x, u, dt: -dt * np.eye(2)}, "Q(x, u, dt): expected variances >= 0 on the diagonal, got -0.1"),
        ({"Q": lambda x, u, dt: np.array([[1.0, 0.5], [0.2, 1.0]])}, "Q(x, u, dt): expected a symmetric matrix"),
        ({"h": lambda x, c: x}, "sensor 'z': h: expected shapes (1,), got (2,)"),
        ({"h": lambda x, c: {"a": x}}, "sensor 'z': h: expected a pytree of shapes (1,), got {'a': float64[2]}"),
        ({"R": lambda x, c: np.ones((2, 2))}, "sensor 'z': R: expected shape (1, 1), got (2, 2)"),
        ({"R": lambda x, c: np.array([[np.nan]])}, "sensor 'z': R: expected finite numbers, got nan"),
    ],
)
def test_faults_in_words(changes, words):
    found = faulty(**changes)
    assert not found.ok
    assert words in found.findings[0]


def test_a_sound_model_has_no_fault():
    assert faulty().ok


def test_a_state_of_another_model_is_refused_at_once():
    with pytest.raises(ValueError, match=r"x: expected shapes \(4,\), got \(3,\)"):
        jf.check(hidden_bias([1.0, 0, 0, 0]), np.zeros(3))
