"""The verb `ros2`: a robot in ROS 2."""

from pathlib import Path
from typing import Annotated

import typer

from services.verbs.verb import Connect, RobotFile, report_errors, robot_name, urdf_of


def register(app: typer.Typer) -> None:
    """Add the verb to the command line."""
    app.command()(ros2)


RosRouter = Annotated[
    str, typer.Option("--ros-router", metavar="ENDPOINT", help="Router of ROS 2: rmw_zenohd, or `gemuco router`.")
]
Domain = Annotated[int, typer.Option(min=0, max=232, envvar="ROS_DOMAIN_ID", help="Domain of ROS 2.")]
Distribution = Annotated[
    str,
    typer.Option("--ros-distro", envvar="ROS_DISTRO", help="Distribution of the other nodes; humble has no hashes."),
]


@report_errors
def ros2(
    robot: RobotFile,
    router: RosRouter = "tcp/127.0.0.1:7447",
    domain: Domain = 0,
    distribution: Distribution = "jazzy",
    rate: Annotated[float, typer.Option(min=0.1, max=1000, help="Highest rate of each topic \\[Hz].")] = 50.0,
    urdf: Annotated[Path | None, typer.Option(help="URDF of the robot; that of the robot file if not given.")] = None,
    connect: Connect = None,
) -> None:
    """Publish a running robot in ROS 2 (rmw_zenoh), without ROS, until Ctrl-C.

    [bold]/ROBOT/joint_states[/] has measured joints only, [bold]/ROBOT/joint_states_estimated[/] all;
    [bold]/diagnostics[/] says which are estimated. Other signals, load cells, robot_description and tf follow.
    """
    from services.ros2.bridge import run_bridge
    from services.ros2.frames import Frames
    from services.ros2.node import Network

    path = urdf or urdf_of(robot)
    network = Network(router, domain, distribution)
    run_bridge(robot_name(robot), network, connect or (), None if path is None else Frames(path), rate)
