"""Who may do what, once and as data: the access control of every session and the checks of the client come from it.

Keys are those of docs/keys.md without `gemuco/<robot>/`; `*` stands for one part of a key, `**` for the rest.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from services.wire import keys

OPEN = (
    "hal/sample",
    "hal/applied",
    "hal/holder",
    "vision/sample",
    "model/estimate",
    "model/anomaly",
    "model/update",
    "simulator/truth",
    "*/status",
)
"""What everybody who is let in may see. What is commanded is not in it: that is for the robot and the recording."""
READING = ("*/do/describe", "model/do/estimate", "model/do/anomaly", "model/do/history")
"""Verbs that change nothing and compute little."""


@dataclass(frozen=True, slots=True)
class Role:
    """What one role may do; whatever is not here is refused.

    Attributes:
        name: `hal`; in certificates and files with the robot's name behind it, `hal.musashi_arm`.
        what: In words.
        says: Keys that it publishes.
        hears: Keys that it subscribes to; also what `alive` tokens it sees: all of its robots.
        asks: Verbs that it asks.
        is_service: Whether it is one of `keys.SERVICES`, and so answers verbs and is alive.
    """

    name: str
    what: str
    says: tuple[str, ...] = ()
    hears: tuple[str, ...] = ()
    asks: tuple[str, ...] = ()
    is_service: bool = True

    @property
    def answers(self) -> tuple[str, ...]:
        """Verbs that it answers."""
        return (f"{self.name}/do/*",) if self.is_service else ()

    @property
    def alive(self) -> tuple[str, ...]:
        """Liveliness tokens that it may have."""
        return (f"{self.name}/alive",) if self.is_service else ()

    def may_say(self, noun: str) -> bool:
        """Whether it may publish `hal/command`."""
        return _covers(self.says, noun)

    def may_hear(self, noun: str) -> bool:
        """Whether it may subscribe to `model/estimate`."""
        return _covers(self.hears, noun)

    def may_ask(self, service: str, verb: str) -> bool:
        """Whether it may ask a service's verb."""
        return _covers(self.asks, f"{service}/do/{verb}")


def _service(
    name: str, what: str, says: Iterable[str] = (), hears: Iterable[str] = (), asks: Iterable[str] = ()
) -> Role:
    """A service also tells its status, and asks another of its kind who that is before it starts beside it."""
    return Role(name, what, (*says, f"{name}/status"), tuple(hears), (*asks, f"{name}/do/describe"))


ROUTER = "router"
PEOPLE = ("operator", "viewer")
ROLES = {
    role.name: role
    for role in (
        _service("simulator", "pretends to be the hardware", ["simulator/truth"]),
        _service("hal", "reads and moves the hardware", ["hal/sample", "hal/applied", "hal/holder"], ["hal/command"]),
        _service("vision", "looks at the robot", ["vision/sample"], ["simulator/truth"]),
        _service(
            "model",
            "estimates, and commands when it was asked to",
            ["model/estimate", "model/anomaly", "model/update", "hal/command"],
            [*OPEN, "model/target"],
            ["hal/do/*"],
        ),
        _service("recorder", "writes everything down, and says nothing", hears=["**"], asks=["*/do/describe"]),
        Role(
            "operator",
            "commands and asks anything",
            ("hal/command", "model/target"),
            OPEN,
            tuple(f"{service}/do/*" for service in keys.SERVICES),
            is_service=False,
        ),
        Role("viewer", "looks on", hears=OPEN, asks=READING, is_service=False),
    )
}
"""All roles but the router, which passes on what the others may say and hear, and says nothing itself."""

RATES = {"hal/command": 1000.0, "model/target": 100.0}
"""Messages per second that pass the router, by key; what is more is dropped."""
ASKED = 50.0
"""Questions per second to each verb that computes; stop and the like are never limited."""
COMPUTING = ("describe", "estimate", "anomaly", "history", "control", "simulate")
SIZES = {"hal/command": 8192, "model/target": 8192, "*/do/*": 1 << 18}
"""Bytes that pass the router, by key."""


def _covers(patterns: Iterable[str], key: str) -> bool:
    """Whether one of the patterns includes the key."""
    return any(_includes(pattern.split("/"), key.split("/")) for pattern in patterns)


def _includes(pattern: list[str], key: list[str]) -> bool:
    if pattern == ["**"]:
        return True
    return len(pattern) == len(key) and all(one in ("*", part) for one, part in zip(pattern, key, strict=True))
