"""`gemuco metrics`: serve the metrics of robots over HTTP until Ctrl-C."""

import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack

import typer
from prometheus_client import CollectorRegistry, start_http_server

from services.errors import ServiceError
from services.metrics.collector import RobotCollector
from services.process.service import until_stopped
from services.watch.fleet_watch import FleetWatch
from services.watch.robot_watch import RobotWatch
from services.watch.snapshot import RobotSnapshot
from services.wire.session import is_loopback

LOOK_EVERY = 1.0
"""Robots that were started on this machine are looked up at this interval [s]."""


def serve_metrics(
    robots: Sequence[str], host: str, port: int, connect: Iterable[str] = (), stop: threading.Event | None = None
) -> None:
    """Serve metrics until SIGTERM, SIGINT or `stop`.

    Args:
        robots: Names of robots, each watched in detail; none for all robots, of which only the statuses are read.
        host: Address to bind.
        port: Port to bind; 0 for any.
        connect: Endpoints, such as a router's, and role files.
        stop: Event that ends it in place of the signals.

    Raises:
        ServiceError: The port is taken, or no session opens.
    """
    connect = tuple(connect)
    registry = CollectorRegistry()
    with until_stopped(stop) as end, ExitStack() as stack:
        fleet: FleetWatch | None = None
        watches = [RobotWatch(robot, connect) for robot in dict.fromkeys(robots)]
        if watches:
            for watch in watches:
                stack.callback(watch.stop)
                watch.start()
        else:
            fleet = stack.enter_context(FleetWatch(connect))

        def snapshots() -> Iterator[RobotSnapshot]:
            yield from fleet.snapshots() if fleet is not None else (watch.look() for watch in watches)

        registry.register(RobotCollector(snapshots))
        try:
            server, thread = start_http_server(port, host, registry)
        except OSError as error:
            raise ServiceError(f"The metrics cannot be served at {host}:{port}: {error.strerror}.") from None
        stack.callback(thread.join, LOOK_EVERY)
        stack.callback(server.shutdown)
        if not is_loopback(host):
            typer.echo(f"*** EVERYONE WHO REACHES {host} CAN READ THE METRICS ***", err=True)
        typer.echo(f"http://{host}:{server.server_port}/metrics  Ctrl-C ends it.")
        while not end.wait(LOOK_EVERY):
            if fleet is not None:
                fleet.look()
