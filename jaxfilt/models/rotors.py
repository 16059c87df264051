"""Propellers, where they sit on an airframe, and how their thrusts add up: allocation from geometry.

Frames: the body is x forward, y left, z up; every rotor pushes along body z. Rotors are numbered counterclockwise,
seen from above. A wrench (4,) is what all rotors do together: thrust (N) along z, moments (N m) about x, y, z.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import linalg
from jaxfilt.types import Array

AIR_DENSITY = 1.225
"""kg/m^3 at sea level, 15 C."""


class Propeller(NamedTuple):
    """A propeller: ``T = C_T rho A (Omega R)^2`` and ``M = C_Q rho A (Omega R)^2 R``, thrust N and torque N m.

    ``C_T``, ``C_Q`` dimensionless; ``rho`` kg/m^3; ``A`` disc area m^2; ``R`` radius m; speeds in rad/s.
    The short form is ``T = k_n Omega^2``, ``M = k_m T``, with `k_n` in N s^2 and `k_m` in m.

    Example:
        >>> propeller = Propeller.of_constants(k_n=8.5e-6, k_m=0.016, R=0.1)
        >>> round(propeller.thrust(500.0), 4), round(propeller.torque(500.0), 4)
        (2.125, 0.034)

    Source: Mahony, Kumar, Corke, Multirotor aerial vehicles (2012), eqs. 1 and 5.
    """

    C_T: Array
    C_Q: Array
    rho: Array
    A: Array
    R: Array

    @classmethod
    def of_constants(cls, k_n: float, k_m: float, R: float, rho: float = AIR_DENSITY) -> Propeller:
        """The propeller of a disc of radius R (m) whose short form has k_n (N s^2) and k_m (m)."""
        A = math.pi * R**2
        C_T = k_n / (rho * A * R**2)
        return cls(C_T, k_m * C_T / R, rho, A, R)

    @property
    def k_n(self) -> Array:
        """Thrust over speed squared, N s^2: ``C_T rho A R^2``."""
        return self.C_T * self.rho * self.A * self.R**2

    @property
    def k_m(self) -> Array:
        """Torque over thrust, m: ``C_Q R / C_T``."""
        return self.C_Q * self.R / self.C_T

    def thrust(self, speed: Array) -> Array:
        """Thrust (N) at a speed (rad/s)."""
        return self.k_n * speed**2

    def torque(self, speed: Array) -> Array:
        """Torque (N m) that the air exerts against the rotation."""
        return self.k_m * self.thrust(speed)


class Rotors(NamedTuple):
    """Where n rotors are and which way they turn the body.

    ``pos`` (n, 3) m, body frame; ``reaction`` (n,): +1 where the torque of the air on the rotor turns the body about
    +z, that is where the rotor turns clockwise seen from above, -1 where it turns counterclockwise; ``k_m`` m, torque
    over thrust.
    """

    pos: Array
    reaction: Array
    k_m: Array


def ring(n: int, arm: float, k_m: float, angle: float, first: int = 1) -> Rotors:
    """n rotors on a circle, evenly spaced counterclockwise, turning alternately.

    Args:
        n: number of rotors, even.
        arm: distance of the rotors from the centre, m.
        k_m: torque over thrust, m.
        angle: direction of the first rotor from body x, rad.
        first: reaction of the first rotor about z, +1 or -1.

    Raises:
        ValueError: fewer than four rotors, or an odd number, which cannot turn alternately.
    """
    if n < 4 or n % 2:
        raise ValueError(f"ring(n): expected an even number of rotors, at least 4, got {n}")
    if first not in (1, -1):
        raise ValueError(f"ring(first): expected 1 or -1, got {first}")
    angles = angle + 2 * np.pi * np.arange(n) / n
    pos = arm * np.stack([np.cos(angles), np.sin(angles), np.zeros(n)], axis=1)
    return Rotors(pos, first * (-1.0) ** np.arange(n), k_m)


def quadrotor_plus(arm: float, k_m: float, first: int = 1) -> Rotors:
    """Four rotors: front, left, back, right. Arguments as in `ring`."""
    return ring(4, arm, k_m, 0.0, first)


def quadrotor_x(arm: float, k_m: float, first: int = 1) -> Rotors:
    """Four rotors at 45, 135, 225, 315 degrees: front left, back left, back right, front right. As in `ring`."""
    return ring(4, arm, k_m, np.pi / 4, first)


def hexarotor(arm: float, k_m: float, first: int = 1) -> Rotors:
    """Six rotors at 30, 90, ..., 330 degrees; by default ``M_i = (-1)^(i-1) k_m T_i``. As in `ring`.

    A lecture prints the matrix that `allocation` derives with a wrong sign in M_x, with cos 60 where cos 30 belongs
    in M_y, without the vector of thrusts, and with yaw signs that contradict its own ``(-1)^(i-1)``.
    """
    return ring(6, arm, k_m, np.pi / 6, first)


def allocation(rotors: Rotors) -> jax.Array:
    """The (4, n) matrix A with ``wrench = A thrusts``, from the rotors' positions: ``sum r_i x T_i e_z`` and reactions.

    Rows: thrust ``1``, M_x ``y_i``, M_y ``-x_i``, M_z ``reaction_i k_m``.

    Args:
        rotors: n rotors.

    Example: more thrust on the left than on the right rolls to the right, about +x.
        >>> import jax.numpy as jnp
        >>> A = allocation(quadrotor_plus(arm=0.2, k_m=0.01))
        >>> [round(float(a), 4) for a in A @ jnp.array([1.0, 2.0, 1.0, 1.0])]
        [5.0, 0.2, 0.0, -0.01]
    """
    pos, reaction = jnp.asarray(rotors.pos), jnp.asarray(rotors.reaction)
    return jnp.stack([jnp.ones_like(reaction), pos[:, 1], -pos[:, 0], rotors.k_m * reaction])


def mixer(rotors: Rotors) -> jax.Array:
    """The (n, 4) matrix that gives the smallest thrusts with a wanted wrench: ``A' (A A')^-1``, A^-1 of a quadrotor.

    Args:
        rotors: n >= 4 rotors that can produce every wrench; else the result is NaN.
    """
    A = allocation(rotors)
    return linalg.gain(A.T, linalg.cholesky(A @ A.T))


class Airframe(NamedTuple):
    """What a multirotor is made of.

    ``mass`` kg; ``inertia`` (3,) kg m^2 about the principal axes x, y, z; ``drag`` kg/s, force of all rotors over air
    speed across their axis; ``rotors``; ``max_thrust`` N of one rotor, whose least is 0.
    """

    mass: Array
    inertia: Array
    drag: Array
    rotors: Rotors
    max_thrust: Array


def hummingbird() -> Airframe:
    """AscTec Hummingbird, a quadrotor in + form of 0.72 kg.

    Source: Furrer, Burri, Achtelik, Siegwart, RotorS - a modular Gazebo MAV simulator framework (2016), file
    hummingbird.xacro: 0.68 kg and four rotors of 9 g; drag of 8.06e-5 kg per rotor times its 453 rad/s in hover.
    """
    propeller = Propeller.of_constants(k_n=8.54858e-6, k_m=0.016, R=0.1)
    rotors = quadrotor_plus(arm=0.17, k_m=propeller.k_m)
    return Airframe(0.716, np.array([0.007, 0.007, 0.012]), 0.146, rotors, propeller.thrust(838.0))


def firefly() -> Airframe:
    """AscTec Firefly, a hexarotor of 1.5 kg.

    Source: as `hummingbird`, file firefly.xacro: 1.5 kg and six rotors of 5 g; drag as there, at 541 rad/s. The file's
    inertia about z, 0.0977 kg m^2, is more than those about x and y together, which no body can have: here their sum,
    that of a flat one.
    """
    propeller = Propeller.of_constants(k_n=8.54858e-6, k_m=0.016, R=0.1)
    rotors = hexarotor(arm=0.215, k_m=propeller.k_m, first=-1)
    return Airframe(1.53, np.array([0.0347563, 0.0458929, 0.0806492]), 0.262, rotors, propeller.thrust(838.0))


def crazyflie() -> Airframe:
    """Bitcraze Crazyflie 2.0, a quadrotor in x form of 28 g.

    Source: J. Forster, System identification of the Crazyflie 2.0 nano quadrocopter (2015): mass, inertia, and drag
    of 9.18e-7 kg per rotor times its 2,315 rad/s in hover; propellers from RotorS, file crazyflie2.xacro.
    """
    propeller = Propeller.of_constants(k_n=1.28192e-8, k_m=5.964552e-3, R=0.0225)
    rotors = quadrotor_x(arm=0.046, k_m=propeller.k_m)
    return Airframe(0.028, np.array([1.657e-5, 1.666e-5, 2.926e-5]), 0.0085, rotors, propeller.thrust(2618.0))
