"""One row per element of every signal: measured, estimated, masked or old."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from services.watch.snapshot import Newest, RobotSnapshot, fresh
from services.wire.messages import Estimates, Sample


class Kind(StrEnum):
    """Origin of a value."""

    MEASURED = "measured"
    ESTIMATED = "estimated"
    MASKED = "masked"
    """The element is not measured at present, hidden from the model, and not estimated either."""
    OLD = "old"
    """The element is no longer published; the value is the last that was measured."""


@dataclass(frozen=True, slots=True)
class SignalRow:
    """One element of a signal.

    Attributes:
        value: Value in the signal's unit; NaN if there is none.
        std: Expected error (1 sigma) of an estimate [unit]; NaN if there is none.
        age: Time since it was last measured [s]; infinite if it never was, NaN if unknown.
        source: Signals from which an estimate was made; empty otherwise.
        method: `mask`, `latent` or `input`; empty if nothing was estimated.
        state: `known`, `doubtful` or `unknown`: whether an estimate is inside of what was learned; empty if not said.
        reason: One sentence on the state.
        distrust: Why it is estimated although it is measured, such as `distrusted: frozen since 12:03:11`; else empty.
    """

    signal: str
    element: str
    unit: str
    kind: Kind
    value: float
    std: float = math.nan
    age: float = math.nan
    source: str = ""
    method: str = ""
    state: str = ""
    reason: str = ""
    distrust: str = ""

    @property
    def name(self) -> str:
        """Name `signal.element`."""
        return f"{self.signal}.{self.element}"


def signal_rows(snapshot: RobotSnapshot) -> tuple[SignalRow, ...]:
    """Return the rows in the order of `describe`; signals that it does not list come last."""
    estimate = fresh(snapshot.estimate)
    rows: list[SignalRow] = []
    for signal, about in _signals(snapshot).items():
        rows += _rows_of(signal, about, _newest_with(snapshot, signal, about), estimate)
    return tuple(rows)


def _signals(snapshot: RobotSnapshot) -> dict[str, dict[str, Any]]:
    """Return signal -> unit, elements and source; before `describe` answered, elements are named by numbers."""
    signals: dict[str, dict[str, Any]] = {}
    for description in (snapshot.hal, snapshot.model):
        for name, about in description.get("signals", {}).items():
            signals.setdefault(name, dict(about))
    for source, newest in (("hal", snapshot.sample), ("vision", snapshot.vision), ("", snapshot.estimate)):
        for name, values in (newest.message.values if newest is not None else {}).items():
            elements = [str(index) for index in range(len(values))]
            signals.setdefault(name, {"unit": "", "elements": elements, "source": source})
    return signals


def _newest_with(snapshot: RobotSnapshot, signal: str, about: dict[str, Any]) -> Newest[Sample] | None:
    """Return the newest sample with this signal, whatever its age."""
    sources = (snapshot.vision,) if about.get("source") == "vision" else (snapshot.sample, snapshot.vision)
    return next((newest for newest in sources if newest is not None and signal in newest.message.values), None)


def _rows_of(
    signal: str, about: dict[str, Any], newest: Newest[Sample] | None, estimate: Estimates | None
) -> Iterator[SignalRow]:
    elements, unit = about["elements"], about["unit"]
    is_seen = about.get("source") == "vision"
    values = valid = ages = None
    if newest is not None and len(newest.message.values[signal]) == len(elements):
        values, valid = newest.message.values[signal], newest.message.valid[signal]
        ages = newest.message.age[signal] + newest.age
    estimated = estimate if estimate is not None and len(estimate.values.get(signal, ())) == len(elements) else None
    for index, element in enumerate(elements):
        age = math.nan if ages is None else float(ages[index])
        is_estimated = estimated is not None and bool(estimated.estimated[signal][index])
        # The model knows the robot file and applies its own age limits to what a camera measured.
        is_used = is_seen and estimated is not None and not is_estimated
        is_fresh = newest is not None and (newest.is_fresh or is_used) and valid is not None and bool(valid[index])
        distrust = "" if estimate is None else estimate.distrusted.get(f"{signal}.{element}", "")
        is_hidden = (is_estimated and is_seen) or bool(distrust)
        if is_fresh and not is_hidden and values is not None:
            yield SignalRow(signal, element, unit, Kind.MEASURED, float(values[index]), age=age)
        elif estimated is not None and is_estimated and np.isfinite(estimated.values[signal][index]):
            yield SignalRow(
                signal, element, unit, Kind.ESTIMATED, float(estimated.values[signal][index]),
                float(estimated.std[signal][index]), age, estimated.mask[signal].replace("+", ", "),
                estimated.method[signal], estimated.state.get(signal, ""), estimated.reason.get(signal, ""), distrust,
            )  # fmt: skip
        elif (newest is not None and (newest.is_fresh or is_seen)) or values is None:
            yield SignalRow(signal, element, unit, Kind.MASKED, math.nan, age=age, distrust=distrust)
        else:
            last = float(values[index])
            yield SignalRow(signal, element, unit, Kind.OLD if np.isfinite(last) else Kind.MASKED, last, age=age)
