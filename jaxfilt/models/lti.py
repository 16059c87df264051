"""Two linear systems that show what a filter can see: an unmeasured velocity, and a hidden bias.

Discrete matrices for steps of `DT`, as the lectures give them. Parameters ``theta`` are natural logarithms of standard
deviations, the process noise per step; the lectures leave the noises open.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.log import schedule
from jaxfilt.models.linear import linear
from jaxfilt.models.parts import start
from jaxfilt.noise import diagonal
from jaxfilt.types import Gaussian, Log, Model, PyTree, Scenario

DT = 0.01
"""s, of both systems."""

LTI = {
    "process": (math.log(1e-3), math.log(1e-2)),  # m, m/s per step: chosen
    "position": math.log(0.05),  # m: chosen
    "velocity": math.log(0.1),  # m/s: chosen
    "start": (math.log(0.5), math.log(0.5)),  # m, m/s
}
"""``theta`` of `lti`."""


def lti(theta: PyTree = LTI) -> Model:
    """Linear time-invariant example: x = [r m, r_dot m/s], ``A = [[1, 0.01], [0, 0.99]]``, ``B = [0, 0.01]'``.

    The velocity loses 1 % a step and is driven by u. Two measurements of the lecture, of which a log uses one:
    "position", z = r, from which the velocity is estimated though nothing measures it; "both", z = [r_dot, r],
    ``H = [[0, 1], [1, 0]]``.

    Args:
        theta: logarithms of the standard deviations process (m, m/s per step), position (m), velocity (m/s). See `LTI`.

    Returns:
        A linear model on (2,) with input (1,) m/s^2.

    Example:
        >>> import jax.numpy as jnp
        >>> lti().f(jnp.array([1.0, 0.0]), jnp.array([100.0]), 0.01).tolist()
        [1.0, 1.0]
    """
    std = jax.tree.map(jnp.exp, theta)
    dtype = std["position"].dtype
    A, B = jnp.array([[1.0, 0.01], [0.0, 0.99]], dtype), jnp.array([[0.0], [0.01]], dtype)
    H = {"position": jnp.array([[1.0, 0.0]], dtype), "both": jnp.array([[0.0, 1.0], [1.0, 0.0]], dtype)}
    R = {"position": diagonal(std["position"]), "both": diagonal(std["velocity"], std["position"])}
    return linear(A, H, diagonal(*std["process"]), R, B)


def lti_start(theta: PyTree = LTI) -> Gaussian:
    """At rest at the origin, with the standard deviations ``theta["start"]`` (m, m/s)."""
    return start(np.zeros(2), *map(jnp.exp, theta["start"]))


def lti_scenario(sensor: str = "position") -> Scenario:
    """Pushed to and fro, with "position" or "both" measured in each step of 0.01 s."""

    def run(steps: int) -> Log:
        every = {name: int(name == sensor) for name in ("position", "both")}
        return schedule(lti(), steps, DT, every=every, u=_push(steps))

    return Scenario(lti, lti_start, LTI, run, {"position": ((0,), "m"), "velocity": ((1,), "m/s")})


def _push(steps: int) -> np.ndarray:
    return np.sin(2 * np.pi * DT * np.arange(steps) / 5)[:, None]


HIDDEN_BIAS = {
    "process": (math.log(1e-3), math.log(1e-2), math.log(1e-3), math.log(1e-2)),  # m, m/s, m/s, m/s per step: chosen
    "position": math.log(0.05),  # m: chosen
    "velocity": math.log(0.1),  # m/s: chosen
    "start": (math.log(0.5), math.log(0.5), math.log(0.5), math.log(0.5)),  # m, m/s, m/s, m/s
}
"""``theta`` of `hidden_bias`."""


def hidden_bias(theta: PyTree = HIDDEN_BIAS) -> Model:
    """A bias that nothing measures: x = [r m, r_dot m/s, b m/s, i m/s], ``r_dot' = b + i``, b constant, i decays.

    ``A = [[1, 0.01, 0, 0], [0, 0, 1, 1], [0, 0, 1, 0], [0, 0, 0, 0.99]]``, ``B = [0, 0, 0, 0.01]'``. The bias does
    not decay and i does, so it can be told from i: both are observable from r, and also from r_dot; from r_dot alone
    the position r is not (the rank of the observability matrix is 4 and 3).

    Args:
        theta: logarithms of the standard deviations process (m, m/s, m/s, m/s per step), position (m), velocity (m/s).
            See `HIDDEN_BIAS`.

    Returns:
        A linear model on (4,) with input (1,) m/s^2 and sensors "position" (r) and "velocity" (r_dot), of which a log
        may use either.

    Example: what the bias does in one step.
        >>> import jax.numpy as jnp
        >>> hidden_bias().f(jnp.array([0.0, 0.0, 0.5, 0.0]), jnp.array([0.0]), 0.01).tolist()
        [0.0, 0.5, 0.5, 0.0]
    """
    std = jax.tree.map(jnp.exp, theta)
    dtype = std["position"].dtype
    A = [[1.0, 0.01, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.99]]
    B = [[0.0], [0.0], [0.0], [0.01]]
    H = {"position": [[1.0, 0.0, 0.0, 0.0]], "velocity": [[0.0, 1.0, 0.0, 0.0]]}
    R = {name: diagonal(std[name]) for name in H}
    H = {name: jnp.array(rows, dtype) for name, rows in H.items()}
    return linear(jnp.array(A, dtype), H, diagonal(*std["process"]), R, jnp.array(B, dtype))


def hidden_bias_start(theta: PyTree = HIDDEN_BIAS) -> Gaussian:
    """All zero, with the standard deviations ``theta["start"]`` (m, m/s, m/s, m/s)."""
    return start(np.zeros(4), *map(jnp.exp, theta["start"]))


def hidden_bias_scenario(sensor: str = "position") -> Scenario:
    """Pushed to and fro against a hidden bias, with "position" or "velocity" measured in each step of 0.01 s."""

    def run(steps: int) -> Log:
        every = {name: int(name == sensor) for name in ("position", "velocity")}
        return schedule(hidden_bias(), steps, DT, every=every, u=_push(steps))

    blocks = {
        "position": ((0,), "m"),
        "velocity": ((1,), "m/s"),
        "bias": ((2,), "m/s"),
        "input": ((3,), "m/s"),
    }
    return Scenario(hidden_bias, hidden_bias_start, HIDDEN_BIAS, run, blocks)
