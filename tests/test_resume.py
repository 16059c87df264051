"""A study that is killed, interrupted or cannot write goes on from its last finished chunk, to the same bits."""

import json
import os
import random
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

CHUNK, RUNS = 50, 1000


def walk(theta):
    A = jnp.array([[1.0, 0.1], [0.0, 0.9]])
    return jf.linear(A, jnp.eye(2)[:1], theta * jnp.diag(jnp.array([0.02, 0.05])), jnp.eye(1))


def start(theta):
    return jf.Gaussian(jnp.zeros(2), jnp.eye(2))


FILTERS = {"kf": lambda theta: jf.kf(walk(theta))}
LOG = jf.schedule(walk(1.0), 40, 0.1, every={"z": 2})


def study(out=None, seed=3, **options):
    options = {"theta": 1.0, "runs": RUNS, "chunk": CHUNK, "workers": 1} | options
    return jf.study(walk, FILTERS, start, LOG, jax.random.key(seed), out=out, **options)


def numbers(result):
    """All that a study found, but not how long it took."""
    return [np.asarray(leaf) for leaf in jax.tree.leaves(result._replace(compile_seconds=0, run_seconds=0, space=()))]


def assert_same_bits(a, b):
    for x, y in zip(numbers(a), numbers(b), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.fixture(scope="module")
def whole():
    return study()


class Stop(Exception):
    """Raised between two chunks, as a signal might be."""


def stopped_after(done, with_what=KeyboardInterrupt):
    def progress(now, runs):
        if now >= done:
            raise with_what

    return progress


def test_an_interrupted_study_says_what_it_has_and_goes_on_to_the_same_bits(whole, tmp_path):
    with pytest.raises(jf.Interrupted) as stop:
        study(tmp_path, progress=stopped_after(300))
    partial = stop.value.result
    assert (partial.runs, partial.planned) == (300, RUNS)
    assert partial.scores["kf"].runs == 300
    assert_same_bits(partial, study(runs=300)._replace(planned=RUNS))
    told = []
    resumed = study(tmp_path, resume=True, progress=lambda done, runs: told.append(done))
    assert told[0] == 300
    assert_same_bits(resumed, whole)


def test_a_finished_study_resumes_at_once_and_may_be_made_larger(whole, tmp_path):
    study(tmp_path, runs=600)
    told = []
    assert study(tmp_path, runs=600, resume=True, progress=lambda done, runs: told.append(done)).runs == 600
    assert told == [600]
    assert_same_bits(study(tmp_path, resume=True), whole)
    taken = study(tmp_path, resume=True, chunk=None)
    assert taken.chunk == CHUNK


def test_nothing_but_finished_chunks_is_taken_for_one(whole, tmp_path):
    """Whatever half-written files lie about: the state is the file that was put in place whole."""
    with pytest.raises(jf.Interrupted):
        study(tmp_path, progress=stopped_after(200))
    (tmp_path / "checkpoint.npz.partial").write_bytes(b"half of somethi")
    (tmp_path / "manifest.json").write_text("{")
    assert_same_bits(study(tmp_path, resume=True), whole)
    assert json.loads((tmp_path / "manifest.json").read_text())["runs_done"] == RUNS


def test_the_manifest_says_what_the_study_is(tmp_path):
    study(tmp_path, runs=100)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert manifest["schema"] == "jaxfilt.checkpoint/1"
    expected = {"seed": 3, "runs": 100, "runs_done": 100, "steps": 40, "dtype": "float64", "chunk": CHUNK, "devices": 1}
    assert {name: manifest[name] for name in expected} == expected
    assert manifest["filters"] == ["kf"]
    assert manifest["theta"] == {"": 1.0}
    assert manifest["made_with"]["jax"] == jax.__version__
    assert set(manifest["made_with"]) == {"jaxfilt", "jax", "numpy", "python", "platform", "device"}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"seed": 4}, "it has seed 3, this study 4"),
        ({"chunk": 40}, "it has chunk 50, this study 40"),
        ({"theta": 2.0}, "it has theta. 1.0, this study 2.0"),
        ({"sample": 7}, "the model, the filters or the schedule have changed since"),
    ],
)
def test_another_study_is_not_resumed(tmp_path, change, text):
    study(tmp_path, runs=100)
    with pytest.raises(ValueError, match=f"cannot resume, {text}"):
        study(tmp_path, resume=True, **change)


