"""The laws of + and -, and rotations against scipy's: values and derivatives both ways, near zero and near pi."""

import itertools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxfilt as jf
from jaxfilt.spaces import quaternion_conjugate, quaternion_product

DTYPES = pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["float32", "float64"])


def is_space(x: Any) -> bool:
    return isinstance(x, jf.Space)


class Pose(NamedTuple):
    pos: Any
    att: Any


class Body(NamedTuple):
    pose: Any
    bias: Any
    arms: Any


TREES = {
    "vector": jf.vector(3),
    "scalar": jf.scalar,
    "angle": jf.angle,
    "so2": jf.so2,
    "so3": jf.so3,
    "tuple": (jf.so2, jf.vector(2), jf.angle),
    "nested": Body(Pose(jf.vector(2), jf.so3), {"gyro": jf.vector(3), "clock": jf.scalar}, (jf.angle, jf.so2)),
}
ALL = pytest.mark.parametrize("tree", TREES.values(), ids=TREES.keys())
SINGLE = pytest.mark.parametrize("space", [s for s in TREES.values() if is_space(s)], ids=list(TREES)[:5])
NEAR_PI = {jnp.float32: [1e-3, 1e-5], jnp.float64: [1e-3, 1e-6, 1e-9]}
"""How close to half a turn a sum may come without rounding taking it over."""


def tangents(dim: int, dtype) -> np.ndarray:
    """Random directions and axes, with lengths of zero, tiny, on both sides of every switch, close to half a turn."""
    rng = np.random.default_rng(dim)
    directions = np.concatenate([rng.normal(size=(4, dim)), np.eye(dim)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths = [0.0, 1e-30, 1e-9, 1e-6, 1e-3, 0.2, 0.28, 0.3, 0.9999, 1.0001, 1.4142, 3.0]
    lengths += [math.pi - gap for gap in NEAR_PI[dtype]]
    return np.array([r * d for r, d in itertools.product(lengths, directions)]).astype(dtype)


def long_tangents(dtype) -> np.ndarray:
    """Half a turn and more, about any axis."""
    directions = tangents(3, dtype)[7 * 8 : 7 * 9]
    return np.concatenate([r * directions for r in (math.pi, 3.2, 5.0, 6.28)]).astype(dtype)


def points(space: jf.Space, count: int, dtype) -> Any:
    """Some points of the space, far and wide."""
    d = 2.0 * np.random.default_rng(7).normal(size=(count, space.dim)).astype(dtype)
    origin = jax.tree.map(lambda a: jnp.asarray(a, dtype), space.origin)
    return jax.jit(jax.vmap(lambda d: space.plus(space.plus(origin, d), d[::-1])))(d)


def seamless(tree: Any, x: Any) -> list[np.ndarray]:
    """The point as numbers without a seam: angles as cos and sin, quaternions as products of two components."""
    spaces, structure = jax.tree.flatten(tree, is_leaf=is_space)
    leaves = []
    for space, leaf in zip(spaces, structure.flatten_up_to(x), strict=True):
        a = np.asarray(leaf, float)
        if space is jf.angle:
            a = np.stack([np.cos(a), np.sin(a)])
        if space is jf.so3:
            a = a[..., :, None] * a[..., None, :]
        leaves.append(a)
    return leaves


def assert_same_point(tree: Any, a: Any, b: Any, atol: float) -> None:
    for x, y in zip(seamless(tree, a), seamless(tree, b), strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=atol)


def slack(dtype) -> float:
    """Rounding of numbers up to about 10 in size."""
    return 100 * float(jnp.finfo(dtype).eps)


@DTYPES
@ALL
def test_the_axioms(tree, dtype):
    """plus(b, 0) = b, minus(plus(b, d), b) = d, plus(b, minus(a, b)) = a."""
    space = jf.product(tree)
    d = tangents(space.dim, dtype)
    b = points(space, len(d), dtype)

    @jax.jit
    @jax.vmap
    def laws(b, d):
        a = space.plus(b, d)
        return space.plus(b, jnp.zeros_like(d)), a, space.minus(a, b), space.plus(b, space.minus(a, b))

    same, a, back, again = laws(b, d)
    assert jax.tree.structure(a) == jax.tree.structure(tree, is_leaf=is_space)
    assert {leaf.dtype for leaf in jax.tree.leaves((a, back))} == {np.dtype(dtype)}
    assert_same_point(tree, same, b, slack(dtype))
    assert_same_point(tree, again, a, slack(dtype))
    np.testing.assert_allclose(back, d, rtol=0, atol=slack(dtype))


@DTYPES
@SINGLE
def test_their_derivatives(space, dtype):
    """The derivative of minus(plus(b, d), b) with respect to d is the identity, forward and in reverse."""
    d = tangents(space.dim, dtype)
    b = points(space, len(d), dtype)

    @jax.jit
    @jax.vmap
    def jacobians(b, d):
        def difference(d):
            return space.minus(space.plus(b, d), b)

        return jax.jacfwd(difference)(d), jax.jacrev(difference)(d)

    for J in jacobians(b, d):
        np.testing.assert_allclose(J, np.broadcast_to(np.eye(space.dim), J.shape), rtol=0, atol=slack(dtype))


@DTYPES
def test_half_a_turn_and_more(dtype):
    """plus(b, minus(a, b)) = a still holds, and no derivative is NaN."""
    for tree, d in [(s, long_tangents(dtype)[:, : s.dim]) for s in (jf.so3, jf.so2, jf.angle)]:
        b = points(tree, len(d), dtype)
        a = jax.jit(jax.vmap(tree.plus))(b, d)
        difference, slope = jax.jit(jax.vmap(lambda a, b, s=tree: (s.minus(a, b), jax.jacrev(s.minus)(a, b))))(a, b)
        assert_same_point(tree, jax.jit(jax.vmap(tree.plus))(b, difference), a, slack(dtype))
        assert (np.linalg.norm(difference, axis=1) <= math.pi + slack(dtype)).all()
        assert np.isfinite(slope).all()


@ALL
def test_flat_says_whether_tangents_add_up(tree):
    space = jf.product(tree)
    rng = np.random.default_rng(3)
    d, e = rng.normal(size=(2, 20, space.dim))
    x = points(space, 20, jnp.float64)
    in_turn, at_once = jax.jit(jax.vmap(lambda x, d, e: (space.plus(space.plus(x, d), e), space.plus(x, d + e))))(
        x, d, e
    )
    gap = max(np.abs(a - b).max() for a, b in zip(seamless(tree, in_turn), seamless(tree, at_once), strict=True))
    assert (gap < 1e-13) == space.flat
    assert space.flat or gap > 0.1


@pytest.mark.parametrize("space", [jf.angle, jf.so2], ids=["angle", "so2"])
def test_second_derivatives_at_zero(space):
    """Reverse over forward, as the gradient of an EKF takes them: of the identity they vanish."""
    b = jax.tree.map(lambda a: a[0], points(space, 1, jnp.float64))
    second = jax.jit(jax.vmap(jax.jacrev(jax.jacfwd(lambda d: space.minus(space.plus(b, d), b)))))
    np.testing.assert_allclose(second(np.array([[0.0], [1e-9], [1e-3]])), 0, atol=1e-12)


# Rotations, against scipy


def scipy_rotation(q: Any) -> Rotation:
    return Rotation.from_quat(np.asarray(q, float), scalar_first=True)


def scipy_quaternion(d: np.ndarray) -> np.ndarray:
    """With w >= 0, except where the rotation is by more than half a turn: scipy's own sign."""
    return Rotation.from_rotvec(d).as_quat(scalar_first=True)


def random_quaternions(count: int, dtype) -> np.ndarray:
    q = np.random.default_rng(1).normal(size=(count, 4))
    return (q / np.linalg.norm(q, axis=1, keepdims=True)).astype(dtype)


def central_difference(f, x: np.ndarray, h: float = 1e-6) -> np.ndarray:
    """The Jacobian of a function of arrays (N, n), row by row: (N, m, n)."""
    steps = h * np.eye(x.shape[1])
    return np.stack([(f(x + step) - f(x - step)) / (2 * h) for step in steps], axis=-1)


@DTYPES
def test_exp_is_scipys(dtype):
    d = np.concatenate([tangents(3, dtype), long_tangents(dtype)])
    q, forward, reverse = jax.jit(
        jax.vmap(lambda d: (jf.so3_exp(d), jax.jacfwd(jf.so3_exp)(d), jax.jacrev(jf.so3_exp)(d)))
    )(d)
    assert q.dtype == dtype
    wide = d.astype(float)
    np.testing.assert_allclose(q, scipy_quaternion(wide), atol=slack(dtype) / 10)
    J = central_difference(scipy_quaternion, wide)
    np.testing.assert_allclose(forward, J, atol=max(1e-9, slack(dtype)))
    np.testing.assert_allclose(reverse, J, atol=max(1e-9, slack(dtype)))


@DTYPES
def test_log_is_scipys(dtype):
    d = np.concatenate([tangents(3, dtype), np.random.default_rng(0).normal(size=(20, 3)).astype(dtype)])
    q = scipy_quaternion(d.astype(float)).astype(dtype)
    back, forward, reverse = jax.jit(
        jax.vmap(lambda q: (jf.so3_log(q), jax.jacfwd(jf.so3_log)(q), jax.jacrev(jf.so3_log)(q)))
    )(q)
    np.testing.assert_allclose(back, scipy_rotation(q).as_rotvec(), atol=slack(dtype) / 10)
    clear = np.abs(q[:, 0]) > 1e-5  # of half a turn, where a finite difference would step over the cut
    J = central_difference(lambda q: scipy_rotation(q).as_rotvec(), q.astype(float))
    np.testing.assert_allclose(forward[clear], J[clear], atol=max(2e-8, slack(dtype)))
    np.testing.assert_allclose(reverse, forward, atol=slack(dtype))
    assert np.isfinite(forward).all()


@DTYPES
def test_minus_and_plus_are_scipys(dtype):
    a, b = random_quaternions(60, dtype).reshape(2, 30, 4)
    d = jax.jit(jax.vmap(jf.so3.minus))(a, b)
    want = (scipy_rotation(b).inv() * scipy_rotation(a)).as_rotvec()
    np.testing.assert_allclose(d, want, atol=slack(dtype))
    moved = jax.jit(jax.vmap(jf.so3.plus))(b, d)
    np.testing.assert_allclose(scipy_rotation(moved).as_matrix(), scipy_rotation(a).as_matrix(), atol=slack(dtype))


@DTYPES
def test_q_and_minus_q_are_one_rotation(dtype):
    a, b = random_quaternions(60, dtype).reshape(2, 30, 4)
    a = np.concatenate([a, [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0.6, 0, -0.8]]]).astype(dtype)
    b = np.concatenate([b, np.tile([1, 0, 0, 0], (3, 1))]).astype(dtype)
    minus = jax.jit(jax.vmap(lambda a, b: (jf.so3.minus(a, b), jax.jacrev(jf.so3.minus)(a, b))))
    for signs in [(-1, 1), (1, -1), (-1, -1)]:
        (d, J), (e, K) = minus(a, b), minus(dtype(signs[0]) * a, dtype(signs[1]) * b)
        half_turn = np.linalg.norm(d, axis=1) > 3.14159
        np.testing.assert_allclose(e[~half_turn], d[~half_turn], atol=slack(dtype))
        np.testing.assert_allclose(np.abs(e), np.abs(d), atol=slack(dtype))
        np.testing.assert_allclose(signs[0] * K[~half_turn], J[~half_turn], atol=slack(dtype))
        assert np.isfinite(K).all()


def skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def inverse_right_jacobian(d: np.ndarray) -> np.ndarray:
    """Of Sola et al., A micro Lie theory (2018), eq. 144."""
    r = np.linalg.norm(d)
    c = 1 / 12 + r**2 / 720 if r < 1e-2 else 1 / r**2 - 1 / (2 * r * np.tan(r / 2))
    return np.eye(3) + skew(d) / 2 + c * skew(d) @ skew(d)


@DTYPES
def test_the_derivative_of_a_sum_of_rotations(dtype):
    """D minus(plus(plus(b, d), e), b) with respect to e at 0 is the inverse right Jacobian of d; likewise the reset."""
    d = tangents(3, dtype)
    b = random_quaternions(len(d), dtype)

    @jax.jit
    @jax.vmap
    def derivatives(b, d):
        def sum_(e):
            return jf.so3.minus(jf.so3.plus(jf.so3.plus(b, d), e), b)

        def reset(e):
            return jf.so3.minus(jf.so3.plus(b, e), jf.so3.plus(b, d))

        return jax.jacfwd(sum_)(jnp.zeros_like(d)), jax.jacrev(reset)(d)

    want = np.stack([inverse_right_jacobian(row) for row in d.astype(float)])
    sums, resets = derivatives(b, d)
    np.testing.assert_allclose(sums, want, atol=slack(dtype))
    np.testing.assert_allclose(resets, np.linalg.inv(want), atol=2 * slack(dtype))


def test_the_second_derivative_of_a_sum_of_rotations_at_zero():
    """The derivative of the inverse right Jacobian I + [d]/2 + [d]^2/12 ... at d = 0 is [e_k]/2."""
    b = random_quaternions(1, np.float64)[0]

    def jacobian(d):
        return jax.jacfwd(lambda e: jf.so3.minus(jf.so3.plus(jf.so3.plus(b, d), e), b))(jnp.zeros(3))

    weights = np.random.default_rng(5).normal(size=(3, 3))
    slope = jax.jit(jax.vmap(jax.grad(lambda d: jnp.sum(weights * jacobian(d)))))
    want = [np.sum(weights * skew(e)) / 2 for e in np.eye(3)]
    d = np.array([[0, 0, 0], [1e-9, 0, -1e-9], [1e-6, 1e-6, 0]])
    np.testing.assert_allclose(slope(d), np.broadcast_to(want, (3, 3)), atol=2e-6)
    np.testing.assert_allclose(slope(d)[0], want, atol=1e-15)


@DTYPES
def test_products_and_rotated_vectors(dtype):
    p, q = random_quaternions(40, dtype).reshape(2, 20, 4)
    v = np.random.default_rng(2).normal(size=(20, 3)).astype(dtype)
    P, Q = scipy_rotation(p), scipy_rotation(q)
    pq, Rv, back, inverse = jax.jit(
        jax.vmap(
            lambda p, q, v: (quaternion_product(p, q), jf.rotate(p, v), jf.rotate_back(p, v), quaternion_conjugate(p))
        )
    )(p, q, v)
    np.testing.assert_allclose(scipy_rotation(pq).as_matrix(), (P * Q).as_matrix(), atol=slack(dtype))
    np.testing.assert_allclose(Rv, P.apply(v), atol=slack(dtype))
    np.testing.assert_allclose(back, P.inv().apply(v), atol=slack(dtype))
    np.testing.assert_allclose(scipy_rotation(inverse).as_matrix(), P.inv().as_matrix(), atol=slack(dtype))


def test_the_perturbation_is_on_the_right_in_the_body_frame():
    quarter_about_z = jf.so3_exp(jnp.array([0, 0, math.pi / 2]))
    moved = jf.so3.plus(quarter_about_z, jnp.array([math.pi / 2, 0, 0]))
    np.testing.assert_allclose(jf.rotate(moved, jnp.array([0.0, 1.0, 0.0])), [0, 0, 1], atol=1e-15)


@DTYPES
def test_ten_thousand_small_turns_stay_on_the_unit_sphere(dtype):
    turn = jnp.asarray([1e-3, -2e-3, 3e-3], dtype)
    heading = jnp.asarray([3e-3], dtype)

    def body(x, _):
        return (jf.so3.plus(x[0], turn), jf.so2.plus(x[1], heading)), None

    start = jnp.asarray([1.0, 0, 0, 0], dtype), jnp.asarray([1.0, 0], dtype)
    (q, c), _ = jax.jit(lambda x: jax.lax.scan(body, x, None, length=10_000))(start)
    assert abs(float(jnp.linalg.norm(q)) - 1) < 2 * float(jnp.finfo(dtype).eps)
    assert abs(float(jnp.linalg.norm(c)) - 1) < 2 * float(jnp.finfo(dtype).eps)
    want = Rotation.from_rotvec(1e4 * np.array([1e-3, -2e-3, 3e-3])).as_matrix()
    np.testing.assert_allclose(scipy_rotation(q).as_matrix(), want, atol=3e-3 if dtype == jnp.float32 else 1e-11)


@DTYPES
def test_a_heading_as_a_unit_vector_is_the_heading_as_an_angle(dtype):
    x, y = np.random.default_rng(4).uniform(-3.1, 3.1, size=(2, 30)).astype(dtype)
    by_angle = jax.vmap(jf.angle.minus)(x, y)
    by_vector = jax.vmap(jf.so2.minus)(np.stack([np.cos(x), np.sin(x)], 1), np.stack([np.cos(y), np.sin(y)], 1))
    np.testing.assert_allclose(by_vector, by_angle, atol=slack(dtype))
    assert (np.abs(by_angle) <= math.pi + slack(dtype)).all()


def test_the_tangent_of_a_product_is_in_the_order_of_its_leaves():
    space = jf.product({"b": jf.scalar, "a": jf.vector(2), "c": (jf.angle,)})
    assert space.dim == 4
    x = space.plus({"a": jnp.zeros(2), "b": jnp.zeros(()), "c": (jnp.zeros(()),)}, jnp.array([1.0, 2.0, 3.0, 0.5]))
    assert x["a"].tolist() == [1, 2]
    assert x["b"] == 3
    assert x["c"][0] == 0.5


def test_complaints():
    with pytest.raises(ValueError, match=r"vector\(n\): expected n >= 1, got 0"):
        jf.vector(0)
    with pytest.raises(TypeError, match=r"product\(tree\): expected a pytree of Space at its leaves, got \[3\]"):
        jf.product({"a": jf.scalar, "n": 3})
    with pytest.raises(TypeError, match=r"product\(tree\): expected a pytree of Space at its leaves, got \(\)"):
        jf.product(())
