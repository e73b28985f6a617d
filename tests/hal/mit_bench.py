"""Three joints in MIT mode on one bus: a Damiao drive, and two of T-Motor that answer under the same identifier."""

import itertools

import numpy as np
from hal_bench import Bench

from hal.config import RobotConfig
from simulators.nodes.canopen.spec import NodeSpec
from simulators.nodes.mit_drive import MitConstants

JOINTS = ("elbow", "wrist", "finger")
DAMIAO = {"motor": "DM4310", "stiffness": 40.0, "damping": 2.0, "ramp": 0.1}
T_MOTOR = {"motor": "AK80-9", "stiffness": 40.0, "damping": 2.0, "ramp": 0.1, "allow_no_watchdog": True}
AT_ONCE = {"low": -np.inf, "high": np.inf, "rate": np.inf}
"""A hand moves a joint anywhere in no time."""
_numbers = itertools.count()


def description(**changes):
    """A robot file as a mapping; `changes` replace whole sections."""
    signals = {
        "joint_position": {"unit": "rad", "elements": list(JOINTS), "plausible": AT_ONCE},
        "joint_velocity": {"unit": "rad/s", "elements": list(JOINTS)},
        "joint_effort": {"unit": "N m", "elements": list(JOINTS)},
        "motor_temperature": {"unit": "degC", "elements": list(JOINTS)},
        "driver_temperature": {"unit": "degC", "elements": ["elbow"]},
    }
    body = {
        "robot": "mit_bench",
        "signals": signals,
        "command": {"signal": "joint_position", "time_to_live": 0.1, "hold": 0.5},
        "limits": {"joint_position": {"low": -3.0, "high": 3.0, "rate": 4.0}},
        "rates": {"hal": 200},
        "buses": {"can0": {"interface": "virtual", "channel": f"mit_bench_{next(_numbers)}"}},
        "kinds": {
            "damiao": {"driver": "mit", "settings": DAMIAO},
            "t_motor": {"driver": "mit", "settings": T_MOTOR},
        },
        "devices": {
            "elbow_drive": {"kind": "damiao", "bus": "can0", "node": 1, "elements": elements("elbow", True)},
            "wrist_drive": {"kind": "t_motor", "bus": "can0", "node": 2, "elements": elements("wrist")},
            "finger_drive": {"kind": "t_motor", "bus": "can0", "node": 3, "elements": elements("finger")},
        },
    }
    return {**body, **changes}


def elements(joint, tells_driver=False):
    """What a drive of a joint measures."""
    report = {
        "position": f"joint_position.{joint}",
        "velocity": f"joint_velocity.{joint}",
        "effort": f"joint_effort.{joint}",
        "temperature": f"motor_temperature.{joint}",
    }
    return {**report, "temperature_driver": f"driver_temperature.{joint}"} if tells_driver else report


def hardware():
    """What really hangs on the bus."""
    t_motor = MitConstants(make="t_motor", velocity=50.0, torque=18.0)
    return [
        NodeSpec("elbow_drive", "can0", 1, "joint_position.elbow", MitConstants()),
        NodeSpec("wrist_drive", "can0", 2, "joint_position.wrist", t_motor),
        NodeSpec("finger_drive", "can0", 3, "joint_position.finger", t_motor),
    ]


class JointWorld:
    """Joints that are where their drives turn them; without power a hand (`position`) may move them."""

    def __init__(self):
        self.time = 0.0
        self.position = np.array([0.4, -0.3, 1.2])

    def step(self, duration):
        self.time += duration

    def measure(self):
        values = {name: np.zeros(3) for name in ("joint_velocity", "joint_effort", "motor_temperature")}
        return {"joint_position": self.position.copy(), "driver_temperature": np.zeros(1), **values}

    truth = measure

    def drive(self, element, target, enabled):
        if enabled:
            self.position[JOINTS.index(element.partition(".")[2])] = target

    def break_part(self, part):
        raise ValueError(f"The bench has no part '{part}'.")

    def close(self):
        pass


def mit_bench(config=None, nodes=None, world=None):
    """Robot and nodes in lockstep, not opened yet."""
    model = RobotConfig.model_validate(config or description())
    return Bench(model, nodes=nodes or hardware(), world=world or JointWorld())


def only(joint, settings, constants, **changes):
    """A robot with one of the joints, its drive with these settings, and its hardware."""
    body = description(**changes)
    signals = {name: {**signal, "elements": [joint]} for name, signal in body["signals"].items()}
    if settings["motor"].startswith("AK"):
        del signals["driver_temperature"]
    body["signals"] = signals
    device = {"kind": "one", "bus": "can0", "node": 1, "elements": elements(joint, "driver_temperature" in signals)}
    body["kinds"] = {"one": {"driver": "mit", "settings": settings}}
    body["devices"] = {f"{joint}_drive": device}
    return body, [NodeSpec(f"{joint}_drive", "can0", 1, f"joint_position.{joint}", constants)]


class OneJoint:
    """A joint that carries a load [N m]."""

    def __init__(self, joint="elbow", position=0.0, load=0.0):
        self.time = 0.0
        self.joint = joint
        self.position = np.array([position])
        self.load = np.array([load])

    def step(self, duration):
        self.time += duration

    def measure(self):
        names = ("joint_velocity", "motor_temperature", "driver_temperature")
        values = {name: np.zeros(1) for name in names}
        return {"joint_position": self.position.copy(), "joint_effort": self.load.copy(), **values}

    truth = measure

    def drive(self, element, target, enabled):
        if enabled:
            self.position[0] = target

    def break_part(self, part):
        raise ValueError(part)

    def close(self):
        pass


def node(bench, joint):
    return bench.rig.node(f"{joint}_drive")
