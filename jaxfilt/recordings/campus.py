"""A Segway on a campus, outdoors and indoors, with wheels, a magnetic compass and poor GPS."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.datasets import Dataset
from jaxfilt.elementary import wrap
from jaxfilt.log import align, merge
from jaxfilt.models.parts import rotated, start
from jaxfilt.noise import const, diagonal
from jaxfilt.spaces import angle, product, scalar, vector
from jaxfilt.types import Array, Gaussian, Model, PyTree, Replay, Sensor


class Segway(NamedTuple):
    """A robot with a magnetic compass, and GPS whose error wanders: the state of `segway`."""

    pos: Array
    """(2,) m, north and east."""
    offset: Array
    """() rad, error of the heading beyond the deviation of the compass."""
    scale: Array
    """() true over reported speed."""
    wander: Array
    """(2,) m, slow error of the GPS, north and east."""


class Wheels(NamedTuple):
    """The input of `segway`, held over the second that ends with the reading."""

    speed: Array
    """() m/s."""
    heading: Array
    """() rad, from north to east, as the compass has it."""


# The deviation and the scale: least squares against the truth of the calibration runs, 2013-01-10 and 2013-02-23. The
# noises: rounded geometric means of the 20 best of 200 drawn at random, by position RMSE on the same two runs. No
# number was chosen on 2013-04-05, the test, but its scores were in sight; that the compass deviates alike on all runs
# was seen on all three.
CAMPUS = {
    "deviation": (0.128, -0.051, 0.070, 0.025, 0.095),  # rad, no logarithms: 1, cos, sin, cos 2, sin 2 of the heading
    "walk": math.log(0.07),  # m/sqrt(s)
    "along": math.log(0.13),  # 1/sqrt(Hz), of the speed
    "across": math.log(0.13),  # 1/sqrt(Hz), of the speed
    "offset": math.log(0.045),  # rad
    "offset_time": math.log(35.0),  # s
    "drift": math.log(0.0007),  # 1/sqrt(s)
    "wander": math.log(3.3),  # m
    "wander_time": math.log(27.0),  # s
    "gps": math.log(5.2),  # m
    "start": (math.log(1.0), math.log(0.01)),  # m, of the scale
}
"""``theta`` of `segway`: natural logarithms, but for the deviation."""

CAMPUS_SCALE = 0.925
"""True over reported speed on the calibration runs."""


def segway(theta: PyTree) -> Model:
    """Dead reckoning by wheels and compass, with GPS whose error is partly white and partly wanders.

    ``pos' = pos + scale speed dt [cos, sin](heading - deviation(heading) - offset)``. ``offset`` and ``wander`` are
    first-order Gauss-Markov: ``b' = exp(-dt/T) b``, ``Q = s^2 (1 - exp(-2 dt/T))``. A compass deviates by the iron
    around it: ``deviation(h) = a + b cos h + c sin h + d cos 2h + e sin 2h``.

    Args:
        theta: ``deviation`` (5 numbers) rad; logarithms of walk (m/sqrt(s)), along, across (1/sqrt(Hz), of the speed),
            offset (rad), offset_time (s), drift (1/sqrt(s), of the scale), wander (m), wander_time (s), gps (m).

    Returns:
        A model on `Segway` (6 dimensions) with input `Wheels` and the sensor "gps", (2,) m.

    Source: correlated noise by a shaping filter: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking
    and Navigation (2001), section 8.2; deviation: Handbook of Magnetic Compass Adjustment (NGA, 2004), chapter II.
    """
    std = {name: jnp.exp(value) for name, value in theta.items() if name not in ("deviation", "start")}

    def yaw(x: Segway, u: Wheels) -> Array:
        h, (a, b, c, d, e) = u.heading, theta["deviation"]
        return h - (a + b * jnp.cos(h) + c * jnp.sin(h) + d * jnp.cos(2 * h) + e * jnp.sin(2 * h)) - x.offset

    def f(x: Segway, u: Wheels, dt: Array) -> Segway:
        way = jnp.stack([x.scale * u.speed * dt, jnp.zeros_like(x.scale)])
        offset, wander = jnp.exp(-dt / std["offset_time"]) * x.offset, jnp.exp(-dt / std["wander_time"]) * x.wander
        return Segway(x.pos + rotated(yaw(x, u), way), wrap(offset), x.scale, wander)

    def Q(x: Segway, u: Wheels, dt: Array) -> Array:
        cos, sin = jnp.cos(yaw(x, u)), jnp.sin(yaw(x, u))
        turn = jnp.stack([jnp.stack([cos, -sin]), jnp.stack([sin, cos])])
        slip = diagonal(std["along"] * u.speed, std["across"] * u.speed)
        pos = dt * (turn @ slip @ turn.T + diagonal(std["walk"], std["walk"]))
        offset = -(std["offset"] ** 2) * jnp.expm1(-2 * dt / std["offset_time"])
        wander = -(std["wander"] ** 2) * jnp.expm1(-2 * dt / std["wander_time"])
        rest = jnp.diag(jnp.stack([offset, dt * std["drift"] ** 2, wander, wander]))
        return jax.scipy.linalg.block_diag(pos, rest)

    gps = Sensor(lambda x, c: x.pos + x.wander, const(diagonal(std["gps"], std["gps"])), vector(2))
    return Model(f, Q, product(Segway(vector(2), angle, scalar, vector(2))), {"gps": gps})


def nclt_1hz(data: Dataset) -> Replay:
    """A Segway outdoors and indoors: wheels and compass as input, consumer GPS with errors of up to 120 m, 1 Hz.

    What the gate refuses is multipath. It starts where the authors of the resampled files let theirs start. The better
    RTK receiver of the set is not used. Sequence 2013-04-05 is the test.
    """

    def belief(theta: PyTree) -> Gaussian:
        pos, scale = map(jnp.exp, theta["start"])
        offset, wander = jnp.exp(theta["offset"]), jnp.exp(theta["wander"])
        mean = Segway(data.constants["start"], 0.0, CAMPUS_SCALE, np.zeros(2))
        return start(mean, pos, pos, offset, scale, wander, wander)

    t, wheels = data.inputs["wheels"]
    # A reading speaks of the second that ends with it: as an input it is held from the stamp before.
    u = (t[:-1], Wheels(wheels[1:].mean(1), data.streams["heading"].z[1:]))
    recording = merge(segway(CAMPUS), {"gps": data.streams["gps"]}, u=u)
    truth = align(recording.t, data.truth["pos"], vector(2))
    return Replay(segway, belief, CAMPUS, recording, truth, vector(2), lambda x: x.pos, {"position": ((0, 1), "m")})
