"""The ends of the way for commands that are no positions: a velocity brakes in time, an effort fades out."""

from dataclasses import dataclass

import numpy as np

from hal.safety.limit import Arrays, Turn, changed

RESPONSE = 0.02
"""How long [s] a drive may lag behind its command."""
CALM = 2.0
"""How many times longer the last of the way takes than what is measured is old: with 1 the drive would swing about the
end, as any loop does whose dead time is as long as its time constant."""
FADE_BAND = 0.1
"""Part of the range, at each end of it, within which an effort towards the end fades out."""


@dataclass(frozen=True, slots=True)
class Way:
    """A signal that says where, or how fast, the commanded elements are.

    Attributes:
        signal: Its name.
        elements: Names of its elements that belong to the commanded ones, k of them.
        commanded: Their places in the commanded signal, shape (k,).
        measured: Their places in this signal, shape (k,).
        low: Lowest value allowed [unit of this signal], shape (k,); -inf where there is none.
        high: Highest value allowed, shape (k,).
    """

    signal: str
    elements: tuple[str, ...]
    commanded: np.ndarray
    measured: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def read(self, measured: Arrays) -> np.ndarray:
        """What is measured now [unit of this signal], shape (k,)."""
        return measured[self.signal][self.measured]

    def unknown(self, measured: Arrays) -> list[str]:
        """Names of the elements that are not measured now."""
        return [name for name, value in zip(self.elements, self.read(measured).tolist(), strict=True) if value != value]


class EndsOfVelocity:
    """A velocity command is braked so that the position comes to rest inside of its range.

    A velocity v that is seen `ahead` too late and is braked then goes on for `v * ahead + v^2 / (2 deceleration)`.
    Solved for v, that is never braked harder than `deceleration`. Beyond an end only the way back is open. Where the
    position is not known the command is 0: nobody can tell how far it would go.
    """

    name = "range"
    needs = "position"

    def __init__(self, position: Way, deceleration: np.ndarray | None, ahead: float) -> None:
        """Prepare.

        Args:
            position: Of the commanded elements.
            deceleration: How fast the command may brake [unit of the command/s], shape (k,); at once if None.
            ahead: How old [s] a position may be by the time at which the drive has followed a command.
        """
        self._position, self._deceleration = position, deceleration
        self._ahead = CALM * ahead

    def limit(self, wanted: np.ndarray, turn: Turn) -> np.ndarray:
        """See `Limit.limit`."""
        way = self._position
        position = way.read(turn.measured)
        up, down = self._fastest(way.high - position), self._fastest(position - way.low)
        mine = wanted[way.commanded]
        bounded = np.where(np.isfinite(position), np.minimum(np.maximum(mine, -down), up), 0.0)
        if (bounded == mine).all():
            return wanted
        limited = wanted.copy()
        limited[way.commanded] = bounded
        return limited

    def _fastest(self, left: np.ndarray) -> np.ndarray:
        left = np.maximum(left, 0.0)
        if self._deceleration is None:
            return left / self._ahead
        return self._deceleration * (np.sqrt(self._ahead**2 + 2.0 / self._deceleration * left) - self._ahead)

    def blind(self, measured: Arrays) -> list[str]:
        """See `Limit.blind`."""
        return self._position.unknown(measured)


class EndsOfEffort:
    """An effort command fades out towards the end of the way, and towards the highest velocity; see `Trips` for beyond.

    Towards the other side it acts in full. Where position or velocity is not known the command is 0.
    """

    def __init__(self, name: str, way: Way) -> None:
        """`name` is told in `Applied.limited_by`; `way` are positions or velocities, and their bounds."""
        self.name = name
        self.needs = "position" if name == "range" else name
        self._way = way
        span = way.high - way.low
        scale = np.where(np.isfinite(span), span, np.maximum(np.abs(way.low), np.abs(way.high)))
        self._band = FADE_BAND * np.where(np.isfinite(scale), scale, 1.0)

    def limit(self, wanted: np.ndarray, turn: Turn) -> np.ndarray:
        """See `Limit.limit`."""
        way = self._way
        value = way.read(turn.measured)
        mine = wanted[way.commanded]
        left = np.where(mine > 0, way.high - value, value - way.low)
        share = np.minimum(np.maximum(left / self._band, 0.0), 1.0)
        limited = wanted.copy()
        limited[way.commanded] = np.where(np.isfinite(value), mine * share, 0.0)
        return changed(limited, wanted)

    def blind(self, measured: Arrays) -> list[str]:
        """See `Limit.blind`."""
        return self._way.unknown(measured)
