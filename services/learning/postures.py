"""Taught postures: a CSV file of commands, one per line; the robot moves to each smoothly and holds it."""

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hal.config import RobotConfig
from services.errors import ServiceError
from services.learning.motion import Motion, Move, minimum_jerk, speed_of, step_of
from services.model.model_config import CollectConfig

HOLD = "hold"


class BadPostures(ServiceError):
    """A file of taught postures cannot be played; the robot did not move."""


@dataclass(frozen=True, slots=True)
class Posture:
    """Command [unit of the commanded signal], shape (k,), and the time to hold it [s]."""

    command: np.ndarray
    hold: float


def load_postures(path: Path, robot: RobotConfig, hold: float) -> list[Posture]:
    """Read a CSV file: a header with the elements of the commanded signal perhaps `hold` [s], and a line per posture.

    Args:
        path: The file.
        robot: Robot file with the limits of all postures.
        hold: Time to hold a posture [s] if the file has none.

    Raises:
        BadPostures: The file has another format, or a posture is outside of the limits; the text names the line.
    """
    try:
        with path.open(newline="") as file:
            lines = [(number, cells) for number, cells in enumerate(csv.reader(file), 1) if any(cells)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise BadPostures(f"The postures '{path}' cannot be read: {error}.") from None
    elements = robot.signals[robot.command.signal].elements
    header = [name.strip() for name in lines[0][1]] if lines else []
    if sorted(set(header) - {HOLD}) != sorted(elements) or len(set(header)) < len(header):
        raise BadPostures(
            f"The first line of '{path}' must name {', '.join(elements)}, each once, and may name {HOLD}; "
            f"it names {', '.join(header) or 'nothing'}."
        )
    if len(lines) < 2:
        raise BadPostures(f"'{path}' holds no posture, only a header.")
    return [_posture(f"'{path}', line {number}", header, cells, robot, hold) for number, cells in lines[1:]]


def _posture(where: str, header: list[str], cells: list[str], robot: RobotConfig, hold: float) -> Posture:
    if len(cells) != len(header):
        raise BadPostures(f"{where}: {len(cells)} values under {len(header)} names.")
    values: dict[str, float] = {}
    for name, cell in zip(header, cells, strict=True):
        try:
            values[name] = float(cell)
        except ValueError:
            raise BadPostures(f"{where}: {name} is '{cell}', which is not a number.") from None
    duration = values.pop(HOLD, hold)
    if not 0.0 <= duration < np.inf:
        raise BadPostures(f"{where}: {HOLD} is {duration:g}; it must be a time in seconds.")
    signal = robot.command.signal
    names = robot.signals[signal].elements
    command = np.array([values[name] for name in names])
    low, high = robot.bounds(signal)
    for index in np.flatnonzero(~((command >= low) & (command <= high))):
        raise BadPostures(
            f"{where}: {names[index]} of {command[index]:g} {robot.signals[signal].unit} is outside of its limits, "
            f"{low[index]:g} to {high[index]:g}. The robot did not move."
        )
    return Posture(command, duration)


def taught(robot: RobotConfig, config: CollectConfig, postures: list[Posture]) -> Motion:
    """Return a motion through every posture once, in the order of the file."""
    speed, step = speed_of(robot, config), step_of(robot)

    def moves(start: np.ndarray) -> Iterator[Move]:
        for posture in postures:
            yield from ((point, step) for point in minimum_jerk(start, posture.command, speed, step))
            if posture.hold:
                yield posture.command, posture.hold
            start = posture.command

    return moves
