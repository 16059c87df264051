"""Tables and matrices as plain text."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np

WIDTH = 118
"""Characters of a line."""


def wrapped(text: str, first: str = "- ") -> str:
    """A paragraph in lines of `WIDTH`, hanging after its first characters."""
    return textwrap.fill(text, WIDTH, initial_indent=first, subsequent_indent=" " * len(first))


def columns(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells, the first column to the left, the others to the right.

    Example:
        >>> print(columns([["", "before", "after"], ["RMSE", "2.5", "1"]]))
              before  after
        RMSE     2.5      1
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for label, *cells in rows:
        right = [cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True)]
        lines.append("  ".join([label.ljust(widths[0]), *right]).rstrip())
    return "\n".join(lines)


def matrix(M: np.ndarray, indent: int = 4, width: int = WIDTH) -> str:
    """A matrix, each number to four digits; one that is diagonal as ``diag(...)``.

    Example:
        >>> import numpy as np
        >>> print(matrix(np.diag([0.25, 1.0])))
            diag(0.25, 1)
        >>> print(matrix(np.array([[2.0, -0.5], [-0.5, 1 / 3]])))
            [[     2,   -0.5],
             [  -0.5, 0.3333]]
    """
    M = np.asarray(M, np.float64)
    if np.array_equal(M, np.diag(np.diagonal(M))):
        text = f"diag({', '.join(map(_digits, np.diagonal(M)))})"
        return textwrap.fill(text, width, initial_indent=" " * indent, subsequent_indent=" " * (indent + 5))
    wide = max(len(_digits(value)) for value in M.flat)
    text = np.array2string(
        M,
        max_line_width=width - indent,
        threshold=M.size + 1,
        separator=", ",
        formatter={"float_kind": lambda value: _digits(float(value)).rjust(wide)},
    )
    return textwrap.indent(text, " " * indent)


def _digits(value: float) -> str:
    return f"{value:.4g}"
