"""The trust loop: measured elements that the others contradict are hidden, estimated and marked with the reason."""

import logging
import math
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from gemuco.anomaly.blame import parts
from gemuco.estimation import fill, recipes
from gemuco.intervals.region import learned_range
from gemuco.normal import Normal
from gemuco.schema import BodySchema
from gemuco.trust.config import BLOCK, Finding, TrustConfig
from gemuco.trust.monitor import TrustMonitor
from hal.by_signal import Numbers
from hal.clock import Clock
from hal.config import RobotConfig
from services.errors import BadArguments
from services.model.estimation import Distrust, Freshness, OneTime, in_order
from services.wire.plain_text import shown

log = logging.getLogger(__name__)

RATE = 50.0
"""Samples are taken at most this often [Hz]."""
JUDGED_AT = 0.02
"""Blocks are judged this time [s] after the multiples of their length on the clock, when the update does not learn."""
BEFORE = 1.0
"""A lie may have begun this long [s] before it was noticed."""
AWAY, BACK = 0.3, 2
"""An element that was away for the first time [s] is compared with the others for the second number of blocks before it
is used again. The HAL, for example, takes a value that has jumped, and stays there, for five seconds only."""
FAR = 3.0
"""It stays hidden while it is further from its estimate than this [std that is promised for the estimate]."""
WAITS = "distrusted: it is back, and not used before it agrees with its estimate"
CAUSES = {
    "environment": "another tool or load than the model takes to be in use",
    "body": "no sensor explains what is measured; the body has changed",
}
"""These are causes without an element, in words."""
SIZED = ("offset", "drift", "noise", "clipped", "frozen", "gain", "unknown")
"""The size of these kinds is reported."""
CALIBRATED = ("offset", "wrap", "gain", "sign")
"""`gemuco calibrate` may be the repair of these kinds."""


