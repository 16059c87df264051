"""Univariate nonstationary growth: one number, and the example on which Kalman filters fail."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.log import schedule
from jaxfilt.models.parts import start
from jaxfilt.noise import const, diagonal
from jaxfilt.spaces import scalar
from jaxfilt.types import Array, Gaussian, Log, Model, PyTree, Scenario, Sensor

GROWTH = {
    "growth": 0.5 * math.log(10.0),  # variance 10 per step: Gordon, Salmond, Smith (1993), section 4
    "reading": 0.0,  # variance 1: likewise
    "start": 0.5 * math.log(10.0),  # chosen, as large as the noise of a step
}
"""``theta`` of `growth`, without units."""

CALM_GROWTH = GROWTH | {"growth": 0.0, "start": 0.0}
"""``theta`` of `growth` with variances 1 throughout: Kotecha, Djuric (2003) and the table of `growth_scenario`."""


def growth(theta: PyTree = GROWTH) -> Model:
    """Univariate nonstationary growth model: ``x' = x/2 + 25 x / (1 + x^2) + 8 u``, ``z = x^2 / 20 + v``, sensor "z".

    The input is ``u = cos(1.2 (k - 1))`` in step k = 1, 2, ..., whatever dt. The reading does not know the sign of x,
    the densities have two peaks, and no Gaussian fits.

    Args:
        theta: logarithms of the standard deviations growth (per step) and reading. See `GROWTH`.

    Returns:
        A model on `jaxfilt.scalar` with input () and sensor "z" ().

    Example:
        >>> import jax.numpy as jnp
        >>> float(growth().f(jnp.asarray(2.0), jnp.asarray(1.0), 1.0))
        19.0

    Source: Gordon, Salmond, Smith, Novel approach to nonlinear/non-Gaussian Bayesian state estimation (1993), section
    4; first in Netto, Gimeno, Mendes (1978) and Kitagawa (1987).
    """
    std = jax.tree.map(jnp.exp, theta)

    def f(x: Array, u: Array, dt: Array) -> Array:
        return 0.5 * x + 25 * x / (1 + x * x) + 8 * u

    reading = Sensor(lambda x, c: x * x / 20, const(diagonal(std["reading"])), scalar)
    return Model(f, const(diagonal(std["growth"])), scalar, {"z": reading})


def growth_start(theta: PyTree = GROWTH) -> Gaussian:
    """0.1, as in Gordon et al., with the standard deviation ``theta["start"]``."""
    return start(0.1, jnp.exp(theta["start"]))


def growth_scenario() -> Scenario:
    """A number that jumps between two wells, its square read each step. Harsh: no Kalman filter can follow it.

    The EKF is far too sure of itself, the UKF's guess little better than none.

    Published with `CALM_GROWTH`, 100 runs x 500 steps: mean squared error of EKF 125.9, UKF 87.9 (alpha = 0.5,
    beta = 2, kappa = 2, that toolbox's defaults), CKF 72.3, Gauss-Hermite of 10 points 40.9, and of a particle filter
    10.2: Hartikainen, Solin, Sarkka, Optimal Filtering with Kalman Filters and Smoothers, manual of the EKF/UKF toolbox
    1.3 (2011), the table of the UNGM demonstration. The tests meet all five.
    """

    def grow(steps: int) -> Log:
        return schedule(growth(), steps, 1.0, u=np.cos(1.2 * np.arange(steps)))

    return Scenario(growth, growth_start, GROWTH, grow, {"x": ((0,), "1")})
