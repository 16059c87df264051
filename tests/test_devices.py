"""The same study on one device, on eight virtual ones, and on two processes over loopback: the same numbers."""

import json
import os
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

SCRIPT = Path(__file__).parent / "distributed_study.py"


def started(*args):
    """A process of its own: how many devices there are is settled when JAX starts."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("XLA_", "JAX_"))}
    command = [sys.executable, str(SCRIPT), *map(str, args)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)


def found(*processes):
    """What they print, read side by side: one that waits for its reader would keep the others waiting."""
    with ThreadPoolExecutor(len(processes)) as readers:
        outputs = [out for out, _ in readers.map(lambda p: p.communicate(timeout=300), processes)]
    assert [p.returncode for p in processes] == [0] * len(processes), outputs[0][-3000:]
    return [json.loads(next(text for text in out.splitlines() if text.startswith("{"))) for out in outputs]


def free_port():
    with socket.socket() as s:
        s.bind(("localhost", 0))
        return s.getsockname()[1]


def assert_same(one, other):
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(np.array(a, float), np.array(b, float), rtol=1e-9, atol=1e-9)


@pytest.fixture(scope="module")
def on_one_machine():
    """On one, four and eight of the virtual devices of one process."""
    return found(started(0, 1, 0))[0]


@pytest.mark.long
def test_eight_virtual_devices_find_what_one_finds(on_one_machine):
    """101 runs do not divide evenly: some devices fill up with runs that do not count."""
    assert on_one_machine["devices"] == 8
    assert on_one_machine["used"] == [1, 4, 8]
    assert_same(on_one_machine["8"], on_one_machine["1"])
    assert_same(on_one_machine["4"], on_one_machine["1"])
    assert len(on_one_machine["1"]) > 100


@pytest.mark.long
def test_two_processes_find_what_one_finds(on_one_machine, tmp_path):
    port = free_port()
    first, second = found(*[started(rank, 2, port, tmp_path) for rank in range(2)])
    assert (first["processes"], first["devices"]) == (2, 4)
    assert first == second
    assert first["resumed"]
    assert first["used"] == [4]
    assert_same(first["all"], on_one_machine["1"])
