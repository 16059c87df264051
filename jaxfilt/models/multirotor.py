"""Multirotors as rigid bodies: attitude on SO(3), and the textbook's form with Euler angles.

Frames, everywhere: the world is z up (east, north, up); the body is x forward, y left, z up. Attitude is a unit
quaternion (w, x, y, z), body to world. Euler angles are roll, pitch, yaw (3-2-1): ``R = Rz(yaw) Ry(pitch) Rx(roll)``,
body to world, pitch positive nose down, yaw positive to the left. A lecture mixes a force that is z up with kinematics
that are z down: here is one frame. Parameters ``theta`` are natural logarithms, all of them: of masses, inertias, drags
and of standard deviations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.elementary import bearing, norm, wrap
from jaxfilt.integrate import Rate, rk4
from jaxfilt.log import schedule
from jaxfilt.models.control import GRAVITY, controller, figure_eight
from jaxfilt.models.parts import start
from jaxfilt.models.rotors import Airframe, firefly, hummingbird
from jaxfilt.models.sensors import gnss_position, gnss_velocity, gyroscope, mocap_pose
from jaxfilt.noise import const, diagonal, white
from jaxfilt.spaces import product, quaternion_product, rotate, so3, vector
from jaxfilt.types import Array, Gaussian, Log, Model, PyTree, Scenario, Sensor, Space

Integrator = Callable[[Rate, Space], Callable[[PyTree, PyTree, Array], PyTree]]


class RigidBody(NamedTuple):
    """A body in the air: the state of `multirotor`; as a rate, the tangent velocity of each field."""

    pos: Array
    """(3,) m, world: the centre of mass."""
    vel: Array
    """(3,) m/s, world."""
    att: Array
    """(4,) quaternion, body to world."""
    rates: Array
    """(3,) rad/s, body."""


class EulerBody(NamedTuple):
    """The same with Euler angles: the state of `euler_multirotor`."""

    pos: Array
    """(3,) m, world."""
    vel: Array
    """(3,) m/s, world."""
    rpy: Array
    """(3,) rad: roll, pitch, yaw."""
    rates: Array
    """(3,) rad/s, body."""


ANGLES = Space(3, lambda x, d: wrap(x + d), lambda a, b: wrap(a - b), np.zeros(3), flat=True)
"""Three angles, (3,) rad."""

BODY = product(RigidBody(vector(3), vector(3), so3, vector(3)))
EULER_BODY = product(EulerBody(vector(3), vector(3), ANGLES, vector(3)))


def rigid_body_rate(x: RigidBody, force: Array, moment: Array, mass: Array, inertia: Array) -> RigidBody:
    """How a rigid body moves: ``v_dot = R f/m - g e_z``, ``R_dot = R [w]x``, ``J w_dot = M - w x J w``.

    (Lectures print ``M_x/m, M_y/m, M_z/z`` for ``M_x/J_x, M_y/J_y, M_z/J_z``, and ``(J_x - J_y)/J_z q r`` for
    ``(J_x - J_y)/J_z p q``.)

    Args:
        x: the state.
        force: (3,) N, body frame, all but gravity.
        moment: (3,) N m, body frame, about the centre of mass.
        mass: () kg.
        inertia: (3,) kg m^2, about the principal axes, which are those of the body.

    Returns:
        RigidBody of tangent velocities: pos m/s, vel m/s^2, att rad/s (body), rates rad/s^2.

    Example: a top that spins about its axis keeps spinning.
        >>> import jax.numpy as jnp
        >>> x = RigidBody(jnp.zeros(3), jnp.zeros(3), jnp.array([1.0, 0, 0, 0]), jnp.array([0.0, 0.0, 5.0]))
        >>> rigid_body_rate(x, jnp.zeros(3), jnp.zeros(3), 1.0, jnp.array([1.0, 1.0, 2.0])).rates.tolist()
        [0.0, 0.0, 0.0]

    Source: Mahony, Kumar, Corke, Multirotor aerial vehicles (2012), eq. 4, with z up.
    """
    return RigidBody(x.vel, rotate(x.att, force) / mass + _gravity(x.vel), x.rates, _turn(x.rates, moment, inertia))


def multirotor_rate(x: RigidBody, wrench: Array, mass: Array, inertia: Array, drag: Array) -> RigidBody:
    """`rigid_body_rate` under a wrench of rotors along body z, and their drag: ``f = T e_z - drag v_across``.

    Args:
        x: the state.
        wrench: (4,) thrust N along body z, moments N m about the body's axes: ``allocation(rotors) @ thrusts``.
        mass: () kg.
        inertia: (3,) kg m^2.
        drag: () kg/s: force over the air speed across the rotors' axis.

    Source: Martin, Salaun, The true role of accelerometer feedback in quadrotor control (2010), eq. 4.
    """
    up = rotate(x.att, jnp.asarray([0.0, 0.0, 1.0], x.att.dtype))
    return RigidBody(
        x.vel, _accelerated(x.vel, up, wrench[0], mass, drag), x.rates, _turn(x.rates, wrench[1:], inertia)
    )


SINGULAR = math.cos(math.radians(85))
"""Least cosine of the pitch at which Euler angles are flown: a loop at 100 Hz cannot leap over what is left out."""


def euler_rate(x: EulerBody, wrench: Array, mass: Array, inertia: Array, drag: Array) -> EulerBody:
    """`multirotor_rate` with Euler angles: ``[roll pitch yaw]_dot = W [p q r]``.

    ``W = [[1, s_roll t_pitch, c_roll t_pitch], [0, c_roll, -s_roll], [0, s_roll / c_pitch, c_roll / c_pitch]]``,
    which is singular at a pitch of +-90 deg: fly with `multirotor_rate` what may come near it. Where the cosine of the
    pitch is less than `SINGULAR`, and beyond, the angles' rates are NaN: an estimate that got there has lost its
    meaning, and a filter's status and `jaxfilt.diagnose` say where, in place of angles that look like any others.

    Args:
        x: the state.
        wrench, mass, inertia, drag: as in `multirotor_rate`.

    Source: R. W. Beard, T. W. McLain, Small Unmanned Aircraft (2012), eq. 3.3.
    """
    (sr, sp, _), (cr, cp, _) = jnp.sin(x.rpy), jnp.cos(x.rpy)
    p, q, r = x.rates
    turning = sr * q + cr * r
    proper = cp > SINGULAR
    cp = jnp.where(proper, cp, 1.0)
    rpy = jnp.where(proper, jnp.stack([p + turning * sp / cp, cr * q - sr * r, turning / cp]), jnp.nan)
    acc = _accelerated(x.vel, body_to_world(x.rpy)[:, 2], wrench[0], mass, drag)
    return EulerBody(x.vel, acc, rpy, _turn(x.rates, wrench[1:], inertia))


def _gravity(like: Array) -> jax.Array:
    return jnp.asarray([0.0, 0.0, -GRAVITY], like.dtype)


def _accelerated(vel: Array, up: Array, thrust: Array, mass: Array, drag: Array) -> jax.Array:
    """Acceleration (3,) m/s^2, world, under a thrust along the unit vector up and drag across it."""
    across = vel - (vel @ up) * up
    return (thrust * up - drag * across) / mass + _gravity(vel)


def _turn(rates: Array, moment: Array, inertia: Array) -> jax.Array:
    """Euler's equations: angular acceleration (3,) rad/s^2, body."""
    return (moment - jnp.cross(rates, inertia * rates)) / inertia