def test_another_version_is_not_resumed(tmp_path, monkeypatch):
    study(tmp_path, runs=100)
    older = checkpoint.made_with() | {"jax": "0.1"}
    monkeypatch.setattr(checkpoint, "made_with", lambda: older)
    with pytest.raises(ValueError, match=rf"it has made_with\.jax {jax.__version__}, this study 0\.1"):
        study(tmp_path, resume=True)


def test_an_unfinished_study_is_not_overwritten_a_finished_one_is(tmp_path):
    with pytest.raises(jf.Interrupted):
        study(tmp_path, progress=stopped_after(200))
    with pytest.raises(FileExistsError, match="stopped after 200 of 1,000 runs: resume it, or remove the folder"):
        study(tmp_path)
    study(tmp_path, resume=True)
    assert study(tmp_path, runs=100).runs == 100


def test_there_must_be_something_to_resume(tmp_path):
    with pytest.raises(FileNotFoundError, match="expected a study to resume, found none"):
        study(tmp_path, resume=True)


def test_a_folder_that_cannot_be_made_is_an_error_before_anything_runs(tmp_path):
    (tmp_path / "file").write_text("in the way")
    told = []
    with pytest.raises(OSError, match="file"):
        study(tmp_path / "file" / "out", progress=lambda *a: told.append(a))
    assert told == []


def test_a_full_disk_stops_the_study_and_loses_nothing(whole, tmp_path, monkeypatch):
    """The disk fills up while the fifth state is written."""
    real, written = os.fsync, []

    def full(descriptor):
        written.append(descriptor)
        if len(written) == 10:
            raise OSError(28, "No space left on device")
        real(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"cannot keep its state after 250 runs \(No space left on device\)"):
        study(tmp_path)
    monkeypatch.undo()
    assert not list(tmp_path.glob("*.partial"))
    assert checkpoint.read_manifest(tmp_path)["runs_done"] == 200
    assert_same_bits(study(tmp_path, resume=True), whole)


KILLED = """
import json, sys
sys.path.insert(0, {folder!r})
import jax
jax.config.update("jax_enable_x64", True)
import test_resume as t
resume = (t.Path({out!r}) / "manifest.json").exists()
result = t.study({out!r}, chunk=2, resume=resume)
print(json.dumps([leaf.tolist() for leaf in t.numbers(result)]))
"""


@pytest.mark.long
def test_killed_at_ten_random_moments_it_ends_with_the_same_bits(tmp_path):
    """SIGKILL, which no program can see coming, at any moment between the start and the end."""
    moments = random.Random(0)

    # Each process would compile the same program: the first one, which nobody disturbs, does it for all.
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "compiled")}
    environment |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1"}

    def process(out):
        code = KILLED.format(folder=str(Path(__file__).parent), out=str(out))
        return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment)

    def done():
        state = checkpoint.read_manifest(tmp_path / "killed")
        return -1 if state is None else state["runs_done"]

    undisturbed = process(tmp_path / "whole").communicate()[0]
    reached = []
    for _ in range(10):
        running, before = process(tmp_path / "killed"), done()
        while done() <= before and running.poll() is None:
            time.sleep(0.01)
        time.sleep(moments.uniform(0.0, 0.05))
        running.send_signal(signal.SIGKILL)
        running.communicate()
        reached.append(done())
    assert reached == sorted(reached)
    assert 0 < reached[0] < reached[-1] < RUNS, reached
    assert process(tmp_path / "killed").communicate()[0] == undisturbed
    assert len(json.loads(undisturbed)) > 100
