"""Readers of recorded multirotors, and of the inertial sensors that they carry."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from jaxfilt.datasets.common import (
    Contents,
    Source,
    arrays,
    each,
    increasing,
    known,
    sensed,
    table,
    text_rows,
)
from jaxfilt.types import Stream

STANDARD_GRAVITY = 9.80665
"""m/s2 in one g, the unit of some accelerometers."""


def crazyflie_uwb(folder: Path, sequence: str) -> Contents:
    """Crazyflie: five indoor flights of 58 to 87 s among eight UWB anchors; sequence: the figure flown.

    Streams: ``range_1`` ... ``range_8`` m, c = the anchor's place (3,), 50 Hz (30 Hz where the name says so); each
    anchor is biased by 0 to -0.35 m and has a noise of its own, 0.03 to 0.3 m. ``flow`` (2,) pixels per log interval;
    ``height`` m, laser range to the floor. Inputs: ``accelerometer`` (3,) m/s2 (specific force), ``gyro`` (3,) rad/s,
    body x forward, y left, z up; ``setpoint`` (3,) m. Of repeated input stamps the last is kept; streams keep all.
    Truth: ``pos`` (3,) m, Vicon, 200 Hz, z up. Stamps of the sensors are up to 0.12 s late. Times: of the log.
    Constants: ``anchors`` (8, 3) m.
    """
    a = arrays(folder / f"{sequence}.npz")
    anchors = a["anchor_pos"].T
    ranges = {}
    for k in range(8):
        t, z = (a["t_uwb1"], a["uwb1"][:, k]) if k < 4 else (a["t_uwb2"], a["uwb2"][:, k - 4])
        ranges[f"range_{k + 1}"] = Stream(t, z, each(anchors[k], len(t)))
    streams = {
        **ranges,
        "flow": Stream(a["t_flow"], a["flowdeck"][:, :2]),
        "height": Stream(a["t_flow"], a["flowdeck"][:, 2]),
    }
    inputs = {
        "accelerometer": increasing(a["t_imu"], STANDARD_GRAVITY * a["imu"][:, :3]),
        "gyro": increasing(a["t_imu"], np.radians(a["imu"][:, 3:])),
        "setpoint": increasing(a["t_cmds"], a["ref"][:, :3]),
    }
    return Contents(streams, inputs, {"pos": increasing(a["t_vicon"], a["pos_vicon"])}, {"anchors": anchors})


def ansfl_phantom4(folder: Path, sequence: str) -> Contents:
    """DJI Phantom 4 RTK with four inertial sensors: 13 outdoor flights of 15 to 54 s; sequence: the file.

    Inputs: ``accelerometer_1`` ... ``accelerometer_4`` (3,) m/s2 (specific force) and ``gyro_1`` ... ``gyro_4`` (3,)
    rad/s, 120 Hz, body x forward, y left, z up. Streams: ``euler_1`` ... (3,) rad, of the sensors' own filters.
    Truth, 10 Hz: ``pos`` (3,) m east, north, up (up in steps of 0.1 m), ``speed`` m/s, ``roll``, ``pitch`` rad (body
    forward, right, down, as aircraft have it), ``yaw`` rad from east to north. RTK, a few centimetres.
    The sensors' clocks are off by ``clock_offset`` (4,) s, a constant that is taken off here. Times: of the RTK log.
    """
    a = arrays(folder / f"{sequence}.npz")
    offsets = _PHANTOM_CLOCKS[sequence]
    streams, inputs = {}, {}
    for k, offset in zip((1, 2, 3, 4), offsets, strict=True):
        imu = a[f"IMU_{k}"]
        t = imu[:, 0] - offset
        streams[f"euler_{k}"] = Stream(t, np.radians(imu[:, 1:4]))
        inputs[f"accelerometer_{k}"] = increasing(t, imu[:, 4:7])
        inputs[f"gyro_{k}"] = increasing(t, np.radians(imu[:, 7:10]))
    g = a["GT"]
    truth = {
        "pos": g[:, [8, 7, 6]],
        "speed": g[:, 2],
        "roll": np.radians(g[:, 5]),
        "pitch": np.radians(g[:, 4]),
        "yaw": np.radians(90 - g[:, 3]),
    }
    return Contents(
        streams, inputs, {name: (g[:, 0], x) for name, x in truth.items()}, {"clock_offset": np.array(offsets)}
    )


_PHANTOM_CLOCKS = {
    "Horizontal_path_01": (0.69,) * 4,
    "Horizontal_path_02": (0.05,) * 4,
    "Horizontal_path_03": (0.05,) * 4,
    "Horizontal_path_05": (0.05,) * 4,
    "Horizontal_path_06": (0.165,) * 4,
    "Horizontal_path_07": (0.165,) * 4,
    "Horizontal_path_08": (0.40,) * 4,
    "Horizontal_path_09": (0.40,) * 4,
    "Horizontal_path_10": (0.40,) * 4,
    "Horizontal_path_16": (-0.36,) * 4,
    "Horizontal_path_22": (-0.64,) * 4,
    "StraightLine_path_01": (0.06, 0.15, 0.15, 0.15),
    "StraightLine_path_02": (0.03, 0.08, 0.08, 0.08),
}
"""Clock of each inertial sensor minus that of the RTK log, s, from the best match of its roll angle with the truth."""


def euroc_mav(folder: Path, sequence: str) -> Contents:
    """EuRoC: three flights of a hexacopter in a machine hall and a room, 86 to 184 s; sequence: the flight.

    Inputs: ``gyro`` (3,) rad/s, ``accelerometer`` (3,) m/s2 (specific force), 200 Hz, in the body frame.
    Streams: MH_01_easy ``leica`` (3,) m, of the prism, 20 Hz; V2_03_difficult ``vicon`` (position (3,) m, quaternion
    (w, x, y, z)) of the Vicon body, 100 Hz; V1_02_medium none. Their clocks are off by ``clock_offset`` s, which is
    taken off here. Truth, 200 Hz: ``pos`` (3,) m, z up; ``attitude`` (w, x, y, z), body to world; and, but for
    MH_01_easy, ``vel`` (3,) m/s, ``gyro_bias``, ``accelerometer_bias``; a batch estimate over the same measurements.
    Constants: ``lever_arm`` (3,) m, the place of the prism or Vicon body in the body frame; ``rotation`` (3, 3), Vicon
    body to body; noise densities by the authors, SI units: ``gyro_noise``, ``gyro_bias_walk``,
    ``accelerometer_noise``, ``accelerometer_bias_walk``. Times: Unix.
    """
    folder = folder / sequence
    imu = table(folder / "imu0.csv.gz", delimiter=",")
    t = imu[:, 0] * 1e-9
    constants = {
        "gyro_noise": 1.6968e-4,
        "gyro_bias_walk": 1.9393e-5,
        "accelerometer_noise": 2.0e-3,
        "accelerometer_bias_walk": 3.0e-3,
    }
    streams = {}
    if sequence == "MH_01_easy":
        offset, a = 0.135, table(folder / "leica0.csv", delimiter=",")
        streams["leica"] = Stream(a[:, 0] * 1e-9 - offset, a[:, 1:4])
        constants |= {"clock_offset": offset, "lever_arm": np.array([0.0748903, -0.0184772, -0.120209])}
        g = table(folder / "groundtruth_pose.txt.gz")
        truth = {"pos": g[:, 1:4], "attitude": g[:, [7, 4, 5, 6]]}
        t_truth = g[:, 0]
    else:
        g = table(folder / "groundtruth.csv.gz", delimiter=",")
        t_truth = g[:, 0] * 1e-9
        blocks = {
            "pos": (1, 4),
            "attitude": (4, 8),
            "vel": (8, 11),
            "gyro_bias": (11, 14),
            "accelerometer_bias": (14, 17),
        }
        truth = {name: g[:, i:j] for name, (i, j) in blocks.items()}
    if sequence == "V2_03_difficult":
        offset, a = -0.196, table(folder / "vicon0.csv.gz", delimiter=",")
        streams["vicon"] = Stream(a[:, 0] * 1e-9 - offset, (a[:, 1:4], a[:, 4:8]))
        rotation = [[0.33638, -0.01749, 0.94156], [-0.02078, -0.99972, -0.01114], [0.94150, -0.01582, -0.33665]]
        lever_arm = np.array([0.06901, -0.02781, -0.12395])
        constants |= {"clock_offset": offset, "lever_arm": lever_arm, "rotation": np.array(rotation)}
    return Contents(
        streams,
        {"gyro": (t, imu[:, 1:4]), "accelerometer": (t, imu[:, 4:7])},
        {name: (t_truth, x) for name, x in truth.items()},
        constants,
    )


def rcv_uwb_drone(folder: Path, sequence: str) -> Contents:
    """RCV: two indoor flights, 227 and 118 s, with ranges to four UWB anchors; sequence "sequence3", "sequence6".

    Streams: ``range_1`` ... ``range_4`` m, c = the anchor's place (3,), 6 Hz each; 0.2 m too long, with gross
    outliers. The anchors are nearly in one plane, so height has a mirror solution. No inertial sensor.
    Truth: ``pos`` (3,) m, ``attitude`` (w, x, y, z); Qualisys, 100 Hz, gaps up to 7 s. Constants: ``anchors`` (4, 3) m.
    Times: Unix (UTC assumed).
    """
    folder = folder / sequence
    anchors = _anchors(folder / "anchor.yaml")
    streams = {}
    for k, anchor in enumerate(anchors, start=1):
        rows = text_rows(folder / f"anchor_{k}.csv")
        ranges = np.array([float(row[2]) for row in rows])
        streams[f"range_{k}"] = Stream(_stamps(rows), ranges, each(anchor, len(rows)))
    rows = text_rows(folder / "gt.csv.gz")
    t, pose = _stamps(rows), np.array([row[1:] for row in rows], float)
    truth = {"pos": (t, pose[:, :3]), "attitude": (t, pose[:, [6, 3, 4, 5]])}
    return Contents(streams, {}, truth, {"anchors": anchors})


def _stamps(rows: list[list[str]]) -> np.ndarray:
    return np.array([datetime.fromisoformat(row[0]).replace(tzinfo=UTC).timestamp() for row in rows])


def _anchors(path: Path) -> np.ndarray:
    """The lists below "position:" of a file that is all lists: [x, y, z], m."""
    lines = path.read_text().splitlines()
    places = [lines[i + 1] for i, line in enumerate(lines) if line.strip() == "- position:"]
    return np.array([place[place.index("[") + 1 : place.index("]")].split(",") for place in places], float)


def broad(folder: Path, sequence: str) -> Contents:
    """BROAD: an inertial sensor on a board moved by hand, 187 s; two of the authors' 39 trials; sequence: the trial.

    Inputs: ``gyro`` (3,) rad/s. Streams: ``accelerometer`` (3,) m/s2 (specific force), ``magnetometer`` (3,) uT; all
    286 Hz, sensor frame. Truth: ``attitude`` (w, x, y, z), sensor to world, z up, up to a constant turn about z;
    ``pos`` (3,) m; OptiTrack, gaps left out; ``moving`` 1 where the authors score, 0 at rest. Times: of the trial.
    """
    a = arrays(folder / f"{sequence}.npz")
    t = np.arange(len(a["imu_gyr"])) / float(a["sampling_rate"].ravel()[0])
    return Contents(
        {"accelerometer": sensed(t, a["imu_acc"]), "magnetometer": sensed(t, a["imu_mag"])},
        {"gyro": (t, a["imu_gyr"])},
        {
            "attitude": known(t, a["opt_quat"]),
            "pos": known(t, a["opt_pos"]),
            "moving": (t, a["movement"].astype(float)),
        },
        {},
    )


SOURCES = {
    "crazyflie_uwb": Source(
        ("circle_xy", "circle_xy_fast", "circle_xy_log30hz", "sine_xyz", "sine_xyz_log30hz"),
        crazyflie_uwb,
        "github.com/msorocky/AER1513_Project, data/*.mat, as npz",
        "none stated",
        "M. Sorocky and co-authors, AER1513_Project, 2018; the same hardware: W. Zhao, A. Goudar, J. Panerati, A. P. "
        "Schoellig, Learning-based bias correction for ultra-wideband localization of resource-constrained mobile "
        "robots, arXiv:2003.09371, 2020",
    ),
    "ansfl_phantom4": Source(
        tuple(_PHANTOM_CLOCKS),
        ansfl_phantom4,
        "github.com/ansfl/Quadrotor-Dead-Reckoning-with-Multiple-Inertial-Sensors, the tables of a flight as one npz",
        "CC BY 4.0",
        "D. Hurwitz, I. Klein, Quadrotor dead reckoning with multiple inertial sensors, arXiv:2310.13452, 2023",
    ),
    "euroc_mav": Source(
        ("V2_03_difficult", "V1_02_medium", "MH_01_easy"),
        euroc_mav,
        "projects.asl.ethz.ch/datasets (ASL, ETH Zurich), csv files gzipped",
        "non-commercial use permitted (not verified)",
        "M. Burri, J. Nikolic, P. Gohl, T. Schneider, J. Rehder, S. Omari, M. W. Achtelik, R. Siegwart, The EuRoC "
        "micro aerial vehicle datasets, Int. J. Robotics Research 35(10), 2016",
    ),
    "rcv_uwb_drone": Source(
        ("sequence3", "sequence6"),
        rcv_uwb_drone,
        "github.com/cjhhalla/RCV_uwb_dataset, gt.csv gzipped",
        "none stated; the authors ask to be cited",
        "J. H. Choe, I. Shim, Addressing relative pose impact on UWB localization: dataset introduction and analysis, "
        "arXiv:2407.03890, 2024",
    ),
    "broad": Source(
        ("02_undisturbed_slow_rotation_B", "21_undisturbed_fast_combined"),
        broad,
        "github.com/dlaidig/broad, data_mat, as npz",
        "CC BY 4.0",
        "D. Laidig, M. Caruso, A. Cereatti, T. Seel, BROAD - a benchmark for robust inertial orientation estimation, "
        "Data 6(7):72, 2021",
    ),
}