def body_to_world(rpy: Array) -> jax.Array:
    """Rotation matrix (3, 3) of roll, pitch, yaw (3,) rad: ``Rz(yaw) Ry(pitch) Rx(roll)``, body to world.

    Example:
        >>> import math, jax.numpy as jnp
        >>> (body_to_world(jnp.array([0.0, 0.0, math.pi / 2])).round(4) + 0.0).tolist()
        [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    (sr, sp, sy), (cr, cp, cy) = jnp.sin(rpy), jnp.cos(rpy)
    return jnp.stack(
        [
            jnp.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr]),
            jnp.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr]),
            jnp.stack([-sp, cp * sr, cp * cr]),
        ]
    )


def from_euler(x: EulerBody) -> RigidBody:
    """The same body with its attitude as a quaternion."""
    (sr, sp, sy), (cr, cp, cy) = jnp.sin(0.5 * x.rpy), jnp.cos(0.5 * x.rpy)
    nought = jnp.zeros_like(sr)
    roll, pitch = jnp.stack([cr, sr, nought, nought]), jnp.stack([cp, nought, sp, nought])
    yaw = jnp.stack([cy, nought, nought, sy])
    return RigidBody(x.pos, x.vel, quaternion_product(quaternion_product(yaw, pitch), roll), x.rates)


def to_euler(x: RigidBody) -> EulerBody:
    """The same body with Euler angles, pitch within +-90 deg; with the nose straight up or down, roll and yaw are not
    defined.

    Example:
        >>> import jax.numpy as jnp
        >>> x = EulerBody(jnp.zeros(3), jnp.zeros(3), jnp.array([0.1, -0.2, 3.0]), jnp.zeros(3))
        >>> [round(float(a), 4) for a in to_euler(from_euler(x)).rpy]
        [0.1, -0.2, 3.0]
    """
    x1, x2, x3 = [rotate(x.att, axis) for axis in jnp.eye(3, dtype=x.att.dtype)]
    roll, yaw = bearing(jnp.stack([x3[2], x2[2]])), bearing(x1[:2])
    return EulerBody(x.pos, x.vel, jnp.stack([roll, jnp.arctan2(-x1[2], norm(x1[:2])), yaw]), x.rates)


def split_step(rate: Rate, space: Space) -> Callable[[PyTree, PyTree, Array], PyTree]:
    """Second order with a single turn of the attitude: the midpoint rule for rotation, then Heun's for translation.

    ``w_m = w + dt/2 w_dot(w)``, ``q' = q Exp(dt w_m)``, ``w' = w + dt w_dot(w_m)``; ``v' = v + dt/2 (a + a')`` with a'
    at the turned attitude, ``p' = p + dt/2 (v + v')``. It wants angular accelerations that depend on the rates alone.
    At 100 Hz it differs from `rk4` by less than a hundredth of the noise of one step, and an EKF with it compiles in
    half the time and runs twice as fast.

    Args:
        rate: function of (x, u), x and its value a `RigidBody`.
        space: of a `RigidBody`.

    Returns:
        ``f(x, u, dt)`` for a `Model`.

    Source: Hairer, Lubich, Wanner, Geometric Numerical Integration (2006), sections II.1 and IV.8.
    """

    def f(x: PyTree, u: PyTree, dt: Array) -> PyTree:
        now = rate(x, u)
        middle = x._replace(rates=x.rates + 0.5 * dt * now.rates)
        turn = rate(middle, u)
        guess = space.plus(x, dt * jnp.concatenate([x.vel, now.vel, turn.att, turn.rates]))
        vel = x.vel + 0.5 * dt * (now.vel + rate(guess, u).vel)
        return guess._replace(pos=x.pos + 0.5 * dt * (x.vel + vel), vel=vel)

    return f


def parameters(airframe: Airframe, gust: float = 0.3, shake: float = 0.5) -> dict[str, Any]:
    """``theta`` of an airframe, flown with usual sensors: natural logarithms, of

    mass (kg), inertia (kg m^2 about x, y, z), drag (kg/s); the densities of white noise force (N sqrt(s), on each axis)
    and torque (N m sqrt(s), about x, y, z); the standard deviations position (m horizontal, m vertical), velocity
    (m/s), pose (m, rad), gyro (rad/s), and start (m, m/s, rad, rad/s).

    Args:
        airframe: from `jaxfilt.models.rotors`.
        gust: force density over mass, (m/s)/sqrt(s).
        shake: torque density over inertia, (rad/s)/sqrt(s).

    Example: the weight of a Hummingbird.
        >>> import math
        >>> round(math.exp(parameters(hummingbird())["mass"]), 4)
        0.716
    """
    return {
        "mass": math.log(airframe.mass),
        "inertia": tuple(math.log(J) for J in airframe.inertia),
        "drag": math.log(airframe.drag),
        "force": math.log(gust * airframe.mass),  # chosen: a gust of 0.3 m/s in 1 s
        "torque": tuple(math.log(shake * J) for J in airframe.inertia),  # chosen: uneven rotors, 0.5 rad/s in 1 s
        "position": (math.log(1.0), math.log(1.5)),  # m: a consumer's GNSS receiver
        "velocity": math.log(0.1),  # m/s: the same receiver's Doppler velocity
        "pose": (math.log(0.005), math.log(0.01)),  # m, rad: motion capture of a small marker tree
        "gyro": math.log(0.02),  # rad/s: a MEMS gyroscope among spinning rotors
        "start": (math.log(0.1), math.log(0.1), math.log(0.05), math.log(0.1)),  # m, m/s, rad, rad/s
    }


HUMMINGBIRD = parameters(hummingbird())
"""A quadrotor of 0.7 kg in a hall: ``theta`` of `multirotor` and `euler_multirotor`."""


def multirotor(theta: PyTree = HUMMINGBIRD, integrate: Integrator = split_step) -> Model:
    """A multirotor of any number of rotors, driven by their wrench: `multirotor_rate`, disturbed by white noise.

    White force (world frame) and torque (body frame) disturb velocity and rates, with ``B = [0; 1/m; 0; 1/J]``:
    ``Q = B diag(force^2, torque^2) B' dt``.

    Args:
        theta: see `parameters`, which makes one of an airframe.
        integrate: `split_step`, or `jaxfilt.rk4` or `jaxfilt.euler`.

    Returns:
        A model on `RigidBody` (12 dimensions: position, velocity, attitude, rates) with a wrench (4,) as input, see
        `multirotor_rate`, and sensors "position" (GNSS, (3,) m), "velocity" (GNSS, (3,) m/s), "pose" (motion capture:
        position and attitude), "gyro" (body rates, (3,) rad/s).

    Example: hover is an equilibrium.
        >>> import jax.numpy as jnp
        >>> x = RigidBody(jnp.zeros(3), jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))
        >>> y = multirotor().f(x, jnp.array([0.716 * 9.81, 0.0, 0.0, 0.0]), 0.01)
        >>> bool(jnp.abs(y.vel).max() < 1e-6)
        True
    """
    theta = jax.tree.map(jnp.asarray, theta)
    physics = _physics(theta)
    f = integrate(lambda x, u: multirotor_rate(x, u, *physics), BODY)
    return Model(f, _disturbance(theta), BODY, _sensors(theta, mocap_pose(_pose_noise(theta))))


def euler_multirotor(theta: PyTree = HUMMINGBIRD, integrate: Integrator = rk4) -> Model:
    """`multirotor` in the textbook's form with Euler angles, singular at a pitch of +-90 deg: `euler_rate`.

    Args:
        theta: see `parameters`; the pose's attitude noise is that of roll, pitch and yaw.
        integrate: `jaxfilt.rk4` or `jaxfilt.euler`.

    Returns:
        A model on `EulerBody` (12 dimensions: position, velocity, roll-pitch-yaw, rates) with the input and the sensors
        of `multirotor`, where "pose" is (position, roll-pitch-yaw).
    """
    theta = jax.tree.map(jnp.asarray, theta)
    physics = _physics(theta)
    f = integrate(lambda x, u: euler_rate(x, u, *physics), EULER_BODY)
    pose = Sensor(lambda x, c: (x.pos, x.rpy), const(_pose_noise(theta)), product((vector(3), ANGLES)))
    return Model(f, _disturbance(theta), EULER_BODY, _sensors(theta, pose))


def _physics(theta: PyTree) -> tuple[Array, Array, Array]:
    return jnp.exp(theta["mass"]), jnp.exp(jnp.stack(theta["inertia"])), jnp.exp(theta["drag"])


def _disturbance(theta: PyTree) -> Callable[[PyTree, PyTree, Array], Array]:
    """Neither form's attitude is disturbed directly, so that both have the same Q."""
    mass, inertia, _ = _physics(theta)
    still = jnp.zeros(3, inertia.dtype)
    gust, shake = jnp.exp(theta["force"]) / mass, jnp.exp(jnp.stack(theta["torque"])) / inertia
    return white(diagonal(still, still + gust, still, shake))


