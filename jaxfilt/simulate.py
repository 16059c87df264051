"""Simulation: the truth and the readings that a model's own equations and noises produce."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxfilt import doors, linalg
from jaxfilt.types import Array, Gaussian, Log, Model, PyTree, Space


class Simulation(NamedTuple):
    """A simulated run: the true state after each row (leading axis T), and the log with its readings and inputs."""

    truth: PyTree
    log: Log


def simulate(
    model: Model, belief: Gaussian, log: Log, key: Array, control: Callable[[PyTree, PyTree], PyTree] | None = None
) -> Simulation:
    """Draw a truth and its readings: ``x' = f(x, u, dt) + w``, ``z = h(x, c) + v``, the start from the belief.

    Args:
        model: the robot and its sensors.
        belief: Gaussian to draw the true start from; a zero covariance starts at its mean.
        log: the schedule: dt, u, c and valid are used, the readings in z replaced. `schedule` makes one.
        key: of `jax.random`.
        control: function of (true state, the row's u) that returns the input to hold over the row's interval, for
            robots that need a controller to stay where they should. Default: the row's u itself.

    Returns:
        Simulation(truth, log): u in the log is what the controller returned.

    Example:
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> start = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> truth, log = jf.simulate(walk, start, jf.schedule(walk, steps=5, dt=1.0), jax.random.key(0))
        >>> truth.shape, log.z["z"].shape
        ((5, 1), (5, 1))
    """
    doors.belief("belief", belief, model.space)
    doors.tables("log", log, model)
    dtype = jax.dtypes.canonicalize_dtype(belief.cov.dtype)
    belief, log = jax.tree.map(jnp.asarray, (belief, log))
    belief = jax.tree.map(lambda a: a.astype(dtype), belief)

    start, key = started(model.space, belief, key)

    def body(x: PyTree, row: tuple[Log, Array]) -> tuple[PyTree, tuple]:
        x, read = simulated(model, x, *row, key, control)
        return x, (x, read.u, read.z)

    _, (truth, u, z) = jax.lax.scan(body, start, (log, jnp.arange(len(log.dt))))
    return Simulation(truth, log._replace(u=u, z=z))


def started(space: Space, belief: Gaussian, key: Array) -> tuple[PyTree, Array]:
    """The true state before the first row, and the key of all rows."""
    start, rows = jax.random.split(key)
    return sample(belief, space, start), rows


def simulated(
    model: Model,
    x: PyTree,
    row: Log,
    number: Array,
    key: Array,
    control: Callable[[PyTree, PyTree], PyTree] | None = None,
) -> tuple[PyTree, Log]:
    """One row, by its number: the true state after it, and the row with its input and its readings."""
    names = [name for name in model.sensors if name in row.z]
    keys = jax.random.split(jax.random.fold_in(key, number), 1 + len(names))
    u = row.u if control is None else control(x, row.u)
    x = jax.lax.cond(row.dt > 0, lambda x: _moved(model, x, u, row.dt, keys[0]), lambda x: x, x)
    z = {name: _reading(model, name, x, row, keys[1 + i]) for i, name in enumerate(names)}
    return x, row._replace(u=u, z=z)


def sample(belief: Gaussian, space: Space, key: Array) -> PyTree:
    """A point drawn from a Gaussian on a space: ``plus(mean, L w)``, ``L L' = cov``, ``w ~ N(0, I)``."""
    return _perturbed(belief.mean, belief.cov, space, key)


def _perturbed(x: PyTree, cov: Array, space: Space, key: Array) -> PyTree:
    w = jax.random.normal(key, (space.dim,), cov.dtype)
    return space.plus(x, linalg.semidefinite_cholesky(cov) @ w)


def _moved(model: Model, x: PyTree, u: PyTree, dt: Array, key: Array) -> PyTree:
    dt = jnp.where(dt > 0, dt, 1.0)
    image = doors.call("f(x, u, dt)", model.f, x=x, u=u, dt=dt)
    moved = _perturbed(image, model.Q(x, u, dt), model.space, key)
    return jax.tree.map(lambda a, like: a.astype(like.dtype), moved, x)


def _reading(model: Model, name: str, x: PyTree, row: Log, key: Array) -> PyTree:
    sensor, c = model.sensors[name], row.c.get(name, ())
    if sensor.law is not None:
        return doors.call(f"law.draw(x, c, key) of sensor {name!r}", sensor.law.draw, x=x, c=c, key=key)
    image = doors.call(f"h(x, c) of sensor {name!r}", sensor.h, x=x, c=c)
    return _perturbed(image, sensor.R(x, c), sensor.space, key)
