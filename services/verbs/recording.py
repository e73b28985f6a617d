"""The verbs of recordings: write them down, play them back, hand them on."""

from pathlib import Path
from typing import Annotated, Any

import typer

from services.verbs.verb import Connect, RobotFile, load, robot_name, robot_path, speaks_plainly

Files = Annotated[list[Path], typer.Argument(metavar="FILE...", help="Recordings (.mcap) of one robot, in any order.")]


def register(app: typer.Typer) -> None:
    """Add the verbs to the command line."""
    app.command()(record)
    app.command()(replay)
    app.command()(export)


@speaks_plainly
def record(
    robot: RobotFile,
    out: Annotated[
        Path, typer.Argument(metavar="FILE", help="The file to write, such as walk.mcap; none is ever replaced.")
    ],
    max_size: Annotated[
        float | None, typer.Option(min=0.1, metavar="MB", help="Begin a new file when one has this size.")
    ] = None,
    max_seconds: Annotated[
        float | None, typer.Option(min=1, max=3600, metavar="S", help="Begin a new file when one covers this long.")
    ] = None,
    condition: Annotated[str, typer.Option(help="How the body is meanwhile, such as its tool; train uses it.")] = "",
    connect: Connect = None,
) -> int:
    """Write down all that a robot's services publish, as MCAP, until Ctrl-C.

    Foxglove opens the files. A new one begins every hour (walk.mcap, walk-000002.mcap, ...); with --max-size or
    --max-seconds they are walk-000001.mcap, walk-000002.mcap, ...
    """
    from services.recording.recorder import run_recorder
    from services.recording.writer import Limits

    limits = Limits(None if max_size is None else round(1e6 * max_size), max_seconds)
    return run_recorder(
        robot_name(robot), out, connect or (), catalogue=_signals(robot), condition=condition, limits=limits
    )


@speaks_plainly
def replay(
    files: Files,
    robot: Annotated[str | None, typer.Option(help="Play as this robot; as the recorded one if not given.")] = None,
    speed: Annotated[
        float,
        typer.Option(min=0, help="Times the recorded speed; 0 plays what is asked for with the verb hal/do/step."),
    ] = 1.0,
    model: Annotated[bool, typer.Option("--model", help="Play what the model published too, in its place.")] = False,
    connect: Connect = None,
) -> int:
    """Play recordings in place of a robot's HAL and camera; serve, top and view work on it as on the robot.

    Samples say that they are a replay, commands are not played, and what would move motors is refused.
    """
    from services.recording.replay import run_replay

    return run_replay(files, None if robot is None else robot_name(robot), speed, model, connect or ())


@speaks_plainly
def export(
    files: Files,
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Where the tables go; one per key.")],
    form: Annotated[str, typer.Option("--format", help="csv or parquet.")] = "csv",
) -> None:
    """Write recordings as tables: one per key, a column per element with its unit, a row per message."""
    from services.recording.export import run_export

    run_export(files, out, form)


def _signals(robot: str) -> Any:
    """The signals of a robot whose file is here; None where only its HAL can tell them."""
    from hal.errors import ConfigError
    from services.recording.schema import Catalogue

    try:
        path = robot_path(robot)
    except ConfigError:
        return None
    return Catalogue.of_robot(load(str(path)))
