"""Fixed lag: a smoother that goes forward, some rows behind the filter."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxfilt import doors
from jaxfilt.prediction import stepper
from jaxfilt.smooth.interval import at
from jaxfilt.smooth.links import Link, back, link, no_time, with_transition
from jaxfilt.types import Array, Filter, Gaussian, Info, PyTree


class Window(NamedTuple):
    """What a fixed-lag smoother carries: the filter's ``beliefs`` after the last rows (lag + 1), the oldest first, and
    the ``links`` (lag) between them."""

    beliefs: Gaussian
    links: Link


def fixed_lag(filter: Filter, lag: int) -> Filter:
    """Fixed-lag smoother, for use online: after each row the belief ``lag`` rows before, given all up to now.

    A `Filter` that carries the last beliefs and what links them; a row costs ``lag`` products of matrices beside the
    filter's own step, and no more calls of f. Its ``gaussian(carried)`` is the belief ``lag`` rows ago (before as many
    rows have passed that before the first row), so it is to be compared with the truth of that row, not, as studies
    and replays do, with the present one. Each prediction counts as a row, also over ``dt = 0``.

    Args:
        filter: from `kf`, `ekf`, `iekf`, `ukf`, `ckf`, `build`.
        lag: rows, >= 0; 0 is the filter itself.

    Raises:
        TypeError, ValueError: a filter without a transition, a lag below 0.

    Example: store what it says at each row, not all that it carries. The last row is too late for the first reading.
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> log = jf.Log(dt=jnp.ones(3), u=(), z={"z": jnp.array([[0.0], [3.0], [3.0]])}, c={}, valid={})
        >>> late = fixed_lag(jf.kf(walk), 1)
        >>> store = lambda carried, info: late.gaussian(carried).mean[0]
        >>> said = jf.scan(late, jf.Gaussian(jnp.zeros(1), jnp.eye(1)), log, store)
        >>> [round(float(m), 3) for m in said]
        [0.0, 0.75, 2.143]

    Source: B. D. O. Anderson, J. B. Moore, Optimal Filtering (1979), section 7.3, computed as in S. Sarkka, Bayesian
    Filtering and Smoothing (2013), section 8.4.
    """
    with_transition(filter)
    if lag < 0:
        raise ValueError(f"lag: expected at least 0 rows, got {lag}")
    model, space = filter.model, filter.model.space

    def begin(belief: Any, key: Array | None = None) -> Window:
        if isinstance(belief, Window):
            return _window(belief, started(filter.begin(Gaussian(space.origin, jnp.eye(space.dim)))))
        return started(filter.begin(belief, key))

    def started(belief: Gaussian) -> Window:
        copies = lambda tree, n: jax.tree.map(lambda a: jnp.broadcast_to(a, (n, *jnp.shape(a))), tree)  # noqa: E731
        return Window(copies(belief, lag + 1), copies(no_time(belief), lag))

    def predict(carried: Window, u: PyTree = (), dt: Array | float = 0.0) -> Window:
        newest = at(carried.beliefs, -1)
        return Window(
            _pushed(carried.beliefs, filter.predict(newest, u, dt)),
            _pushed(carried.links, link(filter, newest, u, dt)),
        )

    def update(
        carried: Window, z: PyTree, sensor: str, c: PyTree = (), mask: Array | None = None
    ) -> tuple[Window, Info]:
        belief, info = filter.update(at(carried.beliefs, -1), z, sensor, c, mask)
        beliefs = jax.tree.map(lambda a, b: jnp.concatenate([a[:-1], b[None]]), carried.beliefs, belief)
        return carried._replace(beliefs=beliefs), info

    def gaussian(carried: Window) -> Gaussian:
        def body(after: Gaussian, row: tuple[Gaussian, Link]) -> tuple[Gaussian, None]:
            before, link = row
            return back(space, before, link, after)[0], None

        earlier = jax.tree.map(lambda a: a[:-1], carried.beliefs)
        return jax.lax.scan(body, at(carried.beliefs, -1), (earlier, carried.links), reverse=True)[0]

    return Filter(predict, update, stepper(model, predict, update), model, begin, gaussian)


def _pushed(tree: PyTree, newest: PyTree) -> PyTree:
    """The newest at the end, the oldest gone."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]])[1:], tree, newest)


def _window(given: Window, like: Window) -> Window:
    doors.alike("carried", given, like)
    doors.floating("carried.beliefs", given.beliefs)
    dtype = jax.dtypes.canonicalize_dtype(given.beliefs.cov.dtype)
    doors.same_dtype(dtype, **{"carried.beliefs": given.beliefs, "carried.links": given.links})
    return jax.tree.map(jnp.asarray, given)
