"""Role files: one self-contained zenoh configuration per role, with certificate, key and password inside."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gemuco.writing import replacing
from services.errors import ServiceError
from services.security import access
from services.security.authority import Identity, decoded, encoded
from services.security.plan import LINKS, LISTENING, InstallationPlan, dialled, listened
from services.wire.connect import host_and_port, merge, role_file
from services.wire.member import DOORS, EMERGENCY, Member
from services.wire.roles import ESTOP, ROLES, ROUTER, STOPPING, Role
from services.wire.session import common_settings, port

ROUTER_SESSIONS = 256
SERVICE_SESSIONS = 32
PERSON_SESSIONS = 32
"""Each person has this number of sessions at an own port of the router, so no person takes those of another."""
EMERGENCY_PORT = 1
FIRST_PERSON_PORT = 2
"""The port for emergency stops, and that of the first person, counted from the router's port."""
PERSON_OPENS_MS = 2000
"""A person's session has this time [ms] to open, because certificates and passwords need several round trips."""
ROUTER_ACCEPTS_MS = 3000


@dataclass(frozen=True, slots=True)
class Secrets:
    """Identity and password of a member, made once and kept in its role file."""

    identity: Identity
    password: str


def secrets_of(path: Path) -> Secrets:
    """Return the secrets of a role file.

    Raises:
        ServiceError: The file was not made by `gemuco security init`.
    """
    transport = role_file(path).get("transport", {})
    try:
        tls = transport["link"]["tls"]
        identity = Identity(decoded(tls["connect_certificate_base64"]), decoded(tls["connect_private_key_base64"]))
        return Secrets(identity, transport["auth"]["usrpwd"]["password"])
    except (KeyError, TypeError, ValueError):
        raise ServiceError(f"'{path}' is not a role file that `gemuco security init` made.") from None


def configuration(plan: InstallationPlan, name: str, known: Mapping[str, Secrets], authority: bytes) -> dict[str, Any]:
    """Return the role file of a member.

    Args:
        plan: Hosts of all members.
        name: Name of the member, as in `plan.members()`.
        known: Secrets of all members.
        authority: Certificate (PEM) of the authority.
    """
    member = plan.members()[name]
    if name == ROUTER:
        own = _router(plan, known)
    elif ROLES[member.role].is_service:
        own = _service(plan, name, known)
    else:
        own = _person(plan, name)
    common = {
        "metadata": {"gemuco": {"role": member.role, "robots": list(member.robots)}},
        "transport": {
            "link": {"protocols": [plan.protocol], "tls": _tls(known[name].identity, authority)},
            "auth": {"usrpwd": {"user": name, "password": known[name].password}},
        },
    }
    return merge(merge(common_settings(), common), own)


def write(path: Path, content: str, mode: int = 0o600) -> None:
    """Write a file in one step, with the permissions `mode` from the first byte on."""
    with replacing(path, mode) as file:
        file.write(content.encode())


def text_of(content: Mapping[str, Any]) -> str:
    """Return a configuration as text of a role file."""
    return json.dumps(content, indent=1) + "\n"


def _router(plan: InstallationPlan, known: Mapping[str, Secrets]) -> dict[str, Any]:
    members = {name: member for name, member in plan.members().items() if name not in plan.people}
    subjects = {
        name: (access.identity_of(name, dials=True), access.rules_of(ROLES[member.role], member.robots))
        for name, member in members.items()
        if name != ROUTER
    }
    return {
        "mode": "router",
        "metadata": {"gemuco": {DOORS: _doors(plan, known)}},
        "listen": {"endpoints": [_door_endpoint(plan, 0)]},
        "transport": {
            "unicast": {"max_sessions": ROUTER_SESSIONS, "accept_timeout": ROUTER_ACCEPTS_MS},
            "auth": {"usrpwd": {"dictionary": _dictionary(members, known)}},
        },
        "access_control": access.access_control(
            subjects | {ROUTER: (access.identity_of(ROUTER, dials=False), access.THROUGH)}
        ),
        **access.limits(plan.robots),
    }


def _doors(plan: InstallationPlan, known: Mapping[str, Secrets]) -> dict[str, Any]:
    """Return the sections of further sessions of the router: one per person, and one for emergency stops."""
    members = plan.members()
    people = {name: members[name] for name in plan.people}
    operators = {name: member for name, member in people.items() if member.may_ask(member.robots[0], *ESTOP)}

    def door(offset: int, admitted: Mapping[str, Member], role: Role | None = None) -> dict[str, Any]:
        subjects: dict[str, access.Subject] = {
            name: (access.identity_of(name, dials=True), access.rules_of(role or ROLES[member.role], member.robots))
            for name, member in admitted.items()
        }
        subjects[ROUTER] = (access.identity_of(ROUTER, dials=False), access.THROUGH)
        return {
            "listen": _door_endpoint(plan, offset),
            "sessions": PERSON_SESSIONS,
            "dictionary": _dictionary(admitted, known),
            "access_control": access.access_control(subjects),
        }

    return {
        EMERGENCY: door(EMERGENCY_PORT, operators, STOPPING),
        **{name: door(offset, {name: people[name]}) for name, offset in person_ports(plan).items()},
    }


def person_ports(plan: InstallationPlan) -> dict[str, int]:
    """Return the port of each person, counted from the router's port."""
    return {name: FIRST_PERSON_PORT + number for number, name in enumerate(plan.people)}


def _door_endpoint(plan: InstallationPlan, offset: int) -> str:
    port = int(host_and_port(plan.routers[0])[1]) + offset
    return f"{plan.protocol}/{listened(plan.hosts(ROUTER)[0], port)}"


def _dialled(plan: InstallationPlan, offset: int) -> list[str]:
    """Return the endpoints of all routers at the port with this offset."""
    places = (host_and_port(place) for place in plan.routers)
    return [f"{plan.protocol}/{dialled(host, int(port) + offset)}" for host, port in places]


def _service(plan: InstallationPlan, name: str, known: Mapping[str, Secrets]) -> dict[str, Any]:
    service, _, robot = name.partition(".")
    hosts = plan.robots[robot]
    dials = LINKS.get(service, ())
    callers = [other for other, places in LINKS.items() if service in places]
    subjects = {
        **{
            other: (access.identity_of(f"{other}.{robot}", dials=True), access.rules_of(ROLES[other], [robot]))
            for other in callers
        },
        **{
            other: (access.identity_of(f"{other}.{robot}", dials=False), access.rules_of(ROLES[other], [robot]))
            for other in dials
        },
        ROUTER: (
            access.identity_of(ROUTER, dials=False),
            access.mirrored(access.rules_of(ROLES[service], [robot])),
        ),
    }
    listens = [f"{plan.protocol}/{listened(hosts[service], port(robot, service))}"] if service in LISTENING else []
    places = [*(dialled(hosts[other], port(robot, other)) for other in dials), plan.routers[0]]
    own: dict[str, Any] = {
        "mode": "peer",
        "listen": {"endpoints": listens},
        "connect": {"endpoints": [f"{plan.protocol}/{place}" for place in places]},
        "transport": {"unicast": {"max_sessions": SERVICE_SESSIONS}},
        "access_control": access.access_control(subjects),
    }
    if callers:
        names = {f"{other}.{robot}": Member(other, (robot,)) for other in callers}
        own["transport"]["auth"] = {"usrpwd": {"dictionary": _dictionary(names, known)}}
    return own


def _person(plan: InstallationPlan, name: str) -> dict[str, Any]:
    """Return the sections of a person; the other end must show the certificate of the router, not of a service."""
    member = plan.members()[name]
    rules = access.mirrored(access.rules_of(ROLES[member.role], member.robots))
    own: dict[str, Any] = {
        "mode": "client",
        "connect": {"endpoints": _dialled(plan, person_ports(plan)[name])},
        "transport": {"unicast": {"open_timeout": PERSON_OPENS_MS}},
        "access_control": access.access_control({ROUTER: (access.identity_of(ROUTER, dials=False), rules)}),
    }
    if member.may_ask(member.robots[0], *ESTOP):
        own["metadata"] = {"gemuco": {EMERGENCY: _dialled(plan, EMERGENCY_PORT)}}
    return own


def _dictionary(members: Mapping[str, Member], known: Mapping[str, Secrets]) -> dict[str, str]:
    return {name: known[name].password for name in members}


def _tls(identity: Identity, authority: bytes) -> dict[str, Any]:
    certificate, key = encoded(identity.certificate), encoded(identity.key)
    return {
        "root_ca_certificate_base64": encoded(authority),
        "listen_certificate_base64": certificate,
        "listen_private_key_base64": key,
        "connect_certificate_base64": certificate,
        "connect_private_key_base64": key,
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
