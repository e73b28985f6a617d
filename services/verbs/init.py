"""The verb `init`: a robot file with a simulator, made from a URDF."""

import shutil
from pathlib import Path
from typing import Annotated, Any

import typer

from services.verbs.verb import report_errors

DESCRIBE = "simulators.robots.urdf_arm:describe"
"""The function that reads a URDF is named by this text, because services know simulators by name only."""


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(init)


@report_errors
def init(
    urdf: Annotated[Path, typer.Argument(metavar="URDF", help="The URDF of an arm, a leg or a whole robot.")],
    tip: Annotated[
        str | None, typer.Option(metavar="LINK", help="End of the chain to use; the longest arm if not given.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the robot; that of the URDF if not given.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="The robot file to write; in this folder, named like the URDF, if not given.")
    ] = None,
) -> None:
    """Write a robot file for the arm that a URDF describes, with a simulator of it.

    The file has joints, limits and torques; drives, encoders and a camera stand in for the hardware. `gemuco demo FILE`
    then collects, trains, runs, and loses an encoder and the camera.
    """
    from gemuco.writing import replace
    from hal import registry
    from hal.errors import ConfigError
    from services.errors import ServiceError

    file = out or Path(f"{urdf.name.partition('.')[0]}.yaml")
    if file.suffix not in (".yaml", ".yml"):
        raise ServiceError(f"A robot file ends in .yaml, not as '{file}'. Name another one by --out.")
    if file.exists():
        raise ServiceError(f"'{file}' exists. Remove it, or name another file by --out.")
    draft: Any = registry.load_object(DESCRIBE)(urdf, tip, name, file.parent)
    _check_name(draft.robot, ConfigError)
    try:
        sheets = file.parent / "eds"
        sheets.mkdir(parents=True, exist_ok=True)
        for sheet in draft.sheets:
            if not (sheets / sheet.name).exists():
                shutil.copy(sheet, sheets)
        replace(file, draft.text.encode())
    except OSError as error:
        raise ServiceError(f"'{file}' cannot be written: {error.strerror}.") from None
    typer.echo(f"{file}: {draft.summary}")
    for note in draft.notes:
        typer.echo(f"  {note}")
    typer.echo(f"Next: gemuco demo {file}")


def _check_name(robot: str, error: type[Exception]) -> None:
    """Check the name before anything is written."""
    import re

    if not re.fullmatch(r"[a-z][a-z0-9_]*", robot):
        raise error(
            f"'{robot}' is no name of a robot: it has lower-case letters, digits and underscores. Give another --name."
        )
