"""Programs on devices: how they are compiled, and how what belongs to runs is spread over several of them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxfilt.types import Array, PyTree

SPREAD = "devices"
"""The name of the axis of devices, along which the runs of a chunk are split."""

# What runs under vmap are thousands of small products; Eigen's thread pool costs more than it brings.
CPU_OPTIONS: dict[str, Any] = {"xla_cpu_multi_thread_eigen": False}


def finished(lowered: jax.stages.Lowered, platform: str) -> jax.stages.Compiled:
    """A lowered program, compiled; on a CPU without Eigen's threads."""
    if platform == "cpu":
        with contextlib.suppress(jax.errors.JaxRuntimeError):  # an XLA that does not know the option
            return lowered.compile(compiler_options=CPU_OPTIONS)
    return lowered.compile()


def spread(
    local: Callable[..., PyTree], joined: Callable[[PyTree], PyTree], devices: tuple, specs: tuple[PartitionSpec, ...]
) -> Any:
    """A function, jitted over devices: each has its part of the arguments, and what the parts return is ``joined``.

    Args:
        local: of one device's part of the arguments.
        joined: of what all devices returned, stacked along axis 0.
        specs: how each argument lies on the devices.
    """
    mesh = _mesh(devices)
    parts = _shard_map(lambda *a: jax.tree.map(lambda b: b[None], local(*a)), mesh, specs, PartitionSpec(SPREAD))
    inward = tuple(NamedSharding(mesh, spec) for spec in specs)
    everywhere = NamedSharding(mesh, PartitionSpec())
    return jax.jit(lambda *a: joined(parts(*a)), in_shardings=inward, out_shardings=everywhere)


def placed(devices: tuple, specs: tuple[PartitionSpec, ...], arguments: tuple) -> tuple:
    """Arguments as arrays that lie on the devices, also of other processes; one device takes them as they are."""
    if len(devices) == 1:
        return arguments
    mesh = _mesh(devices)

    def place(spec: PartitionSpec) -> Callable[[Array], jax.Array]:
        sharding = NamedSharding(mesh, spec)
        return lambda a: jax.make_array_from_callback(np.shape(a), sharding, lambda at: np.asarray(a)[at])

    return tuple(jax.tree.map(place(spec), a) for spec, a in zip(specs, arguments, strict=True))


def _mesh(devices: tuple) -> Mesh:
    return Mesh(np.array(devices), (SPREAD,))


def _shard_map(f: Callable, mesh: Mesh, in_specs: Any, out_specs: Any) -> Callable:
    """`jax.shard_map`, by the name and the options that it has in this JAX."""
    if hasattr(jax, "shard_map"):
        return jax.shard_map(f, mesh=mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)
    from jax.experimental.shard_map import shard_map as early

    return early(f, mesh, in_specs=in_specs, out_specs=out_specs, check_rep=False)
