"""A truth that differs from the filter's model: what goes wrong with readings, and noises wrong by a factor.

A corruption is a pure function ``corrupt(truth, log, key) -> log`` of one simulated run: the true states after each
row (leading axis T), the log with its readings, a key of `jax.random` that the simulation did not use. It may be
vmapped over runs and over its own numbers: probabilities, sizes, delays may be traced (and are then not checked).
Combine corruptions with `several`, in the order in which they happen to a reading: its noise (`outliers`,
`heavy_tails`), then `bias`, then `delay`, then `drop_outs`. The first two take a reading's noise to be what it differs
by from h of the true state of its row, so they come first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors
from jaxfilt.types import Array, Log, Model, PyTree, Sensor

Corruption = Callable[[PyTree, Log, Array], Log]
"""``corrupt(truth, log, key) -> log``, of one run."""


def outliers(model: Model, sensor: str, probability: Array | float, scale: Array | float) -> Corruption:
    """Gross errors: with this probability the noise of a reading is ``scale`` times as large.

    ``z' = plus(h(x), s minus(z, h(x)))``, s = scale with probability p, else 1: the contaminated normal distribution
    ``(1 - p) N(0, R) + p N(0, scale^2 R)``, of covariance ``(1 + p (scale^2 - 1)) R``.

    Args:
        model, sensor: what the readings were simulated with, and whose they are.
        probability: () of an outlier, from 0 to 1, independent from reading to reading.
        scale: () >= 0, times the noise.

    Raises:
        KeyError, ValueError: an unknown sensor; a probability outside [0, 1], a negative scale.

    Example: every reading 10 times as far off.
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> log = jf.schedule(walk, steps=3, dt=1.0)._replace(z={"z": jnp.array([[1.0], [2.0], [-1.0]])})
        >>> outliers(walk, "z", 1.0, 10.0)(jnp.zeros((3, 1)), log, jax.random.key(0)).z["z"][:, 0].tolist()
        [10.0, 20.0, -10.0]

    Source: J. W. Tukey, A survey of sampling from contaminated distributions (1960).
    """
    found = doors.sensor(model, sensor)
    _number("probability", probability, lambda p: 0 <= p <= 1, "a number from 0 to 1")
    _number("scale", scale, lambda s: 0 <= s < np.inf, "a finite number >= 0")

    def corrupt(truth: PyTree, log: Log, key: Array) -> Log:
        struck = jax.random.bernoulli(key, jnp.asarray(probability, float), (len(log.dt),))
        return _noise_times(found, sensor, truth, log, jnp.where(struck, jnp.asarray(scale, float), 1.0))

    return corrupt


def heavy_tails(model: Model, sensor: str, dof: Array | float) -> Corruption:
    """Heavy tails: the Gaussian noise of each reading becomes a multivariate Student t of the same scale matrix R.

    ``z' = plus(h(x), s minus(z, h(x)))``, ``s = sqrt(dof / chi2(dof))``, one s for all components of a reading. Its
    covariance is ``dof / (dof - 2) R``, and does not exist for dof <= 2: to keep the covariance at R, simulate with
    `scaled`, ``R = (dof - 2) / dof``. As dof grows the noise becomes Gaussian.

    Args:
        model, sensor: what the readings were simulated with, and whose they are.
        dof: () > 0, degrees of freedom; 3 to 5 are usual.

    Raises:
        KeyError, ValueError: an unknown sensor; dof <= 0.

    Example:
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> log = jf.schedule(walk, steps=4, dt=1.0)._replace(z={"z": jnp.ones((4, 1))})
        >>> log = heavy_tails(walk, "z", dof=3.0)(jnp.zeros((4, 1)), log, jax.random.key(0))
        >>> len(set(log.z["z"][:, 0].tolist()))
        4

    Source: Kotz, Nadarajah, Multivariate t Distributions and Their Applications (2004), section 1.
    """
    found = doors.sensor(model, sensor)
    _number("dof", dof, lambda d: 0 < d < np.inf, "a finite number > 0")

    def corrupt(truth: PyTree, log: Log, key: Array) -> Log:
        half = 0.5 * jnp.asarray(dof, _dtype(log))
        # The logarithm of the gamma variate: at small dof the variate itself underflows.
        log_gamma = jax.random.loggamma(key, half, (len(log.dt),), half.dtype)
        return _noise_times(found, sensor, truth, log, jnp.exp(0.5 * (jnp.log(half) - log_gamma)))

    return corrupt


def bias(model: Model, sensor: str, offset: Array) -> Corruption:
    """A constant error of the sensor: ``z' = plus(z, offset)``.

    Args:
        model, sensor: what the readings were simulated with, and whose they are.
        offset: (m,) in the tangent of the sensor's space and in its units; for an attitude a rotation vector (3,) rad
            in the body frame.

    Raises:
        KeyError, ValueError: an unknown sensor; an offset of another shape, or not finite.

    Example:
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> log = jf.schedule(walk, steps=2, dt=1.0)
        >>> bias(walk, "z", jnp.array([0.5]))(jnp.zeros((2, 1)), log, jax.random.key(0)).z["z"].tolist()
        [[0.5], [0.5]]
    """
    found = doors.sensor(model, sensor)
    if np.shape(offset) != (found.space.dim,):
        raise ValueError(f"offset: expected shape {(found.space.dim,)}, got {np.shape(offset)}")
    doors.finite("offset", offset)

    def corrupt(truth: PyTree, log: Log, key: Array) -> Log:
        z = _readings(log, sensor)
        d = jnp.asarray(offset, _dtype(log))
        return _with_readings(log, sensor, jax.vmap(found.space.plus, in_axes=(0, None))(z, d))

    return corrupt


def delay(model: Model, sensor: str, rows: Array | int) -> Corruption:
    """Late readings: what arrives at a row was taken ``rows`` rows earlier, and the filter takes it for new.

    Reading, context and ``valid`` move together: the context says what that reading saw (which landmark, from where),
    so it belongs to the instant at which it was taken. In the first ``rows`` rows nothing arrives: ``valid`` is False
    there, and the first reading stands in. A row is not an amount of time unless all dt are equal.

    Where all sensors of a robot without inputs are late by the same, its clock is merely shifted: the innovations
    stay white and NIS as expected, and only the error against the truth tells. Inputs, or another sensor that is not
    late, make a delay show in the innovations.

    Args:
        model, sensor: what the readings were simulated with, and whose they are.
        rows: () whole number >= 1, less than T.

    Raises:
        KeyError, ValueError: an unknown sensor; rows < 1 or not whole; at the call, rows >= T.

    Example:
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> log = jf.schedule(walk, steps=4, dt=1.0)._replace(z={"z": jnp.array([[1.0], [2.0], [3.0], [4.0]])})
        >>> late = delay(walk, "z", rows=1)(jnp.zeros((4, 1)), log, jax.random.key(0))
        >>> late.z["z"][:, 0].tolist(), late.valid["z"].tolist()
        ([1.0, 1.0, 2.0, 3.0], [False, True, True, True])
    """
    doors.sensor(model, sensor)
    _number("rows", rows, lambda k: 1 <= k < np.inf and k == int(k), "a whole number >= 1")

    def corrupt(truth: PyTree, log: Log, key: Array) -> Log:
        z, T = _readings(log, sensor), len(log.dt)
        if doors.is_concrete(rows) and rows >= T:
            raise ValueError(f"rows: expected fewer than the log's {T}, got {rows}")
        taken = jnp.arange(T) - jnp.asarray(rows).astype(int)

        def moved(tree: PyTree) -> PyTree:
            return jax.tree.map(lambda a: jnp.asarray(a)[jnp.maximum(taken, 0)], tree)

        valid = _and(taken >= 0, moved(_valid(log, sensor)))
        c = log.c | {sensor: moved(log.c[sensor])} if sensor in log.c else log.c
        return log._replace(z=log.z | {sensor: moved(z)}, c=c, valid=log.valid | {sensor: valid})

    return corrupt


def drop_outs(model: Model, sensor: str, probability: Array | float, length: Array | float | None = None) -> Corruption:
    """Lost readings, other ones in each run: ``valid' = valid & there``; a reading is lost with all its components.

    With ``length`` they are lost in bursts, by a Markov chain with two states that moves from reading to reading (not
    from row to row): lost -> there with probability ``1/length``, there -> lost with ``p / ((1 - p) length)``; it
    starts from its stationary distribution, p and 1 - p.

    The cost: where ``valid`` is shared by all runs, a row without a reading costs nothing, a `jax.lax.cond` skips it.
    Where it differs by run, a batch computes the sensor's update in every row and then selects. Random drop-outs of
    the car's GNSS, which reads in every fifth row, make a batch of EKFs or UKFs 1.2 to 1.5 times as slow on a CPU;
    those of a sensor that reads in every row cost next to nothing.

    Args:
        model, sensor: what the readings were simulated with, and whose they are.
        probability: () share of the readings that is lost, from 0 to 1.
        length: () >= 1, mean number of readings lost in a row; it must be at least p / (1 - p), so that the chain
            exists. Default: each reading is lost or not independently of the others.

    Raises:
        KeyError, ValueError: an unknown sensor; a probability outside [0, 1], a length below 1 or too short for it.

    Example:
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> log = jf.schedule(walk, steps=1000, dt=1.0)
        >>> log = drop_outs(walk, "z", 0.3, length=5.0)(jnp.zeros((1000, 1)), log, jax.random.key(0))
        >>> 0.6 < log.valid["z"].mean() < 0.8
        Array(True, dtype=bool)

    Source: E. N. Gilbert, Capacity of a burst-noise channel (1960).
    """
    doors.sensor(model, sensor)
    _number("probability", probability, lambda p: 0 <= p <= 1, "a number from 0 to 1")
    if length is not None:
        _number("length", length, lambda k: 1 <= k < np.inf, "a finite number >= 1")
        if doors.is_concrete((probability, length)) and probability > (1 - probability) * length:
            raise ValueError(f"length: expected at least p / (1 - p) for p = {probability}, got {length}")

    def corrupt(truth: PyTree, log: Log, key: Array) -> Log:
        _readings(log, sensor)
        valid = jnp.asarray(_valid(log, sensor))
        if length is None:
            lost = jax.random.bernoulli(key, jnp.asarray(probability, float), (len(valid),))
        else:
            lost = _burst(key, valid.reshape(len(valid), -1).any(axis=1), probability, length)
        return log._replace(valid=log.valid | {sensor: _and(~lost, valid)})

    return corrupt


def several(*corruptions: Corruption) -> Corruption:
    """One corruption after the other, each with its own key.

    Example: outliers, of which some are lost.
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> corrupt = several(outliers(walk, "z", 0.05, 10.0), drop_outs(walk, "z", 0.2))
        >>> log = corrupt(jnp.zeros((100, 1)), jf.schedule(walk, steps=100, dt=1.0), jax.random.key(0))
        >>> log.valid["z"].shape
        (100,)
    """

    def corrupt(truth: PyTree, log: Log, key: Array) -> Log:
        for one, own in zip(corruptions, jax.random.split(key, len(corruptions)), strict=True):
            log = one(truth, log, own)
        return log

    return corrupt


def scaled(model: Model, Q: Array | float = 1.0, R: Array | float | Mapping[str, Array | float] = 1.0) -> Model:
    """The same robot with its noises multiplied: ``Q(x, u, dt)`` by one factor, each sensor's ``R(x, c)`` by another.

    Of covariances: 4 doubles the standard deviation. Simulate with one factor and filter with another for a filter
    whose noises are wrong; vmap over a factor for a sensitivity curve.

    Args:
        model: the robot and its sensors.
        Q: () >= 0, factor of the process noise.
        R: () >= 0, factor of the noise of all sensors, or a dict sensor -> factor; sensors left out keep theirs.

    Raises:
        KeyError, ValueError: an unknown sensor; a factor that is negative or not finite.

    Example:
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> doubled = scaled(walk, Q=2.0, R={"z": 3.0})
        >>> float(doubled.Q(jnp.zeros(1), (), 1.0)[0, 0]), float(doubled.sensors["z"].R(jnp.zeros(1), ())[0, 0])
        (2.0, 3.0)
    """
    factors = dict(R) if isinstance(R, Mapping) else dict.fromkeys(model.sensors, R)
    _number("Q", Q, lambda a: 0 <= a < np.inf, "a finite factor >= 0")
    for name, factor in factors.items():
        doors.sensor(model, name)
        _number(f"R of {name!r}", factor, lambda a: 0 <= a < np.inf, "a finite factor >= 0")
    changed = {name: model.sensors[name]._replace(R=_times(model.sensors[name].R, a)) for name, a in factors.items()}
    return model._replace(Q=_times(model.Q, Q), sensors=model.sensors | changed)


def _times(cov: Callable[..., Array], factor: Array | float) -> Callable[..., Array]:
    def product(*arguments: Any) -> Array:
        P = jnp.asarray(cov(*arguments))
        return P * jnp.asarray(factor, P.dtype)

    return product


def _noise_times(sensor: Sensor, name: str, truth: PyTree, log: Log, factor: Array) -> Log:
    """The log with the noise of each reading of a sensor, ``minus(z, h(x, c))``, multiplied by its factor (T,)."""
    z = _readings(log, name)

    def one(x: PyTree, z: PyTree, c: PyTree, s: Array) -> PyTree:
        image = sensor.h(x, c)
        return sensor.space.plus(image, s * sensor.space.minus(z, image))

    return _with_readings(log, name, jax.vmap(one)(truth, z, log.c.get(name, ()), factor.astype(_dtype(log))))


def _burst(key: Array, reads: Array, probability: Array | float, length: Array | float) -> Array:
    """(T,) bool, which readings a Gilbert chain loses; it moves in the rows where the sensor reads."""
    first, key = jax.random.split(key)
    p, leave = jnp.asarray(probability, float), 1 / jnp.asarray(length, float)
    enter = leave * p / jnp.where(p < 1, 1 - p, 1.0)

    def body(lost: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        reads, draw = row
        return jnp.where(reads, jnp.where(lost, draw >= leave, draw < enter), lost), lost

    draws = jax.random.uniform(key, reads.shape, enter.dtype)
    return jax.lax.scan(body, jax.random.bernoulli(first, p), (reads, draws))[1]


def _readings(log: Log, name: str) -> PyTree:
    if name not in log.z:
        raise KeyError(f"log.z: expected readings of sensor {name!r}, got those of {list(log.z)}")
    return log.z[name]


def _with_readings(log: Log, name: str, z: PyTree) -> Log:
    return log._replace(z=log.z | {name: jax.tree.map(lambda a, like: a.astype(like.dtype), z, log.z[name])})


def _valid(log: Log, name: str) -> Array:
    return log.valid.get(name, np.ones(len(log.dt), bool))


def _and(there: Array, valid: Array) -> Array:
    """A mask by row (T,) with another, by row (T,) or by component (T, m)."""
    return valid & (there[:, None] if jnp.ndim(valid) == 2 else there)


def _dtype(log: Log) -> Any:
    return jax.dtypes.canonicalize_dtype(log.dt.dtype)


def _number(name: str, value: Any, fits: Callable[[Any], bool], expected: str) -> None:
    """Raise unless a number that can be seen fits; a traced one is taken as it is."""
    if np.shape(value) != ():
        raise ValueError(f"{name}: expected {expected}, got shape {np.shape(value)}")
    if doors.is_concrete(value) and not fits(value):
        raise ValueError(f"{name}: expected {expected}, got {value}")
