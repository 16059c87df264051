"""One particle of FastSLAM: what a sighting makes of its pose and of the landmark that was seen."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxfilt import linalg
from jaxfilt.correction import moved
from jaxfilt.slam.parts import Inverse
from jaxfilt.spaces import vector
from jaxfilt.transforms import taylor
from jaxfilt.types import Array, Gaussian, PyTree, Sensor, Space


class Each(NamedTuple):
    """What each particle makes of a reading: innovation (K, m), S (K, m, m), and log density (K,)."""

    innovation: Array
    S: Array
    loglik: Array


def masked(sensor: Sensor, z: PyTree, mask: Array | None) -> Sensor:
    """The sensor with what was not seen read as expected, with variance 1: it changes nothing."""
    if mask is None:
        return sensor
    there = jnp.asarray(mask)
    both = there[:, None] & there[None, :]

    def h(x: PyTree, c: PyTree) -> PyTree:
        return sensor.space.plus(z, jnp.where(there, sensor.space.minus(sensor.h(x, c), z), 0.0))

    def R(x: PyTree, c: PyTree) -> jax.Array:
        cov = jnp.asarray(sensor.R(x, c))
        return jnp.where(both, cov, jnp.eye(len(there), dtype=cov.dtype))

    return sensor._replace(h=h, R=R)


def _drawn(space: Space, belief: Gaussian, noise: Array) -> Gaussian:
    """A pose drawn, of which nothing is uncertain any more."""
    pose = space.plus(belief.mean, linalg.semidefinite_cholesky(belief.cov) @ noise)
    return Gaussian(pose, jnp.zeros_like(belief.cov))


def seen_again(
    space: Space, sensor: Sensor, z: PyTree, informed: bool, robot: Gaussian, noise: Array, place: Array, cov: Array
) -> tuple[Gaussian, Array, Array, Each]:
    """One particle: the pose is drawn, the landmark corrected."""
    plane = vector(2)

    def looked(robot: Gaussian) -> tuple:
        of_robot = taylor(lambda x: sensor.h(x, place), robot, space, sensor.space)
        of_place = taylor(lambda m: sensor.h(robot.mean, m), Gaussian(place, cov), plane, sensor.space)
        R = of_place.cov + sensor.R(robot.mean, place)
        S = linalg.symmetrize(of_robot.cov + R)
        r, L = sensor.space.minus(z, of_robot.mean), linalg.cholesky(S)
        return of_robot, of_place, R, r, S, L

    before, _, R, r, S, L = looked(robot)
    if informed:
        K = linalg.gain(before.cross, L)
        pose = _drawn(space, moved(space, robot, K @ r, before.remainder(K) + K @ R @ K.T), noise)
    else:
        pose = _drawn(space, robot, noise)
    _, of_place, _, r_there, S_there, L_there = looked(pose)
    K = linalg.gain(of_place.cross, L_there)
    noise_of_z = jnp.asarray(sensor.R(pose.mean, place))
    after = linalg.symmetrize(of_place.remainder(K) + K @ noise_of_z @ K.T)
    density = _log_density(r, S, L) if informed else _log_density(r_there, S_there, L_there)
    return pose, place + K @ r_there, after, Each(r, S, density)


def _log_density(r: Array, S: Array, L: Array) -> jax.Array:
    """log N(r; 0, S) but for the constant, which the mixture adds, knowing how many components there are."""
    nis, log_determinant = linalg.score(S, L, r)
    return -0.5 * (nis + log_determinant)


def seen_first(
    space: Space, sensor: Sensor, z: PyTree, inverse: Inverse, robot: Gaussian, noise: Array
) -> tuple[Gaussian, Array, Array]:
    """One particle: the pose is drawn, and the landmark placed from there."""
    pose = _drawn(space, robot, noise)
    here = jnp.zeros(sensor.space.dim, noise.dtype)

    def place(e: Array) -> jax.Array:
        return jnp.asarray(inverse(pose.mean, sensor.space.plus(z, e)), noise.dtype)

    G = jax.jacfwd(place)(here)
    R = jnp.asarray(sensor.R(pose.mean, place(here)))
    return pose, place(here), linalg.symmetrize(G @ R @ G.T)
