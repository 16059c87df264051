"""The robots that can be studied by name."""

from __future__ import annotations

from collections.abc import Callable

from jaxfilt.models import (
    altitude,
    attitude,
    car,
    ctrv,
    falling,
    growth,
    inertial_flight,
    landing,
    loop,
    lti,
    multirotor,
    textbook,
    tracking,
    wheeled,
)
from jaxfilt.types import Scenario

SCENARIOS: dict[str, Callable[[], Scenario]] = {
    "car": car.scenario,
    "car-harsh": car.harsh_scenario,
    "car-like": car.car_like_scenario,
    "ctrv": ctrv.ctrv_scenario,
    "unicycle": wheeled.unicycle_scenario,
    "two-wheeled": wheeled.two_wheeled_scenario,
    "multirotor": multirotor.scenario,
    "multirotor-harsh": multirotor.harsh_scenario,
    "multirotor-euler": multirotor.euler_scenario,
    "hexarotor": multirotor.hexarotor_scenario,
    "multirotor-loop": loop.loop_scenario,
    "attitude": attitude.scenario,
    "inertial": inertial_flight.inertial_scenario,
    "inertial-gnss": inertial_flight.inertial_gnss_scenario,
    "landing": landing.landing_scenario,
    "vertical-drone": altitude.vertical_drone_scenario,
    "table-drone": altitude.table_drone_scenario,
    "level-drone": altitude.level_drone_scenario,
    "horizontal-drone": textbook.horizontal_drone_scenario,
    "voltmeter": textbook.voltmeter_scenario,
    "pendulum": textbook.pendulum_scenario,
    "gps-robot": textbook.gps_robot_scenario,
    "gps-accelerometer-robot": textbook.gps_accelerometer_robot_scenario,
    "lti": lti.lti_scenario,
    "hidden-bias": lti.hidden_bias_scenario,
    "growth": growth.growth_scenario,
    "bearings-only": tracking.bearings_only_scenario,
    "coordinated-turn": tracking.coordinated_turn_scenario,
    "reentry": falling.reentry_scenario,
    "falling-body": falling.falling_body_scenario,
}
"""Name -> function that returns its `Scenario`; the first line of its docstring says what happens."""


def scenario(name: str) -> Scenario:
    """The scenario of this name.

    Raises:
        KeyError: a name that is not in `SCENARIOS`.

    Example:
        >>> list(scenario("car").blocks)
        ['position', 'yaw', 'speed']
    """
    if name not in SCENARIOS:
        raise KeyError(f"scenario: expected one of {', '.join(SCENARIOS)}, got {name!r}")
    return SCENARIOS[name]()


def about(name: str) -> str:
    """What happens in the scenario of this name, in a line."""
    return (SCENARIOS[name].__doc__ or "").strip().splitlines()[0].replace("``", "")
