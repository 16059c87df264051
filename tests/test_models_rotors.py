"""Rotors against mechanics worked out by hand: cross products, symmetry, the book's matrices."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilt.models import rotors
from jaxfilt.models.control import GRAVITY

AIRFRAMES = {"hummingbird": rotors.hummingbird(), "firefly": rotors.firefly(), "crazyflie": rotors.crazyflie()}
RINGS = {name: airframe.rotors for name, airframe in AIRFRAMES.items()}
RINGS["askew"] = rotors.Rotors(
    pos=np.array([[0.3, 0.1, 0.05], [-0.1, 0.2, 0.0], [-0.2, -0.3, -0.02], [0.15, -0.2, 0.1], [0.0, 0.4, 0.0]]),
    reaction=np.array([1.0, -1.0, 1.0, -1.0, -1.0]),
    k_m=0.03,
)


def moved_by(ring: rotors.Rotors, thrusts: np.ndarray) -> np.ndarray:
    """Thrust and moments, rotor by rotor: ``r x F`` and the reaction."""
    force, moment = np.zeros(3), np.zeros(3)
    for r, way, T in zip(ring.pos, ring.reaction, thrusts, strict=True):
        F = np.array([0.0, 0.0, T])
        force += F
        moment += np.cross(r, F) + np.array([0.0, 0.0, way * ring.k_m * T])
    return np.r_[force[2], moment]


def test_a_propeller_in_both_forms():
    C_T, C_Q, rho, R, speed = 0.012, 0.0009, 1.2, 0.13, 600.0
    A = math.pi * R**2
    propeller = rotors.Propeller(C_T, C_Q, rho, A, R)
    assert propeller.thrust(speed) == pytest.approx(C_T * rho * A * (speed * R) ** 2)
    assert propeller.torque(speed) == pytest.approx(C_Q * rho * A * (speed * R) ** 2 * R)
    short = rotors.Propeller.of_constants(propeller.k_n, propeller.k_m, R, rho)
    assert tuple(short) == pytest.approx(tuple(propeller))
    assert short.thrust(speed) == pytest.approx(propeller.k_n * speed**2)


@pytest.mark.parametrize("name", RINGS)
def test_allocation_is_the_sum_of_cross_products(name):
    ring, thrusts = RINGS[name], np.random.default_rng(3).uniform(0.1, 2.0, len(RINGS[name].pos))
    np.testing.assert_allclose(rotors.allocation(ring) @ thrusts, moved_by(ring, thrusts), rtol=1e-13, atol=1e-15)


def test_quadrotors_as_in_the_book():
    """Mahony, Kumar, Corke (2012), eq. 6, turned to y left, z up: + with rotors front, left, back, right."""
    l, k = 0.2, 0.01
    plus = [[1, 1, 1, 1], [0, l, 0, -l], [-l, 0, l, 0], [k, -k, k, -k]]
    np.testing.assert_allclose(rotors.allocation(rotors.quadrotor_plus(l, k)), plus, atol=1e-16)
    d = l / math.sqrt(2)
    cross = [[1, 1, 1, 1], [d, d, -d, -d], [-d, d, d, -d], [-k, k, -k, k]]
    np.testing.assert_allclose(rotors.allocation(rotors.quadrotor_x(l, k, first=-1)), cross, atol=1e-16)


def test_the_hexarotor_sits_at_30_degrees_and_turns_alternately():
    l, k = 0.3, 0.02
    ring = rotors.hexarotor(l, k)
    degrees = np.degrees(np.arctan2(ring.pos[:, 1], ring.pos[:, 0])) % 360
    np.testing.assert_allclose(degrees, [30, 90, 150, 210, 270, 330])
    half, root = l / 2, l * math.sqrt(3) / 2
    by_hand = [
        [1, 1, 1, 1, 1, 1],
        [half, l, half, -half, -l, -half],
        [-root, 0, root, root, 0, -root],
        [k, -k, k, -k, k, -k],
    ]
    np.testing.assert_allclose(rotors.allocation(ring), by_hand, atol=1e-16)


def test_the_hexarotor_is_symmetric():
    ring = rotors.hexarotor(0.3, 0.02)
    A, mixer = np.asarray(rotors.allocation(ring)), np.asarray(rotors.mixer(ring))
    np.testing.assert_allclose(A @ np.full(6, 2.0), [12, 0, 0, 0], atol=1e-15)
    yawing = mixer @ np.array([0.0, 0.0, 0.0, 0.12])
    np.testing.assert_allclose(yawing, [1, -1, 1, -1, 1, -1], rtol=1e-12)
    np.testing.assert_allclose(moved_by(ring, yawing), [0, 0, 0, 0.12], atol=1e-15)
    # A third of a turn brings the ring onto itself, so it turns roll and pitch moments into each other.
    thrusts = np.random.default_rng(4).uniform(0, 1, 6)
    c, s = math.cos(2 * math.pi / 3), math.sin(2 * math.pi / 3)
    turned = np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]])
    np.testing.assert_allclose(A @ np.roll(thrusts, 2), turned @ A @ thrusts, atol=1e-15)


@pytest.mark.parametrize("name", RINGS)
def test_the_mixer_gives_the_smallest_thrusts_with_the_wrench(name):
    A, mixer = rotors.allocation(RINGS[name]), rotors.mixer(RINGS[name])
    np.testing.assert_allclose(A @ mixer, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(mixer, np.linalg.pinv(A), rtol=1e-9, atol=1e-9)


def test_the_mixer_of_rotors_that_cannot_roll_is_nan():
    in_line = rotors.Rotors(np.diag([1.0, 2.0, 3.0, 4.0])[:, :3] * [1, 0, 0], np.array([1.0, -1.0, 1.0, -1.0]), 0.1)
    assert np.isnan(rotors.mixer(in_line)).any()


def test_gradient_with_respect_to_the_arm():
    def thrust_of_the_first(arm):
        ring = RINGS["firefly"]
        return rotors.mixer(ring._replace(pos=arm * jnp.asarray(ring.pos)))[0, 1]

    slope = jax.grad(thrust_of_the_first)(1.3)
    step = 1e-6
    numeric = (thrust_of_the_first(1.3 + step) - thrust_of_the_first(1.3 - step)) / (2 * step)
    assert slope == pytest.approx(float(numeric), rel=1e-7)
    assert slope == pytest.approx(-float(thrust_of_the_first(1.3)) / 1.3, rel=1e-9)


@pytest.mark.parametrize("name", AIRFRAMES)
def test_presets_can_fly(name):
    airframe = AIRFRAMES[name]
    share = airframe.mass * GRAVITY / (len(airframe.rotors.pos) * airframe.max_thrust)
    assert 0.25 < share < 0.8
    x, y, z = airframe.inertia
    assert z <= x + y, "no body has a larger moment of inertia than the sum of the other two"


@pytest.mark.parametrize(("n", "first"), [(5, 1), (2, 1), (4, 2)])
def test_rings_that_are_none(n, first):
    with pytest.raises(ValueError, match="expected"):
        rotors.ring(n, 0.2, 0.01, 0.0, first)
