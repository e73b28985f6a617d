"""Story of any devices: the drives move, and a sensor falls silent and comes back."""

from dataclasses import dataclass, field
from statistics import mode

import numpy as np

from hal.config import RobotConfig
from services.demo.actor import NOTICED_WITHIN, Stage
from services.demo.stories.scene import Scene
from services.demo.timeline import Timeline
from services.model.control_config import ControlConfig

NAMES = ("moves its drives", "loses a sensor")
MOVES = 6
"""The drives go to this many places in every stage."""
ROOM = 0.8
"""The places are in this share of the range of each drive, or within this distance of 0 [its unit] without a range."""
SETTLE = 0.8
"""The drives rest for this time [s] in every place."""
SILENT = 3.0
"""A drive is silent for this time [s]; the HAL has stopped the robot."""
FOLLOWS = 0.1
"""The mean distance from the places is smaller than this share of the range."""
NEAR = 0.1
"""A lost element is estimated if its mean error is smaller than this share of what it went through."""
MORE_MOVES, NORMAL_TRIES = 2, 6
"""Normal errors are learned in at most this many tries, with this many moves between two of them."""


@dataclass(slots=True)
class DeviceMarks:
    """Moments [s of the timeline] and names that the plot shows.

    Attributes:
        device: Name of the device that is lost.
        signal: Signal of the element that is watched.
        element: Name of the element.
        is_drive: Whether the device moves something, so that its silence stops the robot.
        silent: Start and end of its silence.
        stages: Stages played so far.
    """

    device: str
    signal: str
    element: str
    is_drive: bool
    silent: tuple[float, float] = (0.0, 0.0)
    stages: list[Stage] = field(default_factory=list)


def fits(robot: RobotConfig, control: ControlConfig | None) -> bool:
    """Whether the drives can be moved by the model, and a device can be lost beside another one."""
    return control is not None and control.target == robot.command.signal and len(robot.devices) > 1


def lost_device(robot: RobotConfig) -> DeviceMarks:
    """Return the device to lose: the first that moves nothing, or else the last drive."""
    driven = {f"{robot.command.signal}.{element}" for element in robot.signals[robot.command.signal].elements}
    sensors = [name for name, device in robot.devices.items() if not driven & set(device.served)]
    name = sensors[0] if sensors else list(robot.devices)[-1]
    served = robot.devices[name].served
    element = next((served for served in served if served in driven), served[0])
    signal, _, own = element.partition(".")
    return DeviceMarks(name, signal, own, is_drive=not sensors)


class DeviceStory:
    """Stages of the demo, played by a client."""

    def __init__(self, scene: Scene, timeline: Timeline, marks: DeviceMarks) -> None:
        """Prepare; the timeline is of the signal of which an element is lost."""
        self._scene, self._timeline, self.marks = scene, timeline, marks
        self._actor, self._client = scene.actor, scene.client
        self._signal = scene.robot.command.signal
        self._index = scene.robot.signals[marks.signal].elements.index(marks.element)
        self._unit = scene.robot.signals[marks.signal].unit
        low, high = scene.robot.bounds(self._signal)
        is_bounded = np.isfinite(low) & np.isfinite(high)
        self._low, self._high = np.where(is_bounded, low, -1.0), np.where(is_bounded, high, 1.0)
        self._random = np.random.default_rng(scene.seed)
        self._place = 0.5 * (self._low + self._high)

    def play(self) -> None:
        """Play all stages, less than a minute."""
        for stage in (self.move, self.lose_sensor):
            self.marks.stages.append(self._actor.play(stage))
        self._client.disengage()

    def move(self) -> Stage:
        """Play (a): the drives move to places."""
        self._scene.report(f"[bold](a)[/] The drives move to {MOVES} places.")
        start = self._timeline.now()
        self._actor.engage()
        shares = []
        for _ in range(MOVES):
            self._go()
            missed = np.abs(self._actor.truth(self._signal) - self._place) / (self._high - self._low)
            shares.append(float(np.mean(missed)))
        figures = (
            f"{MOVES} places, {np.mean(shares):.1%} of the range away from them on average",
            self._actor.learn_normal(self._go_on, NORMAL_TRIES),
        )
        return Stage(NAMES[0], start, self._timeline.now(), figures, float(np.mean(shares)) < FOLLOWS)

    def lose_sensor(self) -> Stage:
        """Play (b): a device falls silent and comes back; what it measured is estimated."""
        marks, timeline = self.marks, self._timeline
        stops = " It is a drive, so the HAL stops the robot." if marks.is_drive else ""
        self._scene.report(f"[bold](b)[/] {marks.device} falls silent.{stops} What it measured is estimated.")
        start = timeline.now()
        self._actor.fault(f"sensor_silent {marks.device}")
        lost = timeline.now()
        noticed, delay = self._actor.notice(self._is_estimated)
        if marks.is_drive:
            self._actor.wait(lambda: False, SILENT)
        else:
            for _ in range(MOVES):
                self._go()
        end = timeline.now()
        self._actor.fault(f"node_back {marks.device}")
        returned = self._actor.wait(lambda: not self._is_estimated(), NOTICED_WITHIN)
        marks.silent = (start, end)
        if marks.is_drive:
            self._actor.engage()
        self._go()
        figures, share = self._errors(lost + delay, end)
        figures = (
            f"marked as estimated after {1e3 * delay:.0f} ms, {figures[0]}",
            *figures[1:],
            "measured again when the node came back" if returned else "not measured again after the node came back",
            *(["the drives moved again after a reset"] if marks.is_drive else []),
        )
        return Stage(NAMES[1], start, timeline.now(), figures, noticed and returned and share < NEAR)

    def _errors(self, start: float, end: float) -> tuple[tuple[str, ...], float]:
        """Return sentences on the estimates in a span of time [s], and the mean error as a share of the range."""
        timeline, marks = self._timeline, self.marks
        value, truth = (timeline.between(name, start, end)[:, self._index] for name in ("value", "truth"))
        error = np.abs(value - truth)
        passed = timeline.column("truth")[:, self._index]
        range_passed = float(np.nanmax(passed) - np.nanmin(passed))
        mean = float(np.nanmean(error))
        share = mean / range_passed if range_passed > 0.0 else np.inf
        text = mode(timeline.between("source", start, end).tolist() or [""])
        return (
            "method " + text.replace(" ", ", from ", 1).replace("+", ", "),
            f"true error of {marks.signal}.{marks.element} meanwhile: mean {mean:.4g} {self._unit}, "
            f"{share:.1%} of the range that it went through; worst {np.nanmax(error):.4g} {self._unit}",
        ), share

    def _go(self) -> None:
        """Go to another place, and rest there."""
        middle, half = 0.5 * (self._low + self._high), 0.5 * ROOM * (self._high - self._low)
        goal = middle + half * self._random.uniform(-1.0, 1.0, len(middle))
        duration = float(np.abs(goal - self._place).max()) / self._scene.control.speed + SETTLE
        self._place = goal
        self._actor.go(self._signal, goal, duration)

    def _go_on(self) -> None:
        for _ in range(MORE_MOVES):
            self._go()

    def _is_estimated(self) -> bool:
        estimate = self._client.estimate()
        return estimate is not None and bool(estimate.estimated[self.marks.signal][self._index])
