"""`gemuco estop`: stop every drive, say what each did, and fail loudly if one did not."""

from collections.abc import Iterable

import typer

from services.client import Client


def estop_robot(robot: str, reason: str, connect: Iterable[str]) -> int:
    """Ask for the emergency stop, print one line per drive, return the exit code: 0 only if every drive stopped."""
    try:
        with Client(robot, connect) as client:
            answer = client.estop(reason)
    except Exception as error:  # whatever it is, it must be loud
        typer.echo(f"gemuco: {error}", err=True)
        return _shout(f"NOBODY ANSWERED for '{robot}', so nothing may have stopped. CUT THE POWER.")
    for one in answer["devices"]:
        typer.echo(f"{one['device']}: {one['text']}", err=not one["stopped"])
    if answer["text"]:
        typer.echo(f"gemuco: {answer['text']}", err=True)
    if not answer["complete"]:
        failed = ", ".join(one["device"] for one in answer["devices"] if not one["stopped"])
        return _shout(f"NOT STOPPED: {failed}. CUT THE POWER.")
    typer.echo(f"All {len(answer['devices'])} drives stopped. Leave the fault with `gemuco query {robot} reset`.")
    return 0


def _shout(text: str) -> int:
    typer.secho(f"\a*** {text} ***", err=True, fg=typer.colors.WHITE, bg=typer.colors.RED, bold=True)
    return 1
