"""Recorded drives, ready to be run: `replay` joins a dataset, a model of its robot and the truth to score by.

Truth is for scoring, for the start where no other is known, and, where a docstring says so, for position fixes that
are made from it. The parameters of the models were set by hand to round numbers; the comment above each says on which
data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import datasets, metrics
from jaxfilt.datasets import Dataset
from jaxfilt.log import stack
from jaxfilt.recordings.anchored import rcv_uwb_drone
from jaxfilt.recordings.attitude import broad
from jaxfilt.recordings.bicycle import udacity_ctrv
from jaxfilt.recordings.campus import nclt_1hz
from jaxfilt.recordings.canyon import smartloc_berlin
from jaxfilt.recordings.euroc import euroc_mav
from jaxfilt.recordings.indoor import crazyflie_uwb
from jaxfilt.recordings.phantom import ansfl_phantom4
from jaxfilt.recordings.ranging import plaza_range, uwb_labyrinth
from jaxfilt.recordings.roads import comma2k19, kitti_imu_gps
from jaxfilt.recordings.wheels import dart_car, utias_mrclam, wifibot
from jaxfilt.types import Gaussian, Log, PyTree, Replay

_REPLAYS: dict[str, Callable[[Dataset], Replay]] = {
    "udacity_ctrv": udacity_ctrv,
    "utias_mrclam": utias_mrclam,
    "nclt_1hz": nclt_1hz,
    "wifibot": wifibot,
    "dart_car": dart_car,
    "crazyflie_uwb": crazyflie_uwb,
    "euroc_mav": euroc_mav,
    "ansfl_phantom4": ansfl_phantom4,
    "broad": broad,
    "rcv_uwb_drone": rcv_uwb_drone,
    "plaza_range": plaza_range,
    "uwb_labyrinth": uwb_labyrinth,
    "kitti_imu_gps": kitti_imu_gps,
    "comma2k19": comma2k19,
    "smartloc_berlin": smartloc_berlin,
}

GATES: dict[str, float | None] = {
    "udacity_ctrv": None,
    "utias_mrclam": 0.999,  # a few barcodes are misread: bearings off by radians
    "nclt_1hz": 0.9,  # GPS off by up to 120 m; of 0.5 to 0.99999 the best on the two calibration runs
    "wifibot": None,
    "dart_car": None,
    "crazyflie_uwb": 0.999,  # ranges off by metres, up to a tenth of those to anchor 8
    "euroc_mav": 0.9999,
    "ansfl_phantom4": 0.9999,
    "broad": None,
    "rcv_uwb_drone": 0.999,  # ranges off by up to tens of metres
    "plaza_range": None,
    "uwb_labyrinth": 0.999,
    "kitti_imu_gps": None,
    "comma2k19": None,
    "smartloc_berlin": None,  # most readings are off: a gate that refused them would lose its way
}
"""Recording -> the ``gate`` of the filter that goes with its model's parameters."""


def names() -> tuple[str, ...]:
    """The recordings that `replay` knows: datasets for which there is a model.

    Example:
        >>> import jaxfilt.recordings
        >>> jaxfilt.recordings.names()[:6]
        ('udacity_ctrv', 'utias_mrclam', 'nclt_1hz', 'wifibot', 'dart_car', 'crazyflie_uwb')
    """
    return tuple(_REPLAYS)


def replay(name: str, sequence: str | None = None) -> Replay:
    """A recorded drive, its model and its truth, in JAX's default float dtype.

    Args:
        name: one of `names`.
        sequence: one of ``jaxfilt.datasets.sequences(name)``; default the first.

    Returns:
        Replay(model, belief, theta, recording, truth, space, view, blocks). The docstring of the function of that
        name in this package says what is measured. The gate that goes with it is in `GATES`.

    Raises:
        KeyError: a recording or a sequence that does not exist.
        FileNotFoundError: the files are not at ``$JAXFILT_DATA``; the text says where they were looked for.
    """
    if name not in _REPLAYS:
        raise KeyError(f"recording: expected one of {list(_REPLAYS)}, got {name!r}")
    return _REPLAYS[name](datasets.load(name, sequence))


def batch(replays: Sequence[Replay]) -> tuple[Gaussian, Log]:
    """Replays of one model as one batch for `jaxfilt.scan_runs`: beliefs and logs with a leading run axis.

    Shorter logs are padded with rows in which nothing happens. The first replay's model and theta stand for all.

    Raises:
        ValueError: no replays, or replays of different models.
    """
    if len({r.model for r in replays}) != 1:
        raise ValueError(f"replays: expected at least one, all of one model, got {[r.model.__name__ for r in replays]}")
    beliefs = [r.belief(replays[0].theta) for r in replays]
    return jax.tree.map(lambda *b: jnp.stack(b), *beliefs), stack([r.recording.log for r in replays])


def dead_reckoning(log: Log) -> Log:
    """The same log with every sensor silent: what the inputs alone are worth."""
    return log._replace(valid={name: np.zeros(np.shape(log.dt), bool) for name in log.z})


def errors(replay: Replay, mean: PyTree) -> np.ndarray:
    """Errors ``minus(truth, view(mean))`` in the tangent space of the truth, (rows that have a truth, n).

    Args:
        replay: with a truth.
        mean: the estimated states, leading axis T or more: rows beyond the recording's are padding.

    Raises:
        ValueError: nobody knows the truth of this recording.
    """
    if replay.truth is None:
        raise ValueError("replay.truth: expected a Truth, got None: nobody knows where this robot was")
    rows, dtype = len(replay.recording.t), replay.recording.log.dt.dtype
    estimate = jax.jit(jax.vmap(replay.view))(jax.tree.map(lambda a: jnp.asarray(a[:rows], dtype), mean))
    return np.asarray(metrics.errors(replay.space, replay.truth.x, estimate))[replay.truth.mask]


def rmse(replay: Replay, mean: PyTree) -> dict[str, float]:
    """Root mean square of the length of each block's error, block -> number in the block's unit; see `errors`."""
    return metrics.rmse(errors(replay, mean), replay.blocks)
