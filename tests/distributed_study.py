"""A small study for tests: on virtual devices, or one of several processes. Prints its scores as JSON.

python distributed_study.py PROCESS PROCESSES PORT [OUT]
"""

import json
import os
import sys

process, processes, port, *out = sys.argv[1:]
os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={8 if processes == '1' else 2}"
os.environ["JAX_PLATFORMS"] = "cpu"

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

jax.config.update("jax_enable_x64", True)
if processes != "1":
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(f"localhost:{port}", int(processes), int(process))

import jaxfilt as jf  # noqa: E402


def walk(theta):
    A = jnp.array([[1.0, 0.1], [0.0, 0.9]])
    return jf.linear(A, jnp.eye(2)[:1], theta * jnp.diag(jnp.array([0.02, 0.05])), jnp.eye(1))


def start(theta):
    return jf.Gaussian(jnp.zeros(2), jnp.eye(2))


def study(devices, **options):
    log = jf.schedule(walk(1.0), 40, 0.1, every={"z": 2})
    filters = {"kf": lambda theta: jf.kf(walk(theta)), "ekf": lambda theta: jf.ekf(walk(theta))}
    key = jax.random.key(3)
    return jf.study(walk, filters, start, log, key, theta=1.0, runs=101, sample=20, devices=devices, **options)


def plain(result):
    """All numbers that do not tell how they were computed."""
    found = result.scores, result.kept, result.diverged, result.paired, result.truth, result.tracks
    return [np.asarray(leaf, float).tolist() for leaf in jax.tree.leaves(found)]


if __name__ == "__main__":
    found = {"devices": len(jax.devices()), "processes": jax.process_count()}
    if processes == "1":
        one, four = jax.devices()[:1], jax.devices()[:4]
        results = {"1": study(one), "4": study(four, chunk=30), "8": study(None)}
    else:
        results = {"all": study(None, chunk=60, out=out[0])}
        again = study(None, chunk=60, out=out[0], resume=True)
        pairs = zip(plain(again), plain(results["all"]), strict=True)
        found["resumed"] = all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)
    found |= {name: plain(result) for name, result in results.items()}
    found["used"] = [result.devices for result in results.values()]
    print(json.dumps(found), flush=True)
