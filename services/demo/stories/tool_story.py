"""Story of a robot with tools: it moves, its camera is covered, its tool is changed, and the update detects this."""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import cycle
from statistics import mode

import numpy as np

from gemuco.adaption.recognise import Prior
from gemuco.schema import BodySchema
from hal.config import RobotConfig
from services.client import Client
from services.demo.actor import NOTICED_WITHIN, Actor, Stage
from services.demo.stories.tool_targets import common_targets
from services.demo.timeline import Timeline
from services.errors import ServiceError
from services.model.anomaly_loop import UNKNOWN
from services.model.control_config import ControlConfig
from services.model.model_config import model_config
from services.wire.messages import Update

TARGETS = 4
"""The tip's error is measured at this many targets: with the first tool, with the other tool, and after learning."""
LEARNING_TARGETS = 4
"""The model learns between this many targets."""
LEARNING_TIME = 7.0
"""The model learns for at least this time [s]."""
SETTLE = 1.5
"""The tip rests this long [s] at a measured target."""
SHORT_REST = 0.4
"""The tip rests this long [s] at a target that is not measured."""
BETTER = 0.5
"""After the tool is recognised, the tip's error must be at most this share of the error before."""
FOLLOWS = 0.05
"""The tip's mean error [m] is smaller than this with a correct model."""
NAMES = ("moves a tool to targets", "loses its sight", "its tool is changed", "recognises the tool")


@dataclass(slots=True)
class ToolMarks:
    """Moments [s of the timeline] and distances [m] that the plot shows."""

    conditions: tuple[str, str]
    covered: tuple[float, float] = (0.0, 0.0)
    adapting: list[tuple[float, float]] = field(default_factory=list)
    changed: float = float("nan")
    targets: list[tuple[float, np.ndarray]] = field(default_factory=list)
    """Time and value of every target."""
    reached: list[tuple[float, float]] = field(default_factory=list)
    """Time of every measurement at a target, and distance of the tip from the target."""
    stages: list[Stage] = field(default_factory=list)


def fits(robot: RobotConfig, control: ControlConfig | None) -> bool:
    """Whether the robot holds one of several tools and has a camera."""
    return control is not None and bool(robot.conditions and robot.seen)


