"""Compiled lanes: a loop over time of many runs as one loop of machine code, with a register of runs in flight.

A row of one run, in ordinary JAX, is traced once; its small arrays become scalars, its constants fold, and what is left
is emitted as straight code on vectors of runs, through llvmlite. Knows nothing of filters.
"""

from jaxfilt.lanes.nodes import Unsupported

__all__ = ["Unsupported"]
