"""Open a zenoh session: peers on loopback whose address and ports are computed from the robot's name.

Every service listens on one port and connects to the services before it in `keys.SERVICES`, so that each pair has one
connection and either may start first; a client listens nowhere and connects to all. Multicast and gossip are off:
nothing leaves the machine unless `connect` says so. Its items are endpoints, such as a router's
(`tcp/192.168.0.5:7447`), and role files of `gemuco security init`: zenoh configurations that are merged into ours.
"""

import atexit
import ipaddress
import json
import logging
import secrets
import threading
import zlib
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any

import zenoh

from services.errors import NotAllowed, ServiceError, ServiceUnavailable
from services.wire import keys
from services.wire.connect import (
    certificate_end,
    expiry_warning,
    host_and_port,
    split_connect,
    with_password_file,
    with_role_files,
)
from services.wire.member import member_in
from services.wire.messages import MAX_BYTES
from services.wire.probe import is_listening
from services.wire.roles import PEOPLE

log = logging.getLogger(__name__)

FIRST_PORT = 20000
PORT_GROUPS = 2500
"""This number of groups gives ports 20000 to 32499: registered, and below Linux's ephemeral ports (32768 and up)."""
CLIENT = "client"
ROUTER_PORT = 7447

OPEN_WITHIN = 3.0
"""A client waits at most this long [s] for its router."""
LEASE_MS = 900
"""A frozen or unreachable process counts as alive for this time; one that dies is noticed within milliseconds."""
OPEN_MS, LOCAL_OPEN_MS = 500, 2500
"""A handshake that gets no answer is repeated after this time: soon if packets may be lost, and late between processes
of one machine, where none is lost but stops are usual. A session that closes waits for its handshakes.

zenoh 1.10 keeps half of a connection if the process that connects is stopped within its handshake until the time has
passed. The other half refuses every later connection of this session, for ever, unless `LEASE_MS` has passed for it.
"""
MAX_RECEIVED = 4 * MAX_BYTES
"""Longer messages [bytes] are dropped by zenoh; shorter ones above `MAX_BYTES` are counted as malformed."""
CLOSE_WITHIN = 3.0
"""A program waits at most this long [s] for a session to close."""
EXIT_WITHIN = 10.0
"""And this long at its end."""


def port(robot: str, service: str) -> int:
    """Return the loopback port on which a service of this robot listens."""
    group = zlib.crc32(robot.encode()) % PORT_GROUPS
    return FIRST_PORT + group * len(keys.SERVICES) + keys.SERVICES.index(service)


def address(robot: str) -> str:
    """Return the loopback address of a robot: all of 127.0.0.0/8 is this machine's.

    Address and port together hold the whole hash of the name. In one of 9000 fleets of 1000 robots on one machine two
    robots share them; with the port alone it would be one of 13 fleets of 20 robots.
    """
    rest = zlib.crc32(robot.encode()) // PORT_GROUPS
    return f"127.{1 + (rest >> 16)}.{rest >> 8 & 255}.{rest & 255}"


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach the host."""
    try:
        number = ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        return host == "localhost"
    if isinstance(number, ipaddress.IPv6Address) and number.ipv4_mapped is not None:
        number = number.ipv4_mapped
    return number.is_loopback


def endpoint(robot: str, service: str) -> str:
    """Return the zenoh endpoint of a service of this robot."""
    return f"tcp/{address(robot)}:{port(robot, service)}"


def new_boot() -> int:
    """Return a random number that identifies one run of a process."""
    return secrets.randbits(53) or 1


def settings(robot: str, role: str, connect: Iterable[str] = ()) -> dict[str, Any]:
    """Return the zenoh configuration of a service or client of this robot, as plain data.

    Services are peers, which zenoh does not link with each other through a router. A client of a robot on another
    machine connects only to the endpoints of `connect`.

    Raises:
        ServiceError: The role is unknown, or a role file cannot be read.
    """
    roles = (*keys.SERVICES, CLIENT)
    if role not in roles:
        raise ServiceError(f"'{role}' is not a role in a session. Known roles: {', '.join(roles)}.")
    endpoints, files = split_connect(connect)
    is_remote = role == CLIENT and bool(endpoints or files)
    peers = [] if is_remote else [endpoint(robot, peer) for peer in keys.SERVICES[: roles.index(role)]]
    own: dict[str, Any] = {
        "mode": "client" if is_remote else "peer",
        "listen": {"endpoints": [] if role == CLIENT else [endpoint(robot, role)], "exit_on_failure": True},
        "connect": {
            "endpoints": [*peers, *endpoints],
            "timeout_ms": round(1e3 * OPEN_WITHIN) if is_remote else -1,
            "exit_on_failure": is_remote,
            "retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
        },
        **common_settings(),
    }
    if not endpoints and not files:
        own["transport"]["unicast"]["open_timeout"] = LOCAL_OPEN_MS
    configuration = with_role_files(own, files, endpoints)
    _check_member(configuration, robot, role)
    return configuration


def _check_member(configuration: dict[str, Any], robot: str, role: str) -> None:
    """Raise `NotAllowed` if the role file is for another role or another robot."""
    member = member_in(configuration)
    if not member.role:
        return
    if not member.is_for(robot):
        raise NotAllowed(f"This role file is for robot {', '.join(member.robots)}, not for '{robot}'.")
    if member.role != role and not (role == CLIENT and member.role in PEOPLE):
        expected = " or ".join(PEOPLE) if role == CLIENT else f"{role}.{robot}"
        raise NotAllowed(f"This role file is for role '{member.role}'; here it takes that of {expected}.")


def common_settings() -> dict[str, Any]:
    """Return the settings that all sessions share, a router's too."""
    return {
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": True},
        "transport": {
            "unicast": {"open_timeout": OPEN_MS, "accept_timeout": 1000},
            "link": {"tx": {"lease": LEASE_MS}, "rx": {"max_message_size": MAX_RECEIVED}},
            # A receiver that is descheduled for 100 ms loses queries that travel by shared memory.
            "shared_memory": {"enabled": False},
        },
    }


