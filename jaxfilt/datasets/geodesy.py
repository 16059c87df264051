"""From the Earth to a local plane: what readers of satellite fixes need, on the host, in float64."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

EQUATORIAL_RADIUS = 6378137.0
"""Semi-major axis of the WGS 84 ellipsoid, m."""

FLATTENING = 1 / 298.257223563
"""Flattening of the WGS 84 ellipsoid."""

EARTH_RATE = 7.2921151467e-5
"""Rotation of the Earth, rad/s, as GPS has it."""

LIGHT = 299792458.0
"""Speed of light, m/s."""

_ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)


class LocalFrame(NamedTuple):
    """East, north, up about a point: ``origin`` (3,) m Earth-centred, ``axes`` (3, 3), whose rows are e, n, u."""

    origin: np.ndarray
    axes: np.ndarray

    def position(self, p: np.ndarray) -> np.ndarray:
        """Earth-centred points (K, 3), m, in this frame."""
        return self.direction(p - self.origin)

    def direction(self, v: np.ndarray) -> np.ndarray:
        """Earth-centred vectors (K, 3) in this frame."""
        return v @ self.axes.T

    def attitude(self, q: np.ndarray) -> np.ndarray:
        """Quaternions (K, 4), (w, x, y, z), body to Earth-centred, as body to this frame."""
        w, x, y, z = q.T
        rotation = _quaternion(self.axes)
        columns = np.stack([np.stack(c) for c in ((w, -x, -y, -z), (x, w, z, -y), (y, -z, w, x), (z, y, -x, w))])
        return np.einsum("ijk,j->ki", columns, rotation)


def local_frame(origin: np.ndarray) -> LocalFrame:
    """The frame about an Earth-centred point (3,), m."""
    latitude, longitude, _ = geodetic(origin)
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    east = [-sin_lon, cos_lon, 0.0]
    north = [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]
    up = [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]
    return LocalFrame(np.asarray(origin, float), np.array([east, north, up]))


def earth_centred(latitude: np.ndarray, longitude: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Earth-centred points (K, 3), m, of geodetic latitudes and longitudes (K,), rad, and heights (K,), m.

    Source: Hofmann-Wellenhof, Lichtenegger, Wasle, GNSS (2008), eq. 8.3.
    """
    normal = EQUATORIAL_RADIUS / np.sqrt(1 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
    across = (normal + height) * np.cos(latitude)
    along_axis = (normal * (1 - _ECCENTRICITY2) + height) * np.sin(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), along_axis], -1)


def geodetic(p: np.ndarray) -> tuple[float, float, float]:
    """Latitude and longitude, rad, and height, m, of an Earth-centred point (3,), m, near the ground, not at a pole.

    Solves ``tan(lat) = (z + e^2 N sin(lat)) / sqrt(x^2 + y^2)`` by fixed point, which gains two digits an iteration.
    """
    x, y, z = (float(a) for a in p)
    across = np.hypot(x, y)
    latitude = np.arctan2(z, across * (1 - _ECCENTRICITY2))
    for _ in range(8):
        normal = EQUATORIAL_RADIUS / np.sqrt(1 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + _ECCENTRICITY2 * normal * np.sin(latitude), across)
    normal = EQUATORIAL_RADIUS / np.sqrt(1 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
    return float(latitude), float(np.arctan2(y, x)), float(across / np.cos(latitude) - normal)


def sagnac(satellites: np.ndarray, receiver: np.ndarray) -> np.ndarray:
    """What the Earth's rotation adds to ranges while signals fly, m: ``rate / c (x_s y_r - y_s x_r)``.

    Args:
        satellites: (K, 3) m, Earth-centred, at the time of transmission.
        receiver: (3,) m, Earth-centred.
    """
    return EARTH_RATE / LIGHT * (satellites[:, 0] * receiver[1] - satellites[:, 1] * receiver[0])


def _quaternion(axes: np.ndarray) -> np.ndarray:
    """The unit quaternion of a rotation matrix: the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix."""
    R = axes
    K = np.array(
        [
            [R[0, 0] + R[1, 1] + R[2, 2], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 0] - R[1, 1] - R[2, 2], R[1, 0] + R[0, 1], R[0, 2] + R[2, 0]],
            [R[0, 2] - R[2, 0], R[1, 0] + R[0, 1], R[1, 1] - R[0, 0] - R[2, 2], R[2, 1] + R[1, 2]],
            [R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[2, 1] + R[1, 2], R[2, 2] - R[0, 0] - R[1, 1]],
        ]
    )
    return np.linalg.eigh(K)[1][:, -1]
