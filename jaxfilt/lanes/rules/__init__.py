"""The rules, by family; importing this package registers all of them."""

from jaxfilt.lanes.rules import algebra, control, elementwise, factors, movement, order, randomness, windows
from jaxfilt.lanes.rules.registry import RULES

__all__ = ["RULES", "algebra", "control", "elementwise", "factors", "movement", "order", "randomness", "windows"]
