"""`gemuco foxglove ROBOT`: serve a robot to Foxglove until Ctrl-C, in a process and on a session of its own."""

import contextlib
import threading
import time
from collections.abc import Iterable
from contextlib import ExitStack

import foxglove
import typer
from typing_extensions import override

from services.errors import ServiceError
from services.foxglove.channels import RobotChannels
from services.process.loop import Loop
from services.process.service import until_stopped
from services.watch.frames import Frames
from services.watch.robot_watch import RobotWatch
from services.watch.shapes import Wires
from services.wire.session import is_loopback

BACKLOG = 512
"""At most this number of messages waits for a viewer; the oldest are dropped, and nothing waits for a slow viewer."""
ENDS_WITHIN = 1.0
"""The loop is waited for this long [s] at the end."""


class _Arrivals(foxglove.ServerListener):
    """A mark that a viewer has subscribed to something; it is set by the server's threads."""

    def __init__(self) -> None:
        self.has_come = threading.Event()

    @override
    def on_subscribe(self, client: object, channel: object) -> None:
        self.has_come.set()


def run_foxglove(
    robot: str,
    host: str,
    port: int,
    connect: Iterable[str] = (),
    frames: Frames | None = None,
    wires: Wires | None = None,
    rate: float = 30.0,
    stop: threading.Event | None = None,
) -> None:
    """Serve a robot until SIGTERM, SIGINT or `stop`; the robot may start later and may restart.

    Args:
        robot: Name of the robot.
        host: Address to bind.
        port: Port to bind; 0 for any.
        connect: Endpoints of the robot's network, and role files.
        frames: Frames of its URDF; None without one.
        wires: Its wires.
        rate: Highest rate of each topic [Hz].
        stop: Event that ends it in place of the signals.

    Raises:
        ServiceError: The port is taken, no session opens, or a wire is on an unknown link.
    """
    context, arrivals = foxglove.Context(), _Arrivals()
    watch = RobotWatch(robot, connect)
    channels = RobotChannels(robot, context, frames, wires)
    with until_stopped(stop) as end, ExitStack() as stack:
        try:
            server = foxglove.start_server(
                name=f"gemuco {robot}", host=host, port=port, context=context, server_listener=arrivals,
                message_backlog_size=BACKLOG,
            )  # fmt: skip
        except (OSError, RuntimeError, ValueError) as error:
            raise ServiceError(f"Foxglove cannot be served at {host}:{port}: {error}. Another --port?") from None
        stack.callback(server.stop)
        stack.callback(watch.stop)
        watch.start()

        def tick() -> None:
            if arrivals.has_come.is_set():
                arrivals.has_come.clear()
                channels.show_again()
            channels.publish(watch.look(), time.time_ns())

        loop = Loop("foxglove", rate, tick)
        stack.callback(loop.stop, ENDS_WITHIN)
        loop.start()
        if not is_loopback(host):
            typer.echo(f"*** EVERYONE WHO REACHES {host} CAN SEE THE ROBOT ***", err=True)
        shown = f"[{host}]" if ":" in host else host
        typer.echo(f"ws://{shown}:{server.port}  In Foxglove: Open connection, Foxglove WebSocket. Ctrl-C ends it.")
        with contextlib.suppress(KeyboardInterrupt):
            end.wait()
