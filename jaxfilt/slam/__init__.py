"""Filters that find their way and draw the map, both at once, and how good a map is.

They run on any model on a `World`: `jaxfilt.models.slam.with_landmarks` makes one of any robot that sees landmarks.
"""

from jaxfilt.slam.ekf import Chart, ekf_slam
from jaxfilt.slam.fast import Swarm, fast_slam
from jaxfilt.slam.score import laid_upon, map_error

__all__ = ["Chart", "Swarm", "ekf_slam", "fast_slam", "laid_upon", "map_error"]
