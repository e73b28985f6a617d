"""One joint with a servo drive in any mode, on a `virtual` bus, moved in lockstep."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hal_bench import ROBOTS, Bench

from hal.calibration.units import axis_units
from hal.config import RobotConfig
from hal.errors import ConfigError
from hal.robot import open_robot
from simulators.nodes.canopen.spec import DriveConstants, NodeSpec

RATE = 200.0
_numbers = itertools.count()
UNITS = {
    "position": "rad",
    "velocity": "rad/s",
    "effort": "N m",
    "temperature": "degC",
    "following_error": "rad",
}
ELBOW = {quantity: f"joint_{quantity}.elbow" for quantity in UNITS}
CONSTANTS = DriveConstants(
    counts_per_turn=4096, gear=50.0, spool_radius=None, zero=-0.2, rated_torque=0.2, load="joint_load.elbow"
)
NODE = 5
SETTINGS = {"eds": "eds/servo_drive.eds", "counts_per_turn": 4096, "gear": 50, "zero": -0.2}
FIXED = {
    "fixed": True,
    "receives": [{"number": 1, "objects": ["6040h uint16", "607Ah int32"]}],
    "sends": [{"number": 1, "objects": ["6041h uint16", "6064h int32", "6077h int16"]}],
}
TEMPERATURE = {"object": "2200h:1", "type": "int16", "scale": 0.1}
HOMING = {"method": 17, "speed": 1.0, "slow_speed": 0.1}
COMMANDED = {"profile_position": "position", "ip": "position", "csp": "position", "csv": "velocity", "cst": "effort"}


class JointWorld:
    """One joint that follows its servo; its load [N m] is what the test sets."""

    def __init__(self, position=0.3):
        self.time = 0.0
        self.position, self.load = position, 0.0
        self.target, self.enabled = position, False

    def step(self, duration):
        self.time += duration
        if self.enabled:
            self.position += np.clip(self.target - self.position, -20.0 * duration, 20.0 * duration)

    def measure(self):
        other = {f"joint_{quantity}": np.zeros(1) for quantity in UNITS if quantity != "position"}
        return {**other, "joint_position": np.array([self.position]), "joint_load": np.array([self.load])}

    truth = measure

    def drive(self, element, target, enabled):
        self.target, self.enabled = target, enabled

    def break_part(self, part):
        raise ValueError(f"The joint has no part '{part}'.")

    def close(self):
        pass


def joint_description(mode="csp", quantities=tuple(ELBOW), limits=None, **settings):
    """A robot file with one drive."""
    if "temperature" in quantities:
        settings = {"temperature": TEMPERATURE, **settings}
    elements = {quantity: ELBOW[quantity] for quantity in quantities}
    units = UNITS | (axis_units(is_linear=True) if settings.get("spool_radius") else {})
    signals = {f"joint_{q}": {"unit": units[q], "elements": ["elbow"], "stale_after": 0.3} for q in quantities}
    signals.setdefault("joint_position", {"unit": "rad", "elements": ["elbow"], "source": "vision"})
    signals["joint_load"] = {"unit": "N m", "elements": ["elbow"], "source": "vision"}
    commanded = f"joint_{COMMANDED[mode]}"
    return {
        "robot": "joint",
        "signals": signals,
        "command": {"signal": commanded, "time_to_live": 0.1, "hold": 0.3},
        "stop": {"behaviour": "off"} if mode == "cst" else {},
        "limits": {commanded: limits} if limits else {},
        "rates": {"hal": RATE},
        "buses": {"can0": {"interface": "virtual", "channel": f"drive_bench_{next(_numbers)}"}},
        "kinds": {"drive": {"driver": "cia402", "settings": {**SETTINGS, "mode": mode, **settings}}},
        "devices": {"elbow": {"kind": "drive", "bus": "can0", "node": 5, "elements": elements}},
        "folder": ROBOTS,
    }


class JointBench(Bench):
    """Robot and rig of one joint."""

    def __init__(self, mode="csp", position=0.3, hardware=None, **settings):
        body = joint_description(mode, **settings)
        spec = NodeSpec("elbow", "can0", 5, ELBOW["position"], replace(CONSTANTS, **(hardware or {})))
        super().__init__(RobotConfig.model_validate(body), nodes=[spec], world=JointWorld(position))
        self.node = self.rig.node("elbow")
        self.drive = self.robot._devices[0]

    @property
    def objects(self):
        """What the drive has in its object dictionary."""
        return self.node.objects.values

    def value(self, quantity):
        """The newest measured value."""
        return float(self.sample.values[f"joint_{quantity}"][0])


def without(tmp_path, *indices):
    """The drive's data sheet without some objects."""
    kept, is_dropped = [], False
    for line in (ROBOTS / SETTINGS["eds"]).read_text().splitlines():
        if line.startswith("["):
            is_dropped = any(line[1:].upper().startswith(index) for index in indices)
        if not is_dropped:
            kept.append(line)
    path = tmp_path / "less.eds"
    path.write_text("\n".join(kept))
    return path


def refused(mode="csp", sheet=None, node=NODE, quantities=("position",), **settings):
    """What is said of a robot file before anything is opened."""
    body = joint_description(mode, quantities, **settings)
    if sheet is not None:
        body["kinds"]["drive"]["settings"]["eds"] = str(sheet)
    body["devices"]["elbow"]["node"] = node
    with pytest.raises(ConfigError) as caught:
        open_robot(RobotConfig.model_validate(body))
    report = str(caught.value)
    assert "'elbow'" in report
    return report
