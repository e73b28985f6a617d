"""The verb `init`: a robot file with a simulator, made from a URDF, or a robot file of the topics of ROS 2."""

import shutil
from pathlib import Path
from typing import Annotated, Any

import typer

from services.verbs.verb import Distribution, Domain, RosRouter, report_errors

DESCRIBE = "simulators.robots.urdf_arm:describe"
"""The function that reads a URDF is named by this text, because services know simulators by name only."""


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(init)


@report_errors
def init(
    urdf: Annotated[
        Path | None, typer.Argument(metavar="[URDF]", help="The URDF of an arm, a leg or a whole robot.")
    ] = None,
    tip: Annotated[
        str | None, typer.Option(metavar="LINK", help="End of the chain to use; the longest arm if not given.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the robot; that of the URDF if not given.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="The robot file to write; in this folder, named like the URDF, if not given.")
    ] = None,
    ros2: Annotated[bool, typer.Option("--ros2", help="Draft the file from the topics of a ROS 2 network.")] = False,
    router: RosRouter = None,
    domain: Domain = None,
    distribution: Distribution = None,
) -> None:
    """Write a robot file for the arm that a URDF describes, with a simulator of it.

    The file has joints, limits and torques; drives, encoders and a camera stand in for the hardware. `gemuco demo FILE`
    then collects, trains, runs, and loses an encoder and the camera.

    With [bold]--ros2[/] the robot is one whose drivers are ROS 2 nodes: its topics are listed and become signals.
    """
    from services.errors import ServiceError

    if ros2 == (urdf is not None):
        raise ServiceError("`gemuco init` takes either a URDF or --ros2.")
    if urdf is not None:
        _from_urdf(urdf, tip, name, out)
    else:
        _from_topics(name, out, {"router": router, "domain": domain, "distribution": distribution})


def _new_file(file: Path) -> Path:
    """Return a path at which a robot file can be written."""
    from services.errors import ServiceError

    if file.suffix not in (".yaml", ".yml"):
        raise ServiceError(f"A robot file ends in .yaml, not as '{file}'. Name another one by --out.")
    if file.exists():
        raise ServiceError(f"'{file}' exists. Remove it, or name another file by --out.")
    return file


def _from_topics(name: str | None, out: Path | None, given: dict[str, Any]) -> None:
    from gemuco.writing import replace
    from hal.errors import ConfigError
    from services.errors import ServiceError
    from services.ros2.draft import draft
    from services.ros2.settings import network_with

    file = _new_file(out or Path(f"{name or 'ros_robot'}.yaml"))
    robot = name or file.stem
    _check_name(robot, ConfigError)
    made = draft(network_with({}, **given), robot)
    urdf = file.with_name(f"{robot}.urdf")
    if made.urdf and urdf.exists():
        raise ServiceError(f"'{urdf}' exists. Remove it, or give another --name.")
    try:
        if made.urdf:
            replace(urdf, made.urdf.encode())
        replace(file, made.text.encode())
    except OSError as error:
        raise ServiceError(f"'{file}' cannot be written: {error.strerror}.") from None
    typer.echo(f"{file}: {made.summary}")
    for note in made.notes:
        typer.echo(f"  {note}")
    typer.echo(f"Next: gemuco hal {file}, and gemuco top {file}")


def _from_urdf(urdf: Path, tip: str | None, name: str | None, out: Path | None) -> None:
    from gemuco.writing import replace
    from hal import registry
    from hal.errors import ConfigError
    from services.errors import ServiceError

    file = _new_file(out or Path(f"{urdf.name.partition('.')[0]}.yaml"))
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
