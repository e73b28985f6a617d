"""`gemuco rerun ROBOT`: show a running robot in an open rerun viewer until Ctrl-C, on a session of its own."""

import contextlib
import threading
import time
from collections.abc import Iterable, Mapping
from contextlib import ExitStack

import rerun as rr
import typer

from services.errors import ServiceError
from services.process.loop import Loop
from services.process.service import until_stopped
from services.rerun.picture import RobotPicture, blueprint
from services.watch.frames import Frames
from services.watch.robot_watch import RobotWatch
from services.watch.shapes import Wires

VIEWER = "rerun+http://127.0.0.1:9876/proxy"
"""Address of a viewer that was started by `rerun`."""
ENDS_WITHIN = 1.0
"""The loop is waited for this long [s] at the end."""


def run_rerun(
    robot: str,
    signals: Mapping[str, str],
    viewer: str = VIEWER,
    connect: Iterable[str] = (),
    frames: Frames | None = None,
    wires: Wires | None = None,
    rate: float = 15.0,
    stop: threading.Event | None = None,
) -> None:
    """Send a robot to a viewer until SIGTERM, SIGINT or `stop`; robot and viewer may start later and may restart.

    Args:
        robot: Name of the robot.
        signals: Signal -> unit, for the plots.
        viewer: Address of the viewer.
        connect: Endpoints of the robot's network, and role files.
        frames: Frames of its URDF; None without one.
        wires: Its wires.
        rate: Moments per second [Hz].
        stop: Event that ends it in place of the signals.

    Raises:
        ServiceError: The address is malformed, no session opens, or a wire is on an unknown link.
    """
    stream = rr.RecordingStream(f"gemuco {robot}")
    watch = RobotWatch(robot, connect)
    picture = RobotPicture(robot, stream, frames, wires)
    with until_stopped(stop) as end, ExitStack() as stack:
        try:
            stream.connect_grpc(viewer, default_blueprint=blueprint(robot, signals))
        except (RuntimeError, ValueError, OSError) as error:
            raise ServiceError(f"'{viewer}' is no rerun viewer: {error}. Start `rerun`, or name --viewer.") from None
        stack.callback(stream.disconnect)
        stack.callback(watch.stop)
        watch.start()
        loop = Loop("rerun", rate, lambda: picture.show(watch.look(), time.time_ns()))
        stack.callback(loop.stop, ENDS_WITHIN)
        loop.start()
        typer.echo(f"{robot} is sent to {viewer}. Ctrl-C ends it.")
        with contextlib.suppress(KeyboardInterrupt):
            end.wait()
