"""Oracles for the tests of models, in plain NumPy: finite differences, a Kalman filter from the book, NEES."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import jaxfilt as jf


def on_vectors(g, x):
    """A function of the state as one of flat vectors: (n,) -> (m,)."""
    unravel = ravel_pytree(x)[1]
    return lambda v: ravel_pytree(g(unravel(v)))[0]


def assert_derivatives(g, *points, atol=1e-7):
    """Forward and reverse derivatives of g equal central differences at every point, and the second ones are finite."""
    flat = on_vectors(g, points[0])

    @jax.jit
    def derivatives(v):
        second = jax.jacfwd(jax.jacrev(flat))(v)
        return jax.jacfwd(flat)(v), jax.jacrev(flat)(v), jnp.isfinite(second).all()

    value, step = jax.jit(jax.vmap(flat)), 1e-5
    for point in points:
        v = np.asarray(ravel_pytree(point)[0])
        E = step * np.eye(len(v))
        expected = np.asarray(value(v + E) - value(v - E)).T / (2 * step)
        forward, reverse, finite = derivatives(v)
        np.testing.assert_allclose(forward, expected, atol=atol)
        np.testing.assert_allclose(reverse, expected, atol=atol)
        assert finite


def kalman(A, B, H, Q, R, mean, P, us, zs):
    """Predict-first Kalman filter, the textbook's five lines; returns means (T, n) and covariances (T, n, n)."""
    means, covs = [], []
    for u, z in zip(us, zs, strict=True):
        mean, P = A @ mean + B @ u, A @ P @ A.T + Q
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        mean, P = mean + K @ (z - H @ mean), P - K @ H @ P
        means.append(mean)
        covs.append(P)
    return np.stack(means), np.stack(covs)


def matrices(model, x, u, dt):
    """A, B, H by sensor of a linear model, read off its functions by finite differences of unit steps."""
    v = ravel_pytree(x)[0]
    zero = np.zeros_like(v)
    step = on_vectors(lambda s: model.f(s, u, dt), x)
    A = np.stack([step(zero + e) - step(zero) for e in np.eye(len(v))], axis=1)
    H = {}
    for name, sensor in model.sensors.items():
        h = on_vectors(lambda s, sensor=sensor: sensor.h(s, ()), x)
        H[name] = np.stack([h(zero + e) - h(zero) for e in np.eye(len(v))], axis=1)
    return A, H


def observability_rank(A, H):
    return np.linalg.matrix_rank(np.concatenate([H @ np.linalg.matrix_power(A, k) for k in range(len(A))]))


def van_loan(A, density, dt, pieces=2000):
    """The integral of exp(A s) density exp(A s)' over dt, by the midpoint rule and a Taylor series."""
    total, h = np.zeros_like(density), dt / pieces
    for s in (np.arange(pieces) + 0.5) * h:
        E, term = np.eye(len(A)), np.eye(len(A))
        for k in range(1, 8):
            term = term @ A * s / k
            E = E + term
        total = total + E @ density @ E.T * h
    return total


def simulated(scenario, runs, steps, seed=0):
    """Truth and logs of many runs, the run axis first."""
    log = scenario.schedule(steps)

    @jax.jit
    def simulate(keys):
        model, belief = scenario.model(scenario.theta), scenario.belief(scenario.theta)
        return jax.vmap(lambda key: jf.simulate(model, belief, log, key, scenario.control))(keys)

    return simulate(jax.random.split(jax.random.key(seed), runs))


def filtered(scenario, simulation, make, theta=None):
    """Beliefs (runs, T, ...) of a filter with the parameters theta, from the sensors of the scenario's own schedule."""
    theta = scenario.theta if theta is None else theta
    shared = scenario.schedule(simulation.log.dt.shape[1])

    @jax.jit
    def run(theta, z, u):
        log = shared._replace(z={name: z[name] for name in shared.z}, u=u)
        filt, belief = make(scenario.model(theta)), scenario.belief(theta)
        return jf.scan_runs(filt, belief, log, batched=("z", "u"), store=lambda b, info: b)

    return run(theta, simulation.log.z, simulation.log.u)


def nees(model, truth, beliefs):
    """e' P^-1 e, (runs, T), with errors on the model's space."""
    e = np.asarray(jax.jit(jax.vmap(jax.vmap(model.space.minus)))(truth, beliefs.mean))
    return np.einsum("rti,rti->rt", e, np.linalg.solve(np.asarray(beliefs.cov), e[..., None])[..., 0])


def cast(theta, dtype):
    return jax.tree.map(lambda a: jnp.asarray(a, dtype), theta)
