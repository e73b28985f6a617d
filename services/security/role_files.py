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
from services.wire.member import Member
from services.wire.roles import ROLES, ROUTER
from services.wire.session import common_settings, port

ROUTER_SESSIONS = 256
SERVICE_SESSIONS = 32
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
        own = _person(plan)
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
    members = plan.members()
    subjects = {
        name: (access.identity_of(name, dials=True), access.rules_of(ROLES[member.role], member.robots))
        for name, member in members.items()
        if name != ROUTER
    }
    place, host = plan.routers[0], plan.hosts(ROUTER)[0]
    return {
        "mode": "router",
        "listen": {"endpoints": [f"{plan.protocol}/{listened(host, host_and_port(place)[1])}"]},
        "transport": {
            "unicast": {"max_sessions": ROUTER_SESSIONS, "accept_timeout": ROUTER_ACCEPTS_MS},
            "auth": {"usrpwd": {"dictionary": _dictionary(members, known)}},
        },
        "access_control": access.access_control(
            subjects | {ROUTER: (access.identity_of(ROUTER, dials=False), access.THROUGH)}
        ),
        **access.limits(plan.robots),
    }


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


def _person(plan: InstallationPlan) -> dict[str, Any]:
    return {
        "mode": "client",
        "connect": {"endpoints": [f"{plan.protocol}/{place}" for place in plan.routers]},
        "transport": {"unicast": {"open_timeout": PERSON_OPENS_MS}},
    }


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
