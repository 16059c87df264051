"""Parallel in time: all parts of a log of a linear model at once. `jaxfilt.scan` has the flag for it."""

from jaxfilt.parallel.filtering import filtered

__all__ = ["filtered"]
