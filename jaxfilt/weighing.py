"""How a reading weighs points of the state space, and what is reported of it."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from jaxfilt import doors, linalg
from jaxfilt.correction import image
from jaxfilt.mixture import collapsed
from jaxfilt.types import Array, Gaussian, Info, Model, PyTree, Sensor, Status

LOWEST = -1e30
"""Stands for log 0: sums of it stay finite, in float32 too, and so do gradients."""


def log_normal(r: jax.Array, S: jax.Array) -> jax.Array:
    """log N(r; 0, S)."""
    nis, log_determinant = linalg.score(S, linalg.cholesky(S), r)
    return -0.5 * (nis + log_determinant + len(r) * math.log(2 * math.pi))


def normalised(log_weights: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The logarithms of weights of sum 1, none below `LOWEST`, and the logarithm of the sum that they had."""
    total = jax.nn.logsumexp(log_weights)
    return jnp.maximum(log_weights - total, LOWEST), total


def weighed(
    model: Model, name: str, points: PyTree, log_weights: jax.Array, z: PyTree, c: PyTree, mask: Array | None
) -> tuple[jax.Array, Info]:
    """Weights after a reading z, ``w_i p(z | x_i) / sum_j w_j p(z | x_j)``, and what is reported of it.

    p is the sensor's law, or else normal. ``loglik`` is the logarithm of the sum, exact for these points and weights;
    innovation, S and nis are by mean and covariance of the mixture of the points' predictions. Of a reading that has a
    law and lacks a component nothing is used.

    Args:
        points: leading axis N.
        log_weights: (N,), the logarithms of weights of sum 1.
    """
    sensor, dtype = doors.sensor(model, name), log_weights.dtype
    doors.point(f"z[{name!r}]", z, sensor.space)
    doors.finite(f"z[{name!r}]", z)
    doors.same_dtype(dtype, **{f"z[{name!r}]": z})
    z = jax.tree.map(lambda a: jnp.asarray(a, dtype), z)
    there = jnp.full(sensor.space.dim, True)
    if mask is not None:
        doors.mask(f"mask of {name!r}", mask, (sensor.space.dim,))
        there = jnp.asarray(mask) if sensor.law is None else jnp.broadcast_to(jnp.all(mask), there.shape)

    def predicted(x: PyTree) -> tuple[Gaussian, jax.Array]:
        y = doors.call(f"h(x, c) of sensor {name!r}", sensor.h, x=x, c=c)
        R = doors.call(f"R(x, c) of sensor {name!r}", sensor.R, x=x, c=c)
        doors.noise(f"R(x, c) of sensor {name!r}", R, sensor.space.dim, dtype)
        reading = Gaussian(image(f"h(x, c) of sensor {name!r}", y, sensor.space, dtype), jnp.asarray(R, dtype))
        return reading, _log_density(name, sensor, reading, z, x, c, there)

    readings, log_density = jax.vmap(predicted)(points)
    mean, S = collapsed(readings, jnp.exp(log_weights), sensor.space)
    r, S = seen(sensor.space.minus(z, mean), S, there)
    L = linalg.cholesky(S)
    after, loglik = normalised(log_weights + log_density)
    status = first_fault(
        (jnp.isfinite(log_weights), Status.BAD_BELIEF),
        (jax.tree.map(jnp.isfinite, z), Status.BAD_MEASUREMENT),
        (jax.tree.map(jnp.isfinite, (r, S, readings)), Status.BAD_PREDICTION),
        (jnp.diagonal(L) > 0, Status.INDEFINITE_INNOVATION),
        (jnp.isfinite(after), Status.BAD_POSTERIOR),
    )
    nis, _ = linalg.score(S, L, r)
    return after, Info(r, S, nis, loglik, there.sum(dtype=jnp.int32), jnp.zeros((), dtype), status)


def _log_density(
    name: str, sensor: Sensor, reading: Gaussian, z: PyTree, x: PyTree, c: PyTree, there: jax.Array
) -> jax.Array:
    if sensor.law is not None:
        density = doors.call(f"law.log_density(z, x, c) of sensor {name!r}", sensor.law.log_density, z=z, x=x, c=c)
        return jnp.where(there[0], jnp.asarray(density, reading.cov.dtype), 0.0)
    r, R = seen(sensor.space.minus(z, reading.mean), reading.cov, there)
    return log_normal(r, R) + 0.5 * (~there).sum().astype(r.dtype) * math.log(2 * math.pi)


def seen(r: jax.Array, S: jax.Array, there: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Innovation and covariance with 0 and 1 for what was not seen."""
    both = there[:, None] & there[None, :]
    return jnp.where(there, r, 0.0), jnp.where(both, S, jnp.eye(len(r), dtype=S.dtype))


def first_fault(*sound: tuple[PyTree, Status]) -> jax.Array:
    """The status of the first tree of bools that is not all True; OK where all are."""
    status = jnp.int32(Status.OK)
    for tree, code in reversed(sound):
        good = jnp.stack([leaf.all() for leaf in jax.tree.leaves(tree)]).all()
        status = jnp.where(good, status, jnp.int32(code))
    return status
