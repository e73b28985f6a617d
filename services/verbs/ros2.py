"""The verb `ros2`: a robot in ROS 2."""

from pathlib import Path
from typing import Annotated

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
    """Add the verb to the command line."""
    app.command()(ros2)


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
    from services.ros2.frames import Frames
    from services.ros2.settings import network_with

    path, config = urdf or urdf_of(robot), known_robot(robot)
    section = {} if config is None else config.ros2
    network = network_with(section, router=router, domain=domain, distribution=distribution)
    run_bridge(robot_name(robot), network, connect or (), None if path is None else Frames(path), rate)
