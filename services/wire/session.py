"""Open a zenoh session: peers on loopback that find each other by an address and ports made from the robot's name.

Every service listens on one port and connects to the services before it in `keys.SERVICES`, so that each pair has one
connection and either may start first; a client listens nowhere and connects to all. Multicast and gossip are off:
nothing leaves the machine unless `connect` says so. It holds endpoints, such as a router's (`tcp/192.168.0.5:7447`),
and role files: zenoh configurations, as `gemuco security init` makes them, that are laid over ours.
"""

import json
import logging
import secrets
import threading
import zlib
from collections.abc import Iterable
from typing import Any

import zenoh

from services.errors import NotAllowed, ServiceError, ServiceUnavailable
from services.wire import keys
from services.wire.connect import laid_over, sorted_out
from services.wire.doorbell import is_anybody_at
from services.wire.entering import expiry, usable
from services.wire.member import told_by
from services.wire.messages import MAX_BYTES
from services.wire.roles import PEOPLE

log = logging.getLogger(__name__)

FIRST_PORT = 20000
PORT_GROUPS = 2500
"""Ports 20000 to 32499: registered range, and below Linux's ephemeral ports (32768 and up)."""
CLIENT = "client"
ROUTER_PORT = 7447
LOOPBACK = ("127.", "localhost", "[::1]")
OPEN_WITHIN = 3.0
"""How long [s] a client waits for its router."""
LEASE_MS = 900
"""How long a frozen or unreachable process counts as alive; one that dies is noticed within milliseconds."""
ANSWER_MS = 500
"""How long to wait for the other side's part of a handshake; one that was lost is then repeated."""
MAX_RECEIVED = 4 * MAX_BYTES
"""Longer ones are dropped before they arrive here; those in between are counted as malformed."""
CLOSE_WITHIN = 2.0
"""How long [s] to wait for a session to close."""


def port(robot: str, service: str) -> int:
    """The loopback port on which a service of this robot listens."""
    group = zlib.crc32(robot.encode()) % PORT_GROUPS
    return FIRST_PORT + group * len(keys.SERVICES) + keys.SERVICES.index(service)


def address(robot: str) -> str:
    """The loopback address of a robot: all of 127.0.0.0/8 is this machine's.

    Address and port together are the whole hash, so that names differ in them as far as it does: by chance two of a
    thousand robots on one machine share them once in nine thousand fleets. With the port alone, two of twenty would in
    one fleet of thirteen.
    """
    rest = zlib.crc32(robot.encode()) // PORT_GROUPS
    return f"127.{1 + (rest >> 16)}.{rest >> 8 & 255}.{rest & 255}"


def endpoint(robot: str, service: str) -> str:
    """The zenoh endpoint of a service of this robot."""
    return f"tcp/{address(robot)}:{port(robot, service)}"


def new_boot() -> int:
    """A random number that tells one run of a process from the next."""
    return secrets.randbits(53) or 1


def settings(robot: str, role: str, connect: Iterable[str] = ()) -> dict[str, Any]:
    """The zenoh configuration of a service or client of this robot, as plain data.

    Services are peers, which zenoh does not link with each other through a router. A client of a robot that is
    elsewhere enters through the one place that `connect` names, and has no other links.

    Raises:
        ServiceError: Not a role, or a role file cannot be read.
    """
    roles = (*keys.SERVICES, CLIENT)
    if role not in roles:
        raise ServiceError(f"'{role}' is not a role in a session. Known roles: {', '.join(roles)}.")
    endpoints, files = sorted_out(connect)
    is_remote = role == CLIENT and bool(endpoints or files)
    peers = [] if is_remote else [endpoint(robot, peer) for peer in keys.SERVICES[: roles.index(role)]]
    found: dict[str, Any] = {
        "mode": "client" if is_remote else "peer",
        "listen": {"endpoints": [] if role == CLIENT else [endpoint(robot, role)], "exit_on_failure": True},
        "connect": {
            "endpoints": [*peers, *endpoints],
            "timeout_ms": round(1e3 * OPEN_WITHIN) if is_remote else -1,
            "exit_on_failure": is_remote,
            "retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
        },
        **plain_settings(),
    }
    found = laid_over(found, files, endpoints)
    _check_member(found, robot, role)
    return found


def _check_member(found: dict[str, Any], robot: str, role: str) -> None:
    """Raise `NotAllowed` if the role file is for another role or another robot."""
    member = told_by(found)
    if not member.role:
        return
    if not member.is_for(robot):
        raise NotAllowed(f"This role file is for robot {', '.join(member.robots)}, not for '{robot}'.")
    if member.role != role and not (role == CLIENT and member.role in PEOPLE):
        wanted = " or ".join(PEOPLE) if role == CLIENT else f"{role}.{robot}"
        raise NotAllowed(f"This role file is for role '{member.role}'; here it takes that of {wanted}.")


