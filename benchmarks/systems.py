"""The robots of the race, component by component, so that `math`, NumPy and JAX can each run them.

Convention, the same for all: ``(x0, P0)`` is the belief of a run before its first prediction. In each row the state
moves, ``x' = f(x, u) + w``, ``w ~ N(0, Q)``, and then some of its components are measured, ``z = x[seen] + v``,
``v ~ N(0, R)``. Start and covariance of the start differ by run, so that covariances must be computed for each of them
even where the model is linear; u, Q and R are common.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

GRAVITY = 9.81
"""m/s^2."""

INERTIA = (0.010, 0.012, 0.020)
"""kg m^2 of the quadrotor about its axes; its mass is 1 kg."""


class System(NamedTuple):
    """``f(x, u, xp)``: components of x and u -> those of the next x, with xp's sin and cos.

    ``jacobian(x, u, xp)``: (row, column) -> entry of ``df/dx - I`` that is not zero, derived by hand. ``linear``:
    these entries are numbers that depend on nothing. ``inputs(steps)`` (T, k).
    """

    name: str
    f: Callable[..., list]
    jacobian: Callable[..., dict[tuple[int, int], Any]]
    seen: tuple[int, ...]
    Q: np.ndarray
    R: np.ndarray
    x0: np.ndarray
    P0: np.ndarray
    inputs: Callable[[int], np.ndarray]
    linear: bool = False

    @property
    def n(self) -> int:
        """Dimension of the state."""
        return len(self.x0)

    @property
    def H(self) -> np.ndarray:
        """dz/dx (m, n)."""
        return np.eye(self.n)[list(self.seen)]


def transition(system: System, x: np.ndarray, u: Any, xp: Any = np) -> np.ndarray:
    """df/dx (..., n, n) at states (..., n)."""
    F = np.zeros((*x.shape, system.n), x.dtype)
    F[..., range(system.n), range(system.n)] = 1.0
    components = [x[..., i] for i in range(system.n)] if x.ndim > 1 else x.tolist()
    for (i, j), entry in system.jacobian(components, u, xp).items():
        F[..., i, j] += entry
    return F


def moved(system: System, x: np.ndarray, u: Any) -> np.ndarray:
    """f at states (..., n), in NumPy."""
    return np.stack(np.broadcast_arrays(*system.f([x[..., i] for i in range(system.n)], u, np)), axis=-1)


TRACK_DT, CAR_DT, QUAD_DT = 0.1, 0.02, 0.01


def _target() -> System:
    """A target at nearly constant velocity in the plane: x, vx, y, vy; its position is measured."""
    dt, density = TRACK_DT, 0.5
    block = density * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    spread = np.diag([4.0, 1.0, 4.0, 1.0])
    return System(
        "target",
        lambda x, u, xp: [x[0] + dt * x[1], x[1], x[2] + dt * x[3], x[3]],
        lambda x, u, xp: {(0, 1): dt, (2, 3): dt},
        (0, 2), np.kron(np.eye(2), block), 0.25 * np.eye(2), np.array([0.0, 1.0, 0.0, -1.0]), spread,
        lambda steps: np.zeros((steps, 1)), linear=True,
    )  # fmt: skip


def _car() -> System:
    """A car as a unicycle: x, y, heading, speed, turn rate; position and speed are measured."""
    dt = CAR_DT

    def f(x: Any, u: Any, xp: Any) -> list:
        px, py, heading, speed, rate = x
        way = dt * speed
        return [
            px + way * xp.cos(heading), py + way * xp.sin(heading), heading + dt * rate, speed + dt * u[0],
            rate + dt * u[1],
        ]  # fmt: skip

    def jacobian(x: Any, u: Any, xp: Any) -> dict[tuple[int, int], Any]:
        c, s = dt * xp.cos(x[2]), dt * xp.sin(x[2])
        return {(0, 2): -x[3] * s, (0, 3): c, (1, 2): x[3] * c, (1, 3): s, (2, 4): dt}

    def inputs(steps: int) -> np.ndarray:
        t = dt * np.arange(steps)
        return np.stack([0.8 * np.sin(0.9 * t), 0.15 * np.cos(0.7 * t)], axis=1)

    return System(
        "car", f, jacobian, (0, 1, 3), np.diag([1e-4, 1e-4, 1e-5, 1e-3, 1e-4]), np.diag([0.25, 0.25, 0.04]),
        np.array([0.0, 0.0, 0.3, 10.0, 0.05]), np.diag([1.0, 1.0, 0.05, 1.0, 0.02]), inputs,
    )  # fmt: skip


def _quadrotor() -> System:
    """A quadrotor with Euler angles: position, roll, pitch, yaw, velocity (body), rates (body); velocity is not seen.

    Source: R. Beard, Quadrotor dynamics and control (2008), eqs. 14-17, with an Euler step.
    """
    dt = QUAD_DT
    jx, jy, jz = INERTIA
    k0, k1, k2 = (jy - jz) / jx, (jz - jx) / jy, (jx - jy) / jz

    def rotation(x: Any, xp: Any) -> tuple:
        sf, cf, st, ct, sp, cp = (g(x[i]) for i in (3, 4, 5) for g in (xp.sin, xp.cos))
        rows = (
            (ct * cp, sf * st * cp - cf * sp, cf * st * cp + sf * sp),
            (ct * sp, sf * st * sp + cf * cp, cf * st * sp - sf * cp),
            (-st, sf * ct, cf * ct),
        )
        return (sf, cf, st, ct, sp, cp), rows

    def f(x: Any, u: Any, xp: Any) -> list:
        (sf, cf, st, ct, _, _), rows = rotation(x, xp)
        v, w = x[6:9], x[9:12]
        turn = sf * w[1] + cf * w[2]
        rates = [
            *(r[0] * v[0] + r[1] * v[1] + r[2] * v[2] for r in rows),
            w[0] + st / ct * turn,
            cf * w[1] - sf * w[2],
            turn / ct,
            w[2] * v[1] - w[1] * v[2] + GRAVITY * st,
            w[0] * v[2] - w[2] * v[0] - GRAVITY * sf * ct,
            w[1] * v[0] - w[0] * v[1] - GRAVITY * cf * ct + u[0],
            k0 * w[1] * w[2] + u[1] / jx,
            k1 * w[0] * w[2] + u[2] / jy,
            k2 * w[0] * w[1] + u[3] / jz,
        ]
        return [a + dt * rate for a, rate in zip(x, rates, strict=True)]

    def jacobian(x: Any, u: Any, xp: Any) -> dict[tuple[int, int], Any]:
        (sf, cf, st, ct, sp, cp), rows = rotation(x, xp)
        (_, r01, r02), (_, r11, r12), (_, r21, r22) = rows
        (v0, v1, v2), (w0, w1, w2) = x[6:9], x[9:12]
        vx, vy, vz = (r[0] * v0 + r[1] * v1 + r[2] * v2 for r in rows)
        turn, lean, tan = sf * w1 + cf * w2, cf * w1 - sf * w2, st / ct
        entries = {
            (0, 3): r02 * v1 - r01 * v2, (0, 4): cp * vz, (0, 5): -vy,
            (1, 3): r12 * v1 - r11 * v2, (1, 4): sp * vz, (1, 5): vx,
            (2, 3): r22 * v1 - r21 * v2, (2, 4): -ct * v0 - st * (sf * v1 + cf * v2),
            (3, 3): tan * lean, (3, 4): turn / (ct * ct), (3, 9): 1.0, (3, 10): tan * sf, (3, 11): tan * cf,
            (4, 3): -turn, (4, 10): cf, (4, 11): -sf,
            (5, 3): lean / ct, (5, 4): turn * tan / ct, (5, 10): sf / ct, (5, 11): cf / ct,
            (6, 4): GRAVITY * ct, (6, 7): w2, (6, 8): -w1, (6, 10): -v2, (6, 11): v1,
            (7, 3): -GRAVITY * r22, (7, 4): GRAVITY * sf * st, (7, 6): -w2, (7, 8): w0, (7, 9): v2, (7, 11): -v0,
            (8, 3): GRAVITY * r21, (8, 4): GRAVITY * cf * st, (8, 6): w1, (8, 7): -w0, (8, 9): -v1, (8, 10): v0,
            (9, 10): k0 * w2, (9, 11): k0 * w1,
            (10, 9): k1 * w2, (10, 11): k1 * w0,
            (11, 9): k2 * w1, (11, 10): k2 * w0,
        }  # fmt: skip
        entries |= {(i, 6 + j): rows[i][j] for i in range(3) for j in range(3)}
        return {where: dt * entry for where, entry in entries.items()}

    def inputs(steps: int) -> np.ndarray:
        t = 2 * math.pi * dt * np.arange(steps)
        thrust = GRAVITY * (1 + 0.05 * np.sin(0.5 * t))
        return np.stack([thrust, 1e-3 * np.cos(t), 1e-3 * np.cos(0.8 * t), 5e-4 * np.cos(0.6 * t)], axis=1)

    def each(position: float, angle: float, velocity: float, rate: float) -> np.ndarray:
        return np.diag(np.repeat([position, angle, velocity, rate], 3))

    return System(
        "quadrotor", f, jacobian, (0, 1, 2, 3, 4, 5, 9, 10, 11), each(1e-6, 1e-6, 1e-4, 1e-7),
        np.diag(np.repeat([1e-2, 2.5e-3, 2.5e-3], 3)), np.zeros(12), each(0.25, 2.5e-3, 0.04, 1e-4), inputs,
    )  # fmt: skip


SYSTEMS = {system.name: system for system in (_target(), _car(), _quadrotor())}
