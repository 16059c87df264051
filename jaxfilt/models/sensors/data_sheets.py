"""How good usual sensors are: standard deviation, unit, rate, and who says so.

White noise only, as a part alone on a bench has it. On a robot it shakes, multipath bends the radio, the weather moves
the barometer: use them to simulate, and as a start for tuning.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax

from jaxfilt.noise import diagonal


class DataSheet(NamedTuple):
    """A sensor's white noise."""

    std: tuple[float, ...]
    """Standard deviation of each component of a reading."""
    unit: str
    """Of std, component by component where they differ."""
    rate: float
    """Hz, the usual one."""
    source: str
    """Where the numbers are from."""

    def R(self, times: float = 1.0) -> jax.Array:
        """The covariance (m, m) of a reading, its standard deviations multiplied by ``times``.

        Example:
            >>> round(float(TFMINI.R(2.0)[0, 0]), 6)
            0.0016
        """
        return diagonal(*(times * std for std in self.std))


GNSS_CONSUMER = DataSheet(
    (1.5, 1.5, 3.0), "m", 10.0, "u-blox M8 data sheet: 2.5 m CEP, less in the open; height twice as bad"
)
GNSS_VELOCITY = DataSheet((0.05, 0.05, 0.1), "m/s", 10.0, "u-blox M8 data sheet: 0.05 m/s (50 %); upwards twice as bad")
RTK = DataSheet((0.01, 0.01, 0.02), "m", 10.0, "u-blox ZED-F9P data sheet: 0.01 m + 1 ppm CEP; height twice as bad")
MOCAP = DataSheet(
    (0.001, 0.001, 0.001, 0.005, 0.005, 0.005),
    "m, rad",
    200.0,
    "EuRoC data set, Vicon of the authors: 1 mm; 5 mrad chosen",
)
LEICA = DataSheet((0.001, 0.001, 0.001), "m", 20.0, "EuRoC data set, Leica MS50 laser tracker: 1 mm")
BAROMETER = DataSheet((0.1,), "m", 50.0, "Bosch BMP388 data sheet: 1.2 Pa RMS at low power, 8.3 cm per Pa")
MAGNETOMETER = DataSheet((0.5e-6,) * 3, "T", 50.0, "Bosch BMM150 data sheet: 0.3-1.0 uT RMS by preset")
COMPASS = DataSheet((math.radians(2.5),), "rad", 50.0, "Bosch BMM150 data sheet: heading accuracy 2.5 deg")
TFMINI = DataSheet((0.02,), "m", 100.0, "Benewake TFmini-S data sheet: accuracy 6 cm up to 6 m, taken as 3 sigma")
VL53L1X = DataSheet(
    (0.01,), "m", 50.0, "ST VL53L1X data sheet: accuracy 20 mm and ranging error 1 % in the dark, about half"
)
UWB = DataSheet((0.1,), "m", 20.0, "Decawave DWM1000 data sheet: ranges to 10 cm")
OPTICAL_FLOW = DataSheet(
    (0.1, 0.1), "rad/s", 100.0, "PixArt PMW3901 has 0.02 rad a pixel at 100 Hz; a twentieth, chosen"
)
CAMERA = DataSheet((0.005, 0.005), "", 20.0, "chosen: 2 px of a target's centre at a focal length of 400 px")
VISUAL_ODOMETRY = DataSheet((0.01,) * 3 + (0.005,) * 3, "m, rad", 20.0, "chosen: 1 % of a key frame 1 m away, 0.3 deg")
WHEEL_ENCODERS = DataSheet(
    (0.2, 0.2), "rad/s", 50.0, "chosen: one of 1,000 ticks a turn in 20 ms is 0.3 rad/s, uniform"
)

DATA_SHEETS: dict[str, DataSheet] = {
    name: sheet for name, sheet in list(globals().items()) if isinstance(sheet, DataSheet)
}
"""All of them by name."""
