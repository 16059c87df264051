"""What tuning minimises: objectives, each of them called on one run, and differentiated, like any function.

Example: a voltmeter read once. The reading 2 V is predicted as 0 V with S = 4 V^2, so its NIS is 1; then the belief is
1 V with P = 1 V^2, and the truth 2 V has a NEES of 1. The density of each is that of one standard deviation.
    >>> import jax, jax.numpy as jnp, jaxfilt as jf
    >>> def run(objective, theta=0.0):
    ...     one = jnp.eye(1)
    ...     meter = jf.linear(A=one, H=one, Q=one, R=2 * jnp.exp(2 * theta) * one)
    ...     log = jf.Log(dt=jnp.ones(1), u=(), z={"z": jnp.array([[2.0]])}, c={}, valid={})
    ...     truth = jf.Truth(jnp.array([[2.0]]), jnp.array([True]))
    ...     return objective(jf.kf(meter), jf.Gaussian(jnp.zeros(1), one), log, truth)
    >>> round(float(run(log_score)), 4)  # (1 + log(2 pi 1 V^2)) / 2
    1.4189
    >>> round(float(run(likelihood)), 4)  # (1 + log(2 pi 4 V^2)) / 2
    2.1121
    >>> round(float(run(nees_match)), 4), round(float(run(nis_match)), 4)  # of one NEES, 1, the mean is right
    (2.7156, 2.7156)
    >>> round(float(run(mse(1.0))), 4)
    1.0
    >>> round(float(jax.grad(lambda theta: run(likelihood, theta))(0.0)), 4)  # R / S (1 - NIS): R is right
    0.0
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfilt import metrics
from jaxfilt.fold import Objective, Seen
from jaxfilt.metrics import Blocks
from jaxfilt.prediction import dtype_of
from jaxfilt.types import Array, Info

Sums = dict[str, Array]


def _mean(total: Array, count: Array) -> Array:
    """The mean, 0 of nothing."""
    return total / jnp.where(count > 0, count, 1.0)


def _mean_surprise(sums: Sums) -> Array:
    return _mean(sums["surprise"], sums["count"])


def _compared(seen: Seen) -> tuple[Array, Array, Array]:
    """Error, covariance and whether the truth is known: there for an objective that needs a truth."""
    return seen.error, seen.cov, seen.known


def _log_score_row(seen: Seen) -> Sums:
    error, cov, known = _compared(seen)
    return {"surprise": jnp.where(known, -metrics.log_score(error, cov), 0.0), "count": known}


log_score = Objective("log_score", _log_score_row, _mean_surprise, needs_truth=True)
"""Mean negative log density of the true error under the belief: ``mean(-log N(e_k; 0, P_k))``, nats per row.

