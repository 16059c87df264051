"""Kalman filters as the books print them: plain NumPy loops, to hold the library against. Nothing here knows JAX.

A `Book` is a model with its Jacobians worked out by hand. Its points are whatever its own plus and minus take (an
attitude is a rotation matrix here), its rows plain dicts. Every formula is the textbook's form, not the library's:
covariances by the difference ``P - K S K'``, missing components by striking rows out of H and R, densities by SciPy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import multivariate_normal

Point = Any


class BookSensor(NamedTuple):
    """``z = h(x, c) + v``; ``H(x, c)`` (m, n) its Jacobian; plus and minus of readings; a reading from a log's row."""

    h: Callable
    H: Callable
    R: Callable
    plus: Callable
    minus: Callable
    read: Callable


class Book(NamedTuple):
    """``x' = f(x, u, dt) + w``; ``F`` (n, n) its Jacobian; ``carry(d)`` (n, n) the derivative of an error written at
    ``plus(x, d)`` by the same error written at x: the identity where nothing is curved."""

    f: Callable
    F: Callable
    Q: Callable
    plus: Callable
    minus: Callable
    carry: Callable
    sensors: dict[str, BookSensor]


class Result(NamedTuple):
    """What a loop kept: the point and the covariance after each row, and the log-likelihood of each row."""

    means: list
    covs: np.ndarray
    logliks: np.ndarray


class Row(NamedTuple):
    """One instant: an interval, an input, and sensor -> (reading, context, which components were seen)."""

    dt: float
    u: np.ndarray
    readings: dict[str, tuple]


def loop(book: Book, x: Point, P: np.ndarray, rows: list[Row], predict: Callable, correct: Callable) -> Result:
    """Predict over each row's interval, nothing in no time; then one correction for each sensor that spoke."""
    means, covs, logliks = [], [], []
    for row in rows:
        if row.dt > 0:
            x, P = predict(book, x, P, row.u, row.dt)
        total = 0.0
        for name, sensor in book.sensors.items():
            if name in row.readings:
                z, c, seen = row.readings[name]
                x, P, loglik = correct(book, sensor, x, P, z, c, seen)
                total += loglik
        means.append(x)
        covs.append(P)
        logliks.append(total)
    return Result(means, np.array(covs), np.array(logliks))


def no_carry(d: np.ndarray) -> np.ndarray:
    """Carry of a flat space."""
    return np.eye(len(d))


def log_density(r: np.ndarray, S: np.ndarray) -> float:
    """log N(r; 0, S)."""
    return float(multivariate_normal.logpdf(r, cov=S))  # pyright: ignore[reportArgumentType]


def ekf_predict(book: Book, x: Point, P: np.ndarray, u: np.ndarray, dt: float) -> tuple:
    """Sarkka (2013), eq. 5.39."""
    F = book.F(x, u, dt)
    return book.f(x, u, dt), F @ P @ F.T + book.Q(x, u, dt)


def ekf_correct(book: Book, sensor: BookSensor, x: Point, P: np.ndarray, z: Any, c: Any, seen: np.ndarray) -> tuple:
    """Sarkka (2013), eq. 5.40; the error's covariance is reset as in Sola (2017), Quaternion kinematics, eq. 286."""
    H, R = sensor.H(x, c)[seen], sensor.R(x, c)[np.ix_(seen, seen)]
    r = sensor.minus(z, sensor.h(x, c))[seen]
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    G = book.carry(K @ r)
    return book.plus(x, K @ r), G @ (P - K @ S @ K.T) @ G.T, log_density(r, S)


def iekf_correct(iterations: int) -> Callable:
    """Gauss-Newton on ``|z - h(x + d)|^2_R + |d|^2_P`` from d = 0; Bell and Cathey (1993), eq. 3."""

    def correct(book: Book, sensor: BookSensor, x: Point, P: np.ndarray, z: Any, c: Any, seen: np.ndarray) -> tuple:
        R = sensor.R(x, c)[np.ix_(seen, seen)]
        H = sensor.H(x, c)[seen]
        loglik = log_density(sensor.minus(z, sensor.h(x, c))[seen], H @ P @ H.T + R)
        d, cov = np.zeros(len(P)), P
        for _ in range(iterations):
            at = book.plus(x, d)
            H = sensor.H(at, c)[seen] @ book.carry(d)
            r = sensor.minus(z, sensor.h(at, c))[seen]
            cov = np.linalg.inv(np.linalg.inv(P) + H.T @ np.linalg.solve(R, H))
            d = cov @ H.T @ np.linalg.solve(R, r + H @ d)
        G = book.carry(d)
        return book.plus(x, d), G @ cov @ G.T, loglik

    return correct


