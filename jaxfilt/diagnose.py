"""What went wrong, where first, and why: reads the statuses and covariances of a track, outside `jit`."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from jaxfilt import doors
from jaxfilt.types import Status, Track

CAUSES = {
    Status.BAD_BELIEF: "the belief that reached it was not finite",
    Status.BAD_MEASUREMENT: "its reading z is NaN or inf; mark what is missing in log.valid instead",
    Status.BAD_PREDICTION: "h(x, c) or R(x, c) returned NaN or inf at the predicted mean",
    Status.INDEFINITE_INNOVATION: "the innovation covariance S = H P H' + R is not positive definite; look at R",
    Status.BAD_POSTERIOR: "the updated belief is not finite, or has a negative variance",
}


class Diagnosis(NamedTuple):
    """The first fault of a track.

    ``run`` (None for a single run), ``step`` the row; ``sensor``, None where the prediction did it; ``status`` a
    `Status`; ``runs`` how many runs have any fault; ``message`` all of it in words.
    """

    run: int | None
    step: int
    sensor: str | None
    status: Status
    runs: int
    message: str


def diagnose(track: Track) -> Diagnosis | None:
    """The first run, step and sensor that went wrong, and why; None where nothing did.

    Wrong is: a status from `Status.BAD_BELIEF` on, a belief that is not finite, or a covariance with an eigenvalue
    below zero by more than rounding. A reading refused by a gate is not wrong.

    Args:
        track: of `scan`, or of `scan_runs` with a leading run axis; not of `jit`-traced values.

    Returns:
        Diagnosis of the earliest step, at the lowest run that failed there.

    Example: a NaN that no mask announced, put in after the door.
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> z = jnp.array([[1.0], [jnp.nan], [3.0]])
        >>> run = jax.jit(lambda z: jf.scan(jf.kf(walk), jf.Gaussian(jnp.zeros(1), jnp.eye(1)),
        ...                                 jf.Log(jnp.ones(3), (), {"z": z}, {}, {})))
        >>> print(jf.diagnose(run(z)).message)
        step 1, sensor 'z': its reading z is NaN or inf; mark what is missing in log.valid instead
    """
    if not isinstance(track, Track):
        raise TypeError(f"track: expected a Track, got {type(track).__name__}; run scan with the default store")
    if not doors.is_concrete(track):
        raise TypeError("track: expected computed arrays, got traced ones; call diagnose outside jit and vmap")
    single = np.ndim(track.belief.cov) == 3
    batch = jax.tree.map(lambda a: np.asarray(a)[None] if single else np.asarray(a), track)
    fault = _faulty_beliefs(batch)
    for info in batch.info.values():
        fault |= info.status >= Status.BAD_BELIEF
    if not fault.any():
        return None
    step = int(np.argmax(fault.any(axis=0)))
    run = int(np.argmax(fault[:, step]))
    statuses = {name: Status(int(info.status[run, step])) for name, info in batch.info.items()}
    causes = {name: s for name, s in statuses.items() if s > Status.BAD_BELIEF}
    if causes:
        sensor, status = next(iter(causes.items()))
        what = f"sensor {sensor!r}: {CAUSES[status]}"
    elif Status.BAD_BELIEF in statuses.values() or not np.isfinite(batch.belief.cov[run, step]).all():
        sensor, status = None, Status.BAD_BELIEF
        what = "prediction: f(x, u, dt) or Q(x, u, dt) returned NaN or inf"
        what += f" from {_mean(batch, run, step - 1)}" if step else ", or the initial belief was not finite"
    else:
        sensor, status = None, Status.BAD_POSTERIOR
        what = "the covariance lost positive definiteness; use float64, or no negative centre weight"
    runs = int(fault.any(axis=1).sum())
    place = f"step {step}" if single else f"run {run}, step {step}"
    others = "" if runs == 1 else f" ({runs} of {len(fault)} runs have a fault)"
    return Diagnosis(None if single else run, step, sensor, status, runs, f"{place}, {what}{others}")


def _mean(batch: Track, run: int, step: int) -> str:
    """The mean there, in words: "the mean pos = [0, 1.5], yaw = 0.1"."""
    leaves = jax.tree.leaves_with_path(batch.belief.mean)
    words = []
    for path, leaf in leaves:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        value = np.array2string(leaf[run, step], precision=3, separator=", ", suppress_small=True, threshold=12)
        words.append(f"{name} = {value}" if name else value)
    return f"the mean {', '.join(words)}"


def _faulty_beliefs(batch: Track) -> np.ndarray:
    """(N, T): where a mean or a covariance is not finite, or a covariance is indefinite beyond rounding."""
    cov = batch.belief.cov
    finite = np.isfinite(cov).all(axis=(-2, -1))
    for leaf in jax.tree.leaves(batch.belief.mean):
        finite &= np.isfinite(leaf).reshape(*finite.shape, -1).all(axis=-1)
    std = np.sqrt(np.abs(np.diagonal(cov, axis1=-2, axis2=-1)))
    std = np.where(finite[..., None] & (std > 0), std, 1.0)
    correlation = np.where(finite[..., None, None], cov, 0.0) / (std[..., :, None] * std[..., None, :])
    slack = doors.ROUNDING * cov.shape[-1] * np.finfo(cov.dtype).eps
    return ~finite | (np.linalg.eigvalsh(correlation)[..., 0] < -slack)
