"""The verb `init`: a robot file with a simulator, from a URDF or MJCF file, from vendors' files, a bus, or ROS 2."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from services.verbs.verb import DataBitrate, Distribution, Domain, RosRouter, report_errors

DESCRIBE = "simulators.robots.urdf_arm:describe"
"""The function that reads a URDF is named by this text, because services know simulators by name only."""


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(init)


@report_errors
def init(
    source: Annotated[
        Path | None,
        typer.Argument(
            metavar="[SOURCE]", help="A URDF or MJCF file, or a folder with EDS, DCF and DBC files of devices."
        ),
    ] = None,
    tip: Annotated[
        str | None, typer.Option(metavar="LINK", help="End of the chain to use; the longest arm if not given.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the robot; that in the file if not given.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="The robot file to write; in this folder, named like SOURCE, if not given.")
    ] = None,
    scan: Annotated[
        str | None,
        typer.Option(
            metavar="CHANNEL",
            help="Use the nodes on this bus: can0 of SocketCAN, INTERFACE:CHANNEL, or serial:/dev/ttyACM0.",
        ),
    ] = None,
    bitrate: Annotated[int, typer.Option(min=10_000, help="Bit rate of the scanned bus \\[bit/s].")] = 1_000_000,
    data_bitrate: DataBitrate = None,
    ros2: Annotated[bool, typer.Option("--ros2", help="Draft the file from the topics of a ROS 2 network.")] = False,
    router: RosRouter = None,
    domain: Domain = None,
    distribution: Distribution = None,
) -> None:
    """Write a robot file, with a simulator, for an arm in a URDF or MJCF file, or for the devices that you have.

    For an arm the file has joints, limits and torques; drives, encoders and a camera stand in for the hardware. `gemuco
    demo FILE` then collects, trains, runs, and loses an encoder and the camera. For a folder or a bus it has the
    devices, on a bench; complete what no file knows: gears, zeros, limits.

    With [bold]--ros2[/] the robot is one whose drivers are ROS 2 nodes: its topics are listed and become signals.
    """
    from services.errors import BadArguments

    if ros2 and (source is not None or scan is not None):
        raise BadArguments("--ros2 reads the topics of a network; give neither a file nor --scan with it.")
    if ros2:
        _of_topics(name, out, {"router": router, "domain": domain, "distribution": distribution})
        return
    if source is None and scan is None:
        raise BadArguments("Give a URDF or MJCF file, a folder with EDS, DCF and DBC files, --scan can0, or --ros2.")
    if tip is not None and (scan is not None or (source is not None and source.is_dir())):
        raise BadArguments("--tip is for a URDF or MJCF file; devices have no chain of links.")
    if source is not None and source.suffix in (".yaml", ".yml"):
        raise BadArguments(f"'{source}' is not a URDF or MJCF file. A robot file is ready: `gemuco demo {source}`.")
    file = _new_file(out or Path(f"{_stem(source, scan)}.yaml"))
    if scan is not None or (source is not None and source.is_dir()):
        from services.hardware.draft import bus_of

        _of_devices(source, None if scan is None else bus_of(scan, bitrate, data_bitrate), name, file)
    elif source is not None:
        _of_arm(source, tip, name, file)


def _new_file(file: Path) -> Path:
    """Return a path at which a robot file can be written."""
    from services.errors import ServiceError

    if file.suffix not in (".yaml", ".yml"):
        raise ServiceError(f"A robot file ends in .yaml, not as '{file}'. Name another one by --out.")
    if file.exists():
        raise ServiceError(f"'{file}' exists. Remove it, or name another file by --out.")
    return file


def _of_topics(name: str | None, out: Path | None, given: dict[str, Any]) -> None:
    from services.errors import ServiceError
    from services.ros2.draft import draft
    from services.ros2.settings import network_with

    file = _new_file(out or Path(f"{name or 'ros_robot'}.yaml"))
    robot = name or file.stem
    _check_name(robot)
    made = draft(network_with({}, **given), robot)
    urdf = file.with_name(f"{robot}.urdf")
    if made.urdf and urdf.exists():
        raise ServiceError(f"'{urdf}' exists. Remove it, or give another --name.")
    _write(file, made.text, {urdf.name: made.urdf.encode()} if made.urdf else {})
    typer.echo(f"{file}: {made.summary}")
    for note in made.notes:
        typer.echo(f"  {note}")
    typer.echo(f"Next: gemuco hal {file}, and gemuco top {file}")


def _stem(source: Path | None, scan: str | None) -> str:
    if source is not None:
        return source.resolve().name.partition(".")[0] or "robot"
    return f"robot_on_{Path(str(scan).rpartition(':')[2]).name}"


def _of_arm(source: Path, tip: str | None, name: str | None, file: Path) -> None:
    from hal import registry

    draft: Any = registry.load_object(DESCRIBE)(source, tip, name, file.parent)
    _check_name(draft.robot)
    sheets = {f"eds/{sheet.name}": sheet.read_bytes() for sheet in draft.sheets}
    sheets = {name: content for name, content in sheets.items() if not (file.parent / name).exists()}
    _write(file, draft.text, {**sheets, **draft.files})
    _report(file, draft.summary, draft.notes)
    typer.echo(f"Next: gemuco demo {file}")


def _of_devices(source: Path | None, bus: Any, name: str | None, file: Path) -> None:
    from services.hardware.draft import draft_devices

    if name is not None:
        _check_name(name)
    draft = draft_devices(source, bus, name, file)
    copies = {place: path.read_bytes() for place, path in draft.copies.items() if not (file.parent / place).exists()}
    _write(file, draft.text, copies)
    _report(file, draft.summary, draft.notes)
    typer.echo(
        f"Next: complete the lines with 'set' in {file}; then gemuco demo {file}, or, step by step, gemuco simulate "
        f"{file}, gemuco hal {file}, gemuco doctor {file}"
    )


def _report(file: Path, summary: str, notes: tuple[str, ...]) -> None:
    typer.echo(f"{file}: {summary}")
    for note in notes:
        typer.echo(f"  {note}")


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


def _check_name(robot: str) -> None:
    """Check the name before anything is written."""
    import re

    from hal.errors import ConfigError

    if not re.fullmatch(r"[a-z][a-z0-9_]*", robot):
        raise ConfigError(
            f"'{robot}' is no name of a robot: it has lower-case letters, digits and underscores. Give another --name."
        )
