"""A small robot for tests of camera, conditions and collection: two joints in a plane, a tool, load cells, a marker.

Its robot file names this module as the simulator, so that every process can be one of its own.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hal.config import RobotConfig
from hal.robot import Robot
from simulators.direct import direct_robot
from simulators.faults import changed_tool, check_condition
from simulators.nodes.canopen.spec import CellConstants, DriveConstants, NodeSpec
from simulators.rig import Rig

EDS = Path(__file__).resolve().parents[2] / "robots" / "eds"
JOINTS = ("shoulder", "elbow")
CELLS = ("front_left", "front_right", "back_left", "back_right")
POINTS = [[0.06, 0.04], [0.06, -0.04], [-0.06, 0.04], [-0.06, -0.04]]
WEIGHT = 20.0
"""Of the robot [N]."""
TOOLS = {"short": 0.1, "long": 0.25}
"""Length beyond the hand [m]."""
FASTEST = 3.0
"""Of the servos [rad/s]."""
OUT_OF_SIGHT = -0.25
"""The marker is hidden below this height [m]."""


def description(robot: str) -> dict[str, Any]:
    """A robot file as a mapping."""
    drive = {"eds": str(EDS / "servo_drive.eds"), "counts_per_turn": 4096, "gear": 50, "rated_torque": 0.1}
    devices: dict[str, Any] = {}
    for number, joint in enumerate(JOINTS, 1):
        devices[f"{joint}_drive"] = {
            "kind": "drive",
            "bus": "can0",
            "node": number,
            "element": f"joint_position.{joint}",
        }
    for number, cell in enumerate(CELLS, 11):
        devices[f"{cell}_cell"] = {"kind": "cell", "bus": "can0", "node": number, "element": f"foot_force.{cell}"}
    return {
        "robot": robot,
        "signals": {
            "joint_position": {"unit": "rad", "elements": list(JOINTS)},
            "foot_force": {"unit": "N", "elements": list(CELLS)},
            "center_of_gravity": {
                "unit": "m",
                "elements": ["x", "y"],
                "computed": {
                    "by": "hal.computed:center_of_pressure", "from": "foot_force", "settings": {"points": POINTS},
                },
            },
            "tool_tip_position": {"unit": "m", "elements": ["x", "y"], "source": "vision", "stale_after": 0.2},
        },
        "command": {"signal": "joint_position", "time_to_live": 0.2, "hold": 0.5},
        "limits": {"joint_position": {"low": [-1.0, -1.5], "high": [1.0, 1.5], "rate": 3.0}},
        "rates": {"hal": 100, "estimation": 100, "anomaly": 50},
        "buses": {"can0": {"interface": "hub", "channel": f"{robot}_can0"}},
        "kinds": {
            "drive": {"driver": "cia402", "settings": drive},
            "cell": {"driver": "cia404", "settings": {"eds": str(EDS / "load_cell.eds")}},
        },
        "devices": devices,
        "simulator": "small_hand:simulator",
        "conditions": list(TOOLS),
        "collect": {
            "samples": 60,
            "rate": 10,
            "speed": 2.0,
            "hold": 0.2,
            "forecast": "small_hand:forecast",
            "constraints": {"center_of_gravity": {"low": [-0.05, -0.03], "high": [0.05, 0.03]}},
        },
        "model": {"signals": ["joint_position", "center_of_gravity", "tool_tip_position"]},
    }  # fmt: skip


def config(robot: str = "small_hand", **changes: Any) -> RobotConfig:
    """The robot file, with whole sections changed."""
    return RobotConfig.model_validate(description(robot) | changes)


def tip_of(position: np.ndarray, tool: float) -> np.ndarray:
    """Tool tip [m], shape (n, 2), at joint positions [rad], shape (n, 2)."""
    first, both = position[:, 0], position.sum(axis=1)
    reach = 0.2 + tool
    return np.stack([0.3 * np.cos(first) + reach * np.cos(both), 0.3 * np.sin(first) + reach * np.sin(both)], axis=1)


def gravity_of(position: np.ndarray, tool: float) -> np.ndarray:
    """Center of gravity [m], shape (n, 2)."""
    return 0.1 * (tip_of(position, tool) - np.array([0.5, 0.0]))


def forecast(config: RobotConfig, condition: str | None, commands: np.ndarray) -> dict[str, np.ndarray]:
    """The designer's model."""
    tool = TOOLS[condition or "short"]
    return {"center_of_gravity": gravity_of(commands, tool), "tool_tip_position": tip_of(commands, tool)}