class Trust:
    """The judge of all measured elements; the freshness of the values hides those that it distrusts."""

    def __init__(
        self,
        robot: RobotConfig,
        freshness: Freshness,
        schema: Callable[[], BodySchema],
        config: TrustConfig | None,
        clock: Clock,
        stop: Callable[[str], None] = lambda reason: None,
        is_known: Callable[[BodySchema], bool] = lambda schema: True,
        changed: Callable[[float], None] = lambda since: None,
        stops: Iterable[str] | None = None,
        factor: Callable[[], np.ndarray | float] = lambda: 1.0,
    ) -> None:
        """Prepare.

        Args:
            robot: The robot file.
            freshness: Source of samples; its `distrust` is set.
            schema: Returns the model in use.
            config: The settings; None to look for no lies.
            clock: Source of time.
            stop: Stops the robot for a reason, if an element that motion needs is distrusted.
            is_known: Whether a model's normal errors are known to be those of this body.
            changed: Called when other elements are hidden, with the time [s] since when samples are not to be learned
                from.
            stops: Signals or elements that motion needs; None for those that follow from the robot file.
            factor: Returns the factors on the std of the schema's elements, shape (size,).
        """
        self._factor = factor
        self._freshness, self._schema, self._clock = freshness, schema, clock
        self._stop, self._is_known, self._changed = stop, is_known, changed
        self._known: Normal | None = None
        """These normal errors were those of this body once; an update of W does not change that."""
        layout, self._is_active = schema().layout, config is not None
        self._names = [layout.element(index) for index in range(layout.size)]
        self._units = [signal.unit for signal in layout.signals for _ in range(signal.size)]
        place = self._place = {name: index for index, name in enumerate(self._names)}
        devices = {name: [place[e] for e in one.served if e in place] for name, one in robot.devices.items()}
        self._device = {index: name for name, indices in devices.items() for index in indices}
        self.needed = _needed(robot, place, stops)
        """Positions of the elements without which the robot must not move."""
        self._lock = threading.Lock()
        groups = [frozenset(indices) for indices in devices.values() if len(indices) > 1]
        self._monitor = TrustMonitor(schema(), config, groups, self._replaces)
        self._rows: list[np.ndarray] = []
        self._last: Numbers | None = None
        self._one_time = OneTime(freshness)
        self._returns = Returns(np.array([name.partition(".")[0] not in robot.seen for name in self._names]))
        self._block = -math.inf
        """This is the number of the last judged block, counted from the zero of the clock."""
        self._stopped_for: frozenset[int] = frozenset()
        self._lying: frozenset[str] = frozenset()
        self.findings: tuple[Finding, ...] = ()

    def tick(self) -> None:
        """Take the newest sample, and judge the samples of the last block."""
        now, schema = self._clock.monotonic(), self._schema()
        with self._lock:
            self._last = self._freshness.measured()[1]
            if self._is_active and self._returns.see(np.isfinite(in_order(schema, self._last).flat), now):
                self._publish()
            for row in self._one_time.rows(now):
                if self._one_time.is_late:
                    self._freshness.align(row)
                self._rows.append(schema.scaler.normalise(in_order(schema, row).flat))
            block = math.floor((now - JUDGED_AT) / BLOCK)
            if block == self._block:
                return
            is_late = block > self._block + 5
            rows, self._rows, self._block = self._rows, [], block
            if is_late or not rows or not self._is_active:
                return
            if self._is_known(schema):
                self._known = schema.normal
            self._monitor.use(schema)
            self._monitor.is_known = self._known is schema.normal
            self._monitor.add(np.array(rows), now)
            self._returns.judge(self._far(schema) if self._monitor.is_ready else None)
            self._publish()
        self._stop_if_needed()

    def _far(self, schema: BodySchema) -> np.ndarray:
        """Return whether each element is back far from its estimate, shape (size,); not if it cannot be estimated."""
        if not self._returns.back.any() or self._last is None:
            return self._returns.back
        values = in_order(schema, self._last).flat
        hidden = np.where(self._returns.back, np.nan, values)
        hidden.setflags(write=False)
        completion = fill(schema, hidden, schema.derived(recipes)(np.isfinite(hidden)))
        with np.errstate(invalid="ignore"):
            return np.asarray(np.abs(values - completion.value) > FAR * completion.std * self._factor())

    def trust(self, element: str) -> int:
        """Use an element again; it is not hidden again before it has agreed with the others once.

        Raises:
            BadArguments: The model has no such element.
        """
        index = self._index(element)
        with self._lock:
            self._monitor.trust(index)
            self._returns.waiting[index] = self._returns.back[index] = False
            self._publish()
        return index

    def distrust(self, element: str) -> int:
        """Hide an element until `trust`.

        Raises:
            BadArguments: The model has no such element.
        """
        index = self._index(element)
        with self._lock:
            self._monitor.distrust(index, self._clock.monotonic())
            self._publish()
        self._stop_if_needed()
        return index

    def refusal(self) -> str:
        """Return why the robot must not be engaged; empty if it may."""
        needed = sorted(self._monitor.hidden & self.needed)
        if not needed:
            return ""
        name = self._names[needed[0]]
        return f"{name} is {self._freshness.distrust.reasons.get(name, 'distrusted')}, and motion needs it."

    @property
    def doubts(self) -> bool:
        """Whether an element is suspected of a gross lie and still used."""
        return any(finding.is_gross and not finding.is_distrusted for finding in self.findings)

    def text(self) -> str:
        """Return one sentence on what is distrusted or suspected; empty without."""
        parts = [self._sentence(finding) for finding in self.findings]
        return " ".join(parts)

    def facts(self) -> dict[str, Any]:
        """Return the state for the status message."""
        return {
            "ready": self._is_active and self._monitor.is_ready,
            "findings": [
                {
                    "elements": [self._names[index] for index in finding.elements],
                    "cause": finding.cause,
                    "kind": finding.kind,
                    "state": "distrusted" if finding.is_distrusted else "suspect",
                    "by_hand": finding.by_hand,
                    "size": finding.size,
                    "text": self._sentence(finding),
                }
                for finding in self.findings
            ],
        }

    def _publish(self) -> None:
        """Hide what is distrusted; the object changes only with its content."""
        findings = self._monitor.findings
        for finding in findings:
            if finding.is_distrusted and not any(_is_same(finding, known) for known in self.findings):
                log.warning("%s", self._sentence(finding))
        self.findings = findings
        reasons = {
            self._names[index]: f"distrusted: {self._reason(finding, index)}"
            for finding in findings
            if finding.is_distrusted
            for index in finding.elements
        }
        if reasons.keys() != self._lying:
            self._lying = frozenset(reasons)
            since = min((finding.since for finding in findings if finding.is_distrusted), default=math.inf)
            self._changed(since - BEFORE)
        hidden = self._returns.waiting.copy()
        hidden[list(self._monitor.hidden)] = True
        reasons = {self._names[index]: WAITS for index in np.flatnonzero(self._returns.back)} | reasons
        before, hidden = self._freshness.distrust, self._in_robot_order(hidden)
        is_same = np.array_equal(hidden, before.hidden) and reasons.keys() == before.reasons.keys()
        if not is_same or any(_kind(a) != _kind(before.reasons[n]) for n, a in reasons.items()):
            self._freshness.distrust = Distrust(hidden, reasons)

    def _in_robot_order(self, hidden: np.ndarray) -> np.ndarray:
        """Return truth values of the model's layout in the order of the freshness."""
        spans = self._schema().layout.slices
        return np.concatenate([hidden[spans[name]] for name in self._freshness.elements.counts])

    def _stop_if_needed(self) -> None:
        needed = self._monitor.hidden & self.needed
        if needed - self._stopped_for:
            self._stop(self.refusal())
        self._stopped_for = needed

    def _replaces(self, elements: frozenset[int]) -> bool:
        """Whether the model can estimate a set of elements while all others are as they are now."""
        schema, last = self._schema(), self._last
        finite = np.ones(len(self._names), bool) if last is None else np.isfinite(in_order(schema, last).flat)
        finite[list(elements)] = False
        recipe = schema.derived(recipes)(finite)
        return bool(recipe.estimated[list(elements)].all())

    def _index(self, element: str) -> int:
        index = self._place.get(element)
        if index is None:
            raise BadArguments(f"The model has no element {shown(element)}. Known elements: {', '.join(self._names)}.")
        return index

    def _reason(self, finding: Finding, index: int) -> str:
        since = self._wall_time(finding.since)
        if finding.by_hand:
            return f"by an operator since {since}"
        words = f"{finding.kind} since {since}" if finding.kind != "unknown" else f"contradicted since {since}"
        others = [self._names[other] for other in finding.elements if other != index]
        if finding.cause == "either" and others:
            return f"it or {' or '.join(others)} is {words}"
        if part := self._changed_part(finding):
            return f"{words}, or {part} itself has changed"
        return words

    def _changed_part(self, finding: Finding) -> str:
        """Return the part of the body that may have changed, in place of its sensors; empty if none may.

        It has several elements, as tension and length of a muscle, and all of them are contradicted, or one has left
        its learned range: that of a wire that is cut, or slack.
        """
        part = _part_of(self._names[finding.elements[0]]) if finding.elements else ""
        if finding.cause == "part":
            return part
        return part if finding.cause == "element" and not finding.by_hand and self._outside(finding.elements[0]) else ""

    def _outside(self, lying: int) -> str:
        """Return an element of the same part of the body that has left its learned range; empty if none has."""
        schema, last = self._schema(), self._last
        if last is None:
            return ""
        x, (low, high) = schema.scaler.normalise(in_order(schema, last).flat), learned_range(schema)
        outside = (x < low) | (x > high)
        part = next((part for part in parts(schema, list(range(len(x)))) if lying in part), ())
        return next((self._names[other] for other in part if len(part) > 1 and outside[other]), "")

    def _sentence(self, finding: Finding) -> str:
        since, names = self._wall_time(finding.since), [self._names[index] for index in finding.elements]
        if finding.cause in CAUSES:
            known = f": '{finding.condition}' explains what is measured" if finding.condition else ""
            return f"Since {since}: {CAUSES[finding.cause]}{known}."
        joint = " or " if finding.cause == "either" else " and "
        state = "distrusted" if finding.is_distrusted else "suspected"
        text = f"{joint.join(names)} {'is' if len(names) == 1 else 'are'} {state}"
        if finding.by_hand:
            return f"{text} by an operator since {since}."
        kind = "" if finding.kind == "unknown" else f"{finding.kind} "
        text += f": {kind}since {since}"
        if finding.kind in SIZED and math.isfinite(finding.size):
            text += f", off by {finding.size:.3g} {self._units[finding.elements[0]]}"
        device, part, outside = self._device.get(finding.elements[0]), self._changed_part(finding), ""
        if part:
            outside = self._outside(finding.elements[0])
            text += f", or {part} itself has changed"
            text += f": {outside} is outside of what was learned" if outside else ""
        if outside in ("", names[0]) and finding.kind in CALIBRATED and device is not None and len(names) == 1:
            text += f"; `gemuco calibrate` measures {device} anew"
        return f"{text} (still used: {finding.reason})." if finding.reason else f"{text}."

    def _wall_time(self, since: float) -> str:
        """Return a monotonic time as the local time of day."""
        wall = 1e-9 * self._clock.now_ns() - (self._clock.monotonic() - since)
        return time.strftime("%H:%M:%S", time.localtime(wall))