class Rule(NamedTuple):
    """Points (k, n) for the standard normal distribution, and their weights for means and for covariances."""

    points: np.ndarray
    mean: np.ndarray
    cov: np.ndarray


def unscented_rule(n: int, alpha: float, beta: float = 2.0, kappa: float = 0.0) -> Rule:
    """Sarkka (2013), eqs. 5.77 and 5.78."""
    lam = alpha**2 * (n + kappa) - n
    points = [np.zeros(n)]
    points += [np.sqrt(n + lam) * e for e in np.eye(n)] + [-np.sqrt(n + lam) * e for e in np.eye(n)]
    mean = [lam / (n + lam)] + 2 * n * [1 / (2 * (n + lam))]
    cov = [lam / (n + lam) + 1 - alpha**2 + beta] + 2 * n * [1 / (2 * (n + lam))]
    return Rule(np.array(points), np.array(mean), np.array(cov))


def cubature_rule(n: int) -> Rule:
    """Arasaratnam and Haykin (2009), eq. 23."""
    points = np.sqrt(n) * np.vstack([np.eye(n), -np.eye(n)])
    weights = np.full(2 * n, 1 / (2 * n))
    return Rule(points, weights, weights)


def gauss_hermite_rule(n: int, order: int) -> Rule:
    """Products of the one-dimensional rule; Sarkka (2013), eqs. 6.23 to 6.25, nodes of the physicists' polynomials."""
    nodes, weights = np.polynomial.hermite.hermgauss(order)
    index = np.indices((order,) * n).reshape(n, -1).T
    w = np.prod(weights[index] / np.sqrt(np.pi), axis=1)
    return Rule(np.sqrt(2) * nodes[index], w, w)


def mean_of(
    points: list, weights: np.ndarray, anchor: Point, plus: Callable, minus: Callable, iterations: int = 3
) -> Point:
    """Weighted mean of points near the anchor, by ``mean <- mean + sum w minus(point, mean)``, three times."""
    mean = anchor
    for _ in range(iterations):
        mean = plus(mean, sum(w * minus(p, mean) for w, p in zip(weights, points, strict=True)))
    return mean


def sigma_filter(rule: Callable[[int], Rule]) -> tuple[Callable, Callable]:
    """Predict and correct of Sarkka (2013), algorithm 5.14, for any rule; fresh points each time, additive noise."""

    def moments(g: Callable, x: Point, P: np.ndarray, plus: Callable, g_plus: Callable, g_minus: Callable) -> tuple:
        points, wm, wc = rule(len(P))
        spread = points @ np.linalg.cholesky(P).T
        images = [g(plus(x, d)) for d in spread]
        mean = mean_of(images, wm, g(x), g_plus, g_minus)
        away = np.array([g_minus(y, mean) for y in images])
        cov = sum(w * np.outer(a, a) for w, a in zip(wc, away, strict=True))
        cross = sum(w * np.outer(d, a) for w, d, a in zip(wc, spread, away, strict=True))
        return mean, cov, cross

    def predict(book: Book, x: Point, P: np.ndarray, u: np.ndarray, dt: float) -> tuple:
        mean, cov, _ = moments(lambda p: book.f(p, u, dt), x, P, book.plus, book.plus, book.minus)
        return mean, cov + book.Q(x, u, dt)

    def correct(book: Book, sensor: BookSensor, x: Point, P: np.ndarray, z: Any, c: Any, seen: np.ndarray) -> tuple:
        y, cov, cross = moments(lambda p: sensor.h(p, c), x, P, book.plus, sensor.plus, sensor.minus)
        r, cross = sensor.minus(z, y)[seen], cross[:, seen]
        S = (cov + sensor.R(x, c))[np.ix_(seen, seen)]
        K = cross @ np.linalg.inv(S)
        G = book.carry(K @ r)
        return book.plus(x, K @ r), G @ (P - K @ S @ K.T) @ G.T, log_density(r, S)

    return predict, correct


