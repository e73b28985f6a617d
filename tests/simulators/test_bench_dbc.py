"""Any DBC file on the bench: both byte orders, floats, pages, 29 bits, requests, states, errors, the watchdog."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from on_bench import arrives, cycle_until, running, states, virtual

from hal.config import RobotConfig
from hal.errors import ConfigError
from hal.protocols.dbc import load
from simulators.nodes.dbc.frames import Output, decoded, raw_of
from simulators.robots.bench import simulator

SENSOR = """VERSION ""
BU_: Cell Host
BO_ 1792 Load: 8 Cell
 SG_ Force : 7|20@0- (0.01,-5) [-5000|5000] "N" Host
 SG_ Flags : 27|4@0+ (1,0) [0|15] "" Host
 SG_ Heat : 32|16@1+ (0.1,-40) [-40|200] "degC" Host
BO_ 2566848513 Pages: 8 Cell
 SG_ Page M : 0|8@1+ (1,0) [0|3] "" Host
 SG_ Angle m1 : 8|32@1- (1,0) [0|0] "deg" Host
 SG_ Serial m2 : 8|24@1+ (1,0) [0|0] "" Host
BO_ 1808 Ask: 2 Host
 SG_ Action : 0|8@1+ (1,0) [0|9] "" Cell
VAL_ 1792 Flags 0 "FINE" 1 "OVERLOAD" ;
VAL_ 1808 Action 3 "TARE" 4 "OPEN" ;
SIG_VALTYPE_ 2566848513 Angle : 1;
"""

SERVO = """VERSION ""
BU_: Drive Host
BO_ 256 Status: 8 Drive
 SG_ State : 0|4@1+ (1,0) [0|15] "" Host
 SG_ Fault : 4|4@1+ (1,0) [0|15] "" Host
 SG_ Place : 15|24@0- (0.001,0) [0|0] "deg" Host
 SG_ Speed : 39|16@0- (0.01,0) [0|0] "deg/s" Host
BO_ 512 Demand: 4 Host
 SG_ Mode : 0|8@1+ (1,0) [0|9] "" Drive
 SG_ Value : 8|16@1- (0.1,0) [0|0] "" Drive
BO_ 513 Order: 1 Host
 SG_ What : 0|8@1+ (1,0) [0|9] "" Drive
