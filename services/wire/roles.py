"""The rights of each role, as data: the access control of every session and the checks of the client come from it.

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
"""Every role may subscribe to these. Commands are not among them: only the robot and the recorder read those."""
READING = ("*/do/describe", "model/do/estimate", "model/do/anomaly", "model/do/history")
"""These verbs change nothing and compute little."""


@dataclass(frozen=True, slots=True)
class Role:
    """The rights of one role; anything else is refused.

    Attributes:
        name: `hal`; in certificates and files with the robot's name behind it, `hal.musashi_arm`.
        what: Description in words.
        publishes: Keys that it publishes.
        subscribes: Keys that it subscribes to. It sees the `alive` tokens of all its robots.
        asks: Verbs that it asks.
        is_service: Whether it is one of `keys.SERVICES`, and so answers verbs and is alive.
    """

    name: str
    what: str
    publishes: tuple[str, ...] = ()
    subscribes: tuple[str, ...] = ()
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

    def may_publish(self, noun: str) -> bool:
        """Whether it may publish `hal/command`."""
        return _covers(self.publishes, noun)

    def may_subscribe(self, noun: str) -> bool:
        """Whether it may subscribe to `model/estimate`."""
        return _covers(self.subscribes, noun)

    def may_ask(self, service: str, verb: str) -> bool:
        """Whether it may ask a service's verb."""
        return _covers(self.asks, f"{service}/do/{verb}")


def _service(
    name: str, what: str, publishes: Iterable[str] = (), subscribes: Iterable[str] = (), asks: Iterable[str] = ()
) -> Role:
    """Make a service's role, which also publishes its status and asks a running service of its kind for `describe`."""
    return Role(name, what, (*publishes, f"{name}/status"), tuple(subscribes), (*asks, f"{name}/do/describe"))


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
        _service("recorder", "writes everything down, and says nothing", subscribes=["**"], asks=["*/do/describe"]),
        Role(
            "operator",
            "commands and asks anything",
            ("hal/command", "model/target"),
            OPEN,
            tuple(f"{service}/do/*" for service in keys.SERVICES),
            is_service=False,
        ),
        Role("viewer", "looks on", subscribes=OPEN, asks=READING, is_service=False),
    )
}
"""These are all roles but the router, which forwards the others' messages and publishes nothing itself."""

STOPPING = Role(
    "emergency", "stops a robot and does nothing else", asks=("hal/do/estop", "hal/do/stop"), is_service=False
)
"""Rights of an operator at the router's port for emergency stops."""
ESTOP = ("hal", "estop")
"""Service and verb of the emergency stop."""
RATES = {"hal/command": 1000.0, "model/target": 100.0}
"""The router passes this many messages per second by key, and drops the rest."""
ASKED = 50.0
"""The router passes this many queries per second to each verb of `COMPUTING`; stop and the like are never limited."""
COMPUTING = ("describe", "estimate", "anomaly", "history", "control", "simulate")
SIZES = {"hal/command": 8192, "model/target": 8192, "*/do/*": 1 << 18}
"""The router passes messages up to this size [bytes], by key."""


def _covers(patterns: Iterable[str], key: str) -> bool:
    """Whether one of the patterns includes the key."""
    return any(_includes(pattern.split("/"), key.split("/")) for pattern in patterns)


def _includes(pattern: list[str], key: list[str]) -> bool:
    if pattern == ["**"]:
        return True
    return len(pattern) == len(key) and all(piece in ("*", part) for piece, part in zip(pattern, key, strict=True))
