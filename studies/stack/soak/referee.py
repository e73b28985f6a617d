"""Comparison of everything that the model calls measured with the truth of the simulator.

It uses none of the code that it judges: it reads the messages as plain msgpack. A value is wrong if it differs by more
than three promised std from every true value of the time in which it may have been measured.
"""

import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping
from typing import Any

import msgpack
import numpy as np
import zenoh

from services.wire import keys

LARGEST = 3.0
"""A value that is called measured may differ by this number of promised std."""
LATE = 2.0
"""It may do so for this time [s]."""
BRIDGED = 0.3
"""A value that is right for less than this time [s] does not end the time of a wrong one."""
BEFORE, AFTER = 0.15, 0.04
"""The true value may have been taken from the first time [s] before a sample's stamp to the second after it."""
GIVEN_UP = 1.0
"""An estimate is not judged if its sample and its truths do not arrive within this time [s]."""
KEPT = 400
"""Number of cycles whose stamps are kept, and of truths."""


Hear = Callable[[dict[str, Any]], None]


class Referee:
    """Judge of all estimates of one robot.

    Args:
        session: Session of a client.
        robot: The robot's name.
        promised: Signal -> promised std of each element [its unit].

    Attributes:
        fault: Name of the present fault, for the records.
        judged: Number of estimates that were compared.
        unjudged: Number without a known sample or truth, as while the simulator is dead.
        baseless: Number without a fresh sample in which a signal was called measured all the same.
        wrong: Records of values that were called measured and wrong for longer than `LATE`.
        longest: Fault -> longest time [s] in which a wrong value was called measured.
        pauses: Fault -> longest pause [s] between two estimates, restarts of the model included.
        estimated: Number of estimated elements, and of those within 1.645 published std of the truth.
        others: Messages of another type on the keys that it reads; at most `KEPT`.
    """

    def __init__(self, session: zenoh.Session, robot: str, promised: Mapping[str, np.ndarray]) -> None:
        self.fault = "none"
        self.judged = self.unjudged = self.baseless = 0
        self.wrong: list[dict[str, Any]] = []
        self.longest: dict[str, float] = {}
        self.pauses: dict[str, float] = {}
        self.estimated = [0, 0]
        self.others: deque[dict[str, Any]] = deque(maxlen=KEPT)
        self._promised, self._lock = promised, threading.Lock()
        self._stamps: OrderedDict[tuple[int, int], int] = OrderedDict()
        self._heard: dict[int, int] = {}
        self._truths: deque[tuple[int, dict[str, np.ndarray]]] = deque(maxlen=KEPT)
        self._waiting: deque[tuple[float, dict[str, Any], str]] = deque()
        self._streaks: dict[str, dict[str, Any]] = {}
        self._newest = 0.0
        listeners: list[tuple[str, str, Hear]] = [
            (keys.sample(robot), "sample", self._hear_sample),
            (keys.truth(robot), "sample", self._hear_truth),
            (keys.estimate(robot), "estimates", self._hear_estimate),
        ]
        self._subscribers = [
            session.declare_subscriber(key, unpacked(kind, act, self._hear_other)) for key, kind, act in listeners
        ]

    def close(self) -> None:
        """Stop listening."""
        for subscriber in self._subscribers:
            subscriber.undeclare()

    def summary(self) -> dict[str, Any]:
        """Return everything so far, as plain data; wrong values that go on are included."""
        with self._lock:
            going_on = [dict(streak) for streak in self._streaks.values() if _lasted(streak) > LATE]
            return {
                "judged": self.judged, "unjudged": self.unjudged, "baseless": self.baseless,
                "wrong": [*self.wrong, *going_on], "longest": dict(self.longest), "pauses": dict(self.pauses),
                "estimated": list(self.estimated), "others": list(self.others),
            }  # fmt: skip

    def _hear_other(self, message: dict[str, Any]) -> None:
        with self._lock:
            self.others.append(message | {"fault": self.fault})

    def _hear_sample(self, message: dict[str, Any]) -> None:
        with self._lock:
            place = message["boot"], message["cycle"]
            if place in self._stamps:  # played again
                return
            self._stamps[place] = message["stamp_ns"]
            if len(self._stamps) > KEPT:
                self._stamps.popitem(last=False)
            self._judge_known(time.monotonic())

    def _hear_truth(self, message: dict[str, Any]) -> None:
        with self._lock:
            if not self._truths or message["stamp_ns"] > self._truths[-1][0]:
                self._truths.append((message["stamp_ns"], _by_signal(message, "values", "<f8")))
            self._judge_known(time.monotonic())

    def _hear_estimate(self, message: dict[str, Any]) -> None:
        now, number = time.monotonic(), (message["boot"], message["seq"])
        with self._lock:
            if number[0] in self._heard and number[1] <= self._heard[number[0]]:  # played again
                return
            self._heard[number[0]] = number[1]
            if self._newest:
                self.pauses[self.fault] = max(self.pauses.get(self.fault, 0.0), now - self._newest)
            self._newest = now
            if message["cycle"] < 0:  # without a fresh sample nothing may be called measured
                self.baseless += set(message["method"].values()) & {"measured", "fused"} != set()
                return
            self._waiting.append((now, message, self.fault))
            self._judge_known(now)

    def _judge_known(self, now: float) -> None:
        """Judge all estimates whose sample and truths have arrived; give up those that wait for too long."""
        newest = self._truths[-1][0] if self._truths else 0
        while self._waiting:
            since, message, fault = self._waiting[0]
            stamp = next((s for (_, cycle), s in reversed(self._stamps.items()) if cycle == message["cycle"]), 0)
            if stamp and stamp + 1e9 * AFTER <= newest:
                self._judge(stamp, message, fault)
            elif now - since < GIVEN_UP:
                return
            else:
                self.unjudged += 1
            self._waiting.popleft()

    def _judge(self, stamp: int, message: dict[str, Any], fault: str) -> None:
        """Compare one estimate with the truths around the stamp [ns] of its sample."""
        around = [values for at, values in self._truths if -1e9 * BEFORE <= at - stamp <= 1e9 * AFTER]
        if len(around) < 2:
            self.unjudged += 1
            return
        self.judged += 1
        values, std = _by_signal(message, "values", "<f8"), _by_signal(message, "std", "<f8")
        estimated = _by_signal(message, "estimated", "?")
        for signal, promised in self._promised.items():
            true = np.array([one[signal] for one in around])  # (m, n)
            error = np.maximum(true.min(axis=0) - values[signal], values[signal] - true.max(axis=0))
            error = np.maximum(np.where(np.isfinite(error), error, 0.0), 0.0)
            ratio = error / np.maximum(promised, np.nan_to_num(std[signal]))
            wrong = ~estimated[signal] & ((ratio > LARGEST) | ~np.isfinite(values[signal]))
            known = estimated[signal] & np.isfinite(std[signal]) & (std[signal] > 0.0)
            self.estimated[0] += int(known.sum())
            self.estimated[1] += int((error[known] <= 1.645 * std[signal][known]).sum())
            for index in range(len(wrong)):
                self._note(f"{signal}.{index}", bool(wrong[index]), float(ratio[index]), stamp * 1e-9, fault)

    def _note(self, element: str, is_wrong: bool, ratio: float, at: float, fault: str) -> None:
        """Lengthen or end the time in which an element was called measured and wrong."""
        streak = self._streaks.get(element)
        if is_wrong and streak is None:
            streak = {"element": element, "since": at, "until": at, "worst": ratio, "fault": fault}
            self._streaks[element] = streak
        elif is_wrong and streak is not None:
            streak["until"], streak["worst"] = at, max(ratio, streak["worst"])
        elif streak is not None and at - streak["until"] > BRIDGED:
            del self._streaks[element]
            if _lasted(streak) > LATE:
                self.wrong.append(streak)
        if streak is not None:
            name = streak["fault"]
            self.longest[name] = max(self.longest.get(name, 0.0), _lasted(streak))


def unpacked(kind: str, act: Hear, other: Hear) -> Callable[[zenoh.Sample], None]:
    """Return a listener that reads messages as plain msgpack, and gives those of another type to `other`."""

    def hear(sample: zenoh.Sample) -> None:
        try:
            message = msgpack.unpackb(sample.payload.to_bytes())
        except ValueError:
            message = "unreadable"
        if isinstance(message, dict) and message.get("type") == kind:
            act(message)
        else:
            other({"key": str(sample.key_expr), "message": repr(message)[:300]})

    return hear


def _lasted(streak: Mapping[str, Any]) -> float:
    return float(streak["until"] - streak["since"])


def _by_signal(message: Mapping[str, Any], field: str, dtype: str) -> dict[str, np.ndarray]:
    """Return signal -> one of its fields, shape (n,)."""
    flat, start, parts = np.frombuffer(message[field], dtype), 0, {}
    for signal, count in message["elements"].items():
        parts[signal] = flat[start : start + count]
        start += count
    return parts