def _pose_noise(theta: PyTree) -> Array:
    m, rad = jnp.exp(jnp.stack(theta["pose"]))
    return diagonal(m, m, m, rad, rad, rad)


def _sensors(theta: PyTree, pose: Sensor) -> dict[str, Sensor]:
    horizontal, up = jnp.exp(jnp.stack(theta["position"]))
    speed, turn = jnp.exp(theta["velocity"]), jnp.exp(theta["gyro"])
    return {
        "position": gnss_position(diagonal(horizontal, horizontal, up)),
        "velocity": gnss_velocity(diagonal(speed, speed, speed)),
        "pose": pose,
        "gyro": gyroscope(diagonal(turn, turn, turn)),
    }


BLOCKS = {
    "position": ((0, 1, 2), "m"),
    "velocity": ((3, 4, 5), "m/s"),
    "attitude": ((6, 7, 8), "rad"),
    "rates": ((9, 10, 11), "rad/s"),
}

DT = 0.01
"""s: 100 Hz, a flight controller's outer loop."""


def multirotor_start(theta: PyTree = HUMMINGBIRD) -> Gaussian:
    """Level at the start of the usual figure eight, at its speed, with the standard deviations ``theta["start"]``."""
    return start(RigidBody(*_departure(), so3.origin, np.zeros(3)), *_uncertainty(theta))


