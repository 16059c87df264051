"""What cameras tell: how the ground moves below, where a target is seen, how one moved since a key frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxfilt.elementary import norm
from jaxfilt.models.sensors.options import Option, chosen
from jaxfilt.models.sensors.ranging import Terrain, terrain_range, tilt_range
from jaxfilt.noise import const
from jaxfilt.spaces import product, quaternion_conjugate, quaternion_product, rotate_back, so3, vector
from jaxfilt.types import Array, Model, PyTree, Sensor

NEAREST = 0.1
"""m: least depth at which a point is taken to be in front of a camera."""

_H = math.sqrt(0.5)
FORWARD_CAMERA = (0.5, -0.5, 0.5, -0.5)
"""Quaternion from a camera that looks along body x to the body. Camera axes: x right, y down in the picture, z out."""
DOWNWARD_CAMERA = (0.0, _H, -_H, 0.0)
"""Of one that looks down along -z, the top of its picture to the front."""


def ground_flow(vel: Array, att: Array, rates: Array, distance: Array) -> jax.Array:
    """Optical flow (2,) rad/s of a camera that looks down: how the ground below moves in the body's frame.

    ``flow = -(R' vel)_xy / distance + (rates_y, -rates_x)``, at the middle of the picture, where it is exact for any
    tilt and slope. Flying forward the ground moves backwards: flow_x < 0; nosing down (rates_y > 0) it moves forward.
    So ``(R' vel)_xy = ((rates_y, -rates_x) - flow) distance``: it takes the range and the gyroscope to get a velocity.
    Lives on ``vector(2)``. Usual rate: 50-100 Hz.

    Args:
        vel: (3,) m/s, world.
        att: (4,) quaternion.
        rates: (3,) rad/s, body.
        distance: () m > 0, along the body's z axis down to the ground: `tilt_range`.

    Example: 1 m/s forward, 2 m up.
        >>> import jax.numpy as jnp
        >>> level = jnp.array([1.0, 0.0, 0.0, 0.0])
        >>> (ground_flow(jnp.array([1.0, 0.0, 0.0]), level, jnp.zeros(3), jnp.asarray(2.0)) + 0.0).tolist()
        [-0.5, 0.0]

    Source: D. Honegger, L. Meier, P. Tanskanen, M. Pollefeys, An open source and open hardware embedded metric optical
    flow CMOS camera (2013), section III, at the middle of the picture, with z up and the depth along -z.
    """
    own = rotate_back(att, vel)
    return -own[:2] / distance + jnp.stack([rates[1], -rates[0]])


def in_camera(pos: Array, att: Array, point: Array, mount: Array, arm: Array | float = 0.0) -> jax.Array:
    """A point (3,) m, world, in the axes of a camera (right, down, out): ``R_c' (R' (point - pos) - arm)``.

    Args:
        pos: (3,) m, world.
        att: (4,) quaternion, body to world.
        point: (3,) m, world.
        mount: (4,) quaternion, camera to body, such as `FORWARD_CAMERA`.
        arm: (3,) m, body: the camera's place.
    """
    return rotate_back(mount, rotate_back(att, point - pos) - arm)


def image_point(pos: Array, att: Array, point: Array, mount: Array, arm: Array | float = 0.0) -> jax.Array:
    """Where a camera sees a point: normalised image coordinates (2,) ``(x/z, y/z)``, right and down, focal length 1.

    Pixels are ``focal length (px) times that, plus the principal point``, once the lens's distortion is taken off.
    Nearer than 0.1 m, or behind the camera, the depth z is held at 0.1 m; no camera sees that. Lives on ``vector(2)``.
    Usual rate: 5-30 Hz.

    Args:
        pos, att, point, mount, arm: as of `in_camera`.

    Example: 10 m in front, 1 m to the left.
        >>> import jax.numpy as jnp
        >>> level, mount = jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array(FORWARD_CAMERA)
        >>> seen = image_point(jnp.zeros(3), level, jnp.array([10.0, 1.0, 0.0]), mount)
        >>> [round(float(a), 4) + 0.0 for a in seen]
        [-0.1, 0.0]

    Source: R. Hartley, A. Zisserman, Multiple View Geometry in Computer Vision (2004), eq. 6.1 with f = 1.
    """
    seen = in_camera(pos, att, point, mount, arm)
    return seen[:2] / jnp.maximum(seen[2], NEAREST)


def direction_to(pos: Array, att: Array, point: Array, mount: Array, arm: Array | float = 0.0) -> jax.Array:
    """The same as a unit vector (3,), camera axes: for wide angles, and finite everywhere; 0 at the camera itself.

    Lives, nearly, on ``vector(3)``: isotropic noise of standard deviation s rad lets it leave the sphere by s^2.

    Args:
        pos, att, point, mount, arm: as of `in_camera`.
    """
    seen = in_camera(pos, att, point, mount, arm)
    distance = norm(seen)
    return seen / jnp.where(distance > 0, distance, 1.0)


def relative_pose(pos: Array, att: Array, pos0: Array, att0: Array) -> tuple[jax.Array, jax.Array]:
    """Where one is since a key frame, in its axes: ``(R0' (pos - pos0), att0* att)``: visual or lidar odometry.

    Lives on ``product((vector(3), so3))``: m, and quaternion. Usual rate: 10-30 Hz.

    The key frame's own pose is not known better than the state was then, and its error is correlated with the present
    one. So it belongs into the state, as a copy made at the key frame: see `with_key_frame`. A pose that is known from
    elsewhere (a map) can be the reading's context.

    Args:
        pos: (3,) m, world.
        att: (4,) quaternion.
        pos0: (3,) m, world: at the key frame.
        att0: (4,) quaternion.

    Source: S. I. Roumeliotis, J. W. Burdick, Stochastic cloning: a generalized framework for processing relative state
    measurements (2002), section III, with the attitude.
    """
    return rotate_back(att0, pos - pos0), quaternion_product(quaternion_conjugate(att0), att)


class Keyed(NamedTuple):
    """A state and the pose that it had at the last key frame: the state of `with_key_frame`."""

    now: PyTree
    """The state of the model itself, with fields ``pos`` and ``att``."""
    pos: Array
    """(3,) m, world: at the key frame."""
    att: Array
    """(4,) quaternion, at the key frame."""


class Marked(NamedTuple):
    """The input of a model `with_key_frame`."""

    u: PyTree
    """The input of the model itself."""
    key: Array
    """() 1.0 where the row starts at a key frame, and the pose is copied; else 0.0."""


def with_key_frame(model: Model, odometry: dict[str, Array]) -> Model:
    """A model that keeps a copy of its pose at the last key frame, and measures from there.

    Where ``u.key`` is set, the pose of the end of the row before, with all its correlations, is copied before the state
    moves on; else the copy stays as it is, without noise. A row with ``dt = 0`` sets no key.

    Args:
        model: with fields ``pos`` (3,) and ``att`` (4,) in its state.
        odometry: name -> R (6, 6) m^2 and rad^2: sensors of `relative_pose`, besides those of the model.

    Returns:
        A model on `Keyed` (6 dimensions more) with input `Marked`. The covariance of a belief just after a key frame is
        singular, and meant to be.

    Example:
        >>> import jax.numpy as jnp
        >>> from jaxfilt.models.multirotor import multirotor
        >>> with_key_frame(multirotor(), {"visual": 1e-4 * jnp.eye(6)}).space.dim
        18

    Source: Roumeliotis, Burdick (2002), section III.
    """

    def f(x: Keyed, u: Marked, dt: Array) -> Keyed:
        key = u.key != 0
        pos, att = jnp.where(key, x.now.pos, x.pos), jnp.where(key, x.now.att, x.att)
        return Keyed(model.f(x.now, u.u, dt), pos, att)

    def Q(x: Keyed, u: Marked, dt: Array) -> Array:
        own = model.Q(x.now, u.u, dt)
        return jnp.pad(own, (0, 6))

    def of_now(sensor: Sensor) -> Sensor:
        return Sensor(lambda x, c: sensor.h(x.now, c), lambda x, c: sensor.R(x.now, c), sensor.space)

    def since_key(R: Array) -> Sensor:
        moved = product((vector(3), so3))
        return Sensor(lambda x, c: relative_pose(x.now.pos, x.now.att, x.pos, x.att), const(R), moved)

    sensors = {name: of_now(sensor) for name, sensor in model.sensors.items()}
    sensors |= {name: since_key(R) for name, R in odometry.items()}
    return Model(f, Q, product(Keyed(model.space, vector(3), so3)), sensors)


def optical_flow(
    R: Array,
    rates: Callable[[PyTree, PyTree], Array] = lambda x, c: x.rates,
    terrain: Terrain | float = 0.0,
    closest: float = NEAREST,
) -> Sensor:
    """`ground_flow` (2,) rad/s of a state with fields ``pos``, ``vel``, ``att``. Usual rate: 50-100 Hz.

    Args:
        R: (2, 2) (rad/s)^2; of the order of (0.05-0.2 rad/s)^2.
        rates: function (x, c) -> (3,) rad/s, body; for an inertial state with the gyroscope's reading as context:
            ``lambda x, c: c - x.gyro_bias``.
        terrain: world z of the ground, m: a number, or a function of the place, see `height_map`.
        closest: m: the distance is held at this, where the chip sees nothing.
    """

    def h(x: PyTree, c: PyTree) -> Array:
        distance = terrain_range(x.pos, x.att, terrain) if callable(terrain) else tilt_range(x.pos[2], x.att, terrain)
        return ground_flow(x.vel, x.att, rates(x, c), jnp.maximum(distance, closest))

    return Sensor(h, const(R), vector(2))


def camera(R: Array, mount: Option = FORWARD_CAMERA, point: Option | None = None, arm: Option = 0.0) -> Sensor:
    """`image_point` (2,) of a target, for a state with fields ``pos`` and ``att``. Usual rate: 5-30 Hz.

    Args:
        R: (2, 2), without unit: (pixels / focal length in pixels)^2, of the order of (0.002-0.01)^2.
        mount: (4,) quaternion, camera to body; or a function of the state.
        point: (3,) m, world: the target; or a function of the state. Default: the reading's context.
        arm: (3,) m, body: the camera's place; or a function of the state.
    """

    def h(x: PyTree, c: PyTree) -> Array:
        target = c if point is None else chosen(point, x, x.pos)
        return image_point(x.pos, x.att, target, chosen(mount, x, x.att), chosen(arm, x, x.pos))

    return Sensor(h, const(R), vector(2))
