"""What a limit is: it takes a wanted set-point and returns one that it can answer for."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

Arrays = Mapping[str, np.ndarray]


@dataclass(slots=True)
class Turn:
    """What is known when the set-point of a cycle is decided.

    Attributes:
        before: Set-point of the cycle before [unit of the commanded signal], shape (n,).
        speed: How fast it changed then [unit/s], shape (n,).
        measured: Signal -> newest valid values [its unit], shapes (m,); NaN where there is none.
        is_commanded: Whether the set-point comes from outside; one that is merely held is not pulled into range.
    """

    before: np.ndarray
    speed: np.ndarray
    measured: Arrays
    is_commanded: bool = True


class Limit(Protocol):
    """One limit of a command. Limits are asked one after the other; the last has the last word."""

    name: str
    """As told in `Applied.limited_by`."""
    needs: str
    """What must be measured for it, in a word; empty if nothing."""

    def limit(self, wanted: np.ndarray, turn: Turn) -> np.ndarray:
        """The set-point that may be applied [unit of the commanded signal], shape (n,).

        Returns:
            `wanted` itself if it may be applied as it is, else a new array.
        """
        ...

    def blind(self, measured: Arrays) -> list[str]:
        """Elements for which a missing measurement keeps this limit from acting as it should."""
        ...


def changed(limited: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """`wanted` itself if both are the same, so that whoever asks sees at once that nothing was changed."""
    return wanted if (limited == wanted).all() else limited
