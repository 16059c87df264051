"""Bodies that fall through the atmosphere, tracked by radar: straight down, and on reentry.

SI units; the publications use feet and kilometres. Parameters ``theta`` are natural logarithms, all of them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.elementary import bearing, norm
from jaxfilt.integrate import euler, rk4
from jaxfilt.log import schedule
from jaxfilt.models.parts import start
from jaxfilt.noise import const, diagonal, white
from jaxfilt.spaces import angle, product, scalar, vector
from jaxfilt.types import Array, Gaussian, Log, Model, PyTree, Scenario, Sensor

FOOT = 0.3048
"""m."""

SUBSTEPS = 2
"""Of Runge-Kutta within a step of `falling_body`, 0.5 s each: drag slows by at most 37 % a second, good to 0.1 m."""


class FallingBody(NamedTuple):
    """A body that falls straight down: the state of `falling_body`."""

    height: Array
    """() m, above the ground."""
    speed: Array
    """() m/s, downwards."""
    drag: Array
    """() 1/m: deceleration at the ground over the speed's square; the publication's ballistic parameter."""


RADAR_HEIGHT = 100_000 * FOOT
"""m, above the ground: where the radar of `falling_body` stands."""

RADAR_DISTANCE = 100_000 * FOOT
"""m, horizontally from the body's path to the radar of `falling_body`."""

DENSITY_HEIGHT = 20_000 * FOOT
"""m: over which the air of `falling_body` thins by e; the publication's 1 / gamma, gamma = 5e-5 /ft."""

KNOWN_BODY = {
    "range": math.log(100 * FOOT),  # m: variance 1e4 ft^2
    "drag": math.log(1e-3 / FOOT),  # 1/m: expected at the start
    # m, m/s: variances 1e6 ft^2 and 4e6 ft^2/s^2; 1/m: chosen, 20 %, so that no truth drawn from it has negative drag
    "start": (math.log(1000 * FOOT), math.log(2000 * FOOT), math.log(2e-4 / FOOT)),
}
"""``theta`` of `falling_body`: the drag known to 20 %. Otherwise after Julier, Uhlmann, Durrant-Whyte (2000)."""

UNKNOWN_BODY = KNOWN_BODY | {
    "drag": math.log(3e-5 / FOOT),
    "start": (*KNOWN_BODY["start"][:2], math.log(1e-2 / FOOT)),  # variance 1e-4 /ft^2
}
"""What the publication's filters believe of the drag, while the truth starts at the mean of `KNOWN_BODY`."""


def falling_body(theta: PyTree = KNOWN_BODY) -> Model:
    """A body falls at high speed into denser air: ``h' = -v``, ``v' = -exp(-h / H) v^2 drag``, drag constant.

    A radar beside its path measures the range ``sqrt(M^2 + (h - h_radar)^2)``, sensor "range". Where the body passes
    the radar's height the range says nothing of the height, and the drag is strongest soon after. No gravity, no
    process noise, as published. Integrated by Runge-Kutta.

    Args:
        theta: logarithms of the standard deviation range (m) and of what `falling_body_start` needs. See `KNOWN_BODY`.

    Returns:
        A model on `FallingBody` (3 dimensions), no input, with sensor "range" (() m).

    Example: high up it falls freely.
        >>> import jax.numpy as jnp
        >>> x = falling_body().f(FallingBody(*map(jnp.asarray, (90e3, 6e3, 3e-3))), (), 0.1)
        >>> round(float(x.height)), round(float(x.speed))
        (89400, 6000)

    Source: Athans, Wishner, Bertolini, Suboptimal state estimation for continuous-time nonlinear systems from discrete
    noisy measurements (1968); numbers from Julier, Uhlmann, Durrant-Whyte, A new method for the nonlinear
    transformation of means and covariances in filters and estimators (2000).
    """
    std = jax.tree.map(jnp.exp, theta)
    space = product(FallingBody(scalar, scalar, scalar))

    def rate(x: FallingBody, u: PyTree) -> FallingBody:
        deceleration = jnp.exp(-x.height / DENSITY_HEIGHT) * x.speed * x.speed * x.drag
        return FallingBody(-x.speed, -deceleration, jnp.zeros_like(x.drag))

    def Q(x: FallingBody, u: PyTree, dt: Array) -> Array:
        return jnp.zeros((3, 3), x.drag.dtype)

    def seen(x: FallingBody, c: PyTree) -> Array:
        return jnp.hypot(RADAR_DISTANCE, x.height - RADAR_HEIGHT)

    return Model(rk4(rate, space, SUBSTEPS), Q, space, {"range": Sensor(seen, const(diagonal(std["range"])), scalar)})


