"""Published targets, from zenoh to the controller: what cannot be read, comes late or from somebody else is counted."""

from collections.abc import Callable

import zenoh

from services.wire import keys
from services.wire.messages import Target
from services.wire.streams import received_message

DEPTH = 8
"""Targets kept between two ticks: a bad one must not push out the good one beside it."""


class TargetIntake:
    """Takes the targets that came since the last tick, in their order.

    Args:
        session: An open session.
        robot: The robot's name.

    Attributes:
        rejected: Messages that could not be read.
    """

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        self.rejected = 0
        self._subscriber = session.declare_subscriber(keys.target(robot), zenoh.handlers.RingChannel(DEPTH))

    def take(self, use: Callable[[Target], None]) -> None:
        """Hand on what came; never blocks, never raises because of a message."""
        for _ in range(DEPTH):
            sample = self._subscriber.try_recv()
            if sample is None:
                return
            try:
                target = received_message(sample, Target)
            except Exception:  # the tick goes on, whatever came
                self.rejected += 1
                continue
            use(target)