class ToolStory:
    """Stages of the demo, played by a client."""

    def __init__(
        self, robot: RobotConfig, client: Client, timeline: Timeline, seed: int, actor: Actor,
        report: Callable[[str], None], schema: BodySchema,
    ) -> None:  # fmt: skip
        """Call `report` with a line of text per event; `schema` gives the p of the trained conditions.

        Raises:
            ConfigError: The robot file has no control or no forecast.
            NowhereToGo: The robot reaches too few targets under both its first and its last condition.
        """
        control = model_config(robot).control
        assert control is not None
        self._client, self._timeline, self._actor, self._report = client, timeline, actor, report
        self._signal, self._speed = control.target, control.speed
        self._names, self._prior = list(schema.biases), Prior.of(schema)
        self.marks = ToolMarks((robot.conditions[0], robot.conditions[-1]))
        count = LEARNING_TARGETS + TARGETS
        targets, _ = common_targets(robot, self._signal, self.marks.conditions, count, seed)
        self._learning, self._measured = targets[:LEARNING_TARGETS], targets[LEARNING_TARGETS:]
        self._first_error = self._new_error = float("nan")

    def play(self) -> ToolMarks:
        """Play all stages, less than a minute."""
        for stage in (self.move, self.lose_sight, self.change_tool, self.recognise):
            self.marks.stages.append(self._actor.play(stage))
        return self.marks

    def move(self) -> Stage:
        """Play (a): the model learns this body and its tool, and targets are reached."""
        self._report(f"[bold](a)[/] The model recognises the tool in the hand, and its tip moves to {TARGETS} targets.")
        start = self._timeline.now()
        self._actor.engage()
        _, sentences = self._adapt(self.marks.conditions[0])
        self._first_error = self._measure()
        for target in self._learning:
            self._go(target, SHORT_REST)
        normal = self._client.learn_normal()
        figures = (
            *sentences,
            f"{TARGETS} targets, tip {1e3 * self._first_error:.0f} mm away from them on average",
            f"statistics of normal errors learned anew from {normal['samples']} samples",
        )
        return self._stage(NAMES[0], start, figures, self._first_error < FOLLOWS)

    def lose_sight(self) -> Stage:
        """Play (b): the camera is covered; the tip is estimated and marked as estimated."""
        self._report(
            "[bold](b)[/] The camera is covered. The tip is estimated from the joints and marked as estimated."
        )
        start = self._timeline.now()
        self._actor.fault("camera_covered", "vision")
        lost = self._timeline.now()
        noticed, delay = self._actor.notice(lambda: self._is_estimated(True))
        first = self._timeline.stamp()
        for target in self._learning[::-1]:
            self._go(target, SHORT_REST)
        end, last = self._timeline.now(), self._timeline.stamp()
        self._actor.fault("camera_back", "vision")
        returned = self._actor.wait(lambda: self._is_estimated(False), NOTICED_WITHIN)
        self.marks.covered = (start, end)
        value, truth = (self._timeline.between(name, lost + delay, end) for name in ("value", "truth"))
        marked = self._timeline.marked(first, last)
        error = np.linalg.norm(value - truth, axis=1)
        mean = float(np.nanmean(error)) if np.isfinite(error).any() else float("nan")
        source = mode(self._timeline.between("source", lost + delay, end).tolist() or [""])
        source = "method " + source.replace(" ", ", from ", 1).replace("+", ", ")
        figures = (
            f"marked as estimated after {1e3 * delay:.0f} ms, {source}",
            f"true error of the tip meanwhile: mean {1e3 * mean:.0f} mm, worst {1e3 * np.nanmax(error):.0f} mm",
            f"{marked:.0%} of the values published meanwhile are marked as estimated",
            "measured again when the camera was uncovered"
            if returned
            else "not measured again after the camera was uncovered",
        )
        seen = noticed and returned and marked == 1.0 and mean < FOLLOWS
        return self._stage(NAMES[1], start, figures, seen)

    def change_tool(self) -> Stage:
        """Play (c): another tool is put into the hand without a message to the model."""
        old, new = self.marks.conditions
        self._report(f"[bold](c)[/] The tool is changed, {old} for {new}, without a message to the model.")
        start = self.marks.changed = self._timeline.now()
        self._actor.fault(f"tool_changed {new}")
        self._new_error = self._measure()
        end = self._timeline.now()
        verdict, share = self._verdict(start)
        score, limit = (self._timeline.between(name, start, end) for name in ("score", "threshold"))
        figures = (
            f"the same targets: tip {1e3 * self._first_error:.0f} mm away before, {1e3 * self._new_error:.0f} mm now",
            f"anomaly score {np.nanmedian(score):.1f}, threshold {np.nanmedian(limit):.1f}",
            f"verdict: {verdict} ({share:.0%} of the time)",
        )
        # Either verdict counts: it depends on the difference between this body and the designer's.
        noticed = verdict in ("environment", "anomaly")
        return self._stage(NAMES[2], start, figures, noticed and self._new_error > self._first_error / BETTER)

    def recognise(self) -> Stage:
        """Play (d): the update recognises the tool."""
        self._report("[bold](d)[/] The online update recognises the tool.")
        start = self._timeline.now()
        is_recognised, sentences = self._adapt(self.marks.conditions[1])
        after = self._measure()
        self._client.disengage()
        verdict = self._verdict(self._timeline.now() - 1.0)[0]
        reason = ": what is normal with this W is not learned yet, or p is beyond the trained ones"
        figures = (
            *sentences,
            f"the same targets: tip {1e3 * self._new_error:.0f} mm away before, {1e3 * after:.0f} mm now",
            f"verdict now: {verdict}{reason if verdict == UNKNOWN else ''}",
        )
        return self._stage(NAMES[3], start, figures, is_recognised and after < BETTER * self._new_error)

    def _adapt(self, condition: str) -> tuple[bool, list[str]]:
        """Update while the tip moves; return whether the condition was recognised, and sentences on the result."""
        start = self._timeline.now()
        self._client.adapt(True)
        for target in cycle(self._learning):
            if self._timeline.now() > start + LEARNING_TIME:
                break
            self._go(target, SHORT_REST)
        self._client.adapt(False)
        end = self._timeline.now()
        self.marks.adapting.append((start, end))
        updates = self._active(start, end)
        if not updates:
            raise ServiceError("The model publishes nothing about its online update; see the logs beside the plot.")
        last = updates[-1][1]
        away = self._distances(last)
        nearest = self._names[int(np.argmin(away))]
        at = self._settled_at(start, nearest)
        when = (
            "p did not settle: it is not well known, or leaves over twice the learned errors, as on a body that is not "
            "the designer's"
        )
        if np.isfinite(at):
            first = next(update for moment, update in updates if moment >= at)
            when = f"p settled there after {at - start:.1f} s, with sample {_sample_count(first)}"
        figures = [
            f"known tool nearest to p: {nearest} ({away.min():.2f} standard deviations away); in the hand: {condition}",
            f"{when}; {_sample_count(last)} samples in {end - start:.0f} s",
        ]
        return nearest == condition and bool(last.settled) and bool(np.isfinite(at)), figures

    def _settled_at(self, start: float, condition: str) -> float:
        """Return the time at which p first settled nearest to a condition; NaN if it did not."""
        index = self._names.index(condition)
        for at, update in self._active(start, np.inf):
            if _sample_count(update) and update.settled and int(np.argmin(self._distances(update))) == index:
                return at
        return float("nan")

    def _active(self, start: float, end: float) -> list[tuple[float, Update]]:
        return [(at, update) for at, update in self._timeline.updates if start <= at < end and update.active]

    def _distances(self, update: Update) -> np.ndarray:
        """Return distances of p to the known conditions [standard deviations of the trained p], shape (conditions,)."""
        return np.array([self._prior.between(update.bias, known) for known in self._prior.known])

    def _measure(self) -> float:
        """Return the mean distance of the tip from the targets [m]."""
        errors = []
        for target in self._measured:
            self._go(target, SETTLE)
            errors.append(float(np.linalg.norm(self._actor.truth(self._signal) - target)))
            self.marks.reached.append((self._timeline.now(), errors[-1]))
        return float(np.mean(errors))

    def _go(self, target: np.ndarray, rest: float) -> None:
        """Go to a target [m] at the robot file's speed, and rest there for `rest` [s]."""
        distance = float(np.abs(target - self._actor.truth(self._signal)).max())
        self.marks.targets.append((self._timeline.now(), target))
        self._actor.go(self._signal, target, distance / self._speed + rest)

    def _is_estimated(self, expected: bool) -> bool:
        estimate = self._client.estimate()
        return estimate is not None and bool((estimate.estimated[self._signal] == expected).all())

    def _verdict(self, start: float) -> tuple[str, float]:
        """Return the most frequent verdict on the body since a time, and its share."""
        words = [word for word in self._timeline.between("verdict", start, np.inf).tolist() if word]
        verdict = mode(words or ["none"])
        return verdict, words.count(verdict) / max(1, len(words))

    def _stage(self, name: str, start: float, figures: tuple[str, ...], observed: bool) -> Stage:
        return Stage(name, start, self._timeline.now(), figures, observed)


def _sample_count(update: Update) -> int:
    """Return the number of samples since the update began; the window may have dropped some."""
    return update.window + update.dropped
