"""Signals that no device measures: the HAL computes them from another signal of the same sample."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from hal import registry
from hal.config import RobotConfig
from hal.errors import ConfigError

LEAST_FORCE = 1.0
"""A center of pressure needs this total force [N]; below it the result would be noise."""


def center_of_pressure(forces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the center of pressure on the ground; below the center of gravity if the body is at rest.

    Args:
        forces: Upward force on each load cell [N], shape (n,).
        points: Positions of the cells [m], shape (n, 2).

    Returns:
        Mean of the points weighted by force [m], shape (2,); NaN if the total force is below `LEAST_FORCE`.
    """
    total = forces.sum()
    if not total > LEAST_FORCE:
        return np.full(points.shape[1], np.nan)
    return forces @ points / total


def function_of(config: RobotConfig, signal: str) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function that computes a signal [its unit], shape (n,), from the values of its input signal.

    Raises:
        ConfigError: The function does not exist, or its result does not fit the signal.
    """
    computed = config.signals[signal].computed
    if computed is None:
        raise ConfigError(f"Signal '{signal}' of '{config.robot}' is not computed.")
    settings: dict[str, Any] = {
        key: np.array(value, float) if isinstance(value, list) else value for key, value in computed.settings.items()
    }
    function: Callable[[np.ndarray], np.ndarray] = partial(registry.load_object(computed.by), **settings)
    where = f"signals.{signal}.computed of '{config.robot}'"
    size = config.signals[computed.inputs].size
    try:
        shape = np.shape(function(np.full(size, 10.0)))
    except (TypeError, ValueError, IndexError, AttributeError) as error:
        raise ConfigError(
            f"{where} cannot be computed by {computed.by} from {size} values of {computed.inputs} with the settings "
            f"{', '.join(settings) or '(none)'}: {error}."
        ) from None
    if shape != (config.signals[signal].size,):
        raise ConfigError(f"{where} has shape {shape}, but the signal has {config.signals[signal].size} elements.")
    return function
