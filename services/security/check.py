"""`gemuco security check`: attacks a folder of role files from outside and prints one line per attempt."""

from collections.abc import Iterator
from pathlib import Path

import typer

from services.errors import ServiceError
from services.security.attacks import Attempt, Inside, at_the_hal, entering, impostor, people
from services.security.check_sessions import CheckSessions, Weaken
from services.security.door_attacks import at_the_doors, in_the_routers_place
from services.security.model_attacks import with_models
from services.wire.connect import checked_endpoint

_BAD = ("NOT REFUSED", "DOES NOT WORK")
_COLOURS = {"refused": typer.colors.GREEN, "works": typer.colors.GREEN, "not tried": typer.colors.YELLOW}


def run_check(folder: Path, running: str | None = None) -> int:
    """Make all attempts, print a line for each, and return 1 if an attack passed or a permitted use failed.

    Args:
        folder: Folder of `gemuco security init`, with all role files.
        running: Endpoint of a running router; malformed messages then reach the robot, which counts them.

    Raises:
        ServiceError: The folder has no plan, or the check cannot be started.
    """
    count = {"refused": 0, "works": 0, "not tried": 0, "NOT REFUSED": 0, "DOES NOT WORK": 0}
    for attempt in attempts(folder, running):
        count[attempt.verdict] += 1
        is_bad = attempt.verdict in _BAD
        verdict = typer.style(
            f"{attempt.verdict:<14}", fg=typer.colors.RED if is_bad else _COLOURS[attempt.verdict], bold=is_bad
        )
        typer.echo(f"{verdict} {attempt.what}{f' ({attempt.text})' if attempt.text else ''}")
    bad = sum(count[name] for name in _BAD)
    summary = ", ".join(f"{number} {name}" for name, number in count.items() if number)
    typer.secho(f"{summary}.", fg=typer.colors.RED if bad else typer.colors.GREEN, bold=bool(bad))
    return 1 if bad else 0


def attempts(folder: Path, running: str | None = None, weaken: Weaken | None = None) -> Iterator[Attempt]:
    """Make and yield all attempts.

    Raises:
        ServiceError: As `run_check`.
    """
    if running is not None:
        checked_endpoint(running)
    with CheckSessions(folder, running, weaken) as sessions:
        operator, viewer, robot = people(sessions.plan)
        if not operator or not viewer:
            raise ServiceError(f"The check needs an operator and a viewer of robot '{robot}' in plan.json.")
        yield from entering(sessions, viewer)
        yield impostor(sessions, viewer)
        if sessions.hal:
            yield from at_the_hal(sessions, operator, viewer)
        yield from Inside(sessions, operator, viewer).run()
        yield from with_models(sessions)
        yield from in_the_routers_place(sessions, operator)
        yield from at_the_doors(sessions, operator, viewer)
