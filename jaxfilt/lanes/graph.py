"""A program as a graph of scalars: each node is one operation on one number of one run.

Nodes are made once (an equal operation on equal nodes is the same node) and folded when they are made, so the zeros
of a Jacobian and the constants of a model vanish here and not in each run's arithmetic.
"""

from __future__ import annotations

from typing import Any

import numpy as np

KINDS = {
    "b": np.dtype(bool),
    "i32": np.dtype(np.int32),
    "i64": np.dtype(np.int64),
    "u32": np.dtype(np.uint32),
    "u64": np.dtype(np.uint64),
    "f32": np.dtype(np.float32),
    "f64": np.dtype(np.float64),
}
"""What a node may be."""

_KIND_OF = {dtype: kind for kind, dtype in KINDS.items()}

COMPARISONS = {"eq", "ne", "lt", "le", "gt", "ge"}
_COMMUTATIVE = {"add", "mul", "max", "min", "and", "or", "xor", "eq", "ne"}

OPERATIONS = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": lambda a, b: np.divide(a, b) if a.dtype.kind == "f" else _truncated(a, b)[0],
    "rem": lambda a, b: np.fmod(a, b) if a.dtype.kind == "f" else _truncated(a, b)[1],
    "neg": np.negative,
    "abs": np.abs,
    "sqrt": np.sqrt,
    "floor": np.floor,
    "ceil": np.ceil,
    "round": np.rint,
    "max": np.maximum,
    "min": np.minimum,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "not": np.invert,
    "shl": lambda a, b: _shifted(np.left_shift, a, b),
    "shr": lambda a, b: _shifted(np.right_shift, a, b),
    "sar": lambda a, b: np.right_shift(*(x.view(f"i{x.dtype.itemsize}") for x in (a, b))).view(a.dtype),
}
"""What each operation means, in NumPy, whose rules for NaN and signed zeros are JAX's.

Beside them: ``constant``, ``input``, ``convert`` and ``bitcast`` (to the node's kind), ``select`` (predicate, where
true, where false) and ``branch``: a select whose value names the `jax.lax.cond` it belongs to, so that it may be a real
branch where all runs take the same. ``shr`` is logical, ``sar`` arithmetic; ``round`` goes to even.
"""


def kind_of(dtype: np.typing.DTypeLike) -> str:
    """The kind of a dtype.

    Raises:
        KeyError: a dtype that no kernel handles.
    """
    return _KIND_OF[np.dtype(dtype)]


