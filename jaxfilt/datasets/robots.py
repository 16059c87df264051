"""Readers of recorded ground robots: odometry on two wheels, landmarks, poor GPS, ranges to beacons."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxfilt.datasets.common import Contents, Source, arrays, increasing, sensed, table, tagged_rows
from jaxfilt.types import Stream


def utias_mrclam(folder: Path, sequence: str) -> Contents:
    """UTIAS MRCLAM, dataset 7: one of five iRobot Create robots among 15 landmarks, 15 minutes; sequence "1" ... "5".

    Streams: ``landmark``, z = (range m, bearing rad, left positive), c = the landmark's place (2,), m, world;
    ``robot``, the same of another robot, c = its number. Readings of unknown barcodes (9, robot 3) are left out.
    Inputs: ``odometry`` (speed m/s, turn rate rad/s), at 67 Hz, as commanded; gaps up to 1.4 s.
    Truth: ``pos`` (2,) m, ``yaw`` rad, wrapped; Vicon at 65 Hz, gaps up to 0.3 s. World: x, y of the room.
    Constants: ``landmarks``, number -> place (2,), m. Times: Unix, one clock.
    """
    folder = folder / "dataset7"
    place = {int(row[0]): row[1:3] for row in table(folder / "Landmark_Groundtruth.dat")}
    subject = {int(code): int(number) for number, code in table(folder / "Barcodes.dat")}
    seen = table(folder / f"Robot{sequence}_Measurement.dat")
    who = np.array([subject.get(int(code), 0) for code in seen[:, 1]])
    mark, robot = who > 5, (who > 0) & (who <= 5)
    places = np.array([place[k] for k in who[mark]])
    streams = {
        "landmark": Stream(seen[mark, 0], (seen[mark, 2], seen[mark, 3]), places),
        "robot": Stream(seen[robot, 0], (seen[robot, 2], seen[robot, 3]), who[robot].astype(float)),
    }
    odometry = table(folder / f"Robot{sequence}_Odometry.dat.gz")
    truth = table(folder / f"Robot{sequence}_Groundtruth.dat.gz")
    return Contents(
        streams,
        {"odometry": increasing(odometry[:, 0], odometry[:, 1:3])},
        {"pos": (truth[:, 0], truth[:, 1:3]), "yaw": (truth[:, 0], truth[:, 3])},
        {"landmarks": place},
    )


def nclt_1hz(folder: Path, sequence: str) -> Contents:
    """NCLT at 1 Hz: a Segway on a campus, outdoors and indoors, 17 to 80 minutes; sequence: the date.

    Streams: ``gps`` and ``rtk`` (2,) m, missing where there is no new fix; ``heading`` rad and ``turn_rate`` rad/s
    of the IMU. GPS errors are heavy-tailed and correlated in time. Inputs: ``wheels`` (2,) left, right, m/s.
    Truth: ``pos`` (2,) m and ``yaw`` rad, of lidar scan matching and RTK GPS, a decimetre or so.
    Constants: ``start`` (2,) m, where the authors of the resampled files let their filters begin.
    Frame: (north, east), heading from north to east. Time: seconds of the run, row k is second k.
    """
    a = arrays(folder / f"{sequence}.npz")
    t = np.arange(len(a["truth_xy"]), dtype=float)
    streams = {
        "gps": sensed(t, a["gps"]),
        "rtk": sensed(t, a["gps_rtk"]),
        "heading": Stream(t, a["wheel"][:, 2]),
        "turn_rate": Stream(t, a["wheel"][:, 3]),
    }
    return Contents(
        streams,
        {"wheels": (t, a["wheel"][:, :2])},
        {"pos": (t, a["truth_xy"]), "yaw": (t, a["truth_heading"])},
        {"start": a["initial_state"][:2]},
    )


def wifibot(folder: Path, sequence: str) -> Contents:
    """Wifibot: a small robot on four wheels, 12 to 117 s; sequence "1", "2" or "4".

    Streams: none. Inputs: ``odometry`` (forward speed m/s, sideways speed m/s, turn rate rad/s) of the wheels, 50 Hz.
    Truth: ``pos`` (2,) m, ``yaw`` rad; OptiTrack. Frame: that of the first pose in runs 1 and 2.
    """
    a = table(folder / f"wifibot{sequence}.txt", skip=1)
    t = a[:, 0]
    return Contents({}, {"odometry": (t, a[:, [2, 3, 1]])}, {"pos": (t, a[:, 5:7]), "yaw": (t, a[:, 4])}, {})


def plaza_range(folder: Path, sequence: str) -> Contents:
    """CMU Plaza 1: a robot lawn-mower among four radio beacons, 1.9 km in 32 minutes; sequence "plaza1".

    Streams: ``range`` m, c = the beacon's place (2,), m; about 2.9 m too long, standard deviation 1.0-1.3 m.
    Inputs: ``odometry`` (distance m, turn rad) since the input before: encoders and a fibre-optic gyro, 5 Hz.
    Truth: ``pos`` (2,) m, ``yaw`` rad; RTK GPS, 2 cm, 5 Hz. Constants: ``beacons``, number -> place (2,), m.
    """
    a = arrays(folder / "plaza1.npz")
    ranges = a["TD"][np.argsort(a["TD"][:, 0], kind="stable")]
    beacons = {int(row[0]): row[1:3] for row in a["TL"]}
    places = np.array([beacons[int(k)] for k in ranges[:, 2]])
    truth, odometry = a["GT"], a["DR"]
    return Contents(
        {"range": Stream(ranges[:, 0], ranges[:, 3], places)},
        {"odometry": (odometry[:, 0], odometry[:, 1:3])},
        {"pos": (truth[:, 0], truth[:, 1:3]), "yaw": (truth[:, 0], truth[:, 3])},
        {"beacons": beacons},
    )


def uwb_labyrinth(folder: Path, sequence: str) -> Contents:
    """Labyrinth: a robot on two wheels with one range at a time to one of four UWB modules, 30 s; sequence "indoor".

    Streams: ``range`` m, c = the module's place (2,), m; standard deviation as stated by the authors 0.1 m.
    Inputs: ``wheels`` (right, left) m/s, 8 Hz, as the file names them; in the world of the modules' places and of the
    truth "right" is the left one. Truth: ``pos`` (2,) m, origin not stated.
    Constants: ``track_width`` m, as the file has it: half the distance between the wheels.
    """
    ranges = tagged_rows(folder / "Indoor_UWB_Input.txt", "range2")
    odometry = tagged_rows(folder / "Indoor_UWB_Input.txt", "odom2diff")
    truth = tagged_rows(folder / "Indoor_UWB_GT.txt", "point2")
    return Contents(
        {"range": Stream(ranges[:, 0], ranges[:, 1], ranges[:, 3:5])},
        {"wheels": (odometry[:, 0], odometry[:, 1:3])},
        {"pos": (truth[:, 0], truth[:, 1:3])},
        {"track_width": float(odometry[0, 4])},
    )


SOURCES = {
    "utias_mrclam": Source(
        ("1", "2", "3", "4", "5"),
        utias_mrclam,
        "asrl.utias.utoronto.ca/datasets/mrclam, or github.com/ericguerrero/MUSI-lab-session-1, data/MRCLAM_Dataset7; "
        "folder dataset7/, Odometry and Groundtruth gzipped",
        "none stated; offered freely by the authors, who ask to be cited",
        "K. Y. K. Leung, Y. Halpern, T. D. Barfoot, H. H. T. Liu, The UTIAS multi-robot cooperative localization and "
        "mapping dataset, Int. J. Robotics Research 30(8), 2011",
    ),
    "nclt_1hz": Source(
        ("2013-01-10", "2013-02-23", "2013-04-05"),
        nclt_1hz,
        "github.com/SongJgit/KalmanNet4SensorFusion, data/NCLT/processed, as <date>.npz; original: "
        "robots.engin.umich.edu/nclt",
        "Open Database License (original); none stated for the resampled files",
        "N. Carlevaris-Bianco, A. K. Ushani, R. M. Eustice, University of Michigan North Campus long-term vision and "
        "lidar dataset, Int. J. Robotics Research 35(9), 2016; resampled by J. Song, W. Mei, Y. Xu, Q. Fu, L. Bu, "
        "Practical implementation of KalmanNet for accurate data fusion in integrated navigation, IEEE Signal "
        "Processing Letters 31, 2024",
    ),
    "wifibot": Source(
        ("2", "1", "4"),
        wifibot,
        "github.com/CAOR-MINES-ParisTech/ukfm, python/examples/data",
        "BSD 3-Clause",
        "M. Brossard, A. Barrau, S. Bonnabel, A code for unscented Kalman filtering on manifolds (UKF-M), ICRA 2020",
    ),
    "plaza_range": Source(
        ("plaza1",),
        plaza_range,
        "github.com/borglab/gtsam, examples/Data/Plaza1_.mat, as plaza1.npz",
        "redistributed by GTSAM under BSD; none stated for the original",
        "J. Djugash, B. Hamner, S. Roth, Navigating with ranging radios: five data sets with ground truth, J. Field "
        "Robotics 26(9), 2009",
    ),
    "uwb_labyrinth": Source(
        ("indoor",),
        uwb_labyrinth,
        "github.com/TUC-ProAut/libRSF, datasets/Indoor_UWB",
        "CC BY-SA 4.0",
        "T. Pfeifer, libRSF, TU Chemnitz, The Labyrinth Dataset, 2017-2023",
    ),
}
