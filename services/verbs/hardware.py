"""Verbs of the command line for who stands before the hardware: scan, doctor, calibrate, can dump."""

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from services.verbs.verb import Connect, RobotFile, load, speaks_plainly

calibrate = typer.Typer(no_args_is_help=True, help="Measure zero, direction and gain of a device; keep them with it.")
can = typer.Typer(no_args_is_help=True, help="Look at CAN buses.")

MaybeRobot = Annotated[
    str | None, typer.Argument(metavar="[ROBOT]", help="A robot file, or the name of one; or else an interface.")
]
Interface = Annotated[
    str | None, typer.Option(help="In place of a robot: an interface of python-can, such as socketcan.")
]
Channel = Annotated[str | None, typer.Option(help="Its channel, such as can0.")]
Bitrate = Annotated[int, typer.Option(min=10_000, help="Its bit rate [bit/s].")]
Device = Annotated[str, typer.Argument(metavar="DEVICE", help="A device, or the element that it measures.")]
Seconds = Annotated[float, typer.Option(min=0.1, max=60.0, help="How long to average at each point [s].")]
Noise = Annotated[
    float | None, typer.Option(min=0.0, help="Largest standard deviation of what stands still [the signal's unit].")
]
Yes = Annotated[bool, typer.Option("--yes", help="Measure the first point at once, and store without asking.")]


def register(app: typer.Typer) -> None:
    """Put these verbs on the command line."""
    app.command()(scan)
    app.command()(doctor)
    app.add_typer(calibrate, name="calibrate")
    app.add_typer(can, name="can")


@speaks_plainly
def scan(
    robot: MaybeRobot = None,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = 1_000_000,
    seconds: Annotated[float, typer.Option(min=0.1, max=60.0, help="How long to listen first [s].")] = 1.5,
    passive: Annotated[bool, typer.Option("--passive", help="Only listen; send nothing.")] = False,
    mit: Annotated[
        bool,
        typer.Option("--mit", help="Also look for MIT drives, by ending their motor mode: a joint that hangs falls."),
    ] = False,
) -> int:
    """Find out who is on a bus: node ids, device types, vendors, serial numbers, beside the robot file if given.

    Listens first, then asks nodes who they are, unless a master is at work there. Enables nothing.
    """
    from services.hardware.scan import run_scan

    config, buses = _buses(robot, interface, channel, bitrate)
    return run_scan(buses, config, seconds, not passive, mit)


@speaks_plainly
def doctor(robot: RobotFile, connect: Connect = None) -> int:
    """Look at everything that a robot needs, one line each, with what to do: buses, nodes, clocks, role files, network.

    Asks the HAL if it runs, or else opens the buses itself with the motors off. Exit code 1 if anything is bad.
    """
    from services.hardware.doctor import run_doctor

    return run_doctor(robot, connect or ())


@calibrate.command()
@speaks_plainly
def joint(
    robot: RobotFile,
    device: Device,
    at: Annotated[
        list[float] | None,
        typer.Option(
            "--at", help="A position that you will put it to [rad or m]; again for another. Asks if not given."
        ),
    ] = None,
    seconds: Seconds = 1.0,
    noise: Noise = None,
    yes: Yes = False,
) -> int:
    """Zero of a joint or wire at one known position; also its direction at two, with a check of its scale.

    The HAL must not run. The motors stay off: move the joint by hand.
    """
    from services.hardware.calibrate import Wanted, calibrate_joint

    return calibrate_joint(load(robot), device, Wanted(tuple(at or ()), seconds, noise, yes))


@calibrate.command()
@speaks_plainly
def cell(
    robot: RobotFile,
    device: Device,
    weight: Annotated[
        list[float] | None,
        typer.Option("--weight", help="A weight that you will hang on it; again for another. Asks if not given."),
    ] = None,
    unit: Annotated[
        str | None, typer.Option(help="Of the weights: N, or the signal's own; kg for a force if not given.")
    ] = None,
    seconds: Seconds = 1.0,
    noise: Noise = None,
    yes: Yes = False,
) -> int:
    """Tare of a load cell with one known weight (0 for none); also its gain with two or more.

    The HAL must not run. Without --weight you are asked, in the signal's unit.
    """
    from services.hardware.calibrate import Wanted, calibrate_cell

    return calibrate_cell(load(robot), device, unit, Wanted(tuple(weight or ()), seconds, noise, yes))


@can.command()
@speaks_plainly
def dump(
    robot: MaybeRobot = None,
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = 1_000_000,
    bus: Annotated[str | None, typer.Option(help="Only this bus of the robot.")] = None,
    node: Annotated[int | None, typer.Option(min=0, help="Only frames of this node.")] = None,
    count: Annotated[int | None, typer.Option(min=1, help="So many frames.")] = None,
    seconds: Annotated[float, typer.Option(min=0.1, help="So long [s]; until Ctrl-C if not given.")] = math.inf,
    summary: Annotated[
        bool, typer.Option("--summary", help="One line per identifier, with its rate, at the end.")
    ] = False,
) -> int:
    """Show the frames of a bus in words: SYNC, NMT, heartbeats, emergencies, SDO, PDO, DBC and MIT frames.

    Sends nothing, and may run beside a HAL.
    """
    from services.hardware.dump import Wanted, run_dump

    config, buses = _buses(robot, interface, channel, bitrate)
    if bus is not None:
        if bus not in buses:
            raise typer.BadParameter(f"There is no bus '{bus}'. Known: {', '.join(buses)}.")
        buses = {bus: buses[bus]}
    return run_dump(buses, config, Wanted(node, count, seconds, summary))


def _buses(robot: str | None, interface: str | None, channel: str | None, bitrate: int) -> tuple[Any, dict[str, Any]]:
    """The robot file, if one was given, and its buses, or the one that was named."""
    from hal.config import BusConfig
    from services.errors import BadArguments

    if (robot is None) == (interface is None):
        raise BadArguments(
            "Name either a robot, or --interface and --channel (`--interface socketcan --channel can0`)."
        )
    if robot is not None:
        config = load(robot)
        return config, dict(config.buses)
    if channel is None:
        raise BadArguments(f"--interface {interface} needs a --channel, such as can0.")
    return None, {Path(channel).name: BusConfig(interface=str(interface), channel=channel, bitrate=bitrate)}
