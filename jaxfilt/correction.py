"""How a reading corrects a belief: innovation, gain, Joseph's form, and what is reported of it.

``m = transform(h);  S = m.cov + R;  r = z - m.mean;  K = m.cross S^-1;
belief' = (mean + K r,  m.remainder(K) + K R K')``
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from numbers import Real
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import chisquare, doors, linalg
from jaxfilt.transforms import Transform
from jaxfilt.types import Array, Gaussian, Info, Model, PyTree, Sensor, Space, Status

Gate = float | Mapping[str, float] | None


class Recipe(NamedTuple):
    """What makes a filter this one: its transform, how its update iterates, and by sensor the chi-square thresholds,
    for each number of components seen, above which a reading is refused (``gates``) or weakened (``limits``)."""

    transform: Transform
    relinearise: Callable[[jax.Array], Transform]
    iterations: int
    gates: dict[str, np.ndarray]
    limits: dict[str, np.ndarray]


def thresholds_of(argument: str, model: Model, gate: Gate) -> dict[str, np.ndarray]:
    """For each sensor that has one the chi-square threshold by number of components seen, 0 ... m."""
    if gate is None:
        return {}
    by_sensor = dict(gate) if isinstance(gate, Mapping) else dict.fromkeys(model.sensors, gate)
    thresholds = {}
    for name, probability in by_sensor.items():
        if name not in model.sensors:
            raise KeyError(f"{argument}: expected sensors of {list(model.sensors)}, got {name!r}")
        if not isinstance(probability, Real) or isinstance(probability, bool):
            kind = type(probability).__name__
            raise TypeError(f"{argument}: expected a probability for {name!r}, got {kind} {probability!r}")
        if not 0 < probability < 1:
            raise ValueError(f"{argument}: expected a probability between 0 and 1 for {name!r}, got {probability}")
        dof = np.arange(1, model.sensors[name].space.dim + 1)
        thresholds[name] = np.r_[1.0, chisquare.quantile(float(probability), dof)]
    return thresholds


def correct_belief(
    recipe: Recipe, model: Model, name: str, belief: Gaussian, z: PyTree, c: PyTree, mask: Array | None
) -> tuple[Gaussian, Info]:
    """The belief after a reading z of the sensor of this name, and what is reported of it; the belief stays as it was
    where a gate refuses the reading."""
    sensor, dtype = model.sensors[name], belief.cov.dtype

    def h(x: PyTree) -> PyTree:
        y = doors.call(f"h(x, c) of sensor {name!r}", sensor.h, x=x, c=c)
        return image(f"h(x, c) of sensor {name!r}", y, sensor.space, dtype)

    R = doors.call(f"R(x, c) of sensor {name!r}", sensor.R, x=belief.mean, c=c)
    doors.noise(f"R(x, c) of sensor {name!r}", R, sensor.space.dim, dtype)
    there = _mask(mask, sensor, name)

    def correct(transform: Transform) -> tuple:
        m = transform(h, belief, model.space, sensor.space)
        # The shift comes after the difference is taken: J d is no angle and must not be wrapped like one.
        r = sensor.space.minus(z, m.mean) + m.shift
        r, S, cross = _observed(there, r, linalg.symmetrize(m.cov + R), m.cross)
        L = linalg.cholesky(S)
        return m, r, S, L, cross

    m, r, S, L, cross = correct(recipe.transform)
    gates, limits = recipe.gates.get(name), recipe.limits.get(name)
    info = _report(belief, z, r, S, L, there, gates, limits)
    weight = None if limits is None else _weight(info.nis, _limit(limits, there))
    for _ in range(recipe.iterations - 1):
        m, r, S, L, cross = correct(recipe.relinearise(_weakened(weight, cross @ linalg.solve(S, L, r))))
    K = linalg.solve(S, L, cross.T).T
    if weight is not None:  # as if S were S / weight
        K, R = weight * K, R + (1 / weight - 1) * S
    delta = _weakened(weight, cross @ linalg.solve(S, L, r))
    after = moved(model.space, belief, delta, _joseph(m.remainder, K, R))
    info = info._replace(status=_judge(info.status, after))
    if gates is None:
        return after, info
    refused = info.status == Status.GATED
    belief = jax.tree.map(lambda old, new: jnp.where(refused, old, new), belief, after)
    return belief, info


def _limit(thresholds: np.ndarray, there: jax.Array | None) -> Array:
    """The threshold for the components that were seen."""
    return thresholds[-1] if there is None else jnp.asarray(thresholds)[there.sum(dtype=jnp.int32)]


def _weight(nis: jax.Array, limit: Array) -> jax.Array:
    """Huber's weight ``min(1, sqrt(limit / nis))``, smooth in reverse mode at nis = 0."""
    limit = jnp.asarray(limit, nis.dtype)
    return jnp.sqrt(limit / jnp.maximum(nis, limit))


def _weakened(weight: jax.Array | None, delta: jax.Array) -> jax.Array:
    return delta if weight is None else weight * delta


