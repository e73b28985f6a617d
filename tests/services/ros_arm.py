"""A robot of two joints whose driver is a ROS 2 node, and its HAL, each in threads of the test."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import zenoh

from hal.config import RobotConfig
from services.ros2 import cdr, messages
from services.ros2.hardware import run_ros_hal
from services.ros2.node import Network, Node

JOINTS = ["shoulder", "elbow"]
COMMANDS = "/arm_controller/joint_trajectory"


def description(robot: str, network: Network, **changes: Any) -> dict[str, Any]:
    body = {
        "robot": robot,
        "signals": {
            "joint_position": {
                "unit": "rad", "elements": JOINTS, "source": "ros2", "topic": "/joint_states", "field": "position",
                "stale_after": 0.5,
            },
            "joint_velocity": {
                "unit": "rad/s", "elements": JOINTS, "source": "ros2", "topic": "/joint_states", "field": "velocity",
                "stale_after": 0.5,
            },
            "wrist_force": {
                "unit": "N", "elements": ["z"], "source": "ros2", "topic": "/wrist", "field": "force",
                "stale_after": 0.5,
            },
            "skin": {
                "unit": "1", "elements": ["s0", "s1", "s2"], "source": "ros2", "topic": "/skin", "field": "data",
                "stale_after": 0.5,
            },
        },
        "command": {
            "signal": "joint_position", "time_to_live": 0.5, "hold": 3.0, "topic": COMMANDS, "following_error": 2.0,
        },
        "limits": {"joint_position": {"low": -1.0, "high": 1.0, "rate": 0.5, "acceleration": 5.0}},
        "rates": {"hal": 50},
        "ros2": {"router": network.router, "distribution": network.distribution},
    }  # fmt: skip
    return {**body, **changes}


def config_of(robot: str, network: Network, **changes: Any) -> RobotConfig:
    return RobotConfig.model_validate(description(robot, network, **changes))


@contextmanager
def hal(config: RobotConfig) -> Iterator[None]:
    stop = threading.Event()
    thread = threading.Thread(target=run_ros_hal, args=(config, (), stop), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(20.0)
        assert not thread.is_alive()


class Driver:
    """The node of the arm's driver: publishes its state at 50 Hz, and moves where the last trajectory says.

    `change` may replace or drop a JointState before it is published.
    """

    def __init__(self, network: Network) -> None:
        self.position, self.commands = np.array([0.1, -0.2]), 0
        self.change: Callable[[dict[str, Any]], dict[str, Any] | None] = dict
        self._network = network
        self._target: np.ndarray | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "Driver":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _take(self, sample: zenoh.Sample) -> None:
        message = cdr.decode(messages.TRAJECTORY, sample.payload.to_bytes())
        assert message["joint_names"] == JOINTS
        (point,) = message["points"]
        self._target = np.array(point["positions"])
        self.commands += 1

    def _run(self) -> None:
        with Node("/arm_driver", self._network) as node:
            node.subscribe(COMMANDS, messages.TRAJECTORY, self._take)
            states = node.publisher("/joint_states", messages.JOINT_STATE)
            wrist = node.publisher("/wrist", messages.WRENCH)
            skin = node.publisher("/skin", messages.NUMBERS)
            while not self._stop.wait(0.02):
                if self._target is not None:
                    self.position = self._target
                joints = {
                    name: {"position": float(value), "velocity": 0.0}
                    for name, value in zip(JOINTS, self.position, strict=True)
                }
                state = messages.joint_state(time.time_ns(), joints)
                assert state is not None
                if (changed := self.change(state)) is not None:
                    states.put(changed)
                wrist.put(messages.wrench(time.time_ns(), "wrist", {"fz": 7.0}))
                skin.put(messages.numbers([], [1.0, 2.0, 3.0]))