class Returns:
    """Elements that were away while most others were measured, and are not used before they are judged.

    Args:
        watched: Whether each element is watched, shape (n,).

    Attributes:
        waiting: Whether each is away, or back and not judged yet, shape (n,).
        back: Whether it waits and is measured again, shape (n,).
    """

    def __init__(self, watched: np.ndarray) -> None:
        size = len(watched)
        self._watched, self._left = watched, np.full(size, math.inf)
        self.waiting, self.back = np.zeros(size, bool), np.zeros(size, bool)
        self._blocks = np.zeros(size, int)

    def see(self, measured: np.ndarray, now: float) -> bool:
        """Note at a time [s] which elements are measured, shape (n,); return whether `waiting` or `back` changed."""
        before, missing = (self.waiting, self.back), self._watched & ~measured
        if 2 * np.count_nonzero(missing) > np.count_nonzero(self._watched):  # all are late, or the HAL is away
            missing = missing & self.waiting
        self._left = np.where(missing, np.minimum(self._left, now), math.inf)
        self.waiting = before[0] | (now - self._left >= AWAY)
        self._blocks[missing] = 0
        self.back = self.waiting & measured
        return not (np.array_equal(before[0], self.waiting) and np.array_equal(before[1], self.back))

    def judge(self, far: np.ndarray | None) -> None:
        """Use those again that are back for `BACK` blocks and not far off, shape (n,); None: all, nothing is known."""
        self._blocks += self.back
        right = self.back if far is None else self.back & (self._blocks >= BACK) & ~far
        self.waiting, self.back = self.waiting & ~right, self.back & ~right


def _needed(robot: RobotConfig, place: dict[str, int], stops: Iterable[str] | None) -> frozenset[int]:
    """Return the elements that motion needs.

    Args:
        robot: The robot file.
        place: Element -> position.
        stops: Signals or elements; None for the commanded elements, and limited ones of the same name.
    """
    if stops is not None:
        named = set(stops)
        return frozenset(at for name, at in place.items() if {name, name.partition(".")[0]} & named)
    command = robot.command.signal
    moved = robot.signals[command].elements
    signals = {command, *robot.limits}
    names = [f"{signal}.{element}" for signal in signals for element in moved]
    return frozenset(place[name] for name in names if name in place)


def _is_same(one: Finding, other: Finding) -> bool:
    return one.elements == other.elements and one.is_distrusted == other.is_distrusted and one.kind == other.kind


def _part_of(element: str) -> str:
    return element.partition(".")[2]


def _kind(reason: str) -> str:
    return reason.partition(" since ")[0]
