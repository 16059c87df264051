"""The Kalman family: one predict and one update over any transform.

``predict``  m = transform(f);  belief' = (m.mean, m.cov + Q)
``update``   m = transform(h);  S = m.cov + R;  r = z - m.mean;  K = m.cross S^-1;
belief' = (mean + K r,  m.remainder(K) + K R K')

The last line is Joseph's form: valid for any K and positive semidefinite by construction. + and - are those of the
model's spaces. Filters are predict-first: a row predicts over its ``dt``, then updates; ``dt = 0`` makes it
update-first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import chisquare, doors, linalg
from jaxfilt.transforms import Transform, cubature, taylor, taylor_at, unscented
from jaxfilt.types import Array, Filter, Gaussian, Info, Log, Model, PyTree, Sensor, Space, Status

Gate = float | Mapping[str, float] | None


def kf(model: Model, gate: Gate = None) -> Filter:
    """Kalman filter: the `ekf`, which is exact on a linear model. `jaxfilt.linear` makes one.

    Source: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), table 5.2.4-1.
    """
    return build(taylor, model, gate)


def ekf(model: Model, gate: Gate = None) -> Filter:
    """Extended Kalman filter, Jacobians by automatic differentiation; on manifolds the error-state filter.

    Args:
        model: the robot and its sensors.
        gate: probability with which a true reading passes, e.g. 0.999, for all sensors or by name; None: no gate.

    Returns:
        Filter(predict, update, step): pure functions.

    Raises:
        ValueError, TypeError: at the first call, where shapes, structure or dtypes do not fit.

    Example:
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> filt = jf.ekf(walk)
        >>> belief = filt.predict(jf.Gaussian(jnp.zeros(1), jnp.eye(1)), (), 1.0)
        >>> belief, info = filt.update(belief, jnp.array([3.0]), "z")
        >>> round(float(belief.mean[0]), 4), round(float(info.nis), 4)
        (2.0, 3.0)

    Source: S. Sarkka, Bayesian Filtering and Smoothing (2013), algorithm 5.4.
    """
    return build(taylor, model, gate)


def iekf(model: Model, iterations: int = 4, gate: Gate = None) -> Filter:
    """Iterated extended Kalman filter: the update relinearises about its own result, a Gauss-Newton search.

    ``d <- K_i (z - h(x_i) - H_i (mean - x_i))`` with ``x_i = mean + d``; prior and measurement count once, however
    many iterations. Info (innovation, S, nis, likelihood) is that of the prediction, before any iteration.

    Args:
        model: the robot and its sensors.
        iterations: linearisations in all, >= 1; 1 is the `ekf`.
        gate: as in `ekf`.

    Source: Bell, Cathey, The iterated Kalman filter update as a Gauss-Newton method (1993), eqs. 3 and 9.
    """
    if iterations < 1:
        raise ValueError(f"iekf(iterations): expected at least 1, got {iterations}")
    return build(taylor, model, gate, relinearise=taylor_at, iterations=iterations)


def ukf(model: Model, alpha: float = 1.0, beta: float = 2.0, kappa: float = 0.0, gate: Gate = None) -> Filter:
    """Unscented Kalman filter, additive noise, fresh sigma points before the prediction and before each update.

    Args:
        model: the robot and its sensors.
        alpha, beta, kappa: the spread and weights of the sigma points, see `unscented`.
        gate: as in `ekf`.

    Source: S. Sarkka, Bayesian Filtering and Smoothing (2013), algorithm 5.14.
    """
    return build(unscented(alpha, beta, kappa), model, gate)


def ckf(model: Model, gate: Gate = None) -> Filter:
    """Cubature Kalman filter. Source: Arasaratnam, Haykin, Cubature Kalman filters (2009), appendix A."""
    return build(cubature, model, gate)


def build(
    transform: Transform,
    model: Model,
    gate: Gate = None,
    relinearise: Callable[[jax.Array], Transform] | None = None,
    iterations: int = 1,
) -> Filter:
    """A filter from any transform: the way to a filter of your own.

    Args:
        transform: how a Gaussian passes through f and h, see `jaxfilt.transforms`.
        model: the robot and its sensors.
        gate: as in `ekf`.
        relinearise: offset (n,) -> transform about ``mean + offset``, for updates with more than one iteration.
        iterations: linearisations per update.
    """
    doors.instance("model", model, Model)
    if not model.sensors:
        raise ValueError("model.sensors: expected at least one sensor, got none")
    recipe = _Recipe(transform, relinearise or (lambda _: transform), iterations, _thresholds(model, gate))

    def predict(belief: Gaussian, u: PyTree = (), dt: Array | float = 0.0) -> Gaussian:
        belief = _canonical(belief, model.space)
        doors.inputs("u", u, belief.cov.dtype)
        moves, dt = _interval(dt, belief)
        return _branch(moves, lambda b: _predict(transform, model, b, u, dt), lambda b: b, belief)

    def update(
        belief: Gaussian, z: PyTree, sensor: str, c: PyTree = (), mask: Array | None = None
    ) -> tuple[Gaussian, Info]:
        belief = _canonical(belief, model.space)
        found = doors.sensor(model, sensor)
        doors.point(f"z[{sensor!r}]", z, found.space)
        doors.finite(f"z[{sensor!r}]", z)
        doors.same_dtype(belief.cov.dtype, **{f"z[{sensor!r}]": z})
        return _update(recipe, model, sensor, belief, z, c, mask)

    def step(belief: Gaussian, row: Log) -> tuple[Gaussian, dict[str, Info]]:
        doors.tables("row", row, model)
        belief = predict(belief, row.u, row.dt)
        infos = {}
        for name in model.sensors:
            if name in row.z:
                belief, infos[name] = _update_if_there(update, model, belief, row, name)
        return belief, infos

    return Filter(predict, update, step, model)


class _Recipe(NamedTuple):
    """What makes a filter this one: its transform, how its update iterates, its gates' thresholds by sensor."""

    transform: Transform
    relinearise: Callable[[jax.Array], Transform]
    iterations: int
    thresholds: dict[str, np.ndarray]


