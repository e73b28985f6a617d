"""The story of a robot that holds tools: it moves, its camera is covered, its tool is changed, and it notices."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import cycle

import numpy as np

from gemuco.adaption.recognise import Prior
from gemuco.schema import BodySchema
from hal.config import RobotConfig
from services.client import Client
from services.demo.actor import NOTICED_WITHIN, Actor, Stage
from services.demo.timeline import Timeline
from services.demo.tool_targets import common_targets
from services.errors import ServiceError
from services.model.model_config import model_config
from services.wire.messages import Update

TARGETS = 4
"""Targets at which the tip's error is measured: with the first tool, with the other one, and when it is known."""
LEARNING_TARGETS = 4
"""Targets between which the model learns."""
LEARNING_TIME = 7.0
"""How long it learns at least [s]."""
SETTLE = 1.5
"""Time [s] at a target beside the time of the way there."""
HURRY = 0.4
"""The same where nothing is measured."""
BETTER = 0.5
"""Knowing the tool must at least halve the tip's error."""
FOLLOWS = 0.05
"""A measured model brings the tip this near to a target [m], or something is wrong."""


@dataclass(slots=True)
class ToolMarks:
    """Moments and figures that the plot shows, on the timeline's clock; errors are distances [m]."""

    conditions: tuple[str, str]
    covered: tuple[float, float] = (0.0, 0.0)
    adapting: list[tuple[float, float]] = field(default_factory=list)
    changed: float = float("nan")
    targets: list[tuple[float, np.ndarray]] = field(default_factory=list)
    """When which target was given."""
    reached: list[tuple[float, float]] = field(default_factory=list)
    """When a target was measured, and the tip's distance from it."""
    stages: list[Stage] = field(default_factory=list)


