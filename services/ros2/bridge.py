"""`gemuco ros2 ROBOT`: publish a robot in ROS 2 until Ctrl-C, in a process and on a session of its own."""

import logging
import threading
import time
from collections.abc import Iterable
from contextlib import ExitStack

import typer

from services.errors import ServiceError, ServiceUnavailable
from services.process.loop import Loop
from services.process.service import until_stopped
from services.ros2 import messages
from services.ros2.diagnostics import DIAGNOSTIC_ARRAY, DIAGNOSTICS, OK, WARN, diagnostics, element_status, states
from services.ros2.node import Network, Node
from services.ros2.outgoing import Outgoing
from services.watch.frames import Frames
from services.watch.robot_watch import RobotWatch
from services.watch.signal_rows import Kind, SignalRow, signal_rows
from services.watch.snapshot import RobotSnapshot

log = logging.getLogger(__name__)

DIAGNOSTICS_EVERY = 1.0
"""The diagnostics are published at this interval [s], and at once when an element is lost or back."""
TRY_EVERY = 1.0
"""The router of ROS 2 is tried again at this interval [s]."""


def described_rows(snapshot: RobotSnapshot) -> list[SignalRow]:
    """Return the rows of a robot; before `describe` has answered, when elements have numbers as names, none."""
    return [row for row in signal_rows(snapshot) if row.unit]


class Bridge:
    """A robot as a node of ROS 2.

    Args:
        node: The open node.
        watch: Source of the robot's messages.
        frames: Frames of the robot's URDF; None without one.
    """

    def __init__(self, node: Node, watch: RobotWatch, frames: Frames | None) -> None:
        self._node, self._watch = node, watch
        self._outgoing = Outgoing(node, watch.robot, frames)
        self._diagnostics = node.publisher(DIAGNOSTICS, DIAGNOSTIC_ARRAY)
        node.serve(f"/{watch.robot}/estimate", "diagnostic_msgs/srv/SelfTest", self._answer_estimate)
        node.serve(f"/{watch.robot}/stop", "std_srvs/srv/Trigger", self._answer_stop)
        self._due = 0.0
        self._states: object = None

    def tick(self) -> None:
        """Publish what is new."""
        snapshot = self._watch.look()
        rows = described_rows(snapshot)
        self._outgoing.publish(snapshot, rows)
        now, before = time.monotonic(), self._states
        self._states = states(rows)
        if now >= self._due or (before is not None and self._states != before):
            self._due = now + DIAGNOSTICS_EVERY
            self._outgoing.check_names()
            self._diagnostics.put(diagnostics(snapshot, rows, self._status()))

    def _answer_estimate(self, _: messages.Message) -> messages.Message:
        """Return a status per element with its value, measured or estimated, and whether all are known."""
        snapshot = self._watch.look()
        rows = described_rows(snapshot)
        known = [row.kind in (Kind.MEASURED, Kind.ESTIMATED) for row in rows]
        statuses = [element_status(snapshot.robot, row) for row in rows]
        return {"id": snapshot.robot, "passed": int(bool(known) and all(known)), "status": statuses}

    def _answer_stop(self, _: messages.Message) -> messages.Message:
        """Stop the robot as its file says, as every client may."""
        client = self._watch.client
        if client is None:
            return {"success": False, "message": "The bridge has no connection to the robot."}
        try:
            answer = client.stop()
        except ServiceError as error:
            return {"success": False, "message": str(error)}
        return {"success": True, "message": f"The robot's mode is '{answer.get('mode', 'not known')}'."}

    def _status(self) -> messages.Message:
        """Return the status of the bridge itself."""
        problems = [*self._outgoing.taken.values(), *self._outgoing.doubled()]
        robot = self._watch.robot
        values = {"published": self._outgoing.published, "topics of others": len(problems)}
        text = " ".join(problems) or "running"
        return messages.status(f"{robot}: ros2 bridge", robot, WARN if problems else OK, text, values)


def run_bridge(
    robot: str,
    network: Network,
    connect: Iterable[str] = (),
    frames: Frames | None = None,
    rate: float = 50.0,
    stop: threading.Event | None = None,
) -> None:
    """Publish a robot until SIGTERM, SIGINT or `stop`; robot, model and router may start later and may restart.

    Args:
        robot: Name of the robot.
        network: The part of ROS 2 to join.
        connect: Endpoints of the robot's own network, and role files.
        frames: Frames of its URDF; None without one.
        rate: Highest rate of each topic [Hz].
        stop: Event that ends the bridge in place of the signals.

    Raises:
        NameTaken: The domain has such a node already.
        ServiceError: An endpoint is malformed.
    """
    watch = RobotWatch(robot, connect)
    with until_stopped(stop) as end, ExitStack() as stack:
        node = _entered(stack, robot, network, end)
        if node is None:
            return
        stack.callback(watch.stop)
        watch.start()
        bridge = Bridge(node, watch, frames)
        typer.echo(f"{node.name} in ROS domain {network.domain} at {network.router}. Ctrl-C ends it.")
        loop = Loop("ros2", rate, bridge.tick)
        stack.callback(loop.stop, DIAGNOSTICS_EVERY)
        loop.start()
        _report_links(node, end)


def _entered(stack: ExitStack, robot: str, network: Network, end: threading.Event) -> Node | None:
    """Return the open node as soon as the router answers; None if the bridge ends before."""
    text = ""
    while not end.is_set():
        try:
            return stack.enter_context(Node(f"/{robot}/gemuco", network))
        except ServiceUnavailable as error:
            if str(error) != text:
                text = str(error)
                log.warning("%s The bridge continues when it does.", text)
            end.wait(TRY_EVERY)
    return None


def _report_links(node: Node, end: threading.Event) -> None:
    """Log when the router of ROS 2 goes and returns, until the bridge ends."""
    was_linked = True
    while not end.wait(TRY_EVERY):
        if (is_linked := node.is_linked) != was_linked:
            was_linked = is_linked
            state = "is back" if is_linked else "is gone; the bridge continues when it is back"
            log.warning("The router of ROS 2 at %s %s.", node.network.router, state)
