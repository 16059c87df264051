"""Machine code on disk: found again, never trusted, never needed."""

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

pytest.importorskip("llvmlite")
from jaxfilt.lanes import cache, machine
from jaxfilt.lanes.graph import Graph
from jaxfilt.lanes.kernel import Kernel
from jaxfilt.lanes.program import Leaf, Output, Program, Slot, Source

PROGRAM = """
import numpy as np
from tests.test_lanes_cache import works
works()
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXFILT_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def works(added: float = 2.0) -> None:
    """A kernel does what it should, wherever its code is from."""
    g = Graph()
    x, z = g.input(("carry", 0), "f64"), g.input(("source", 0, 0), "f64")
    after = g.make("add", g.make("add", x, z), g.constant(added, "f64"))
    leaf = Leaf("f64", False, (0,), (0,))
    p = Program(g, (Source("f64", 1, False, True),), (leaf,), (Slot("f64", 0, 0, after),), (Output((x,), "f64"),))
    (final,), _ = Kernel(p)([np.ones((5, 3, 1))], [np.arange(5.0)[:, None]], 5, 3)
    np.testing.assert_array_equal(final[:, 0], np.arange(5.0) + 3 * (1 + added))


def compilations(monkeypatch) -> list:
    """Grows with each module that is compiled and not found."""
    made, compile = [], machine._object_code
    monkeypatch.setattr(machine, "_object_code", lambda text: made.append(text) or compile(text))
    return made


def files(folder) -> list:
    return sorted(folder.iterdir())


def test_code_is_compiled_once(folder, monkeypatch):
    made = compilations(monkeypatch)
    works()
    works()
    assert len(made) == 1
    assert len(files(folder)) == 1
    works(7.0)
    assert len(files(folder)) == 2


def test_another_process_finds_it(folder):
    works()
    before = files(folder)[0].read_bytes()
    code = "from jaxfilt.lanes import machine\nmachine._object_code = None\n" + PROGRAM
    environment = os.environ | {"PYTHONPATH": os.getcwd()}
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True, env=environment, timeout=120)
    assert files(folder)[0].read_bytes() == before


@pytest.mark.parametrize(
    "spoil",
    [
        lambda code: b"",
        lambda code: code[:50],
        lambda code: code[:-1],
        lambda code: code[:-300] + bytes(300),
        lambda code: code[:-1] + bytes([code[-1] ^ 1]),
        lambda code: b"\x7fELF" + code,
    ],
)
def test_code_that_is_not_what_was_written_is_replaced(folder, monkeypatch, spoil):
    made = compilations(monkeypatch)
    works()
    path = files(folder)[0]
    code = path.read_bytes()
    path.write_bytes(spoil(code))
    works()
    assert len(made) == 2
    assert path.read_bytes() == code
    works()
    assert len(made) == 2


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="Windows has other ways to say who may write a file")
def test_code_that_others_can_write_is_not_run(folder, monkeypatch):
    made = compilations(monkeypatch)
    works()
    files(folder)[0].chmod(0o666)
    works()
    assert len(made) == 2
    assert not files(folder)[0].stat().st_mode & 0o022
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    works()
    assert len(made) == 3
    assert not folder.stat().st_mode & 0o077


def test_other_processors_and_compilers_have_files_of_their_own(folder, monkeypatch):
    made = compilations(monkeypatch)
    works()
    monkeypatch.setattr(machine, "OPTIMIZATION", machine.OPTIMIZATION + 1)
    works()
    assert len(made) == len(files(folder)) == 2


@pytest.mark.parametrize("what", ["a file", "a file above", "no space"])
def test_a_folder_that_cannot_be_written_is_not_needed(tmp_path, monkeypatch, what):
    (tmp_path / "file").write_text("in the way")
    place = {"a file": tmp_path / "file", "a file above": tmp_path / "file" / "cache", "no space": tmp_path / "cache"}
    monkeypatch.setenv("JAXFILT_CACHE", str(place[what]))
    if what == "no space":

        def full(*_):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "replace", full)
    works()
    works()
    if what == "no space":
        assert not list((tmp_path / "cache").iterdir())


def test_what_was_not_used_for_longest_goes_first(folder, monkeypatch):
    for i, key in enumerate(["a", "b", "c"]):
        cache.write(key, bytes(1000))
        os.utime(folder / f"{key}.code", (i, i))
    assert cache.read("a") == bytes(1000)  # now the one used last
    monkeypatch.setattr(cache, "LIMIT", 2 * files(folder)[0].stat().st_size)
    cache.write("d", bytes(1000))
    assert [path.stem for path in files(folder)] == ["a", "d"]
    (folder / "other.txt").write_text("not ours")
    monkeypatch.setattr(cache, "LIMIT", 0)
    cache.write("e", b"")
    assert [path.name for path in files(folder)] == ["other.txt"]


def test_many_at_once(folder):
    """Threads and processes that compile the same at the same time."""
    environment = os.environ | {"PYTHONPATH": os.getcwd(), "OMP_NUM_THREADS": "1"}
    others = [subprocess.Popen([sys.executable, "-c", PROGRAM], env=environment) for _ in range(2)]
    with ThreadPoolExecutor(4) as pool:
        end = time.monotonic() + 1
        while time.monotonic() < end:
            list(pool.map(works, [1.0, 2.0, 3.0, 2.0]))
            for path in files(folder)[::2]:
                path.unlink(missing_ok=True)
    assert [other.wait(timeout=120) for other in others] == [0, 0]
    assert all(path.suffix == ".code" for path in files(folder))


@pytest.mark.parametrize(
    ("platform", "variables", "expected"),
    [
        ("linux", {"XDG_CACHE_HOME": "/x"}, "/x/jaxfilt"),
        ("linux", {}, "/home/u/.cache/jaxfilt"),
        ("darwin", {}, "/home/u/Library/Caches/jaxfilt"),
        ("win32", {"LOCALAPPDATA": "/l"}, "/l/jaxfilt"),
        ("linux", {"JAXFILT_CACHE": "/c"}, "/c"),
    ],
)
def test_folder(monkeypatch, platform, variables, expected):
    for name in ("JAXFILT_CACHE", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    for name, value in ({"HOME": "/home/u", "USERPROFILE": "/home/u"} | variables).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "platform", platform)
    assert cache.folder().as_posix() == expected


def test_without_llvmlite(monkeypatch):
    """Nothing but compiling needs it."""
    machine.available.cache_clear()
    machine._host.cache_clear()
    monkeypatch.setitem(sys.modules, "llvmlite", None)
    monkeypatch.setitem(sys.modules, "llvmlite.binding", None)
    assert not machine.available()
    monkeypatch.undo()
    machine.available.cache_clear()
    assert machine.available()
