"""Linear models in one line."""

from __future__ import annotations

from collections.abc import Mapping

from jaxfilt import doors
from jaxfilt.noise import const
from jaxfilt.spaces import vector
from jaxfilt.types import Array, Model, Sensor


def linear(
    A: Array,
    H: Array | Mapping[str, Array],
    Q: Array,
    R: Array | Mapping[str, Array],
    B: Array | None = None,
) -> Model:
    """A discrete linear model: ``x' = A x + B u + w``, ``z = H x + v``, ``w ~ N(0, Q)``, ``v ~ N(0, R)``.

    A row with ``dt > 0`` is one step, however long; one with ``dt = 0`` predicts nothing.

    Args:
        A: (n, n) transition matrix.
        H: (m, n) measurement matrix of the sensor "z", or a dict sensor -> matrix.
        Q: (n, n) process noise covariance per step.
        R: (m, m) measurement noise covariance, or a dict sensor -> matrix.
        B: (n, k) input matrix, default none.

    Raises:
        ValueError: shapes that do not fit, or a covariance that is none.

    Example: constant velocity, position measured.
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> A = jnp.array([[1.0, 0.1], [0.0, 1.0]])
        >>> model = jf.linear(A, H=jnp.array([[1.0, 0.0]]), Q=0.01 * jnp.eye(2), R=jnp.array([[0.5]]))
        >>> model.space.dim, list(model.sensors)
        (2, ['z'])
    """
    doors.matrix("A", A)
    n = A.shape[-1]
    if A.shape != (n, n):
        raise ValueError(f"A: expected a square matrix, got shape {A.shape}")
    if B is not None:
        doors.matrix("B", B)
        if B.shape[0] != n:
            raise ValueError(f"B: expected shape ({n}, k), got {B.shape}")
    Hs = dict(H) if isinstance(H, Mapping) else {"z": H}
    Rs = dict(R) if isinstance(R, Mapping) else {"z": R}
    if list(Hs) != list(Rs):
        raise ValueError(f"R: expected the sensors of H, {list(Hs)}, got {list(Rs)}")
    doors.covariance("Q", Q, n)
    sensors = {}
    for name, M in Hs.items():
        doors.matrix(f"H of sensor {name!r}", M)
        if M.shape[1] != n:
            raise ValueError(f"H of sensor {name!r}: expected shape (m, {n}), got {M.shape}")
        doors.covariance(f"R of sensor {name!r}", Rs[name], M.shape[0])
        sensors[name] = Sensor(lambda x, c, M=M: M @ x, const(Rs[name]), vector(M.shape[0]))
    if B is None:
        return Model(lambda x, u, dt: A @ x, const(Q), vector(n), sensors)
    return Model(lambda x, u, dt: A @ x + B @ u, const(Q), vector(n), sensors)
