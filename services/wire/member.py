"""The role that a role file grants; the client and the page check it before they ask the robot."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from services.errors import ServiceError
from services.wire.connect import role_file, split_connect
from services.wire.roles import ROLES

DOORS = "doors"
"""Entry of the router's role file: further sessions with limits of their own."""
EMERGENCY = "emergency"
"""Entry of an operator's role file: endpoints at which only emergency stops are accepted."""
ALL = "*"
"""In place of a robot's name this means every robot, future ones included."""


@dataclass(frozen=True, slots=True)
class Member:
    """A role and its robots. Without a role there is no security, and everything is allowed.

    Attributes:
        role: `operator`; empty without a role file.
        robots: Names of robots, or `*`.
    """

    role: str = ""
    robots: tuple[str, ...] = ()

    def is_for(self, robot: str) -> bool:
        """Whether the role is for this robot."""
        return not self.role or ALL in self.robots or robot in self.robots

    def may_ask(self, robot: str, service: str, verb: str) -> bool:
        """Whether it may ask a service's verb."""
        return not self.role or (self.is_for(robot) and self.role in ROLES and ROLES[self.role].may_ask(service, verb))

    def may_publish(self, robot: str, noun: str) -> bool:
        """Whether it may publish, such as `hal/command`."""
        return not self.role or (self.is_for(robot) and self.role in ROLES and ROLES[self.role].may_publish(noun))

    def may_subscribe(self, robot: str, noun: str) -> bool:
        """Whether it may subscribe, such as to `model/estimate`."""
        return not self.role or (self.is_for(robot) and self.role in ROLES and ROLES[self.role].may_subscribe(noun))


def member_of(connect: Iterable[str]) -> Member:
    """Return the member of the first role file in `connect` that names a role.

    Raises:
        ServiceError: It cannot be read.
    """
    for file in split_connect(connect)[1]:
        if (member := member_in(role_file(file))).role:
            return member
    return Member()


def doors_in(configuration: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the doors of a router's role file by name; empty for other files."""
    return dict(((configuration.get("metadata") or {}).get("gemuco") or {}).get(DOORS) or {})


def emergency_endpoints(configuration: Mapping[str, Any]) -> list[str]:
    """Return the endpoints for emergency stops in a configuration; empty without any."""
    return list(((configuration.get("metadata") or {}).get("gemuco") or {}).get(EMERGENCY) or ())


def member_in(configuration: Mapping[str, Any]) -> Member:
    """Return the member that a configuration is for.

    Raises:
        ServiceError: Its metadata does not describe a role.
    """
    entry = (configuration.get("metadata") or {}).get("gemuco")
    if entry is None:
        return Member()
    if (
        not isinstance(entry, Mapping)
        or not isinstance(entry.get("role"), str)
        or not isinstance(entry.get("robots"), list)
    ):
        raise ServiceError("The role file's metadata.gemuco must be {role: NAME, robots: [NAMES]}.")
    return Member(entry["role"], tuple(str(robot) for robot in entry["robots"]))