def euler_start(theta: PyTree = HUMMINGBIRD) -> Gaussian:
    """`multirotor_start` with Euler angles."""
    return start(EulerBody(*_departure(), np.zeros(3), np.zeros(3)), *_uncertainty(theta))


def _departure() -> tuple[Array, Array]:
    path = figure_eight(1, DT)
    return path.pos[0], path.vel[0]


def _uncertainty(theta: PyTree) -> list[Array]:
    return [jnp.exp(jnp.asarray(log_std)) for log_std in theta["start"] for _ in range(3)]


def scenario() -> Scenario:
    """The usual flight: a figure eight of 4 m in 8 s in a motion capture hall, pose at 20 Hz, gyroscope at 100 Hz.

    Mild: the attitude is always known to a degree or two, so that EKF and UKF are both consistent.
    """
    return _flight(multirotor, multirotor_start, HUMMINGBIRD, hummingbird(), {"pose": 5})


def hexarotor_scenario() -> Scenario:
    """The usual flight with a hexarotor of 1.5 kg, the Firefly."""
    return _flight(multirotor, multirotor_start, parameters(firefly()), firefly(), {"pose": 5})


def euler_scenario() -> Scenario:
    """The usual flight in Euler angles, which it never brings near their singularity."""
    fly = controller(hummingbird())
    flight = _flight(euler_multirotor, euler_start, HUMMINGBIRD, hummingbird(), {"pose": 5})
    return flight._replace(control=lambda x, reference: fly(from_euler(x), reference))


