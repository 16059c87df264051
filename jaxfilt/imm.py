"""Interacting multiple models: a robot that changes its way of moving, and a bank of filters that know one each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors, linalg
from jaxfilt.correction import nothing
from jaxfilt.mixture import collapsed
from jaxfilt.prediction import branch, canonical, interval, stepper
from jaxfilt.types import Array, Filter, Gaussian, Info, Model, PyTree, Space, Status
from jaxfilt.weighing import LOWEST, first_fault, normalised


class Modes(NamedTuple):
    """What an `imm` carries: by mode a belief (leading axis M), and ``log_probability`` (M,) of being in it."""

    belief: Gaussian
    log_probability: Array


def imm(filters: Sequence[Filter], transition: Array, probability: Array | None = None) -> Filter:
    """Interacting multiple models: M filters of one robot that moves in one of M ways, and changes between them.

    ``predict``  ``c_j = sum_i T_ij mu_i``; filter j starts from the mixture of all beliefs with the weights
    ``T_ij mu_i / c_j``, reduced to its mean and covariance, and predicts; ``mu_j <- c_j``. ``update``  each filter
    updates; ``mu_j <- mu_j L_j / sum_i mu_i L_i`` with L the density of its innovation. The log of the sum is
    ``loglik``. The estimate, `Filter.gaussian`, has mean and covariance of the mixture. Mixtures are reduced in tangent
    spaces, so that angles and attitudes are states like any other.

    Innovation, S and nis are of the mixture of predictions. A reading that a filter's gate refuses counts for that mode
    with density 1: leave gates to filters that all have one, or to none.

    Args:
        filters: Kalman filters, each of its own model: the state spaces are one, and so are the sensors.
        transition: (M, M), T_ij the probability, in one prediction with dt > 0, of going over from mode i to mode j;
            each row of sum 1.
        probability: (M,) of each mode at the start; default all alike.

    Returns:
        Filter(predict, update, step, model, begin, gaussian), its ``model`` that of the first; it carries `Modes`.

    Raises:
        ValueError, TypeError: fewer than two filters, spaces or sensors that differ, a filter that carries no Gaussian,
            probabilities that are none.

    Example: a number that stays where it is, or jumps.
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> one = jnp.eye(1)
        >>> calm, wild = (jf.kf(jf.linear(one, one, q * one, one)) for q in (0.0, 100.0))
        >>> filt = imm([calm, wild], jnp.array([[0.9, 0.1], [0.1, 0.9]]))
        >>> modes = filt.predict(filt.begin(jf.Gaussian(jnp.zeros(1), one)), (), 1.0)
        >>> modes, info = filt.update(modes, jnp.array([10.0]), "z")
        >>> [round(float(p), 3) for p in jnp.exp(modes.log_probability)]
        [0.0, 1.0]

    Source: Blom, Bar-Shalom, The interacting multiple model algorithm for systems with Markovian switching coefficients
    (1988); Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), section 11.6.6.
    """
    filters = tuple(filters)
    model = _checked(filters, transition, probability)
    space, count = model.space, len(filters)

    def begin(belief: Any, key: Array | None = None) -> Modes:
        if isinstance(belief, Modes):
            return _own(belief, count, space)
        belief = canonical(belief, space)
        dtype = belief.cov.dtype
        shares = jnp.full(count, 1 / count, dtype) if probability is None else jnp.asarray(probability, dtype)
        each = [filt.begin(belief) for filt in filters]
        return Modes(jax.tree.map(lambda *a: jnp.stack(a), *each), _log(shares))

    def mixed(modes: Modes, u: PyTree, dt: jax.Array) -> Modes:
        dtype = modes.log_probability.dtype
        joint = _log(jnp.asarray(transition, dtype)) + modes.log_probability[:, None]
        arrived = jax.nn.logsumexp(joint, axis=0)
        shares = jnp.exp(joint - arrived[None, :])
        after = []
        for j, filt in enumerate(filters):
            start = collapsed(modes.belief, shares[:, j], space)
            after.append(filt.predict(start, u, dt))
        return Modes(jax.tree.map(lambda *a: jnp.stack(a), *after), normalised(arrived)[0])

    def predict(belief: Any, u: PyTree = (), dt: Array | float = 0.0) -> Modes:
        modes = begin(belief)
        moves, dt = interval(dt, modes)
        return branch(moves, lambda modes: mixed(modes, u, dt), lambda modes: modes, modes)

    def update(belief: Any, z: PyTree, sensor: str, c: PyTree = (), mask: Array | None = None) -> tuple[Modes, Info]:
        modes = begin(belief)
        pairs = [
            filt.update(jax.tree.map(lambda a, j=j: a[j], modes.belief), z, sensor, c, mask)
            for j, filt in enumerate(filters)
        ]
        beliefs, infos = (jax.tree.map(lambda *a: jnp.stack(a), *side) for side in zip(*pairs, strict=True))
        weights, loglik = normalised(modes.log_probability + infos.loglik)
        info = _mixture(modes.log_probability, infos, loglik)
        sound = first_fault(
            (jnp.isfinite(modes.log_probability), Status.BAD_BELIEF), (jnp.isfinite(weights), Status.BAD_POSTERIOR)
        )
        status = jnp.where(info.status == Status.OK, sound, info.status)
        return Modes(beliefs, weights), info._replace(status=status)

    def gaussian(modes: Modes) -> Gaussian:
        return collapsed(modes.belief, jnp.exp(modes.log_probability), space)

    return Filter(predict, update, stepper(model, predict, update), model, begin, gaussian)


def _mixture(log_probability: jax.Array, infos: Info, loglik: jax.Array) -> Info:
    """One report of the reports of all modes: the prediction is a mixture, and so has one mean and one covariance."""
    shares = jnp.exp(log_probability)
    r = shares @ infos.innovation
    d = infos.innovation - r[None, :]
    S = jnp.tensordot(shares, infos.S, axes=1) + d.T @ (shares[:, None] * d)
    # What was not seen has innovation 0 and variance 1 in every mode, and keeps them.
    silent = nothing(len(r), r.dtype)
    nis = linalg.score(S, linalg.cholesky(S), r)[0]
    return silent._replace(
        innovation=r,
        S=S,
        nis=nis,
        loglik=loglik,
        dof=infos.dof.max(),
        ratio=infos.ratio.min(),
        status=infos.status.max(),
    )


def _log(p: jax.Array) -> jax.Array:
    return jnp.where(p > 0, jnp.log(jnp.where(p > 0, p, 1.0)), LOWEST)


def _checked(filters: tuple[Filter, ...], transition: Array, probability: Array | None) -> Model:
    if len(filters) < 2:
        raise ValueError(f"filters: expected at least two, got {len(filters)}")
    for filt in filters:
        doors.instance("filters", filt, Filter)
    first = filters[0].model
    for filt in filters:
        if filt.transition is None:
            raise TypeError("filters: expected Kalman filters, which carry a Gaussian")
        alike = jax.tree.map(np.shape, filt.model.space.origin) == jax.tree.map(np.shape, first.space.origin)
        if not alike or filt.model.space.dim != first.space.dim:
            raise ValueError(
                f"filters: expected one state space, got {doors.describe(first.space.origin)} and "
                f"{doors.describe(filt.model.space.origin)}"
            )
        if list(filt.model.sensors) != list(first.sensors):
            raise ValueError(
                f"filters: expected the same sensors, got {list(first.sensors)} and {list(filt.model.sensors)}"
            )
    _probabilities("transition", transition, (len(filters), len(filters)))
    if probability is not None:
        _probabilities("probability", probability, (len(filters),))
    return first


def _probabilities(name: str, p: Array, shape: tuple[int, ...]) -> None:
    if np.shape(p) != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {np.shape(p)}")
    if not doors.is_concrete(p):
        return
    values = np.asarray(p, np.float64)
    if not (values >= 0).all() or not np.allclose(values.sum(-1), 1, atol=1e-5):
        raise ValueError(f"{name}: expected probabilities, each row of sum 1, got {values.tolist()}")


def _own(modes: Modes, count: int, space: Space) -> Modes:
    doors.array("belief.log_probability", modes.log_probability)
    if modes.log_probability.shape != (count,):
        raise ValueError(f"belief.log_probability: expected shape ({count},), got {modes.log_probability.shape}")
    doors.point("belief.belief.mean", modes.belief.mean, space, leading=(count,))
    dtype = jax.dtypes.canonicalize_dtype(modes.log_probability.dtype)
    doors.same_dtype(dtype, **{"belief": modes.belief})
    return Modes(*jax.tree.map(lambda a: jnp.asarray(a, dtype), tuple(modes)))
