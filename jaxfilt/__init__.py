"""jaxfilt: differentiable, batched Kalman filters in JAX."""

from jaxfilt import priors
from jaxfilt.averages import averaging, moving_average
from jaxfilt.bootstrap import block_bootstrap
from jaxfilt.bound import Bound, cramer_rao, efficiency
from jaxfilt.check import Checkup, check
from jaxfilt.complementary import complementary, dead_reckoning
from jaxfilt.diagnose import Diagnosis, diagnose
from jaxfilt.elementary import bearing, cosc, norm, sinc, wrap
from jaxfilt.files import load, save
from jaxfilt.filters import build, ckf, ekf, iekf, kf, ukf
from jaxfilt.fit import Fit
from jaxfilt.fold import Objective, Seen
from jaxfilt.grid import Cells, grid, lattice
from jaxfilt.imm import Modes, imm
from jaxfilt.integrate import euler, rk4
from jaxfilt.log import align, merge, schedule, stack, validate
from jaxfilt.mismatch import scaled
from jaxfilt.models.linear import linear
from jaxfilt.models.sensors import range_bearing
from jaxfilt.noise import (
    Parametrisation,
    blocks,
    const,
    diagonal,
    floored,
    log_cholesky,
    log_std,
    shared,
    van_loan,
    white,
)
from jaxfilt.objectives import held_back, likelihood, log_score, mix, mse, nees_match, nis_match
from jaxfilt.out_of_sequence import OutOfSequence, out_of_sequence
from jaxfilt.particle import Kidnapping, Particles, particle
from jaxfilt.report.arrays import to_xarray
from jaxfilt.review import Replayed, Review, replayed
from jaxfilt.run import log_likelihood, mean_and_std, mean_only, scan, scan_runs
from jaxfilt.scores import Paired, Scores
from jaxfilt.simulate import Simulation, sample, simulate
from jaxfilt.slam import Chart, Swarm, ekf_slam, fast_slam
from jaxfilt.smooth import Smoothed, fixed_lag, sample_trajectories, smooth
from jaxfilt.spaces import angle, product, rotate, rotate_back, scalar, so2, so3, so3_exp, so3_log, vector
from jaxfilt.study import Interrupted, Study, study
from jaxfilt.sweep import Sweep, sweep
from jaxfilt.theta_file import theta_from_json, theta_to_json
from jaxfilt.transforms import cubature, gauss_hermite, taylor, unscented
from jaxfilt.tune import tune
from jaxfilt.tuning.split import Split
from jaxfilt.types import (
    Filter,
    Gaussian,
    Info,
    Law,
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
    Transition,
    Truth,
)
from jaxfilt.verdict import Verdict, innovation_verdict, verdicts

__all__ = [
    "Bound",
    "Cells",
    "Chart",
    "Checkup",
    "Diagnosis",
    "Filter",
    "Fit",
    "Gaussian",
    "Info",
    "Interrupted",
    "Kidnapping",
    "Law",
    "Log",
    "Model",
    "Modes",
    "Moments",
    "Objective",
    "OutOfSequence",
    "Paired",
    "Parametrisation",
    "Particles",
    "Recording",
    "Replay",
    "Replayed",
    "Review",
    "Scenario",
    "Scores",
    "Seen",
    "Sensor",
    "Simulation",
    "Smoothed",
    "Space",
    "Split",
    "Status",
    "Stream",
    "Study",
    "Swarm",
    "Sweep",
    "Track",
    "Transition",
    "Truth",
    "Verdict",
    "align",
    "angle",
    "averaging",
    "bearing",
    "block_bootstrap",
    "blocks",
    "build",
    "check",
    "ckf",
    "complementary",
    "const",
    "cosc",
    "cramer_rao",
    "cubature",
    "dead_reckoning",
    "diagnose",
    "diagonal",
    "efficiency",
    "ekf",
    "ekf_slam",
    "euler",
    "fast_slam",
    "fixed_lag",
    "floored",
    "gauss_hermite",
    "grid",
    "held_back",
    "iekf",
    "imm",
    "innovation_verdict",
    "kf",
    "lattice",
    "likelihood",
    "linear",
    "load",
    "log_cholesky",
    "log_likelihood",
    "log_score",
    "log_std",
    "mean_and_std",
    "mean_only",
    "merge",
    "mix",
    "moving_average",
    "mse",
    "nees_match",
    "nis_match",
    "norm",
    "out_of_sequence",
    "particle",
    "priors",
    "product",
    "range_bearing",
    "replayed",
    "rk4",
    "rotate",
    "rotate_back",
    "sample",
    "sample_trajectories",
    "save",
    "scalar",
    "scaled",
    "scan",
    "scan_runs",
    "schedule",
    "shared",
    "simulate",
    "sinc",
    "smooth",
    "so2",
    "so3",
    "so3_exp",
    "so3_log",
    "stack",
    "study",
    "sweep",
    "taylor",
    "theta_from_json",
    "theta_to_json",
    "to_xarray",
    "tune",
    "ukf",
    "unscented",
    "validate",
    "van_loan",
    "vector",
    "verdicts",
    "white",
    "wrap",
]
