"""What the data do not tell of theta: parameters and directions that the loss does not know, in words; host side.

Theta is mostly logarithms: its natural unit is a factor of e.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.fit import Flat
from jaxfilt.tuning.curvature import WEIGHT, Hessian, modes
from jaxfilt.tuning.parameters import Parameters
from jaxfilt.types import Array, Gaussian, Log, Model, PyTree

FAR = 1.0
"""Standard deviation along a direction, beyond which the data are said not to determine it: a factor of e."""

SHOWN = 0.1
"""Share of a direction's largest entry below which a parameter is not named."""

ALIKE = 0.1
"""Relative difference up to which covariances are said to grow in proportion."""


def uninfluential(gradients: Array, names: Sequence[str]) -> tuple[str, ...]:
    """Parameters that the loss does not know: the gradient by them is exactly 0 wherever it was taken.

    Args:
        gradients: (k, p) at k points.
        names: of the p parameters.

    Example:
        >>> import numpy as np
        >>> uninfluential(np.array([[1.0, 0.0, 0.0], [2.0, 0.5, 0.0]]), ("q", "r", "mark"))
        ('mark',)
    """
    return tuple(name for name, g in zip(names, np.asarray(gradients).T, strict=True) if (g == 0).all())


class Effects(NamedTuple):
    """What theta acts on, see `effects`.

    ``groups``: parameter -> some of "Q", "P0", "R gnss" (covariances), "f", "h gnss", "mean" (of the first belief).
    ``covariances``: "Q", "P0", "R gnss" -> the matrices (k, m, m) at k states, and their derivatives (k, m, m, p).
    """

    groups: dict[str, frozenset[str]]
    covariances: dict[str, tuple[np.ndarray, np.ndarray]]


def effects(
    model: Callable[[PyTree], Model],
    belief: Callable[[PyTree], Gaussian],
    parameters: Parameters,
    at: Array,
    x: PyTree,
    rows: Log,
) -> Effects:
    """What each free number of theta acts on, by the derivatives of the model's functions at a few states.

    Args:
        model, belief: functions of theta.
        parameters: which numbers of theta are free.
        at: (p,) their values.
        x: states, leading axis k.
        rows: of the log at these states, leading axis k; the sensors in ``z`` are looked at.

    Returns:
        Effects(groups, covariances).

    Example:
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> from jaxfilt.models import textbook
        >>> from jaxfilt.tuning.parameters import parameters
        >>> free = parameters(textbook.PENDULUM)
        >>> log = jf.schedule(textbook.pendulum(), steps=1, dt=0.1)
        >>> x = textbook.Pendulum(jnp.array([0.5]), jnp.array([0.0]))
        >>> found = effects(textbook.pendulum, textbook.pendulum_start, free, free.start, x, log)
        >>> {name: sorted(on) for name, on in found.groups.items()}
        {'length': ['f'], 'push': ['Q'], 'reading': ['R z'], 'start/0': ['P0'], 'start/1': ['P0']}
    """
    at = jnp.asarray(at)
    at = at.astype(jax.eval_shape(lambda v: belief(parameters.tree(v)).cov, at).dtype)
    rows = jax.tree.map(jnp.asarray, rows)

    def everything(vector: Array, still: Model, first: Gaussian) -> tuple[tuple[dict, dict], dict]:
        theta = parameters.tree(vector)
        own, start = model(theta), belief(theta)

        def one(x: PyTree, row: Log) -> tuple[dict, dict]:
            dt = jnp.where(row.dt > 0, row.dt, 1.0)
            covs = {"Q": own.Q(x, row.u, dt)}
            means = {"f": own.space.minus(own.f(x, row.u, dt), still.f(x, row.u, dt))}
            for name in (name for name in own.sensors if name in row.z):
                sensor, c = own.sensors[name], row.c.get(name, ())
                covs[f"R {name}"] = sensor.R(x, c)
                means[f"h {name}"] = sensor.space.minus(sensor.h(x, c), still.sensors[name].h(x, c))
            return covs, means

        covs, means = jax.vmap(one)(x, rows)
        covs["P0"], means["mean"] = start.cov[None], own.space.minus(start.mean, first.mean)
        return (covs, means), covs

    @jax.jit
    def derivatives(at: Array) -> tuple[tuple[dict, dict], dict]:
        still, first = model(parameters.tree(at)), belief(parameters.tree(at))
        return jax.jacfwd(lambda v: everything(v, still, first), has_aux=True)(at)

    (dcovs, dmeans), values = jax.tree.map(lambda a: np.asarray(a, np.float64), derivatives(at))
    acts = {group: (d != 0).reshape(-1, len(at)).any(0) for group, d in (dcovs | dmeans).items()}
    groups = {name: frozenset(group for group, on in acts.items() if on[j]) for j, name in enumerate(parameters.names)}
    return Effects(groups, {group: (values[group], d) for group, d in dcovs.items()})


