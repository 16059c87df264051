"""Smoothing: what the whole log says of each row, not only what came before it."""

from jaxfilt.smooth.interval import Smoothed, smooth
from jaxfilt.smooth.lag import Window, fixed_lag
from jaxfilt.smooth.sampling import sample_trajectories

__all__ = ["Smoothed", "Window", "fixed_lag", "sample_trajectories", "smooth"]
