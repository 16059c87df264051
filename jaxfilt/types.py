"""The nouns that cross rooms: plain tuples, all of them pytrees, none of them clever."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

PyTree = Any
"""A nest of tuples, dicts and NamedTuples with arrays at its leaves."""

Array = Any
"""A JAX or NumPy array."""


class Gaussian(NamedTuple):
    """A belief: all that a Kalman filter carries from one instant to the next.

    ``mean`` is a point of the state space (a pytree: one robot, one instant); ``cov`` is the (n, n)
    covariance of ``minus(x, mean)``, in the tangent space at the mean.
    """

    mean: PyTree
    cov: Array


class Moments(NamedTuple):
    """The first two moments of ``g(x)`` for a Gaussian x, as a transform returns them.

    ``mean`` is a point of the output space, ``cov`` (m, m) the covariance of the image, ``cross`` (n, m)
    the covariance of x with it, and ``remainder(K)`` the (n, n) covariance of ``x - K g(x)``, computed as a
    product so that it is positive semidefinite by construction; it must be that of these cov and cross, for gradients
    count on it. An expansion about ``mean + d`` (iterated filters)
    has as its mean g there, and ``shift`` = J d (m,), to be added to innovations; 0 otherwise.
    """

    mean: PyTree
    cov: Array
    cross: Array
    remainder: Callable[[Array], Array]
    shift: Array | float = 0.0


class Space(NamedTuple):
    """Where + and - of a state or of a measurement live.

    For points a, b and tangent vectors d of shape (dim,)::

        plus(b, minus(a, b)) == a        minus(plus(b, d), b) == d   (small d)        plus(b, 0) == b

    ``origin`` is a point of the space, as NumPy arrays: the template of every point's structure and shapes.
    ``flat`` says that ``plus(plus(x, a), b) == plus(x, a + b)``: no curvature, so nothing need be carried
    from one tangent space to another.
    """

    dim: int
    plus: Callable[[PyTree, Array], PyTree]
    minus: Callable[[PyTree, PyTree], Array]
    origin: PyTree
    flat: bool


class Transition(NamedTuple):
    """How the state before and the state after an interval hang together, as a Kalman filter's prediction sees it.

    ``belief`` is that after the interval; ``cross`` (n, n) the covariance of the state before with the state after;
    ``remainder(K)`` the (n, n) covariance of ``x - K x'``, process noise and all, computed as a product. Tangent spaces
    are those at the mean before, and at the mean of ``belief``.
    """

    belief: Gaussian
    cross: Array
    remainder: Callable[[Array], Array]


class Law(NamedTuple):
    """How a sensor's readings are distributed where that is not normal: a door seen or not, an echo that misses.

    ``log_density(z, x, c)`` is log p(z | x), up to a constant that no x changes if nobody compares likelihoods;
    ``draw(x, c, key)`` a reading.
    """

    log_density: Callable[[PyTree, PyTree, PyTree], Array]
    draw: Callable[[PyTree, PyTree, Array], PyTree]


class Sensor(NamedTuple):
    """What a sensor reports: ``z = h(x, c) + v``, ``v ~ N(0, R(x, c))``, on ``space``.

    ``c`` is the context of one reading, ``()`` unless the log says otherwise: which landmark was seen, where
    the satellite was, a matrix H of that instant.

    With a ``law`` readings are distributed as it says, and h and R are their mean and covariance: particle and grid
    filters and simulations go by the law, Kalman filters know these two moments of it.
    """

    h: Callable[[PyTree, PyTree], PyTree]
    R: Callable[[PyTree, PyTree], Array]
    space: Space
    law: Law | None = None


class Model(NamedTuple):
    """A robot: ``x' = f(x, u, dt) + w``, ``w ~ N(0, Q(x, u, dt))``, and its sensors, in order of use.

    ``Q`` is the *discrete* covariance for this ``dt``; `const`, `white` and `van_loan` make it.
    """

    f: Callable[[PyTree, PyTree, Array], PyTree]
    Q: Callable[[PyTree, PyTree, Array], Array]
    space: Space
    sensors: dict[str, Sensor]


class Status(IntEnum):
    """How an update went; from `BAD_BELIEF` on, something is wrong. The first cause is reported."""

    OK = 0
    ABSENT = 1
    GATED = 2
    BAD_BELIEF = 3
    BAD_MEASUREMENT = 4
    BAD_PREDICTION = 5
    INDEFINITE_INNOVATION = 6
    BAD_POSTERIOR = 7


class Info(NamedTuple):
    """What an update reports, apart from the belief.

    ``innovation`` (m,) and its covariance ``S`` (m, m); ``nis`` = innovation' S^-1 innovation; ``loglik`` =
    log N(innovation; 0, S); ``dof``, the number of components used; ``ratio`` = nis over the gate's threshold,
    above 1 where the gate refused the reading (0 without a gate); ``status``, a `Status`.
    A refused reading keeps its innovation, S, nis and ratio, and has dof 0 and loglik 0.
    """

    innovation: Array
    S: Array
    nis: Array
    loglik: Array
    dof: Array
    ratio: Array
    status: Array


class Log(NamedTuple):
    """What happened to one robot: one row per instant, leading axis T (a row alone has none).

    A row predicts once over ``dt`` seconds with the input ``u`` that was held over the interval ending there,
    then updates with each sensor present, in the order of ``model.sensors``.

    ``dt`` (T,) s. ``u`` a pytree (``()``: no input). ``z`` a dict sensor -> readings in their natural shape.
    ``c`` a dict sensor -> context, absent: ``()``. ``valid`` a dict sensor -> (T,) bool, or (T, m) where single
    components can be missing; a sensor absent from ``valid`` is there in every row. A missing reading is
    ``valid = False`` with any proper point of the sensor's space in ``z`` (a unit quaternion for an attitude, not
    zeros), never NaN: a batch computes the update before it drops it, and NaN would poison reverse mode.
    """

    dt: Array
    u: PyTree
    z: dict[str, PyTree]
    c: dict[str, PyTree]
    valid: dict[str, Array]


class Stream(NamedTuple):
    """One sensor's readings as recorded: ``t`` (K,) absolute seconds, float64; ``z``, ``c`` with leading axis K.

    ``valid`` (K,) or (K, m) marks what is missing, None: nothing is. A plain tuple ``(t, z)`` will do for it.
    """

    t: np.ndarray
    z: PyTree
    c: PyTree = ()
    valid: np.ndarray | None = None


class Truth(NamedTuple):
    """Where the robot really was: states ``x`` (leading axis T) and ``mask`` (T,), False where unknown."""

    x: PyTree
    mask: Array


class Recording(NamedTuple):
    """A log with its absolute times ``t`` (T,), float64, which never enter ``jit``."""

    log: Log
    t: np.ndarray


class Filter(NamedTuple):
    """A filter is a tuple of pure functions over a model. State is carried, Info is reported.

    ``predict(belief, u, dt) -> belief``; ``update(belief, z, sensor, c=(), mask=None) -> (belief, Info)``;
    ``step(belief, row) -> (belief, {sensor: Info})``, where a row is one row of a `Log`.

    A Kalman filter carries a `Gaussian`; others carry what they need: particles, cells, a map with what was seen of it.
    ``begin(belief, key=None)`` makes what is carried from a `Gaussian`, with a key of `jax.random` where it is drawn;
    what is carried already it returns, checked, as arrays of one dtype. ``gaussian(carried)`` is its mean and
    covariance, by which every filter is scored. ``transition(belief, u, dt)``, dt > 0, is the `Transition` that a
    smoother goes back by; None where a filter has none.
    """

    predict: Callable[..., Any]
    update: Callable[..., tuple[Any, Info]]
    step: Callable[[Any, Log], tuple[Any, dict[str, Info]]]
    model: Model
    begin: Callable[..., Any]
    gaussian: Callable[[Any], Gaussian]
    transition: Callable[..., Transition] | None = None


class Track(NamedTuple):
    """What a scan returns: the belief after each row, or what else the filter carries, and ``info``, a dict sensor ->
    Info; leading axis T."""

    belief: Any
    info: dict[str, Info]


class Scenario(NamedTuple):
    """All that a study needs to know of a robot: what to simulate and what to believe at the start.

    ``model(theta)`` and ``belief(theta)`` are functions of the parameters ``theta``; ``schedule(steps)`` is the
    `Log` of a run without its readings; ``control(x, u)`` turns the true state and the row's reference into the
    input (None: the row's input is used as it is); ``blocks`` names parts of the tangent space for the tables,
    name -> (indices, unit).
    """

    model: Callable[[PyTree], Model]
    belief: Callable[[PyTree], Gaussian]
    theta: PyTree
    schedule: Callable[[int], Log]
    blocks: dict[str, tuple[tuple[int, ...], str]]
    control: Callable[[PyTree, PyTree], PyTree] | None = None


class Replay(NamedTuple):
    """A recorded drive or flight, ready to be run: the model of the robot, where it began, what it measured.

    ``model(theta)`` and ``belief(theta)`` as in `Scenario`. ``truth`` (None where nobody knows it) lives on
    ``space``, and ``view(x)`` is the part of the state that it knows; ``blocks`` names parts of that space's
    tangent, name -> (indices, unit).
    """

    model: Callable[[PyTree], Model]
    belief: Callable[[PyTree], Gaussian]
    theta: PyTree
    recording: Recording
    truth: Truth | None
    space: Space
    view: Callable[[PyTree], PyTree]
    blocks: dict[str, tuple[tuple[int, ...], str]]
