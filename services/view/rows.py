"""Every element of every signal as one row: measured, estimated, masked, or old."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from services.view.seen import Heard, Seen
from services.wire.messages import Estimates, Sample


class Kind(StrEnum):
    """How a value came about."""

    MEASURED = "measured"
    ESTIMATED = "estimated"
    MASKED = "masked"
    """Not measured now, hidden from the model, and not estimated either."""
    OLD = "old"
    """Nobody tells any more; the last that was measured."""


@dataclass(frozen=True, slots=True)
class Row:
    """One element of a signal.

    Attributes:
        value: In the signal's unit; NaN if there is none.
        std: Expected error (1 sigma) of an estimate [unit]; NaN if there is none.
        age: Since it was last measured [s]; infinite if it never was, NaN where nobody tells.
        source: The signals that an estimate was made from; empty else.
        method: `mask`, `latent` or `input`; empty where nothing was estimated.
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

    @property
    def name(self) -> str:
        """`signal.element`."""
        return f"{self.signal}.{self.element}"


def rows(seen: Seen) -> tuple[Row, ...]:
    """The rows in the order of the robot file, as far as it was told."""
    estimate = seen.fresh(seen.estimate)
    found: list[Row] = []
    for signal, about in _signals(seen).items():
        heard = _measured_by(seen, signal, about)
        found += _of_signal(signal, about, heard, estimate)
    return tuple(found)


def _signals(seen: Seen) -> dict[str, dict[str, Any]]:
    """Signal -> unit, elements and source; what no `describe` told yet has numbers for names."""
    found: dict[str, dict[str, Any]] = {}
    for told in (seen.hal, seen.model):
        for name, about in told.get("signals", {}).items():
            found.setdefault(name, dict(about))
    for heard in (seen.sample, seen.vision, seen.estimate):
        for name, values in (heard.message.values if heard is not None else {}).items():
            found.setdefault(name, {"unit": "", "elements": [str(i) for i in range(len(values))]})
    return found


def _measured_by(seen: Seen, signal: str, about: dict[str, Any]) -> Heard[Sample] | None:
    """The newest sample that should hold the signal, however old."""
    sources = (seen.vision,) if about.get("source") == "vision" else (seen.sample, seen.vision)
    return next((heard for heard in sources if heard is not None and signal in heard.message.values), None)


def _of_signal(
    signal: str, about: dict[str, Any], heard: Heard[Sample] | None, estimate: Estimates | None
) -> Iterator[Row]:
    elements, unit = about["elements"], about["unit"]
    count = len(elements)
    values = valid = ages = None
    if heard is not None and len(heard.message.values[signal]) == count:
        values, valid = heard.message.values[signal], heard.message.valid[signal]
        ages = heard.message.age[signal] + heard.age
    inferred = estimate if estimate is not None and len(estimate.values.get(signal, ())) == count else None
    for index, element in enumerate(elements):
        age = math.nan if ages is None else float(ages[index])
        is_fresh = heard is not None and heard.is_fresh and valid is not None and bool(valid[index])
        # The model adds its own limits of age to what a camera saw: it knows the robot file.
        hidden = inferred is not None and bool(inferred.estimated[signal][index]) and about.get("source") == "vision"
        if is_fresh and not hidden and values is not None:
            yield Row(signal, element, unit, Kind.MEASURED, float(values[index]), age=age)
        elif inferred is not None and np.isfinite(inferred.values[signal][index]):
            yield Row(
                signal, element, unit, Kind.ESTIMATED, float(inferred.values[signal][index]),
                float(inferred.std[signal][index]), age, inferred.mask[signal].replace("+", ", "),
                inferred.method[signal],
            )  # fmt: skip
        elif (heard is not None and (heard.is_fresh or about.get("source") == "vision")) or values is None:
            yield Row(signal, element, unit, Kind.MASKED, math.nan, age=age)
        else:
            last = float(values[index])
            yield Row(signal, element, unit, Kind.OLD if np.isfinite(last) else Kind.MASKED, last, age=age)
