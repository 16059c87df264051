"""The posterior Cramer-Rao bound: how small the mean squared error of a filter, any filter, can be.

With F, Q, H, R along a truth and E the mean over truths, drawn from the prior with process noise, Tichavsky's
recursion for the information ``J = P^-1`` is, row by row::

    J' = D22 - D12' (J + D11)^-1 D12 + E[H' R^-1 H]
    D11 = E[F' Q^-1 F],  D12 = -E[F]' Q^-1,  D22 = Q^-1

The matrix inversion lemma takes the first part to a form that is used here, since Q and P may be singular in it::

    P' = Q + E[F] (P^-1 + S)^-1 E[F]',   S = E[(F - E[F])' Q^-1 (F - E[F])]

S = 0 where F is the same for all truths: on a linear model this is the Kalman filter. A singular Q, as the limit of
``Q + eps I``, makes S the same with the pseudo-inverse of Q, as long as the columns of F - E[F] lie in the range of Q.
Where they do not, S has no limit, and that bound says nothing; see `cramer_rao` for what is computed then.

JAX takes the means, in one compiled program; the recursion runs in NumPy, in float64.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors, linalg
from jaxfilt import log as logs
from jaxfilt.filters import ekf
from jaxfilt.metrics import Blocks
from jaxfilt.simulate import simulate
from jaxfilt.transforms import taylor
from jaxfilt.types import Array, Gaussian, Log, Model, PyTree, Space


class Bound(NamedTuple):
    """What `cramer_rao` returns, in NumPy.

    ``cov`` (T, n, n): the bound on the mean squared error matrix after each row, in the tangent space.
    ``linearised`` (T, n, n): the mean over the truths of the covariance that a filter has which linearises at the
    truth. It is what a good filter reaches where errors are small, and it bounds nothing.
    ``exact``: whether ``cov`` is a bound; if not, an approximation, and ``kind`` says in words why.
    """

    cov: np.ndarray
    linearised: np.ndarray
    exact: bool
    kind: str


class _Row(NamedTuple):
    """One row's means over the truths, and what differs from truth to truth by more than rounding.

    ``D`` = E[H' R^-1 H] over all sensors; ``beyond``: F - E[F] leaves the range of Q; ``bends``: F or H differs.
    """

    F: Array
    S: Array
    Q: Array
    D: Array
    linearised: Array
    beyond: Array
    bends: Array
    Q_differs: Array
    R_differs: dict[str, Array]
    R_singular: dict[str, Array]


def cramer_rao(
    model: Callable[[PyTree], Model],
    belief: Callable[[PyTree], Gaussian],
    log: Log,
    key: Array,
    *,
    theta: PyTree,
    runs: int = 200,
    control: Callable[[PyTree, PyTree], PyTree] | None = None,
) -> Bound:
    """Posterior Cramer-Rao bound: ``E[minus(truth, estimate) minus(truth, estimate)'] >= cov`` for every filter.

    Truths are drawn with process noise, their start from the prior ``belief(theta)``. The bound is exact, up to the
    mean over ``runs`` truths, where the state space is flat, Q and R are the same for all truths, and the noise
    reaches every direction in which the nonlinear part of f acts. Where dynamics and sensors are linear, no mean is
    needed, and a Kalman filter attains it. An angle counts as flat: its errors should be small against a turn.

    Otherwise it is approximate, and ``kind`` says so. Where the noise does not reach (a position that integrates the
    cosine of a heading), or Q or R differs, ``cov`` is ``linearised``: the start and the noises are taken as the
    unknowns, in which the model has no singular matrix, and for each truth ``G I^-1 G'`` is computed by a Riccati
    recursion along it, I being their information and G the derivative of the state. For fixed Q and R,
    ``E[G] E[I]^-1 E[G]'``, with the means inside, is a bound; it is no larger (Jensen), and the two meet for small
    errors. It has no recursion, so it is left to the tests.

    A nonlinear f with little noise has a bound that is exact and loose: look at ``linearised`` beside it. After 60 rows
    of `jaxfilt.models.car.scenario` the bound on the yaw is 0.29 of the EKF's mean squared error, ``linearised`` 1.04.

    Args:
        model: theta -> model.
        belief: theta -> Gaussian, the prior; its covariance may be singular, even zero.
        log: the schedule: dt, u, c and valid are used, see `jaxfilt.schedule`.
        key: of `jax.random`.
        theta: parameters. Other ones compile nothing new, as long as the functions are the same.
        runs: truths, >= 2: one would not show what differs. All T x runs states are in memory at once.
        control: as in `jaxfilt.simulate`. The bound is for filters that take the inputs as given.

    Raises:
        ValueError, TypeError, KeyError: naming the argument, what was expected and what came; a bound that is not
            finite, with its row.

    Example: a random walk, Q = R = 1, settles at the golden ratio's variance.
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> def walk(theta):
        ...     return jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1) * theta)
        >>> def start(theta):
        ...     return jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> bound = cramer_rao(walk, start, jf.schedule(walk(1.0), 20, 1.0), jax.random.key(0), theta=1.0, runs=2)
        >>> round(float(bound.cov[-1, 0, 0]), 4), bound.exact
        (0.618, True)

    Source: Tichavsky, Muravchik, Nehorai, Posterior Cramer-Rao bounds for discrete-time nonlinear filtering (1998),
    eq. 21, with its section on additive Gaussian noise. Covariances along the truth: J. H. Taylor, The Cramer-Rao
    estimation error lower bound computation for deterministic nonlinear systems (1979). Both means inside: H. L. Van
    Trees, Detection, Estimation, and Modulation Theory, part I (1968), section 2.4.3.
    """
    robot, start = model(theta), belief(theta)
    doors.belief("belief(theta)", start, robot.space)
    dtype = jax.dtypes.canonicalize_dtype(start.cov.dtype)
    logs.validate(robot, log, dtype)
    if runs < 2:
        raise ValueError(f"runs: expected at least 2, got {runs}")
    jax.eval_shape(functools.partial(_step, robot, control), start, jax.tree.map(lambda a: a[0], log))
    rows = jax.device_get(_means(model, belief, control, runs, theta, log, key))
    _finite("the covariance linearised at the truths", rows.linearised)

    linear, flat = not rows.bends.any(), all(space.flat for space in _spaces(robot, log))
    broken = _broken(rows)
    linearised = np.asarray(rows.linearised, np.float64)
    cov = linearised if broken else _recursion(np.asarray(start.cov, np.float64), rows)
    _finite("the bound", cov)

    reasons = broken + ([] if flat else ["the space is curved, and its tangent will do for small errors"])
    if control and not linear:
        reasons.append("the inputs follow the true state, and what they tell of it is left out")
    if reasons:
        kind = "approximate: " + "; ".join(reasons)
    elif linear:
        kind = "exact: dynamics and sensors are linear, and a Kalman filter attains it"
    else:
        kind = f"exact, up to the mean over {runs} truths: no filter's mean squared error is smaller, none may reach it"
    return Bound(cov, linearised, not reasons, kind)


def efficiency(bound: np.ndarray, mse: np.ndarray, blocks: Blocks) -> dict[str, np.ndarray]:
    """How much of what is possible a filter reaches: bound over mean squared error, 1 being all of it.

    Args:
        bound: (T, n, n), the ``cov`` of `cramer_rao`.
        mse: (T, n, n) mean over runs of e e', e the errors; NaN where unknown.
        blocks: name -> (indices of the tangent vector, unit).

    Returns:
        name -> (T,): trace of the bound's block over trace of the error's; and "total", the mean over the components
        of their ratios, so that units do not weigh. NaN where the error is 0.

    Raises:
        ValueError: shapes that differ, indices outside, a block called "total".

    Example:
        >>> bound, mse = np.diag([1.0, 4.0])[None], np.diag([2.0, 4.0])[None]
        >>> {name: float(e[0]) for name, e in efficiency(bound, mse, {"position": ((0,), "m")}).items()}
        {'position': 0.5, 'total': 0.75}
    """
    bound, mse = np.asarray(bound), np.asarray(mse)
    if bound.ndim != 3 or bound.shape[1] != bound.shape[2] or bound.shape != mse.shape:
        raise ValueError(f"efficiency: expected bound and mse of one shape (T, n, n), got {bound.shape}, {mse.shape}")
    n = bound.shape[1]
    for name, (index, _) in blocks.items():
        if name == "total" or not index or min(index) < 0 or max(index) >= n:
            raise ValueError(f"blocks: expected indices from 0 to {n - 1} and no name 'total', got {name!r}: {index}")
    least, got = (np.diagonal(a, axis1=1, axis2=2) for a in (bound, mse))
    with np.errstate(divide="ignore", invalid="ignore"):
        by_block = {name: least[:, list(i)].sum(1) / got[:, list(i)].sum(1) for name, (i, _) in blocks.items()}
        ratios = np.where(got > 0, least / got, np.nan)
    counted = np.isfinite(ratios)
    total = np.where(counted, ratios, 0.0).sum(1) / np.where(counted.any(1), counted.sum(1), np.nan)
    return by_block | {"total": total}


def _step(robot: Model, control: Callable | None, start: Gaussian, row: Log) -> PyTree:
    """For its doors alone: a filter's step looks at the shapes and dtypes of all that f, Q, h and R return."""
    u = row.u if control is None else control(start.mean, row.u)
    return ekf(robot).step(start, row._replace(u=u))


