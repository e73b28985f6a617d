"""Two clients and one robot, over real sessions: who commands, who is refused, and what comes too late."""

import logging
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest
from small_arm import description, eventually
from test_command_intake import Wires

from hal.clock import SystemClock
from hal.config import RobotConfig
from hal.robot import Robot
from services.client import Client
from services.errors import BadArguments, CommandHeld, LeaseLost, TooLate
from services.hardware.hal_service import HalService
from services.process.service import Service
from services.wire import keys, messages, query
from services.wire.caller import Caller
from services.wire.messages import Command

SECONDS = 1.0


class Hal:
    """A HAL of wires that are at once where they are asked to be, in this process, that can die and come back."""

    def __init__(self, robot: str) -> None:
        self.config = RobotConfig.model_validate(description(robot))
        self.start()

    def start(self) -> None:
        self.service = Service(self.config.robot, "hal").__enter__()
        self.body = Robot(self.config, [Wires(self.config, SystemClock())])
        self._stop = threading.Event()
        self._made = HalService(self.config, self.body, self.service)
        self._thread = threading.Thread(target=self._made.run, args=(self._stop,))
        self._thread.start()

    def end(self) -> None:
        self._stop.set()
        self._thread.join(30.0)
        self.service.__exit__(None, None, None)

    def commands(self) -> dict[str, Any]:
        return dict(self._made.status().facts["commands"])


@pytest.fixture
def hal(robot: str) -> Iterator[Hal]:
    found = Hal(robot)
    yield found
    found.end()


@pytest.fixture
def anna(hal: Hal, robot: str) -> Iterator[Client]:
    with Client(robot, name="anna") as client:
        yield client


@pytest.fixture
def bert(hal: Hal, robot: str) -> Iterator[Client]:
    with Client(robot, name="bert") as client:
        yield client


def _command(client: Client, value: float = 0.0) -> None:
    sample = client.next_sample()
    assert sample is not None
    client.command("muscle_length", np.full(2, value), sample)


@pytest.mark.long
def test_a_second_client_is_refused_by_name_and_may_stop(hal: Hal, anna: Client, bert: Client) -> None:
    with anna.lease(5.0):
        eventually(lambda: bert.holder().name == "anna")
        anna.enable()
        eventually(lambda: hal.body.mode == "hold")
        for refused in (
            bert.lease().__enter__,
            bert.enable,
            bert.disable,
            bert.reset,
            lambda: bert.home("wires"),
            lambda: bert.tare("wires"),
        ):
            with pytest.raises(
                CommandHeld, match=r"anna commands this robot for another .* s, and longer if it continues"
            ):
                refused()
        with pytest.raises(CommandHeld, match="one lease is enough"):
            anna.lease().__enter__()
        eventually(lambda: _command(anna) or hal.body.mode == "follow")
        _command(bert, 0.1)
        eventually(lambda: hal.commands()["refused"] > 0)
        assert "anna commands this robot" in hal.commands()["text"]
        assert (hal.body.cycle()[1].desired != 0.1).all()
        bert.stop()
        eventually(lambda: _command(anna) or hal.body.mode == "off")
        _command(anna)
        anna.sample()
        assert hal.body.mode == "off"  # what goes on after a stop does not start it again
    bert.enable()


@pytest.mark.long
def test_a_lease_is_renewed_until_its_end_also_when_that_is_an_exception(anna: Client, bert: Client) -> None:
    with pytest.raises(ZeroDivisionError), anna.lease(0.6):
        time.sleep(1.2)
        anna.reset()
        with pytest.raises(CommandHeld, match="anna"):
            bert.reset()
        raise ZeroDivisionError
    bert.reset()
    with pytest.raises(BadArguments, match="A lease has a length of"):
        bert.lease(float("nan")).__enter__()
    anna.reset()


_HOLDER = """
import sys, time
from services.client import Client
with Client(sys.argv[1], name="carl") as client, client.lease(float(sys.argv[2])):
    print("holds", flush=True)
    time.sleep(60)
"""


