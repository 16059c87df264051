"""Saving and loading: bit for bit, with or without the model, and no half-written or half-read files."""

import os
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt import files


class Fix(NamedTuple):
    pos: Any
    more: Any


class Controls(NamedTuple):
    throttle: Any
    steering: Any


ODD = 'it\'s [0] a "name"/é'
FIX = jf.product(Fix(jf.vector(2), {"yaw": jf.angle, "tilt": (jf.scalar, jf.so3)}))


def model() -> jf.Model:
    still = jf.const(jnp.eye(3))
    sensors = {
        "fix": jf.Sensor(lambda x, c: x, jf.const(jnp.eye(FIX.dim)), FIX),
        ODD: jf.Sensor(lambda x, c: x, still, jf.vector(3)),
    }
    return jf.Model(lambda x, u, dt: x, still, jf.vector(3), sensors)


def recording(dtype=np.float64, u: Any = None) -> jf.Recording:
    rng = np.random.default_rng(0)

    def numbers(*shape):
        return rng.normal(size=(7, *shape)).astype(dtype)

    log = jf.Log(
        dt=np.abs(numbers()),
        u=Controls(numbers(), (numbers(2), {"gear": rng.integers(0, 5, 7), "none": ()})) if u is None else u,
        z={"fix": Fix(numbers(2), {"yaw": numbers(), "tilt": (numbers(), numbers(4))}), ODD: numbers(3)},
        c={ODD: (numbers(3, 3), rng.integers(0, 9, 7, np.int32))},
        valid={"fix": rng.uniform(size=(7, FIX.dim)) < 0.5, ODD: rng.uniform(size=7) < 0.5},
    )
    return jf.Recording(log, 1.7e9 + np.cumsum(rng.uniform(size=7)))


def assert_bit_equal(a: Any, b: Any) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


@pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=["float32", "float64"])
def test_there_and_back(tmp_path: Path, dtype):
    """With the model readings get their structure back; NamedTuples that it knows nothing of come back as dicts."""
    rec = recording(dtype)
    rec.log.z["fix"].pos[0] = [-0.0, np.finfo(dtype).tiny / 2]
    path = tmp_path / "log.npz"
    files.save(path, rec)
    u = rec.log.u
    plain_u = {"throttle": u.throttle, "steering": u.steering}
    assert_bit_equal(files.load(path, model()), rec._replace(log=rec.log._replace(u=plain_u)))
    z = {"fix": {"pos": rec.log.z["fix"].pos, "more": rec.log.z["fix"].more}, ODD: rec.log.z[ODD]}
    assert_bit_equal(files.load(path), rec._replace(log=rec.log._replace(u=plain_u, z=z)))


def test_what_was_loaded_without_the_model_can_be_saved_and_loaded_with_it(tmp_path: Path):
    files.save(tmp_path / "a.npz", recording())
    files.save(tmp_path / "b.npz", files.load(tmp_path / "a.npz"))
    assert_bit_equal(files.load(tmp_path / "b.npz", model()), files.load(tmp_path / "a.npz", model()))


@pytest.mark.parametrize("u", [(), {}, None], ids=["tuple", "dict", "None"])
def test_empty_fields(tmp_path: Path, u):
    log = jf.Log(np.ones(2), u, {}, {}, {})
    files.save(tmp_path / "log.npz", jf.Recording(log, np.arange(2.0)))
    back = files.load(tmp_path / "log.npz").log
    assert (back.u, back.z, back.c, back.valid) == (u, {}, {}, {})


def test_jax_arrays_of_a_simulation(tmp_path: Path):
    walk = jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
    log = jax.tree.map(jnp.asarray, jf.schedule(walk, 3, 0.5))
    files.save(str(tmp_path / "log.npz"), jf.Recording(log, jnp.cumsum(log.dt)))
    back = files.load(str(tmp_path / "log.npz"), walk)
    assert_bit_equal(back.log, log)
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(back))
    assert back.t.tolist() == [0.5, 1.0, 1.5]


def test_anyone_can_read_and_write_the_file(tmp_path: Path):
    files.save(tmp_path / "log.npz", recording())
    with np.load(tmp_path / "log.npz") as archive:
        assert {"version", "t", "dt", "z['fix']['pos']", "u['steering'][0]"} <= set(archive.files)
    t = np.arange(3.0)
    np.savez(tmp_path / "mine.npz", version=1, t=t, dt=np.ones(3), **{"z['z']": np.ones((3, 1))})
    rec = files.load(tmp_path / "mine.npz", jf.linear(jnp.eye(1), jnp.eye(1), jnp.eye(1), jnp.eye(1)))
    assert rec.log.z["z"].tolist() == [[1.0]] * 3
    assert rec.log[1:2] + rec.log[3:] == ((), {}, {})


def test_nothing_in_the_file_is_executed(tmp_path: Path):
    """Pickles are neither written nor read."""
    np.savez(tmp_path / "log.npz", version=1, t=np.zeros(1), dt=np.zeros(1), u=np.array([print], dtype=object))
    with pytest.raises(ValueError, match=r"log\.npz: expected a recording .* got a damaged file \(Object arrays"):
        files.load(tmp_path / "log.npz")
    strange = recording(u={"driver": np.array(["Ann", None] * 3 + ["Ann"], dtype=object)})
    with pytest.raises(TypeError, match=r"recording\.log\.u\['driver'\]: expected numbers, got dtype object"):
        files.save(tmp_path / "other.npz", strange)
    assert os.listdir(tmp_path) == ["log.npz"]


# What is no recording


