"""`gemuco security check`: proves from outside that who must not get in does not, one line per attempt."""

from collections.abc import Iterator
from pathlib import Path

import typer

from services.errors import ServiceError
from services.security.attacks import Attempt, Inside, at_the_hal, entering, impostor, people
from services.security.stage import Stage, Weaken
from services.wire.connect import checked_endpoint

_BAD = ("NOT REFUSED", "DOES NOT WORK")
_COLOURS = {"refused": typer.colors.GREEN, "works": typer.colors.GREEN, "not tried": typer.colors.YELLOW}


def run_check(folder: Path, running: str | None = None) -> int:
    """Try everything, print a line for each, return the exit code: 1 if anything was not refused, or does not work.

    Args:
        folder: Of `gemuco security init`, with all role files.
        running: The endpoint of a router that runs already; malformed messages then reach the robot, which counts them.

    Raises:
        ServiceError: There is nothing to check, or it cannot be started.
    """
    count = {"refused": 0, "works": 0, "not tried": 0, "NOT REFUSED": 0, "DOES NOT WORK": 0}
    for one in attempts(folder, running):
        count[one.verdict] += 1
        is_bad = one.verdict in _BAD
        verdict = typer.style(
            f"{one.verdict:<14}", fg=typer.colors.RED if is_bad else _COLOURS[one.verdict], bold=is_bad
        )
        typer.echo(f"{verdict} {one.what}{f' ({one.text})' if one.text else ''}")
    bad = sum(count[name] for name in _BAD)
    told = ", ".join(f"{number} {name}" for name, number in count.items() if number)
    typer.secho(f"{told}.", fg=typer.colors.RED if bad else typer.colors.GREEN, bold=bool(bad))
    return 1 if bad else 0


def attempts(folder: Path, running: str | None = None, weaken: Weaken | None = None) -> Iterator[Attempt]:
    """Every attempt, as it is made.

    Raises:
        ServiceError: As `run_check`.
    """
    if running is not None:
        checked_endpoint(running)
    with Stage(folder, running, weaken) as stage:
        operator, viewer, robot = people(stage.plan)
        if not operator or not viewer:
            raise ServiceError(f"The check needs an operator and a viewer of robot '{robot}' in plan.json.")
        yield from entering(stage, viewer)
        yield impostor(stage, viewer)
        if stage.hal:
            yield from at_the_hal(stage, operator, viewer)
        yield from Inside(stage, operator, viewer).run()