def unsecured_endpoints(configuration: dict[str, Any]) -> list[str]:
    """Return the endpoints at which other machines may connect without a certificate."""
    link = configuration.get("transport", {}).get("link", {})
    is_mutual = bool(link.get("tls", {}).get("enable_mtls"))
    return [
        endpoint
        for endpoint in configuration.get("listen", {}).get("endpoints", ())
        if not is_loopback(host_and_port(endpoint.partition("/")[2])[0])
        and not (is_mutual and endpoint.startswith(("tls/", "quic/")))
        and not endpoint.startswith("unixsock")
    ]


def open_session(robot: str, role: str, connect: Iterable[str] = ()) -> zenoh.Session:
    """Open a session; a service never waits for the other services, which may start and stop at any time.

    Args:
        robot: The robot's name.
        role: One of `keys.SERVICES`, or `client`.
        connect: Endpoints (`tcp/192.168.0.5:7447`) and role files.

    Raises:
        ServiceUnavailable: A client's router does not run.
        NotAllowed: The router refuses the client, or the role file is for another role or robot.
        ServiceError: The service's port is taken, or an endpoint is malformed.
    """
    who = f"a client of robot '{robot}'" if role == CLIENT else f"the '{role}' service of robot '{robot}'"
    return open_with(settings(robot, role, connect), who)


def open_with(configuration: dict[str, Any], who: str) -> zenoh.Session:
    """Open a session with this configuration; `who` names it in errors.

    Raises:
        ServiceUnavailable, NotAllowed, ServiceError: As `open_session`.
    """
    for place in unsecured_endpoints(configuration):
        log.warning("*** %s LISTENS ON %s WITHOUT SECURITY: see `gemuco security init` ***", who, place)
    if warning := expiry_warning(configuration):
        log.warning("%s", warning)
    try:
        with with_password_file(configuration) as complete:
            return zenoh.open(zenoh.Config.from_json5(json.dumps(complete)))
    except zenoh.ZError as error:
        if "Address already in use" in str(error):
            number = _taken_port(configuration["listen"]["endpoints"], str(error))
            text = f"Port {number} of {who} is taken by another process. See which: `ss -lntup 'sport = :{number}'`."
            if configuration["mode"] != "router":
                text += " If the names of two robots give the same address, one of them needs another name."
            raise ServiceError(text) from None
        if configuration["mode"] == "client":
            raise _no_link(configuration, who) from None
        reason = str(error).split(" at /")[0].rstrip(".")
        places = ", ".join(configuration["listen"]["endpoints"])
        raise ServiceError(f"No zenoh session for {who}{f' on {places}' if places else ''}: {reason}.") from None


def _taken_port(endpoints: list[str], text: str) -> str:
    """Return the port that zenoh reports as taken."""
    named = [endpoint for endpoint in endpoints if endpoint in text] or endpoints
    return host_and_port(named[0])[1]


def _no_link(configuration: dict[str, Any], who: str) -> ServiceError:
    """Return the reason why a client got no link; zenoh reports an absent router and a refusal alike."""
    places = configuration["connect"]["endpoints"]
    listening = [place for place in places if is_listening(place)]
    if not listening:
        return ServiceUnavailable(
            f"No zenoh session for {who}: no process listens at {', '.join(places)}. Is `gemuco router` running?"
        )
    role, until = member_in(configuration).role, certificate_end(configuration)
    if until is not None and until <= datetime.now(UTC):
        hint = expiry_warning(configuration)
    elif role:
        hint = (
            f"Is the role file ('{role}') of the same `gemuco security init` as the router's, and not renewed since? "
            "The router, or this person's share of it, may also be full, or its certificate may not name this address."
        )
    else:
        hint = "It may want a role file (`--connect ROLE.json`), as `gemuco security init` makes them."
    return NotAllowed(
        f"No zenoh session for {who}: {', '.join(listening)} refused it. {hint} "
        f"If the router is only starting, or busy, it took longer than {OPEN_MS / 1e3:g} s: try again."
    )


def close_session(session: zenoh.Session) -> None:
    """Close a session within `CLOSE_WITHIN`: zenoh may block for 10 s on a lossy link, for which only exit waits."""
    closing = threading.Thread(target=session.close, name="close session", daemon=True)
    closing.start()
    closing.join(CLOSE_WITHIN)
    if closing.is_alive():
        atexit.register(closing.join, EXIT_WITHIN)  # an interpreter that ends beside it aborts the process