def test_other_files(tmp_path: Path):
    path = tmp_path / "it.npz"
    text = r"it\.npz: expected a recording as `jaxfilt\.save` writes it, got "
    for content in (b"", b"t,z\n0,1\n", b"\x93NUMPY"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=text + "something else or only the beginning of one"):
            files.load(path)
    with open(path, "wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(ValueError, match=text + "something else"):
        files.load(path)
    np.savez(path, a=np.zeros(3), t=np.zeros(3))
    with pytest.raises(ValueError, match=text + "a file without dt, version"):
        files.load(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("notes.txt", "not an array")
    with pytest.raises(ValueError, match=text + "a file without dt, t, version"):
        files.load(path)
    with pytest.raises(FileNotFoundError, match=r"nowhere\.npz"):
        files.load(tmp_path / "nowhere.npz")


def test_a_file_cut_short_anywhere(tmp_path: Path):
    path = tmp_path / "log.npz"
    files.save(path, recording())
    whole = path.read_bytes()
    for length in np.linspace(0, len(whole) - 1, 20).astype(int):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"log\.npz: expected a recording"):
            files.load(path)


def test_a_file_with_a_flipped_bit(tmp_path: Path):
    path = tmp_path / "log.npz"
    files.save(path, recording())
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        start = next(info for info in archive.infolist() if info.filename == "dt.npy").header_offset
    content[start + 60] ^= 4
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"log\.npz: expected a recording .* got a damaged file"):
        files.load(path)


def rewritten(tmp_path: Path, **changes: Any) -> Path:
    """A saved recording with some entries replaced, or removed where None."""
    files.save(tmp_path / "log.npz", recording())
    with np.load(tmp_path / "log.npz") as archive:
        entries = dict(archive) | changes
    np.savez(tmp_path / "changed.npz", **{name: a for name, a in entries.items() if a is not None})
    return tmp_path / "changed.npz"


def test_another_version(tmp_path: Path):
    path = rewritten(tmp_path, version=np.array(2))
    with pytest.raises(ValueError, match=r"changed\.npz: expected version 1 of the format, .* got 2"):
        files.load(path)


def test_entries_that_do_not_belong(tmp_path: Path):
    with pytest.raises(ValueError, match=r"changed\.npz: expected entries of a log, \('dt', .*\), got \"w\['fix'\]\""):
        files.load(rewritten(tmp_path, **{"w['fix']": np.zeros(7)}))
    with pytest.raises(ValueError, match=r"expected entries of a log, .*, got 'z\[fix\]'"):
        files.load(rewritten(tmp_path, **{"z[fix]": np.zeros(7)}))
    with pytest.raises(ValueError, match=r"npz: recording\.log\.dt: expected leading axis 7, got shape \(6,\)"):
        files.load(rewritten(tmp_path, dt=np.zeros(6)))


def test_a_model_that_does_not_fit(tmp_path: Path):
    files.save(tmp_path / "log.npz", recording())
    other = jf.linear(jnp.eye(1), jnp.eye(1), jnp.eye(1), jnp.eye(1))
    with pytest.raises(KeyError, match=r"sensor: expected one of \['z'\], got "):
        files.load(tmp_path / "log.npz", other)
    flat = model()
    flat.sensors["fix"] = flat.sensors[ODD]
    with pytest.raises(ValueError, match=r"log\.npz: expected for sensor 'fix' \[\"z\['fix'\]\"\], got .*'pos'"):
        files.load(tmp_path / "log.npz", flat)
    path = rewritten(tmp_path, **{"z['fix']['pos']": np.zeros((7, 3))})
    with pytest.raises(ValueError, match=r"changed\.npz: z of 'fix': expected shapes .* got .*\(7, 3\)"):
        files.load(path, model())


# Writing


def test_what_cannot_be_saved(tmp_path: Path):
    rec, path = recording(), tmp_path / "log.npz"
    with pytest.raises(TypeError, match=r"recording: expected Recording\(log, t\), got Log"):
        files.save(path, rec.log)
    with pytest.raises(ValueError, match=r"recording\.log\.dt: expected leading axis 6, got shape \(7,\)"):
        files.save(path, rec._replace(t=rec.t[:6]))
    with pytest.raises(ValueError, match=r"recording\.log\.dt: expected leading axis 1, got shape \(7,\)"):
        files.save(path, rec._replace(t=np.array(1.0)))
    with pytest.raises(TypeError, match=r"recording\.log: expected names as keys of its dicts, got 3"):
        files.save(path, recording(u={3: np.zeros(7)}))
    assert os.listdir(tmp_path) == []


def test_where_nothing_can_be_written(tmp_path: Path):
    rec = recording()
    with pytest.raises(FileNotFoundError, match=r"no_such_folder/log\.npz") as caught:
        files.save(tmp_path / "no_such_folder" / "log.npz", rec)
    assert caught.value.filename == str(tmp_path / "no_such_folder" / "log.npz")
    (tmp_path / "file").write_text("")
    with pytest.raises(NotADirectoryError, match=r"file/log\.npz"):
        files.save(tmp_path / "file" / "log.npz", rec)
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(IsADirectoryError, match=r"folder\.npz"):
        files.save(tmp_path / "folder.npz", rec)
    assert sorted(os.listdir(tmp_path)) == ["file", "folder.npz"]


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "log.npz"
    files.save(path, recording(np.float32))
    before = path.read_bytes()
    write = np.savez_compressed

    def half(file, **arrays):
        write(file, **dict(list(arrays.items())[:3]))
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", half)
    with pytest.raises(OSError, match=r"No space left on device: '.*log\.npz'"):
        files.save(path, recording())
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["log.npz"]
    monkeypatch.undo()
    files.save(path, recording())
    assert path.read_bytes() != before
    assert os.listdir(tmp_path) == ["log.npz"]
