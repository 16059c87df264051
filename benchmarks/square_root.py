"""Whether single precision needs a square-root form: ``python -m benchmarks.square_root`` prints two tables.

First an update that is ill-conditioned by construction, three states seen twice by almost the same combination
(H = [1 1 1; 1 1 1+d], R = d^2 I, P = I): with d = 1e-4 in float32 and 1e-9 in float64 S is singular to rounding. Then
long runs in float32 beside the same in float64, on the same readings: what rounding does to errors, covariances and
NEES. The product form is the library's; the others are of a book, in NumPy and the same precision: the short form
(I - K H) P, Joseph's, and QR of the square roots, kept as a root, which is what a square-root filter would do; "exact,
rounded" is the best that anything kept as a covariance can do. Minutes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mpmath import mp

import jaxfilt as jf
from jaxfilt.scenarios import SCENARIOS

UPDATES = ((np.float32, 1e-2), (np.float32, 1e-3), (np.float32, 1e-4), (np.float64, 1e-6), (np.float64, 1e-9))
"""Precision, and d."""

LONG = (
    "two-wheeled",
    "pendulum",
    "gps-robot",
    "hidden-bias",
    "unicycle",
    "attitude",
    "multirotor",
    "inertial",
    "inertial-gnss",
)
"""Scenarios of the long runs."""

STEPS, RUNS, EACH = 20_000, 4, 20
"""Rows, runs, and rows to each one that is judged."""


def problem(dtype: Any, d: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """P, H and R, rounded to this precision."""
    H = np.array([[1, 1, 1], [1, 1, 1 + d]], dtype)
    return np.eye(3, dtype=dtype), H, np.diag(np.full(2, d * d)).astype(dtype)


DIRECTIONS = np.array([[1, 1, 1], [0, 0, 1]])
"""The one that was measured twice, and the one that the difference of the two readings tells of."""


def exactly(P: np.ndarray, H: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The covariance after the update of these very numbers, and its variances along the directions; in 100 digits."""
    with mp.workdps(100):
        prior, map, noise = (mp.matrix(M.tolist()) for M in (P, H, R))
        after = prior - prior * map.T * (map * prior * map.T + noise) ** -1 * map * prior
        along = [(mp.matrix([v.tolist()]) * after * mp.matrix(v.tolist()))[0] for v in DIRECTIONS]
        return np.array(after.tolist(), float), np.array(along, float)


def short(P: np.ndarray, H: np.ndarray, R: np.ndarray) -> np.ndarray:
    """(I - K H) P."""
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return (np.eye(3, dtype=P.dtype) - K @ H) @ P


def joseph(P: np.ndarray, H: np.ndarray, R: np.ndarray) -> np.ndarray:
    """(I - K H) P (I - K H)' + K R K', with the gain as in `short`."""
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    A = np.eye(3, dtype=P.dtype) - K @ H
    return A @ P @ A.T + K @ R @ K.T


def square_root(P: np.ndarray, H: np.ndarray, R: np.ndarray) -> np.ndarray:
    """QR of [[R^1/2, H P^1/2], [0, P^1/2]]': the array form; the root is squared in float64."""
    root = np.linalg.cholesky(P)
    array = np.block([[np.sqrt(R), H @ root], [np.zeros((3, 2), P.dtype), root]])
    _, root = np.linalg.qr(array.T)
    after = root.T[2:, 2:].astype(float)
    return after @ after.T


def rounded(P: np.ndarray, H: np.ndarray, R: np.ndarray) -> np.ndarray:
    """The right answer, stored as a covariance."""
    return exactly(P, H, R)[0].astype(P.dtype)


def product(P: np.ndarray, H: np.ndarray, R: np.ndarray) -> np.ndarray:
    """The library's update."""
    model = jf.linear(np.eye(3, dtype=P.dtype), H, np.eye(3, dtype=P.dtype), R)
    belief = jf.Gaussian(np.zeros(3, P.dtype), P)
    after, _ = jax.jit(lambda b, z: jf.kf(model).update(b, z, "z"))(belief, np.zeros(2, P.dtype))
    return np.asarray(after.cov)


FORMS: dict[str, Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]] = {
    "short": short,
    "Joseph": joseph,
    "QR, a root": square_root,
    "exact, rounded": rounded,
    "jaxfilt": product,
}