# --- the means over the truths, in JAX --------------------------------------------------------------------------------


@functools.partial(jax.jit, static_argnums=(0, 1, 2, 3))
def _means(
    model: Callable, belief: Callable, control: Callable | None, runs: int, theta: PyTree, log: Log, key: Array
) -> _Row:
    """Each row's means: a scan over rows, the truths side by side; leading axis T."""
    robot, start = model(theta), belief(theta)
    dtype = jax.dtypes.canonicalize_dtype(start.cov.dtype)
    # The first row once more, in no time: the truth after it is the start.
    rows = jax.tree.map(lambda a: jnp.concatenate([a[:1], a]), log)
    rows = rows._replace(dt=rows.dt.at[0].set(0.0))

    def draw(number: Array) -> tuple:
        truth, seen = simulate(robot, start, rows, jax.random.fold_in(key, number), control)
        return truth, seen.u

    truth, u = jax.vmap(draw, out_axes=1)(jnp.arange(runs))
    before, after = jax.tree.map(lambda a: a[:-1], truth), jax.tree.map(lambda a: a[1:], truth)

    def body(P: Array, each: tuple) -> tuple[Array, _Row]:
        before, after, u, row = each

        def one(before: PyTree, after: PyTree, u: PyTree, P: Array) -> tuple:
            F, Q = _dynamics(robot, before, u, row.dt, dtype)
            seen = {name: _sensor(robot, name, after, row, dtype) for name in robot.sensors if name in row.z}
            predicted = linalg.symmetrize(F @ P @ F.T + Q)
            updated = predicted
            for H, R in seen.values():
                updated = _updated(updated, H, R)
            return F, Q, {name: R for name, (_, R) in seen.items()}, _information(seen), predicted, updated

        F, Q, R, D, predicted, updated = jax.vmap(one)(before, after, u, P)
        return updated, _row(F, Q, R, D, P, predicted, updated)

    P = jnp.broadcast_to(jnp.asarray(start.cov, dtype), (runs, robot.space.dim, robot.space.dim))
    u = jax.tree.map(lambda a: a[1:], u)
    return jax.lax.scan(body, P, (before, after, u, jax.tree.map(jnp.asarray, log)))[1]