def flat_directions(
    hessian: Hessian,
    effects: Effects,
    *,
    count: float | None = None,
    influence: Array | None = None,
    needs_truth: bool = True,
) -> tuple[Flat, ...]:
    """Directions in which theta may move by more than a factor of e, for all that the data say; in words.

    Args:
        hessian: of the loss, at its minimum.
        effects: of the parameters, from `effects`, in the order of the Hessian.
        count, influence: as in `standard_errors`; without them only directions without any curvature are found.
        needs_truth: whether the objective does.

    Returns:
        Flat(direction, curvature, std, text), the flattest first; none where the Hessian is not finite.

    Source: R. K. Mehra, On the identification of variances and adaptive Kalman filtering, IEEE Trans. Automatic Control
    15 (1970), for what innovations tell of Q.
    """
    if not np.isfinite(hessian.matrix).all():
        return ()
    axes, cov, flat, down = modes(hessian, count, influence)
    length = np.linalg.norm(axes, axis=0)
    std = np.where(flat, np.inf, np.sqrt(np.diag(cov)) * length)
    found = _null_basis(axes[:, flat & ~down], _common_scale(effects))
    weak = [k for k in np.argsort(-std) if FAR < std[k] < np.inf]
    found += list((axes[:, weak] / length[weak]).T)
    stds = [np.inf] * (len(found) - len(weak)) + [float(s) for s in std[weak]]
    names = list(effects.groups)
    within_q = sum(_groups(_named(d, names), effects) == {"Q"} for d in found)
    flats = []
    for k in np.flatnonzero(down):
        d = axes[:, k] / length[k]
        text = f"{_listed(_named(d, names))}: the loss bends down along it, so this is no minimum"
        flats.append(Flat(_named(d, names), float(d @ hessian.matrix @ d), np.inf, text))
    for d, far in zip(found, stds, strict=True):
        d = d if d[np.abs(d).argmax()] > 0 else -d
        named = _named(d, names)
        text = _words(named, far, _growth(d, effects), effects)
        if _groups(named, effects) == {"Q"} and not needs_truth and _is_full(effects):
            text += f"; full Q cannot be identified from innovations alone: {within_q} of its directions are flat"
        flats.append(Flat(named, float(d @ hessian.matrix @ d), far, text))
    return tuple(flats)


def _common_scale(effects: Effects) -> np.ndarray | None:
    """The direction (p,) in which all covariances grow in proportion and nothing else changes; None: there is none."""
    own = [all(on in effects.covariances for on in groups) for groups in effects.groups.values()]
    all_parts = [_normalised(C, dC) for C, dC in effects.covariances.values()]
    C, dC = (np.concatenate(parts) for parts in zip(*all_parts, strict=True))
    direction = np.linalg.lstsq(np.where(own, dC, 0.0), C, rcond=None)[0]
    off = np.linalg.norm(dC @ direction - C)
    return direction / np.linalg.norm(direction) if off <= 1e-3 * np.linalg.norm(C) else None


