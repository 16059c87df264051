"""How an inertial filter may begin without being told its attitude: about level, with the likeliest heading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.filters import ekf
from jaxfilt.models.attitude import attitude_spread
from jaxfilt.models.inertial import Navigation
from jaxfilt.noise import diagonal
from jaxfilt.run import scan_runs
from jaxfilt.types import Array, Gaussian, Info, Log, Model


def about(
    pos: Array, att: Array, stds: Sequence[Array], yaw_std: Array, extra: Mapping[str, Array] | None = None
) -> Gaussian:
    """A belief about a `Navigation`: tilted so and so, heading so and so, all errors independent, the rest zero.

    Tilt and heading err about axes of the *world*; the tangent's are those of the body, so the covariance is turned.

    Args:
        pos: (3,) m, world.
        att: (4,) quaternion, body to world.
        stds: position (m), velocity (m/s), tilt (rad), gyroscope bias (rad/s), accelerometer bias (m/s^2), each of all
            its axes.
        yaw_std: rad.
        extra: name -> (n,) standard deviations of extra states, which are zero.

    Example: upside down, the heading's error is still about the vertical.
        >>> import jax.numpy as jnp
        >>> start = about(jnp.zeros(3), jnp.array([0.0, 1.0, 0.0, 0.0]), jnp.array([1.0, 1.0, 0.5, 1.0, 1.0]), 2.0)
        >>> jnp.diagonal(start.cov)[6:9].round(3).tolist()
        [0.25, 0.25, 4.0]
    """
    p, v, tilt, bg, ba = (jnp.asarray(s) for s in stds)
    dtype = p.dtype
    pos, att = (jnp.asarray(a, dtype) for a in (pos, att))
    around = attitude_spread(att, tilt, jnp.asarray(yaw_std, dtype))
    more = {name: jnp.asarray(std, dtype) for name, std in sorted(extra.items())} if extra else {}
    parts = [diagonal(p, p, p, v, v, v), around, diagonal(bg, bg, bg, ba, ba, ba)]
    parts += [jnp.diag(std**2) for std in more.values()]
    none = jnp.zeros(3, dtype)
    mean = Navigation(pos, none, att, none, none, {name: 0 * std for name, std in more.items()} if more else ())
    return Gaussian(mean, jax.scipy.linalg.block_diag(*parts))


def most_likely(model: Model, beliefs: Sequence[Gaussian], log: Log) -> int:
    """Which of these starts explains the readings of a log best: the EKF's with the largest likelihood.

    Source: D. T. Magill, Optimal adaptive estimation of sampled stochastic processes, IEEE Trans. Automatic Control
    10(4) (1965): a bank of filters, of which we keep one.
    """
    starts = jax.tree.map(lambda *b: jnp.stack(b), *beliefs)

    def likelihoods(starts: Gaussian, log: Log) -> jax.Array:
        def explained(b: Gaussian, info: dict[str, Info]) -> Any:
            return sum(i.loglik for i in info.values())

        return scan_runs(ekf(model), starts, log, batched=(), store=explained, backend="xla").sum(1)

    return int(np.argmax(jax.jit(likelihoods)(starts, log)))
