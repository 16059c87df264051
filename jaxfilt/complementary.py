"""The baselines of the lectures, with the interface of a filter: complementary filter for attitude, dead reckoning.

Both are tuples of pure functions over a model, as the Kalman filters are: `jaxfilt.scan`, `scan_runs`, studies and
replays take them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import doors
from jaxfilt.correction import image, nothing
from jaxfilt.elementary import bearing, norm
from jaxfilt.prediction import advanced, branch, canonical, interval, kalman, predictor, transitioner
from jaxfilt.spaces import rotate, rotate_back, so3, so3_log
from jaxfilt.transforms import taylor
from jaxfilt.types import Array, Filter, Gaussian, Info, Model, PyTree, Sensor, Status


def complementary(
    model: Model,
    share: Mapping[str, Array | float],
    integral: Mapping[str, Array | float] | None = None,
    heading: Collection[str] = ("magnetometer",),
) -> Filter:
    """Complementary filter: the gyroscope integrated, each reading pulls the attitude by a fixed share towards itself.

    The lecture's ``angle = alpha (angle + dt rate) + (1 - alpha) angle of the accelerometer``, on SO(3) and so at any
    attitude: with the reading z of a vector (3,) that should be seen as h(x), ``q' = q Exp(share e)`` and
    ``b' = b - integral e``, where e (rad, body) is the smallest turn that brings z onto h(x). A sensor of the heading
    turns about the vertical only, by the angle between the horizontal parts of the two, so that a disturbed field does
    not tilt the attitude. At a steady rate 1/dt a share is ``1 - alpha``, a time constant of ``dt / share`` s; Mahony's
    k_P is ``share / dt`` and his k_I ``integral / dt``. Q and R are not used.

    It has no covariance: that of its belief is 0 from the first step on, whatever it starts with. Info has the
    innovation, and S, nis, loglik and dof 0, as of a reading that tells nothing about consistency: means of NEES and
    NIS are NaN, a replay or a study scores its errors and otherwise finds nothing to judge by.

    Args:
        model: of a state with a field ``att`` (4,), a quaternion, and, with an integral, ``gyro_bias`` (3,) rad/s: of
            `jaxfilt.models.attitude` or, its gyroscope the input, any other.
        share: sensor -> share of the turn that one reading is followed by, 0 to 1. Sensors that are not named are not
            heard.
        integral: sensor -> 1/s, how much of the turn is taken for bias; None: the bias stays as it was believed.
        heading: sensors, if they are there, that turn about the vertical only.

    Returns:
        Filter(predict, update, step, model).

    Raises:
        KeyError: a sensor that the model lacks, or an integral of one that has no share.
        ValueError: a sensor of anything but a vector (3,), a state without the fields, a share that is not 0 to 1.

    Example: a tilt of 0.1 rad that nobody believed, a tenth of it taken over.
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> from jaxfilt.models.attitude import attitude, hand_held_start
        >>> filt = complementary(attitude(), {"accelerometer": 0.1})
        >>> seen = jf.rotate_back(jf.so3_exp(jnp.array([0.1, 0.0, 0.0])), jnp.array([0.0, 0.0, 9.81]))
        >>> belief, _ = filt.update(hand_held_start(), seen, "accelerometer")
        >>> [round(float(a), 4) + 0.0 for a in jf.so3_log(belief.mean.att)]
        [0.01, 0.0, 0.0]

    Source: R. Mahony, T. Hamel, J.-M. Pflimlin, Nonlinear complementary filters on the special orthogonal group, IEEE
    Trans. Automatic Control 53(5) (2008), eq. 32, the explicit filter, with the whole angle where it has its sine.
    """
    _checked(model, share, integral or {})

    def predict(belief: Gaussian, u: PyTree = (), dt: Array | float = 0.0) -> Gaussian:
        belief = _without_covariance(belief, model)
        doors.inputs("u", u, belief.cov.dtype)
        moves, dt = interval(dt, belief)

        def on(b: Gaussian) -> Gaussian:
            return b._replace(mean=advanced(model, b.mean, u, dt, b.cov.dtype))

        return branch(moves, on, lambda b: b, belief)

    def update(
        belief: Gaussian, z: PyTree, sensor: str, c: PyTree = (), mask: Array | None = None
    ) -> tuple[Gaussian, Info]:
        belief = _without_covariance(belief, model)
        found, dtype = doors.sensor(model, sensor), belief.cov.dtype
        silent = nothing(found.space.dim, dtype)
        if sensor not in share:
            return belief, silent
        doors.point(f"z[{sensor!r}]", z, found.space)
        doors.finite(f"z[{sensor!r}]", z)
        doors.same_dtype(dtype, **{f"z[{sensor!r}]": z})
        name, x = f"h(x, c) of sensor {sensor!r}", belief.mean
        expected = image(name, doors.call(name, found.h, x=x, c=c), found.space, dtype)
        turn = _heading(x.att, z, expected) if sensor in heading else _smallest_turn(z, expected)
        moved = x._replace(att=so3.plus(x.att, jnp.asarray(share[sensor], dtype) * turn))
        if integral and sensor in integral:
            moved = moved._replace(gyro_bias=x.gyro_bias - jnp.asarray(integral[sensor], dtype) * turn)
        told = _told(found, x, moved, z, expected, silent)
        if mask is None:
            return belief._replace(mean=moved), told
        doors.mask(f"mask of {sensor!r}", mask, (found.space.dim,))
        there = jnp.asarray(mask).all()  # a direction of which a component is missing is none
        kept = jax.tree.map(lambda new, old: jnp.where(there, new, old), (moved, told), (x, silent))
        return belief._replace(mean=kept[0]), kept[1]

    return kalman(model, predict, update, None)


def dead_reckoning(model: Model) -> Filter:
    """A filter that hears nothing: what the inputs alone are worth, with the covariance that an `ekf` predicts.

    Every sensor is reported as absent. `jaxfilt.recordings.dead_reckoning` silences a log instead, for any filter.

    Args:
        model: the robot.

    Example:
        >>> import jax.numpy as jnp, jaxfilt as jf
        >>> walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> log = jf.Log(jnp.ones(3), (), {"z": jnp.ones((3, 1))}, {}, {})
        >>> belief = jf.scan(dead_reckoning(walk), jf.Gaussian(jnp.zeros(1), jnp.eye(1)), log).belief
        >>> belief.mean[:, 0].tolist(), belief.cov[:, 0, 0].tolist()
        ([0.0, 0.0, 0.0], [2.0, 3.0, 4.0])
    """
    doors.instance("model", model, Model)

    predict = predictor(taylor, model)

    def update(
        belief: Gaussian, z: PyTree, sensor: str, c: PyTree = (), mask: Array | None = None
    ) -> tuple[Gaussian, Info]:
        return belief, nothing(doors.sensor(model, sensor).space.dim, belief.cov.dtype)

    return kalman(model, predict, update, transitioner(taylor, model))


def _checked(model: Model, share: Mapping[str, Array | float], integral: Mapping[str, Array | float]) -> None:
    doors.instance("model", model, Model)
    fields = ("att", "gyro_bias") if integral else ("att",)
    if missing := [name for name in fields if not hasattr(model.space.origin, name)]:
        raise ValueError(
            f"model: expected a state with {' and '.join(fields)}, got none of {missing} in {model.space.origin}"
        )
    for name, value in share.items():
        if jax.tree.map(np.shape, doors.sensor(model, name).space.origin) != (3,):
            raise ValueError(f"share: expected sensors of a vector (3,), got {name!r}")
        if doors.is_concrete(value) and not 0 <= float(value) <= 1:
            raise ValueError(f"share[{name!r}]: expected 0 to 1, got {value}")
    if strangers := set(integral) - set(share):
        raise KeyError(f"integral: expected sensors that have a share, {list(share)}, got {sorted(strangers)}")


def _without_covariance(belief: Gaussian, model: Model) -> Gaussian:
    belief = canonical(belief, model.space)
    return belief._replace(cov=jnp.zeros_like(belief.cov))


def _smallest_turn(z: Array, expected: Array) -> jax.Array:
    """The rotation vector (3,) of the smallest turn that brings z onto another vector; 0 where that is the opposite, or
    one of them nothing."""
    q = jnp.concatenate([(norm(z) * norm(expected) + z @ expected)[None], jnp.cross(z, expected)])
    known = q @ q > 0
    return jnp.where(known, so3_log(jnp.where(known, q, jnp.asarray(so3.origin, q.dtype))), 0.0)


def _heading(att: Array, z: Array, expected: Array) -> jax.Array:
    """The rotation vector (3,), body, of the turn about the vertical that brings z into the direction of another."""
    (ax, ay, _), (bx, by, up) = rotate(att, z), rotate(att, expected)
    turn = bearing(jnp.stack([ax * bx + ay * by, ax * by - ay * bx]))
    return rotate_back(att, jnp.stack([jnp.zeros_like(up), jnp.zeros_like(up), turn]))


def _told(sensor: Sensor, x: PyTree, moved: PyTree, z: Array, expected: Array, silent: Info) -> Info:
    """What is reported of a reading that was heard: its innovation, and nothing that would need a covariance."""
    status = jnp.int32(Status.OK)
    for tree, code in (
        (moved, Status.BAD_POSTERIOR),
        (expected, Status.BAD_PREDICTION),
        (z, Status.BAD_MEASUREMENT),
        (x, Status.BAD_BELIEF),
    ):
        finite = jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)]).all()
        status = jnp.where(finite, status, jnp.int32(code))
    return silent._replace(innovation=sensor.space.minus(z, expected), status=status)
