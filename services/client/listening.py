"""What a client hears: the newest of everything that a robot publishes, once or for ever."""

from collections.abc import Iterator
from typing import TypeVar

from services.client.link import TIMEOUT, Link
from services.client.live import DEADLINE, FRESH, FRESH_STATUS, Health, Live, LiveHealth
from services.wire import keys
from services.wire.messages import Anomaly, Applied, Estimates, Holder, Message, Sample, Status, Update

M = TypeVar("M", bound=Message)


class Listening(Link):
    """The part of `Client` that asks nobody."""

    def sample(self, max_age: float = FRESH, timeout: float = 0.0) -> Sample | None:
        """The newest measurement; None if none arrived in the last `max_age` [s], nor while waiting `timeout` [s]."""
        return self.fresh(keys.sample(self.robot), Sample, max_age, timeout)

    def vision(self, max_age: float = FRESH, timeout: float = 0.0) -> Sample | None:
        """What a camera saw last, or None; see `sample`."""
        return self.fresh(keys.vision(self.robot), Sample, max_age, timeout)

    def applied(self, max_age: float = FRESH, timeout: float = 0.0) -> Applied | None:
        """What was last sent to the drives, or None; see `sample`."""
        return self.fresh(keys.applied(self.robot), Applied, max_age, timeout)

    def update(self, max_age: float = 4 * FRESH, timeout: float = 0.0) -> Update | None:
        """What the online update does, or None; see `sample`."""
        return self.fresh(keys.update(self.robot), Update, max_age, timeout)

    def truth(self, max_age: float = FRESH, timeout: float = 0.0) -> Sample | None:
        """What a simulator knows to be true, or None; see `sample`."""
        return self.fresh(keys.truth(self.robot), Sample, max_age, timeout)

    def status(self, service: str, max_age: float = FRESH_STATUS, timeout: float = 0.0) -> Status | None:
        """The newest status of a service, or None; see `sample`."""
        return self.fresh(keys.status(self.robot, service), Status, max_age, timeout)

    def next_sample(self, timeout: float = TIMEOUT) -> Sample | None:
        """Wait for the next measurement; None if none arrives within `timeout` [s]."""
        return self.reader(keys.sample(self.robot), Sample).wait(timeout)

    def holder(self, timeout: float = TIMEOUT) -> Holder:
        """Who commands the robot; its `name` is empty if nobody does.

        Raises:
            ServiceUnavailable: No HAL tells.
        """
        found = self.fresh(keys.holder(self.robot), Holder, FRESH_STATUS, timeout)
        if found is None:
            raise self.silence(self.reader(keys.holder(self.robot), Holder), timeout)
        return found

    def sensors(self, service: str = "hal", deadline: float | None = DEADLINE) -> Iterator[Sample]:
        """Measurements as they come, always the newest: whoever is slow skips.

        Args:
            service: Whose: `hal`, or `vision` for what a camera sees.
            deadline: How long [s] to wait for the next before that is an error; None waits for ever.

        Raises:
            ServiceUnavailable, TooSlow, WrongVersion: From `next`, when none came in time; it may be called again.
            NotAllowed: At once.
        """
        key = keys.vision(self.robot) if service == "vision" else keys.sample(self.robot)
        return self._live(key, Sample, deadline)

    def estimates(self, deadline: float | None = DEADLINE) -> Iterator[Estimates]:
        """Every signal, measured or estimated, as it comes; see `sensors`."""
        return self._live(keys.estimate(self.robot), Estimates, deadline)

    def anomalies(self, deadline: float | None = DEADLINE) -> Iterator[Anomaly]:
        """How unlike normal the body is, as it comes; see `sensors`."""
        return self._live(keys.anomaly(self.robot), Anomaly, deadline)

    def health(self, deadline: float | None = DEADLINE) -> Iterator[Health]:
        """Who is alive and what each service tells of itself, after every change and every status; see `sensors`."""
        readers = [self.reader(keys.status(self.robot, service), Status) for service in keys.SERVICES]
        return LiveHealth(
            self.presence(), readers, self.changed, deadline, lambda waited: self.no_health(readers, waited)
        )

    def _live(self, key: str, record: type[M], deadline: float | None) -> Live[M]:
        reader = self.reader(key, record)
        return Live(reader, deadline, FRESH, lambda waited: self.silence(reader, waited))