def falling_body_start(theta: PyTree = KNOWN_BODY) -> Gaussian:
    """300,000 ft up, 20,000 ft/s down, the drag ``theta["drag"]``; with ``theta["start"]`` in m, m/s, 1/m."""
    stds = map(jnp.exp, theta["start"])
    return start(FallingBody(300_000 * FOOT, 20_000 * FOOT, jnp.exp(theta["drag"])), *stds)


def falling_body_scenario() -> Scenario:
    """A body falls from 90 km at 6 km/s past a radar that reads its range each second (``--steps 60``: the whole fall).

    The publication's own case, where the drag is unknown, is `UNKNOWN_BODY` against a truth at the mean of
    `KNOWN_BODY`: it shows in figures, whose levels could not be checked, that the EKF is biased and the UKF is not.
    """
    blocks = {"height": ((0,), "m"), "speed": ((1,), "m/s"), "drag": ((2,), "1/m")}

    def fall(steps: int) -> Log:
        return schedule(falling_body(), steps, 1.0)

    return Scenario(falling_body, falling_body_start, KNOWN_BODY, fall, blocks)


class Reentry(NamedTuple):
    """A vehicle that comes back from space, in the plane of its path: the state of `reentry`."""

    pos: Array
    """(2,) m, from the radar: up, along the ground."""
    vel: Array
    """(2,) m/s."""
    drag: Array
    """() natural logarithm of its drag over that of a typical vehicle."""


EARTH_RADIUS = 6374e3
"""m: of the radar of `reentry` from the centre of the earth."""

GRAVITATION = 3.9860e14
"""m^3/s^2: of the earth, times its mass."""

REENTRY_DENSITY_HEIGHT = 13.406e3
"""m: over which the air of `reentry` thins by e."""

TYPICAL_DRAG = 0.59783e-3
"""1/m: deceleration at the ground over the speed's square, of a typical vehicle of `reentry`."""

REENTRY = {
    "buffet": 0.5 * math.log(2.4064e-5 * 1e6 / 0.1),  # (m/s)/sqrt(s): 2.4064e-5 km^2/s^2 in each 0.1 s
    "drag_walk": 0.5 * math.log(1e-6 / 0.1),  # 1/sqrt(s): 1e-6 in each 0.1 s
    "radar": (math.log(1.0), math.log(0.17e-3)),  # m, rad
    "drag": 0.0,  # of the drag expected at the start, over the typical
    "start": (*4 * (math.log(1.0),), 0.0),  # m, m/s: variances 1e-6 km^2 and km^2/s^2; 1
}
"""What a filter believes of a vehicle that it does not know: ``theta`` of `reentry`."""

HEAVY_REENTRY = REENTRY | {"drag_walk": -math.inf, "drag": 0.6932, "start": (*4 * (math.log(1.0),), -math.inf)}
"""The publication's truth: twice the typical drag in each run, and constant; its filters believe in `REENTRY`."""


