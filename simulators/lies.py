"""Sensors that lie: their electronics work, and what they measure is wrong."""

import math
import random
from collections import deque
from collections.abc import Callable

Lie = Callable[[float, float], float]
"""A lie is called with the true value [unit] and the time [s], and returns the measured value."""
TURN = 2.0 * math.pi


class UnknownLie(ValueError):
    """The lie does not exist, or its number is missing or wrong; the message lists the known ones."""


def frozen(value: float, time: float, amount: float) -> Lie:
    """Return a sensor that keeps its present value."""
    return lambda true, now: value


def offset(value: float, time: float, amount: float) -> Lie:
    """Return a sensor that reads `amount` too much."""
    return lambda true, now: true + amount


def drift(value: float, time: float, amount: float) -> Lie:
    """Return a sensor whose error grows by `amount` per second."""
    return lambda true, now: true + amount * (now - time)


def gain(value: float, time: float, amount: float) -> Lie:
    """Return a sensor that reads `amount` times the true value."""
    return lambda true, now: amount * true


def flipped(value: float, time: float, amount: float) -> Lie:
    """Return a sensor with the wrong sign."""
    return lambda true, now: -true


def wrapped(value: float, time: float, amount: float) -> Lie:
    """Return an encoder that reads one turn too much."""
    return lambda true, now: true + TURN


def clipped(value: float, time: float, amount: float) -> Lie:
    """Return a sensor that reads at most `amount`."""
    return lambda true, now: min(true, amount)


def noisy(value: float, time: float, amount: float) -> Lie:
    """Return a sensor with noise of this standard deviation."""
    draw = random.Random(round(1e6 * time))
    return lambda true, now: true + amount * draw.gauss(0.0, 1.0)


def stuck(value: float, time: float, amount: float) -> Lie:
    """Return a sensor that keeps its present value, with noise of this standard deviation, so that its bits change."""
    draw = random.Random(round(1e6 * time))
    return lambda true, now: value + amount * draw.gauss(0.0, 1.0)


def delayed(value: float, time: float, amount: float) -> Lie:
    """Return a sensor that reads the value of `amount` seconds ago."""
    past = deque([(time, value)])

    def read(true: float, now: float) -> float:
        if now > past[-1][0]:
            past.append((now, true))
        while len(past) > 1 and past[1][0] <= now - amount:
            past.popleft()
        return past[0][1]

    return read


LIES: dict[str, tuple[Callable[[float, float, float], Lie], str, str]] = {
    "sensor_frozen": (frozen, "", "keeps its present value"),
    "sensor_offset": (offset, "AMOUNT", "reads {amount:g} too much"),
    "sensor_drift": (drift, "AMOUNT", "drifts by {amount:g} per second"),
    "sensor_gain": (gain, "FACTOR", "reads {amount:g} times the true value"),
    "sensor_flipped": (flipped, "", "has the wrong sign"),
    "sensor_wrapped": (wrapped, "", "reads one turn too much"),
    "sensor_clipped": (clipped, "LIMIT", "reads at most {amount:g}"),
    "sensor_noisy": (noisy, "STD", "has noise of {amount:g}"),
    "sensor_stuck": (stuck, "STD", "keeps its present value with noise of {amount:g}"),
    "sensor_delayed": (delayed, "SECONDS", "reads the value of {amount:g} s ago"),
}
"""Fault -> lie, the word for its number if it has one, and a sentence on it."""
SWAPPED, TRUE = "sensors_swapped", "sensor_true"
"""These faults swap the values of two nodes, and end a node's lie."""


def known_lies() -> list[str]:
    """Return the form of every lie."""
    forms = [" ".join(filter(None, (name, "NODE", number))) for name, (_, number, _) in LIES.items()]
    return [*forms, f"{SWAPPED} NODE NODE", f"{TRUE} NODE"]


def lie_of(name: str, words: list[str], value: float, time: float) -> tuple[Lie, str]:
    """Return a lie and a sentence on it.

    Args:
        name: Fault, such as `sensor_offset`.
        words: What follows the node: the number, if the fault has one.
        value: Present value [unit].
        time: Present time [s].

    Raises:
        UnknownLie: The number is missing, too much or not a number.
    """
    make, number, sentence = LIES[name]
    try:
        amount = float(words[0]) if number else 0.0
        if len(words) != bool(number) or not math.isfinite(amount):
            raise ValueError(words)
    except (ValueError, IndexError):
        needs = f"the name of a node and {number}" if number else "the name of one node"
        raise UnknownLie(f"'{name}' takes {needs}, and not '{' '.join(words)}' after the node.") from None
    return make(value, time, amount), sentence.format(amount=amount)
