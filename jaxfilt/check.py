"""A model's health at one point, in words: before the first run rather than after the first NaN."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors
from jaxfilt.types import Array, Model, PyTree, Sensor, Space


class Checkup(NamedTuple):
    """What `check` found: ``ok``, no fault; ``findings``, a sentence each, faults first; ``rank``, of observability."""

    ok: bool
    findings: tuple[str, ...]
    rank: int

    def __str__(self) -> str:
        return "\n".join(self.findings)


def check(
    model: Model, x: PyTree, u: PyTree = (), dt: Array | float = 0.1, c: Mapping[str, PyTree] | None = None
) -> Checkup:
    """Look a model over at one state: structure and shapes, finite values and Jacobians, noise, observability.

    Observability is of the model linearised at x with u held: the rank of ``[H; H A; ...; H A^(n-1)]``, with
    ``A = (F - I) / dt``, over all sensors together. A nonlinear model may be observable along a path though not at
    a point.

    Args:
        model: the robot and its sensors.
        x: the state to look at; not an equilibrium only, if you can: much is invisible to a robot at rest.
        u: an input.
        dt: s.
        c: sensor -> context of one reading.

    Returns:
        Checkup(ok, findings, rank): print it.

    Raises:
        ValueError, TypeError: x is no state of this model.

    Example: from a rate alone, no one knows where the robot is.
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> A = jnp.array([[1.0, 0.1], [0.0, 1.0]])
        >>> odometer = jf.linear(A, H=jnp.array([[0.0, 1.0]]), Q=0.01 * jnp.eye(2), R=jnp.eye(1))
        >>> print(jf.check(odometer, jnp.zeros(2)))
        observability: rank 1 of 2 at this x and u; not determined: x[0]
        f: Jacobian finite, 2 x 2
        Q: positive definite, the same for dt and dt/2 (a covariance per step)
        sensor 'z': h finite, Jacobian of rank 1 of 1; R positive definite

    Source: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), section 1.3.7.
    """
    doors.point("x", x, model.space)
    x = jax.tree.map(jnp.asarray, x)
    faults: list[str] = []
    notes: list[str] = []
    F = _jacobian("f", lambda y: model.f(y, u, dt), x, model.space, model.space, faults)
    if F is not None:
        notes.append(f"f: Jacobian finite, {model.space.dim} x {model.space.dim}")
    _check_process_noise(model, x, u, dt, faults, notes)
    rows = []
    for name, sensor in model.sensors.items():
        H = _check_sensor(name, sensor, model.space, x, (c or {}).get(name, ()), faults, notes)
        rows += [] if H is None else [H]
    rank = 0
    if F is not None and rows:
        rank, unseen = _observability(F, np.concatenate(rows), float(dt))
        verdict = f"observability: rank {rank} of {model.space.dim} at this x and u"
        if unseen is None:
            notes.append(verdict)
        else:
            named = ", ".join(n for n, seen in zip(tangent_names(model.space), unseen, strict=True) if seen)
            notes.insert(0, f"{verdict}; not determined: {named}")
    return Checkup(not faults, tuple(faults + notes), rank)


def _jacobian(
    name: str, g: Callable, x: PyTree, space_in: Space, space_out: Space, faults: list[str]
) -> np.ndarray | None:
    """The Jacobian in tangent spaces, or None and a fault where g does not give a finite one."""
    try:
        y = g(x)
        doors.point(name, y, space_out)
    except (TypeError, ValueError) as wrong:
        faults.append(f"{name}: {wrong}" if not str(wrong).startswith(name) else str(wrong))
        return None
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(y)):
        faults.append(f"{name}: returned {jax.tree.map(np.asarray, y)} at this x, expected finite numbers")
        return None
    origin = jnp.zeros(space_in.dim, jnp.result_type(*jax.tree.leaves(x)))
    local = jax.jacfwd(lambda d: space_out.minus(g(space_in.plus(x, d)), y))
    J = np.asarray(local(origin))
    if not np.isfinite(J).all():
        bad = [tangent_names(space_in)[j] for j in np.flatnonzero(~np.isfinite(J).all(axis=0))]
        faults.append(f"{name}: its derivative with respect to {', '.join(bad)} is not finite at this x")
        return None
    return J


def _check_process_noise(model: Model, x: PyTree, u: PyTree, dt: Array | float, faults: list, notes: list) -> None:
    try:
        Q, half = np.asarray(model.Q(x, u, dt)), np.asarray(model.Q(x, u, 0.5 * dt))
        doors.covariance("Q(x, u, dt)", Q, model.space.dim)
    except (TypeError, ValueError) as wrong:
        faults.append(str(wrong))
        return
    scaling = ", the same for dt and dt/2 (a covariance per step)" if np.array_equal(Q, half) else ""
    notes.append(f"Q: {_definiteness(Q)}{scaling}")


def _check_sensor(
    name: str, sensor: Sensor, space: Space, x: PyTree, c: PyTree, faults: list, notes: list
) -> np.ndarray | None:
    title = f"sensor {name!r}"
    H = _jacobian(f"{title}: h", lambda y: sensor.h(y, c), x, space, sensor.space, faults)
    try:
        R = np.asarray(sensor.R(x, c))
        doors.covariance(f"{title}: R", R, sensor.space.dim)
    except (TypeError, ValueError) as wrong:
        faults.append(str(wrong))
        return H
    if H is not None:
        rank = np.linalg.matrix_rank(H)
        notes.append(f"{title}: h finite, Jacobian of rank {rank} of {sensor.space.dim}; R {_definiteness(R)}")
    return H


def _definiteness(P: np.ndarray) -> str:
    std = np.sqrt(np.diag(P))
    if not (std > 0).all():
        return f"positive semidefinite, {int((std == 0).sum())} of {len(P)} variances zero"
    lowest = np.linalg.eigvalsh(P / np.outer(std, std))[0]
    return "positive definite" if lowest > len(P) * np.finfo(P.dtype).eps else "positive semidefinite, singular"


def _observability(F: np.ndarray, H: np.ndarray, dt: float) -> tuple[int, np.ndarray | None]:
    """The rank, and which tangent components have a share in what no sensor sees."""
    n = len(F)
    A = (F - np.eye(n)) / dt
    A = A / max(float(np.linalg.norm(A, 2)), float(np.finfo(F.dtype).tiny))
    H = H / np.maximum(np.linalg.norm(H, axis=1, keepdims=True), np.finfo(F.dtype).tiny)
    rows = [H]
    for _ in range(n - 1):
        rows.append(rows[-1] @ A)
    _, s, V = np.linalg.svd(np.concatenate(rows))
    # F carries rounding of eps / dt in A; what falls below it is no information.
    rank = int((s > s[0] * n * 10 * np.finfo(F.dtype).eps / min(dt, 1.0)).sum())
    return rank, None if rank == n else np.linalg.norm(V[rank:], axis=0) > 1e-3


def tangent_names(space: Space) -> list[str]:
    """A name for each component of the tangent vector, from the paths of the state's leaves: ``pos[0]``, ``yaw``."""
    probe = jax.tree.map(jnp.asarray, space.origin)
    paths = jax.tree_util.tree_flatten_with_path(space.origin)[0]
    moved = jax.jacfwd(lambda d: space.plus(probe, d))(jnp.zeros(space.dim))
    names = [""] * space.dim
    for (path, _), leaf in zip(paths, jax.tree.leaves(moved), strict=True):
        own = np.flatnonzero(np.abs(np.asarray(leaf)).reshape(-1, space.dim).sum(axis=0) > 0)
        title = ".".join(str(getattr(k, "name", getattr(k, "key", getattr(k, "idx", k)))) for k in path) or "x"
        for i, j in enumerate(own):
            names[j] = title if len(own) == 1 and np.ndim(leaf) == 1 else f"{title}[{i}]"
    return names
