"""The Kalman family: one predict and one update over any transform.

``predict``  m = transform(f);  belief' = (m.mean, m.cov + Q)
``update``   m = transform(h);  S = m.cov + R;  r = z - m.mean;  K = m.cross S^-1;
belief' = (mean + K r,  m.remainder(K) + K R K')

The last line is Joseph's form: valid for any K and positive semidefinite by construction. + and - are those of the
model's spaces. Filters are predict-first: a row predicts over its ``dt``, then updates; ``dt = 0`` makes it
update-first.
"""

from __future__ import annotations

from collections.abc import Callable

import jax

from jaxfilt import doors
from jaxfilt.correction import Gate, Recipe, correct_belief, thresholds_of
from jaxfilt.prediction import canonical, kalman, predictor, transitioner
from jaxfilt.transforms import Transform, cubature, taylor, taylor_at, unscented
from jaxfilt.types import Array, Filter, Gaussian, Info, Model, PyTree


def kf(model: Model, gate: Gate = None, robust: Gate = None) -> Filter:
    """Kalman filter: the `ekf`, which is exact on a linear model. `jaxfilt.linear` makes one.

    Source: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), table 5.2.4-1.
    """
    return build(taylor, model, gate, robust)


def ekf(model: Model, gate: Gate = None, robust: Gate = None) -> Filter:
    """Extended Kalman filter, Jacobians by automatic differentiation; on manifolds the error-state filter.

    Args:
        model: the robot and its sensors.
        gate: probability with which a true reading passes, e.g. 0.999, for all sensors or by name; None: no gate.
        robust: probability with which a true reading counts in full, e.g. 0.95, for all sensors or by name; None: 1.
            Beyond that quantile of its NIS a reading is weakened, by Huber's weight ``w = sqrt(quantile / nis)``: gain
            ``w K``, covariance as if S were ``S / w``, so that no outlier, however far, moves the belief by more than
            the quantile's root in its own standard deviations; ``loglik`` is minus Huber's loss, and ``ratio`` nis
            over the quantile. Where both are given, a gate refuses what is further off still, and ``ratio`` is its.

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

    Source: S. Sarkka, Bayesian Filtering and Smoothing (2013), algorithm 5.4; robust: C. J. Masreliez, R. D. Martin,
    Robust Bayesian estimation for the linear model and robustifying the Kalman filter (1977), with the psi of P. J.
    Huber, Robust Statistics (1981), eq. 7.3.
    """
    return build(taylor, model, gate, robust)


def iekf(model: Model, iterations: int = 4, gate: Gate = None, robust: Gate = None) -> Filter:
    """Iterated extended Kalman filter: the update relinearises about its own result, a Gauss-Newton search.

    ``d <- K_i (z - h(x_i) - H_i (mean - x_i))`` with ``x_i = mean + d``; prior and measurement count once, however
    many iterations. Info (innovation, S, nis, likelihood) is that of the prediction, before any iteration.

    Args:
        model: the robot and its sensors.
        iterations: linearisations in all, >= 1; 1 is the `ekf`.
        gate, robust: as in `ekf`.

    Source: Bell, Cathey, The iterated Kalman filter update as a Gauss-Newton method (1993), eqs. 3 and 9.
    """
    if iterations < 1:
        raise ValueError(f"iekf(iterations): expected at least 1, got {iterations}")
    return build(taylor, model, gate, robust, relinearise=taylor_at, iterations=iterations)


def ukf(
    model: Model,
    alpha: float = 1.0,
    beta: float = 2.0,
    kappa: float = 0.0,
    gate: Gate = None,
    robust: Gate = None,
) -> Filter:
    """Unscented Kalman filter, additive noise, fresh sigma points before the prediction and before each update.

    Args:
        model: the robot and its sensors.
        alpha, beta, kappa: the spread and weights of the sigma points, see `unscented`.
        gate, robust: as in `ekf`.

    Source: S. Sarkka, Bayesian Filtering and Smoothing (2013), algorithm 5.14.
    """
    return build(unscented(alpha, beta, kappa), model, gate, robust)


def ckf(model: Model, gate: Gate = None, robust: Gate = None) -> Filter:
    """Cubature Kalman filter. Source: Arasaratnam, Haykin, Cubature Kalman filters (2009), appendix A."""
    return build(cubature, model, gate, robust)


def build(
    transform: Transform,
    model: Model,
    gate: Gate = None,
    robust: Gate = None,
    relinearise: Callable[[jax.Array], Transform] | None = None,
    iterations: int = 1,
) -> Filter:
    """A filter from any transform: the way to a filter of your own.

    Args:
        transform: how a Gaussian passes through f and h, see `jaxfilt.transforms`.
        model: the robot and its sensors.
        gate, robust: as in `ekf`.
        relinearise: offset (n,) -> transform about ``mean + offset``, for updates with more than one iteration.
        iterations: linearisations per update.
    """
    doors.instance("model", model, Model)
    if not model.sensors:
        raise ValueError("model.sensors: expected at least one sensor, got none")
    gates, limits = thresholds_of("gate", model, gate), thresholds_of("robust", model, robust)
    recipe = Recipe(transform, relinearise or (lambda _: transform), iterations, gates, limits)

    predict = predictor(transform, model)

    def update(
        belief: Gaussian, z: PyTree, sensor: str, c: PyTree = (), mask: Array | None = None
    ) -> tuple[Gaussian, Info]:
        belief = canonical(belief, model.space)
        found = doors.sensor(model, sensor)
        doors.point(f"z[{sensor!r}]", z, found.space)
        doors.finite(f"z[{sensor!r}]", z)
        doors.same_dtype(belief.cov.dtype, **{f"z[{sensor!r}]": z})
        return correct_belief(recipe, model, sensor, belief, z, c, mask)

    return kalman(model, predict, update, transitioner(transform, model))
