"""`gemuco calibrate`: compare readings of a device with values known to the operator; fit and store a line."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import typer
from rich.console import Console
from rich.table import Table

from hal.calibration import store
from hal.calibration.line import CalibrationLine, CalibrationRefused, cell_line, joint_line
from hal.calibration.store import Point
from hal.config import RobotConfig
from hal.finding.measuring import Measurement, Subject, subject
from services import show
from services.errors import BadArguments
from services.process.lock import instead_of

GRAVITY = 9.80665
"""Standard gravity is this acceleration [m/s^2]."""
NOISE = {"rad": 0.005, "m": 0.001, "N": 0.5, "N m": 0.05, "Pa": 500.0}
"""An element at rest has at most this standard deviation [the key's unit], unless the operator gives another value."""
LEAST_MOVE = {"rad": 0.1, "m": 0.01}
"""Two positions must differ by at least this much [the key's unit] to show a direction."""


@dataclass(frozen=True, slots=True)
class CalibrationOptions:
    """Options of a calibration.

    Attributes:
        known: Known values [the element's unit]; empty: ask the operator.
        seconds: Averaging time at each point [s].
        noise: Largest standard deviation [the element's unit]; None for the default of its unit.
        yes: Measure the first point at once, and store without asking.
    """

    known: tuple[float, ...]
    seconds: float
    noise: float | None
    yes: bool


def calibrate_joint(config: RobotConfig, what: str, options: CalibrationOptions) -> int:
    """Measure the zero at one known position; zero and direction at two or more."""
    item = subject(config, what, "direction")
    noise = options.noise or NOISE.get(item.unit, 0.005)
    least = LEAST_MOVE.get(item.unit, 20 * noise)
    request = f"Move {item.element} to a known position"
    return _calibrate(item, options, noise, request, lambda points, now: joint_line(points, now.factor, least))


def calibrate_cell(config: RobotConfig, what: str, unit: str | None, options: CalibrationOptions) -> int:
    """Measure the zero with one known weight; zero and gain with two or more.

    Args:
        config: The robot file.
        what: A load cell, or an element that it measures.
        unit: Unit of the weights: `kg` or the element's own; None for kg if the element is a force.
        options: Options, with known weights in `unit`.
    """
    item = subject(config, what, "gain")
    unit = unit or ("kg" if item.unit == "N" else item.unit)
    if unit not in ("kg", item.unit) or (unit == "kg" and item.unit != "N"):
        units = "kg or N" if item.unit == "N" else item.unit
        raise BadArguments(f"Weights of {item.element} are given in {units}, not in '{unit}'.")
    factor = GRAVITY if unit == "kg" else 1.0
    noise = options.noise or NOISE.get(item.unit, 0.5)
    options = replace(options, known=tuple(factor * known for known in options.known))
    request = f"Load {item.element}"
    return _calibrate(item, options, noise, request, lambda points, now: cell_line(points, now.factor, noise))


def _calibrate(
    item: Subject,
    options: CalibrationOptions,
    noise: float,
    request: str,
    fit: Callable[[Sequence[Point], CalibrationLine], CalibrationLine],
) -> int:
    """Measure each point, fit the line, show and store it."""
    console = show.console()
    with instead_of(item.config.robot, "hal"), Measurement(item) as device:
        console.print(f"{item.device}: {device.identity or 'no identity'}. Its motors are off.")
        points = [device.measure(known, options.seconds, noise) for known in _known_values(item, options, request)]
        if not points:
            raise CalibrationRefused("No known value was given, so nothing was measured.")
        now = device.now
        line = fit(points, now)
        _show(console, item, points, now, line)
        if item.factor == "direction" and (warning := item.wrap(line)):
            console.print(f"[yellow]{warning}[/]")
        if not (options.yes or typer.confirm("Store it?")):
            console.print("Not stored.")
            return 1
        path = store.save(item.config, device.record(line, tuple(points)))
    console.print(f"Stored in {path}. The HAL reads it when it starts.")
    return 0


def _known_values(item: Subject, options: CalibrationOptions, request: str) -> Iterable[float]:
    """Yield the true value of each point [the element's unit] when the operator has set it."""
    for number, known in enumerate(options.known):
        if number or not options.yes:
            typer.prompt(f"{request}: {known:.6g} {item.unit}, then press Enter", default="", show_default=False)
        yield known
    while not options.known:
        answer = typer.prompt(f"{request}; its value [{item.unit}] (Enter: no more)", default="", show_default=False)
        if not answer:
            return
        try:
            yield float(answer)
        except ValueError:
            typer.echo(f"'{answer}' is not a number.")


def _show(
    console: Console, item: Subject, points: Sequence[Point], now: CalibrationLine, line: CalibrationLine
) -> None:
    unit = item.unit
    table = Table(title=f"{item.element} [{unit}]".replace("[", r"\["), box=None, title_justify="left")
    for column in ("known", "reads now", "std", "samples", "will read", "residual"):
        table.add_column(column, justify="right")
    for point in points:
        will = line.value(point.read)
        table.add_row(
            f"{point.known:.5g}", f"{now.value(point.read):.5g}", f"{point.std * abs(line.factor):.2g}",
            str(point.samples), f"{will:.5g}", f"{will - point.known:+.2g}",
        )  # fmt: skip
    console.print(table)
    console.print(
        f"zero {now.zero:.6g} -> {line.zero:.6g} {unit}, {item.factor} {now.factor:.6g} -> {line.factor:.6g}; "
        f"largest residual {line.residual:.3g} {unit}."
    )