def _jacobian(g: Callable, x: PyTree, space_in: Space, space_out: Space, dtype: np.dtype) -> Array:
    return taylor(g, Gaussian(x, jnp.eye(space_in.dim, dtype=dtype)), space_in, space_out).cross.T


def _dynamics(robot: Model, x: PyTree, u: PyTree, dt: Array, dtype: np.dtype) -> tuple[Array, Array]:
    """F and Q of one truth; I and 0 in no time."""
    n = robot.space.dim

    def moves() -> tuple[Array, Array]:
        F = _jacobian(lambda x: robot.f(x, u, dt), x, robot.space, robot.space, dtype)
        return F, jnp.asarray(robot.Q(x, u, dt), dtype)

    return jax.lax.cond(dt > 0, moves, lambda: (jnp.eye(n, dtype=dtype), jnp.zeros((n, n), dtype)))


def _sensor(robot: Model, name: str, x: PyTree, row: Log, dtype: np.dtype) -> tuple[Array, Array]:
    """H and R of one sensor at one truth; H is 0 and R is 1 where a component was not seen: it tells nothing."""
    sensor = robot.sensors[name]
    c, m = row.c.get(name, ()), sensor.space.dim
    there = jnp.broadcast_to(jnp.asarray(row.valid.get(name, True)), (m,))
    H = _jacobian(lambda x: sensor.h(x, c), x, robot.space, sensor.space, dtype)
    R = jnp.where(there[:, None] & there[None, :], sensor.R(x, c), jnp.eye(m, dtype=dtype))
    return jnp.where(there[:, None], H, 0.0), R


def _information(seen: dict[str, tuple[Array, Array]]) -> dict[str, Array]:
    """``H' R^-1 H`` by sensor; NaN where R is singular."""
    scaled = {name: linalg.forward_solve(linalg.cholesky(R), H) for name, (H, R) in seen.items()}
    return {name: Y.T @ Y for name, Y in scaled.items()}


def _updated(P: Array, H: Array, R: Array) -> Array:
    """Joseph's form, as in `jaxfilt.filters`."""
    K = linalg.gain(P @ H.T, linalg.cholesky(linalg.symmetrize(H @ P @ H.T + R)))
    A = jnp.eye(len(P), dtype=P.dtype) - K @ H
    return linalg.symmetrize(A @ P @ A.T + K @ R @ K.T)


