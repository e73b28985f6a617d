"""Questions about limits that are valid but unlikely, such as degrees that were written as radians."""

import math
from collections.abc import Iterable, Iterator

import numpy as np

from hal.config import LimitConfig, RobotConfig, per_element
from hal.device import Device

FARTHEST = {"rad": (4.0 * math.pi, "deg", "two turns"), "m": (20.0, "mm", "20 m")}
"""Unit -> value beyond which a position is unlikely, the unit it may have been written in, and the value in words."""
FASTEST = {"rad": (30.0, "deg"), "m": (20.0, "mm")}
"""Unit -> rate [unit/s] beyond which a position is unlikely to move, and the unit it may have been written in."""
TOLERANCE = 1.01
"""A rate may exceed that of its drive by this factor, because drives round."""


def position_questions(config: RobotConfig) -> Iterator[str]:
    """Yield a question for every signal whose limits are unlikely for its unit."""
    for name, limit in config.limits.items():
        signal = config.signals[name]
        if signal.unit not in FARTHEST:
            continue
        farthest, other, words = FARTHEST[signal.unit]
        fastest, _ = FASTEST[signal.unit]
        ends = np.abs(np.concatenate(config.bounds(name)))
        size = float(np.max(ends[np.isfinite(ends)], initial=0.0))
        advice = f"Are these {other}? Then add written_in: {other} beside them."
        if size > farthest:
            yield f"{name} may go to {size:g} {signal.unit}, which is more than {words}. {advice}"
        elif (rate := _largest(limit, signal.size)) > fastest:
            yield f"{name} may move at {rate:g} {signal.unit}/s. {advice}"


def drive_questions(config: RobotConfig, devices: Iterable[Device]) -> Iterator[tuple[str, str]]:
    """Yield the name of every drive that cannot move as fast as the robot file allows, and a question about it."""
    name = config.command.signal
    signal, limit = config.signals[name], config.limits.get(name)
    if limit is None or limit.rate is None:
        return
    rates = dict(zip(signal.elements, per_element(limit.rate, signal.size, f"limits.{name}.rate"), strict=True))
    for device in devices:
        if device.command_quantity != "position" or not device.commands:
            continue
        rate, fastest = rates[device.commands[0].partition(".")[2]], device.fastest
        if rate > TOLERANCE * fastest:
            yield (
                device.name,
                f"limits.{name} allows {rate:.4g} {signal.unit}/s, and the drive moves at most at {fastest:.4g} "
                f"{signal.unit}/s. Is the rate in {signal.unit}/s, and is the gear right?",
            )


def _largest(limit: LimitConfig, size: int) -> float:
    return float(np.max(per_element(limit.rate, size, "rate", 0.0)))
