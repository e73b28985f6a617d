"""A tool that is changed while a service judges sensors: which right ones are hidden, and whether p finds the tool.

    python -m studies.live.tools [--robots pr2_duster kxr_humanoid] [--plays 8] [--first 0] [--body 1]

The story of `gemuco demo` for a robot with tools in simulated time, on an actual body, moved by its own controller: the
service first takes another p to be in use. It updates for 7 s and learns what is normal, its camera is covered for a
few seconds, and then the tool is changed without a message. The update is on again for 7 s only after that. No sensor
lies. All loops of the model service run at their own rates; there is no HAL, and the body follows the commands within
its limit of rate. The seed draws the body, its noise and the targets; with `--body` these are the same in all plays,
and only the rests differ by some 10 ms, as they do from one demo to the next. The model is learned once, as by the
demo, and kept in runs/NAME/model.
"""

import argparse
import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import cycle

import numpy as np
from rich.console import Console
from rich.table import Table

import gemuco
from gemuco import BodySchema
from gemuco.adaption.recognise import Prior
from gemuco.errors import NotEnoughData
from hal import registry
from hal.config import RobotConfig, load_robot
from services.demo.demo import make_model
from services.demo.stories.tool_story import (
    BETTER,
    FOLLOWS,
    LEARNING_TARGETS,
    LEARNING_TIME,
    SETTLE,
    SHORT_REST,
    TARGETS,
)
from services.demo.stories.tool_targets import common_targets
from services.errors import NotEngaged
from services.model import artifacts
from services.model.control_loop import Control
from services.model.model_config import model_config
from services.wire.messages import Target
from studies.live.service import LiveService

ROBOTS = "pr2_duster", "kxr_humanoid"
CAMERA_EVERY, CAMERA_AGE = 2, 0.035
"""The camera reports every second sample of the HAL, this old [s]."""
STEP = 0.005
"""The body moves in steps of this length [s]."""
BEFORE = 8.0
"""The robot rests, engaged, for this time [s] before the story begins."""
SHIFT = 0.013
"""Rests are longer by a multiple of this time [s]."""
PAUSE, TRIES, REPEATS = 1.0, 15, 3
"""A stopped robot is engaged again after this time [s], which is tried the second number of times. A target is sent at
most the third number of times."""


@dataclass(slots=True)
class Play:
    """One play.

    Attributes:
        seed: Seed of body, noise and targets.
        hidden: Times [s] and names of right elements that were hidden.
        stops: Times [s] at which the robot was stopped for one of them.
        tools: After each update the nearest trained tool, and the distance of p from it [standard deviations of the
            trained p].
        is_settled: Whether p settled there in the last update.
        errors: Mean distance of the tip from its targets [m] before the change, after it, and at the end.
        reason: Why the play ended early; empty if it did not.
    """

    seed: int
    hidden: list[tuple[float, str]] = field(default_factory=list)
    stops: list[float] = field(default_factory=list)
    tools: list[tuple[str, float]] = field(default_factory=list)
    is_settled: bool = False
    errors: list[float] = field(default_factory=list)
    reason: str = ""

    def recognised(self, tool: str) -> bool:
        """Whether p became that of the changed tool, and the tip moved as the demo wants.

        The estimate without the camera, and the verdict, are not judged.
        """
        if self.reason:
            return False
        first, changed, last = self.errors
        moves = first < FOLLOWS and changed > first / BETTER and last < BETTER * changed
        return moves and self.is_settled and self.tools[-1][0] == tool


class NotFollowing(Exception):
    """The robot was stopped for a sensor, and cannot be engaged."""