def _row(
    F: Array, Q: Array, R: dict[str, Array], D: dict[str, Array], P: Array, predicted: Array, updated: Array
) -> _Row:
    """The means over the truths (leading axis) of one row.

    What F - E[F] does is measured by what it moves: a standard deviation of the error before, in units of that after.
    """
    n, negligible = F.shape[-1], _negligible(F.dtype)
    mean_F = _mean(F)
    spread = F - mean_F[None]
    L = linalg.semidefinite_cholesky(Q[0])
    noisy = jnp.diagonal(L) > 0
    # L y = spread where there is noise; below a zero pivot y is what the noise cannot explain.
    Y = jax.vmap(linalg.forward_solve, in_axes=(None, 0))(L + jnp.diag(jnp.where(noisy, 0.0, 1.0)), spread)
    explained, rest = jnp.where(noisy[:, None], Y, 0.0), jnp.where(noisy[:, None], 0.0, Y)
    std_before, std_after = (jnp.sqrt(jnp.maximum(jnp.diagonal(_mean(cov)), 0.0)) for cov in (P, predicted))

    def moves(a: Array) -> Array:
        return jnp.any(jnp.abs(a) * std_before[None, None, :] > negligible * std_after[None, :, None])

    bends = [moves(spread), *[_differs(d) for d in D.values()]]
    return _Row(
        F=mean_F,
        S=_mean(jnp.swapaxes(explained, 1, 2) @ explained),
        Q=Q[0],
        D=sum((_mean(d) for d in D.values()), jnp.zeros((n, n), F.dtype)),
        linearised=_mean(updated),
        beyond=moves(rest),
        bends=jnp.any(jnp.stack(bends)),
        Q_differs=_differs(Q),
        R_differs={name: _differs(r) for name, r in R.items()},
        R_singular={name: ~jnp.all(jnp.isfinite(d)) for name, d in D.items()},
    )


def _mean(a: Array) -> Array:
    """The mean over the first axis; exact where all are the same."""
    return a[0] + (a - a[:1]).mean(0)


def _differs(P: Array) -> Array:
    """Whether covariances (or informations) along the first axis differ by more than rounding of their own size."""
    size = jnp.sqrt(jnp.diagonal(P, axis1=1, axis2=2).max(0))
    return jnp.any(jnp.abs(P - P[:1]) > _negligible(P.dtype) * size[None, :, None] * size[None, None, :])


def _negligible(dtype: np.dtype) -> float:
    """Half the digits: further below, a difference is rounding, or might as well be."""
    return float(jnp.finfo(dtype).eps) ** 0.5


# --- the recursion, in NumPy ------------------------------------------------------------------------------------------


def _recursion(P: np.ndarray, rows: _Row) -> np.ndarray:
    covs = []
    for F, S, Q, D in zip(*(np.asarray(a, np.float64) for a in (rows.F, rows.S, rows.Q, rows.D)), strict=True):
        P = Q + F @ _informed(P, S) @ F.T
        P = _informed(P, D)
        covs.append(P)
    return np.stack(covs)


def _informed(P: np.ndarray, D: np.ndarray) -> np.ndarray:
    """``(P^-1 + D)^-1`` for a P that may be singular: ``L (I + L' D L)^-1 L'`` with P = L L'."""
    if not D.any():
        return P
    scale = np.sqrt(np.diag(P))
    scale[scale == 0] = 1.0
    size, axes = np.linalg.eigh(P / np.outer(scale, scale))
    L = scale[:, None] * axes * np.sqrt(np.clip(size, 0.0, None))
    root = np.linalg.cholesky(np.eye(len(P)) + L.T @ D @ L)
    A = np.linalg.solve(root, L.T)
    return A.T @ A


def _broken(rows: _Row) -> list[str]:
    """Why the recursion is not to be had, in words; empty where it is."""
    reasons = []
    if rows.beyond.any():
        reasons.append("the noise does not reach every direction in which the nonlinear dynamics act")
    if rows.Q_differs.any():
        reasons.append("Q differs from truth to truth")
    reasons += [f"R of sensor {name!r} differs from truth to truth" for name, r in rows.R_differs.items() if r.any()]
    reasons += [f"R of sensor {name!r} is singular" for name, r in rows.R_singular.items() if r.any()]
    if reasons:
        reasons[-1] += ", so each truth is linearised by itself, which will do for small errors"
    return reasons


def _spaces(robot: Model, log: Log) -> list[Space]:
    return [robot.space, *[robot.sensors[name].space for name in log.z]]


def _finite(name: str, a: np.ndarray) -> None:
    bad = ~np.isfinite(a).all((1, 2))
    if bad.any():
        k = int(np.argmax(bad))
        raise ValueError(f"{name}: expected finite numbers, got none from row {k}: do f, Q, h and R hold out there?")
