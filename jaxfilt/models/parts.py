"""Pieces that several models share: an arc, a turn of axes, the noise of white acceleration, a start."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxfilt.elementary import sinc, wrap
from jaxfilt.noise import diagonal
from jaxfilt.types import Array, Gaussian, PyTree


def arc(pos: Array, yaw: Array, length: Array, turn: Array) -> tuple[Array, Array]:
    """Where a wheel without slip comes out that rolls along a circular arc.

    ``pos' = pos + length sinc(turn/2) [cos, sin](yaw + turn/2)``, ``yaw' = yaw + turn``: the chord. It is exact, and
    smooth at ``turn = 0``, where the textbook's form with ``v / rate`` divides by zero.

    Args:
        pos: (2,) m, world.
        yaw: () rad.
        length: () m along the arc, negative backwards.
        turn: () rad, change of yaw on the way, positive to the left.

    Returns:
        (pos', yaw'), yaw' in [-pi, pi].

    Example: a quarter of a circle of radius 1 m.
        >>> import math, jax.numpy as jnp
        >>> pos, yaw = arc(jnp.zeros(2), 0.0, math.pi / 2, math.pi / 2)
        >>> pos.round(4).tolist(), round(float(yaw), 4)
        ([1.0, 1.0], 1.5708)

    Source: Thrun, Burgard, Fox, Probabilistic Robotics (2005), eq. 5.9, written with the chord.
    """
    middle = yaw + 0.5 * turn
    chord = length * sinc(0.5 * turn)
    return pos + chord * jnp.stack([jnp.cos(middle), jnp.sin(middle)]), wrap(yaw + turn)


def rotated(yaw: Array, v: Array) -> Array:
    """A vector (2,) of the body frame (forward, left), seen in the world: ``[[cos, -sin], [sin, cos]] v``.

    Example:
        >>> import math, jax.numpy as jnp
        >>> (rotated(math.pi / 2, jnp.array([1.0, 0.0])).round(4) + 0.0).tolist()
        [0.0, 1.0]
    """
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.stack([cos * v[0] - sin * v[1], sin * v[0] + cos * v[1]])


def white_acceleration(dt: Array) -> Array:
    """Covariance (2, 2) of [position, velocity] driven for dt seconds by white acceleration of density 1 m^2/s^3.

    ``[[dt^3/3, dt^2/2], [dt^2/2, dt]]``: the same noise however the time is cut into steps.

    Example:
        >>> import jax.numpy as jnp
        >>> (6 * white_acceleration(jnp.asarray(1.0))).tolist()
        [[2.0, 3.0], [3.0, 6.0]]

    Source: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), eq. 6.2.2-12.
    """
    return jnp.stack([jnp.stack([dt**3 / 3, dt**2 / 2]), jnp.stack([dt**2 / 2, dt])])


def start(mean: PyTree, *stds: Array) -> Gaussian:
    """A belief with independent errors: the mean in the dtype of the standard deviations.

    Args:
        mean: a point of the state space, of Python or NumPy numbers.
        stds: standard deviations of the tangent's components, in order.

    Example:
        >>> import jax.numpy as jnp
        >>> start([3.0], jnp.asarray(2.0)).cov.tolist()
        [[4.0]]
    """
    cov = diagonal(*stds)
    return Gaussian(jax.tree.map(lambda a: jnp.asarray(a, cov.dtype), mean), cov)
