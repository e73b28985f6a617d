"""`gemuco view`: serve the page until Ctrl-C."""

import threading
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path

import typer

from services.model import artifacts
from services.process.service import until_stopped
from services.view.controls import Controls, why_read_only
from services.view.door import Door, new_token
from services.view.page import Page, serve_page
from services.view.scene import Looks
from services.view.site import open_site
from services.watch.robot_watch import RobotWatch
from services.wire.member import member_of
from services.wire.session import is_loopback

WITHOUT_LINK = "Read only: buttons need the link that `gemuco view` printed."


def view(
    robot: str, host: str, port: int, connect: Iterable[str], looks: Looks, stop: threading.Event | None = None
) -> None:
    """Serve the page of a robot until SIGTERM, SIGINT or `stop`.

    Args:
        robot: Name of the robot.
        host: Address to bind.
        port: Port to bind; 0 for any.
        connect: Endpoints, such as a router's, and role files.
        looks: Look of the robot in 3D.
        stop: Event that ends the page in place of the signals.

    Raises:
        ServiceError: The port is taken, a package is missing, or a role file or the URDF cannot be read.
    """
    connect = tuple(connect)
    read_only = why_read_only(member_of(connect), robot, host)
    watch = RobotWatch(robot, connect)
    token = "" if read_only else new_token()
    with until_stopped(stop) as end, ExitStack() as open_parts:

        def make(port: int, door: Door, read_only: str) -> tuple[Page, int]:
            site = open_site(host, port, f"gemuco view {robot}", door)
            open_parts.callback(site.stop)
            controls = Controls(lambda: watch.client, read_only)
            page = Page(site, robot, watch.look, controls, looks, taught_path(robot))
            open_parts.callback(page.close)
            return page, site.get_port()

        pages: list[Page] = []
        onlookers = 0
        if token:
            page, onlookers = make(0, Door(host), WITHOUT_LINK)
            pages.append(page)
        page, port = make(port, Door(host, token, lambda: onlookers), read_only)
        pages.append(page)
        open_parts.callback(watch.stop)
        watch.start()
        if not is_loopback(host):
            text = f"*** THE PAGE OF '{robot}' HAS NO LOGIN: EVERYONE WHO REACHES {host} CAN READ IT ***"
            typer.echo(text, err=True)
        said = read_only or "With buttons: who has this link commands the robot."
        typer.echo(f"http://{host}:{port}/{token}  {said}  Ctrl-C ends it.")
        serve_page(lambda: _turn(pages), end)


def _turn(pages: list[Page]) -> None:
    for page in pages:
        page.turn()


def taught_path(robot: str) -> Path:
    """Return the file of taught samples, which `gemuco train --data` reads."""
    return artifacts.RUNS / robot / "taught.npz"