LOST_HUMMINGBIRD = HUMMINGBIRD | {"start": (math.log(0.3), math.log(0.3), math.log(0.5), math.log(0.3))}
"""The quadrotor thrown into the air outdoors: it hardly knows its attitude, to 30 deg about each axis."""


def harsh_scenario() -> Scenario:
    """Thrown into the air and off at speed: a figure eight of 4 m in 4 s, GNSS position at 5 Hz and a gyroscope.

    The attitude is known to 0.5 rad about each axis at the start, and only how the position answers the thrust tells
    more. The EKF believes its first linearisations: its mean NEES is some four times the state's dimension, the UKF's
    twice.
    """
    every = {"position": 20, "pose": 0}
    return _flight(multirotor, multirotor_start, LOST_HUMMINGBIRD, hummingbird(), every, period=4.0)


def _flight(
    model: Callable[[PyTree], Model],
    belief: Callable[[PyTree], Gaussian],
    theta: PyTree,
    airframe: Airframe,
    every: dict[str, int],
    period: float = 8.0,
) -> Scenario:
    silent = {"position": 0, "velocity": 0}

    def fly(steps: int) -> Log:
        return schedule(model(theta), steps, DT, every=silent | every, u=figure_eight(steps, DT, period=period))

    return Scenario(model, belief, theta, fly, BLOCKS, controller(airframe))
