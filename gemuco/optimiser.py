"""How a gradient moves numbers: Adam, or descent with momentum."""

from collections.abc import Sequence

import numpy as np

OPTIMISERS = ("adam", "sgd")
MOMENTUM = 0.9
SQUARES = 0.999
"""How slowly Adam forgets the size of a gradient."""


class Optimiser:
    """Moves arrays against their gradients, in place.

    Args:
        kind: `adam` or `sgd` (with momentum 0.9).
        rate: Learning rate.
        arrays: The arrays it will move; only their shapes are looked at.
    """

    def __init__(self, kind: str, rate: float, arrays: Sequence[np.ndarray]) -> None:
        self.kind, self.rate = kind, rate
        self._slow = [np.zeros_like(array) for array in arrays]
        self._square = [np.zeros_like(array) for array in arrays]
        self._time = 0

    def move(self, arrays: Sequence[np.ndarray], gradients: Sequence[np.ndarray]) -> None:
        """One step."""
        self._time += 1
        if self.kind == "sgd":
            for array, slow, gradient in zip(arrays, self._slow, gradients, strict=True):
                slow *= MOMENTUM
                slow += gradient
                array -= (self.rate * slow).astype(array.dtype)
            return
        gain = self.rate * np.sqrt(1.0 - SQUARES**self._time) / (1.0 - MOMENTUM**self._time)
        for array, slow, square, gradient in zip(arrays, self._slow, self._square, gradients, strict=True):
            slow += (1.0 - MOMENTUM) * (gradient - slow)
            square += (1.0 - SQUARES) * (gradient * gradient - square)
            array -= (gain * slow / (np.sqrt(square) + 1e-8)).astype(array.dtype)
