"""A loop over rows for many runs as a function of JAX arrays: inside `jax.jit`, under `jax.vmap` and differentiable."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from jaxfilt.lanes import derive, ffi, linear
from jaxfilt.lanes.engine import Engine, Operand, Result, Single, Sizes
from jaxfilt.lanes.nodes import Unsupported
from jaxfilt.lanes.program import Program
from jaxfilt.lanes.reach import living
from jaxfilt.lanes.reverse import Counts, Pair
from jaxfilt.lanes.trace import Assumed, Stored, Traced, program, traced

Arrays = list[jax.Array]


class Parts(NamedTuple):
    """What a loop is given, in the order in which it is passed on; or something about each of it."""

    constants: list
    rows: list
    start: list

    @property
    def all(self) -> list:
        """In one list."""
        return [*self.constants, *self.rows, *self.start]


def compiled(
    row: Traced, arrays: Parts, shared: Parts, sizes: Sizes, largest: int | None = None
) -> tuple[Arrays, Arrays]:
    """The carry at the end, leading axis runs, and the outputs of a traced row, for arrays of all runs and rows.

    Raises:
        Unsupported: an equation that has no rule, or a row of more operations than ``largest``.
    """
    loop = Loop(row, shared._replace(constants=[*shared.constants, *(True for _ in row.given)]), sizes, largest)
    found = loop.differentiable()(*arrays._replace(constants=[*arrays.constants, *row.given]).all)
    return found[: len(arrays.start)], found[len(arrays.start) :]


class Loop:
    """A traced row, and how often it runs: as a function of flat arrays, in the order of `Parts`."""

    def __init__(self, row: Traced, shared: Parts, sizes: Sizes, largest: int | None = None) -> None:
        self.row, self.shared, self.sizes, self.largest = row, shared, sizes, largest
        own, carried, avals = row.sizes[0], row.carried(), row.closed.in_avals
        self.avals = Parts([*avals[:own], *row.given], list(avals[own + len(carried) :]), list(carried))
        self.outs = row.closed.out_avals[len(carried) :]
        self._made: dict[bool, tuple[Program, Assumed]] = {}

    def differentiable(self) -> Callable[..., Arrays]:
        """The function with its derivatives, forward and reverse."""
        function = jax.custom_jvp(self.__call__)

        def rule(primals: tuple, tangents: tuple) -> tuple[Arrays, list]:
            found = function(*primals)
            pairs = zip(primals, tangents, strict=True)
            active = [derive.is_float(p) and not isinstance(t, SymbolicZero) for p, t in pairs]
            moved = linear.apply(
                functools.partial(self._tangents, active),
                functools.partial(self._cotangents, active),
                list(primals),
                [t for t, on in zip(tangents, active, strict=True) if on],
                [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in found if derive.is_float(a)],
            )
            floats = iter(moved)
            return found, [next(floats) if derive.is_float(a) else np.zeros(a.shape, jax.dtypes.float0) for a in found]

        function.defjvp(rule, symbolic_zeros=True)
        return function

    def __call__(self, *arrays: jax.Array) -> Arrays:
        """Run it; derivatives do not go through here."""
        fast = Single(*self._program(False))
        results = [Result(np.dtype(a.dtype), a.shape) for a in self.avals.start]
        results += [_result(a, how, self.sizes) for a, how in zip(self.outs, self.row.stored, strict=True)]
        operands = _operands(self.avals, self.shared, self.sizes)
        engine = Engine(operands, results, fast, lambda: Single(*self._program(True)))
        found = _called(engine, self._name() + fast.kernel.digest, self.sizes, list(arrays))
        added = [
            np.int32 if a.dtype == np.bool_ and how.summed else a.dtype
            for a, how in zip(self.outs, self.row.stored, strict=True)
        ]
        outs = [a.astype(dtype) for a, dtype in zip(found[len(self.avals.start) :], added, strict=True)]
        return [*found[: len(self.avals.start)], *outs]

    def _program(self, strict: bool) -> tuple[Program, Assumed]:
        if strict not in self._made:
            self._made[strict] = program(self.row, self.shared, False, strict)
            size = 0 if strict or self.largest is None else len(living(self._made[strict][0]))
            if self.largest is not None and size > self.largest:
                raise Unsupported("row", f"{size} operations on numbers, more than the {self.largest} that pay")
        return self._made[strict]

    def _name(self) -> str:
        """What tells the equations apart from others, also where their fast forms are the same."""
        text = str(self.row.closed.jaxpr) + "".join(c.tobytes().hex() for c in self.row.known if c is not None)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def _split(self, flat: list) -> Parts:
        ends = len(self.avals.constants), len(self.avals.constants) + len(self.avals.rows)
        return Parts(flat[: ends[0]], flat[ends[0] : ends[1]], flat[ends[1] :])

    def _tangents(self, active: list[bool], primals: Arrays, tangents: Arrays) -> Arrays:
        """Those of the floats of the carry at the end and of the outputs."""
        at, on, given = self._split(primals), self._split(active), iter(tangents)
        moved = Parts(*([next(given) if yes else None for yes in part] for part in on))
        floats = [derive.is_float(a) for a in at.start]
        begin = [jnp.zeros_like(a) if t is None else t for a, t in zip(at.start, moved.start, strict=True)]
        chosen = [k for k, yes in enumerate(on.constants) if yes], [k for k, yes in enumerate(on.rows) if yes]
        arrays = Parts(
            [*at.constants, *_only(moved.constants, on.constants)],
            [*at.rows, *_only(moved.rows, on.rows)],
            [*at.start, *_only(begin, floats)],
        )
        shared = Parts(
            [*self.shared.constants, *_only(self.shared.constants, on.constants)],
            [*self.shared.rows, *_only(self.shared.rows, on.rows)],
            [*self.shared.start, *_only(self.shared.start, floats)],
        )
        avals = Parts(
            [*self.avals.constants, *_only(self.avals.constants, on.constants)],
            [*self.avals.rows, *_only(self.avals.rows, on.rows)],
            [*self.avals.start, *_only(self.avals.start, floats)],
        )
        counts = len(at.constants), len(at.start)
        stored = [how for a, how in zip(self.outs, self.row.stored, strict=True) if derive.is_float(a)]
        body = derive.tangents(self.row.flat, counts, chosen)
        loop = Loop(traced(body, avals, stored), shared, self.sizes, self.largest)
        return loop(*arrays.all)[len(at.start) :]

    def _cotangents(self, active: list[bool], primals: Arrays, cotangents: Arrays) -> Arrays:
        """Those of the active arrays."""
        at, on = self._split(primals), self._split(active)
        floats = [derive.is_float(a) for a in at.start]
        slope, given = cotangents[: sum(floats)], iter(cotangents[sum(floats) :])
        behind = [
            (_spread(next(given), how, self.sizes), how.summed)
            for a, how in zip(self.outs, self.row.stored, strict=True)
            if derive.is_float(a)
        ]
        found = self._pulled(on, floats)(at, slope, behind)
        ends = sum(floats), sum(floats) + sum(on.constants)
        shared = [*_only(self.shared.start, floats), *_only(self.shared.constants, on.constants)]
        each = [a.sum(0) if alike else a for a, alike in zip(found, shared, strict=False)]
        begin = iter(each[: ends[0]])
        start = [next(begin) if yes else None for yes in floats]
        return [*each[ends[0] :], *found[ends[1] :], *_only(start, on.start)]

    def _pulled(self, on: Parts, floats: list[bool]) -> Callable[[Parts, Arrays, list[tuple[jax.Array, bool]]], Arrays]:
        """The function that goes backward: (arrays, cotangents of the carry, and of the outputs)."""
        active = [k for k, yes in enumerate(on.constants) if yes], [k for k, yes in enumerate(on.rows) if yes]
        sums = [self.avals.constants[k] for k in active[0]]
        outs = [(a, how) for a, how in zip(self.outs, self.row.stored, strict=True) if derive.is_float(a)]
        begin = _only(self.avals.start, floats)
        steps = self.sizes.steps
        results = [Result(np.dtype(a.dtype), a.shape) for a in [*begin, *sums]]
        results += [_moving(self.avals.rows[k], steps, self.shared.rows[k]) for k in active[1]]
        operands = _operands(self.avals, self.shared, self.sizes)
        operands += [Operand(np.dtype(a.dtype), a.shape, False) for a in begin]
        operands += [Operand(np.dtype(a.dtype), (steps, *a.shape), how.summed) for a, how in outs]
        constants, rows, start = (len(part) for part in self.avals)
        counts = Counts(constants, rows, start, len(begin), len(sums))

        def pair(strict: bool) -> Pair:
            leaves = self._program(strict)[0].leaves[: len(self.avals.start)]
            none = Stored()
            forward = traced(derive.saving(self.row.flat, leaves), self.avals, [none] * len(leaves))
            kept = forward.closed.out_avals[len(leaves) :]
            shapes = [a.shape for a in self.avals.start]
            body = derive.pulling(self.row.flat, leaves, shapes, len(self.avals.rows), active)
            rows = [*self.avals.rows, *kept, *(a for a, _ in outs)]
            shared = Parts(
                self.shared.constants,
                [*self.shared.rows, *(False for _ in kept), *(how.summed for _, how in outs)],
                [False] * (len(begin) + len(sums)),
            )
            summed = [Stored(summed=self.shared.rows[k]) for k in active[1]]
            backward = traced(body, Parts(self.avals.constants, rows, [*begin, *sums]), summed)
            return Pair(
                Single(*program(forward, self.shared, False, strict)),
                Single(*program(backward, shared, True, strict)),
                counts,
                operands,
                results,
                [Result(np.dtype(a.dtype), a.shape) for a in kept],
            )

        def pulled(at: Parts, slope: Arrays, behind: list[tuple[jax.Array, bool]]) -> Arrays:
            fast = pair(False)
            engine = Engine(operands, results, fast, _as_now(lambda: pair(True)))
            name = self._name() + fast.forth.kernel.digest + fast.back.kernel.digest
            return _called(engine, name, self.sizes, [*at.all, *slope, *(a for a, _ in behind)])

        return pulled


def _as_now(function: Callable[[], Any]) -> Callable[[], Any]:
    """The function with the precision of now: it is called later, on another thread, where that may be another."""
    double = jax.config.jax_enable_x64  # type: ignore[attr-defined]

    def later() -> Any:
        with _precision(double):
            return function()

    return later


def _precision(double: bool) -> Any:
    """`jax.enable_x64`, by the name that it has in this JAX."""
    if hasattr(jax, "enable_x64"):
        return jax.enable_x64(double)
    from jax.experimental import enable_x64  # type: ignore[attr-defined]

    return enable_x64(double)


def _called(engine: Engine, name: str, sizes: Sizes, arrays: Arrays) -> Arrays:
    shapes = [jax.ShapeDtypeStruct(r.whole(sizes), r.dtype) for r in engine.results]
    unique = hashlib.sha256(f"{name} {tuple(sizes)}".encode()).hexdigest()[:32]
    operation = jax.custom_jvp(ffi.operation(unique, lambda reads, writes: engine(reads, writes, sizes), shapes))
    operation.defjvp(linear.differentiated_once)
    return list(operation(*arrays))


def _operands(avals: Parts, shared: Parts, sizes: Sizes) -> list[Operand]:
    still = [Operand(np.dtype(a.dtype), a.shape, s) for a, s in zip(avals.constants, shared.constants, strict=True)]
    rows = zip(avals.rows, shared.rows, strict=True)
    moving = [Operand(np.dtype(a.dtype), (sizes.steps, *a.shape), s) for a, s in rows]
    begin = [Operand(np.dtype(a.dtype), a.shape, s) for a, s in zip(avals.start, shared.start, strict=True)]
    return [*still, *moving, *begin]


def _result(aval: Any, how: Stored, sizes: Sizes) -> Result:
    if how.summed:
        dtype = np.dtype(aval.dtype) if derive.is_float(aval) else np.dtype(np.float64)
        return Result(dtype, (sizes.steps, *aval.shape), summed=True)
    return Result(np.dtype(aval.dtype), (sizes.steps // how.every, *aval.shape), few=how.few)


def _moving(aval: Any, steps: int, summed: bool) -> Result:
    return Result(np.dtype(aval.dtype), (steps, *aval.shape), summed=summed)


def _spread(cotangent: jax.Array, how: Stored, sizes: Sizes) -> jax.Array:
    """The cotangent of an output at all rows of all runs: zero where it was not kept."""
    if how.summed:
        return cotangent
    runs = sizes.runs - len(cotangent)
    rest = sizes.steps - how.every * cotangent.shape[1]
    pads = [(0, runs, 0), (how.every - 1, rest, how.every - 1), *[(0, 0, 0)] * (cotangent.ndim - 2)]
    if how.every == 1 and runs == 0:
        return cotangent
    return jax.lax.pad(cotangent, jnp.zeros((), cotangent.dtype), pads)


def _only(values: Sequence, chosen: Sequence[bool]) -> list:
    return [v for v, yes in zip(values, chosen, strict=True) if yes]
