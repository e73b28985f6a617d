"""Commands that arrive: how many a tick takes, floods, repeated and late messages, and what is logged of them."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import msgpack
import msgspec
import numpy as np
import pytest

from hal.errors import CommandRefused
from services.command.intake import PER_TICK, WAITING, Intake, Rings
from services.errors import CommandHeld, LeaseLost, TargetRefused, TooLate
from services.wire.messages import Command


class Payload(bytes):
    def to_bytes(self) -> bytes:
        return self


@dataclass
class Put:
    """What zenoh hands out: the message as it is, and bytes that name its sender."""

    message: Any
    sender: int = 5

    @property
    def payload(self) -> Payload:
        return Payload(msgpack.packb({"type": "command", "boot": self.sender}))


class Queue:
    """A session, its only subscriber, and the ring of that subscriber."""

    def declare_subscriber(self, key: str, handler: Any) -> "Queue":
        self.handler = self
        self._waiting: deque[Put] = deque(maxlen=WAITING)
        return self

    def put(self, *messages: Any, sender: int = 5) -> None:
        self._waiting.extend(Put(message, sender) for message in messages)

    def try_recv(self) -> Put | None:
        return self._waiting.popleft() if self._waiting else None


def numbered(seq: int, stamp_ns: int = 0, boot: int = 5) -> Command:
    return Command(signal="s", values=np.zeros(1), cycle=1, hal_boot=1, seq=seq, stamp_ns=stamp_ns, boot=boot)


@pytest.fixture
def intake(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Intake[Command], Queue, list[Any]]]:
    monkeypatch.setattr("services.command.intake.received_message", lambda sample, record: sample.message)
    queue, used = Queue(), []

    def use(message: Any) -> None:
        if isinstance(message.signal, Exception):
            raise message.signal
        used.append(message.seq)

    yield Intake(queue, "key", Command, use), queue, used  # type: ignore[arg-type]


def raising(error: Exception, seq: int = 0) -> Any:
    message = numbered(seq)
    msgspec.structs.force_setattr(message, "signal", error)
    return message


def test_a_tick_follows_at_most_eight_messages_of_a_sender_the_newest(
    intake: tuple[Intake[Command], Queue, list[Any]],
) -> None:
    taken, queue, used = intake
    none = dict.fromkeys(("accepted", "refused", "malformed", "flooded", "repeated", "late"), 0)
    assert taken.facts() == none | {"text": ""}
    queue.put(*map(numbered, range(11)))
    taken.take()
    assert used == list(range(3, 11))
    assert taken.facts() == none | {"accepted": 8, "flooded": 3, "text": taken.news()}
    assert "More than 8 command messages of a sender came in a tick" in taken.news()


def test_a_flood_does_not_displace_the_commands_of_another(intake: tuple[Intake[Command], Queue, list[Any]]) -> None:
    taken, queue, used = intake
    for tick in range(50):
        queue.put(numbered(tick, boot=7), sender=7)
        for sender in range(100, 190 if tick else 110):  # more than there are rings, once one was accepted
            queue.put(*[raising(CommandHeld("no"), seq=1000 * tick + 1)] * 20, sender=sender)
        used.clear()
        taken.take()
        assert used == [tick]
        assert taken.counters["refused"] <= PER_TICK * (tick + 1)
    assert taken.counters["flooded"] > 49 * 90 * 12


def test_thousands_of_senders_take_no_more_room_than_sixty_four() -> None:
    rings = Rings()
    for sender in range(5000):
        rings.put(Put(numbered(1), sender))  # type: ignore[arg-type]
    assert len(rings.take(10_000)) == 64
    assert rings.dropped == 5000 - 64
    for sender in range(5000, 5064):
        rings.put(Put(numbered(1), sender))  # type: ignore[arg-type]
    assert len(rings.take(10_000)) == 64  # the next tick has room for others


def test_a_tick_takes_at_most_what_waits_so_that_a_flood_cannot_hold_it(
    intake: tuple[Intake[Command], Queue, list[Any]],
) -> None:
    taken, queue, _ = intake
    asked = 0

    def endless() -> Put:
        nonlocal asked
        asked += 1
        return Put(numbered(asked))

    queue.try_recv = endless  # type: ignore[method-assign]
    taken.take()
    assert asked == WAITING


def test_a_command_that_comes_twice_or_late_is_counted_told_and_not_followed(
    intake: tuple[Intake[Command], Queue, list[Any]],
) -> None:
    taken, queue, used = intake
    queue.put(numbered(1, 100), numbered(3, 300), numbered(2, 200), numbered(3, 300))
    queue.put(numbered(1, 50, boot=6), sender=6)
    taken.take()
    assert sorted(used) == [1, 1, 3]
    facts = taken.facts()
    assert (facts["accepted"], facts["late"], facts["repeated"]) == (3, 1, 1)
    assert "came twice (number 3 after number 3)" in taken.news()


@pytest.mark.parametrize(
    "error", [CommandRefused("no"), CommandHeld("no"), LeaseLost("no"), TooLate("no"), TargetRefused("no")]
)
def test_refused_messages(intake: tuple[Intake[Command], Queue, list[Any]], error: Exception) -> None:
    taken, queue, _ = intake
    queue.put(raising(error), numbered(1))
    taken.take()
    facts = taken.facts()
    assert (facts["accepted"], facts["refused"], facts["malformed"], facts["text"]) == (1, 1, 0, "no")
    assert taken.news() == "no"


def test_news_last_for_five_seconds_and_logs_are_a_second_apart(
    intake: tuple[Intake[Command], Queue, list[Any]], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    taken, queue, _ = intake
    now = [100.0]
    monkeypatch.setattr("services.command.intake.time.monotonic", lambda: now[0])
    for moment, logged in ((100.0, 1), (100.9, 1), (101.0, 2), (101.5, 2), (102.1, 3)):
        now[0] = moment
        queue.put(raising(ValueError("odd")))
        taken.take()
        assert len(caplog.records) == logged
    assert taken.facts()["malformed"] == 5
    assert taken.facts()["text"] == "A command could not be read: ValueError: odd"
    assert "(0 refused, 5 malformed so far)" in caplog.text
    for moment, is_news in ((107.0, True), (107.2, False)):
        now[0] = moment
        assert bool(taken.news()) is is_news
    assert taken.facts()["text"]
