"""Recorded inertial readings, made ready: the input of a row, a reading at any time, and the first attitude."""

from __future__ import annotations

import numpy as np

from jaxfilt.datasets.common import Timed
from jaxfilt.models.inertial import Imu


def imu_input(gyro: Timed, accelerometer: Timed) -> tuple[np.ndarray, Imu]:
    """The input of `jaxfilt.merge`: over each interval between two stamps of the gyroscope the mean of their readings.

    A reading held from its stamp on would be half an interval late.

    Args:
        gyro: stamps (K,) s and readings (K, 3), rad/s.
        accelerometer: stamps and readings (L, 3), m/s^2, interpolated where its stamps are others.

    Returns:
        (t, Imu), with leading axis K - 1.
    """
    t = gyro[0]
    force = np.stack([np.interp(t, accelerometer[0], a) for a in accelerometer[1].T], axis=1)
    return t[:-1], Imu(*(0.5 * (a[1:] + a[:-1]) for a in (gyro[1], force)))


def imu_at(stamps: np.ndarray, imu: tuple[np.ndarray, Imu]) -> Imu:
    """What the IMU read over the interval that ends at each of these stamps (K,), s: leading axis K."""
    t, readings = imu
    rows = np.clip(np.searchsorted(t, stamps, side="left") - 1, 0, len(t) - 1)
    return Imu(readings.gyro[rows], readings.accelerometer[rows])


def level(force: np.ndarray, yaw: float = 0.0) -> np.ndarray:
    """The attitude (4,) at which a vehicle at rest reads this specific force (3,), with a yaw (rad) of your choice.

    ``roll = atan2(f_y, f_z)``, ``pitch = atan2(-f_x, |f_y, f_z|)``.

    Example: nose up by 90 degrees, so that x feels the support.
        >>> import numpy as np
        >>> [round(float(a), 4) for a in level(np.array([9.81, 0.0, 0.0]))]
        [0.7071, 0.0, -0.7071, 0.0]

    Source: P. D. Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems (2013), eq. 5.101.
    """
    roll, pitch = np.arctan2(force[1], force[2]), np.arctan2(-force[0], np.hypot(force[1], force[2]))
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a / 2), np.sin(a / 2)) for a in (roll, pitch, yaw))
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )
