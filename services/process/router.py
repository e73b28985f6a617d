"""`gemuco router`: the one place through which everybody but a robot's own services reaches the robots.

It is a zenoh session that routes, and knows nothing of robots. Samples and commands between HAL and model do not pass
through it, so that nothing stops when it does.
"""

import logging
import threading
from collections.abc import Iterable
from typing import Any

from services.health import ROUTER
from services.process.heartbeat import Heartbeat
from services.process.loop import Loop
from services.process.service import until_stopped
from services.wire.connect import checked_endpoint, split_connect, with_role_files
from services.wire.probe import check_answers
from services.wire.session import ROUTER_PORT, close_session, common_settings, open_with

log = logging.getLogger(__name__)

LISTEN = (f"tcp/127.0.0.1:{ROUTER_PORT}",)
"""Where a router listens if nobody says otherwise: this machine only."""
WHO = "the router"
RING_RATE = 1.0
"""How often [Hz] the router rings at its own door, so that a health check can tell whether it still answers."""


def router_settings(listen: Iterable[str] = (), connect: Iterable[str] = ()) -> dict[str, Any]:
    """The zenoh configuration of a router, as plain data.

    Args:
        listen: Endpoints; those of the role file if not given, else `LISTEN`.
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
    found = with_role_files(own, files, endpoints)
    if chosen := [checked_endpoint(one) for one in listen]:
        found["listen"]["endpoints"] = chosen
    return found


def run_router(listen: Iterable[str] = (), connect: Iterable[str] = (), stop: threading.Event | None = None) -> None:
    """Route until SIGTERM, SIGINT or `stop`.

    Args:
        listen: As `router_settings`.
        connect: As `router_settings`.
        stop: An event that ends it; signals are then left alone.

    Raises:
        ServiceError: A port is taken, an endpoint is malformed, or a role file cannot be read.
    """
    configuration = router_settings(listen, connect)
    with until_stopped(stop) as told:
        session = open_with(configuration, WHO)
        print(f"Router listens on {', '.join(configuration['listen']['endpoints'])}.", flush=True)
        door = Loop("door", RING_RATE, lambda: check_answers(configuration["listen"]["endpoints"]))
        door.start()
        try:
            with Heartbeat(ROUTER, "", [door]):
                told.wait()
        finally:
            door.stop(0.0)
            close_session(session)
