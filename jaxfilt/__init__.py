"""jaxfilt: differentiable, batched Kalman filters in JAX."""

from jaxfilt.check import Checkup, check
from jaxfilt.diagnose import Diagnosis, diagnose
from jaxfilt.elementary import bearing, cosc, norm, sinc, wrap
from jaxfilt.files import load, save
from jaxfilt.filters import build, ckf, ekf, iekf, kf, ukf
from jaxfilt.integrate import euler, rk4
from jaxfilt.log import align, merge, schedule, stack, validate
from jaxfilt.models.linear import linear
from jaxfilt.models.sensors import range_bearing
from jaxfilt.noise import Parametrisation, blocks, const, diagonal, log_cholesky, log_std, van_loan, white
from jaxfilt.run import log_likelihood, mean_and_std, mean_only, scan, scan_runs
from jaxfilt.simulate import Simulation, sample, simulate
from jaxfilt.spaces import angle, product, rotate, rotate_back, scalar, so2, so3, so3_exp, so3_log, vector
from jaxfilt.study import Study, study
from jaxfilt.transforms import cubature, gauss_hermite, taylor, unscented
from jaxfilt.types import (
    Filter,
    Gaussian,
    Info,
    Log,
    Model,
    Moments,
    Recording,
    Replay,
    Scenario,
    Sensor,
    Space,
    Status,
    Stream,
    Track,
    Truth,
)

__all__ = [
    "Checkup",
    "Diagnosis",
    "Filter",
    "Gaussian",
    "Info",
    "Log",
    "Model",
    "Moments",
    "Parametrisation",
    "Recording",
    "Replay",
    "Scenario",
    "Sensor",
    "Simulation",
    "Space",
    "Status",
    "Stream",
    "Study",
    "Track",
    "Truth",
    "align",
    "angle",
    "bearing",
    "blocks",
    "build",
    "check",
    "ckf",
    "const",
    "cosc",
    "cubature",
    "diagnose",
    "diagonal",
    "ekf",
    "euler",
    "gauss_hermite",
    "iekf",
    "kf",
    "linear",
    "load",
    "log_cholesky",
    "log_likelihood",
    "log_std",
    "mean_and_std",
    "mean_only",
    "merge",
    "norm",
    "product",
    "range_bearing",
    "rk4",
    "rotate",
    "rotate_back",
    "sample",
    "save",
    "scalar",
    "scan",
    "scan_runs",
    "schedule",
    "simulate",
    "sinc",
    "so2",
    "so3",
    "so3_exp",
    "so3_log",
    "stack",
    "study",
    "taylor",
    "ukf",
    "unscented",
    "validate",
    "van_loan",
    "vector",
    "white",
    "wrap",
]