def filters(alphas: tuple[float, ...] = (0.1, 0.5, 1.0), iterations: int = 4) -> dict[str, tuple[Callable, Callable]]:
    """Every filter of the books by name: (predict, correct)."""
    table = {"ekf": (ekf_predict, ekf_correct), "iekf": (ekf_predict, iekf_correct(iterations))}
    table |= {f"ukf {a}": sigma_filter(lambda n, a=a: unscented_rule(n, a)) for a in alphas}
    table |= {"ckf": sigma_filter(cubature_rule), "gauss_hermite": sigma_filter(lambda n: gauss_hermite_rule(n, 3))}
    return table


def simulate(
    book: Book, x: Point, P: np.ndarray, schedule: list[tuple[float, Any, dict]], rng: np.random.Generator
) -> tuple[list, list[dict]]:
    """A truth and its readings: (points, sensor -> reading) for each (dt, u, sensor -> context) of the schedule."""
    x = book.plus(x, rng.multivariate_normal(np.zeros(len(P)), P))
    truth, readings = [], []
    for dt, u, contexts in schedule:
        if dt > 0:
            x = book.plus(book.f(x, u, dt), rng.multivariate_normal(np.zeros(len(P)), book.Q(x, u, dt)))
        row = {}
        for name, c in contexts.items():
            sensor = book.sensors[name]
            R = sensor.R(x, c)
            row[name] = sensor.plus(sensor.h(x, c), rng.multivariate_normal(np.zeros(len(R)), R))
        truth.append(x)
        readings.append(row)
    return truth, readings


def rows_of(log: Any, book: Book) -> list[Row]:
    """The rows of a log (of NumPy arrays, leading axis T), silent sensors and unseen components taken out."""
    return list(_rows(log, book))


def _rows(log: Any, book: Book) -> Iterator[Row]:
    for k, dt in enumerate(np.asarray(log.dt)):
        readings = {}
        for name, sensor in book.sensors.items():
            if name not in log.z:
                continue
            valid = np.asarray(log.valid[name])[k] if name in log.valid else np.True_
            seen = np.flatnonzero(np.broadcast_to(valid, len(sensor.R(None, None))))
            if len(seen):
                c = np.asarray(log.c[name])[k] if name in log.c else ()
                readings[name] = (sensor.read(log.z[name], k), c, seen)
        yield Row(float(dt), log.u[k] if len(log.u) else np.zeros(0), readings)


def dense_posterior(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, x: np.ndarray, P: np.ndarray, rows: list[Row], Hs: dict, Rs: dict
) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean and covariance of the last state given every reading, and their marginal log-likelihood: no recursion.

    The trajectory is one big Gaussian, ``X = M [x_0; w_1; ...; w_K] + offset``; the readings are one linear map of it,
    and the answer is one conditioning, Sarkka (2013), lemma A.1.
    """
    n = len(x)
    steps = sum(row.dt > 0 for row in rows)
    prior = np.kron(np.eye(1 + steps), Q)
    prior[:n, :n] = P
    M, offset, moved = np.zeros((n, n * (1 + steps))), x.copy(), 0
    M[:, :n] = np.eye(n)
    maps, offsets, noises, values = [], [], [], []
    for row in rows:
        if row.dt > 0:
            moved += 1
            M, offset = A @ M, A @ offset + B @ row.u
            M[:, n * moved : n * (moved + 1)] = np.eye(n)
        for name, (z, _, seen) in row.readings.items():
            maps.append(Hs[name][seen] @ M)
            offsets.append(Hs[name][seen] @ offset)
            noises.append(Rs[name][np.ix_(seen, seen)])
            values.append(z[seen])
    H, r = np.vstack(maps), np.concatenate(values) - np.concatenate(offsets)
    R = np.zeros((len(r), len(r)))
    ends = np.cumsum([len(block) for block in noises])
    for end, block in zip(ends, noises, strict=True):
        R[end - len(block) : end, end - len(block) : end] = block
    S = H @ prior @ H.T + R
    gain = np.linalg.solve(S, H @ prior @ M.T).T
    return offset + gain @ r, M @ prior @ M.T - gain @ H @ prior @ M.T, log_density(r, S)
