"""FastSLAM: particles of the robot's path, each with a map of its own, one small Kalman filter for each landmark.

Given the path, landmarks do not hang together: N filters of two numbers in place of one of 2 N.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors, linalg, resampling
from jaxfilt.correction import Gate, Recipe, carried, correct_belief, nothing, thresholds_of
from jaxfilt.mixture import moments
from jaxfilt.models.slam import World
from jaxfilt.prediction import branch, canonical, dtype_of, predictor, stepper
from jaxfilt.slam.particle import Each, masked, seen_again, seen_first
from jaxfilt.slam.parts import Inverse, anatomy, finite, first_sight, known_number, of_some_landmark, robot_alone
from jaxfilt.transforms import taylor
from jaxfilt.types import Array, Filter, Gaussian, Info, Model, PyTree, Status


class Swarm(NamedTuple):
    """What `fast_slam` carries of its K particles.

    ``robots`` a Gaussian with leading axis K: where the robot of each particle may have got since it was last drawn;
    ``places`` (K, N, 2) m and ``covs`` (K, N, 2, 2) of its landmarks; ``seen`` (N,), bool, of all; ``log_weights`` (K,)
    of sum 1; ``key`` of `jax.random`.
    """

    robots: Gaussian
    places: Array
    covs: Array
    seen: Array
    log_weights: Array
    key: Array


def fast_slam(
    model: Model,
    particles: int = 100,
    sightings: Mapping[str, Inverse] | None = None,
    gate: Gate = None,
    informed: bool = True,
    threshold: float = 0.5,
) -> Filter:
    """FastSLAM with known association: particles of the path, and for each a Kalman filter for each landmark.

    Between readings a particle's robot is a Gaussian, that of an `ekf`. A sighting of landmark j, z with covariance R,
    corrects it, ``S = H_x P H_x' + H_m C_j H_m' + R``; a pose is drawn from what results; then the landmark is
    corrected as seen from there. The weight is multiplied by ``N(z; h, S)``. That is FastSLAM 2.0. With
    ``informed=False`` the pose is drawn before the reading is looked at and the weight multiplied by ``N(z; h, H_m C_j
    H_m' + R)``: FastSLAM 1.0, which needs more particles the better the sensor. A reading of the robot alone corrects
    its Gaussian and draws nothing. The landmarks' priors are not looked at, as in `ekf_slam`.

    Args:
        model: on `World`, of `jaxfilt.models.slam.with_landmarks`.
        particles: K, how many.
        sightings: as in `ekf_slam`.
        gate: probability with which a true reading passes, by the NIS of all particles' mean innovation.
        informed: whether poses are drawn knowing the reading.
        threshold: resampled, systematically, where the effective number of particles is below this share of K.

    Returns:
        Filter that carries a `Swarm`: `begin` needs a key. ``Info.loglik`` is the log of the weights' mean, an estimate
        of p(z | past); innovation and S are those of the mixture.

    Raises:
        TypeError: a model that is not on a `World`, a context that is no number of a landmark.
        ValueError: no particles, a threshold that is not 0 to 1, `begin` without a key.
        KeyError: sightings of sensors that the model lacks.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxfilt.models.slam import slam, slam_start
        >>> filt = fast_slam(slam(landmarks=2), particles=10)
        >>> swarm = filt.begin(slam_start(landmarks=jnp.zeros((2, 2))), jax.random.key(0))
        >>> swarm, info = filt.update(swarm, (3.0, 0.0), "landmark", 1)
        >>> swarm.seen.tolist(), filt.gaussian(swarm).mean.landmarks[1].round(4).tolist()
        ([False, True], [3.0, 0.0])

    Source: M. Montemerlo, S. Thrun, D. Koller, B. Wegbreit, FastSLAM: A factored solution to the simultaneous
    localization and mapping problem (2002), section 3; FastSLAM 2.0 (2003), eqs. 8 to 18.
    """
    parts = anatomy(model, sightings)
    if particles < 1:
        raise ValueError(f"particles: expected at least 1, got {particles}")
    if not 0 <= threshold <= 1:
        raise ValueError(f"threshold: expected 0 to 1, got {threshold}")
    gates = thresholds_of("gate", model, gate)
    robot = robot_alone(model, parts)
    move = predictor(taylor, robot)

    def begin(start: Gaussian | Swarm, key: Array | None = None) -> Swarm:
        if isinstance(start, Swarm):
            return checked(start)
        if not isinstance(start, Gaussian):
            raise TypeError(f"belief: expected a Gaussian or a Swarm, got {type(start).__name__}")
        if key is None:
            raise ValueError("key: expected a key of jax.random, got None: FastSLAM draws its poses")
        (mean, P), r = canonical(start, model.space), parts.robot
        blocks = jnp.stack([P[i : i + 2, i : i + 2] for i in range(r, r + 2 * parts.landmarks, 2)])
        one = (Gaussian(mean.robot, linalg.symmetrize(P[:r, :r])), mean.landmarks, blocks)
        robots, places, covs = jax.tree.map(lambda a: jnp.broadcast_to(a, (particles, *a.shape)), one)
        even = jnp.full(particles, -math.log(particles), P.dtype)
        return Swarm(robots, places, covs, jnp.zeros(parts.landmarks, bool), even, key)

    def checked(swarm: Any) -> Swarm:
        doors.instance("swarm", swarm, Swarm)
        doors.mask("swarm.seen", swarm.seen, (parts.landmarks,))
        for field, shape in (
            ("places", (particles, parts.landmarks, 2)),
            ("covs", (particles, parts.landmarks, 2, 2)),
            ("log_weights", (particles,)),
        ):
            if np.shape(getattr(swarm, field)) != shape:
                raise ValueError(f"swarm.{field}: expected shape {shape}, got {np.shape(getattr(swarm, field))}")
        doors.point("swarm.robots.mean", swarm.robots.mean, robot.space, leading=(particles,))
        dtype = jax.dtypes.canonicalize_dtype(swarm.log_weights.dtype)
        numbers = {field: getattr(swarm, field) for field in ("robots", "places", "covs", "log_weights")}
        doors.floating("swarm", numbers)
        doors.same_dtype(dtype, **{f"swarm.{field}": value for field, value in numbers.items()})
        numbers = jax.tree.map(lambda a: jnp.asarray(a, dtype), numbers)
        return swarm._replace(**numbers, seen=jnp.asarray(swarm.seen))

    def predict(swarm: Swarm, u: PyTree = (), dt: Array | float = 0.0) -> Swarm:
        swarm = checked(swarm)
        return swarm._replace(robots=jax.vmap(lambda b: move(b, u, dt))(swarm.robots))

    def update(swarm: Swarm, z: PyTree, sensor: str, c: PyTree = (), mask: Array | None = None) -> tuple[Swarm, Info]:
        swarm, found = checked(swarm), doors.sensor(model, sensor)
        dtype = dtype_of(swarm)
        doors.point(f"z[{sensor!r}]", z, found.space)
        doors.finite(f"z[{sensor!r}]", z)
        doors.same_dtype(dtype, **{f"z[{sensor!r}]": z})
        z = jax.tree.map(lambda a: jnp.asarray(a, dtype), z)
        if mask is not None:
            doors.mask(f"mask of {sensor!r}", mask, (found.space.dim,))
        if sensor not in parts.inverse:
            after, each = _robots_read(robot, swarm, z, sensor, c, mask)
            return weighed(swarm, after, z, each, sensor, mask)

        number = known_number(sensor, c, parts.landmarks)
        z = of_some_landmark(z, number, parts.landmarks)
        heard = masked(robot.sensors[sensor], z, mask)
        key, drawn = jax.random.split(swarm.key)
        swarm = swarm._replace(key=key)
        noise = jax.random.normal(drawn, (particles, parts.robot), dtype)

        def again(swarm: Swarm) -> tuple[Swarm, Info]:
            seen = jax.vmap(partial(seen_again, robot.space, heard, z, informed))
            here = swarm.places.at[:, number].get(**OUTSIDE), swarm.covs.at[:, number].get(**OUTSIDE)
            robots, places, covs, each = seen(swarm.robots, noise, *here)
            return weighed(swarm, _written(swarm, number, robots, places, covs), z, each, sensor, mask)

        def begun(swarm: Swarm) -> tuple[Swarm, Info]:
            seen = jax.vmap(partial(seen_first, robot.space, heard, z, parts.inverse[sensor]))
            after = _written(swarm, number, *seen(swarm.robots, noise))
            after = after._replace(seen=swarm.seen.at[number].set(True))
            before = swarm.robots, swarm.log_weights
            info = first_sight(found.space.dim, dtype, z, before, (after.robots, after.places, after.covs))
            if mask is None:
                return after, info
            whole = jnp.asarray(mask).all()  # from a range alone nobody knows where a landmark stands
            silent = swarm, nothing(found.space.dim, dtype)
            return jax.tree.map(lambda new, old: jnp.where(whole, new, old), (after, info), silent)

        first = ~swarm.seen.at[number].get(mode="fill", fill_value=True, wrap_negative_indices=False)
        return branch(first, begun, again, swarm)

    def weighed(
        before: Swarm, after: Swarm, z: PyTree, each: Each, sensor: str, mask: Array | None
    ) -> tuple[Swarm, Info]:
        after, info = _weighed(before, after, z, each, mask)
        if sensor in gates:
            threshold_of_nis = jnp.asarray(gates[sensor], info.nis.dtype)[info.dof]
            info = info._replace(ratio=info.nis / threshold_of_nis)
            refused = (info.ratio > 1) & (info.status == Status.OK)
            info = info._replace(
                status=jnp.where(refused, jnp.int32(Status.GATED), info.status),
                dof=jnp.where(refused, 0, info.dof),
                loglik=jnp.where(refused, 0.0, info.loglik),
            )
            after = jax.tree.map(lambda old, new: jnp.where(refused, old, new), before, after)
        return _resampled(after, threshold), info

    def gaussian(swarm: Swarm) -> Gaussian:
        w, r = jnp.exp(swarm.log_weights), parts.robot
        spread = moments(World(swarm.robots.mean, swarm.places), w, model.space)
        own = jax.vmap(lambda b: carried(robot.space, b, spread.mean.robot))(swarm.robots)
        cov = spread.cov.at[:r, :r].add(jnp.tensordot(w, own, axes=1))
        rows = r + np.arange(2 * parts.landmarks).reshape(parts.landmarks, 2)
        cov = cov.at[rows[:, :, None], rows[:, None, :]].add(jnp.tensordot(w, swarm.covs, axes=1))
        return Gaussian(spread.mean, linalg.symmetrize(cov))

    return Filter(predict, update, stepper(model, predict, update), model, begin, gaussian)


OUTSIDE = {"mode": "fill", "fill_value": jnp.nan, "wrap_negative_indices": False}
"""What a landmark's number that is none reads: NaN, which shows in the status."""


def _written(swarm: Swarm, number: Array, robots: Gaussian, places: Array, covs: Array) -> Swarm:
    """The swarm with these robots and, of each, this one landmark."""
    places, covs = swarm.places.at[:, number].set(places), swarm.covs.at[:, number].set(covs)
    return swarm._replace(robots=robots, places=places, covs=covs)


def _robots_read(robot: Model, swarm: Swarm, z: PyTree, name: str, c: PyTree, mask: Array | None) -> tuple[Swarm, Each]:
    """A sensor that sees no landmark: each particle's Gaussian is corrected, as in an `ekf`."""
    recipe = Recipe(taylor, lambda _: taylor, 1, {}, {})
    robots, info = jax.vmap(lambda b: correct_belief(recipe, robot, name, b, z, c, mask))(swarm.robots)
    constant = 0.5 * math.log(2 * math.pi) * info.dof.astype(info.loglik.dtype)
    return swarm._replace(robots=robots), Each(info.innovation, info.S, info.loglik + constant)


def _weighed(before: Swarm, after: Swarm, z: PyTree, each: Each, mask: Array | None) -> tuple[Swarm, Info]:
    """Weights multiplied by the particles' densities, and what is reported of the mixture."""
    total = jax.nn.logsumexp(before.log_weights + each.loglik)
    after = after._replace(log_weights=before.log_weights + each.loglik - total)
    w = jnp.exp(before.log_weights)
    r = w @ each.innovation
    d = each.innovation - r[None, :]
    S = linalg.symmetrize(jnp.tensordot(w, each.S, axes=1) + d.T @ (w[:, None] * d))
    nis = linalg.score(S, linalg.cholesky(S), r)[0]
    dof = jnp.int32(len(r)) if mask is None else jnp.asarray(mask).sum(dtype=jnp.int32)
    loglik = total - 0.5 * math.log(2 * math.pi) * dof.astype(total.dtype)
    status = jnp.int32(Status.OK)
    for tree, code in (
        ((after.robots, after.places, after.covs, after.log_weights), Status.BAD_POSTERIOR),
        ((r, S), Status.BAD_PREDICTION),
        (z, Status.BAD_MEASUREMENT),
        ((before.robots, before.places, before.covs, before.log_weights), Status.BAD_BELIEF),
    ):
        status = jnp.where(finite(tree), status, jnp.int32(code))
    return after, Info(r, S, nis, loglik, dof, jnp.zeros_like(nis), status)


def _resampled(swarm: Swarm, threshold: float) -> Swarm:
    """The swarm drawn anew by its weights, where few particles carry them all."""
    count = len(swarm.log_weights)
    key, drawn = jax.random.split(swarm.key)
    few = jnp.exp(-jax.nn.logsumexp(2 * swarm.log_weights)) < threshold * count

    def again(swarm: Swarm) -> Swarm:
        chosen = resampling.systematic(drawn, swarm.log_weights)
        robots, places, covs = jax.tree.map(lambda a: a[chosen], (swarm.robots, swarm.places, swarm.covs))
        even = jnp.full_like(swarm.log_weights, -math.log(count))
        return swarm._replace(robots=robots, places=places, covs=covs, log_weights=even)

    return branch(few, again, lambda swarm: swarm, swarm._replace(key=key))
