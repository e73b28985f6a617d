"""The verb `view`: the live page."""

from pathlib import Path
from typing import Annotated

import typer

from services.verbs.verb import Connect, RobotFile, report_errors, robot_name, urdf_of


def register(app: typer.Typer) -> None:
    """Add the verbs to the command line."""
    app.command()(view)


@report_errors
def view(
    robot: RobotFile,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 for any.")] = 8090,
    host: Annotated[
        str,
        typer.Option(
            help="Address to serve on. Elsewhere than 127.0.0.1 everyone can read the page, and it has no buttons."
        ),
    ] = "127.0.0.1",
    urdf: Annotated[Path | None, typer.Option(help="URDF of the robot; that of the robot file if not given.")] = None,
    connect: Connect = None,
) -> None:
    """Show a running robot in the browser: signals, the robot in 3D, plots, anomaly, loops, buttons, teaching.

    Needs the extra packages: pip install 'gemuco[view]'.
    """
    from services.view.run import view as show

    show(robot_name(robot), host, port, connect or (), urdf or urdf_of(robot))
