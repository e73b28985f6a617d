"""The exceptions of `services`."""

from hal.errors import CommandRefused


class ServiceError(Exception):
    """Base of every exception that `services` raises on purpose."""


class NoAnswer(ServiceError):
    """A query without an answer; each cause has its own class."""


class ServiceUnavailable(NoAnswer):
    """No such service, no router, or no network."""


class TooSlow(NoAnswer):
    """A service that did not answer within the deadline."""


class NotAllowed(NoAnswer):
    """A request that the client's role does not allow, or a client that the router refuses."""


class WrongVersion(NoAnswer):
    """Another version of the wire format on the other side."""


class CommandHeld(ServiceError):
    """A robot that another client commands; the text names the holder."""


class LeaseLost(ServiceError):
    """The end of this client's lease: it ran out, or the HAL was restarted."""


class TooLate(ServiceError, CommandRefused):
    """A refused request to move the robot: it is too old, or its age is unknown."""


class AlreadyRunning(ServiceError):
    """A second service of a kind that the robot already has."""


class RemoteError(ServiceError):
    """An exception of a service whose class this process does not know; the text names it."""


class RecordingError(ServiceError):
    """A recording that cannot be written or read."""


class TargetRefused(ServiceError):
    """A target that is not accepted; the controller keeps the one before."""


class NotEngaged(ServiceError):
    """A controller that could not engage; it moved nothing."""


class BadArguments(ServiceError):
    """Unknown, missing or malformed arguments of a verb."""