@pytest.mark.long
def test_a_holder_that_is_killed_keeps_others_out_no_longer_than_its_lease(anna: Client, robot: str) -> None:
    holder = subprocess.Popen([sys.executable, "-c", _HOLDER, robot, str(SECONDS)], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    assert holder.stdout.readline() == "holds\n"
    with pytest.raises(CommandHeld, match="carl commands"):
        anna.reset()
    holder.kill()
    holder.communicate()
    killed = time.monotonic()

    def is_free() -> bool:
        try:
            anna.reset()
        except CommandHeld:
            return False
        return True

    eventually(is_free)
    assert time.monotonic() - killed < SECONDS + 2.0


@pytest.mark.long
def test_a_hal_that_was_restarted_has_forgotten_the_holder_who_hears_of_it(hal: Hal, anna: Client) -> None:
    with anna.lease(5.0) as lease:
        hal.end()
        hal.start()
        eventually(lambda: bool(lease.text))
        with pytest.raises(LeaseLost, match="This client no longer commands the robot: "):
            anna.enable()
        sample = anna.next_sample()
        assert sample is not None
        with pytest.raises(LeaseLost):
            anna.command("muscle_length", np.zeros(2), sample)
        anna.stop()
        assert anna.describe("hal")["robot"] == anna.robot
    anna.enable()


@pytest.mark.long
def test_a_holder_that_was_frozen_longer_than_its_lease_knows_that_it_commands_no_more(anna: Client) -> None:
    lease = anna.lease(0.6)
    with lease:
        lease._stop.set()  # as if its thread had not come to run
        eventually(lambda: bool(lease.text))
        with pytest.raises(LeaseLost, match=r"not renewed for 0\.6 s"):
            anna.reset()
    anna.reset()


def test_who_streams_without_a_lease_commands_until_a_second_after(hal: Hal, anna: Client, bert: Client) -> None:
    anna.enable()
    eventually(lambda: hal.body.mode == "hold")
    eventually(lambda: _command(anna) or hal.body.mode == "follow")
    with pytest.raises(CommandHeld, match="anna commands"):
        bert.lease().__enter__()
    with anna.lease():  # what it has it may keep
        pass
    with bert.lease():
        eventually(lambda: anna.holder().name == "bert")


@pytest.mark.long
@pytest.mark.parametrize("verb", ["enable", "reset", "home", "tare", "lease"])
def test_what_may_move_the_robot_is_not_done_late(hal: Hal, anna: Client, verb: str) -> None:
    """As a link does that was cut: it delivers later what had been asked."""
    run, cycle = anna._link.seen()
    key = keys.verb(anna.robot, "hal", verb)
    asked = replace(anna._link.caller, hal_boot=run, cycle=cycle)
    eventually(lambda: anna._link.seen()[1] - cycle > 1.1 * hal.config.rates.hal)
    for caller, says in (
        (asked, "s old when the request arrived|there was no cycle"),
        (anna._link.caller, "does not name its sender's newest sample"),
        (replace(asked, hal_boot=run + 1), "another run of the HAL"),
    ):
        with pytest.raises(TooLate, match=says):
            query.ask(anna.session, key, {"seconds": 5.0}, 5.0, caller)
    assert hal.body.mode == "off"
    assert anna.holder().name == ""
    query.ask(anna.session, keys.verb(anna.robot, "hal", "disable"), caller=asked)  # letting go is never too late


def _nested(depth: int) -> bytes:
    return b"\x81\xa1a" * depth + b"\xc0"


NASTY = {
    "nothing": b"",
    "no msgpack": b"\xc1\xff",
    "a list": msgpack.packb([1, 2]),
    "a later version": msgpack.packb({"v": 3}),
    "a version that is none": msgpack.packb({"v": {"a": [1]}}),
    "nested": _nested(400),
    "nested without end": _nested(100_000),
    "cut off": msgpack.packb({"name": "anna", "boot": 5})[:-2],
    "too long": b"\x00" * (messages.MAX_BYTES + 1),
    "many keys": msgpack.packb({str(number): number for number in range(50_000)}),
    "numbers as names": msgpack.packb({1: 2}),
    "wrong types": msgpack.packb({"boot": "5", "cycle": 1.5, "name": 3, "seconds": [float("nan")], "reason": {}}),
    "beyond 64 bit": b"\x81\xa5cycle\xcf" + b"\xff" * 8,
    "negative": msgpack.packb({"cycle": -(2**63), "hal_boot": -1, "boot": -1}),
    "signs for a terminal": msgpack.packb({"name": "\x1b[2J\nERROR root: all is well", "reason": "\x1b[2J\n"}),
}


@pytest.mark.parametrize("verb", ["enable", "disable", "reset", "home", "tare", "lease", "release", "stop", "estop"])
@pytest.mark.long
def test_whatever_comes_to_a_verb_is_answered_and_only_what_stops_is_done(
    hal: Hal, anna: Client, verb: str, caplog: pytest.LogCaptureFixture
) -> None:
    anna.sample(timeout=10.0)
    key = keys.verb(anna.robot, "hal", verb)
    for what, nasty in NASTY.items():
        for payload, attachment in ((nasty, None), (nasty, nasty), (b"", nasty)):
            found = [reply.ok for reply in anna.session.get(key, payload=payload, attachment=attachment, timeout=10.0)]
            assert len(found) == 1, what
            assert found[0] is not None, what
            answer = msgpack.unpackb(found[0].payload.to_bytes())
            assert ("ok" in answer) if verb in ("stop", "estop") else answer, what
            assert "\x1b" not in str(answer) and "\n" not in answer.get("text", ""), what
            if verb == "estop":
                break  # each takes its time
    assert hal.body.mode in ("off", "fault" if verb == "estop" else "off")
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]
    assert anna.sample(timeout=5.0) is not None


