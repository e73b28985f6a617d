"""The verbs of recordings: record, replay, export."""

from pathlib import Path
from typing import Annotated, Any

import typer

from services.verbs.verb import Connect, RobotFile, known_robot, load, report_errors, robot_name, robot_path, urdf_of

Files = Annotated[list[Path], typer.Argument(metavar="FILE...", help="Recordings (.mcap) of one robot, in any order.")]


def register(app: typer.Typer) -> None:
    """Add the verbs to the command line."""
    app.command()(record)
    app.command()(replay)
    app.command()(export)


@report_errors
def record(
    robot: RobotFile,
    out: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="The file to write, such as walk.mcap. An existing file is never replaced."
        ),
    ],
    max_size: Annotated[
        float | None, typer.Option(min=0.1, metavar="MB", help="Begin a new file at this size.")
    ] = None,
    max_seconds: Annotated[
        float | None, typer.Option(min=1, max=3600, metavar="S", help="Begin a new file after this time.")
    ] = None,
    condition: Annotated[
        str, typer.Option(help="Condition of the body during the recording, such as its tool; train uses it.")
    ] = "",
    connect: Connect = None,
) -> int:
    """Record all messages of a robot's services as MCAP until Ctrl-C.

    Foxglove opens the files. A new file begins every hour (walk.mcap, walk-000002.mcap, ...); with --max-size or
    --max-seconds they are walk-000001.mcap, walk-000002.mcap, ...
    """
    from services.recording.recorder import run_recorder
    from services.recording.writer import Limits

    limits = Limits(None if max_size is None else round(1e6 * max_size), max_seconds)
    return run_recorder(
        robot_name(robot), out, connect or (), catalogue=_signals(robot), condition=condition, limits=limits
    )


@report_errors
def replay(
    files: Files,
    robot: Annotated[str | None, typer.Option(help="Name to play as; that of the recorded robot if not given.")] = None,
    speed: Annotated[
        float,
        typer.Option(min=0, help="Multiple of the recorded speed; 0 begins with a pause: the page has play and step."),
    ] = 1.0,
    model: Annotated[bool, typer.Option("--model", help="Also play the messages of the model, in its place.")] = False,
    connect: Connect = None,
) -> int:
    """Play recordings in place of a robot's HAL and camera; serve, top and view work as with the robot.

    Samples are marked as a replay. Commands are not played, and verbs that would move motors are refused.
    The page pauses it, plays single steps and goes to another place.
    """
    from services.recording.replay import run_replay

    return run_replay(files, None if robot is None else robot_name(robot), speed, model, connect or ())


@report_errors
def export(
    files: Files,
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for the tables.")],
    form: Annotated[str, typer.Option("--format", help="csv, parquet, foxglove, rerun or lerobot.")] = "csv",
    urdf: Annotated[
        Path | None, typer.Option(help="URDF for foxglove and rerun; that of the robot file of this name if not given.")
    ] = None,
    fps: Annotated[int, typer.Option(min=1, max=1000, help="Frames per second for lerobot.")] = 30,
    task: Annotated[str, typer.Option(help="What the robot does, in words, for lerobot.")] = "move",
) -> None:
    """Write recordings as tables: one per key, with a column per element and its unit, and a row per message.

    The format foxglove is one file (FILE.foxglove.mcap) with the channels of `gemuco foxglove`: the robot in 3D,
    measured and estimated values, states, log and health; rerun is the same for rerun (FILE.rrd). The format lerobot
    is a LeRobotDataset (v3.0) in FOLDER, in which observation.estimated marks what was not measured.
    """
    if form == "lerobot":
        from services.lerobot.export import export_lerobot

        typer.echo(str(export_lerobot(files, out, fps, task)))
        return
    if form in ("foxglove", "rerun"):
        _export_picture(form, files, out, urdf)
        return
    from services.recording.export import run_export

    run_export(files, out, form)


def _export_picture(form: str, files: list[Path], out: Path, urdf: Path | None) -> None:
    from services.recording.reading import facts_of, one_robot
    from services.watch.frames import Frames

    if form == "foxglove":
        from services.foxglove.file import write_foxglove as write
    else:
        from services.extras import require

        require("rerun")
        from services.rerun.file import write_rerun as write
    robot = one_robot(facts_of(files))
    config = known_robot(robot)
    path = urdf or urdf_of(robot)
    wires = None if config is None else config.wires
    file, count = write(files, out, None if path is None else Frames(path), wires)
    typer.echo(f"{count} moments in {file}")


def _signals(robot: str) -> Any:
    """Return the signals of a robot file; None if there is no file, so that the HAL has to be queried."""
    from hal.errors import ConfigError
    from services.recording.schema import Catalogue

    try:
        path = robot_path(robot)
    except ConfigError:
        return None
    return Catalogue.of_robot(load(str(path)))
