"""EKF-SLAM: one Gaussian over the robot and all landmarks, of which a reading looks at two blocks.

Each step costs O(n^2) for n = robot + 2 N numbers, for Jacobians are taken in the columns that are not zero, and
products with them likewise: the same covariances as of an `ekf`, in Joseph's form.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import chisquare, doors, linalg
from jaxfilt.correction import Gate, Recipe, correct_belief, nothing, thresholds_of
from jaxfilt.models.slam import World
from jaxfilt.prediction import branch, canonical, predictor, stepper
from jaxfilt.slam.parts import Anatomy, Inverse, anatomy, first_sight, known_number, of_some_landmark
from jaxfilt.transforms import Transform
from jaxfilt.types import Array, Filter, Gaussian, Info, Model, Moments, PyTree, Space


class Chart(NamedTuple):
    """What `ekf_slam` carries: a Gaussian on the `World`, and which landmarks were ``seen`` (N,), bool.

    A landmark that was not seen yet has the prior of the Gaussian that all began with. To give some of them away, begin
    with a Chart in which they are seen.
    """

    belief: Gaussian
    seen: Array


def ekf_slam(
    model: Model,
    sightings: Mapping[str, Inverse] | None = None,
    gate: Gate = None,
    robust: Gate = None,
    association: Literal["known", "nearest"] = "known",
    fresh: float = 1 - 1e-6,
) -> Filter:
    """EKF-SLAM: an extended Kalman filter on robot and landmarks, each landmark placed where it is first seen.

    With the place ``g(x, z)`` of a landmark that a robot at x sees as z, its Jacobians ``G_x, G_z`` and the covariance
    P of all else: ``mean = g(x, z)``, ``cov = G_x P_xx G_x' + G_z R G_z'``, ``cov with all else = G_x P_x.``. It is the
    limit of a prior that knows nothing of that landmark. Afterwards the reading corrects robot and map as in `ekf`. The
    linearisation is about estimates that change, so in time the map is believed too firmly; see the benchmarks.

    Args:
        model: on `World`, of `jaxfilt.models.slam.with_landmarks`.
        sightings: sensor of landmarks -> function (robot, z) -> place (2,), the inverse of the sensor's h. Default: the
            sensor "landmark", range and bearing of a robot with ``pos`` and ``yaw``. Every other sensor reads the robot
            alone.
        gate, robust: as in `jaxfilt.ekf`. A landmark's first sighting has nothing to be compared with and passes.
        association: "known": ``c`` is the number of the landmark. "nearest": ``c`` is not looked at; the reading is of
            the landmark that makes it likeliest (least ``nis + log |S|``), if the gate lets it pass; of a new one, the
            next that is free, where even the least NIS is beyond the quantile ``fresh``; of none in between.
        fresh: probability, above the gate's.

    Returns:
        Filter that carries a `Chart`. A first sighting is reported with dof, nis and loglik 0.

    Raises:
        TypeError: a model that is not on a `World`, a context that is no number of a landmark.
        ValueError: "nearest" without a gate, or with a gate above ``fresh``.
        KeyError: sightings of sensors that the model lacks.

    Example: what is first seen from a pose that is off by 0.5 m is off by as much, and so is all that is seen later.
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> from jaxfilt.models.slam import slam, slam_start
        >>> filt = ekf_slam(slam(landmarks=2))
        >>> start = slam_start(landmarks=jnp.zeros((2, 2)))
        >>> chart = filt.begin(start._replace(cov=start.cov.at[0, 0].set(0.25)))
        >>> chart, info = filt.update(chart, (3.0, 0.0), "landmark", 1)
        >>> chart.seen.tolist(), chart.belief.mean.landmarks[1].tolist(), round(float(chart.belief.cov[0, 5]), 4)
        ([False, True], [3.0, 0.0], 0.25)

    Source: R. Smith, M. Self, P. Cheeseman, Estimating uncertain spatial relationships in robotics (1990), section 4;
    S. Thrun, W. Burgard, D. Fox, Probabilistic Robotics (2005), tables 10.1 (its infinite prior taken to the limit) and
    10.2 (association).
    """
    parts = anatomy(model, sightings)
    gates, limits = thresholds_of("gate", model, gate), thresholds_of("robust", model, robust)
    newcomers = _newcomers(model, parts, association, gates, fresh)
    move = predictor(_moving(parts.robot), model)

    def begin(carried: Gaussian | Chart, key: Array | None = None) -> Chart:
        if not isinstance(carried, (Gaussian, Chart)):
            raise TypeError(f"belief: expected a Gaussian or a Chart, got {type(carried).__name__}")
        chart = carried if isinstance(carried, Chart) else Chart(carried, np.zeros(parts.landmarks, bool))
        chart = checked(chart)
        return chart._replace(belief=chart.belief._replace(cov=linalg.symmetrize(chart.belief.cov)))

    def checked(chart: Any) -> Chart:
        doors.instance("chart", chart, Chart)
        doors.mask("chart.seen", chart.seen, (parts.landmarks,))
        return Chart(canonical(chart.belief, model.space), jnp.asarray(chart.seen))

    def predict(chart: Chart, u: PyTree = (), dt: Array | float = 0.0) -> Chart:
        chart = checked(chart)
        return chart._replace(belief=move(chart.belief, u, dt))

    def update(chart: Chart, z: PyTree, sensor: str, c: PyTree = (), mask: Array | None = None) -> tuple[Chart, Info]:
        chart = checked(chart)
        found, dtype = doors.sensor(model, sensor), chart.belief.cov.dtype
        doors.point(f"z[{sensor!r}]", z, found.space)
        doors.finite(f"z[{sensor!r}]", z)
        doors.same_dtype(dtype, **{f"z[{sensor!r}]": z})
        z = jax.tree.map(lambda a: jnp.asarray(a, dtype), z)

        def corrected(chart: Chart, rows: Array, c: PyTree) -> tuple[Chart, Info]:
            transform = _looking(rows)
            recipe = Recipe(transform, lambda _: transform, 1, gates, limits)
            belief, info = correct_belief(recipe, model, sensor, chart.belief, z, c, mask)
            return chart._replace(belief=belief), info

        if sensor not in parts.inverse:
            return corrected(chart, jnp.arange(parts.robot, dtype=jnp.int32), c)

        if association == "known":
            number = known_number(sensor, c, parts.landmarks)
            z = of_some_landmark(z, number, parts.landmarks)
            first = ~chart.seen.at[number].get(mode="fill", fill_value=True, wrap_negative_indices=False)
        else:
            if mask is not None:
                raise ValueError(f"mask of {sensor!r}: expected None, for the nearest is told by whole readings only")
            number, first = _nearest(model, parts, sensor, chart, z, newcomers[sensor])
        rows = jnp.concatenate([jnp.arange(parts.robot, dtype=jnp.int32), parts.rows(number)])

        def again(chart: Chart) -> tuple[Chart, Info]:
            return corrected(chart, rows, number)

        def begun(chart: Chart) -> tuple[Chart, Info]:
            after = _begun(model, parts, sensor, chart, z, number)
            info = first_sight(found.space.dim, dtype, z, chart.belief, after.belief)
            if mask is None:
                return after, info
            doors.mask(f"mask of {sensor!r}", mask, (found.space.dim,))
            whole = jnp.asarray(mask).all()  # from a range alone nobody knows where a landmark stands
            silent = nothing(found.space.dim, dtype)
            return jax.tree.map(lambda new, old: jnp.where(whole, new, old), (after, info), (chart, silent))

        return branch(first, begun, again, chart)

    return Filter(predict, update, stepper(model, predict, update), model, begin, lambda chart: chart.belief)


def _newcomers(
    model: Model, parts: Anatomy, association: str, gates: dict[str, np.ndarray], fresh: float
) -> dict[str, float]:
    """For each sensor of landmarks the NIS beyond which a reading is of a new one."""
    if association not in ("known", "nearest"):
        raise ValueError(f"association: expected 'known' or 'nearest', got {association!r}")
    if association == "known":
        return {}
    if not 0 < fresh < 1:
        raise ValueError(f"fresh: expected a probability between 0 and 1, got {fresh}")
    beyond = {}
    for name in parts.inverse:
        dim = model.sensors[name].space.dim
        beyond[name] = float(chisquare.quantile(fresh, np.array([dim]))[0])
        if name not in gates:
            raise ValueError(f"gate: expected one for {name!r}, by which the nearest landmark is accepted, got none")
        if gates[name][-1] > beyond[name]:
            raise ValueError(f"fresh: expected a probability above the gate's, got {fresh}")
    return beyond


def _looking(rows: Array) -> Transform:
    """`taylor` of a function that looks at these rows of the state alone."""

    def transform(g: Any, belief: Gaussian, space_in: Space, space_out: Space) -> Moments:
        P, y, n = belief.cov, g(belief.mean), space_in.dim

        def away(d: jax.Array) -> jax.Array:
            return space_out.minus(g(space_in.plus(belief.mean, jnp.zeros(n, P.dtype).at[rows].set(d))), y)

        J = jax.jacfwd(away)(jnp.zeros(rows.shape[0], P.dtype))
        H = jnp.zeros((space_out.dim, n), P.dtype).at[:, rows].set(J)
        PH = P[:, rows] @ J.T

        def remainder(K: jax.Array) -> jax.Array:
            left = P - K @ PH.T  # (I - K H) P, P symmetric
            return left - (left @ H.T) @ K.T

        return Moments(y, J @ PH[rows], PH, remainder)

    return transform


def _moving(r: int) -> Transform:
    """`taylor` of a motion of the first r numbers that depends on them alone, the others at rest."""

    def transform(f: Any, belief: Gaussian, space_in: Space, space_out: Space) -> Moments:
        P, y, n = belief.cov, f(belief.mean), space_in.dim

        def away(d: jax.Array) -> jax.Array:
            return space_out.minus(f(space_in.plus(belief.mean, jnp.zeros(n, P.dtype).at[:r].set(d))), y)[:r]

        F = jax.jacfwd(away)(jnp.zeros(r, P.dtype))
        cross = P.at[:, :r].set(P[:, :r] @ F.T)

        def remainder(K: jax.Array) -> jax.Array:
            A = jnp.eye(n, dtype=P.dtype) - K.at[:, :r].set(K[:, :r] @ F)
            return A @ P @ A.T

        return Moments(y, cross.at[:r].set(F @ cross[:r]), cross, remainder)

    return transform


def _begun(model: Model, parts: Anatomy, name: str, chart: Chart, z: PyTree, number: Array) -> Chart:
    """The chart with a landmark placed where it was seen."""
    (mean, P), sensor = chart.belief, model.sensors[name]
    r, rows, n = parts.robot, parts.rows(number), model.space.dim

    def place(d: jax.Array, e: jax.Array) -> jax.Array:
        robot = model.space.plus(mean, jnp.zeros(n, P.dtype).at[:r].set(d)).robot
        where = doors.call(f"sightings[{name!r}]", parts.inverse[name], robot=robot, z=sensor.space.plus(z, e))
        return jnp.asarray(where, P.dtype)

    here = jnp.zeros(r, P.dtype), jnp.zeros(sensor.space.dim, P.dtype)
    Gx, Gz = jax.jacfwd(place, argnums=(0, 1))(*here)
    mean = World(mean.robot, mean.landmarks.at[number].set(place(*here)))
    R = jnp.asarray(sensor.R(mean, number))
    with_all = Gx @ P[:r]
    P = P.at[rows].set(with_all).at[:, rows].set(with_all.T)
    P = P.at[rows[:, None], rows].set(linalg.symmetrize(Gx @ P[:r, :r] @ Gx.T + Gz @ R @ Gz.T))
    return Chart(Gaussian(mean, P), chart.seen.at[number].set(True))


def _nearest(
    model: Model, parts: Anatomy, name: str, chart: Chart, z: PyTree, beyond: float
) -> tuple[jax.Array, jax.Array]:
    """The number of the landmark that makes a reading likeliest, or of the next free one, and whether it is that."""
    sensor, belief = model.sensors[name], chart.belief

    def look(number: jax.Array) -> tuple[jax.Array, jax.Array]:
        rows = jnp.concatenate([jnp.arange(parts.robot, dtype=jnp.int32), parts.rows(number)])
        m = _looking(rows)(lambda x: sensor.h(x, number), belief, model.space, sensor.space)
        S = linalg.symmetrize(m.cov + sensor.R(belief.mean, number))
        nis, log_determinant = linalg.score(S, linalg.cholesky(S), sensor.space.minus(z, m.mean))
        return nis, nis + log_determinant

    nis, cost = jax.vmap(look)(jnp.arange(parts.landmarks, dtype=jnp.int32))
    nearest = jnp.argmin(jnp.where(chart.seen, cost, jnp.inf))
    # Of no landmark: where none was seen yet the least is infinite.
    first = (jnp.min(jnp.where(chart.seen, nis, jnp.inf)) > beyond) & ~chart.seen.all()
    return jnp.where(first, jnp.argmin(chart.seen), nearest).astype(jnp.int32), first
