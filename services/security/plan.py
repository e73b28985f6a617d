"""What `gemuco security init` was asked for: hosts, robots and people; `plan.json` in its folder, without a secret."""

import ipaddress
import re
from pathlib import Path
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from services.errors import ServiceError
from services.wire.member import ALL, Member
from services.wire.roles import PEOPLE, ROLES, ROUTER
from services.wire.session import ROUTER_PORT

FILE = "plan.json"
LISTENING = ("simulator", "hal", "vision", "model")
"""Services that others are linked to directly."""
LINKS = {"vision": ("simulator",), "model": ("hal", "vision"), "recorder": LISTENING}
"""Who dials whom, beside the router, whom every service dials: what a robot's services tell each other goes no way
round. The HAL dials no other service."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
_HOST = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?")


class Person(BaseModel):
    """Somebody with a role file of their own."""

    model_config = ConfigDict(extra="forbid")
    role: Literal["operator", "viewer"]
    robots: list[str] = Field(default_factory=lambda: [ALL])


class Plan(BaseModel):
    """Who is where.

    Attributes:
        protocol: Of every link.
        days: How long a certificate is valid.
        routers: Hosts with ports; services dial the first, people the first that answers.
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
    def _names(cls, found: dict[str, object]) -> dict[str, object]:
        for name in found:
            if not _NAME.fullmatch(name) or name in ROLES.keys() - set(PEOPLE) or name == ROUTER:
                raise ValueError(f"'{name}' cannot be a name here: letters, digits, _ and -, and none of a service")
        return found

    @field_validator("robots")
    @classmethod
    def _places(cls, found: dict[str, dict[str, str]]) -> dict[str, dict[str, str]]:
        for robot, hosts in found.items():
            if set(hosts) != set(LISTENING):
                raise ValueError(f"robot '{robot}' needs a host for each of {', '.join(LISTENING)}")
            for host in hosts.values():
                if not is_host(host):
                    raise ValueError(f"'{host}' of robot '{robot}' is no host's name or address; ports are not told")
        return found

    @field_validator("routers")
    @classmethod
    def _routers(cls, found: list[str]) -> list[str]:
        return [with_port(one) for one in found]

    @classmethod
    def read(cls, folder: Path) -> Self | None:
        """The plan of a folder; None if it has none.

        Raises:
            ServiceError: It cannot be read.
        """
        path = folder / FILE
        if not path.exists():
            return None
        try:
            return cls.model_validate_json(path.read_text())
        except (OSError, ValidationError) as error:
            raise ServiceError(f"'{path}' is not a plan: {_first(error)}.") from None

    @classmethod
    def of(cls, **told: object) -> Self:
        """A plan of these fields.

        Raises:
            ServiceError: One of them is wrong.
        """
        try:
            return cls.model_validate(told)
        except ValidationError as error:
            raise ServiceError(f"No such plan: {_first(error)}.") from None

    def members(self) -> dict[str, Member]:
        """Everybody with a role file, by its name: the router, services as `hal.<robot>`, people."""
        services = [name for name, role in ROLES.items() if role.is_service]
        return {
            ROUTER: Member(ROUTER, (ALL,)),
            **{f"{service}.{robot}": Member(service, (robot,)) for robot in self.robots for service in services},
            **{name: Member(person.role, tuple(person.robots)) for name, person in self.people.items()},
        }

    def hosts(self, name: str) -> list[str]:
        """Under which names and addresses others reach this member; none if it never listens."""
        if name == ROUTER:
            return [_host(one) for one in self.routers]
        service, _, robot = name.partition(".")
        return [self.robots[robot][service]] if service in LISTENING else []


def with_port(place: str) -> str:
    """`HOST` as `HOST:7447`; another port stays.

    Raises:
        ValueError: It is neither.
    """
    is_bare_v6 = place.count(":") > 1 and not place.startswith("[")
    host, colon, port = (place, "", "") if is_bare_v6 or place.endswith("]") else place.rpartition(":")
    if not colon:
        host, port = place, str(ROUTER_PORT)
    if not is_host(host) or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ValueError(f"'{place}' is no HOST or HOST:PORT")
    return f"{_bracketed(host)}:{port}"


def is_host(text: str) -> bool:
    """Whether this can be a host's name or address."""
    try:
        ipaddress.ip_address(text.strip("[]"))
    except ValueError:
        return bool(_HOST.fullmatch(text))
    return True


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches that host."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def dialled(host: str, port: str | int) -> str:
    """`HOST:PORT` to connect to."""
    return f"{_bracketed(host)}:{port}"


def listened(host: str, port: str | int) -> str:
    """`ADDRESS:PORT` to listen on for what is reached as `host`: every address, for a host may have several names."""
    if is_loopback(host):
        return dialled("127.0.0.1" if host == "localhost" else host, port)
    return f"[::]:{port}" if ":" in host else f"0.0.0.0:{port}"


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host and not host.startswith("[") else host


def _host(place: str) -> str:
    return place.rpartition(":")[0].strip("[]")


def _first(error: OSError | ValidationError) -> str:
    if isinstance(error, OSError):
        return str(error.strerror)
    told = error.errors(include_url=False)[0]
    where = ".".join(str(part) for part in told["loc"])
    said = str(told["msg"]).removeprefix("Value error, ")
    return f"{where}: {said}" if where else said
