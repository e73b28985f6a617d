"""The verbs of other programs: a robot in ROS 2, in Foxglove, in rerun, and its metrics for Prometheus."""

from pathlib import Path
from typing import Annotated, Any

import typer

from services.verbs.verb import (
    Connect,
    Distribution,
    Domain,
    RobotFile,
    RosRouter,
    known_robot,
    report_errors,
    robot_name,
    urdf_of,
)


def register(app: typer.Typer) -> None:
    """Add the verbs to the command line."""
    app.command()(ros2)
    app.command()(foxglove)
    app.command()(rerun)
    app.command()(metrics)


@report_errors
def ros2(
    robot: RobotFile,
    router: RosRouter = None,
    domain: Domain = None,
    distribution: Distribution = None,
    rate: Annotated[float, typer.Option(min=0.1, max=1000, help="Highest rate of each topic \\[Hz].")] = 50.0,
    urdf: Annotated[Path | None, typer.Option(help="URDF of the robot; that of the robot file if not given.")] = None,
    connect: Connect = None,
) -> None:
    """Publish a running robot in ROS 2 (rmw_zenoh), without ROS, until Ctrl-C.

    [bold]/ROBOT/joint_states[/] has measured joints only, [bold]/ROBOT/joint_states_estimated[/] all;
    [bold]/diagnostics[/] says which are estimated. Other signals, load cells, robot_description and tf follow.
    """
    from services.ros2.bridge import run_bridge
    from services.ros2.settings import network_with
    from services.watch.frames import Frames

    path, config = urdf or urdf_of(robot), known_robot(robot)
    section = {} if config is None else config.ros2
    network = network_with(section, router=router, domain=domain, distribution=distribution)
    run_bridge(robot_name(robot), network, connect or (), None if path is None else Frames(path), rate)


@report_errors
def foxglove(
    robot: RobotFile,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to serve on; 0 for any.")] = 8765,
    host: Annotated[str, typer.Option(help="Address to serve on.")] = "127.0.0.1",
    rate: Annotated[float, typer.Option(min=0.1, max=1000, help="Highest rate of each topic \\[Hz].")] = 30.0,
    urdf: Annotated[Path | None, typer.Option(help="URDF of the robot; that of the robot file if not given.")] = None,
    layout: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a layout for this robot to FILE, and end.")
    ] = None,
    connect: Connect = None,
) -> None:
    r"""Serve a running robot to Foxglove: the robot in 3D, values with their intervals, states, log, health.

    In Foxglove: Open connection, Foxglove WebSocket. Needs the extra packages: pip install 'gemuco\[foxglove]'.
    """
    from services.watch.frames import Frames

    path, config = urdf or urdf_of(robot), known_robot(robot)
    frames = None if path is None else Frames(path)
    if layout is not None:
        from services.foxglove.layout import write_layout

        root = "base" if frames is None else frames.links[0]
        write_layout(layout, robot_name(robot), _signals(robot, config, connect), root)
        typer.echo(f"{layout}: in Foxglove, Layout, Import from file.")
        return
    from services.foxglove.serve import run_foxglove

    wires = None if config is None else config.wires
    run_foxglove(robot_name(robot), host, port, connect or (), frames, wires, rate)


@report_errors
def rerun(
    robot: RobotFile,
    viewer: Annotated[
        str, typer.Option(metavar="URL", help="Viewer to send to, as `rerun` opens it.")
    ] = "rerun+http://127.0.0.1:9876/proxy",
    rate: Annotated[float, typer.Option(min=0.1, max=200, help="Moments per second \\[Hz].")] = 15.0,
    urdf: Annotated[Path | None, typer.Option(help="URDF of the robot; that of the robot file if not given.")] = None,
    connect: Connect = None,
) -> None:
    r"""Show a running robot in an open rerun viewer: the robot in 3D, values with their intervals, log, health.

    Needs the extra packages: pip install 'gemuco\[rerun]'.
    """
    from services.extras import require
    from services.watch.frames import Frames

    require("rerun")
    from services.rerun.live import run_rerun

    path, config = urdf or urdf_of(robot), known_robot(robot)
    signals = {name: unit for name, (unit, _) in _signals(robot, config, connect).items()}
    frames = None if path is None else Frames(path)
    run_rerun(robot_name(robot), signals, viewer, connect or (), frames, None if config is None else config.wires, rate)


def _signals(robot: str, config: Any, connect: Any) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Return signal -> unit and elements, of the robot file, or of the running robot without one."""
    if config is not None:
        return {name: (signal.unit, tuple(signal.elements)) for name, signal in config.signals.items()}
    from services.client import Client

    with Client(robot_name(robot), tuple(connect or ())) as client:
        signals = client.describe("hal")["signals"]
    return {name: (about["unit"], tuple(about["elements"])) for name, about in signals.items()}


@report_errors
def metrics(
    robots: Annotated[
        list[str] | None, typer.Argument(metavar="[ROBOT]...", help="Robots, each in detail; all robots if not given.")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to serve on; 0 for any.")] = 9464,
    host: Annotated[str, typer.Option(help="Address to serve on.")] = "127.0.0.1",
    connect: Connect = None,
) -> None:
    """Serve metrics of running robots for Prometheus: loops, elements, anomaly, buses, troubles.

    Of named robots every element is served; without a name only what the statuses of all robots say.

    Needs the extra packages: pip install 'gemuco[metrics]'.
    """
    from services.metrics.serve import serve_metrics

    serve_metrics([robot_name(robot) for robot in robots or ()], host, port, connect or ())
