"""The verbs for work on the hardware: scan, doctor, calibrate, can dump."""

import math
import re
from pathlib import Path
from typing import Annotated, Any

import typer

from services.verbs.verb import Connect, DataBitrate, RobotFile, load, report_errors

calibrate = typer.Typer(no_args_is_help=True, help="Measure and store zero, direction and gain of a device.")
can = typer.Typer(no_args_is_help=True, help="Show CAN buses.")

MaybeRobot = Annotated[
    str | None,
    typer.Argument(
        metavar="[ROBOT]", help="A robot file or the name of one; or a channel, such as can0 or hub:CHANNEL."
    ),
]
DoctorRobot = Annotated[
    str | None, typer.Argument(metavar="[ROBOT]", help="A robot file, or the name of one in robots/.")
]
CHANNEL = re.compile(r"(?:sl|v)?can\d+|[a-z][a-z0-9_]*:[^\\].*")
"""A channel in place of a robot, as `gemuco init --scan` has it; `C:\\` begins a path."""
Interface = Annotated[
    str | None, typer.Option(help="Instead of a robot: an interface of python-can, such as socketcan.")
]
Channel = Annotated[str | None, typer.Option(help="Channel of the interface, such as can0.")]
Bitrate = Annotated[int, typer.Option(min=10_000, help="Bit rate of the channel \\[bit/s].")]
Device = Annotated[str, typer.Argument(metavar="DEVICE", help="A device, or an element that it measures.")]
Seconds = Annotated[float, typer.Option(min=0.1, max=60.0, help="Averaging time at each point \\[s].")]
Noise = Annotated[float | None, typer.Option(min=0.0, help="Largest standard deviation at rest \\[the signal's unit].")]
Yes = Annotated[bool, typer.Option("--yes", help="Measure the first point at once, and store without asking.")]


def register(app: typer.Typer) -> None:
    """Add the verbs to the command line."""
    app.command()(scan)
    app.command()(doctor)
    app.add_typer(calibrate, name="calibrate")
    app.add_typer(can, name="can")


@report_errors
def scan(
    robot: MaybeRobot = None,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = 1_000_000,
    data_bitrate: DataBitrate = None,
    seconds: Annotated[
        float, typer.Option(min=0.1, max=60.0, help="Listening time before the first request \\[s].")
    ] = 1.5,
    passive: Annotated[bool, typer.Option("--passive", help="Only listen, send nothing.")] = False,
    mit: Annotated[
        bool,
        typer.Option("--mit", help="Also search for MIT drives. This ends their motor mode: a hanging joint falls."),
    ] = False,
) -> int:
    """List the nodes of a bus: ids, device types, vendors, serial numbers. Compare them with the robot file if given.

    Listens first, then reads the identity of each node, unless a master is active on the bus. Enables no motor.
    """
    from services.hardware.scan import run_scan

    config, buses = _buses(robot, interface, channel, bitrate, data_bitrate)
    return run_scan(buses, config, seconds, not passive, mit)


@report_errors
def doctor(robot: DoctorRobot = None, connect: Connect = None) -> int:
    """Check buses, nodes, topics, clocks, role files and network of a robot: one line per check, with its remedy.

    Reads the status of the HAL if it runs, otherwise opens the buses with the motors off. Without a robot: this
    machine's packages, CAN interfaces, clocks and scheduling. Exit code 1 if anything is bad.
    """
    from services.hardware.doctor import run_doctor
    from services.ros2.hardware import check_topics

    return run_doctor(robot, connect or (), check_topics)


@calibrate.command()
@report_errors
def joint(
    robot: RobotFile,
    device: Device,
    at: Annotated[
        list[float] | None,
        typer.Option(
            "--at", help="A known position that you will set \\[rad or m]; repeat for more. Asks if not given."
        ),
    ] = None,
    seconds: Seconds = 1.0,
    noise: Noise = None,
    yes: Yes = False,
) -> int:
    """Measure the zero of a joint or wire at one known position; at two, also its direction, and check its scale.

    The HAL must not run. The motors stay off: move the joint by hand.
    """
    from services.hardware.calibrate import CalibrationOptions, calibrate_joint

    return calibrate_joint(load(robot), device, CalibrationOptions(tuple(at or ()), seconds, noise, yes))


