"""`gemuco calibrate`: a person tells what is true, the device tells what it reads, the line between them is kept."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import typer
from rich.console import Console
from rich.table import Table

from hal.calibration import store
from hal.calibration.line import CalibrationRefused, Line, cell_line, joint_line
from hal.calibration.store import Point
from hal.config import RobotConfig
from hal.finding.measuring import Measuring, Subject, subject
from services import show
from services.errors import BadArguments
from services.process.lock import instead_of

GRAVITY = 9.80665
"""Standard gravity [m/s^2]: newtons per kilogram."""
NOISE = {"rad": 0.005, "m": 0.001, "N": 0.5, "N m": 0.05, "Pa": 500.0}
"""What a thing that stands still may seem to move [the unit], unless told otherwise."""
LEAST_MOVE = {"rad": 0.1, "m": 0.01}
"""By how much two positions must differ [the unit] to tell a direction."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """How to measure.

    Attributes:
        known: What a person will tell [the element's unit]; empty: ask.
        seconds: How long to average at each point [s].
        noise: Largest standard deviation [the element's unit]; None for the default of its unit.
        yes: Measure the first point at once, and store without asking.
    """

    known: tuple[float, ...]
    seconds: float
    noise: float | None
    yes: bool


def calibrate_joint(config: RobotConfig, what: str, wanted: Wanted) -> int:
    """Zero from one known position, zero and direction from two or more."""
    found = subject(config, what, "direction")
    noise = wanted.noise or NOISE.get(found.unit, 0.005)
    least = LEAST_MOVE.get(found.unit, 20 * noise)
    ask = f"Put {found.element} where you know it"
    return _calibrate(found, wanted, noise, ask, lambda points, now: joint_line(points, now.factor, least))


def calibrate_cell(config: RobotConfig, what: str, unit: str | None, wanted: Wanted) -> int:
    """Zero with one known weight, zero and gain from two or more.

    Args:
        config: The robot file.
        what: A load cell, or an element that it measures.
        unit: In which the weights were told: `kg`, or the element's own; None for kg if it is a force.
        wanted: How to measure; weights in `unit`.
    """
    found = subject(config, what, "gain")
    unit = unit or ("kg" if found.unit == "N" else found.unit)
    if unit not in ("kg", found.unit) or (unit == "kg" and found.unit != "N"):
        raise BadArguments(f"Weights of {found.element} are told in {'kg or N' if found.unit == 'N' else found.unit}.")
    factor = GRAVITY if unit == "kg" else 1.0
    noise = wanted.noise or NOISE.get(found.unit, 0.5)
    told = Wanted(tuple(factor * known for known in wanted.known), wanted.seconds, wanted.noise, wanted.yes)
    ask = f"Load {found.element}"
    return _calibrate(found, told, noise, ask, lambda points, now: cell_line(points, now.factor, noise))


def _calibrate(
    found: Subject, wanted: Wanted, noise: float, ask: str, fit: Callable[[Sequence[Point], Line], Line]
) -> int:
    """Measure at each point, fit, show, store."""
    console = show.console()
    with instead_of(found.config.robot, "hal"), Measuring(found) as device:
        console.print(f"{found.device}: {device.identity or 'it does not tell who it is'}. Its motors are off.")
        points = [device.look(known, wanted.seconds, noise) for known in _known(found, wanted, ask)]
        if not points:
            raise CalibrationRefused("Nothing was told, so nothing is measured.")
        now = device.now
        line = fit(points, now)
        _show(console, found, points, now, line)
        if found.factor == "direction" and (told := found.wrap(line)):
            console.print(f"[yellow]{told}[/]")
        if not (wanted.yes or typer.confirm("Store it?")):
            console.print("Not stored.")
            return 1
        path = store.save(found.config, device.record(line, tuple(points)))
    console.print(f"Stored in {path}; the HAL takes it when it starts.")
    return 0


def _known(found: Subject, wanted: Wanted, ask: str) -> Iterable[float]:
    """What is true at each point [the element's unit], once it is."""
    for number, known in enumerate(wanted.known):
        if number or not wanted.yes:
            typer.prompt(f"{ask}: {known:.6g} {found.unit}, then press Enter", default="", show_default=False)
        yield known
    while not wanted.known:
        told = typer.prompt(f"{ask}; how much is it [{found.unit}]? (Enter: no more)", default="", show_default=False)
        if not told:
            return
        try:
            yield float(told)
        except ValueError:
            typer.echo(f"'{told}' is no number.")


def _show(console: Console, found: Subject, points: Sequence[Point], now: Line, line: Line) -> None:
    unit = found.unit
    table = Table(title=f"{found.element} [{unit}]".replace("[", r"\["), box=None, title_justify="left")
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
        f"zero {now.zero:.6g} -> {line.zero:.6g} {unit}, {found.factor} {now.factor:.6g} -> {line.factor:.6g}; "
        f"largest residual {line.residual:.3g} {unit}."
    )
