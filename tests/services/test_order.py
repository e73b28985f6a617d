"""Messages that come twice, late, in another order or from a recording are never used."""

import random
import time

import numpy as np
import pytest
from test_command_intake import BOOT, Taken

from hal.errors import CommandRefused
from services.watch.fleet_watch import ServiceRecord
from services.wire import keys, messages
from services.wire.messages import Command, Sample, Status, Update
from services.wire.order import CLOCK_WAS_SET, SENDERS, Order, StreamOrder
from services.wire.session import close_session, open_session
from services.wire.streams import Reader, Transit


def update(seq: int, stamp_ns: int = 0, boot: int = 5) -> Update:
    return Update(
        active=True, model_version=seq, window=0, dropped=0, loss=0.0, seq=seq, stamp_ns=stamp_ns, boot=boot
    )  # fmt: skip


def test_numbers_and_stamps_only_move_forward() -> None:
    order = Order()
    assert order.problem(update(1, 10)) == ""
    assert order.problem(update(4, 40)) == "", "a gap is a loss, and no disorder"
    assert "came twice (number 4 after number 4)" in order.problem(update(4, 40))
    assert "came late (number 3 after number 4)" in order.problem(update(3, 30))
    assert order.problem(update(5, 20)) == "", "its clock was set back"
    assert order.problem(update(0, 60)) == "", "it began to count again"
    assert order.counters == {"repeated": 1, "late": 1}


def test_a_message_without_number_and_stamp_is_always_in_order() -> None:
    order = Order()
    assert [order.problem(update(0, 0, boot)) for boot in (5, 5, 0, 0)] == [""] * 4


def test_senders_are_told_apart_and_only_the_newest_are_remembered() -> None:
    order = Order()
    for boot in range(1, 3 * SENDERS):
        assert order.problem(update(9, 90, boot)) == ""
    assert order.problem(update(8, 80, boot)) != ""
    assert len(order._heard) == SENDERS


def test_any_shuffle_with_copies_is_used_once_and_forward() -> None:
    chance = random.Random(3)
    sent = [update(number, 10 * number) for number in range(1, 400)]
    arriving = [chance.choice(sent[max(0, place - 6) : place + 1]) for place in range(len(sent)) for _ in range(2)]
    order = StreamOrder()
    used = [message.seq for message in arriving if not order.problem_at(message, 0.0)]
    assert used == sorted(set(used))
    assert sum(order.counters.values()) == len(arriving) - len(used)


def test_a_recording_of_a_former_run_is_not_fresh_and_a_restart_is() -> None:
    order = StreamOrder()
    assert order.problem_at(update(900, 9_000, boot=1), 1.0) == ""
    assert order.problem_at(update(0, 10_000, boot=2), 2.0) == "", "it was restarted"
    assert "from another run" in order.problem_at(update(880, 8_800, boot=1), 2.1)
    assert "from another run" in order.problem_at(update(7, 9_500, boot=3), 2.1)
    assert order.problem_at(update(1, 10_100, boot=2), 2.2) == ""
    late = 2.3 + CLOCK_WAS_SET
    assert order.problem_at(update(881, 8_810, boot=1), late) != "", "of this run newer messages were heard"
    assert order.problem_at(update(0, 500, boot=4), late) == "", "on a computer whose clock is behind"


def test_a_sample_that_is_replayed_byte_for_byte_is_not_the_newest(robot: str) -> None:
    session = open_session(robot, "client")
    reader = Reader(session, keys.update(robot), Update)
    now = time.time_ns()
    recorded = [messages.encode(update(count, now + 5_000_000 * count)) for count in range(1, 200)]
    for data in recorded:
        session.put(keys.update(robot), data)
    deadline = time.monotonic() + 10.0
    while (last := reader.last()) is None or last.message.seq != 199:
        assert time.monotonic() < deadline
        time.sleep(0.002)
    for number, data in enumerate(recorded[:20] + recorded[-3:]):
        session.put(keys.update(robot), data)
        while sum(reader.order.counters.values()) <= number:
            assert time.monotonic() < deadline
            time.sleep(0.001)
    assert reader.last() is last
    assert reader.order.counters == {"repeated": 1, "late": 22}
    assert "came twice" in reader.order.text
    close_session(session)


def test_gemuco_top_takes_a_status_once_and_says_that_messages_are_out_of_order() -> None:
    record = ServiceRecord()
    for seq in (1, 2, 1, 2):
        status = Status(service="hal", state="running", facts={}, seq=seq, stamp_ns=seq * 10**9, boot=5)
        record.add(status, float(seq))
    assert record.status is not None
    assert (record.status.seq, record.received) == (2, 2.0)
    assert record.order.counters == {"repeated": 1, "late": 1}


def test_what_order_lets_through_is_never_younger_than_it_is() -> None:
    """A stamp that goes back is a clock that was set, and turns the guard off for that message: order comes before."""
    transit, order = Transit(), StreamOrder()
    for count in range(1, 100):
        transit.delay(10**9 + count * 10**7, 1.0 + 0.01 * count)
        order.problem_at(update(count, 10**9 + count * 10**7), 1.0 + 0.01 * count)
    old = update(50, 10**9 + 50 * 10**7)
    assert transit.delay(old.stamp_ns, 2.5) == 0.0
    assert order.problem_at(old, 2.5)


class TestCommands:
    def test_one_that_answers_an_older_cycle_does_not_replace_a_newer_one(self, robot: str) -> None:
        taken = Taken(robot)
        older = taken.sample
        newer = taken.cycle()
        try:
            taken.robot.command(np.array([0.2, 0.2]), newer.cycle)
            with pytest.raises(CommandRefused, match=f"answers cycle {older.cycle}, but one that answers"):
                taken.robot.command(np.array([0.1, 0.1]), older.cycle)
            taken.robot.command(np.array([0.3, 0.3]), newer.cycle)
            taken.clock.advance(taken.robot.period)
            _, applied = taken.robot.cycle()
            assert applied.desired.tolist() == [0.3, 0.3]
        finally:
            taken.robot.close()
            close_session(taken.session)

    def test_a_replay_of_a_command_is_counted_and_not_followed(self, robot: str) -> None:
        taken = Taken(robot)
        try:
            data = [self._command(taken.sample, count) for count in (1, 2)]
            taken.offer(data[0])
            taken.offer(data[1])
            for count in range(5):
                taken.offer(data[count % 2])
            facts = taken.intake.facts()
            assert (facts["accepted"], facts["late"], facts["repeated"]) == (2, 3, 2)
        finally:
            taken.robot.close()
            close_session(taken.session)

    @staticmethod
    def _command(sample: Sample, count: int) -> bytes:
        return messages.encode(
            Command(
                signal="muscle_length", values=np.full(2, 0.1 * count), cycle=sample.cycle, hal_boot=BOOT, boot=5,
                seq=count, stamp_ns=10**9 + count,
            )
        )  # fmt: skip