def _canonical(belief: Gaussian, space: Space) -> Gaussian:
    """The belief as arrays of one dtype, that of its covariance; a Python float in the mean is taken along."""
    doors.belief("belief", belief, space)
    dtype = jax.dtypes.canonicalize_dtype(belief.cov.dtype)
    return Gaussian(*jax.tree.map(lambda a: jnp.asarray(a, dtype), tuple(belief)))


def _interval(dt: Array | float, belief: Gaussian) -> tuple[Array | bool, jax.Array]:
    """Whether time passes, and how much, checked."""
    if np.shape(dt) != ():
        raise ValueError(f"dt: expected a scalar, got shape {np.shape(dt)}")
    if doors.is_concrete(dt) and not 0 <= float(dt) < math.inf:
        raise ValueError(f"dt: expected a finite interval >= 0 s, got {float(dt)}")
    doors.same_dtype(belief.cov.dtype, dt=dt)
    return dt > 0, jnp.asarray(dt, belief.cov.dtype)


def _branch(predicate: Array | bool, then: Callable, otherwise: Callable, belief: Gaussian) -> Any:
    """`jax.lax.cond`, decided at once where the predicate is known: outside jit a cond would compile at every call."""
    if doors.is_concrete(predicate):
        return then(belief) if predicate else otherwise(belief)
    return jax.lax.cond(predicate, then, otherwise, belief)


def _predict(transform: Transform, model: Model, belief: Gaussian, u: PyTree, dt: jax.Array) -> Gaussian:
    # Where vmap turns the branch on dt into a select, this one runs at dt = 0 too: keep f and Q off that point.
    dt = jnp.where(dt > 0, dt, 1.0)

    def f(x: PyTree) -> PyTree:
        y = doors.call("f(x, u, dt)", model.f, x=x, u=u, dt=dt)
        return _image("f(x, u, dt)", y, model.space, belief.cov.dtype)

    m = transform(f, belief, model.space, model.space)
    Q = doors.call("Q(x, u, dt)", model.Q, x=belief.mean, u=u, dt=dt)
    doors.noise("Q(x, u, dt)", Q, model.space.dim, belief.cov.dtype)
    return Gaussian(m.mean, linalg.symmetrize(m.cov + Q))