def test_who_looks_at_everything_sets_nothing_off(hal: Hal, anna: Client) -> None:
    anna.sample(timeout=10.0)
    report = [reply.ok for reply in anna.session.get(f"gemuco/{anna.robot}/hal/do/*", timeout=5.0)]
    answers = [msgpack.unpackb(one.payload.to_bytes()) for one in report if one is not None]
    assert len(answers) >= 10
    assert all("asks several verbs at once" in answer["text"] for answer in answers)
    assert hal.body.mode == "off"


@pytest.mark.long
def test_whatever_comes_as_a_command_moves_nothing_and_the_cycle_turns(hal: Hal, anna: Client) -> None:
    anna.enable()
    eventually(lambda: hal.body.mode == "hold")
    sample = anna.next_sample()
    assert sample is not None
    good = Command(
        signal="muscle_length", values=np.full(2, 0.1), cycle=sample.cycle, hal_boot=sample.boot, boot=anna.boot
    )
    body = msgpack.unpackb(messages.encode(good))
    wrong = [*NASTY.values(), messages.encode(good)[:-3]]
    wrong += [
        msgpack.packb(body | change)
        for change in (
            {"cycle": 2**64 - 1}, {"cycle": -1}, {"v": True}, {"v": 2.0}, {"signal": "\x1b[2J" * 9999},
            {"values": np.full(2, np.inf).tobytes()}, {"values": b""}, {"name": ["anna"]}, {"cycle": 1.5},
        )
    ]  # fmt: skip
    before = hal.commands()
    for data in wrong:
        anna.session.put(keys.command(anna.robot), data)
        anna.next_sample()
    anna.session.put(f"gemuco/{anna.robot}/hal/*", messages.encode(good))
    anna.session.delete(keys.command(anna.robot))

    def count(now: dict[str, Any]) -> int:
        return int(now["refused"] + now["malformed"] - before["refused"] - before["malformed"])

    eventually(lambda: count(hal.commands()) == len(wrong) + 2)
    now = anna.sample(timeout=5.0)
    assert now is not None
    np.testing.assert_array_equal(now.values["muscle_length"], sample.values["muscle_length"])
    assert hal.commands()["accepted"] == before["accepted"]
    assert hal.commands()["text"].isprintable()


def test_a_caller_is_told_by_name_and_not_by_what_it_writes_into_logs(hal: Hal, anna: Client) -> None:
    says = pytest.raises(CommandHeld, match=r"^eve\?\[2J\?root: all is well commands this robot")
    with Client(anna.robot, name="eve\x1b[2J\nroot: all is well") as eve, eve.lease(), says:
        anna.reset()
    assert str(Caller("", 5)) == "client 5"
