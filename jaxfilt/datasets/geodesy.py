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
    """East, north, up about a point: ``origin`` (3,) m, Earth-centred, at ``latitude`` and ``longitude``, rad."""

    origin: np.ndarray
    latitude: float
    longitude: float

    def position(self, p: np.ndarray) -> np.ndarray:
        """Earth-centred points (K, 3), m, in this frame."""
        return self.direction(p - self.origin)

    def direction(self, v: np.ndarray) -> np.ndarray:
        """Earth-centred vectors (K, 3) in this frame."""
        sin_lat, cos_lat = np.sin(self.latitude), np.cos(self.latitude)
        sin_lon, cos_lon = np.sin(self.longitude), np.cos(self.longitude)
        east = [-sin_lon, cos_lon, 0.0]
        north = [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]
        up = [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]
        return v @ np.array([east, north, up]).T

    def attitude(self, q: np.ndarray) -> np.ndarray:
        """Quaternions (K, 4), (w, x, y, z), body to Earth-centred, as body to this frame.

        This frame is the Earth-centred one turned by longitude + 90 deg about z, then by 90 deg - latitude about x.
        """
        about_z, about_x = 0.5 * (self.longitude + np.pi / 2), 0.5 * (np.pi / 2 - self.latitude)
        back_x = np.array([np.cos(about_x), -np.sin(about_x), 0.0, 0.0])
        back_z = np.array([np.cos(about_z), 0.0, 0.0, -np.sin(about_z)])
        return _quaternion_product(back_x, _quaternion_product(back_z, q))


def local_frame(origin: np.ndarray) -> LocalFrame:
    """The frame about an Earth-centred point (3,), m."""
    latitude, longitude, _ = geodetic(origin)
    return LocalFrame(np.asarray(origin, float), latitude, longitude)


def _quaternion_product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Hamilton product of one quaternion (4,) with many (K, 4), (w, x, y, z)."""
    scalar = p[0] * q[:, 0] - q[:, 1:] @ p[1:]
    vector = p[0] * q[:, 1:] + q[:, :1] * p[1:] + np.cross(p[1:], q[:, 1:])
    return np.concatenate([scalar[:, None], vector], axis=1)


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
