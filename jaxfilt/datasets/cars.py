"""Readers of recorded cars: laser and radar, GNSS, wheels and steering on the CAN bus, inertial sensors."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxfilt.datasets import geodesy
from jaxfilt.datasets.common import Contents, Source, arrays, increasing, named_columns, table, tagged_rows
from jaxfilt.types import Stream


def udacity_ctrv(folder: Path, sequence: str) -> Contents:
    """Udacity's laser and radar file: 25 s of a *simulated* bicycle; sequence "synthetic".

    Streams: ``lidar`` (2,) m, and ``radar`` (range m, bearing rad, range rate m/s), alternately, together 20 Hz; the
    sensors stand at the origin. Standard deviations handed out with the file: 0.15 m; 0.3 m, 0.03 rad, 0.3 m/s.
    Truth, exact: ``pos`` (2,) m, ``vel`` (2,) m/s, ``yaw`` rad, ``turn_rate`` rad/s. Times: Unix.
    """
    path = folder / "obj_pose-laser-radar-synthetic-input.txt"
    laser, radar = tagged_rows(path, "L"), tagged_rows(path, "R")
    t_laser, t_radar = laser[:, 2] * 1e-6, radar[:, 3] * 1e-6
    order = np.argsort(np.r_[t_laser, t_radar])
    t, x = np.r_[t_laser, t_radar][order], np.r_[laser[:, 3:], radar[:, 4:]][order]
    return Contents(
        {"lidar": Stream(t_laser, laser[:, :2]), "radar": Stream(t_radar, tuple(radar[:, :3].T))},
        {},
        {"pos": (t, x[:, :2]), "vel": (t, x[:, 2:4]), "yaw": (t, x[:, 4]), "turn_rate": (t, x[:, 5])},
        {},
    )


def dart_car(folder: Path, sequence: str) -> Contents:
    """DART: a car of 1/10 scale driven by hand in a motion-capture room, 68 to 105 s; sequence: the file.

    Streams, 10 Hz, from when the car starts: ``speed`` m/s (wheel encoder), ``turn_rate`` rad/s (gyroscope),
    ``accelerometer`` (2,) m/s2, not calibrated. Stamped when they arrive, about 0.1 s late.
    Inputs: ``throttle`` and ``steering``, each -1 ... 1 (steering: left positive).
    Truth: ``pos`` (2,) m, ``yaw`` rad, wrapped; Vicon at 100 Hz. Times: Unix.
    """
    column = named_columns(folder / f"{sequence}.csv.gz")
    t = column["vicon time"]
    # Sensor columns repeat their last value at the rate of the truth: a reading is where their own clock moves on.
    new = np.flatnonzero(np.diff(column["elapsed time sensors"]) > 0) + 1
    streams = {
        "speed": Stream(t[new], column["vel encoder"][new]),
        "turn_rate": Stream(t[new], column["W (IMU)"][new]),
        "accelerometer": Stream(t[new], np.stack([column["acc x (IMU)"], column["acc y (IMU)"]], 1)[new]),
    }
    inputs = {name: (t[new], column[name][new]) for name in ("throttle", "steering")}
    pos = np.stack([column["vicon x"], column["vicon y"]], 1)
    return Contents(streams, inputs, {"pos": (t, pos), "yaw": (t, column["vicon yaw"])}, {})


def comma2k19(folder: Path, sequence: str) -> Contents:
    """comma2k19: one minute on a Californian highway; sequence "segment40"; hold out its last third by convention.

    World: east, north, up (m) from the first truth position. Body: forward, right, down (as the phone).
    Streams: ``gnss`` (3,) m, u-blox, 10 Hz; ``gnss_coarse`` (3,) m, Qualcomm, 0.5 Hz; ``speed`` m/s; ``wheels`` (4,)
    m/s, front left, front right, rear left, rear right; ``magnetometer`` (3,) uT.
    Inputs: ``gyro`` (3,) rad/s, ``accelerometer`` (3,) m/s2 (specific force), 104 Hz; ``steering`` rad, at the
    steering wheel, 83 Hz. The raw pseudoranges in the file are not read.
    Truth, 20 Hz: ``pos`` (3,) m, ``vel`` (3,) m/s, ``attitude`` (w, x, y, z), body to world; of the authors'
    GNSS, vision and inertial optimisation, a few decimetres, not independent of ``gnss``. Times: since boot.
    """
    a = arrays(folder / "segment40.npz")
    frame = geodesy.local_frame(a["truth_pos_ecef"][0])
    t = a["truth_t"]

    def fix(name: str) -> Stream:
        latitude, longitude, altitude = np.radians(a[name][:, 0]), np.radians(a[name][:, 1]), a[name][:, 4]
        return Stream(a[f"{name}_t"], frame.position(geodesy.earth_centred(latitude, longitude, altitude)))

    streams = {
        "gnss": fix("ublox"),
        "gnss_coarse": fix("qcom"),
        "speed": Stream(a["speed_t"], a["speed"]),
        "wheels": Stream(a["wheel_t"], a["wheel_speed"]),
        "magnetometer": Stream(a["mag_t"], a["mag"]),
    }
    inputs = {
        "gyro": increasing(a["gyro_t"], a["gyro"]),
        "accelerometer": increasing(a["accel_t"], a["accel"]),
        "steering": increasing(a["steer_t"], np.radians(a["steer_deg"])),
    }
    truth = {
        "pos": (t, frame.position(a["truth_pos_ecef"])),
        "vel": (t, frame.direction(a["truth_vel_ecef"])),
        "attitude": (t, frame.attitude(a["truth_quat"])),
    }
    return Contents(streams, inputs, truth, {})


def kitti_imu_gps(folder: Path, sequence: str) -> Contents:
    """KITTI as in GTSAM's example: 7.9 minutes of a car in Karlsruhe; sequence "drive"; hold out its last third.

    Streams: ``gnss`` (3,) m, RTK, 1 Hz. Inputs: ``gyro`` (3,) rad/s and ``accelerometer`` (3,) m/s2, 100 Hz; body x
    forward, y left, z up; a gap of 1.9 s after the first row. Truth: none but fixes that are withheld.
    Constants: noise by the authors, ``accelerometer_std`` 0.01, ``gyro_std`` 1.75e-4, ``accelerometer_bias_std``
    1.67e-4, ``gyro_bias_std`` 2.91e-6, SI units. World: local, z up. Times: seconds of the day.
    """
    imu, gnss = table(folder / "imu.txt.gz", skip=1), table(folder / "gps.csv", skip=1, delimiter=",")
    noise = table(folder / "imu_metadata.txt", skip=1)[0]
    names = ("accelerometer_std", "gyro_std", "accelerometer_bias_std", "gyro_bias_std")
    return Contents(
        {"gnss": Stream(gnss[:, 0], gnss[:, 1:4])},
        {"gyro": (imu[:, 0], imu[:, 5:8]), "accelerometer": (imu[:, 0], imu[:, 2:5])},
        {},
        {name: float(noise[i]) for name, i in zip(names, (6, 7, 9, 10), strict=True)},
    )


def smartloc_berlin(folder: Path, sequence: str) -> Contents:
    """smartLoc: 4.7 minutes of a car in an urban canyon in Berlin; sequence "potsdamer_platz"; hold out its last third.

    World: east, north, up (m) from the first truth position.
    Streams: ``pseudorange`` m, freed of atmosphere and satellite clock (by the authors) and of the Earth's rotation
    during the flight of the signal (here, the Sagnac term at the origin, good to centimetres within kilometres),
    c = {``satellite`` (3,) m, ``system`` 1 GPS 4 GLONASS, ``number``, ``elevation`` rad, ``cn0`` dBHz, ``variance``
    m2 as stated}; gross multipath. 15 satellites an epoch, 5 Hz, all of one stamp.
    Inputs: ``odometry`` (3 speeds m/s, 3 turn rates rad/s), body forward, left, up.
    Truth: ``pos`` (3,) m, geodetic GNSS and inertial reference. Times: seconds of the run.
    """
    path = folder / "Berlin_Potsdamer_Platz_Input.txt.gz"
    odometry, seen = tagged_rows(path, "odom3"), tagged_rows(path, "pseudorange3")
    truth = tagged_rows(folder / "Berlin_Potsdamer_Platz_GT.txt", "point3")
    frame = geodesy.local_frame(truth[0, 1:4])
    context = {
        "satellite": frame.position(seen[:, 3:6]),
        "system": seen[:, 7],
        "number": seen[:, 6],
        "elevation": np.radians(seen[:, 8]),
        "cn0": seen[:, 9],
        "variance": seen[:, 2],
    }
    ranges = seen[:, 1] - geodesy.sagnac(seen[:, 3:6], truth[0, 1:4])
    return Contents(
        {"pseudorange": Stream(seen[:, 0], ranges, context)},
        {"odometry": (odometry[:, 0], odometry[:, 1:7])},
        {"pos": (truth[:, 0], frame.position(truth[:, 1:4]))},
        {},
    )


SOURCES = {
    "udacity_ctrv": Source(
        ("synthetic",),
        udacity_ctrv,
        "github.com/jamesjosephreynolds/CarND-Unscented-Kalman-Filter-Project, data/",
        "MIT",
        "Udacity, CarND-Unscented-Kalman-Filter-Project, 2017",
    ),
    "dart_car": Source(
        ("free_driving_2", "free_driving_1", "throttle_ramp_steer025"),
        dart_car,
        "github.com/Lorenzo-Lyons/DART, System_identification/Data, gzipped",
        "MIT",
        "L. Lyons, T. Niesten, L. Ferranti, DART: a compact platform for autonomous driving research, IEEE Intelligent "
        "Vehicles Symposium 2024",
    ),
    "comma2k19": Source(
        ("segment40",),
        comma2k19,
        "github.com/commaai/comma2k19, Example_1/b0c9d2329ad1606b|2018-08-02--08-34-47/40, as segment40.npz",
        "MIT",
        "H. Schafer, E. Santana, A. Haden, R. Biasini, A commute in data: the comma2k19 dataset, arXiv:1812.05752, "
        "2018",
    ),
    "kitti_imu_gps": Source(
        ("drive",),
        kitti_imu_gps,
        "github.com/borglab/gtsam, examples/Data: KittiEquivBiasedImu.txt (gzipped, as imu.txt.gz), "
        "KittiGps_converted.txt (as gps.csv), KittiEquivBiasedImu_metadata.txt (as imu_metadata.txt)",
        "CC BY-NC-SA 3.0 (KITTI), redistributed by GTSAM under BSD",
        "A. Geiger, P. Lenz, C. Stiller, R. Urtasun, Vision meets robotics: the KITTI dataset, Int. J. Robotics "
        "Research 32(11), 2013",
    ),
    "smartloc_berlin": Source(
        ("potsdamer_platz",),
        smartloc_berlin,
        "github.com/TUC-ProAut/libRSF, datasets/smartLoc, Input gzipped",
        "CC BY-SA 4.0",
        "P. Reisdorf, T. Pfeifer, J. Bressler, S. Bauer, P. Weissig, S. Lange, G. Wanielik, P. Protzel, The problem of "
        "comparable GNSS results, VEHICULAR 2016",
    ),
}