def judged(P: np.ndarray, want: np.ndarray, along: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Largest error and least eigenvalue, over the largest variance; variances along the directions over the true."""
    P = np.asarray(P, float)
    size = float(np.abs(want).max())
    lowest = float(np.linalg.eigvalsh(0.5 * (P + P.T))[0]) if np.isfinite(P).all() else np.nan
    return (
        float(np.abs(P - want).max()) / size,
        lowest / size,
        np.einsum("ki,ij,kj->k", DIRECTIONS, P, DIRECTIONS) / along,
    )


def compared(name: str, steps: int, runs: int) -> tuple[float, float, float, float, float]:
    """A scenario in float32 beside float64.

    Returns the largest difference of a standard deviation, relative; the 99.9 % quantile of the difference of means, in
    standard deviations; NEES over its dimension in float64 and in float32; the share of beliefs that are unsound.
    """
    scene = SCENARIOS[name]()
    schedule = jax.tree.map(jnp.asarray, scene.schedule(steps))
    theta = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), scene.theta)
    space = scene.model(theta).space

    def simulated(key: Any) -> Any:
        return jf.simulate(scene.model(theta), scene.belief(theta), schedule, key, scene.control)

    truth, logs = jax.jit(jax.vmap(simulated))(jax.random.split(jax.random.key(7), runs))

    def filtered(dtype: Any) -> jf.Gaussian:
        cast = lambda tree: jax.tree.map(  # noqa: E731
            lambda a: a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a, tree
        )
        given = cast(theta), cast(logs)

        def one(theta: Any, log: jf.Log) -> jf.Gaussian:
            start = cast(jax.tree.map(jnp.asarray, scene.belief(theta)))
            return jf.scan(jf.ekf(scene.model(theta)), start, log, lambda b, info: b)

        found = jax.jit(jax.vmap(one, (None, 0)))(*given)
        return jax.tree.map(lambda a: a.astype(jnp.float64), found)

    def judge(x: Any, single: jf.Gaussian, double: jf.Gaussian) -> tuple:
        std = jnp.sqrt(jnp.diagonal(double.cov))
        known = std > 0
        unit = jnp.where(known, std, 1.0)
        spread = jnp.abs(jnp.sqrt(jnp.maximum(jnp.diagonal(single.cov), 0.0)) / unit - 1)
        off = jnp.abs(space.minus(single.mean, double.mean)) / unit
        nees = [_nees(space, x, b) for b in (double, single)]
        sound = jnp.isfinite(single.cov).all() & (jnp.diagonal(single.cov) >= 0).all()
        return jnp.where(known, spread, 0.0).max(), jnp.where(known, off, 0.0).max(), *nees, ~sound

    thinned = jax.tree.map(lambda a: a[:, ::EACH], (truth, filtered(jnp.float32), filtered(jnp.float64)))
    found = jax.jit(jax.vmap(jax.vmap(judge)))(*thinned)
    spread, off, double, single, unsound = (np.asarray(a) for a in found)
    worst = float(np.nanmax(spread)), float(np.nanquantile(off, 0.999))
    return *worst, float(double.mean()) / space.dim, float(single.mean()) / space.dim, float(unsound.mean())


def _nees(space: jf.Space, x: Any, b: jf.Gaussian) -> jax.Array:
    e = space.minus(x, b.mean)
    std = jnp.sqrt(jnp.diagonal(b.cov))
    unit = jnp.where(std > 0, std, 1.0)
    return (e / unit) @ jnp.linalg.pinv(b.cov / (unit[:, None] * unit), rtol=1e-12) @ (e / unit)


def main() -> None:
    """Print the tables."""
    jax.config.update("jax_enable_x64", True)
    print("| precision, d | form | error | least eigenvalue | variance of (1, 1, 1) | of (0, 0, 1) |")
    print("|---|---|---|---|---|---|")
    for dtype, d in UPDATES:
        given = problem(dtype, d)
        for form, update in FORMS.items():
            try:
                after = update(*given)
            except np.linalg.LinAlgError:
                after = np.full((3, 3), np.nan)
            error, lowest, along = judged(after, *exactly(*given))
            factors = f"x {along[0]:.3g} | x {along[1]:.3g}"
            print(f"| {np.dtype(dtype).name}, {d:g} | {form} | {error:.1e} | {lowest:.1e} | {factors} |")
    print(f"\n{RUNS} runs of {STEPS:,} rows, float32 beside float64:\n")
    print("| scenario | std off by | mean off by, std (99.9 %) | NEES / n float64 | float32 | unsound |")
    print("|---|---|---|---|---|---|")
    for name in LONG:
        spread, off, double, single, unsound = compared(name, STEPS, RUNS)
        print(f"| {name} | {spread:.1e} | {off:.1e} | {double:.3f} | {single:.3f} | {unsound:.1%} |", flush=True)


if __name__ == "__main__":
    main()
