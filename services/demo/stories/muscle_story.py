"""Story of the demo: an arm moves, loses a sensor, learns its body, has sensors that lie, and loses a muscle."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from statistics import mode

import numpy as np

from hal.config import RobotConfig
from services.client import Client
from services.demo.actor import NOTICED_WITHIN, Actor, Stage
from services.demo.timeline import Timeline, hidden_error
from services.model.control_config import ControlConfig
from services.wire.messages import Anomaly

POSE_TIME = 2.5
"""The arm has at most this time for a test pose [s]."""
SETS_OFF = 0.7
"""From this time [s] on an arm that stands still has reached its pose."""
RESTING, STILL = 0.3, 0.01
"""An arm rests if no joint moved by more than `STILL` [rad] within this time [s]."""
POSES = 6
"""The model's error is measured at this many test poses before and after the update, which does not use them."""
LEARNING_POSES = 8
LEARNING_TIME = 1.6
MOVING_TIME = 1.2
"""The arm sets off for its next pose before it rests: its samples differ more."""
LEARNED = 80
"""The online update takes this many samples before it is stopped; eight poses give about a hundred samples."""
NORMAL = 200
"""The statistics of normal errors are learned from this many samples; six test poses give about 100."""
MOST_POSES = 24
"""At most this many further poses are used to collect samples, because a machine may be slow."""
CALM_TIME = 2.0
"""No anomaly may be reported for this long [s] before the muscle is cut."""
SETTLING = 0.5
"""New statistics are in use, and all verdicts of the old ones have arrived, after this time [s]."""
CALM_TRIES = 3
"""The statistics of normal errors are learned at most this often, each time from more poses."""
SILENT_POSES = 2
CUT_POSES = 3
LOADED, LOADING_POSES = 20.0, 6
"""The muscle is cut where it bears the first number [N], if it does in one of the second number of poses: the cut of a
slack wire changes nothing that could be noticed."""
INSIDE = 0.15
"""The distance of targets from the limits is at least this share of the range."""
ENCODER, SILENT_ELEMENT = "shoulder_roll_encoder", "shoulder_roll"
MUSCLE, TENSION = "deltoid_side", "muscle_tension"
LIES = (("elbow_pitch", "sensor_offset elbow_pitch_encoder 1.0", "one radian off"),
        ("shoulder_pitch", "sensor_frozen shoulder_pitch_encoder", "frozen"))  # fmt: skip
"""Elements whose encoders lie, the faults, and the lies in words."""
LYING_POSES = 2
TRUE_POSES = 6
"""A lying encoder is trusted again within this number of poses to which the arm went without being stopped."""
WRONG, LEAKS_AFTER = 0.1, 2.0
"""A value is wrong from this error on [rad]; this time [s] after the first one none may be passed on as measured."""
NAMES = ("moves to targets", "loses an encoder", "learns its own body", "has encoders that lie", "loses a muscle")


@dataclass(slots=True)
class Marks:
    """Moments [s of the timeline] and figures that the plot shows."""

    silent: tuple[float, float] = (0.0, 0.0)
    learning: tuple[float, float] = (0.0, 0.0)
    lies: float = 0.0
    cut: float = 0.0
    alarm: float = float("nan")
    blamed: str = ""
    error_before: float = float("nan")
    error_after: float = float("nan")
    stages: list[Stage] = field(default_factory=list)


def fits(robot: RobotConfig, control: ControlConfig | None) -> bool:
    """Whether the robot has the muscle that is cut, and measures its tension."""
    is_measured = TENSION in robot.signals and MUSCLE in robot.signals[TENSION].elements
    return control is not None and is_measured and MUSCLE in robot.signals[robot.command.signal].elements


