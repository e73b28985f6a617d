"""The router (`gemuco router`), through which clients on other machines reach the robots.

It is a zenoh session that routes messages and knows no robots. Samples and commands between HAL and model do not pass
through it, so a robot works without it.
"""

import logging
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from services.health import ROUTER
from services.process.doors import door_settings
from services.process.heartbeat import Heartbeat
from services.process.loop import Loop
from services.process.service import until_stopped
from services.wire.connect import checked_endpoint, split_connect, with_role_files
from services.wire.probe import check_answers
from services.wire.session import ROUTER_PORT, close_session, common_settings, open_with

log = logging.getLogger(__name__)

LISTEN = (f"tcp/127.0.0.1:{ROUTER_PORT}",)
"""A router listens here by default: on this machine only."""
WHO = "the router"
PROBE_RATE = 1.0
"""The router probes its own endpoints at this rate [Hz], so that a health check notices if it does not answer."""
PROBE_ENDS = 0.5
"""Before it ends, a router waits for a probe in progress for at most this time [s], which would report closed ports."""


def router_settings(listen: Iterable[str] = (), connect: Iterable[str] = ()) -> dict[str, Any]:
    """Return the zenoh configuration of a router, as plain data.

    Args:
        listen: Endpoints; by default those of the role file, else `LISTEN`.
        connect: Endpoints of other routers, for a fleet, and the router's role file.

    Raises:
        ServiceError: A role file cannot be read, or an endpoint is malformed.
    """
    endpoints, files = split_connect(connect)
    own = {
        "mode": "router",
        "listen": {"endpoints": list(LISTEN), "exit_on_failure": True},
        "connect": {
            "endpoints": endpoints,
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
        },
        **common_settings(),
    }
    configuration = with_role_files(own, files, endpoints)
    if places := [checked_endpoint(endpoint) for endpoint in listen]:
        configuration["listen"]["endpoints"] = places
    return configuration


def run_router(listen: Iterable[str] = (), connect: Iterable[str] = (), stop: threading.Event | None = None) -> None:
    """Route until SIGTERM, SIGINT or `stop`.

    Args:
        listen: As `router_settings`.
        connect: As `router_settings`.
        stop: Event that ends the router; signals are then not handled.

    Raises:
        ServiceError: A port is taken, an endpoint is malformed, or a role file cannot be read.
    """
    with until_stopped(stop) as stopped, routing(listen, connect) as endpoints:
        print(f"Router listens on {', '.join(endpoints)}.", flush=True)
        probe = Loop("probe", PROBE_RATE, lambda: check_answers(endpoints))
        probe.start()
        try:
            with Heartbeat(ROUTER, "", [probe]):
                stopped.wait()
        finally:
            probe.stop(PROBE_ENDS)


@contextmanager
def routing(listen: Iterable[str] = (), connect: Iterable[str] = ()) -> Iterator[list[str]]:
    """Open the router and its doors for the time of the context, and yield their endpoints.

    Raises:
        ServiceError: As `run_router`.
    """
    configuration = router_settings(listen, connect)
    sessions = []
    endpoints: list[str] = []
    try:
        for name, door in {"": configuration, **door_settings(configuration)}.items():
            sessions.append(open_with(door, f"the router's door for {name}" if name else WHO))
            endpoints += door["listen"]["endpoints"]
        yield endpoints
    finally:
        for session in reversed(sessions):
            close_session(session)
