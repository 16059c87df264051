"""A lost drone above hills: its equations by hand, and whether it finds itself; above a plain it cannot."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from jaxfilt.models.relocalisation import LOST_DRONE, hills, relocalisation, relocalisation_scenario

SCENE = relocalisation_scenario()
PLAIN = lambda place: 10.0 + 0.0 * place[0]  # noqa: E731


def test_the_equations_by_hand():
    model = relocalisation()
    x, u = jnp.array([120.0, 60.0]), jnp.array([3.0, -4.0])
    np.testing.assert_allclose(model.f(x, u, 2.0), [126.0, 52.0])
    np.testing.assert_allclose(model.Q(x, u, 2.0), 2 * 0.3**2 * np.eye(2), rtol=1e-12)
    np.testing.assert_allclose(model.sensors["range"].h(x, ()), 60.0 - hills()[6, 3], rtol=1e-12)
    np.testing.assert_allclose(model.sensors["range"].R(x, ()), [[0.25]], rtol=1e-12)


def errors(filt, model, runs=24, steps=150):
    """Distance (m) of the estimates from the drone at the end; it starts anywhere within the map."""
    start, plan = SCENE.belief(LOST_DRONE), SCENE.schedule(steps)

    def one(key):
        place, draw, own = jax.random.split(key, 3)
        there = jf.Gaussian(jax.random.uniform(place, (2,), minval=50.0, maxval=350.0), jnp.zeros((2, 2)))
        truth, log = jf.simulate(model, there, plan, draw, SCENE.control)
        said = jf.scan(filt, filt.begin(start, own), log, lambda b, info: filt.gaussian(b).mean)
        return jnp.linalg.norm(said[-1] - truth[-1])

    return np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(1), runs)))


def test_particles_find_the_drone_and_an_ekf_does_not():
    hilly = relocalisation()
    found = errors(jf.particle(hilly, 4000), hilly)
    assert np.mean(found < 20.0) > 0.75
    assert np.mean(errors(jf.ekf(hilly), hilly) < 20.0) < 0.5


def test_above_a_plain_nobody_finds_it():
    plain = relocalisation(ground=PLAIN)
    assert np.mean(errors(jf.particle(plain, 1000), plain) < 20.0) < 0.2