class MuscleStory:
    """Stages of the demo, played by a client."""

    def __init__(
        self, robot: RobotConfig, client: Client, timeline: Timeline, seed: int, actor: Actor,
        report: Callable[[str], None],
    ) -> None:  # fmt: skip
        """Call `report` with a line of text per event."""
        self._client, self._timeline, self._actor, self._report = client, timeline, actor, report
        self._signal = "joint_position"
        self._elements = robot.signals[self._signal].elements
        self._muscles = robot.signals[robot.command.signal].elements
        self._muscle_signals = {name for name, signal in robot.signals.items() if signal.elements == self._muscles}
        self._loaded = robot.signals[TENSION].elements.index(MUSCLE)
        self._low, self._high = robot.bounds(self._signal)
        self._random = np.random.default_rng(seed)
        self._poses = [self._pose() for _ in range(POSES)]
        self.marks = Marks()

    def play(self) -> Marks:
        """Play all stages, about a minute."""
        for stage in (self.move, self.lose_sensor, self.learn, self.lie, self.lose_muscle):
            self.marks.stages.append(self._actor.play(stage))
        return self.marks

    def move(self) -> Stage:
        """Play (a): the arm moves to targets."""
        self._report("[bold](a)[/] The controller moves the arm to targets.")
        start = self._timeline.now()
        self._actor.engage()
        misses, errors = self._measure_poses()
        self.marks.error_before = _mean_norm(errors)
        reached = _mean_norm(misses)
        figures = (
            f"{POSES} targets, distance from the target {reached:.3f} rad (mean norm of 5 joints)",
            f"with all encoders hidden, the model would be wrong by {self.marks.error_before:.3f} rad",
        )
        truth = self._timeline.between("truth", start, self._timeline.now())
        span = float(np.nanmax(np.nanmax(truth, axis=0) - np.nanmin(truth, axis=0)))
        return Stage(NAMES[0], start, self._timeline.now(), figures, reached < 0.5 and span > 0.3)

    def lose_sensor(self) -> Stage:
        """Play (b): an encoder falls silent; the arm continues with an estimate."""
        self._report(f"[bold](b)[/] The node of {ENCODER} falls silent. The arm continues with an estimate.")
        index = self._elements.index(SILENT_ELEMENT)
        start = self._timeline.now()
        self._actor.fault(f"sensor_silent {ENCODER}")
        lost = self._timeline.now()
        noticed, delay = self._actor.notice(lambda: self._is_estimated(index))
        for _ in range(SILENT_POSES):
            self._go(self._pose(), LEARNING_TIME)
        end = self._timeline.now()
        self._actor.fault(f"node_back {ENCODER}")
        returned = self._actor.wait(lambda: not self._is_estimated(index), NOTICED_WITHIN)
        self.marks.silent = (start, end)
        error = np.abs(self._silent_error(index, lost + delay, end))
        source = mode(self._timeline.between("source", lost + delay, end).tolist() or [""])
        source = "method " + source.replace(" ", ", from ").replace("+", ", ")
        worst = float(np.nanmax(error)) if error.size else float("nan")
        mean = float(np.nanmean(error)) if error.size else float("nan")
        figures = (
            f"marked as estimated after {1e3 * delay:.0f} ms, {source}",
            f"true error of {SILENT_ELEMENT} while silent: mean {mean:.3f} rad, worst {worst:.3f} rad",
            "measured again when the node came back" if returned else "not measured again after the node came back",
        )
        return Stage(NAMES[1], start, self._timeline.now(), figures, noticed and returned and mean < 0.5)

    def learn(self) -> Stage:
        """Play (c): the model learns online while the arm moves, and its error is measured at test poses."""
        self._report("[bold](c)[/] The online update learns from the arm's own motion.")
        start = self._timeline.now()
        self._client.adapt(True)
        for _ in range(LEARNING_POSES):
            self._go(self._pose(), MOVING_TIME)
        window = self._gather(LEARNED)
        self._client.adapt(False)
        self.marks.learning = (start, self._timeline.now())
        misses, errors = self._measure_poses()
        self.marks.error_after = _mean_norm(errors)
        normal = self._learn_normal()
        before, after = self.marks.error_before, self.marks.error_after
        figures = (
            f"learned for {self.marks.learning[1] - start:.0f} s from {window} samples",
            f"estimate at {POSES} test poses with all encoders hidden: {before:.3f} rad before, {after:.3f} rad after",
            f"distance from the targets now {_mean_norm(misses):.3f} rad",
            f"statistics of normal errors learned anew from {normal} samples",
        )
        return Stage(NAMES[2], start, self._timeline.now(), figures, after < before)

    def lie(self) -> Stage:
        """Play (d): an encoder is one radian off, then another one freezes; each is hidden until it is right again."""
        self._become_calm()
        start, figures, observed = self._timeline.now(), [], True
        self.marks.lies = start
        for element, fault, words in LIES:
            self._report(f"[bold](d)[/] The encoder of {element} lies: {words}.")
            figure, is_seen = self._lying(element, fault, words)
            figures.append(figure)
            observed &= is_seen
        return Stage(NAMES[3], start, self._timeline.now(), tuple(figures), observed)

    def _lying(self, element: str, fault: str, words: str) -> tuple[str, bool]:
        """Let an encoder lie and be right again; return a sentence, and whether it was hidden and trusted again."""
        index, start = self._elements.index(element), self._timeline.now()
        self._actor.fault(fault)
        reason = ""
        for _ in range(LYING_POSES):
            self._go(self._pose(), LEARNING_TIME)
            reason = self._reason(element) or reason
        self._actor.fault(f"sensor_true {element}_encoder")
        end = self._timeline.now()
        reached = 0
        for _ in range(MOST_POSES):
            if not self._is_estimated(index) or reached == TRUE_POSES:
                break
            stops = self._actor.stops
            self._go(self._pose(), LEARNING_TIME)
            reached += self._actor.stops == stops
        returned = self._timeline.now() - end
        at, hidden = (self._timeline.between(name, start, end) for name in ("time", "estimated"))
        hidden = hidden[:, index] > 0
        error = np.abs(self._silent_error(index, start, end))
        wrong = error[hidden & np.isfinite(error)]
        if not reason or not wrong.size:
            return f"{element} {words}: not noticed", False
        delay = float(at[np.argmax(hidden)]) - start
        late = leaks(at, hidden, error)
        leak = f", wrong as measured later by {error[late].max():.3f} rad" if late.any() else ""
        is_back = not self._is_estimated(index)
        back = f"trusted again {returned:.0f} s after it was right" if is_back else "not trusted again"
        text = (
            f"{element} {words}: {reason}; hidden after {delay:.1f} s, estimate wrong by {wrong.mean():.3f} rad; {back}"
        )
        return text + leak, is_back and not late.any()

    def _reason(self, element: str) -> str:
        """Return why an element is hidden now: by the model, or by the HAL; empty if no reason is given."""
        name, estimate, status = f"{self._signal}.{element}", self._client.estimate(), self._client.status("hal")
        if estimate is not None and name in estimate.distrusted:
            return estimate.distrusted[name]
        return status.text.rstrip(".") if status is not None and name in status.text else ""

    def lose_muscle(self) -> Stage:
        """Play (e): a muscle is cut, and the anomaly detection names it, or an element of it is distrusted."""
        self._load_muscle()
        self._become_calm()
        tension = self._tension()
        self._report(f"[bold](e)[/] The wire of {MUSCLE}, which bears {tension:.0f} N, is cut.")
        start = self._timeline.now()
        calm = self._timeline.between("is_anomaly", start - CALM_TIME, start)
        score = float(np.nanmedian(self._timeline.between("score", start - CALM_TIME, start)))
        alarms = float(np.mean(self._timeline.between("is_anomaly", 0.0, self.marks.lies)))
        self._actor.fault(f"muscle_cut {MUSCLE}")
        self.marks.cut = start
        noticed = self._actor.wait(self._is_cut_noticed, NOTICED_WITHIN)
        for _ in range(CUT_POSES if not noticed else 0):  # in some postures the muscle bears nothing
            self._go_as_cut(lambda: self._is_cut_noticed)
            if noticed := self._is_cut_noticed():
                break
        self.marks.alarm = self._timeline.now()
        for _ in range(CUT_POSES):
            self._go_as_cut()
        early = [anomaly for at, anomaly in self._timeline.anomalies if start <= at < self.marks.alarm + 1.0]
        verdicts, end = self._distrusted_of_muscle(), self._timeline.now()
        by = ["the test for lies"] * bool(verdicts) + ["the anomaly detection"] * bool(early)
        # Without the distrusted length the score is of the other muscles.
        self.marks.blamed = MUSCLE if verdicts else self._blamed_muscle(early)
        peak = float(np.nanmax(self._timeline.between("score", start, self.marks.alarm + 1.0)))
        limit = float(np.nanmedian(self._timeline.between("threshold", start, end)))
        figures = (
            f"the wire bore {tension:.0f} N",
            f"anomaly score {score:.1f} before the cut, then up to {peak:.1f}, threshold {limit:.1f}",
            f"reported after {1e3 * (self.marks.alarm - start):.0f} ms by {' and '.join(by) or 'nothing'}",
            *self._blame(early),
            f"before anything was wrong an anomaly was reported {alarms:.1%} of the time",
            *(f"{name} is {why}; motion needs it, so the arm stays off" for name, why in verdicts),
        )
        right = self.marks.blamed == MUSCLE
        self._client.disengage()
        return Stage(NAMES[4], start, end, figures, noticed and right and not calm.any())

    def _load_muscle(self) -> None:
        """Go to poses until the muscle bears something."""
        for _ in range(LOADING_POSES):
            if self._tension() >= LOADED:
                return
            self._actor.go(self._signal, self._pose(), POSE_TIME, ends=self._at_rest)

    def _tension(self) -> float:
        """Return the true tension of the muscle now [N]."""
        return float(self._actor.truth(TENSION)[self._loaded])

    def _is_cut_noticed(self) -> bool:
        return self._is_alarmed() or bool(self._distrusted_of_muscle())

    def _go_as_cut(self, ends: Callable[[], Callable[[], bool]] = lambda: lambda: False) -> None:
        """Go to a pose, unless the arm is stopped because the cut muscle is distrusted."""
        self._actor.go(self._signal, self._pose(), LEARNING_TIME, lambda: bool(self._distrusted_of_muscle()), ends)

    def _distrusted_of_muscle(self) -> list[tuple[str, str]]:
        """Return the elements of the cut muscle that are not used as measured, and why."""
        estimate = self._client.estimate()
        known = {} if estimate is None else estimate.distrusted
        return [(name, why) for name, why in known.items() if name.partition(".")[2] == MUSCLE]

    def _gather(self, samples: int) -> int:
        """Go to more poses until the update's window has this many samples; return its number of samples."""
        for _ in range(MOST_POSES):
            if self._window() >= samples:
                break
            self._go(self._pose(), MOVING_TIME)
        return self._window()

    def _window(self) -> int:
        update = self._client.update(timeout=1.0)
        return 0 if update is None else update.window

    def _learn_normal(self) -> int:
        """Learn the statistics of normal errors since the model changed; return the number of samples."""
        self._gather(NORMAL)
        return int(self._client.learn_normal()["samples"])

    def _become_calm(self) -> None:
        """Wait until the whole arm has no anomaly; if it has one, learn normal errors from more motion."""
        for tries_left in reversed(range(CALM_TRIES)):
            self._actor.wait(lambda: False, SETTLING)
            start = self._timeline.now()
            self._actor.wait(lambda: False, CALM_TIME)
            if not self._timeline.between("is_anomaly", start, self._timeline.now()).any() or not tries_left:
                return
            self._report(
                "    An anomaly is reported for the whole arm: normal errors are learned from more of its motion."
            )
            for _ in range(LEARNING_POSES):
                self._go(self._pose(), LEARNING_TIME)
            self._report(f"    Statistics of normal errors learned anew from {self._learn_normal()} samples.")

    def _blame(self, anomalies: list[Anomaly]) -> list[str]:
        """Return a line on what the anomaly detection names; none if it reports nothing before the arm stops."""
        if not anomalies:
            return []
        element = mode(anomaly.blamed for anomaly in anomalies)
        return [
            f"the anomaly detection: largest part of the score from the muscle {self._blamed_muscle(anomalies)}, of "
            f"single elements from {element or 'none'}"
        ]

    def _blamed_muscle(self, anomalies: list[Anomaly]) -> str:
        """Return the muscle whose tension and length together contribute most; empty without anomalies."""
        total = np.zeros(len(self._muscles))
        for anomaly in anomalies:
            for signal in self._muscle_signals & anomaly.contribution.keys():
                total += np.nan_to_num(anomaly.contribution[signal])
        return self._muscles[int(np.argmax(total))] if anomalies else ""

    def _measure_poses(self) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return, for every test pose, target minus truth and estimate with hidden encoders minus truth [rad]."""
        misses, errors = [], []
        for pose in self._poses:
            self._actor.go(self._signal, pose, POSE_TIME, ends=self._at_rest)
            misses.append(pose - self._actor.truth(self._signal))
            errors.append(self._hidden_error())
        return misses, errors

    def _hidden_error(self) -> np.ndarray:
        """Return estimate with hidden encoders minus truth [rad]; query again while a muscle's sensor is late."""
        errors: list[np.ndarray] = []

        def is_complete() -> bool:
            errors.append(hidden_error(self._client, self._signal, [self._signal]))
            return bool(np.isfinite(errors[-1]).all())

        self._actor.wait(is_complete, NOTICED_WITHIN)
        return errors[-1]

    def _at_rest(self) -> Callable[[], bool]:
        """Return a function that returns whether the arm has reached a pose for which it sets off now."""
        begun = time.monotonic()
        moved, rest = begun, self._actor.truth(self._signal)

        def is_at_rest() -> bool:
            nonlocal moved, rest
            now, joints = time.monotonic(), self._actor.truth(self._signal)
            if np.abs(joints - rest).max() > STILL:
                moved, rest = now, joints
            return now - begun > SETS_OFF and now - moved > RESTING

        return is_at_rest

    def _go(self, pose: np.ndarray, duration: float) -> None:
        self._actor.go(self._signal, pose, duration)

    def _pose(self) -> np.ndarray:
        margin = INSIDE * (self._high - self._low)
        return self._random.uniform(self._low + margin, self._high - margin)

    def _is_estimated(self, index: int) -> bool:
        estimate = self._client.estimate()
        return estimate is not None and bool(estimate.estimated[self._signal][index])

    def _is_alarmed(self) -> bool:
        anomaly = self._client.anomaly()
        return anomaly is not None and anomaly.is_anomaly

    def _silent_error(self, index: int, start: float, end: float) -> np.ndarray:
        value, truth = (self._timeline.between(name, start, end) for name in ("value", "truth"))
        return value[:, index] - truth[:, index] if len(value) else np.zeros(0)


def leaks(at: np.ndarray, hidden: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return where a value is passed on as measured that has been wrong for too long; see `LEAKS_AFTER`.

    Args:
        at: Times of the estimates [s], shape (n,).
        hidden: Whether the value was estimated, truth values, shape (n,).
        error: Size of its error [rad], shape (n,); NaN without an estimate, where nothing is passed on.
    """
    wrong = ~hidden & (error > WRONG)
    return wrong & (at > at[np.argmax(wrong)] + LEAKS_AFTER) if wrong.any() else wrong


def _mean_norm(errors: list[np.ndarray]) -> float:
    return float(np.mean([np.linalg.norm(error) for error in errors]))
