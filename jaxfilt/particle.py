"""Particle filters: any distribution, as weighted points that move as the robot may have moved."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors, linalg, resampling
from jaxfilt.mixture import moments
from jaxfilt.prediction import advanced, branch, canonical, interval, stepper
from jaxfilt.types import Array, Filter, Gaussian, Info, Log, Model, PyTree, Status
from jaxfilt.weighing import normalised, weighed

RESAMPLING: dict[str, Callable[[jax.Array, jax.Array], jax.Array]] = {
    "systematic": resampling.systematic,
    "stratified": resampling.stratified,
}


class Particles(NamedTuple):
    """What a particle filter carries: points ``x`` (leading axis N), the logarithms of their weights, of sum 1
    (``log_weight`` (N,)), and the ``key`` of all that is still to be drawn."""

    x: PyTree
    log_weight: Array
    key: Array


class Kidnapping(NamedTuple):
    """With this ``probability`` in each prediction the robot is somewhere else: at ``anywhere(key)``, a state drawn."""

    probability: float
    anywhere: Callable[[Array], PyTree]


def particle(
    model: Model,
    particles: int = 1000,
    resample: str = "systematic",
    threshold: float = 0.5,
    auxiliary: bool = False,
    kidnapping: Kidnapping | None = None,
) -> Filter:
    """Particle filter: points move by f and by noise drawn from Q, and are weighed by p(z | x).

    ``predict``  where ``1 / sum w^2 < threshold N``, N points are drawn by weight; ``x_i' = plus(f(x_i, u, dt), w_i)``
    with ``w_i ~ N(0, Q(x_i, u, dt))``. ``update``  ``w_i <- p(z | x_i) w_i / sum_j p(z | x_j) w_j``, p the sensor's law
    or normal. ``loglik`` is the logarithm of the sum: the exponential of all of a run together is an unbiased estimate
    of its likelihood.

    Auxiliary: before points move they are drawn by how well ``f(x_i, u, dt)`` explains all readings of the row, which
    is taken out of their weights again; good where readings are precise. Then innovation, S and nis, of particles that
    have looked already, test nothing, and only ``step`` knows of it.

    It carries `Particles`, begun from a Gaussian with a key. Nothing is differentiated through the choice of particles:
    gradients are biased.

    Args:
        model: the robot and its sensors.
        particles: N, >= 2.
        resample: "systematic" or "stratified".
        threshold: share of N, 0 (never) to 1, of the effective number of particles below which they are drawn anew.
        auxiliary: draw by the next row's readings, in each row.
        kidnapping: for a robot that is to find itself again; part of the model, so the likelihood stays unbiased.

    Returns:
        Filter(predict, update, step, model, begin, gaussian).

    Raises:
        ValueError, TypeError: options out of range, a belief to begin from without a key, particles that do not fit.

    Example: as good as the Kalman filter on a linear model, up to chance.
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> filt = particle(walk, particles=20_000)
        >>> cloud = filt.begin(jf.Gaussian(jnp.zeros(1), jnp.eye(1)), jax.random.key(0))
        >>> cloud, info = filt.update(filt.predict(cloud, (), 1.0), jnp.array([3.0]), "z")
        >>> bool(abs(filt.gaussian(cloud).mean[0] - 2.0) < 0.05), bool(abs(info.S[0, 0] - 3.0) < 0.1)
        (True, True)

    Source: Gordon, Salmond, Smith, Novel approach to nonlinear/non-Gaussian Bayesian state estimation (1993); Pitt,
    Shephard, Filtering via simulation: auxiliary particle filters (1999), section 3. Unbiased: Del Moral, Feynman-Kac
    Formulae (2004), section 7.4. Kidnapping: Thrun, Burgard, Fox, Probabilistic Robotics (2005), section 8.3.3.
    """
    draw = _checked(model, particles, resample, threshold, kidnapping)
    space = model.space
    fresh = -float(np.log(particles))

    def begin(belief: Any, key: Array | None = None) -> Particles:
        if isinstance(belief, Particles):
            return _own(belief, model, particles)
        belief = canonical(belief, space)
        if key is None:
            raise ValueError(
                "key: expected a key of jax.random to draw particles with, got None; filter.begin takes it"
            )
        first, rest = jax.random.split(key)
        x = jax.vmap(lambda w: _moved(model, belief.mean, belief.cov, w))(_noise(first, belief.cov.dtype))
        return Particles(x, jnp.full(particles, fresh, belief.cov.dtype), rest)

    def _noise(key: Array, dtype: Any) -> jax.Array:
        return jax.random.normal(key, (particles, space.dim), dtype)

    def spread(cloud: Particles, u: PyTree, dt: jax.Array) -> Particles:
        """The points moved, each by its own noise."""
        dtype = cloud.log_weight.dtype
        rest, of_noise, of_choice, of_place = jax.random.split(cloud.key, 4)

        def one(x: PyTree, w: jax.Array) -> PyTree:
            Q = doors.call("Q(x, u, dt)", model.Q, x=x, u=u, dt=dt)
            doors.noise("Q(x, u, dt)", Q, space.dim, dtype)
            return _moved(model, advanced(model, x, u, dt, dtype), jnp.asarray(Q, dtype), w)

        x = jax.vmap(one)(cloud.x, _noise(of_noise, dtype))
        if kidnapping is not None:
            gone = jax.random.uniform(of_choice, (particles,)) < kidnapping.probability
            elsewhere = jax.vmap(kidnapping.anywhere)(jax.random.split(of_place, particles))
            x = jax.tree.map(lambda new, old: jnp.where(_like(gone, old), new.astype(old.dtype), old), elsewhere, x)
        return Particles(x, cloud.log_weight, rest)

    def chosen(cloud: Particles) -> Particles:
        rest, key = jax.random.split(cloud.key)
        some = draw(key, cloud.log_weight)
        return Particles(jax.tree.map(lambda a: a[some], cloud.x), jnp.full_like(cloud.log_weight, fresh), rest)

    def predict(belief: Any, u: PyTree = (), dt: Array | float = 0.0) -> Particles:
        cloud = begin(belief)
        doors.inputs("u", u, cloud.log_weight.dtype)
        moves, dt = interval(dt, cloud)

        def on(cloud: Particles) -> Particles:
            scarce = resampling.effective_size(cloud.log_weight) < threshold * particles
            return spread(branch(scarce, chosen, lambda c: c, cloud), u, dt)

        return branch(moves, on, lambda cloud: cloud, cloud)

    def update(
        belief: Any, z: PyTree, sensor: str, c: PyTree = (), mask: Array | None = None
    ) -> tuple[Particles, Info]:
        cloud = begin(belief)
        weights, info = weighed(model, sensor, cloud.x, cloud.log_weight, z, c, mask)
        return cloud._replace(log_weight=weights), info

    def expected(cloud: Particles, u: PyTree, dt: Array) -> Particles:
        dtype = cloud.log_weight.dtype
        return cloud._replace(x=jax.vmap(lambda x: advanced(model, x, u, jnp.asarray(dt, dtype), dtype))(cloud.x))

    look, listen = stepper(model, expected, update), stepper(model, lambda cloud, u, dt: cloud, update)

    def looking(belief: Any, row: Log) -> tuple[Particles, dict[str, Info]]:
        cloud = begin(belief)
        doors.tables("row", row, model)
        doors.inputs("u", row.u, cloud.log_weight.dtype)
        moves, dt = interval(row.dt, cloud)

        def ahead(cloud: Particles) -> tuple[Particles, jax.Array]:
            seen = look(cloud, row._replace(dt=dt))[0].log_weight
            rest, key = jax.random.split(cloud.key)
            some = draw(key, seen)
            x = jax.tree.map(lambda a: a[some], cloud.x)
            weights, total = normalised((fresh - (seen - cloud.log_weight))[some])
            return spread(Particles(x, weights, rest), row.u, dt), total

        still = jnp.zeros((), cloud.log_weight.dtype)
        cloud, owed = branch(moves, ahead, lambda cloud: (cloud, still), cloud)
        cloud, infos = listen(cloud, row)
        # What the first stage took out of the weights belongs to the row's likelihood: the first reading reports it.
        for name, info in infos.items():
            heard = info.status != Status.ABSENT
            infos[name] = info._replace(loglik=info.loglik + jnp.where(heard, owed, 0.0))
            owed = jnp.where(heard, 0.0, owed)
        return cloud, infos

    def gaussian(cloud: Particles) -> Gaussian:
        return moments(cloud.x, jnp.exp(cloud.log_weight), space)

    step = looking if auxiliary else stepper(model, predict, update)
    return Filter(predict, update, step, model, begin, gaussian)


def _moved(model: Model, x: PyTree, cov: Array, noise: Array) -> PyTree:
    moved = model.space.plus(x, linalg.semidefinite_cholesky(cov) @ noise)
    return jax.tree.map(lambda a: a.astype(noise.dtype), moved)


def _like(flags: jax.Array, a: jax.Array) -> jax.Array:
    return flags.reshape(-1, *[1] * (a.ndim - 1))


def _checked(
    model: Model, particles: int, resample: str, threshold: float, kidnapping: Kidnapping | None
) -> Callable[[jax.Array, jax.Array], jax.Array]:
    doors.instance("model", model, Model)
    if not model.sensors:
        raise ValueError("model.sensors: expected at least one sensor, got none")
    if isinstance(particles, bool) or not isinstance(particles, int) or particles < 2:
        raise ValueError(f"particles: expected a whole number of at least 2, got {particles!r}")
    if resample not in RESAMPLING:
        raise ValueError(f"resample: expected one of {list(RESAMPLING)}, got {resample!r}")
    if not 0 <= threshold <= 1:
        raise ValueError(f"threshold: expected 0 to 1, got {threshold}")
    if kidnapping is not None:
        doors.instance("kidnapping", kidnapping, Kidnapping)
        if not 0 <= kidnapping.probability <= 1:
            raise ValueError(f"kidnapping.probability: expected 0 to 1, got {kidnapping.probability}")
    return RESAMPLING[resample]


def _own(cloud: Particles, model: Model, particles: int) -> Particles:
    """The particles as arrays of one dtype, that of their weights."""
    doors.array("belief.log_weight", cloud.log_weight)
    if cloud.log_weight.shape != (particles,):
        raise ValueError(f"belief.log_weight: expected shape ({particles},), got {cloud.log_weight.shape}")
    doors.floating("belief.log_weight", cloud.log_weight)
    doors.point("belief.x", cloud.x, model.space, leading=(particles,))
    dtype = jax.dtypes.canonicalize_dtype(cloud.log_weight.dtype)
    doors.same_dtype(dtype, **{"belief.x": cloud.x})
    x, weights = jax.tree.map(lambda a: jnp.asarray(a, dtype), (cloud.x, cloud.log_weight))
    return Particles(x, weights, cloud.key)
