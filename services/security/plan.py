"""Hosts, robots and people of a secured installation: `plan.json` of `gemuco security init`, without secrets."""

import ipaddress
import re
from pathlib import Path
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from services.errors import ServiceError
from services.wire.connect import host_and_port
from services.wire.member import ALL, EMERGENCY, Member
from services.wire.roles import PEOPLE, ROLES, ROUTER
from services.wire.session import ROUTER_PORT, is_loopback

FILE = "plan.json"
LISTENING = ("simulator", "hal", "vision", "model")
"""These services accept direct links from other services."""
LINKS = {"vision": ("simulator",), "model": ("hal", "vision"), "recorder": LISTENING}
"""Each service opens links to these services, in addition to the router; the HAL opens no other link."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
_HOST = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?")


class Person(BaseModel):
    """A person with a role file."""

    model_config = ConfigDict(extra="forbid")
    role: Literal["operator", "viewer"]
    robots: list[str] = Field(default_factory=lambda: [ALL])


class InstallationPlan(BaseModel):
    """Hosts of all members.

    Attributes:
        protocol: Protocol of every link.
        days: Validity of a certificate [days].
        routers: HOST:PORT of each router; services connect to the first, people to the first that answers.
        robots: Robot -> service -> host.
        people: Name -> role and robots.
    """

    model_config = ConfigDict(extra="forbid")
    protocol: Literal["quic", "tls"] = "quic"
    days: int = Field(730, ge=1)
    routers: list[str] = Field(min_length=1)
    robots: dict[str, dict[str, str]] = Field(default_factory=dict)
    people: dict[str, Person] = Field(
        default_factory=lambda: {"operator": Person(role="operator"), "viewer": Person(role="viewer")}
    )

    @field_validator("robots", "people")
    @classmethod
    def _check_names(cls, entries: dict[str, object]) -> dict[str, object]:
        for name in entries:
            if not _NAME.fullmatch(name) or name in ROLES.keys() - set(PEOPLE) or name in (ROUTER, EMERGENCY):
                raise ValueError(f"'{name}' cannot be a name here: use letters, digits, _ and -, but no service's name")
        return entries

    @field_validator("robots")
    @classmethod
    def _check_hosts(cls, entries: dict[str, dict[str, str]]) -> dict[str, dict[str, str]]:
        for robot, hosts in entries.items():
            if set(hosts) != set(LISTENING):
                raise ValueError(f"robot '{robot}' needs a host for each of {', '.join(LISTENING)}")
            for host in hosts.values():
                if not is_host(host):
                    raise ValueError(f"'{host}' of robot '{robot}' is not a host's name or address without a port")
        return entries

    @field_validator("routers")
    @classmethod
    def _with_ports(cls, entries: list[str]) -> list[str]:
        return [with_port(entry) for entry in entries]

    @classmethod
    def read(cls, folder: Path) -> Self | None:
        """Return the plan of a folder; None if the folder has no plan.

        Raises:
            ServiceError: The plan cannot be read.
        """
        path = folder / FILE
        if not path.exists():
            return None
        try:
            return cls.model_validate_json(path.read_text())
        except (OSError, ValidationError) as error:
            raise ServiceError(f"'{path}' is not a plan: {_first(error)}.") from None

    @classmethod
    def of(cls, **fields: object) -> Self:
        """Make a plan of these fields.

        Raises:
            ServiceError: A field is wrong.
        """
        try:
            return cls.model_validate(fields)
        except ValidationError as error:
            raise ServiceError(f"The plan is wrong: {_first(error)}.") from None

    def members(self) -> dict[str, Member]:
        """Return every member with a role file, by name: the router, services as `hal.<robot>`, people."""
        services = [name for name, role in ROLES.items() if role.is_service]
        return {
            ROUTER: Member(ROUTER, (ALL,)),
            **{f"{service}.{robot}": Member(service, (robot,)) for robot in self.robots for service in services},
            **{name: Member(person.role, tuple(person.robots)) for name, person in self.people.items()},
        }

    def hosts(self, name: str) -> list[str]:
        """Return the names and addresses of a member that listens; empty for other members."""
        if name == ROUTER:
            return [_host(router) for router in self.routers]
        service, _, robot = name.partition(".")
        return [self.robots[robot][service]] if service in LISTENING else []


def with_port(place: str) -> str:
    """Return `HOST` as `HOST:7447`, and `HOST:PORT` unchanged.

    Raises:
        ValueError: The text is neither HOST nor HOST:PORT.
    """
    is_bare_v6 = place.count(":") > 1 and not place.startswith("[")
    host, colon, port = (place, "", "") if is_bare_v6 or place.endswith("]") else place.rpartition(":")
    if not colon:
        host, port = place, str(ROUTER_PORT)
    if not is_host(host) or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ValueError(f"'{place}' is not HOST or HOST:PORT")
    return f"{_bracketed(host)}:{port}"


def is_host(text: str) -> bool:
    """Whether the text can be a host's name or address."""
    try:
        ipaddress.ip_address(text.strip("[]"))
    except ValueError:
        return bool(_HOST.fullmatch(text))
    return True


def dialled(host: str, port: str | int) -> str:
    """Return `HOST:PORT` to connect to."""
    return f"{_bracketed(host)}:{port}"


def listened(host: str, port: str | int) -> str:
    """Return `ADDRESS:PORT` to listen on for a member on `host`.

    The address is that of all interfaces, because a host may have several names; a loopback host listens on loopback.
    """
    if is_loopback(host):
        return dialled("127.0.0.1" if host == "localhost" else host, port)
    return f"[::]:{port}" if ":" in host else f"0.0.0.0:{port}"


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host and not host.startswith("[") else host


def _host(place: str) -> str:
    return host_and_port(place)[0].strip("[]")


def _first(error: OSError | ValidationError) -> str:
    if isinstance(error, OSError):
        return str(error.strerror)
    first = error.errors(include_url=False)[0]
    field = ".".join(str(part) for part in first["loc"])
    message = str(first["msg"]).removeprefix("Value error, ")
    return f"{field}: {message}" if field else message
