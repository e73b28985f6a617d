"""Every kind of device that the HAL can drive: its settings, the simulated node that plays it, and what it is to do.

One entry here gives a new device the whole conformance suite.
"""

import itertools
import math
from dataclasses import dataclass, field

from hal_bench import ROBOTS

from hal.config import RobotConfig
from hal.drivers.dbc import DbcNode, DbcServo
from hal.drivers.odrive import profile
from simulators.nodes.canopen.analog_input import AnalogConstants
from simulators.nodes.canopen.spec import CellConstants, DriveConstants, EncoderConstants, NodeSpec
from simulators.nodes.dbc.sensor import DbcConstants
from simulators.nodes.dbc_cell import DbcCellConstants
from simulators.nodes.mit_drive import MitConstants
from simulators.nodes.odrive import OdriveConstants

RATE = 100.0
STALE_AFTER = 0.02
NAME, MOVER = "thing", "mover"
_numbers = itertools.count()
_UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m", "force": "N"}


@dataclass(frozen=True)
class DeviceKind:
    """One kind of device.

    Attributes:
        name: Of the kind, in a test's name.
        driver: Of the registry.
        settings: Of the robot file.
        constants: Of the simulated node.
        node: Its node id.
        quantities: What is read of it, the main one first.
        value: What the main quantity is set to in the world [SI unit].
        tolerance: How well it measures that [SI unit].
        commanded: Quantity that it is commanded by; empty for a sensor.
        answers: Identifiers of the frames with what it measures.
        limits: Of the commanded signal.
        watchdog: Longest time [s] from the HAL's silence until the device is without power.
        tells_reboot: Whether it says when it has booted.
        tells_state: Whether it says if it is enabled.
    """

    name: str
    driver: str
    settings: dict
    constants: object
    answers: tuple[int, ...]
    quantities: tuple[str, ...] = ("position",)
    node: int = 5
    value: float = 0.6
    tolerance: float = 1e-3
    commanded: str = ""
    limits: dict = field(default_factory=lambda: {"low": -1.5, "high": 1.5, "rate": 2.0})
    watchdog: float = 0.75
    tells_reboot: bool = True
    tells_state: bool = True

    def __str__(self):
        return self.name

    @property
    def main(self):
        """Signal of the main quantity."""
        return f"thing_{self.quantities[0]}"

    def description(self, bus):
        """A robot file with one such device, and with a drive beside a sensor, since a robot moves something."""
        device = {"kind": "thing", "bus": "can0", "node": self.node}
        device["elements"] = {quantity: f"thing_{quantity}.one" for quantity in self.quantities}
        body = {
            "robot": "conformance",
            "signals": {
                f"thing_{quantity}": {
                    "unit": _UNITS[quantity],
                    "elements": ["one"],
                    "stale_after": STALE_AFTER,
                    # the stage moves it in no time, which is any velocity
                    "plausible": {"low": -math.inf, "high": math.inf, "rate": math.inf},
                }
                for quantity in self.quantities
            },
            "command": {"signal": f"thing_{self.commanded}", "time_to_live": 0.1, "hold": 0.5},
            "limits": {f"thing_{self.commanded}": self.limits},
            "rates": {"hal": RATE},
            "buses": {"can0": bus},
            "kinds": {"thing": {"driver": self.driver, "settings": self.settings}},
            "devices": {NAME: device},
            "folder": ROBOTS,
        }
        if self.commanded == "effort":
            body["stop"] = {"behaviour": "off"}
        if not self.commanded:
            body["signals"]["mover_position"] = {"unit": "rad", "elements": ["one"]}
            body["command"]["signal"] = "mover_position"
            body["limits"] = {"mover_position": self.limits}
            body["kinds"]["mover"] = {"driver": "cia402", "settings": DRIVE}
            body["devices"][MOVER] = {"kind": "mover", "bus": "can0", "node": 99, "element": "mover_position.one"}
        return body

    def config(self, bus=None):
        """The robot file, on a `virtual` bus of its own unless another is given."""
        bus = bus or {"interface": "virtual", "channel": f"conformance_{next(_numbers)}"}
        return RobotConfig.model_validate(self.description(bus))

    def hardware(self):
        """What hangs on the bus."""
        world = "thing_position.one" if self.commanded else f"{self.main}.one"
        nodes = [NodeSpec(NAME, "can0", self.node, world, self.constants)]
        if not self.commanded:
            nodes.append(NodeSpec(MOVER, "can0", 99, "mover_position.one", JOINT))
        return nodes


