"""What a step of the descent is taken on: all runs, some of them, or some pieces of them."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.loop import checkpointed
from jaxfilt.tuning.loss import Evaluated, Problem, compiled, losses, started
from jaxfilt.tuning.split import Case, apart, pieces, some
from jaxfilt.types import Array, Log, PyTree


class Batches:
    """The loss of the training data: called with parameters (S, p), the number of the step, and where its epoch began.

    With ``batch`` runs a step, each epoch deals the runs anew into ``each`` minibatches, by a permutation that depends
    on the seed and the epoch alone. With ``length`` it is pieces of runs that are dealt: each goes on from the belief
    that the parameters at the beginning of the epoch (the anchor) had there, through which no gradient goes."""

    def __init__(
        self,
        problem: Problem,
        case: Case,
        starts: int = 1,
        batch: int | None = None,
        length: int | None = None,
        seed: int = 0,
    ) -> None:
        self._begins = None if length is None else _Begins(problem, case, starts, length)
        case = case if length is None else pieces(case, length)
        self.runs, self.starts = len(case.run), starts
        self.batch = self.runs if batch is None else batch
        if not 1 <= self.batch <= self.runs:
            what = "runs" if length is None else "pieces of runs"
            raise ValueError(f"batch: expected 1 to {self.runs} {what}, got {batch}")
        self.each = self.runs // self.batch
        self.full = self.each == 1 and length is None
        self._data, self._axes = apart(case)
        self._seed = seed
        every = np.arange(self.batch)
        begin = None if self._begins is None else jax.tree.map(lambda a: a[:, every], self._begins.shapes)
        self._program = losses(problem, some(self._data, self._axes, every), self._axes, starts, begin)

    def __call__(self, V: np.ndarray, step: int, anchor: np.ndarray) -> Evaluated:
        epoch, k = divmod(step, self.each)
        chosen = np.random.default_rng((self._seed, epoch)).permutation(self.runs)[
            k * self.batch : (k + 1) * self.batch
        ]
        whole = self.each == 1
        data = self._data if whole else some(self._data, self._axes, chosen)
        begin = None
        if self._begins is not None:
            begin = self._begins(anchor)
            begin = begin if whole else jax.tree.map(lambda a: a[:, chosen], begin)
        return jax.device_get(self._program(jnp.asarray(V, data.log.dt.dtype), data, begin))


class _Begins:
    """What the pieces of runs go on from: called with parameters (S, p), the beliefs (S, pieces, ...)."""

    def __init__(self, problem: Problem, case: Case, starts: int, length: int) -> None:
        data, axes = apart(case)
        runs, rows = case.weight.shape
        count = -(-rows // length)

        def one(v: Array, case: Case) -> PyTree:
            theta = problem.parameters.tree(v)
            filter = problem.filter(theta)

            def step(b: PyTree, row: Log) -> tuple[PyTree, PyTree]:
                return filter.step(b, row)[0], b

            before = checkpointed(step, filter.begin(started(problem, theta, case)), case.log)[1]
            return jax.tree.map(lambda a: a[::length], before)

        def every(V: Array, data: Case) -> PyTree:
            of_runs = jax.vmap(jax.vmap(one, in_axes=(None, axes)), in_axes=(0, None))(V, data)
            return jax.tree.map(lambda a: a.reshape(starts, runs * count, *a.shape[3:]), of_runs)

        shape = jax.ShapeDtypeStruct((starts, len(problem.parameters.start)), case.log.dt.dtype)
        self.shapes: Any = jax.tree.map(lambda s: np.zeros(s.shape, s.dtype), jax.eval_shape(every, shape, data))
        self._program, self._data, self._dtype = compiled(every, shape, data), data, case.log.dt.dtype
        self._anchor, self._found = None, None

    def __call__(self, anchor: np.ndarray) -> Any:
        if self._anchor is None or not np.array_equal(anchor, self._anchor):
            self._anchor = anchor.copy()
            self._found = jax.device_get(self._program(jnp.asarray(anchor, self._dtype), self._data))
        return self._found
