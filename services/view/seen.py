"""What was heard of a robot up to one moment, each message with its age."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from services.wire.messages import Anomaly, Applied, Estimates, Holder, Message, Sample, Status, Update

M = TypeVar("M", bound=Message)

FRESH = 0.5
"""Age [s] up to which a value is shown as it is; older ones are greyed, and tell their age."""
FRESH_STATUS = 2.5
"""The same for what comes once a second."""


@dataclass(frozen=True, slots=True)
class Heard(Generic[M]):
    """A message, and how long ago [s] it arrived, on this machine's clock."""

    message: M
    age: float

    @property
    def is_fresh(self) -> bool:
        """Whether it may be shown as what is now."""
        return self.age <= (FRESH_STATUS if isinstance(self.message, Status | Holder) else FRESH)


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """Everything that was heard.

    Attributes:
        robot: The robot's name.
        linked: Whether this client has a connection, or needs none.
        link_text: Why not, in one sentence.
        alive: Names of the services that are there.
        statuses: Service -> its newest status.
        hal: What the HAL's `describe` told; empty before.
        model: What the model's `describe` told; empty before.
    """

    robot: str
    linked: bool = True
    link_text: str = ""
    alive: frozenset[str] = frozenset()
    sample: Heard[Sample] | None = None
    vision: Heard[Sample] | None = None
    applied: Heard[Applied] | None = None
    estimate: Heard[Estimates] | None = None
    anomaly: Heard[Anomaly] | None = None
    update: Heard[Update] | None = None
    holder: Heard[Holder] | None = None
    statuses: Mapping[str, Heard[Status]] = field(default_factory=dict)
    hal: Mapping[str, Any] = field(default_factory=dict)
    model: Mapping[str, Any] = field(default_factory=dict)

    def fresh(self, what: Heard[M] | None) -> M | None:
        """The message, unless it is old or was never heard."""
        return what.message if what is not None and what.is_fresh else None

    @property
    def mode(self) -> str:
        """Mode of the motors; empty if it is not known now."""
        applied = self.fresh(self.applied)
        return applied.mode if applied is not None else ""
