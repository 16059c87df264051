"""The lectures' simplest baselines, with the interface of a filter: the moving average, and the mean of two sensors."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp

from jaxfilt import doors
from jaxfilt.correction import nothing
from jaxfilt.prediction import advanced, branch, canonical, interval, kalman
from jaxfilt.types import Array, Filter, Gaussian, Info, Model, PyTree, Status
from jaxfilt.weighing import first_fault, seen


def moving_average(model: Model, alpha: float | Mapping[str, float]) -> Filter:
    """Moving average: ``x = alpha x + (1 - alpha) z``, of whatever a sensor reads, and nothing moves in between.

    For states that are read as they are: h must be a projection, as ``x.pos`` is. What the sensor does not see stays as
    it is. At a steady rate 1/dt its latency is ``alpha / (1 - alpha) dt``: that is the
    time by which it comes after a ramp. f, Q and R are not used, and there is no covariance: see `averaging`.

    Args:
        model: whose sensors read parts of the state.
        alpha: how much of the old stays, 0 to 1 (excluded), for all sensors or by name: the others are not heard.

    Returns:
        Filter(predict, update, step, model, begin, gaussian). Info has the innovation, and S, nis, loglik and dof 0.

    Raises:
        KeyError: a sensor that the model lacks.
        ValueError: an alpha that is not 0 to 1.

    Example:
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> one = jnp.eye(1)
        >>> volts = moving_average(jf.linear(one, one, one, one), alpha=0.75)
        >>> belief, _ = volts.update(jf.Gaussian(jnp.array([8.0]), one), jnp.array([12.0]), "z")
        >>> belief.mean.tolist()
        [9.0]

    Source: R. G. Brown, Statistical Forecasting for Inventory Control (1959): exponential smoothing.
    """
    return _averaged(model, alpha, still=True)


def averaging(model: Model, alpha: float | Mapping[str, float] = 0.5) -> Filter:
    """The lecture's mean of two sensors: ``x = alpha f(x, u, dt) + (1 - alpha) z``, for example of the position that
    integrated accelerations say and of that which GPS says.

    The baseline that fusion must beat: its weights are fixed, and what no sensor reads, the velocity, is never
    corrected, so its error grows without bound.

    It has no covariance: that of its belief is 0 from the first step on. Means of NEES and NIS are NaN; a study or a
    replay scores its errors and otherwise finds nothing to judge by.

    Args, returns, raises: as of `moving_average`, but f moves the state between the readings.

    Example: GPS says 4 m, dead reckoning 2 m.
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> A, H = jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.array([[1.0, 0.0]])
        >>> both = averaging(jf.linear(A, H, jnp.eye(2), jnp.eye(1)))
        >>> belief = both.predict(jf.Gaussian(jnp.array([1.0, 1.0]), jnp.eye(2)), (), 1.0)
        >>> both.update(belief, jnp.array([4.0]), "z")[0].mean.tolist()
        [3.0, 1.0]
    """
    return _averaged(model, alpha, still=False)


def _averaged(model: Model, alpha: float | Mapping[str, float], still: bool) -> Filter:
    doors.instance("model", model, Model)
    shares = dict(alpha) if isinstance(alpha, Mapping) else dict.fromkeys(model.sensors, alpha)
    for name, share in shares.items():
        doors.sensor(model, name)
        if doors.is_concrete(share) and not 0 <= float(share) < 1:
            raise ValueError(f"alpha[{name!r}]: expected 0 <= alpha < 1, got {share}")

    def predict(belief: Gaussian, u: PyTree = (), dt: Array | float = 0.0) -> Gaussian:
        belief = _without_covariance(belief, model)
        doors.inputs("u", u, belief.cov.dtype)
        moves, dt = interval(dt, belief)
        if still:
            return belief

        def on(b: Gaussian) -> Gaussian:
            return b._replace(mean=advanced(model, b.mean, u, dt, b.cov.dtype))

        return branch(moves, on, lambda b: b, belief)

    def update(
        belief: Gaussian, z: PyTree, sensor: str, c: PyTree = (), mask: Array | None = None
    ) -> tuple[Gaussian, Info]:
        belief = _without_covariance(belief, model)
        found, dtype, n = doors.sensor(model, sensor), belief.cov.dtype, model.space.dim
        silent = nothing(found.space.dim, dtype)
        if sensor not in shares:
            return belief, silent
        doors.point(f"z[{sensor!r}]", z, found.space)
        doors.finite(f"z[{sensor!r}]", z)
        doors.same_dtype(dtype, **{f"z[{sensor!r}]": z})
        expected = doors.call(f"h(x, c) of sensor {sensor!r}", found.h, x=belief.mean, c=c)
        r = found.space.minus(z, expected)
        if mask is not None:
            doors.mask(f"mask of {sensor!r}", mask, (found.space.dim,))
            r, _ = seen(r, jnp.eye(len(r), dtype=dtype), jnp.asarray(mask))
        # The rows of a projection are orthonormal: its transpose takes a reading back to where it belongs.
        H = jax.jacfwd(lambda d: found.space.minus(found.h(model.space.plus(belief.mean, d), c), expected))(
            jnp.zeros(n, dtype)
        )
        moved = model.space.plus(belief.mean, (1 - jnp.asarray(shares[sensor], dtype)) * (H.T @ r))
        status = first_fault(
            (jax.tree.map(jnp.isfinite, belief.mean), Status.BAD_BELIEF),
            (jax.tree.map(jnp.isfinite, z), Status.BAD_MEASUREMENT),
            (jax.tree.map(jnp.isfinite, expected), Status.BAD_PREDICTION),
            (jax.tree.map(jnp.isfinite, moved), Status.BAD_POSTERIOR),
        )
        return belief._replace(mean=moved), silent._replace(innovation=r, status=status)

    return kalman(model, predict, update, None)


def _without_covariance(belief: Gaussian, model: Model) -> Gaussian:
    belief = canonical(belief, model.space)
    return belief._replace(cov=jnp.zeros_like(belief.cov))