@calibrate.command()
@report_errors
def cell(
    robot: RobotFile,
    device: Device,
    weight: Annotated[
        list[float] | None,
        typer.Option("--weight", help="A known weight that you will attach; repeat for more. Asks if not given."),
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option(help="Unit of the weights: kg, or the unit of the signal; kg for a force if not given."),
    ] = None,
    seconds: Seconds = 1.0,
    noise: Noise = None,
    yes: Yes = False,
) -> int:
    """Measure the zero of a load cell with one known weight (0 for none); with two or more, also its gain.

    The HAL must not run. Without --weight it asks for values in the signal's unit.
    """
    from services.hardware.calibrate import CalibrationOptions, calibrate_cell

    options = CalibrationOptions(tuple(weight or ()), seconds, noise, yes)
    return calibrate_cell(load(robot), device, unit, options)


@can.command()
@report_errors
def dump(
    robot: MaybeRobot = None,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = 1_000_000,
    data_bitrate: DataBitrate = None,
    bus: Annotated[str | None, typer.Option(help="Only this bus of the robot.")] = None,
    node: Annotated[int | None, typer.Option(min=0, help="Only frames of this node.")] = None,
    count: Annotated[int | None, typer.Option(min=1, help="Number of frames; no limit if not given.")] = None,
    seconds: Annotated[float, typer.Option(min=0.1, help="Duration \\[s]; until Ctrl-C if not given.")] = math.inf,
    summary: Annotated[
        bool, typer.Option("--summary", help="One line per identifier, with its rate, at the end.")
    ] = False,
) -> int:
    """Show the frames of a bus in words: SYNC, NMT, heartbeats, emergencies, SDO, PDO, DBC and MIT frames.

    Sends nothing, and may run while a HAL runs.
    """
    from hal.line import SERIAL
    from services.errors import BadArguments
    from services.hardware.dump import DumpOptions, run_dump

    config, buses = _buses(robot, interface, channel, bitrate, data_bitrate)
    if bus is not None:
        if bus not in buses:
            raise typer.BadParameter(f"There is no bus '{bus}'. Known: {', '.join(buses)}.")
        buses = {bus: buses[bus]}
    if lines := [name for name, entry in buses.items() if entry.interface in SERIAL]:
        raise BadArguments(f"{', '.join(lines)} is a serial line, without CAN frames. `gemuco scan` lists its servos.")
    return run_dump(buses, config, DumpOptions(node, count, seconds, summary))


def _buses(
    robot: str | None, interface: str | None, channel: str | None, bitrate: int, data_bitrate: int | None
) -> tuple[Any, dict[str, Any]]:
    """Return the robot file and its buses; without a robot, None and the bus of the interface or channel."""
    from services.errors import BadArguments
    from services.hardware.draft import bus_of, bus_with

    if (robot is None) == (interface is None):
        raise BadArguments(
            "Name either a robot, or --interface and --channel (`--interface socketcan --channel can0`), or can0 alone."
        )
    if robot is not None and not Path(robot).exists() and CHANNEL.fullmatch(robot):
        bus = bus_of(robot, bitrate, data_bitrate)
        return None, {Path(str(bus.channel)).name: bus}
    if robot is not None:
        config = load(robot)
        if not config.buses:
            raise BadArguments(f"Robot '{config.robot}' has no bus. `gemuco top` shows what its HAL reads.")
        return config, dict(config.buses)
    if channel is None:
        raise BadArguments(f"--interface {interface} needs a --channel, such as can0.")
    return None, {Path(channel).name: bus_with(str(interface), channel, bitrate, data_bitrate)}
