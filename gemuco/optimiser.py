"""Gradient descent: Adam, or descent with momentum."""

import numpy as np

from gemuco.compiled.learning import adam, momentum

OPTIMISERS = ("adam", "sgd")


class Optimiser:
    """Gradient descent of an array, in place.

    Args:
        kind: `adam` or `sgd` (with momentum 0.9).
        rate: Learning rate.
        size: Length of the array.

    Attributes:
        time: Number of steps.
    """

    def __init__(self, kind: str, rate: float, size: int) -> None:
        self.kind, self.rate = kind, rate
        self._slow, self._square = np.zeros((2, size), np.float32)
        self.time = 0

    def move(self, numbers: np.ndarray, gradient: np.ndarray) -> None:
        """Take one step; both arrays have shape (size,), float32."""
        self.time += 1
        if self.kind == "sgd":
            momentum(numbers, gradient, self._slow, float(self.rate))
        else:
            adam(numbers, gradient, self._slow, self._square, float(self.rate), self.time)

    def state(self) -> dict[str, np.ndarray]:
        """Return the internal arrays; a resumed training writes its stored values into them."""
        return {"slow": self._slow, "square": self._square}
