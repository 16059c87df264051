"""A tuning that was killed goes on to the same end, bit for bit; one that is interrupted says what it found."""

import functools
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt import checkpoint
from jaxfilt.study import Interrupted

TRUE = {"q": -0.7, "r": 0.7}
WRONG = {"q": 1.6, "r": -1.6}
LBFGS = {"steps": 12}
ADAM = {"optimizer": "adam", "learning_rate": 0.1, "batch": 5, "length": 20, "patience": 99, "steps": 24}
OPTIONS = {"lbfgs": LBFGS, "adam on pieces": ADAM}


def walk(theta):
    one = jnp.eye(1)
    return jf.linear(A=one, H=one, Q=jnp.exp(2 * theta["q"]) * one, R=jnp.exp(2 * theta["r"]) * one)


def kf(theta):
    return jf.kf(walk(theta))


def start(theta):
    return jf.Gaussian(jnp.zeros(1), jnp.eye(1))


def tune(**options):
    log = jf.schedule(walk(TRUE), 50, 1.0)
    keys = jax.random.split(jax.random.key(3), 6)
    x, logs = jax.jit(jax.vmap(lambda key: jf.simulate(walk(TRUE), start(TRUE), log, key)))(keys)
    truth = jf.Truth(x, np.full((6, 50), True))
    return jf.tune(kf, start, WRONG, logs, truth, noise_estimate=False, **options)


@functools.cache
def whole(optimizer):
    return tune(**OPTIONS[optimizer])


class Killed(BaseException):
    """As good as a kill: nothing after it runs."""


def killed_at(k):
    def progress(step, steps, loss, validation):
        if step == k:
            raise Killed

    return progress


@pytest.mark.parametrize("optimizer", OPTIONS)
def test_killed_and_resumed_it_ends_the_same(optimizer, tmp_path):
    """Adam is killed within an epoch of three minibatches, whose pieces begin where its first parameters say."""
    options, uninterrupted = OPTIONS[optimizer], whole(optimizer)
    with pytest.raises(Killed):
        tune(**options, out=tmp_path, progress=killed_at(5))
    assert checkpoint.read_manifest(tmp_path)["steps_done"] == 5
    with pytest.raises(FileExistsError, match=r"holds a tuning that stopped after 5 of \d+ steps: resume it"):
        tune(**options, out=tmp_path)
    resumed = tune(**options, out=tmp_path, resume=True)
    np.testing.assert_array_equal(resumed.history.theta, uninterrupted.history.theta)
    np.testing.assert_array_equal(resumed.history.loss, uninterrupted.history.loss)
    assert resumed.theta == uninterrupted.theta
    with pytest.raises(ValueError, match="cannot resume, it has seed 0, this tuning 1"):
        tune(**options, out=tmp_path, resume=True, key=jax.random.key(1))


def test_more_steps_are_asked_for(tmp_path):
    short = ADAM | {"steps": 6}
    tune(**short, out=tmp_path)
    longer = tune(**ADAM, out=tmp_path, resume=True)
    assert len(longer.history.loss) == 24
    np.testing.assert_array_equal(longer.history.theta, whole("adam on pieces").history.theta)


def test_interrupted_it_says_what_it_found():
    def progress(step, steps, loss, validation):
        if step == 4:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as caught:
        tune(steps=50, progress=progress)
    fit = caught.value.result
    assert fit.stopped == "interrupted"
    assert len(fit.history.loss) == 4
    assert fit.scores["tuned"]["train"].loss < fit.scores["before"]["train"].loss


def done_in(folder):
    manifest = checkpoint.read_manifest(folder)
    return -1 if manifest is None else manifest["steps_done"]


@pytest.mark.long
def test_a_real_kill(tmp_path):
    """SIGKILL of a process at an arbitrary moment of its descent."""
    code = f"""
import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})
import jax; jax.config.update("jax_enable_x64", True)
import test_tune_resume as t
fit = t.tune(**(t.ADAM | {{"steps": 400}}), out={str(tmp_path)!r}, resume=len(sys.argv) > 1)
print(repr(fit.theta["q"].item()))
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while process.poll() is None and time.monotonic() < deadline and not done_in(tmp_path) > 20:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert 20 < done_in(tmp_path) < 400
    last = subprocess.run([sys.executable, "-c", code, "resume"], check=True, capture_output=True, text=True)
    whole = subprocess.run(
        [sys.executable, "-c", code.replace(repr(str(tmp_path)), repr(str(tmp_path / "whole")))],
        check=True,
        capture_output=True,
        text=True,
    )
    assert last.stdout == whole.stdout
