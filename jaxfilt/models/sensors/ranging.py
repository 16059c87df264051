"""How far: to landmarks, to beacons, to satellites, to the ground below."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxfilt.elementary import bearing, norm, wrap
from jaxfilt.models.sensors.options import Option, chosen
from jaxfilt.models.sensors.positioning import antenna_position
from jaxfilt.noise import const
from jaxfilt.spaces import angle, product, rotate, scalar
from jaxfilt.types import Array, PyTree, Sensor

STEEPEST = 0.1
"""Least cosine of the tilt at which a downward beam is taken to meet the ground: 84 degrees."""

Terrain = Callable[[Array], Array]
"""World z (m) of the ground at a place (2,) m: what `height_map` makes."""


def range_bearing(pos: Array, yaw: Array, point: Array) -> tuple[jax.Array, jax.Array]:
    """Range (m) and bearing (rad, relative to the heading, left positive) of a point in the plane.

    ``d = point - pos``, ``(|d|, wrap(atan2(d_y, d_x) - yaw))``, finite derivatives also where ``d = 0``. Lives on
    ``product((scalar, angle))``. Usual rate: 1-20 Hz (lidar, camera with known landmarks).

    Args:
        pos: (2,) m, world.
        yaw: () rad.
        point: (2,) m, world.

    Example:
        >>> import jax.numpy as jnp
        >>> r, b = range_bearing(jnp.zeros(2), jnp.asarray(0.0), jnp.array([0.0, 2.0]))
        >>> float(r), round(float(b), 4)
        (2.0, 1.5708)

    Source: Thrun, Burgard, Fox, Probabilistic Robotics (2005), eq. 6.40.
    """
    d = point - pos
    return norm(d), wrap(bearing(d) - yaw)


def range_to(pos: Array, point: Array, bias: Array | float = 0.0) -> jax.Array:
    """Range (m) to a known point: ultrasound or radio beacon, ``|point - pos| + bias``.

    Lives on ``scalar``; its derivative at the point itself is 0. Usual rate: 5-50 Hz.

    Args:
        pos: (n,) m, world.
        point: (n,) m, world.
        bias: () m, what the beacon's clock or the air adds.

    Example:
        >>> import jax.numpy as jnp
        >>> float(range_to(jnp.array([3.0, 0.0]), jnp.array([0.0, 4.0]), bias=0.5))
        5.5
    """
    return norm(point - pos) + bias


def pseudorange(pos: Array, satellite: Array, clock: Array | float = 0.0) -> jax.Array:
    """Pseudorange (m) less the satellite's distance from the world's origin: ``|s - p| - |s| + clock``.

    Take ``|s|`` off the reading in float64: 20,000 km in float32 are known to 2 m, this difference, computed as
    ``p (p - 2 s) / (|s - p| + |s|)``, is good to millimetres. The satellite's own clock, the air and the turn of the
    earth during the flight of the signal must be taken off as well. Lives on ``scalar``. Usual rate: 1-10 Hz.

    Args:
        pos: (3,) m, in the world's frame, whose origin is near.
        satellite: (3,) m, in the same frame, away from the origin.
        clock: () m, the receiver's clock error times the speed of light: a state that drifts, common to all satellites.

    Example: 100 m up, beneath the satellite.
        >>> import jax.numpy as jnp
        >>> float(pseudorange(jnp.array([0.0, 0.0, 100.0]), jnp.array([0.0, 0.0, 2e7]), clock=30.0))
        -70.0

    Source: P. D. Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems (2013), section
    9.4.1, less its value at the origin.
    """
    return pos @ (pos - 2 * satellite) / (norm(satellite - pos) + norm(satellite)) + clock


def pseudorange_rate(
    pos: Array, vel: Array, satellite: Array, satellite_vel: Array, drift: Array | float = 0.0
) -> jax.Array:
    """Pseudorange rate (m/s), from the Doppler shift: ``(s - p) (s_vel - vel) / |s - p| + drift``.

    Lives on ``scalar``. Usual rate: 1-10 Hz.

    Args:
        pos: (3,) m.
        vel: (3,) m/s.
        satellite: (3,) m.
        satellite_vel: (3,) m/s.
        drift: () m/s, of the receiver's clock times the speed of light.

    Source: Groves (2013), sec. 9.4.1, without the turn of the earth.
    """
    away = satellite - pos
    distance = norm(away)
    return away @ (satellite_vel - vel) / jnp.where(distance > 0, distance, 1.0) + drift


def tilt_range(height: Array, att: Array, terrain: Array | float = 0.0) -> jax.Array:
    """Range (m) of a downward range finder fixed to the body: ``(height - terrain) / (cos roll cos pitch)``.

    The cosine of the tilt is R33 of the attitude's rotation matrix. The tilt belongs here or in the reading, once: a
    lecture compensates both. Beyond 84 degrees, where no beam returns, the cosine is held at 0.1. Lives on
    ``scalar``. Usual rate: 20-50 Hz.

    Args:
        height: () m, world z of the range finder.
        att: (4,) quaternion.
        terrain: () m, world z of the ground (or the table) below.

    Example: 2 m up, rolled by 60 degrees.
        >>> import math, jax.numpy as jnp, jaxfilt as jf
        >>> round(float(tilt_range(jnp.asarray(2.0), jf.so3_exp(jnp.array([math.pi / 3, 0.0, 0.0])))), 4)
        4.0
    """
    return (height - terrain) / jnp.maximum(_up(att)[2], STEEPEST)


def terrain_range(pos: Array, att: Array, terrain: Terrain, rounds: int = 3) -> jax.Array:
    """Range (m) of a downward range finder above uneven ground: `tilt_range` to where the beam meets it.

    ``range = (z - terrain(p_xy - range (R e_z)_xy)) / (R e_z)_z``, from the height below the vehicle by so many rounds
    of substitution, each of which shrinks the error by slope times tan(tilt): exact when level or above a plain.

    Args:
        pos: (3,) m, world: of the range finder.
        att: (4,) quaternion.
        terrain: function (2,) m -> () m, see `height_map`.
        rounds: number of substitutions.
    """
    up = _up(att)
    cos = jnp.maximum(up[2], STEEPEST)
    reach = (pos[2] - terrain(pos[:2])) / cos
    for _ in range(rounds):
        reach = (pos[2] - terrain(pos[:2] - reach * up[:2])) / cos
    return reach


def height_map(grid: Array, origin: Option = (0.0, 0.0), spacing: Array | float = 1.0, smooth: bool = True) -> Terrain:
    """The height of the ground between the nodes of a grid, a function of the place.

    Smooth: Catmull-Rom splines along x and y, through the nodes, continuous in slope. Else bilinear. Beyond the
    outermost nodes the height stays what it is at the edge, after one spacing in which the slope runs out.

    It looks 16 nodes up, by indices that depend on the state: cheap for any grid on XLA. The fast backend does so in up
    to 64 nodes only; with a larger grid ``backend="auto"`` chooses XLA, and ``backend="lanes"`` raises.

    Args:
        grid: (n, m) m, ``grid[i, j]`` at ``origin + spacing (i, j)``: the first index goes along x.
        origin: (2,) m, world.
        spacing: m.
        smooth: a filter likes slopes without steps.

    Returns:
        Function (2,) m, world -> () m.

    Raises:
        ValueError: a grid that is not (n, m).

    Example:
        >>> import jax.numpy as jnp
        >>> hill = height_map(jnp.array([[0.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 0.0]]), spacing=10.0)
        >>> float(hill(jnp.array([10.0, 10.0]))), float(hill(jnp.array([15.0, 10.0])))
        (4.0, 2.25)

    Source: E. Catmull, R. Rom, A class of local interpolating splines (1974), with tension 1/2.
    """
    if jnp.ndim(grid) != 2:
        raise ValueError(f"height_map(grid): expected shape (n, m), got {jnp.shape(grid)}")
    last = jnp.asarray(jnp.shape(grid)) - 1
    weights = _cubic if smooth else _linear

    def height(place: Array) -> jax.Array:
        heights = jnp.asarray(grid, place.dtype)
        at = (place - jnp.asarray(origin, place.dtype)) / jnp.asarray(spacing, place.dtype)
        at = jnp.clip(at, -1.0, last.astype(place.dtype) + 1.0)
        cell = jnp.floor(at)
        corner = cell.astype(last.dtype)
        i, j = (jnp.clip(corner[k] + jnp.arange(-1, 3, dtype=last.dtype), 0, last[k]) for k in range(2))
        along, across = (weights(at[k] - cell[k]) for k in range(2))
        return along @ heights[i[:, None], j[None, :]] @ across

    return height


def range_finder(R: Array, terrain: Terrain | float = 0.0, arm: Option = (0.0, 0.0, 0.0)) -> Sensor:
    """Range (m) to the ground, along the body's z axis downwards, of a state with ``pos`` and ``att``. Rate: 20-50 Hz.

    Args:
        R: (1, 1) m^2; of the order of (0.01-0.05 m)^2.
        terrain: world z of the ground, m: a number, or a function of the place, see `height_map`.
        arm: (3,) m, body: the range finder's place; or a function of the state.

    Example: above a hill.
        >>> import jax.numpy as jnp
        >>> from jaxfilt.models.sensors import TFMINI
        >>> hill = height_map(jnp.array([[0.0, 1.0], [2.0, 3.0]]), spacing=10.0)
        >>> sensor = range_finder(TFMINI.R(), hill)
    """

    def h(x: PyTree, c: PyTree) -> Array:
        place = antenna_position(x.pos, x.att, chosen(arm, x, x.pos))
        return terrain_range(place, x.att, terrain) if callable(terrain) else tilt_range(place[2], x.att, terrain)

    return Sensor(h, const(R), scalar)


def beacon(R: Array, point: Option | None = None, bias: Option = 0.0, arm: Option | None = None) -> Sensor:
    """Range (m) to a beacon of a state with a field ``pos``, with an arm also ``att``. Usual rate: 5-50 Hz.

    Args:
        R: (1, 1) m^2; of the order of (0.1 m)^2 for ultra-wideband radio.
        point: (n,) m, world: the beacon's place; or a function of the state (a beacon that is to be found). Default:
            the reading's context.
        bias: () m, of this beacon; or a function of the state: ``lambda x: x.extra["bias"][3]``.
        arm: (3,) m, body: the vehicle's antenna; or a function of the state.
    """

    def h(x: PyTree, c: PyTree) -> Array:
        pos = x.pos if arm is None else antenna_position(x.pos, x.att, chosen(arm, x, x.pos))
        return range_to(pos, c if point is None else chosen(point, x, x.pos), chosen(bias, x, x.pos))

    return Sensor(h, const(R), scalar)


def landmark(R: Array) -> Sensor:
    """Range (m) and bearing (rad) of the landmark at the context (2,) m, for a state with ``pos`` (2,) and ``yaw``.

    Usual rate: 1-20 Hz.

    Args:
        R: (2, 2) m^2 and rad^2.
    """
    return Sensor(lambda x, c: range_bearing(x.pos, x.yaw, c), const(R), product((scalar, angle)))


def satellite(R: Array, clock: Option) -> Sensor:
    """`pseudorange` (m) of the satellite at the context (3,) m, for a state with ``pos`` (3,). Usual rate: 1-10 Hz.

    Args:
        R: (1, 1) m^2; of the order of (1-5 m)^2 under the open sky. Between houses many are tens of metres too long.
        clock: () m; or a function of the state: ``lambda x: x.extra["clock"]``.
    """
    return Sensor(lambda x, c: pseudorange(x.pos, c, chosen(clock, x, x.pos)), const(R), scalar)


def _up(att: Array) -> jax.Array:
    return rotate(att, jnp.asarray([0.0, 0.0, 1.0], att.dtype))


def _cubic(t: Array) -> jax.Array:
    """Catmull-Rom weights (4,) of the nodes at -1, 0, 1, 2."""
    outer, inner = (1 - t) * (1 - t) * t, (1 - t) * t * t
    step = t * t * (3 - 2 * t)
    return jnp.stack([-0.5 * outer, 1 - step + 0.5 * inner, step + 0.5 * outer, -0.5 * inner])


def _linear(t: Array) -> jax.Array:
    return jnp.stack([jnp.zeros_like(t), 1 - t, t, jnp.zeros_like(t)])