DRIVE = {"eds": "eds/servo_drive.eds", "counts_per_turn": 4096, "gear": 50, "zero": -0.2, "rated_torque": 0.2}
JOINT = DriveConstants(counts_per_turn=4096, gear=50.0, spool_radius=None, zero=-0.2, rated_torque=0.2)
MIT = {"stiffness": 40.0, "damping": 2.0, "ramp": 0.1}
DBC_CELL = {
    "dbc": "dbc/load_cell.dbc",
    "node_offset": 1,
    "periods": {"Force": 0.005},
    "quantities": {"force": {"signal": "Force.Force"}},
    "error": {"signal": "Force.Status", "good": "GOOD"},
}
AXIS = {"dbc": "dbc/odrive_cansimple.dbc"}
SERVO_BY_DBC = {**AXIS, **profile("position", 8.0, 0.2)}
ONE_FORCE = {"force": "thing_force.one"}
T_MOTOR = MitConstants(make="t_motor", velocity=50.0, torque=18.0)
FORCE = {"quantities": ("force",), "value": 12.0, "tolerance": 0.02}
SERVO = {"commanded": "position"}
BOTH = ("position", "velocity")

KINDS = (
    DeviceKind("cia402_csp", "cia402", DRIVE, JOINT, (0x185,), **SERVO),
    DeviceKind("cia402_pp", "cia402", {**DRIVE, "mode": "profile_position"}, JOINT, (0x185,), **SERVO),
    DeviceKind(
        "cia402_csv", "cia402", {**DRIVE, "mode": "csv"}, JOINT, (0x185,), quantities=BOTH, commanded="velocity"
    ),
    DeviceKind(
        "cia402_cst", "cia402", {**DRIVE, "mode": "cst"}, JOINT, (0x185,),
        quantities=("position", "effort"), commanded="effort", limits={"low": -5.0, "high": 5.0},
    ),
    DeviceKind("cia404", "cia404", {"eds": "eds/load_cell.eds"}, CellConstants(), (0x185,), **FORCE),
    DeviceKind(
        "cia401", "cia401", {"eds": "eds/analog_input.eds", "gain": 500.0 / 2**15},
        AnalogConstants(full_scale=500.0), (0x185,), **FORCE,
    ),
    DeviceKind(
        "cia406", "cia406", {"eds": "eds/joint_encoder.eds", "zero": -math.pi}, EncoderConstants(), (0x185,),
        tolerance=5e-5,
    ),
    DeviceKind("mit_damiao", "mit", {"motor": "DM4310", **MIT}, MitConstants(), (5 + 16,), tells_reboot=False, **SERVO),
    DeviceKind(
        "mit_t_motor", "mit", {"motor": "AK80-9", "allow_no_watchdog": True, **MIT}, T_MOTOR, (0,),
        tells_reboot=False, tells_state=False, watchdog=math.inf, **SERVO,
    ),
    DeviceKind("dbc", "dbc", DBC_CELL, DbcCellConstants(), (0x185,), tells_reboot=False, **FORCE),
    DeviceKind(
        "dbc_bench", "dbc", DBC_CELL, DbcConstants(DbcNode.Settings.model_validate(DBC_CELL), ROBOTS, ONE_FORCE),
        (0x185,), tells_reboot=False, **FORCE,
    ),
    DeviceKind(
        "dbc_servo_bench", "dbc_servo", SERVO_BY_DBC,
        DbcConstants(DbcServo.Settings.model_validate(SERVO_BY_DBC), ROBOTS, {"position": "thing_position.one"}),
        (5 << 5 | 0x09,), **SERVO,
    ),
    DeviceKind(
        "dbc_servo", "dbc_servo", {**AXIS, **profile("position", 8.0, 0.2)}, OdriveConstants(),
        (5 << 5 | 0x09,), **SERVO,
    ),
    DeviceKind(
        "odrive", "odrive", {**AXIS, "gear": 8.0, "zero": 0.25}, OdriveConstants(zero=0.25), (5 << 5 | 0x09,), **SERVO
    ),
)  # fmt: skip
ACTUATORS = tuple(kind for kind in KINDS if kind.commanded)
