"""Story of any arm with encoders behind its gears and a camera: it moves, loses an encoder, and loses its sight."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from statistics import mode

import numpy as np

from hal.config import RobotConfig
from hal.errors import ConfigError
from services.demo.actor import NOTICED_WITHIN, Stage
from services.demo.stories.scene import Scene
from services.demo.timeline import Timeline
from services.hardware.stand_in import simulator_of
from services.learning.collector import motion_of
from services.model.control_config import ControlConfig

MOVES = 4
"""The arm goes to this many postures in every stage."""
NORMAL_TRIES, MORE_MOVES = 4, 2
"""Normal errors are learned in at most this many tries, with this many more moves between two of them."""
SETTLE = 0.8
"""The arm rests for this time [s] in every posture."""
REST = 0.1
"""A command of the motion that lasts longer than this is a posture in which it rests [s]."""
FOLLOWS = 0.15
"""The norm of the distance of all joints from their targets is smaller than this if the model is right [rad]."""
NEAR = 0.1
"""A lost joint is estimated if its mean error is smaller than this [rad]."""
SHARE = 0.03
"""The tip is estimated if its mean error is smaller than this share of the reach."""
NAMES = ("moves to postures", "loses an encoder", "loses its sight")


@dataclass(slots=True)
class ArmMarks:
    """Moments [s of the timeline] and names that the plot shows."""

    encoder: str = ""
    element: str = ""
    silent: tuple[float, float] = (0.0, 0.0)
    covered: tuple[float, float] = (0.0, 0.0)
    reach: float = float("nan")
    stages: list[Stage] = field(default_factory=list)


def encoders_of(robot: RobotConfig, target: str) -> dict[str, str]:
    """Return element -> device, of the devices that measure a signal and move nothing; empty if drives measure it."""
    driven = {f"{robot.command.signal}.{element}" for element in robot.signals[robot.command.signal].elements}
    encoders = {}
    for name, device in robot.devices.items():
        for served in device.served:
            signal, _, element = served.partition(".")
            if signal == target and not driven & set(device.served):
                encoders[element] = name
    return encoders


def fits(robot: RobotConfig, control: ControlConfig | None) -> bool:
    """Whether the story can be played: every joint has an encoder of its own, and a camera sees one signal."""
    if control is None or control.target not in robot.measured or len(robot.seen) != 1 or not robot.collect:
        return False
    same_size = robot.signals[control.target].size == robot.signals[robot.command.signal].size
    return same_size and len(encoders_of(robot, control.target)) == robot.signals[control.target].size


class ArmStory:
    """Stages of the demo, played by a client."""

    def __init__(self, scene: Scene, joints: Timeline, tip: Timeline) -> None:
        """Prepare; the timelines are of the joints and of what the camera sees."""
        robot, control = scene.robot, scene.control
        self._client, self._joints, self._tip = scene.client, joints, tip
        self._actor, self._report = scene.actor, scene.report
        self._robot, self._signal, self._speed = robot, control.target, control.speed
        (self._seen,) = robot.seen
        self._postures = rests(robot, scene.seed)
        self._place = next(self._postures)
        encoders = encoders_of(robot, control.target)
        # The joint in the middle of the arm moves the tip and carries a load.
        element = robot.signals[control.target].elements[len(encoders) // 2]
        self.marks = ArmMarks(encoders[element], element, reach=reach_of(robot))

    def play(self) -> ArmMarks:
        """Play all stages, less than a minute."""
        for stage in (self.move, self.lose_encoder, self.lose_sight):
            self.marks.stages.append(self._actor.play(stage))
        self._client.disengage()
        return self.marks

    def move(self) -> Stage:
        """Play (a): the arm moves to postures."""
        self._report(f"[bold](a)[/] The controller moves the arm to {MOVES} postures.")
        start = self._joints.now()
        self._actor.engage()
        misses = []
        for _ in range(MOVES):
            self._go()
            misses.append(float(np.linalg.norm(self._actor.truth(self._signal) - self._place)))
        truth = self._joints.between("truth", start, self._joints.now())
        span = float(np.nanmax(np.nanmax(truth, axis=0) - np.nanmin(truth, axis=0)))
        miss = float(np.mean(misses))
        figures = (
            f"{MOVES} postures, {miss:.3f} rad away from them on average (norm of {len(self._place)} joints)",
            f"the joint that moved most moved by {span:.2f} rad",
            self._actor.learn_normal(self._go_on, NORMAL_TRIES),
        )
        return Stage(NAMES[0], start, self._joints.now(), figures, miss < FOLLOWS and span > 0.2)

    def lose_encoder(self) -> Stage:
        """Play (b): an encoder falls silent and comes back; the arm goes on with an estimate."""
        marks = self.marks
        self._report(f"[bold](b)[/] {marks.encoder} falls silent. The arm goes on with an estimate.")
        index = self._robot.signals[self._signal].elements.index(marks.element)
        start = self._joints.now()
        self._actor.fault(f"sensor_silent {marks.encoder}")
        lost = self._joints.now()
        noticed, delay = self._actor.notice(lambda: self._estimated(self._signal, index))
        for _ in range(MOVES):
            self._go()
        end = self._joints.now()
        self._actor.fault(f"node_back {marks.encoder}")
        returned = self._actor.wait(lambda: not self._estimated(self._signal, index), NOTICED_WITHIN)
        marks.silent = (start, end)
        value, truth = (self._joints.between(name, lost + delay, end)[:, index] for name in ("value", "truth"))
        error = np.abs(value - truth)
        mean = float(np.nanmean(error))
        figures = (
            f"marked as estimated after {1e3 * delay:.0f} ms, {self._source(self._joints, lost + delay, end)}",
            f"true error of {marks.element} meanwhile: mean {mean:.4f} rad, worst {np.nanmax(error):.4f} rad",
            "measured again when the node came back" if returned else "not measured again after the node came back",
        )
        return Stage(NAMES[1], start, self._joints.now(), figures, noticed and returned and mean < NEAR)

    def lose_sight(self) -> Stage:
        """Play (c): the camera is covered and uncovered; the tip is estimated and marked as estimated."""
        self._report("[bold](c)[/] The camera is covered. The tip is estimated from the arm.")
        start = self._tip.now()
        self._actor.fault("camera_covered", "vision")
        lost = self._tip.now()
        noticed, delay = self._actor.notice(lambda: self._estimated(self._seen, 0))
        first = self._tip.stamp()
        for _ in range(MOVES):
            self._go()
        end, last = self._tip.now(), self._tip.stamp()
        self._actor.fault("camera_back", "vision")
        returned = self._actor.wait(lambda: not self._estimated(self._seen, 0), NOTICED_WITHIN)
        self.marks.covered = (start, end)
        value, truth = (self._tip.between(name, lost + delay, end) for name in ("value", "truth"))
        marked = self._tip.marked(first, last) == 1.0
        error = np.linalg.norm(value - truth, axis=1)
        mean, share = float(np.nanmean(error)), float(np.nanmean(error)) / self.marks.reach
        figures = (
            f"marked as estimated after {1e3 * delay:.0f} ms, {self._source(self._tip, lost + delay, end)}",
            f"true error of the tip meanwhile: mean {1e3 * mean:.1f} mm ({share:.1%} of the reach of "
            f"{self.marks.reach:.2f} m), worst {1e3 * np.nanmax(error):.1f} mm",
            "every value published meanwhile is marked" if marked else "NOT every value published meanwhile is marked",
            "measured again when the camera was uncovered" if returned else "not measured again when it was uncovered",
        )
        return Stage(NAMES[2], start, self._tip.now(), figures, noticed and returned and marked and share < SHARE)

    def _go(self) -> None:
        """Go to the next posture, and rest there."""
        goal = next(self._postures)
        duration = float(np.abs(goal - self._place).max()) / self._speed + SETTLE
        self._place = goal
        self._actor.go(self._signal, goal, duration)

    def _go_on(self) -> None:
        for _ in range(MORE_MOVES):
            self._go()

    def _estimated(self, signal: str, index: int) -> bool:
        estimate = self._client.estimate()
        return estimate is not None and bool(estimate.estimated[signal][index])

    @staticmethod
    def _source(timeline: Timeline, start: float, end: float) -> str:
        text = mode(timeline.between("source", start, end).tolist() or [""])
        return "method " + text.replace(" ", ", from ", 1).replace("+", ", ")


def rests(robot: RobotConfig, seed: int) -> Iterator[np.ndarray]:
    """Yield postures in which the robot's motion rests [unit of the commanded signal], shape (k,), its start first."""
    low, high = robot.bounds(robot.command.signal)
    yield from (command for command, duration in motion_of(robot, seed)(0.5 * (low + high)) if duration > REST)


def reach_of(robot: RobotConfig) -> float:
    """Return the reach of an arm [m].

    Raises:
        ConfigError: The simulator does not know it.
    """
    reach = getattr(simulator_of(robot), "reach", None)
    if reach is None:
        raise ConfigError(f"The simulator of '{robot.robot}' has no method `reach`, by which the demo judges the tip.")
    return float(reach(robot))
