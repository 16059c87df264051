"""Factor graphs: whole trajectories as nonlinear least squares, with loop closures. Needs ``jaxfilt[graph]``."""

from jaxfilt.graph.between import Between, Placement, planar, spatial
from jaxfilt.graph.trajectory import Trajectory, optimise

__all__ = ["Between", "Placement", "Trajectory", "optimise", "planar", "spatial"]