class Graph:
    """Nodes by number: ``op``, ``args`` (numbers of nodes), ``kind`` and ``value`` of each.

    ``strict`` keeps ``0 * x``, which is 0 only where x is finite. Otherwise it is folded, and ``folded`` has each such
    x: who runs the program must know that they were finite.
    """

    def __init__(self, strict: bool = False) -> None:
        self.strict = strict
        self.op: list[str] = []
        self.args: list[tuple[int, ...]] = []
        self.kind: list[str] = []
        self.value: list = []
        self.folded: set[int] = set()
        self.branches = 0
        self._known: dict[tuple, int] = {}
        self._constants: dict[int, Any] = {}
        self._literals: dict[tuple, int] = {}
        self._instances: dict[tuple, int] = {}

    def __len__(self) -> int:
        return len(self.op)

    def constant(self, value: object, kind: str) -> int:
        """The node of a number known now."""
        literal = (value, type(value), kind) if isinstance(value, (int, float)) and value else None  # -0 equals 0
        node = self._literals.get(literal) if literal else None
        if node is None:
            number = np.asarray(value).astype(KINDS[kind])[()]
            node = self._node("constant", (), kind, number, number.tobytes())
            self._constants[node] = number
            if literal:
                self._literals[literal] = node
        return node

    def input(self, where: tuple, kind: str) -> int:
        """The node of a number that is read: ``where`` tells it apart from all others."""
        return self._node("input", (), kind, where, where)

    def known(self, node: int) -> np.generic | None:
        """The value of a constant, None of anything else."""
        return self._constants.get(node)

    def instance(self, key: tuple | None = None) -> int:
        """The value of the ``branch`` nodes of one choice: a number not yet taken, or that of the same `key`."""
        found = None if key is None else self._instances.get(key)
        if found is None:
            found = self.branches
            self.branches += 1
            if key is not None:
                self._instances[key] = found
        return found

    def make(self, op: str, *args: int, kind: str | None = None, value: object = None) -> int:
        """The node of an operation; ``kind`` is only asked for of ``convert`` and ``bitcast``."""
        if kind is None:
            kind = "b" if op in COMPARISONS else self.kind[args[-1]]
        if op in _COMMUTATIVE and args[0] > args[1]:
            args = args[::-1]
        choice = op in ("select", "branch")
        found = self._known.get((op, args, kind, value if choice else None))
        if found is not None:
            return found
        constants = [self._constants.get(a) for a in args]
        if choice:
            return self._chosen(op, args, constants[0], value)
        if op == "convert" and kind == self.kind[args[0]]:
            return args[0]
        if None not in constants:
            return self.constant(_computed(op, constants, kind), kind)
        if op not in ("convert", "bitcast"):
            fold = self._float if self.kind[args[0]][0] == "f" else self._bits
            found = fold(op, args, constants)
            if found is not None:
                return found
        return self._node(op, args, kind, value, None)

    def raw(self, op: str, *args: int) -> int:
        """The node of an operation that is not to be folded, nor to be taken for one that was."""
        return self._node(op, args, self.kind[args[-1]], None, "raw")

    def _node(self, op: str, args: tuple[int, ...], kind: str, value: object, key: object) -> int:
        identity = (op, args, kind, key)
        found = self._known.get(identity)
        if found is None:
            found = self._known[identity] = len(self.op)
            self.op.append(op)
            self.args.append(args)
            self.kind.append(kind)
            self.value.append(value)
        return found

    def _chosen(self, op: str, args: tuple[int, ...], predicate: object, value: object) -> int:
        if predicate is not None:
            return args[1] if predicate else args[2]
        if args[1] == args[2]:
            return args[1]
        return self._node(op, args, self.kind[args[1]], value, value)

    def _float(self, op: str, args: tuple[int, ...], constants: list) -> int | None:
        """A node that an operation on floats comes down to, without rounding anything anew."""
        a, c = args, constants
        kind = self.kind[a[0]]
        if op == "mul":
            if c[1] is not None:
                a, c = a[::-1], c[::-1]
            if c[0] is not None:
                if c[0] == 0 and not self.strict:
                    self.folded.add(a[1])
                    return self.constant(0, kind)
                if c[0] == 1:
                    return a[1]
                if c[0] == -1:
                    return self.make("neg", a[1])
            return self._negated(a)
        if op == "div" and c[1] is not None and abs(np.frexp(c[1])[0]) == 0.5:
            least = np.finfo(c[1]).tiny
            if least <= abs(c[1]) <= 1 / least:
                return self.make("mul", self.constant(1 / c[1], kind), a[0])  # by a power of two: exact
        if op == "div" and c[0] is not None and c[0] == 0 and not self.strict:
            # 0 / x is NaN at x = 0, as is 0 * (1 / x): the reciprocal must be finite.
            self.folded.add(self.make("div", self.constant(1, kind), a[1]))
            return self.constant(0, kind)
        if op == "add":
            for this, other in ((0, 1), (1, 0)):
                if c[this] is not None and c[this] == 0:
                    return a[other]
                if self.op[a[this]] == "neg":
                    return self.make("sub", a[other], self.args[a[this]][0])
        if op == "sub":
            if c[1] is not None and c[1] == 0:
                return a[0]
            if c[0] is not None and c[0] == 0:
                return self.make("neg", a[1])
            if self.op[a[1]] == "neg":
                return self.make("add", a[0], self.args[a[1]][0])
        if op == "neg" and self.op[a[0]] == "neg":
            return self.args[a[0]][0]
        if op == "neg" and self.op[a[0]] == "sub":
            return self.make("sub", *self.args[a[0]][::-1])
        return None

    def _negated(self, args: tuple[int, ...]) -> int | None:
        """A product of negated factors, its sign outside."""
        negative = [self.op[a] == "neg" for a in args]
        if not any(negative):
            return None
        product = self.make("mul", *(self.args[a][0] if n else a for a, n in zip(args, negative, strict=True)))
        return product if all(negative) else self.make("neg", product)

    def _bits(self, op: str, args: tuple[int, ...], constants: list) -> int | None:
        """A node that an operation on integers or flags comes down to."""
        for this, other in ((0, 1), (1, 0)) if len(args) == 2 else ():
            c = constants[this]
            if c is None:
                continue
            nothing, everything = c == 0, c == np.invert(np.zeros((), c.dtype))
            if op == "and" and (nothing or everything):
                return args[this] if nothing else args[other]
            if op == "or" and (nothing or everything):
                return args[other] if nothing else args[this]
            if nothing and (op in ("add", "xor") or (this == 1 and op in ("sub", "shl", "shr", "sar"))):
                return args[other]
            if op == "mul" and (nothing or c == 1):
                return args[this] if nothing else args[other]
        if op in ("and", "or") and args[0] == args[1]:
            return args[0]
        if op == "not" and self.op[args[0]] == "not":
            return self.args[args[0]][0]
        return None


def _computed(op: str, constants: list, kind: str) -> object:
    with np.errstate(all="ignore"):
        if op == "convert":
            return converted(constants[0], kind)[()]
        if op == "bitcast":
            return constants[0].view(KINDS[kind])
        return OPERATIONS[op](*constants)


def converted(a: np.ndarray, kind: str) -> np.ndarray:
    """What ``convert`` means: as NumPy, except that a float too large for an integer is the nearest one, and NaN 0."""
    dtype = KINDS[kind]
    if a.dtype.kind != "f" or dtype.kind not in "iu":
        with np.errstate(all="ignore"):
            return np.asarray(a.astype(dtype))
    least, most = np.iinfo(dtype).min, np.iinfo(dtype).max
    # Every bound but the least one rounds up to a power of two that the integer has not.
    inside = (a >= a.dtype.type(least)) & (a < a.dtype.type(float(most)))
    limit = np.where(a > 0, dtype.type(most), np.where(a < 0, dtype.type(least), dtype.type(0)))
    return np.where(inside, np.where(inside, a, 0).astype(dtype), limit)


def _truncated(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quotient and remainder of integers, towards zero, as JAX has them: by zero -1 (all bits) and the dividend."""
    safe = np.where(b == 0, np.ones_like(b), b)
    rest = np.fmod(a, safe)
    quotient = ((a - rest) // safe).astype(a.dtype)
    return np.where(b == 0, ~np.zeros_like(a), quotient), np.where(b == 0, a, rest)


def _shifted(shift: np.ufunc, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """A logical shift; by the width of the number or more it gives 0."""
    bits = a.dtype.itemsize * 8
    unsigned = a.view(f"u{a.dtype.itemsize}")
    amount = b.astype(np.uint64)
    moved = shift(unsigned, np.minimum(amount, bits - 1).astype(unsigned.dtype))
    return np.where(amount < bits, moved, np.zeros_like(moved)).astype(unsigned.dtype).view(a.dtype)
