"""The verb `init`: a robot file with a simulator, made from a URDF or MJCF file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from services.verbs.verb import report_errors

DESCRIBE = "simulators.robots.urdf_arm:describe"
"""The function that reads the file is named by this text, because services know simulators by name only."""


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(init)


@report_errors
def init(
    source: Annotated[
        Path, typer.Argument(metavar="FILE", help="The URDF or MJCF file of an arm, a leg or a whole robot.")
    ],
    tip: Annotated[
        str | None, typer.Option(metavar="LINK", help="End of the chain to use; the longest arm if not given.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the robot; that in the file if not given.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="The robot file to write; in this folder, named like FILE, if not given.")
    ] = None,
) -> None:
    """Write a robot file for the arm that a URDF or an MJCF file describes, with a simulator of it.

    The file has joints, limits and torques; drives, encoders and a camera stand in for the hardware. `gemuco demo FILE`
    then collects, trains, runs, and loses an encoder and the camera. An MJCF file (of MuJoCo) is converted to a URDF.
    """
    from hal import registry
    from hal.errors import ConfigError
    from services.errors import ServiceError

    file = out or Path(f"{source.name.partition('.')[0]}.yaml")
    if file.suffix not in (".yaml", ".yml"):
        raise ServiceError(f"A robot file ends in .yaml, not as '{file}'. Name another one by --out.")
    if file.exists():
        raise ServiceError(f"'{file}' exists. Remove it, or name another file by --out.")
    draft: Any = registry.load_object(DESCRIBE)(source, tip, name, file.parent)
    _check_name(draft.robot, ConfigError)
    sheets = {f"eds/{sheet.name}": sheet.read_bytes() for sheet in draft.sheets}
    sheets = {name: content for name, content in sheets.items() if not (file.parent / name).exists()}
    _write(file, draft.text, {**sheets, **draft.files})
    typer.echo(f"{file}: {draft.summary}")
    for note in draft.notes:
        typer.echo(f"  {note}")
    typer.echo(f"Next: gemuco demo {file}")


def _write(file: Path, text: str, more: Mapping[str, bytes]) -> None:
    """Write a robot file and the files that belong into its folder; no other file is overwritten."""
    from gemuco.writing import replace
    from services.errors import ServiceError

    others = {file.parent / name: content for name, content in more.items()}
    for path, content in others.items():
        if path.exists() and path.read_bytes() != content:
            raise ServiceError(f"'{path}' exists with another content. Remove it, or name a file elsewhere by --out.")
    try:
        for path, content in (*others.items(), (file, text.encode())):
            path.parent.mkdir(parents=True, exist_ok=True)
            replace(path, content)
    except OSError as error:
        raise ServiceError(f"'{file}' cannot be written: {error.strerror}.") from None


def _check_name(robot: str, error: type[Exception]) -> None:
    """Check the name before anything is written."""
    import re

    if not re.fullmatch(r"[a-z][a-z0-9_]*", robot):
        raise error(
            f"'{robot}' is no name of a robot: it has lower-case letters, digits and underscores. Give another --name."
        )
