"""Contract of a simulated node, whatever its protocol."""

from collections.abc import Callable, Mapping
from typing import Protocol, runtime_checkable

from simulators.nodes.canopen.spec import NodeSpec

Frame = tuple[int, bytes]
"""A frame is identifier and data; an identifier of 29 bits has `EXTENDED` set, and that of a sent frame of CAN FD has
`simulators.wire_time.FD`."""
Handler = Callable[[bytes, float], None]
"""A handler is called with a frame's data and the time [s]."""
EXTENDED = 1 << 31
REMOTE = 1 << 30
"""This flag marks the identifier of a route for remote frames; its handler gets no data."""


class SimulatedNode(Protocol):
    """One node: frames in by `routes` and `sync`, time by `tick`, frames out into the outbox it was made with.

    Its class is called with `NodeSpec`, `Plant` and the outbox, a list of frames. Times are seconds of one monotonic
    clock. A node is used by one thread at a time.
    """

    spec: NodeSpec
    is_powered: bool
    is_muted: bool
    """Sends no measurements any more: its sensor is dead, its electronics are not."""
    routes_changed: Callable[[], None]
    """Called by the node when `routes` would answer differently."""

    @property
    def condition(self) -> str:
        """Short text on its present activity."""
        ...

    def routes(self) -> Mapping[int, Handler]:
        """Return identifier -> handler of its data, for all identifiers but SYNC."""
        ...

    def sync(self, now: float) -> None:
        """Handle a SYNC."""
        ...

    def tick(self, now: float) -> None:
        """Advance to a time; called every few milliseconds."""
        ...

    def power_up(self, now: float) -> None:
        """Start as after power-on."""
        ...

    def power_down(self) -> None:
        """Fall silent at once."""
        ...

    def break_down(self) -> None:
        """Report a fault of the device's own."""
        ...


@runtime_checkable
class SimulatedDrive(Protocol):
    """A node that moves something."""

    spec: NodeSpec

    @property
    def servo(self) -> tuple[float, bool]:
        """Target of the world's servo [unit of `spec.element`], and whether it is enabled."""
        ...