def plain_settings() -> dict[str, Any]:
    """What all sessions have in common, a router's too."""
    return {
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": True},
        "transport": {
            # 10 s by default.
            "unicast": {"open_timeout": ANSWER_MS, "accept_timeout": 1000},
            "link": {"tx": {"lease": LEASE_MS}, "rx": {"max_message_size": MAX_RECEIVED}},
            # A receiver that is descheduled for 100 ms loses queries that travel by shared memory.
            "shared_memory": {"enabled": False},
        },
    }


def open_to_all(configuration: dict[str, Any]) -> list[str]:
    """Endpoints at which other machines may enter without a certificate."""
    link = configuration.get("transport", {}).get("link", {})
    is_mutual = bool(link.get("tls", {}).get("enable_mtls"))
    return [
        one
        for one in configuration.get("listen", {}).get("endpoints", ())
        if not one.partition("/")[2].startswith(LOOPBACK)
        and not (is_mutual and one.startswith(("tls/", "quic/")))
        and not one.startswith("unixsock")
    ]


def open_session(robot: str, role: str, connect: Iterable[str] = ()) -> zenoh.Session:
    """Open a session; a service never waits for the others, who may come, die and come back.

    Args:
        robot: The robot's name.
        role: One of `keys.SERVICES`, or `client`.
        connect: Endpoints (`tcp/192.168.0.5:7447`) and role files.

    Raises:
        ServiceUnavailable: A client's router is not there.
        NotAllowed: It is there and does not let the client in, or the role file is for somebody else.
        ServiceError: The service's port is taken, or an endpoint is malformed.
    """
    who = f"a client of robot '{robot}'" if role == CLIENT else f"the '{role}' service of robot '{robot}'"
    return opened(settings(robot, role, connect), who)


def opened(configuration: dict[str, Any], who: str) -> zenoh.Session:
    """Open a session of this configuration; `who` is for the errors.

    Raises:
        ServiceUnavailable, NotAllowed, ServiceError: As `open_session`.
    """
    for one in open_to_all(configuration):
        log.warning("*** %s LISTENS ON %s FOR ANYBODY, WITHOUT SECURITY: see `gemuco security init` ***", who, one)
    if said := expiry(configuration):
        log.warning("%s", said)
    try:
        with usable(configuration) as taken:
            return zenoh.open(zenoh.Config.from_json5(json.dumps(taken)))
    except zenoh.ZError as error:
        if "Address already in use" in str(error):
            number = _taken(configuration["listen"]["endpoints"], str(error))
            text = f"Port {number} of {who} is taken by another process. See which: `ss -lntup 'sport = :{number}'`."
            if configuration["mode"] != "router":
                text += " If it is another robot's whose name makes the same address, one of both needs another name."
            raise ServiceError(text) from None
        if configuration["mode"] == "client":
            raise _not_let_in(configuration, who) from None
        reason = str(error).split(" at /")[0].rstrip(".")
        places = ", ".join(configuration["listen"]["endpoints"])
        raise ServiceError(f"No zenoh session for {who}{f' on {places}' if places else ''}: {reason}.") from None


def _taken(listens: list[str], text: str) -> str:
    """The port that zenoh says is taken."""
    named = [one for one in listens if one in text] or listens
    return named[0].rpartition(":")[2]


def _not_let_in(configuration: dict[str, Any], who: str) -> ServiceError:
    """Why a client got no link: zenoh does not tell who is not there from who does not let us in."""
    places = configuration["connect"]["endpoints"]
    there = [one for one in places if is_anybody_at(one)]
    if not there:
        where = ", ".join(places)
        return ServiceUnavailable(f"No zenoh session for {who}: nobody is at {where}. Is `gemuco router` running?")
    role = told_by(configuration).role
    hint = (
        expiry(configuration)
        or f"Is the role file ('{role}') of the same `gemuco security init` as the router's, and not renewed since? "
        "The router may also be full, or the address be none that its certificate names."
        if role
        else "It may want a role file (`--connect ROLE.json`), as `gemuco security init` makes them."
    )
    return NotAllowed(
        f"No zenoh session for {who}: somebody is at {', '.join(there)}, and does not let it in. {hint} "
        f"If it is only starting, or its machine is busy, it took longer than {ANSWER_MS / 1e3:g} s: try again."
    )


def close_session(session: zenoh.Session) -> None:
    """Close a session, and do not wait longer than `CLOSE_WITHIN`: zenoh may block for 10 s on a lossy link."""
    closing = threading.Thread(target=session.close, name="close session", daemon=True)
    closing.start()
    closing.join(CLOSE_WITHIN)
