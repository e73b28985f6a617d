"""Open a zenoh session: peers on loopback that find each other by ports made from the robot's name.

Every service listens on one port and connects to the services before it in `keys.SERVICES`, so that each pair has one
connection and either may start first; a client listens nowhere and connects to all. Multicast and gossip are off:
nothing leaves the machine unless `connect` names an endpoint.
"""

import json
import secrets
import threading
import zlib
from collections.abc import Iterable
from typing import Any

import zenoh

from services import keys
from services.errors import ServiceError
from services.messages import MAX_BYTES

FIRST_PORT = 20000
PORT_GROUPS = 2500
"""Ports 20000 to 32499: registered range, and below Linux's ephemeral ports (32768 and up)."""
CLIENT = "client"
LEASE_MS = 1000
"""How long a frozen or unreachable process counts as alive; one that dies is noticed within milliseconds."""
MAX_RECEIVED = 4 * MAX_BYTES
"""Longer ones are dropped before they arrive here; those in between are counted as malformed."""
CLOSE_WITHIN = 2.0
"""How long [s] to wait for a session to close."""


def port(robot: str, service: str) -> int:
    """The loopback port on which a service of this robot listens."""
    group = zlib.crc32(robot.encode()) % PORT_GROUPS
    return FIRST_PORT + group * len(keys.SERVICES) + keys.SERVICES.index(service)


def endpoint(robot: str, service: str) -> str:
    """The zenoh endpoint of a service of this robot."""
    return f"tcp/127.0.0.1:{port(robot, service)}"


def new_boot() -> int:
    """A random number that tells one run of a process from the next."""
    return secrets.randbits(53) or 1


def settings(robot: str, role: str, connect: Iterable[str] = ()) -> dict[str, Any]:
    """The zenoh configuration of a service or client of this robot, as plain data."""
    roles = (*keys.SERVICES, CLIENT)
    if role not in roles:
        raise ServiceError(f"'{role}' is not a role in a session. Known roles: {', '.join(roles)}.")
    peers = keys.SERVICES[: roles.index(role)]
    return {
        "mode": "peer",
        "listen": {"endpoints": [] if role == CLIENT else [endpoint(robot, role)], "exit_on_failure": True},
        "connect": {
            "endpoints": [*(endpoint(robot, peer) for peer in peers), *connect],
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
        },
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": True},
        "transport": {
            # Lost handshakes are repeated after open_timeout: 10 s by default.
            "unicast": {"open_timeout": 500, "accept_timeout": 1000},
            "link": {"tx": {"lease": LEASE_MS}, "rx": {"max_message_size": MAX_RECEIVED}},
            # A receiver that is descheduled for 100 ms loses queries that travel by shared memory.
            "shared_memory": {"enabled": False},
        },
    }


def open_session(robot: str, role: str, connect: Iterable[str] = ()) -> zenoh.Session:
    """Open a session; it never waits for the others, who may come, die and come back.

    Args:
        robot: The robot's name.
        role: One of `keys.SERVICES`, or `client`.
        connect: More zenoh endpoints, such as a router's (`tcp/192.168.0.5:7447`).

    Raises:
        ServiceError: The service's port is taken, or an endpoint is malformed.
    """
    configuration = zenoh.Config.from_json5(json.dumps(settings(robot, role, connect)))
    try:
        return zenoh.open(configuration)
    except zenoh.ZError as error:
        if "Address already in use" in str(error):
            raise ServiceError(
                f"Port {port(robot, role)} of the '{role}' service of robot '{robot}' is taken by another process. "
                f"See which with `ss -ltnp 'sport = :{port(robot, role)}'`."
            ) from None
        reason = str(error).split(" at /")[0].rstrip(".")
        raise ServiceError(f"No zenoh session for '{role}' of robot '{robot}': {reason}.") from None


def close_session(session: zenoh.Session) -> None:
    """Close a session, and do not wait longer than `CLOSE_WITHIN`: zenoh may block for 10 s on a lossy link."""
    closing = threading.Thread(target=session.close, name="close session", daemon=True)
    closing.start()
    closing.join(CLOSE_WITHIN)