VAL_ 256 State 0 "BOOT" 1 "OFF_STATE" 2 "RUN" 3 "ERROR" ;
VAL_ 256 Fault 0 "NONE" 1 "HOT" 2 "TIMEOUT" ;
VAL_ 513 What 1 "START" 2 "STOP" 3 "CLEAR" ;
"""


def sensor(folder: Path) -> dict[str, Any]:
    (folder / "any_name.dbc").write_text(SENSOR)
    return {
        "robot": "cells",
        "folder": folder,
        "signals": {
            "pull_force": {"unit": "N", "elements": ["left", "right"]},
            "lever_position": {"unit": "rad", "elements": ["lever"]},
            "joint_position": {"unit": "rad", "elements": ["mover"]},
            "motor_temperature": {"unit": "degC", "elements": ["left"]},
        },
        "command": {"signal": "joint_position"},
        "limits": {"joint_position": {"low": -3.0, "high": 3.0}},
        "buses": {"can0": {"bitrate": 1000000}},
        "kinds": {
            "mover": {"driver": "mit", "settings": {"motor": "DM4310", "stiffness": 40.0, "damping": 2.0, "ramp": 0.1}},
            "cell": {
                "driver": "dbc",
                "settings": {
                    "dbc": "any_name.dbc",
                    "node_offset": 1,
                    "periods": {"Load": 0.01, "Pages": 0.01},
                    "quantities": {
                        "force": {"signal": "Load.Force"},
                        "position": {"signal": "Pages.Angle", "scale": 0.0174532925},
                        "temperature": {"signal": "Load.Heat"},
                    },
                    "gain": -2.0,
                    "zero": 0.5,
                    "error": {"signal": "Load.Flags", "good": "FINE"},
                    "identity": {"signals": ["Pages.Serial"]},
                    "open": [
                        {
                            "send": "Ask",
                            "values": {"Action": "OPEN"},
                            "until": {"signal": "Load.Flags", "equals": "FINE"},
                        }
                    ],
                    "tare": [{"send": "Ask", "values": {"Action": "TARE"}}],
                },
            },
        },
        "devices": {
            "left": {
                "kind": "cell",
                "bus": "can0",
                "node": 3,
                "elements": {
                    "force": "pull_force.left",
                    "position": "lever_position.lever",
                    "temperature": "motor_temperature.left",
                },
            },
            "mover": {"kind": "mover", "bus": "can0", "node": 90, "element": "joint_position.mover"},
            "right": {"kind": "cell", "bus": "can0", "node": 4, "element": "pull_force.right"},
        },
    }


def servo(folder: Path, quantity: str) -> dict[str, Any]:
    (folder / "load_cell.dbc").write_text(SERVO)  # the name of a shipped file says nothing
    until = {"signal": "Status.State", "equals": "RUN", "within": 2.0}
    scale = {"position": 0.0174532925, "velocity": 0.0174532925, "effort": 0.01}[quantity]
    elements = {"position": "joint_position.one", "velocity": "joint_velocity.one"}
    signals = {
        "joint_position": {"unit": "rad", "elements": ["one"]},
        "joint_velocity": {"unit": "rad/s", "elements": ["one"]},
        "joint_effort": {"unit": "N m", "elements": ["one"]},
    }
    quantities = {
        "position": {"signal": "Status.Place", "scale": 0.0174532925},
        "velocity": {"signal": "Status.Speed", "scale": 0.0174532925},
    }
    if quantity == "effort":
        quantities["effort"] = {"signal": "Status.Fault"}
        elements["effort"] = "joint_effort.one"
    else:
        del signals["joint_effort"]
    return {
        "robot": "servo",
        "folder": folder,
        "signals": signals,
        "command": {"signal": f"joint_{quantity}"},
        "stop": {"behaviour": "off" if quantity == "effort" else "hold"},
        "limits": {"joint_position": {"low": -3.0, "high": 3.0}, f"joint_{quantity}": {"low": -3.0, "high": 3.0}},
        "buses": {"can0": {"bitrate": 1000000}},
        "kinds": {
            "axis": {
                "driver": "dbc_servo",
                "settings": {
                    "dbc": "load_cell.dbc",
                    "node_offset": 16,
                    "direction": -1,
                    "periods": {"Status": 0.01},
                    "quantities": quantities,
                    "command": {
                        "quantity": quantity,
                        "send": "Demand",
                        "signal": "Value",
                        "scale": scale,
                        "while_disabled": True,
                    },
                    "state": {
                        "signal": "Status.State",
                        "ready": ["OFF_STATE"],
                        "enabled": ["RUN"],
                        "fault": ["ERROR"],
                        "booting": ["BOOT"],
                    },
                    "error": {"signal": "Status.Fault", "good": "NONE"},
                    "enable": [{"send": "Order", "values": {"What": "START"}, "until": until}],
                    "disable": [{"send": "Order", "values": {"What": "STOP"}}],
                    "reset": [{"send": "Order", "values": {"What": "CLEAR"}}],
                    "watchdog": {
                        "timeout": 0.3,
                        "fed_by": ["Demand"],
                        "expired": {"signal": "Status.Fault", "equals": "TIMEOUT"},
                    },
                },
            }
        },
        "devices": {"axis": {"kind": "axis", "bus": "can0", "node": 2, "elements": elements}},
    }


@pytest.mark.long
def test_a_sensor_sends_what_its_file_describes(tmp_path: Path) -> None:
    with running(virtual(sensor(tmp_path))) as (robot, rig):
        rig.fault("set pull_force.left 123.4")
        rig.fault("set pull_force.right -7")
        rig.fault("set lever_position.lever 0.3")
        rig.fault("set motor_temperature.left 61")
        sample = cycle_until(robot, arrives("pull_force", np.array([123.4, -7.0]), 0.02))
        sample = cycle_until(robot, arrives("lever_position", np.array([0.3]), 1e-4))
        assert sample.values["motor_temperature"] == pytest.approx([61.0], abs=0.1)
        assert sum(device.identity.startswith("dbc:any_name-") for device in robot._devices) == 2
        rig.fault("emcy right")
        cycle_until(robot, lambda one: np.isnan(one.values["pull_force"][1]))
        assert "overload" in robot.health()["devices"]["right"]["text"]


@pytest.mark.long
def test_a_sensor_takes_its_reading_as_zero(tmp_path: Path) -> None:
    with running(virtual(sensor(tmp_path))) as (robot, rig):
        rig.fault("set pull_force.left 80")
        cycle_until(robot, arrives("pull_force", np.array([80.0, 0.0]), 0.02))
        robot._devices[0].tare()
        cycle_until(robot, arrives("pull_force", np.array([0.5 - 2.0 * 0.0, 0.0]), 0.02))


@pytest.mark.long
@pytest.mark.parametrize("quantity", ["position", "velocity", "effort"])
def test_a_servo_follows_each_kind_of_set_point(tmp_path: Path, quantity: str) -> None:
    with running(virtual(servo(tmp_path, quantity))) as (robot, _):
        cycle_until(robot, lambda one: one.complete)
        target = np.array([0.4])
        cycle_until(robot, lambda one: one.values["joint_position"][0] > 0.35, target)
        assert states(robot) == {"axis": "enabled"}
        robot.disable()
        cycle_until(robot, lambda one: states(robot) == {"axis": "ready"})


@pytest.mark.long
def test_a_servo_with_frames_of_can_fd_on_a_bus_with_the_timing_of_one(tmp_path: Path) -> None:
    body = servo(tmp_path, "position")
    wide = SERVO.replace("Status: 8", "Status: 24").replace("15|24@0-", "151|24@0-").replace("Demand: 4", "Demand: 10")
    (tmp_path / "load_cell.dbc").write_text(wide)
    body["buses"]["can0"].update(
        interface="hub", channel=str(tmp_path / "can"), data_bitrate=4_000_000, options={"bit_timing": True}
    )
    with running(RobotConfig.model_validate(body)) as (robot, _):
        cycle_until(robot, lambda one: one.values["joint_position"][0] > 0.35, np.array([0.4]))
        assert states(robot) == {"axis": "enabled"}
        assert robot.health()["buses"]["can0"]["counters"]["ignored"] == 0


@pytest.mark.long
def test_a_servo_without_a_master_stops_and_says_why(tmp_path: Path) -> None:
    with running(virtual(servo(tmp_path, "position"))) as (robot, rig):
        cycle_until(robot, arrives("joint_position", np.array([0.2])), np.array([0.2]))
        node = rig.node("axis")
        deadline = time.monotonic() + 30.0
        while node.condition == "enabled" and time.monotonic() < deadline:
            time.sleep(0.05)  # no cycle, so no set-point feeds the watchdog
        assert node.condition == "disabled"
        cycle_until(robot, lambda one: robot._devices[0]._counters["watchdog_expired"] == 1)


@pytest.mark.long
def test_a_broken_servo_is_off_until_it_is_reset(tmp_path: Path) -> None:
    with running(virtual(servo(tmp_path, "position"))) as (robot, rig):
        cycle_until(robot, arrives("joint_position", np.array([0.2])), np.array([0.2]))
        rig.fault("emcy axis")
        cycle_until(robot, lambda one: states(robot) == {"axis": "fault"} and robot.mode == "fault")
        robot.reset()
        cycle_until(robot, lambda one: states(robot) == {"axis": "ready"})
        cycle_until(robot, arrives("joint_position", np.array([0.3])), np.array([0.3]))
        before = robot._devices[0]._counters["boots"]  # its start counts as one if the driver saw it
        rig.fault("node_reboot axis")
        cycle_until(robot, lambda one: robot._devices[0]._counters["boots"] > before)


def test_pages_are_sent_in_turn_and_a_frame_that_is_none_is_ignored(tmp_path: Path) -> None:
    (tmp_path / "cells.dbc").write_text(SENSOR)
    message = load(tmp_path / "cells.dbc").message("Pages")
    output = Output(message, 5)
    assert [output.encode()[0] for _ in range(2)] == [1, 1]  # the first page of the file
    output.use("Angle")
    output.use("Serial")
    output.put("Angle", 90.0)
    assert [decoded(message, output.encode())["Page"] for _ in range(4)] == [1.0, 2.0, 1.0, 2.0]
    assert decoded(message, bytes([9, 0, 0, 0, 0, 0, 0, 0])) is None  # a page that the file does not have
    assert decoded(message, b"\1") is None


def test_a_value_that_does_not_fit_is_sent_as_the_nearest_one(tmp_path: Path) -> None:
    (tmp_path / "cells.dbc").write_text(SENSOR)
    file = load(tmp_path / "cells.dbc")
    force, heat = file.signal("Load.Force")[1], file.signal("Load.Heat")[1]
    assert raw_of(force, 1e9) == 2**19 - 1
    assert raw_of(force, -1e9) == -(2**19)
    assert raw_of(heat, -100.0) == 0.0
    assert raw_of(force, float("nan")) == 0.0
    assert raw_of(file.signal("Load.Flags")[1], "OVERLOAD") == 1.0
    with pytest.raises(ConfigError, match=r"has no value 'BROKEN'\. It has: FINE, OVERLOAD"):
        raw_of(file.signal("Load.Flags")[1], "BROKEN")


def test_a_node_with_frames_of_can_fd_is_refused_on_a_classic_bus(tmp_path: Path) -> None:
    body = servo(tmp_path, "position")
    (tmp_path / "load_cell.dbc").write_text(SERVO.replace("Status: 8", "Status: 24"))
    with pytest.raises(ConfigError, match=r"'axis' sends frames of CAN FD.*buses\.can0\.data_bitrate"):
        simulator.rig(virtual(body), "bench", 0)
