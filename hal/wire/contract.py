"""Contract of a wire with devices, as robot and devices use it: a CAN bus or a serial line."""

from typing import Any, Protocol

from hal.wire.state import BusState


class Wire(Protocol):
    """A wire that stays usable as an object while its interface fails and returns.

    A cycle is `begin`, the set-points of the devices, `sync`, and `wait`.
    """

    name: str
    counters: dict[str, int]
    needs_sync: bool
    """Whether it has CANopen nodes, which need the SYNC and the HAL's heartbeat."""

    @property
    def state(self) -> BusState:
        """State of the wire."""
        ...

    @property
    def text(self) -> str:
        """Problem and remedy in one sentence for the operator; empty without a problem."""
        ...

    def expect(self, node: Any) -> None:
        """Wait in every cycle for `answered(node)`."""
        ...

    def answered(self, node: Any) -> None:
        """Note the answer of a device in this cycle."""
        ...

    def open(self) -> None:
        """Start to receive, and return after the first attempt to open the interface, also if it failed."""
        ...

    def close(self) -> None:
        """Stop and close the interface. Safe to call twice."""
        ...

    def begin(self) -> None:
        """Begin a cycle, before the first set-point."""
        ...

    def sync(self, now: float) -> None:
        """Ask the devices for their measurements; `now` is the time of the cycle [monotonic s]."""
        ...

    def wait(self, deadline: float) -> bool:
        """Wait for all answers until the deadline [monotonic s], and return whether they are complete."""
        ...

    def trouble(self) -> str:
        """Return the problem that made the wire unusable now or since the last call; empty without one."""
        ...

    def health(self) -> dict[str, Any]:
        """Return state, problem, load as a share of the bit rate, and counters."""
        ...
