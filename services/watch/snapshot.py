"""The newest message of each kind from one robot, each with its age."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeVar

from services.client.live import FRESH_STATUS
from services.wire.messages import Anomaly, Applied, Estimates, Holder, Message, Sample, Status, Update

M = TypeVar("M", bound=Message)

FRESH = 0.5
"""A message is shown as present up to this age [s]."""
FRESH_UPDATE = 1.0
"""The state of the online update is shown as present up to this age [s]."""


@dataclass(frozen=True, slots=True)
class Newest(Generic[M]):
    """A message and its age [s] on this machine's clock."""

    message: M
    age: float

    @property
    def is_fresh(self) -> bool:
        """Whether the message may be shown as present."""
        if isinstance(self.message, Status | Holder):
            return self.age <= FRESH_STATUS
        return self.age <= (FRESH_UPDATE if isinstance(self.message, Update) else FRESH)


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotSnapshot:
    """Everything that is known of a robot at one moment.

    Attributes:
        robot: Name of the robot.
        linked: Whether this client has a connection, or needs none.
        link_text: Reason for a missing connection, in one sentence.
        has_streams: Whether samples, estimates and anomalies are subscribed to; a view of a fleet reads statuses only.
        alive: Names of the live services.
        twins: Services of which two processes publish under this robot's name.
        refused: Reasons why newest messages cannot be read, such as another version of the wire format.
        disordered: Sentences about messages that came twice or late in the last seconds, and were not used.
        statuses: Service -> its newest status.
        hal: Answer of the HAL's `describe`; empty before.
        model: Answer of the model's `describe`; empty before.
    """

    robot: str
    linked: bool = True
    link_text: str = ""
    has_streams: bool = True
    alive: frozenset[str] = frozenset()
    twins: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    disordered: tuple[str, ...] = ()
    sample: Newest[Sample] | None = None
    vision: Newest[Sample] | None = None
    applied: Newest[Applied] | None = None
    estimate: Newest[Estimates] | None = None
    anomaly: Newest[Anomaly] | None = None
    update: Newest[Update] | None = None
    holder: Newest[Holder] | None = None
    statuses: Mapping[str, Newest[Status]] = field(default_factory=dict)
    hal: Mapping[str, Any] = field(default_factory=dict)
    model: Mapping[str, Any] = field(default_factory=dict)

    @property
    def age(self) -> float:
        """Age of the newest message [s]; infinite if there is none."""
        newest = (self.sample, self.vision, self.estimate, self.holder, *self.statuses.values())
        return min((one.age for one in newest if one is not None), default=math.inf)

    @property
    def motors(self) -> str:
        """Mode of the motors; empty if it is not known at present."""
        if (applied := fresh(self.applied)) is not None:
            return applied.mode
        mode = self.facts("hal").get("mode")
        return mode if isinstance(mode, str) and not self.has_streams else ""

    @property
    def lease_holder(self) -> str:
        """Name of the lease holder and the time left, in words."""
        holder = fresh(self.holder)
        if holder is None:
            return "not known"
        if not holder.holder:
            return "none"
        through = " through the model" if holder.through else ""
        return f"{holder.name or f'client {holder.holder}'}{through}, {holder.left:.0f} s left"

    def facts(self, service: str) -> Mapping[str, Any]:
        """Return the facts of a service's status; empty if that is old."""
        status = fresh(self.statuses.get(service))
        return status.facts if status is not None else {}


def held(snapshot: RobotSnapshot) -> RobotSnapshot:
    """Return a snapshot whose messages count as fresh while a replay is paused, as they are the present ones there."""
    replay = snapshot.facts("hal").get("replay")
    if not (isinstance(replay, dict) and replay.get("paused") is True):
        return snapshot
    return replace(
        snapshot,
        sample=_now(snapshot.sample),
        vision=_now(snapshot.vision),
        applied=_now(snapshot.applied),
        estimate=_now(snapshot.estimate),
        anomaly=_now(snapshot.anomaly),
        update=_now(snapshot.update),
    )


def _now(newest: Newest[M] | None) -> Newest[M] | None:
    return None if newest is None else replace(newest, age=0.0)


def fresh(newest: Newest[M] | None) -> M | None:
    """Return the message; None if it is old or did not arrive yet."""
    return newest.message if newest is not None and newest.is_fresh else None
