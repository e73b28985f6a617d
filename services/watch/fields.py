"""Fields of an element for viewers: numbers that are known now, and words."""

import math
from collections.abc import Mapping
from typing import Any

from services.watch.signal_rows import Kind, SignalRow
from services.watch.snapshot import RobotSnapshot

INTERVAL = 1.645
"""An estimate is within this number of std in 90 % of the cases."""


def element(row: SignalRow) -> dict[str, Any]:
    """Return the fields of an element; a value that is neither measured nor estimated now is absent."""
    is_estimated = row.kind is Kind.ESTIMATED
    value = row.value if row.kind in (Kind.MEASURED, Kind.ESTIMATED) else math.nan
    reach = INTERVAL * row.std
    numbers = {
        "value": value,
        "measured": value if row.kind is Kind.MEASURED else math.nan,
        "estimated": value if is_estimated else math.nan,
        "low": value - reach if is_estimated else math.nan,
        "high": value + reach if is_estimated else math.nan,
        "std": row.std if is_estimated else math.nan,
        "age": row.age,
    }
    return {**known(numbers), "kind": row.kind.value, "state": row.state, "reason": row.distrust or row.reason}


def known(numbers: Mapping[str, float]) -> dict[str, float]:
    """Return the numbers that are finite."""
    return {name: number for name, number in numbers.items() if math.isfinite(number)}


def tension_limits(snapshot: RobotSnapshot) -> dict[str, float]:
    """Return signal -> its `soft_high` in the HAL's description."""
    limits = snapshot.hal.get("limits")
    return {
        str(signal): float(about["soft_high"])
        for signal, about in (limits.items() if isinstance(limits, Mapping) else ())
        if isinstance(about, Mapping) and isinstance(about.get("soft_high"), int | float) and about["soft_high"] > 0
    }