def _normalised(C: np.ndarray, dC: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Covariances (k, m, m) and their derivatives as columns, each component in units of its standard deviation."""
    std = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    std = np.where(std > 0, std, 1.0)
    unit = std[:, :, None] * std[:, None, :]
    return np.ravel(C / unit), (dC / unit[..., None]).reshape(-1, dC.shape[-1])


def _null_basis(null: np.ndarray, scale: np.ndarray | None) -> list[np.ndarray]:
    """Unit vectors that span the columns of ``null`` (p, k), each with few entries; one is the common scale, if there.

    Of k chosen parameters each vector moves one and leaves the others (reduced echelon form), so that a parameter that
    does nothing is a vector of its own, and pairs that can stand in for each other are not mixed.
    """
    null = np.linalg.svd(null, full_matrices=False)[0]
    chosen: list[int] = []
    if scale is not None:
        scale = np.where(np.linalg.norm(null, axis=1) > 1 - 0.1 * WEIGHT, 0.0, scale)
        if np.linalg.norm(null.T @ scale) > (1 - WEIGHT) * np.linalg.norm(scale):
            chosen = [int(np.abs(scale).argmax())]
    there, rest = len(chosen), null
    for k in range(null.shape[1]):
        if k >= there:
            chosen.append(int(np.linalg.norm(rest, axis=1).argmax()))
        row = rest[chosen[k]]
        rest = rest - np.outer(rest @ row, row) / (row @ row)
    basis = (null @ np.linalg.inv(null[chosen])).T
    if there:
        basis[0] = scale
    basis = [np.where(np.abs(b) > WEIGHT * np.abs(b).max(), b, 0.0) for b in basis]
    return [b / np.linalg.norm(b) for b in sorted(basis, key=np.count_nonzero, reverse=True)]


def _named(d: np.ndarray, names: list[str]) -> dict[str, float]:
    """The larger entries of a direction, largest first."""
    order = np.argsort(-np.abs(d), kind="stable")
    return {names[j]: float(d[j]) for j in order if abs(d[j]) > SHOWN * np.abs(d).max()}


def _groups(direction: dict[str, float], effects: Effects) -> set[str]:
    return set().union(*(effects.groups[name] for name in direction))


def _is_full(effects: Effects) -> bool:
    """Whether Q has more free numbers than variances."""
    return sum(groups == {"Q"} for groups in effects.groups.values()) > effects.covariances["Q"][0].shape[-1]


def _growth(d: np.ndarray, effects: Effects) -> dict[str, float]:
    """How fast each covariance grows along d, ``dC = a C``: group -> a; NaN for one that changes its shape too."""
    size, changes = {}, {}
    for group, (C, dC) in effects.covariances.items():
        c, change = _normalised(C, dC)
        changes[group] = c, change @ d
        size[group] = np.linalg.norm(change @ d) / np.linalg.norm(c) if c.any() else 0.0
    growth = {}
    for group, (c, change) in changes.items():
        if size[group] > SHOWN * max(size.values()):
            a = change @ c / (c @ c)
            growth[group] = float(a) if np.linalg.norm(change - a * c) < ALIKE * np.linalg.norm(change) else math.nan
    return growth


def _words(direction: dict[str, float], std: float, growth: dict[str, float], effects: Effects) -> str:
    names, rates = list(direction), np.array(list(growth.values()))
    if len(names) == 1:
        return f"{names[0]}: the data {'say nothing about it' if std == np.inf else 'hardly tell'}"
    if set(growth) == _groups(direction, effects) and np.isfinite(rates).all():
        if len(growth) == 1:
            return f"the scale of {_listed(growth)} is not determined by this objective"
        alike = np.ptp(rates) <= ALIKE * np.abs(rates).max()
        if alike and any(group.startswith("R ") for group in growth):
            change = "does not change" if std == np.inf else "hardly changes"
            why = f"this objective looks only at the mean, which {change} when all are multiplied alike"
            return f"the common scale of {_listed(growth)}: {why}"
        up, down = ([g for g, a in growth.items() if (a > 0) == sign] for sign in (True, False))
        if up and down:
            return f"the scale of {_listed(up)} against that of {_listed(down)} is not determined by this objective"
        return f"the scales of {_listed(growth)} are not determined by this objective"
    if len(names) == 2:
        return f"{names[0]} against {names[1]}: only their combination shows in these data"
    return f"{_listed(names)}: only combinations of them show in these data"


def _listed(names: Iterable[str]) -> str:
    *first, last = [f"R of {name[2:]}" if name.startswith("R ") else name for name in names]
    return f"{', '.join(first)} and {last}" if first else last
