"""Numbers and tests as what JSON can hold."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxfilt import consistency
from jaxfilt.consistency import Consistency

PARAMETERS = ("theta", "truth_theta", "start_theta", "estimated_theta", "parameters", "over", "at")
"""What keeps all its digits."""


def plain(x: Any, digits: int = 6) -> Any:
    """The same as JSON knows it; numbers to so many digits, parameters to all of theirs, NaN and inf as None."""
    if hasattr(x, "_asdict"):
        return plain(x._asdict(), digits)
    if isinstance(x, Mapping):
        return {str(key): plain(value, 17 if key in PARAMETERS else digits) for key, value in x.items()}
    if isinstance(x, np.ndarray | np.generic):
        return plain(x.tolist(), digits)
    if isinstance(x, (list, tuple)):
        return [plain(value, digits) for value in x]
    if isinstance(x, float):
        return float(f"{x:.{digits}g}") if math.isfinite(x) else None
    return x


def judged(total: Consistency, steps: Consistency | None = None) -> dict[str, Any]:
    """A mean beside its expectation and bounds; over time too, where there are steps."""
    ratio = total.mean / total.expected if total.expected else None
    found = total._asdict() | {"ratio": ratio, "verdict": consistency.verdict(total)}
    return found if steps is None else found | {"share_inside": consistency.share_inside(steps)}
