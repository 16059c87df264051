"""The car of ``scenario("car")`` in the peers of `benchmarks.studies`: a loop in filterpy, and dynamax.

The state is a vector (4,): x, y (m), yaw (rad), speed (m/s); yaw is an ordinary number here, which it may be as long as
the drive stays within a turn. A peer is imported where it is called.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.models.car import CITY_CAR, DT
from jaxfilt.types import Array

SPREAD = {"alpha": 1.0, "beta": 2.0, "kappa": 0.0}
"""Of the sigma points, the same for all; jaxfilt's default."""

UNSEEN = 1e9
"""m^2: the variance that stands for "no reading" where a filter must be given one in every row."""

SEEN = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
"""h of GNSS and odometer together: x, y, speed. The odometer alone is the last row."""


class Runs(NamedTuple):
    """Simulated runs: ``truth`` (N, T, 4), ``u`` (N, T, 2) acceleration and steering, ``gnss`` (N, T, 2), ``odometer``
    (N, T)."""

    truth: Array
    u: Array
    gnss: Array
    odometer: Array


class Car(NamedTuple):
    """The numbers of the car: wheel base (m), Q per step, R of GNSS and odometer together, mean, cov of the start."""

    wheel_base: float
    Q: np.ndarray
    R: np.ndarray
    mean: np.ndarray
    cov: np.ndarray


def car() -> Car:
    """Those of `CITY_CAR`, in float64."""
    std: dict[str, Any] = {name: np.exp(np.asarray(value, float)) for name, value in CITY_CAR.items()}
    Q = DT * np.diag([std["slip"], std["slip"], std["turn"], std["speed"]]) ** 2
    R = np.diag([std["gnss"], std["gnss"], std["odometer"]]) ** 2
    return Car(float(std["wheel_base"]), Q, R, np.array([0.0, 0.0, 0.0, 10.0]), np.diag(std["start"]) ** 2)


def moved(x: Any, u: Any, wheel_base: float, xp: Any, sinc: Callable) -> tuple:
    """The bicycle's f with ``xp`` = `math` or `jax.numpy`: the chord of an arc, as in `jaxfilt.models.parts.arc`."""
    length = (x[3] + 0.5 * u[0] * DT) * DT
    turn = length * xp.tan(u[1]) / wheel_base
    middle, chord = x[2] + 0.5 * turn, length * sinc(0.5 * turn)
    return x[0] + chord * xp.cos(middle), x[1] + chord * xp.sin(middle), x[2] + turn, x[3] + u[0] * DT


def jacobian(x: list[float], u: list[float], wheel_base: float) -> np.ndarray:
    """df/dx (4, 4) by hand: the chord is ``2 sin(length k / 2) / k``, k the curvature, so d chord = cos(turn/2) ds."""
    k = math.tan(u[1]) / wheel_base
    length = (x[3] + 0.5 * u[0] * DT) * DT
    half = 0.5 * length * k
    cos, sin, chord = math.cos(x[2] + half), math.sin(x[2] + half), length * _sinc(half)
    along, across = DT * math.cos(half), 0.5 * DT * k * chord
    return np.array(
        [
            [1.0, 0.0, -chord * sin, along * cos - across * sin],
            [0.0, 1.0, chord * cos, along * sin + across * cos],
            [0.0, 0.0, 1.0, DT * k],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _sinc(x: float) -> float:
    return math.sin(x) / x if x else 1.0


def filterpy(name: str, runs: Runs, gnss_reads: np.ndarray) -> np.ndarray:
    """Means (N, T, 4) by filterpy's "EKF" or "UKF": one run after the other, one step after the other."""
    kalman, numbers = importlib.import_module("filterpy.kalman"), car()
    odometer, R_odometer = SEEN[2:], numbers.R[2:, 2:]

    def f(x: np.ndarray, u: list[float]) -> np.ndarray:
        return np.array(moved(x.tolist(), u, numbers.wheel_base, math, _sinc))

    class Extended(kalman.ExtendedKalmanFilter):
        def predict_x(self, u: Any = 0) -> None:
            self.F = jacobian(self.x.tolist(), u, numbers.wheel_base)
            self.x = f(self.x, u)

    def extended() -> tuple[Any, Callable, Callable]:
        kf = Extended(4, 1)

        def update(gnss: np.ndarray | None, speed: np.ndarray) -> None:
            if gnss is None:
                kf.update(speed, lambda x: odometer, lambda x: odometer @ x, R=R_odometer)
            else:
                kf.update(np.append(gnss, speed), lambda x: SEEN, lambda x: SEEN @ x, R=numbers.R)

        return kf, kf.predict, update

    def unscented() -> tuple[Any, Callable, Callable]:
        points = kalman.MerweScaledSigmaPoints(4, **SPREAD)
        kf = kalman.UnscentedKalmanFilter(4, 1, DT, lambda x: x[3:], lambda x, dt, u: f(x, u), points)

        def update(gnss: np.ndarray | None, speed: np.ndarray) -> None:
            if gnss is None:
                kf.update(speed, R=R_odometer)
            else:
                kf.update(np.append(gnss, speed), R=numbers.R, hx=lambda x: SEEN @ x)

        return kf, lambda u: kf.predict(u=u), update

    means = np.empty(runs.truth.shape)
    for n in range(len(means)):
        kf, predict, update = {"EKF": extended, "UKF": unscented}[name]()
        kf.x, kf.P, kf.Q = numbers.mean.copy(), numbers.cov.copy(), numbers.Q
        for t, u in enumerate(runs.u[n].tolist()):
            predict(u)
            update(runs.gnss[n, t] if gnss_reads[t] else None, runs.odometer[n, t : t + 1])
            means[n, t] = kf.x
    return means


def dynamax(name: str, mean: jax.Array, cov: jax.Array, gnss_reads: np.ndarray) -> Callable[..., jax.Array]:
    """Function of one run's (u, gnss, odometer) that returns the means (T, 4) by dynamax's "EKF" or "UKF".

    Its filters start with an update: ``mean`` (4,) and ``cov`` (4, 4) are of the first prediction. They take a reading
    of all sensors in every row; where there is none of GNSS its variance is `UNSEEN`.
    """
    ssm, numbers = importlib.import_module("dynamax.nonlinear_gaussian_ssm"), car()
    R = np.repeat(numbers.R[None], len(gnss_reads), axis=0)
    R[~gnss_reads, :2, :2] = UNSEEN * np.eye(2)

    def f(x: jax.Array, u: jax.Array) -> jax.Array:
        return jnp.stack(moved(x, u, numbers.wheel_base, jnp, lambda a: jnp.sinc(a / math.pi)))

    def h(x: jax.Array, u: jax.Array) -> jax.Array:
        return jnp.stack([x[0], x[1], x[3]])

    Q, R = jnp.asarray(numbers.Q, cov.dtype), jnp.asarray(R, cov.dtype)
    params = ssm.ParamsNLGSSM(mean, cov, f, Q, h, R)
    options: dict[str, Any] = {"output_fields": ["filtered_means"]}
    if name == "UKF":
        options["hyperparams"] = ssm.UKFHyperParams(**SPREAD)
    run = {"EKF": ssm.extended_kalman_filter, "UKF": ssm.unscented_kalman_filter}[name]

    def means(u: jax.Array, gnss: jax.Array, odometer: jax.Array) -> jax.Array:
        z = jnp.concatenate([gnss, odometer[:, None]], axis=1)
        return run(params, z, inputs=u, **options).filtered_means

    return means