def seen(tip: np.ndarray) -> np.ndarray:
    """What the camera makes of a tool tip [m], shape (2,); NaN when it is hidden."""
    return tip.copy() if tip[1] > OUT_OF_SIGHT else np.full(2, np.nan)


class HandWorld:
    """Joints that follow their servos, without noise."""

    def __init__(self, condition: str | None) -> None:
        self.time = 0.0
        self._tool = TOOLS[check_condition(condition, tuple(TOOLS)) or ""]
        self._position = np.array([0.2, -0.3])
        self._targets = np.full(2, np.nan)
        self._names = {f"joint_position.{joint}": index for index, joint in enumerate(JOINTS)}

    def step(self, duration: float) -> None:
        self.time += duration
        wanted = np.where(np.isfinite(self._targets), self._targets, self._position)
        self._position = self._position + np.clip(wanted - self._position, -FASTEST * duration, FASTEST * duration)

    def truth(self) -> dict[str, np.ndarray]:
        position = self._position[None]
        gravity = gravity_of(position, self._tool)[0]
        share = gravity / np.array(POINTS[0])
        signs = np.sign(np.array(POINTS))
        force = WEIGHT / 4 * np.prod(1 + signs * share, axis=1)
        return {
            "joint_position": self._position.copy(),
            "foot_force": force,
            "center_of_gravity": gravity,
            "tool_tip_position": tip_of(position, self._tool)[0],
        }

    def measure(self) -> Mapping[str, np.ndarray]:
        values = self.truth()
        return values | {"tool_tip_position": seen(values["tool_tip_position"])}

    def drive(self, element: str, target: float, enabled: bool) -> None:
        self._targets[self._names[element]] = target if enabled else np.nan

    def break_part(self, part: str) -> None:
        self._tool = TOOLS[changed_tool(part, tuple(TOOLS))]

    def close(self) -> None:
        self._targets[:] = np.nan


class HandCamera:
    """Sees the marker at the tool tip."""

    def __init__(self) -> None:
        self._covered = False

    def see(self, truth: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {"tool_tip_position": np.full(2, np.nan) if self._covered else seen(truth["tool_tip_position"])}

    def fault(self, text: str) -> str:
        if text not in ("camera_covered", "camera_back"):
            raise ValueError(f"'{text}' is nothing that can happen here. Known: camera_covered, camera_back.")
        self._covered = text == "camera_covered"
        return "The camera sees nothing." if self._covered else "The camera sees again."


class SmallHand:
    variants = ("nominal", "actual")
    conditions = tuple(TOOLS)

    def rig(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Rig:
        servo = DriveConstants(spool_radius=None, gear=50)
        nodes = [
            NodeSpec(f"{joint}_drive", "can0", number, f"joint_position.{joint}", servo)
            for number, joint in enumerate(JOINTS, 1)
        ]
        nodes += [
            NodeSpec(f"{cell}_cell", "can0", number, f"foot_force.{cell}", CellConstants())
            for number, cell in enumerate(CELLS, 11)
        ]
        return Rig(config, HandWorld(condition), nodes)

    def direct(self, config: RobotConfig, variant: str, seed: int, condition: str | None = None) -> Robot:
        return direct_robot(config, HandWorld(condition))

    def vision(self, config: RobotConfig, variant: str, seed: int) -> HandCamera:
        return HandCamera()


simulator = SmallHand()
