"""Readers of recorded data: what can be said without the recordings."""

import numpy as np
import pytest

from jaxfilt import datasets
from jaxfilt.datasets import geodesy
from jaxfilt.datasets.common import increasing, known, sensed


def test_a_readings_missing_parts_are_marked():
    t, z = np.arange(3.0), np.array([[1.0, 2.0], [np.nan, 3.0], [np.nan, np.nan]])
    partly = sensed(t, z)
    assert partly.valid.tolist() == [[True, True], [False, True], [False, False]]
    assert partly.z.tolist() == [[1, 2], [0, 3], [0, 0]]
    assert sensed(t, np.where(np.isnan(z).any(1, keepdims=True), np.nan, z)).valid.tolist() == [True, False, False]
    assert sensed(t, z[:, 1]).valid.tolist() == [True, True, False]
    assert sensed(t[:1], z[:1]).valid is None


def test_of_a_repeated_stamp_the_last_value_is_kept():
    t, x = increasing(np.array([0.0, 1.0, 1.0, 2.0]), np.array([5.0, 6.0, 7.0, 8.0]))
    assert (t.tolist(), x.tolist()) == ([0, 1, 2], [5, 7, 8])


def test_a_truth_has_no_gaps_written_as_nan():
    t, x = known(np.arange(3.0), np.array([[1.0, 2.0], [np.nan, 3.0], [4.0, 5.0]]))
    assert (t.tolist(), x.tolist()) == ([0, 2], [[1, 2], [4, 5]])


def rotated(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """q v q*, by Rodrigues' formula for the axis and angle of a quaternion (w, x, y, z)."""
    angle, axis = 2 * np.arctan2(np.linalg.norm(q[1:]), q[0]), q[1:] / np.linalg.norm(q[1:])
    return v * np.cos(angle) + np.cross(axis, v) * np.sin(angle) + axis * (axis @ v) * (1 - np.cos(angle))


def test_geodesy_on_known_points():
    # Paris and the pole, Earth-centred coordinates from the definition of the WGS 84 ellipsoid.
    p = geodesy.earth_centred(np.radians([0.0, 90.0, 48.8566]), np.radians([0.0, 0.0, 2.3522]), np.array([0, 0, 35.0]))
    np.testing.assert_allclose(p[:2], [[6378137.0, 0, 0], [0, 0, 6356752.314245]], atol=1e-6)
    latitude, longitude, height = geodesy.geodetic(p[2])
    np.testing.assert_allclose(np.degrees([latitude, longitude]), [48.8566, 2.3522], rtol=1e-12)
    assert height == pytest.approx(35.0, abs=1e-6)
    frame = geodesy.local_frame(p[2])
    higher = geodesy.earth_centred(np.array([latitude]), np.array([longitude]), np.array([height + 10]))
    np.testing.assert_allclose(frame.position(higher), [[0, 0, 10]], atol=1e-6)
    norther = geodesy.earth_centred(np.array([latitude + 1e-6]), np.array([longitude]), np.array([height]))
    assert frame.position(norther)[0].argmax() == 1
    # The quaternion and the axes are the same rotation.
    q, v = np.array([0.5, -0.5, 0.1, 0.7]), np.array([1.0, 2.0, 3.0])
    both = rotated(frame.attitude(q[None] / np.linalg.norm(q))[0], v), frame.direction(rotated(q, v)[None])[0]
    np.testing.assert_allclose(*both, atol=1e-12)


def test_a_missing_variable_says_so(monkeypatch):
    monkeypatch.delenv("JAXFILT_DATA", raising=False)
    with pytest.raises(FileNotFoundError, match=r"wifibot: the environment variable JAXFILT_DATA is not set.*ukfm"):
        datasets.load("wifibot")


@pytest.mark.parametrize("name", datasets.names())
def test_a_missing_folder_says_where_it_looked_and_where_to_get_it(monkeypatch, tmp_path, name):
    monkeypatch.setenv("JAXFILT_DATA", str(tmp_path))
    with pytest.raises(FileNotFoundError) as error:
        datasets.load(name)
    text = str(error.value)
    assert str(tmp_path / name) in text
    assert "JAXFILT_DATA" in text
    assert "Get them from" in text


def test_unknown_names_are_told_the_known_ones():
    with pytest.raises(KeyError, match=r"dataset: expected one of .*'wifibot'.* got 'nuscenes'"):
        datasets.load("nuscenes")
    with pytest.raises(KeyError, match=r"sequence of 'wifibot': expected one of \['2', '1', '4'\], got '3'"):
        datasets.load("wifibot", "3")
    with pytest.raises(KeyError, match="expected one of"):
        datasets.sequences("nuscenes")