def _update(
    recipe: _Recipe, model: Model, name: str, belief: Gaussian, z: PyTree, c: PyTree, mask: Array | None
) -> tuple[Gaussian, Info]:
    sensor, dtype = model.sensors[name], belief.cov.dtype

    def h(x: PyTree) -> PyTree:
        y = doors.call(f"h(x, c) of sensor {name!r}", sensor.h, x=x, c=c)
        return _image(f"h(x, c) of sensor {name!r}", y, sensor.space, dtype)

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
    thresholds = recipe.thresholds.get(name)
    info = _report(belief, z, r, S, L, there, thresholds)
    for _ in range(recipe.iterations - 1):
        m, r, S, L, cross = correct(recipe.relinearise(cross @ linalg.solve(S, L, r)))
    K = linalg.solve(S, L, cross.T).T
    moved = _moved(model.space, belief, cross @ linalg.solve(S, L, r), _joseph(m.remainder, K, R))
    info = info._replace(status=_judge(info.status, moved))
    if thresholds is None:
        return moved, info
    refused = info.status == Status.GATED
    belief = jax.tree.map(lambda old, new: jnp.where(refused, old, new), belief, moved)
    return belief, info


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


def _image(name: str, y: PyTree, space: Space, dtype: jnp.dtype) -> PyTree:
    """What a user's function returned, checked against the space it should lie on."""
    doors.point(name, y, space)
    doors.same_dtype(dtype, **{name: y})
    return jax.tree.map(lambda a: jnp.asarray(a, dtype), y)


def _moved(space: Space, belief: Gaussian, delta: jax.Array, P: jax.Array) -> Gaussian:
    """The belief moved by delta, its covariance carried to the tangent space at the new mean."""
    mean = space.plus(belief.mean, delta)
    if not space.flat:
        G = jax.jacfwd(lambda d: space.minus(space.plus(belief.mean, d), mean))(delta)
        P = G @ P @ G.T
    return Gaussian(mean, linalg.symmetrize(P))


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
    thresholds: np.ndarray | None,
) -> Info:
    nis, log_determinant = linalg.score(S, L, r)
    dof = jnp.asarray(len(r), jnp.int32) if there is None else there.sum(dtype=jnp.int32)
    loglik = -0.5 * (nis + log_determinant + dof.astype(r.dtype) * math.log(2 * math.pi))
    status = jnp.where(_is_finite((belief.mean, belief.cov)), Status.OK, Status.BAD_BELIEF).astype(jnp.int32)
    status = _first(status, ~_is_finite(z), Status.BAD_MEASUREMENT)
    status = _first(status, ~_is_finite((r, S)), Status.BAD_PREDICTION)
    status = _first(status, ~jnp.all(jnp.diagonal(L) > 0), Status.INDEFINITE_INNOVATION)
    ratio = jnp.zeros_like(nis)
    if thresholds is not None:
        ratio = nis / jnp.asarray(thresholds, nis.dtype)[dof]
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


def _update_if_there(update: Callable, model: Model, belief: Gaussian, row: Log, name: str) -> tuple[Gaussian, Info]:
    z, c = row.z[name], row.c.get(name, ())
    if name not in row.valid:
        return update(belief, z, name, c)
    valid = row.valid[name]
    doors.mask(f"row.valid[{name!r}]", valid, (), (model.sensors[name].space.dim,))
    valid = np.bool_(valid) if isinstance(valid, bool) else valid
    mask = valid if np.ndim(valid) else None
    nothing = _nothing(model.sensors[name].space.dim, belief.cov.dtype)
    return _branch(valid.any(), lambda b: update(b, z, name, c, mask), lambda b: (b, nothing), belief)


def _nothing(m: int, dtype: jnp.dtype) -> Info:
    """What is reported of a sensor that was silent."""
    number, count = jnp.zeros((), dtype), jnp.zeros((), jnp.int32)
    absent = jnp.asarray(Status.ABSENT, jnp.int32)
    return Info(jnp.zeros(m, dtype), jnp.zeros((m, m), dtype), number, number, count, number, absent)


def _thresholds(model: Model, gate: Gate) -> dict[str, np.ndarray]:
    """For each gated sensor the chi-square threshold by number of components seen, 0 ... m."""
    if gate is None:
        return {}
    by_sensor = dict(gate) if isinstance(gate, Mapping) else dict.fromkeys(model.sensors, gate)
    thresholds = {}
    for name, probability in by_sensor.items():
        if name not in model.sensors:
            raise KeyError(f"gate: expected sensors of {list(model.sensors)}, got {name!r}")
        if not 0 < probability < 1:
            raise ValueError(f"gate: expected a probability between 0 and 1 for {name!r}, got {probability}")
        dof = np.arange(1, model.sensors[name].space.dim + 1)
        thresholds[name] = np.r_[1.0, chisquare.quantile(probability, dof)]
    return thresholds
