"""Rules of factors of small matrices and of solving with them, element by element.

Source: G. H. Golub, C. F. Van Loan, Matrix Computations, 4th edition (2013), algorithms 3.1.1, 3.1.2 (substitution),
3.4.1 (LU with partial pivoting), 4.2.1 (Cholesky).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfilt.lanes.graph import Graph, kind_of
from jaxfilt.lanes.nodes import Nodes
from jaxfilt.lanes.rules.algebra import dot
from jaxfilt.lanes.rules.registry import rule
from jaxfilt.lanes.rules.windows import places

if TYPE_CHECKING:
    from jaxfilt.lanes.lower import Lowering


@rule("cholesky")
def _(lowering: Lowering, equation: Any, x: Nodes) -> Nodes:
    out = np.full(x.shape, lowering.graph.constant(0, kind_of(equation.outvars[0].aval.dtype)), np.int64)
    for at in np.ndindex(*x.shape[:-2]):
        for i, row in enumerate(_cholesky(lowering.graph, x[at].tolist())):
            out[at][i, : len(row)] = row
    return out


def _cholesky(g: Graph, a: list[list[int]]) -> list[list[int]]:
    """Rows of the lower factor, all of it NaN if a pivot is not positive."""
    n = len(a)
    rows: list[list[int]] = [[] for _ in range(n)]
    failed = g.constant(False, "b")
    for j in range(n):
        kind = g.kind[a[j][j]]
        pivot = g.make("sub", a[j][j], dot(g, rows[j], rows[j], kind))
        failed = g.make("or", failed, g.make("le", pivot, g.constant(0, kind)))  # as LAPACK: a NaN is no reason to stop
        root = g.make("sqrt", pivot)
        inverse = g.make("div", g.constant(1, kind), root)
        for i in range(j + 1, n):
            rest = g.make("sub", a[i][j], dot(g, rows[i], rows[j], kind))
            rows[i].append(_divided(g, rest, root, inverse, shared=n - j > 2))
        rows[j].append(root)
    missing = g.constant(np.nan, g.kind[a[0][0]]) if n else 0
    return [[g.make("select", failed, missing, node) for node in row] for row in rows]


def _divided(g: Graph, x: int, divisor: int, inverse: int, shared: bool) -> int:
    """A quotient; by its inverse where several share the divisor, which costs half an ulp and saves the divisions."""
    return g.make("mul", x, inverse) if shared else g.make("div", x, divisor)


@rule("triangular_solve")
def _(lowering: Lowering, equation: Any, a: Nodes, b: Nodes) -> Nodes:
    p = equation.params
    # A is brought to the left, and to lower triangular form by turning the order of rows and columns.
    right = b if p["left_side"] else np.swapaxes(b, -1, -2)
    matrix = a if not p["transpose_a"] else np.swapaxes(a, -1, -2)
    lower = p["lower"] != p["transpose_a"]
    if not p["left_side"]:
        matrix, lower = np.swapaxes(matrix, -1, -2), not lower
    if not lower:
        matrix, right = matrix[..., ::-1, ::-1], right[..., ::-1, :]
    out = np.empty(right.shape, np.int64)
    for at in np.ndindex(*right.shape[:-2]):
        out[at] = _substituted(lowering.graph, matrix[at].tolist(), right[at], p["unit_diagonal"])
    out = out if lower else out[..., ::-1, :]
    return out if p["left_side"] else np.swapaxes(out, -1, -2)


def _substituted(g: Graph, a: list[list[int]], b: Nodes, unit: bool) -> Nodes:
    """X with A X = B for a lower triangular A."""
    columns = []
    for right in b.T.tolist():
        x: list[int] = []
        for i, node in enumerate(right):
            kind = g.kind[node]
            rest = g.make("sub", node, dot(g, a[i][:i], x, kind))
            if not unit:
                inverse = g.make("div", g.constant(1, kind), a[i][i])
                rest = _divided(g, rest, a[i][i], inverse, shared=b.shape[1] > 1)
            x.append(rest)
        columns.append(x)
    return np.array(columns, np.int64).reshape(b.shape[::-1]).T


@rule("lu")
def _(lowering: Lowering, equation: Any, x: Nodes) -> tuple[Nodes, Nodes, Nodes]:
    m, n = x.shape[-2:]
    batch = x.shape[:-2]
    out, swaps, order = np.array(x), np.empty((*batch, min(m, n)), np.int64), np.empty((*batch, m), np.int64)
    for at in np.ndindex(*batch):
        rows, swapped = _lu(lowering.graph, x[at].tolist())
        out[at], swaps[at] = rows, swapped
        order[at] = _permuted(lowering, swapped, m, "i32")
    return out, swaps, order


def _lu(g: Graph, a: list[list[int]]) -> tuple[list[list[int]], list[int]]:
    """Unit lower and upper factor in one, and for each column the row that was swapped in: its largest element."""
    m, n = len(a), len(a[0])
    swaps = []
    for k in range(min(m, n)):
        kind = g.kind[a[k][k]]
        nought = g.constant(0, kind)
        largest, where = g.make("abs", a[k][k]), g.constant(k, "i32")
        for i in range(k + 1, m):
            if a[i][k] == nought:
                continue  # is larger than nothing
            size = g.make("abs", a[i][k])
            wins = g.make("gt", size, largest)
            largest, where = g.make("select", wins, size, largest), g.make("select", wins, g.constant(i, "i32"), where)
        swaps.append(where)
        for i in range(k + 1, m):
            here = g.make("eq", where, g.constant(i, "i32"))
            pairs = list(zip(a[k], a[i], strict=True))
            a[k] = [g.make("select", here, other, own) for own, other in pairs]
            a[i] = [g.make("select", here, own, other) for own, other in pairs]
        inverse = g.make("div", g.constant(1, kind), a[k][k])
        # A column without a pivot is left as it is: 0 / 0 would spoil what LAPACK leaves alone.
        singular = g.make("eq", a[k][k], nought)
        for i in range(k + 1, m):
            factor = _divided(g, a[i][k], a[k][k], inverse, shared=m - k > 2)
            factor = g.make("select", singular, a[i][k], factor)
            a[i][k] = factor
            for j in range(k + 1, n):
                a[i][j] = g.make("sub", a[i][j], dot(g, [factor], [a[k][j]], kind))
    return a, swaps


@rule("lu_pivots_to_permutation")
def _(lowering: Lowering, equation: Any, swaps: Nodes) -> Nodes:
    aval = equation.outvars[0].aval
    size, kind = aval.shape[-1], kind_of(aval.dtype)
    rows = [_permuted(lowering, row, size, kind) for row in swaps.reshape(-1, swaps.shape[-1]).tolist()]
    return np.array(rows, np.int64).reshape(aval.shape)


def _permuted(lowering: Lowering, swaps: list[int], size: int, kind: str) -> list[int]:
    """0, 1, ... after its i-th number was swapped with that at ``swaps[i]``, one after the other."""
    g = lowering.graph
    order = [g.constant(i, kind) for i in range(size)]
    for i, swap in enumerate(swaps):
        for (j,), here in places(lowering, "lu_pivots_to_permutation", [swap], [size - 1], clamped=False):
            if j > i:
                order[i], order[j] = (
                    g.make("select", here, order[j], order[i]),
                    g.make("select", here, order[i], order[j]),
                )
    return order