def reentry(theta: PyTree = REENTRY) -> Model:
    """Reentry vehicle: gravity, drag in thinner or denser air, buffeting; range and bearing from a radar.

    ``vel' = -b exp(drag) exp(-h / H) |vel| vel - G r / |r|^3 + w`` with r from the centre of the earth and ``h = |r| -
    |r_radar|``, by Euler's step, which is the publication's model; dt = 0.1 s. Positions are from the radar and not
    from the centre of the earth, where float32 would resolve half a metre.

    Args:
        theta: logarithms of the noise densities buffet ((m/s)/sqrt(s)), drag_walk (1/sqrt(s)), of the standard
            deviations radar (m, rad), and of what `reentry_start` needs. See `REENTRY`.

    Returns:
        A model on `Reentry` (5 dimensions), no input, with sensor "radar" (range m, bearing rad from straight up).

    Example: a stone let go 1 km up, at a typical drag.
        >>> import jax.numpy as jnp
        >>> x = reentry().f(Reentry(jnp.array([1000.0, 0.0]), jnp.zeros(2), jnp.asarray(0.0)), (), 0.1)
        >>> [round(float(v), 3) + 0.0 for v in x.vel]
        [-0.981, 0.0]

    Source: Julier, Uhlmann, Unscented filtering and nonlinear estimation (2004), with their corrections of the same
    year; discrete as in Hartikainen, Solin, Sarkka, manual of the EKF/UKF toolbox 1.3 (2011).
    """
    std = jax.tree.map(jnp.exp, theta)
    space = product(Reentry(vector(2), vector(2), scalar))

    def rate(x: Reentry, u: PyTree) -> Reentry:
        up, along = x.pos[0], x.pos[1]
        from_centre = jnp.stack([up + EARTH_RADIUS, along])
        distance = norm(from_centre)
        # distance - EARTH_RADIUS, without the difference of two large numbers
        height = (2 * EARTH_RADIUS * up + x.pos @ x.pos) / (distance + EARTH_RADIUS)
        drag = TYPICAL_DRAG * jnp.exp(x.drag - height / REENTRY_DENSITY_HEIGHT) * norm(x.vel)
        gravity = GRAVITATION / distance**2 / distance
        return Reentry(x.vel, -drag * x.vel - gravity * from_centre, jnp.zeros_like(x.drag))

    still = jnp.zeros_like(std["buffet"])
    density = diagonal(still, still, std["buffet"], std["buffet"], std["drag_walk"])
    radar = Sensor(lambda x, c: (norm(x.pos), bearing(x.pos)), const(diagonal(*std["radar"])), product((scalar, angle)))
    return Model(euler(rate, space), white(density), space, {"radar": radar})


def reentry_start(theta: PyTree = REENTRY) -> Gaussian:
    """126 km above and 349 km beside the radar at 7 km/s, of drag ``theta["drag"]``; ``theta["start"]`` m, m/s, 1."""
    pos, vel = np.array([6500.4e3 - EARTH_RADIUS, 349.14e3]), np.array([-1809.3, -6796.7])
    return start(Reentry(pos, vel, theta["drag"]), *map(jnp.exp, theta["start"]))


def reentry_scenario() -> Scenario:
    """A vehicle comes back from space, its drag known to a factor e, radar at 10 Hz (``--steps 2000``: the whole fall).

    The model knows no ground: of the truths drawn here, some with little drag are below it by then.

    Published with the truth `HEAVY_REENTRY`, 100 runs x 2,000 steps: the position's RMSE of EKF, UKF, CKF and
    Gauss-Hermite alike is 0.0084 km (Hartikainen, Solin, Sarkka, manual of the EKF/UKF toolbox 1.3 (2011), the table
    of the reentry demonstration).
    """
    blocks = {"position": ((0, 1), "m"), "velocity": ((2, 3), "m/s"), "drag": ((4,), "1")}

    def fall(steps: int) -> Log:
        return schedule(reentry(), steps, 0.1)

    return Scenario(reentry, reentry_start, REENTRY, fall, blocks)