class ToolStory:
    """Plays the stages through a client, as any remote program could."""

    def __init__(
        self, robot: RobotConfig, client: Client, timeline: Timeline, seed: int, actor: Actor,
        tell: Callable[[str], None], schema: BodySchema,
    ) -> None:  # fmt: skip
        """`tell` is called with what happens; of the schema only the p of the trained conditions is read.

        Raises:
            ConfigError: The robot file does not say how the body is controlled, or forecast.
            NowhereToGo: The first and the last of the robot's conditions have too few places in common.
        """
        control = model_config(robot).control
        assert control is not None
        self._client, self._timeline, self._actor, self._tell = client, timeline, actor, tell
        self._signal, self._speed = control.target, control.speed
        self._names, self._prior = list(schema.biases), Prior.of(schema)
        self.marks = ToolMarks((robot.conditions[0], robot.conditions[-1]))
        count = LEARNING_TARGETS + TARGETS
        targets, _ = common_targets(robot, self._signal, self.marks.conditions, count, seed)
        self._learning, self._measured = targets[:LEARNING_TARGETS], targets[LEARNING_TARGETS:]
        self._before = self._without = float("nan")

    def play(self) -> ToolMarks:
        """All stages, less than a minute."""
        for stage in (self.move, self.lose_sight, self.change_tool, self.recognise):
            self.marks.stages.append(self._actor.play(stage))
        return self.marks

    def move(self) -> Stage:
        """(a) The model gets to know this body and its tool, and targets are reached."""
        self._tell(f"[bold](a)[/] Which tool is in the hand is found out, and its tip moves to {TARGETS} targets.")
        start = self._timeline.now()
        self._actor.engage()
        known = self._adapt(self.marks.conditions[0])
        self._before = self._measure()
        for target in self._learning:
            self._go(target, HURRY)
        normal = self._client.ask("model", "normal")
        figures = (
            *known[1],
            f"{TARGETS} targets, tip {1e3 * self._before:.0f} mm away from them on average",
            f"what is normal learned anew from {normal['samples']} samples",
        )
        return self._stage("moves a tool to targets", start, figures, self._before < FOLLOWS)

    def lose_sight(self) -> Stage:
        """(b) The camera is covered; the tip goes on being known, and marked as estimated."""
        self._tell("[bold](b)[/] The camera is covered. The tip is estimated from the joints, and marked so.")
        start = self._timeline.now()
        self._client.fault("camera_covered", "vision")
        noticed = self._actor.wait(lambda: self._is_estimated(True), NOTICED_WITHIN)
        delay = self._timeline.now() - start
        for target in self._learning[::-1]:
            self._go(target, HURRY)
        end = self._timeline.now()
        self._client.fault("camera_back", "vision")
        returned = self._actor.wait(lambda: self._is_estimated(False), NOTICED_WITHIN)
        self.marks.covered = (start, end)
        value, truth = (self._timeline.between(name, start + delay, end) for name in ("value", "truth"))
        marked = self._timeline.between("estimated", start + delay, end) > 0
        error = np.linalg.norm(value - truth, axis=1)
        mean = float(np.nanmean(error)) if np.isfinite(error).any() else float("nan")
        source = _most_common(self._timeline.between("source", start + delay, end).tolist())
        source = "method " + source.replace(" ", ", from ", 1).replace("+", ", ")
        figures = (
            f"marked as estimated after {1e3 * delay:.0f} ms, {source}",
            f"true error of the tip meanwhile: mean {1e3 * mean:.0f} mm, worst {1e3 * np.nanmax(error):.0f} mm",
            f"{marked.all(axis=1).mean():.0%} of what was published meanwhile is marked as estimated",
            "measured again when the camera saw again" if returned else "not measured again after the camera was back",
        )
        seen = noticed and returned and bool(marked.all()) and mean < FOLLOWS
        return self._stage("loses its sight", start, figures, seen)

    def change_tool(self) -> Stage:
        """(c) Another tool is put into the hand, and nobody tells the model."""
        old, new = self.marks.conditions
        self._tell(f"[bold](c)[/] The tool is changed, {old} for {new}, and the model does not learn of it.")
        start = self.marks.changed = self._timeline.now()
        self._client.fault(f"tool_changed {new}")
        self._without = self._measure()
        end = self._timeline.now()
        verdict, share = self._verdict(start)
        score, limit = (self._timeline.between(name, start, end) for name in ("score", "threshold"))
        figures = (
            f"the same targets: tip {1e3 * self._before:.0f} mm away before, {1e3 * self._without:.0f} mm now",
            f"anomaly score {np.nanmedian(score):.1f}, threshold {np.nanmedian(limit):.1f}",
            f"verdict: {verdict} ({share:.0%} of the time)",
        )
        # Which of the two it is depends on how near this body is to its designer's; that something is new must be told.
        noticed = verdict in ("environment", "anomaly")
        return self._stage("its tool is changed", start, figures, noticed and self._without > self._before / BETTER)

    def recognise(self) -> Stage:
        """(d) The update finds out which tool it is."""
        self._tell("[bold](d)[/] The online update looks which tool that is.")
        start = self._timeline.now()
        known, told = self._adapt(self.marks.conditions[1])
        after = self._measure()
        self._client.disengage()
        figures = (
            *told,
            f"the same targets: tip {1e3 * self._without:.0f} mm away before, {1e3 * after:.0f} mm now",
            f"verdict now: {self._verdict(self._timeline.now() - 1.0)[0]}",
        )
        return self._stage("recognises the tool", start, figures, known and after < BETTER * self._without)

    def _adapt(self, condition: str) -> tuple[bool, list[str]]:
        """Update while the tip moves; whether the condition was recognised, and what there is to say."""
        start = self._timeline.now()
        self._client.adapt(True)
        for target in cycle(self._learning):
            if self._timeline.now() > start + LEARNING_TIME:
                break
            self._go(target, HURRY)
        self._client.adapt(False)
        end = self._timeline.now()
        self.marks.adapting.append((start, end))
        updates = self._active(start, end)
        if not updates:
            raise ServiceError("The model tells nothing of its online update; see the logs beside the plot.")
        last = updates[-1][1]
        away = self._distances(last)
        nearest = self._names[int(np.argmin(away))]
        at = self._settled_at(start, nearest)
        when = "p did not settle there"
        if np.isfinite(at):
            first = next(update for moment, update in updates if moment >= at)
            when = f"p settled there after {at - start:.1f} s, with sample {_seen(first)}"
        figures = [
            f"known tool nearest to p: {nearest} ({away.min():.2f} standard deviations away); in the hand: {condition}",
            f"{when}; {_seen(last)} samples in {end - start:.0f} s",
        ]
        return nearest == condition and bool(last.settled) and bool(np.isfinite(at)), figures

    def _settled_at(self, start: float, condition: str) -> float:
        """When p first was settled nearest to a condition; NaN if it was not."""
        index = self._names.index(condition)
        for at, update in self._active(start, np.inf):
            if _seen(update) and update.settled and int(np.argmin(self._distances(update))) == index:
                return at
        return float("nan")

    def _active(self, start: float, end: float) -> list[tuple[float, Update]]:
        return [(at, update) for at, update in self._timeline.updates if start <= at < end and update.active]

    def _distances(self, update: Update) -> np.ndarray:
        """From p to that of every known condition [standard deviations of the trained p], shape (conditions,)."""
        return np.array([self._prior.between(update.bias, known) for known in self._prior.known])

    def _measure(self) -> float:
        """Mean distance of the tip from the targets [m]."""
        errors = []
        for target in self._measured:
            self._go(target, SETTLE)
            errors.append(float(np.linalg.norm(self._actor.truth(self._signal) - target)))
            self.marks.reached.append((self._timeline.now(), errors[-1]))
        return float(np.mean(errors))

    def _go(self, target: np.ndarray, rest: float) -> None:
        """Go to a target [m] at the robot file's speed, and rest there for so long [s]."""
        way = float(np.abs(target - self._actor.truth(self._signal)).max())
        self.marks.targets.append((self._timeline.now(), target))
        self._actor.go(self._signal, target, way / self._speed + rest)

    def _is_estimated(self, wanted: bool) -> bool:
        estimate = self._client.estimate()
        return estimate is not None and bool((estimate.estimated[self._signal] == wanted).all())

    def _verdict(self, start: float) -> tuple[str, float]:
        """What the body was judged to be most of the time since then, and in which share of it."""
        words = [word for word in self._timeline.between("verdict", start, np.inf).tolist() if word]
        verdict = _most_common(words) or "none"
        return verdict, words.count(verdict) / max(1, len(words))

    def _stage(self, name: str, start: float, figures: tuple[str, ...], observed: bool) -> Stage:
        return Stage(name, start, self._timeline.now(), figures, observed)


def _seen(update: Update) -> int:
    """Samples since the update began; the window may have dropped some."""
    return update.window + update.dropped


def _most_common(words: list[str]) -> str:
    return Counter(words).most_common(1)[0][0] if words else ""
