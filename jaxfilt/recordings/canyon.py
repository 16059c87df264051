"""A car in an urban canyon: raw distances to satellites, many of them by way of a wall."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.datasets import Dataset
from jaxfilt.log import align, merge
from jaxfilt.models.parts import arc, start, white_acceleration
from jaxfilt.models.sensors import pseudorange
from jaxfilt.models.wheeled import Odometry
from jaxfilt.noise import diagonal
from jaxfilt.spaces import angle, product, scalar, vector
from jaxfilt.types import Array, Gaussian, Model, PyTree, Replay, Sensor, Stream

GLONASS = 4.0
"""The number of that system in the context of a pseudorange; 1 is GPS."""


class Tracked(NamedTuple):
    """A car and the clock of its receiver: the state of `canyon_car`."""

    pos: Array
    """(3,) m, east, north, up."""
    yaw: Array
    """() rad, from east to north."""
    turn_bias: Array
    """() rad/s, by which the turn rate reads too high."""
    clock: Array
    """(2,) m and m/s: how far the receiver's clock is ahead of GPS, in light's way, and how fast."""
    glonass: Array
    """() m, what GLONASS adds to the clock."""


class Satellite(NamedTuple):
    """What is known of a pseudorange: the context of "pseudorange"."""

    place: Array
    """(3,) m, east, north, up."""
    system: Array
    """() 1 GPS, 4 GLONASS."""
    cn0: Array
    """() dBHz, carrier to noise density."""


# Floor and share (7 and 4 m) follow the scatter of the residuals on the first two thirds of the drive, and the share is
# then 30 times that: readings come five times a second, and their errors are alike for a minute, which a filter that
# takes noises for white has to be told somehow. Of 4 to 240 m it is the least at which the variances of the position
# agree with its errors; whole drive in sight, none of it held out. The others are round first guesses.
CANYON = {
    "along": math.log(0.2),  # m/sqrt(s)
    "across": math.log(0.05),  # m/sqrt(s)
    "climb": math.log(0.01),  # m/sqrt(s)
    "turn": math.log(0.005),  # rad/sqrt(s)
    "turn_bias": math.log(1e-5),  # rad/s/sqrt(s)
    "clock": math.log(0.1),  # m/sqrt(s)
    "clock_drift": math.log(0.05),  # m/s/sqrt(s)
    "glonass": math.log(0.01),  # m/sqrt(s)
    "floor": math.log(7.0),  # m
    "share": math.log(120.0),  # m at 45 dBHz
    # m horizontally, m vertically, rad, rad/s, m of clock, m/s of drift, m of GLONASS
    "start": tuple(map(math.log, (5.0, 2.0, 0.1, 0.003, 30.0, 100.0, 10.0))),
}
"""``theta`` of a car in a city: natural logarithms."""

SCATTER = CANYON | {"share": math.log(4.0)}
"""`CANYON` with every reading taken for independent of the last: what there is for a robust filter to mend."""


def canyon_car(theta: PyTree) -> Model:
    """A car with odometry as input and pseudoranges one by one: position and receiver clock in one filter.

    ``pos`` rolls along an arc of ``rate - turn_bias`` in the plane; the height wanders. ``clock' = clock + dt drift``.
    ``pseudorange = |place - pos| - |place| + clock + (glonass, of that system)``: less the distance to the origin,
    which is taken off the reading on the host, for at 20,000 km float32 knows whole metres only.
    ``R = floor^2 + share^2 10^((45 - cn0) / 10)``: a weak signal is a poor one.

    Args:
        theta: logarithms of the densities along, across, climb (m/sqrt(s)), turn (rad/sqrt(s)), turn_bias
            (rad/s/sqrt(s)), clock (m/sqrt(s)), clock_drift (m/s/sqrt(s)), glonass (m/sqrt(s)); floor and share (m).

    Returns:
        A model on `Tracked` (8 dimensions) with input `Odometry` and the sensor "pseudorange", () m, whose context is a
        `Satellite`.

    Example:
        >>> import jax.numpy as jnp
        >>> none = jnp.asarray(0.0)
        >>> x = Tracked(jnp.array([0.0, 0.0, 4.0]), none, none, jnp.array([7.0, 0.0]), jnp.asarray(2.0))
        >>> overhead = Satellite(jnp.array([0.0, 0.0, 2e7]), jnp.asarray(4.0), jnp.asarray(45.0))
        >>> round(float(canyon_car(CANYON).sensors["pseudorange"].h(x, overhead)), 4)
        5.0

    Source: P. D. Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems (2013), sections
    9.4.2 (pseudoranges and clock in an EKF) and 9.2.4.3 (weights by C/N0); odometry as in `rolling`.
    """
    keys = ("along", "across", "climb", "turn", "turn_bias", "clock", "clock_drift", "glonass", "floor", "share")
    std = {name: jnp.exp(theta[name]) for name in keys}

    def f(x: Tracked, u: Odometry, dt: Array) -> Tracked:
        pos, yaw = arc(x.pos[:2], x.yaw, u.speed * dt, (u.rate - x.turn_bias) * dt)
        clock = jnp.stack([x.clock[0] + dt * x.clock[1], x.clock[1]])
        return x._replace(pos=jnp.concatenate([pos, x.pos[2:]]), yaw=yaw, clock=clock)

    def Q(x: Tracked, u: Odometry, dt: Array) -> Array:
        cos, sin = jnp.cos(x.yaw), jnp.sin(x.yaw)
        turn = jnp.stack([jnp.stack([cos, -sin]), jnp.stack([sin, cos])])
        plane = dt * turn @ diagonal(std["along"], std["across"]) @ turn.T
        rest = dt * diagonal(std["climb"], std["turn"], std["turn_bias"])
        clock = std["clock_drift"] ** 2 * white_acceleration(dt)
        clock = clock + dt * diagonal(std["clock"], 0.0 * std["clock"])
        return jax.scipy.linalg.block_diag(plane, rest, clock, dt * diagonal(std["glonass"]))

    def h(x: Tracked, c: Satellite) -> Array:
        return pseudorange(x.pos, c.place, x.clock[0] + jnp.where(c.system == GLONASS, x.glonass, 0.0))

    def R(x: Tracked, c: Satellite) -> Array:
        weak = std["share"] * 10 ** ((45 - c.cn0) / 20)
        return diagonal(jnp.sqrt(std["floor"] ** 2 + weak**2))

    return Model(
        f,
        Q,
        product(Tracked(vector(3), angle, scalar, vector(2), scalar)),
        {"pseudorange": Sensor(h, R, scalar)},
    )


def smartloc_berlin(data: Dataset) -> Replay:
    """A car at Potsdamer Platz, 5 minutes: speed and turn rate as input, 5 Hz, and fifteen pseudoranges an epoch.

    Each pseudorange is a row. Two in five are off by more than 15 m, most of the worst too long: a wall sends the
    signal round. Such errors have no mean of zero, and last. A filter that takes them for independent (`SCATTER`) gains
    much by being robust, but is not mended by it: each reading by itself is hardly unlikely, and all err to one side. A
    tight gate makes it lose its way. With noises as in `CANYON` there is little left to gain. It starts at its true
    place and course; its clock as the first epoch then has it.
    """
    t, odometry = data.inputs["odometry"]
    seen, (t_truth, pos) = data.streams["pseudorange"], data.truth["pos"]
    c = Satellite(seen.c["satellite"], seen.c["system"], seen.c["cn0"])
    # A reading speaks of the interval that ends with it.
    u = (t[:-1], Odometry(odometry[1:, 0], odometry[1:, 5]))
    beyond = seen.z - np.linalg.norm(c.place, axis=1)
    recording = merge(canyon_car(CANYON), {"pseudorange": Stream(seen.t, beyond, c)}, u=u)
    truth = align(recording.t, (t_truth, pos), vector(3), gap=0.5)

    way = pos[np.argmax(np.hypot(*(pos - pos[0])[:, :2].T) > 2)] - pos[0]
    first = (seen.t == seen.t.min()) & (c.system != GLONASS)
    clock = np.median(seen.z[first] - np.linalg.norm(c.place[first] - pos[0], axis=1))
    zero = np.zeros(())
    mean = Tracked(pos[0], np.arctan2(way[1], way[0]), zero, np.array([clock, 0.0]), zero)

    def belief(theta: PyTree) -> Gaussian:
        across, up, yaw, bias, ahead, drift, glonass = map(jnp.exp, theta["start"])
        return start(mean, across, across, up, yaw, bias, ahead, drift, glonass)

    blocks = {"position": ((0, 1), "m"), "height": ((2,), "m")}
    return Replay(canyon_car, belief, CANYON, recording, truth, vector(3), lambda x: x.pos, blocks)
