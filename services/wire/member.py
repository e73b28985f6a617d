"""Who one is, as one's role file says: what the client and the page ask before they ask the robot."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from services.errors import ServiceError
from services.wire.connect import role_file, sorted_out
from services.wire.roles import ROLES

ALL = "*"
"""In the place of a robot's name: every robot there is or will be."""


@dataclass(frozen=True, slots=True)
class Member:
    """A role, and the robots that it is for; no role means that there is no security, and everything is allowed.

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

    def may_say(self, robot: str, noun: str) -> bool:
        """Whether it may publish, such as `hal/command`."""
        return not self.role or (self.is_for(robot) and self.role in ROLES and ROLES[self.role].may_say(noun))

    def may_hear(self, robot: str, noun: str) -> bool:
        """Whether it may subscribe, such as to `model/estimate`."""
        return not self.role or (self.is_for(robot) and self.role in ROLES and ROLES[self.role].may_hear(noun))


def member_of(connect: Iterable[str]) -> Member:
    """Who the role file among these is for.

    Raises:
        ServiceError: It cannot be read.
    """
    for file in sorted_out(connect)[1]:
        if (found := told_by(role_file(file))).role:
            return found
    return Member()


def told_by(configuration: Mapping[str, Any]) -> Member:
    """Who a configuration is for.

    Raises:
        ServiceError: What it says of the role is no role.
    """
    told = (configuration.get("metadata") or {}).get("gemuco")
    if told is None:
        return Member()
    if (
        not isinstance(told, Mapping)
        or not isinstance(told.get("role"), str)
        or not isinstance(told.get("robots"), list)
    ):
        raise ServiceError("The role file's metadata.gemuco must be {role: NAME, robots: [NAMES]}.")
    return Member(told["role"], tuple(str(one) for one in told["robots"]))