class LiveRobot:
    """A simulated robot with a tool that a model service moves; `result` is what happened so far."""

    def __init__(self, robot: RobotConfig, schema: BodySchema, seed: int, shift: float) -> None:
        """Put the robot at rest with its first tool in the hand, and engage the controller after a while.

        Args:
            robot: The robot file.
            schema: Its model.
            seed: Seed of body and noise.
            shift: All rests are longer by this time [s].
        """
        settings = model_config(robot).control
        assert settings is not None
        self._robot, self._settings, self._shift, self.result = robot, settings, shift, Play(seed)
        simulator = registry.load_object(str(robot.simulator), "simulator", ("world",))
        self._world = simulator.world("actual", seed, robot.conditions[0])
        self.service = LiveService(robot, schema)
        self._period, self._cycles = 1.0 / robot.rates.hal, 0
        self.is_covered = False
        self._pictures: deque[tuple[float, dict[str, np.ndarray]]] = deque()
        self._command = np.array(self._world.truth()[robot.command.signal])
        self._hidden: frozenset[str] = frozenset()
        self._names, self._prior = list(schema.biases), Prior.of(schema)
        self.service.follow()
        self._run(1.0)
        self._control.engage(lambda: None)
        self._run(BEFORE + shift)

    @property
    def _control(self) -> Control:
        control = self.service.model.control
        assert control is not None
        return control

    def _run(self, seconds: float) -> None:
        end = self.service.now + seconds
        while self.service.now < end - 1e-9:
            self._turn()

    def _turn(self) -> None:
        """Let one cycle of the HAL pass."""
        self._cycles += 1
        service, robot, time = self.service, self._robot, self._cycles * self._period
        self._move(service.command)
        values = {name: np.asarray(value, float) for name, value in self._world.measure().items()}
        if self._cycles % CAMERA_EVERY == 0:
            seen = {
                name: np.full_like(values[name], np.nan) if self.is_covered else values[name] for name in robot.seen
            }
            self._pictures.append((time + CAMERA_AGE, seen))
        while self._pictures and self._pictures[0][0] <= time:
            arrival, seen = self._pictures.popleft()
            service.run_until(arrival)
            service.camera(seen, CAMERA_AGE)
        service.run_until(time)
        service.hal({name: value for name, value in values.items() if name not in robot.seen})
        hidden = frozenset(service.model.freshness.distrust.reasons)
        self.result.hidden += [(round(time, 2), name) for name in sorted(hidden - self._hidden)]
        self._hidden = hidden

    def _move(self, command: np.ndarray | None) -> None:
        """Let the body follow a command [its unit], shape (n,), within the limit of rate, for one cycle."""
        signal = self._robot.command.signal
        reach = np.asarray(self._robot.limits[signal].rate) * self._period
        if command is not None:
            self._command = self._command + np.clip(command - self._command, -reach, reach)
        for name, position in zip(self._robot.signals[signal].elements, self._command.tolist(), strict=True):
            self._world.drive(f"{signal}.{name}", position, True)
        for _ in range(round(self._period / STEP)):
            self._world.step(STEP)

    def go(self, target: np.ndarray, rest: float) -> float:
        """Move the tip to a target [m] and rest there [s]; return its distance from the target [m].

        Raises:
            NotFollowing: The robot was stopped, and cannot be engaged.
        """
        signal = self._settings.target
        duration = float(np.abs(target - self._world.truth()[signal]).max()) / self._settings.speed
        for _ in range(REPEATS):
            if not self._control.engaged:
                self._recover()
            self._control.set_target(Target(signal=signal, values=target))
            self._run(duration + rest + self._shift)
            if self._control.engaged:
                break
        return float(np.linalg.norm(self._world.truth()[signal] - target))

    def _recover(self) -> None:
        self.result.stops.append(round(self.service.now, 2))
        for _ in range(TRIES):
            self._run(PAUSE)
            if not self.service.model.trust.refusal():
                self._control.engage(lambda: None)
                return
        raise NotFollowing(self.service.model.trust.refusal())

    def adapt(self, targets: np.ndarray) -> None:
        """Update while the tip moves between targets."""
        start, settled = self.service.now, ""
        self.service.model.update.adapt(True)
        for target in cycle(targets):
            if self.service.now > start + LEARNING_TIME:
                break
            self.go(target, SHORT_REST)
            update = self.service.updated
            settled = self._nearest(update.bias)[0] if update.settled else settled
        self.service.model.update.adapt(False)
        self.result.tools.append(self._nearest(self.service.model.living.schema.bias))
        self.result.is_settled = settled == self.result.tools[-1][0]

    def _nearest(self, p: np.ndarray) -> tuple[str, float]:
        away = [self._prior.between(p, known) for known in self._prior.known]
        return self._names[int(np.argmin(away))], round(min(away), 2)

    def measure(self, targets: np.ndarray) -> None:
        """Measure the distance of the tip from targets [m]."""
        self.result.errors.append(round(float(np.mean([self.go(target, SETTLE) for target in targets])), 3))

    def change_tool(self, condition: str) -> None:
        """Put another tool into the hand."""
        self._run(1.0)
        self._world.break_part(f"tool_changed:{condition}")


def play(robot: RobotConfig, schema: BodySchema, seed: int, shift: float = 0.0) -> Play:
    """Play the story once, with rests that are longer by `shift` [s]."""
    control = model_config(robot).control
    assert control is not None
    tools = robot.conditions[0], robot.conditions[-1]
    targets, _ = common_targets(robot, control.target, tools, LEARNING_TARGETS + TARGETS, seed)
    learning, measured = targets[:LEARNING_TARGETS], targets[LEARNING_TARGETS:]
    live = LiveRobot(robot, schema, seed, shift)
    try:
        live.adapt(learning)
        live.measure(measured)
        for target in learning:
            live.go(target, SHORT_REST)
        live.service.model.update.learn_normal()
        live.is_covered = True
        for target in learning[::-1]:
            live.go(target, SHORT_REST)
        live.is_covered = False
        live.change_tool(tools[1])
        live.measure(measured)
        live.adapt(learning)
        live.measure(measured)
    except (NotFollowing, NotEnoughData, NotEngaged) as error:
        live.result.reason = str(error)
    return live.result


def row_of(robot: RobotConfig, plays: Sequence[Play]) -> tuple[str, ...]:
    """Return the row of one robot."""
    hidden, stopped = (sum(map(bool, counted)) for counted in ([p.hidden for p in plays], [p.stops for p in plays]))
    recognised = [play for play in plays if play.recognised(robot.conditions[-1])]
    errors = [1e3 * np.array([play.errors[n] for play in plays if len(play.errors) > n]) for n in range(3)]
    medians = ", ".join(f"{np.median(part):.0f}" if len(part) else "-" for part in errors)
    return robot.robot, str(len(plays)), str(hidden), str(stopped), str(len(recognised)), medians


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), choices=ROBOTS)
    parser.add_argument("--plays", type=int, default=8, help="Plays of each robot.")
    parser.add_argument("--first", type=int, default=0, help="The first seed.")
    parser.add_argument("--body", type=int, help="The seed of all plays; the rests differ.")
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    headings = "plays", "a right one hidden", "stopped for it", "tool recognised", "median errors [mm]"
    table = Table("robot", *headings)
    for name in options.robots:
        robot = load_robot(f"robots/{name}.yaml")
        make_model(robot, Console())
        schema, plays = gemuco.load(artifacts.model_folder(name)), []
        for number in range(options.first, options.first + options.plays):
            is_same = options.body is not None
            plays.append(play(robot, schema, options.body if is_same else number, SHIFT * number if is_same else 0.0))
            print(plays[-1], flush=True)
        table.add_row(*row_of(robot, plays))
    Console(width=120).print(table)
