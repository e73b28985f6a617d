"""A robot without buses for tests of safety: two joints that obey position, velocity or effort, moved in lockstep."""

import numpy as np

from hal.clock import ManualClock
from hal.config import RobotConfig
from hal.device import Device, DeviceHealth, DeviceState, Reading
from hal.errors import CommandRefused
from hal.robot import Robot

JOINTS = ("shoulder", "elbow")
PERIOD = 0.005
INERTIA, FRICTION = 0.2, 0.1
BRAKING = 20.0
"""Of a quick stop [rad/s^2]."""
UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m", "temperature": "degC"}
PARK = {"behaviour": "park", "park": [0.0, 1.0], "speed": 0.4}
LIMITS = {
    "position": {"joint_position": {"low": -1, "high": 2, "rate": 1.0, "acceleration": 10.0}},
    "velocity": {
        "joint_position": {"low": -1, "high": 2},
        "joint_velocity": {"low": -1, "high": 1, "rate": 5.0},
    },
    "effort": {
        "joint_position": {"low": -1, "high": 2},
        "joint_velocity": {"low": -3, "high": 3},
        "joint_effort": {"low": -2, "high": 2, "rate": 100.0},
    },
}


def description(quantity="position", **changes):
    """A robot file as a mapping; `changes` replace whole sections."""
    body = {
        "robot": "safety_bench",
        "signals": {f"joint_{name}": {"unit": unit, "elements": list(JOINTS)} for name, unit in UNITS.items()},
        "command": {"signal": f"joint_{quantity}", "time_to_live": 0.1, "hold": 0.5},
        "limits": LIMITS[quantity],
        "stop": {"behaviour": "damp" if quantity == "effort" else "hold"},
        "rates": {"hal": 1 / PERIOD},
    }
    return {**body, **changes}


class Joint(Device):
    """One joint with a motor. What happens to it is for tests to set.

    Attributes:
        push: Effort from outside [N m].
        is_deaf: Whether it ignores all that it is asked.
        asked: Every request, in order.
    """

    can_damp = True

    def __init__(self, name, quantity, clock):
        self.name = f"{name}_drive"
        self.served = {kind: f"joint_{kind}.{name}" for kind in UNITS}
        self.measures = tuple(self.served.values())
        self.commands = (self.served[quantity],)
        self.command_quantity = quantity
        self.state = DeviceState.READY
        self.position, self.velocity, self.effort, self.temperature = 0.3, 0.0, 0.0, 30.0
        self.push = 0.0
        self.is_deaf = self.is_silent = False
        self.text = ""
        self.asked = []
        self.target = 0.0
        self._clock = clock
        self._stopping = False

    def open(self):
        self.state = DeviceState.READY

    def close(self):
        self.state = DeviceState.CLOSED

    def read(self):
        values = np.array([self.position, self.velocity, self.effort, self.temperature])
        received = -np.inf if self.is_silent else self._clock.monotonic()
        return Reading(values, np.full(4, received))

    def health(self):
        return DeviceHealth(self.state, self.text)

    def _hear(self, what):
        self.asked.append(what)
        return not self.is_deaf

    def enable(self):
        if self._hear("enable"):
            self.state, self._stopping = DeviceState.ENABLED, False
            self.target = self.position if self.command_quantity == "position" else 0.0

    def disable(self):
        if self._hear("disable"):
            self.state, self._stopping = DeviceState.READY, False

    def quick_stop(self):
        if self._hear("quick_stop") and self.state in (DeviceState.ENABLED, DeviceState.HOMING):
            self._stopping, self.state = True, DeviceState.STOPPING

    def home(self):
        if self.name.startswith("elbow"):
            raise CommandRefused("The elbow has no homing of its own.")
        self.state = DeviceState.HOMING

    def apply(self, values):
        self._hear("apply")
        self.target = float(values[0])

    def damp(self):
        self._hear("damp")
        self.target = None

    def idle(self):
        self._hear("idle")

    def move(self, duration):
        """Let time pass for the mechanics."""
        before = self.velocity
        if self._stopping:
            self.velocity -= np.clip(self.velocity, -BRAKING * duration, BRAKING * duration)
            if self.velocity == 0.0:
                self.state, self._stopping = DeviceState.READY, False
        elif self.state is not DeviceState.ENABLED:
            self.velocity = 0.0  # the brake
        elif self.target is None:
            self.velocity *= np.exp(-10 * duration)
        elif self.command_quantity == "effort":
            total = self.target + self.push - FRICTION * self.velocity
            self.velocity += total / INERTIA * duration
        else:
            goal = self.target if self.command_quantity == "velocity" else (self.target - self.position) / duration
            self.velocity = goal
        self.position += self.velocity * duration
        self.effort = INERTIA * (self.velocity - before) / duration


class SafetyBench:
    """The robot, its joints and its clock."""

    def __init__(self, quantity="position", clock=None, **changes):
        self.clock = clock or ManualClock()
        self.config = RobotConfig.model_validate(description(quantity, **changes))
        self.joints = [Joint(name, quantity, self.clock) for name in JOINTS]
        self.robot = Robot(self.config, self.joints, clock=self.clock)
        self.robot.open()
        self.sample = self.applied = None

    def cycle(self, count=1):
        for _ in range(count):
            self.clock.advance(PERIOD)
            for joint in self.joints:
                joint.move(PERIOD)
            self.sample, self.applied = self.robot.cycle()
        return self.applied

    def enable(self):
        self.cycle()
        self.robot.enable()
        self.cycle(2)
        assert self.robot.mode == "hold"
        return self

    def follow(self, desired, count=1):
        for _ in range(count):
            self.robot.command(np.array(desired, float), self.sample.cycle)
            self.cycle()

    def until(self, mode, cycles=2000):
        """How many cycles it took until the robot's mode is this."""
        for count in range(cycles):
            if self.robot.mode == mode:
                return count
            self.cycle()
        raise AssertionError(f"{self.robot.mode}, not {mode}: {self.robot.health()}")

    @property
    def positions(self):
        return np.array([joint.position for joint in self.joints])

    @property
    def velocities(self):
        return np.array([joint.velocity for joint in self.joints])