def _joseph(remainder: Callable[[jax.Array], jax.Array], K: jax.Array, R: jax.Array) -> jax.Array:
    """Joseph's form ``remainder(K) + K R K'`` at the optimal gain ``K = C S^-1``, where its slope in K is zero.

    So the first derivative is that at a fixed K, and the longest path of reverse mode is never walked. It holds for
    every transform: the form is ``P - K C' - C K' + K S K'``, whose derivative in K is ``2 (K S - C)``. The derivative
    depends on K again, hence a rule and not a `stop_gradient`: second derivatives are exact too.
    """
    function, held = jax.closure_convert(remainder, K)

    def form(K: jax.Array, R: jax.Array, *held: jax.Array) -> jax.Array:
        return function(K, *held) + K @ R @ K.T

    stationary = jax.custom_jvp(form)

    @stationary.defjvp
    def _(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
        K, *others = primals
        _, slope = jax.jvp(lambda *others: form(K, *others), tuple(others), tuple(tangents[1:]))
        return stationary(*primals), slope

    return stationary(K, R, *held)


def image(name: str, y: PyTree, space: Space, dtype: jnp.dtype) -> PyTree:
    """What a user's function returned, checked against the space it should lie on."""
    doors.point(name, y, space)
    doors.same_dtype(dtype, **{name: y})
    return jax.tree.map(lambda a: jnp.asarray(a, dtype), y)


def moved(space: Space, belief: Gaussian, delta: jax.Array, P: jax.Array) -> Gaussian:
    """The belief moved by delta, its covariance P carried from the tangent space at the old mean to that at the new."""
    mean = space.plus(belief.mean, delta)
    return Gaussian(mean, linalg.symmetrize(_carried(space, belief.mean, delta, mean, P)))


def carried(space: Space, belief: Gaussian, mean: PyTree) -> jax.Array:
    """The belief's covariance, about its own mean all the same, in the tangent space at another point."""
    return _carried(space, belief.mean, jnp.zeros(space.dim, belief.cov.dtype), mean, belief.cov)


def _carried(space: Space, base: PyTree, delta: jax.Array, mean: PyTree, P: jax.Array) -> jax.Array:
    if space.flat:
        return P
    G = jax.jacfwd(lambda d: space.minus(space.plus(base, d), mean))(delta)
    return G @ P @ G.T


def _mask(mask: Array | None, sensor: Sensor, name: str) -> jax.Array | None:
    if mask is None:
        return None
    doors.mask(f"mask of {name!r}", mask, (sensor.space.dim,))
    return jnp.asarray(mask)


def _observed(
    there: jax.Array | None, r: jax.Array, S: jax.Array, cross: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Leave out what was not seen: its innovation is 0, its variance 1, its correlations 0, so it changes nothing."""
    if there is None:
        return r, S, cross
    both = there[:, None] & there[None, :]
    eye = jnp.eye(len(r), dtype=S.dtype)
    return jnp.where(there, r, 0.0), jnp.where(both, S, eye), jnp.where(there[None, :], cross, 0.0)


def _report(
    belief: Gaussian,
    z: PyTree,
    r: jax.Array,
    S: jax.Array,
    L: jax.Array,
    there: jax.Array | None,
    gates: np.ndarray | None,
    limits: np.ndarray | None,
) -> Info:
    nis, log_determinant = linalg.score(S, L, r)
    dof = jnp.asarray(len(r), jnp.int32) if there is None else there.sum(dtype=jnp.int32)
    cost, ratio = nis, jnp.zeros_like(nis)
    if limits is not None:
        limit = jnp.asarray(_limit(limits, there), nis.dtype)
        cost = jnp.where(nis > limit, 2 * jnp.sqrt(limit * jnp.maximum(nis, limit)) - limit, nis)
        ratio = nis / limit
    loglik = -0.5 * (cost + log_determinant + dof.astype(r.dtype) * math.log(2 * math.pi))
    status = jnp.where(_is_finite((belief.mean, belief.cov)), Status.OK, Status.BAD_BELIEF).astype(jnp.int32)
    status = _first(status, ~_is_finite(z), Status.BAD_MEASUREMENT)
    status = _first(status, ~_is_finite((r, S)), Status.BAD_PREDICTION)
    status = _first(status, ~jnp.all(jnp.diagonal(L) > 0), Status.INDEFINITE_INNOVATION)
    if gates is not None:
        ratio = nis / jnp.asarray(_limit(gates, there), nis.dtype)
        status = _first(status, ratio > 1, Status.GATED)
        used = status != Status.GATED
        dof, loglik = jnp.where(used, dof, 0), jnp.where(used, loglik, 0.0)
    return Info(r, S, nis, loglik, dof, ratio, status)


def _first(status: jax.Array, bad: jax.Array, code: Status) -> jax.Array:
    return jnp.where((status == Status.OK) & bad, jnp.int32(code), status)


def _judge(status: jax.Array, belief: Gaussian) -> jax.Array:
    sound = _is_finite((belief.mean, belief.cov)) & jnp.all(jnp.diagonal(belief.cov) >= 0)
    return _first(status, ~sound, Status.BAD_POSTERIOR)


def _is_finite(tree: PyTree) -> jax.Array:
    flags = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]
    return jnp.all(jnp.stack(flags))


def nothing(m: int, dtype: jnp.dtype) -> Info:
    """What is reported of a sensor that was silent."""
    number, count = jnp.zeros((), dtype), jnp.zeros((), jnp.int32)
    absent = jnp.asarray(Status.ABSENT, jnp.int32)
    return Info(jnp.zeros(m, dtype), jnp.zeros((m, m), dtype), number, number, count, number, absent)
