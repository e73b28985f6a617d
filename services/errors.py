"""What can be wrong between processes."""


class ServiceError(Exception):
    """Base of every exception that `services` raises on purpose."""


class ServiceUnavailable(ServiceError):
    """A service did not answer within the deadline."""


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