``-log N(e; 0, P) = (e' P^-1 e + log |P| + d log 2 pi) / 2``: the first term asks for a P as large as the errors, the
second for a small one. The score is strictly proper: its expectation is smallest for the density that the errors really
have, so it makes the errors small *and* P honest, the common scale of P0, Q and R with it. Rows whose truth is unknown
do not count. Not a likelihood, for the errors of neighbouring rows are correlated. Called as every `Objective`: see the
example of this module.

Source: Gneiting, Raftery, Strictly proper scoring rules, prediction, and estimation, JASA 102 (2007), section 4.1.
"""


def _likelihood_row(seen: Seen) -> Sums:
    info = seen.info.values()
    return {"surprise": -sum(i.loglik for i in info), "count": sum(i.dof for i in info)}


likelihood = Objective("likelihood", _likelihood_row, _mean_surprise, needs_truth=False, likelihood=True)
"""Mean negative log density of the innovations, ``-sum_k log N(r_k; 0, S_k) / sum_k m_k``, nats per component read.

The negative logarithm of p(z_1 ... z_T), which needs no truth; exact for a `kf` on a linear model, also where
components are missing. Missing readings do not count; nor do those that a gate refused, so that a gate rewards a filter
which refuses what it cannot explain: tune without one. Called as every `Objective`: see the example of this module.

Source: S. Sarkka, Bayesian Filtering and Smoothing (2013), eq. 12.38.
"""


def _mismatch(sums: Sums) -> Array:
    """How far sums of squares, and of their squares, are from those of chi-square variables; 0 where both agree.

    ``a = log(sum / expected)`` is the scale, ``b = log(sum of squares / expected) - 2 a`` the shape, which no scale
    changes; the factor makes the loss ``log(var)^2`` for a small excess of the variance. Of several sensors, the mean.
    """

    def logarithm(x: Array) -> Array:
        tiny = float(jnp.finfo(x.dtype).tiny)
        return jnp.log(jnp.where(x < tiny, tiny, x))

    there = sums["dof"] > 0
    dof, dof_square = (jnp.where(there, sums[name], 1.0) for name in ("dof", "dof_square"))
    scale = logarithm(sums["value"]) - jnp.log(dof)
    shape = logarithm(sums["square"]) - jnp.log(dof_square) - 2 * scale
    apart = jnp.where(there, scale**2 + (dof_square / (2 * dof) * shape) ** 2, 0.0)
    return _mean(apart.sum(), there.sum().astype(apart.dtype))


def _nees_row(seen: Seen) -> Sums:
    error, cov, known = _compared(seen)
    d, count = len(error), known.astype(error.dtype)
    value = jnp.where(known, metrics.nees(error, cov), 0.0)
    return {"value": value, "square": value**2, "dof": d * count, "dof_square": d * (d + 2) * count, "count": count}


nees_match = Objective("nees_match", _nees_row, _mismatch, needs_truth=True)
"""Mean and variance of the NEES against those of a consistent filter, d and 2 d for a truth of d dimensions.

``log(m1 / d)^2 + ((d + 2) / 2 log(m2 / (d (d + 2)) / (m1 / d)^2))^2`` with m1 the mean of the NEES and m2 that of its
square. The second term compares var / mean^2, whatever the mean; near the optimum it is ``log(d var / (2 mean^2))^2``.
Logarithms, because a filter whose standard deviations are 100 times too small has a NEES of 10,000 d: the square of
that difference would be all that a mix sees, while this loss is 4 times the square of the logarithm of that factor, a
parabola that any optimiser descends. m2 and not the variance, which is a difference and may be 0.

Matching makes a filter consistent, not good: one that knows nothing, and says so, matches. It is for a `mix`. Called
as every `Objective`: see the example of this module.
"""


def _nis_row(seen: Seen) -> Sums:
    dtype = dtype_of(seen.belief)
    readings = [_reading(seen.info.get(name), dtype) for name in seen.filter.model.sensors]
    nis, dof = (jnp.stack(column) for column in zip(*readings, strict=True))
    count = (dof > 0).sum()
    return {"value": nis, "square": nis**2, "dof": dof, "dof_square": dof * (dof + 2), "count": count}


def _reading(info: Info | None, dtype: Any) -> tuple[Array, Array]:
    """NIS and number of components; unlike in `metrics.used`, what is broken stays, so that its NaN is seen."""
    if info is None:
        return jnp.zeros((), dtype), jnp.zeros((), dtype)
    return jnp.where(info.dof > 0, info.nis, 0.0), info.dof.astype(dtype)


nis_match = Objective("nis_match", _nis_row, _mismatch, needs_truth=False)
"""Mean and variance of each sensor's NIS against those of a consistent filter; the mean over the sensors that read.

As `nees_match`, with sums over the sensor's readings, of m_k components each: ``d`` becomes ``sum m_k`` and
``d (d + 2)`` becomes ``sum m_k (m_k + 2)``, so that missing components are no mismatch. Needs no truth. Missing
readings do not count, nor do those that a gate refused. Matching makes a filter consistent, not good: for a `mix`.
Called as every `Objective`: see the example of this module.
"""


def mse(weights: float | Mapping[str, float] = 1.0, blocks: Blocks | None = None) -> Objective:
    """Mean squared error against the truth: ``sum_b weight_b mean_k(sum over block b of e_k,i^2)``.

    The errors alone: a filter's estimates do not change when P0, Q and R are scaled together, so this loss leaves their
    common scale free, and P with it. `log_score` determines it.

    Args:
        weights: name -> weight, in the inverse of the block's unit squared; a block without one weighs nothing. Or one
            number for all components of the truth's space, where there are no ``blocks``.
        blocks: name -> (indices of the tangent vector of the truth's space, unit).

    Raises:
        ValueError: weights that are negative, not finite or all 0; when called, an index beyond the truth's space.
        TypeError: a dict without ``blocks``, or a number with them.
        KeyError: a weight for a block that is none.

    Example: a radian counts as much as 10 m.
        >>> objective = mse({"position": 1.0, "yaw": 100.0}, {"position": ((0, 1), "m"), "yaw": ((2,), "rad")})
        >>> objective.name, objective.needs_truth
        ('mse', True)
    """
    if (blocks is None) == isinstance(weights, Mapping):
        wanted = "a number without blocks" if blocks is None else "a dict with blocks"
        raise TypeError(f"mse(weights): expected {wanted}, got {weights!r}")
    named = weights if isinstance(weights, Mapping) else {"all": weights}
    if not (all(0 <= weight < math.inf for weight in named.values()) and any(named.values())):
        raise ValueError(f"mse(weights): expected finite numbers >= 0, not all 0, got {weights!r}")
    places = {"all": ()} if blocks is None else {name: index for name, (index, _) in blocks.items()}
    for name in named:
        if name not in places:
            raise KeyError(f"mse(weights): expected blocks of {list(places)}, got {name!r}")

    def row(seen: Seen) -> Sums:
        error, _, known = _compared(seen)
        return {"square": error**2, "count": known}

    def loss(sums: Sums) -> Array:
        d = len(sums["square"])
        by_component = np.zeros(d)
        for name, weight in named.items():
            for i in places[name] or range(d):
                if not 0 <= i < d:
                    raise ValueError(f"mse(blocks): expected indices below {d}, the truth's, got {i} of {name!r}")
                by_component[i] += weight
        return _mean(jnp.asarray(by_component, sums["square"].dtype) @ sums["square"], sums["count"])

    return Objective("mse", row, loss, needs_truth=True)


def held_back(sensor: str, every: int = 1) -> Objective:
    """Prediction of readings that the filter does not see: ``mean(-log N(z - h; 0, S))``, nats per component.

    Each k-th reading of the sensor is kept from the filter and predicted from the belief after the other updates of its
    row. Needs no truth, and tests what the likelihood does not: whether the other sensors say where this one would be.
    Not a likelihood, for the filter does not learn from what it has predicted. A gate does not apply to these readings.

    Args:
        sensor: whose readings.
        every: k, each k-th of its readings; 1: all of them, so that the filter never sees this sensor.

    Raises:
        ValueError: ``every`` that is no whole number >= 1.
        KeyError: when called, a sensor that the model lacks.

    Example: 2 V is predicted, with S = P + R = 1 + 2 V^2, from the meter that is read; the second one says 3 V.
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> one = jnp.eye(1)
        >>> meters = jf.linear(A=one, H={"first": one, "second": one}, Q=one, R={"first": 2 * one, "second": 2 * one})
        >>> log = jf.Log(dt=jnp.ones(1), u=(), z={"first": 4 * one, "second": 3 * one}, c={}, valid={})
        >>> start = jf.Gaussian(jnp.zeros(1), one)
        >>> round(float(held_back("second")(jf.kf(meters), start, log)), 4)  # (1 / 3 + log(2 pi 3 V^2)) / 2
        1.6349
    """
    if not isinstance(every, int) or isinstance(every, bool) or every < 1:
        raise ValueError(f"held_back(every): expected a whole number >= 1, got {every!r}")

    def row(seen: Seen) -> Sums:
        held = seen.held
        if sensor not in held.z:
            return {"surprise": jnp.zeros(()), "count": jnp.zeros(())}
        m = seen.filter.model.sensors[sensor].space.dim
        there = jnp.broadcast_to(jnp.asarray(held.valid[sensor]), (m,))
        _, info = seen.filter.update(seen.belief, held.z[sensor], sensor, held.c.get(sensor, ()), there)
        # Not info.loglik, which is 0 where a gate refuses: nobody may refuse what is asked of him. A component that is
        # missing has innovation 0 and variance 1 there, so its density is that of N(0; 0, 1).
        surprise = -metrics.log_score(info.innovation, info.S)
        dof = there.sum().astype(surprise.dtype)
        return {"surprise": surprise - 0.5 * (m - dof) * math.log(2 * math.pi), "count": dof}

    name = f"held_back({sensor!r})" if every == 1 else f"held_back({sensor!r}, every={every})"
    return Objective(name, row, _mean_surprise, needs_truth=False, held={sensor: every})


def mix(*parts: tuple[Objective, float]) -> Objective:
    """Weighted sum of objectives: ``sum_i weight_i loss_i``.

    All see the same filter: readings that one of them holds back are kept from it for all. Its count is that of the
    first. No likelihood, whatever its parts.

    Args:
        parts: (objective, weight >= 0).

    Raises:
        ValueError: nothing to mix, weights that are negative or not finite, parts that hold back different readings of
            one sensor.
        TypeError: a part that is no pair, or whose first is no Objective.

    Example:
        >>> both = mix((log_score, 1.0), (nis_match, 0.1))
        >>> both.name, both.needs_truth
        ('log_score + 0.1 nis_match', True)
    """
    if not parts:
        raise ValueError("mix(parts): expected at least one (objective, weight), got none")
    held: dict[str, int] = {}
    for part in parts:
        if not (isinstance(part, tuple) and len(part) == 2 and isinstance(part[0], Objective)):
            raise TypeError(f"mix(parts): expected (objective, weight), got {part!r}")
        objective, weight = part
        if not 0 <= weight < math.inf:
            raise ValueError(f"mix(parts): expected finite weights >= 0, got {weight} for {objective.name!r}")
        for sensor, every in objective.held.items():
            if held.setdefault(sensor, every) != every:
                raise ValueError(
                    f"mix(parts): expected parts that hold back the same readings of {sensor!r}, got each "
                    f"{held[sensor]}. and each {every}."
                )

    def row(seen: Seen) -> Sums:
        found = [objective.row(seen) for objective, _ in parts]
        sums = {f"{i}/{name}": value for i, own in enumerate(found) for name, value in own.items()}
        return sums | {"count": found[0]["count"]}

    def loss(sums: Sums) -> Array:
        total = jnp.zeros((), jnp.result_type(sums["count"]))
        for i, (objective, weight) in enumerate(parts):
            prefix = f"{i}/"
            own = {name.removeprefix(prefix): value for name, value in sums.items() if name.startswith(prefix)}
            total = total + float(weight) * objective.loss(own)
        return total

    name = " + ".join(o.name if w == 1 else f"{w:g} {o.name}" for o, w in parts)
    return Objective(name, row, loss, needs_truth=any(o.needs_truth for o, _ in parts), held=held)
