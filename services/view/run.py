"""`gemuco view`: serve the page until Ctrl-C."""

import threading
from collections.abc import Iterable
from pathlib import Path

import typer

from services.model import artifacts
from services.process.service import until_stopped
from services.view.controls import Controls, why_read_only
from services.view.page import Page, serve_page
from services.view.site import open_site
from services.watch.robot_watch import RobotWatch
from services.wire.member import member_of
from services.wire.session import is_loopback


def view(
    robot: str, host: str, port: int, connect: Iterable[str], urdf: Path | None, stop: threading.Event | None = None
) -> None:
    """Serve the page of a robot until SIGTERM, SIGINT or `stop`.

    Args:
        robot: Name of the robot.
        host: Address to bind.
        port: Port to bind; 0 for any.
        connect: Endpoints, such as a router's, and role files.
        urdf: URDF of the robot; None for a page without 3D.
        stop: Event that ends the page in place of the signals.

    Raises:
        ServiceError: The port is taken, a package is missing, or a role file or the URDF cannot be read.
    """
    connect = tuple(connect)
    read_only = why_read_only(member_of(connect), robot, host)
    watch = RobotWatch(robot, connect)
    with until_stopped(stop) as end:
        site = open_site(host, port, f"gemuco view {robot}")
        try:
            page = Page(site, robot, watch.look, Controls(lambda: watch.client, read_only), urdf, taught_path(robot))
            watch.start()
            if not is_loopback(host):
                text = f"*** THE PAGE OF '{robot}' HAS NO LOGIN: EVERYONE WHO REACHES {host} CAN READ IT ***"
                typer.echo(text, err=True)
            typer.echo(f"http://{host}:{site.get_port()}  {read_only or 'With buttons.'}  Ctrl-C ends it.")
            try:
                serve_page(page.turn, end)
            finally:
                page.close()
                watch.stop()
        finally:
            site.stop()


def taught_path(robot: str) -> Path:
    """Return the file of taught samples, which `gemuco train --data` reads."""
    return artifacts.RUNS / robot / "taught.npz"
