"""What can be wrong between processes."""

from hal.errors import CommandRefused


class ServiceError(Exception):
    """Base of every exception that `services` raises on purpose."""


class NoAnswer(ServiceError):
    """A question was not answered; each way in which that happens has its own class."""


class ServiceUnavailable(NoAnswer):
    """Nobody is there: no such service, no router, no network."""


class TooSlow(NoAnswer):
    """Somebody is there, and did not answer within the deadline."""


class NotAllowed(NoAnswer):
    """This client's role may not ask or say that, or is not let in at all."""


class WrongVersion(NoAnswer):
    """The other side speaks another version of the wire format."""


class CommandHeld(ServiceError):
    """Somebody else commands this robot; the text names the holder."""


class LeaseLost(ServiceError):
    """This client commands no more: its lease ran out, or the HAL was restarted."""


class TooLate(ServiceError, CommandRefused):
    """What may move the robot was asked for too long ago, or without telling when; it is not done."""


class AlreadyRunning(ServiceError):
    """The robot already has this service; a second one is refused."""


class RemoteError(ServiceError):
    """A service refused, with an exception that this process does not know; the text names its class."""


class RecordingError(ServiceError):
    """A recording cannot be written or read."""


class TargetRefused(ServiceError):
    """A target was not accepted; the controller goes on with the one before."""


class NotEngaged(ServiceError):
    """The controller could not take over; nothing moved because of it."""


class BadArguments(ServiceError):
    """A verb was asked with arguments it does not understand."""
