"""Lease, lateness, permission and intake at their bounds, on clocks that are moved by hand."""

import math
import time
from collections.abc import Mapping
from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest

from hal.clock import ManualClock
from hal.errors import CommandRefused
from services.command import client_lease
from services.command.client_lease import NEEDS_LEASE, ClientLease
from services.command.intake import DEPTH, LOG_EVERY, NEWS_FOR, Commands
from services.command.lateness import WITHIN, Cycles, age_of, refuse_late
from services.command.lease import LONGEST, SHORTEST, STREAM, Lease, Tenure
from services.command.permission import HEARD_WITHIN, Permission
from services.errors import BadArguments, CommandHeld, LeaseLost, NoAnswer, ServiceError, TooLate
from services.wire.caller import LONGEST_NAME, UNKNOWN, Caller
from services.wire.messages import Command, Holder, Sample
from services.wire.streams import Arrival

ANNA, BERT, MODEL = Caller("anna", 11), Caller("bert", 22), Caller("model service", 99)


class Case:
    def __init__(self) -> None:
        self.clock = ManualClock()
        self.lease = Lease(self.clock)


@pytest.fixture
def case() -> Case:
    return Case()


def test_times_of_a_lease(case: Case) -> None:
    assert [SHORTEST, LONGEST, STREAM] == [0.2, 60.0, 1.0]
    assert [WITHIN, HEARD_WITHIN, NEWS_FOR, LOG_EVERY, DEPTH] == [1.0, 2.5, 5.0, 1.0, 8]
    for seconds in (0.2, 60.0, 1):
        case.lease.take(ANNA, seconds, 7)
        assert case.lease.left() == pytest.approx(seconds)
    for wrong in (0.199, 60.001, True):
        with pytest.raises(BadArguments):
            case.lease.take(ANNA, wrong)


def test_a_new_lease_is_nobodys() -> None:
    assert Tenure() == Tenure(UNKNOWN, -math.inf, 0, 0)
    assert not hasattr(Tenure(), "__dict__")
    with pytest.raises(FrozenInstanceError):
        Tenure().number = 1  # type: ignore[misc]
    lease = Lease(ManualClock())
    assert lease.tenure is None
    assert lease.left() == 0.0
    lease.check(UNKNOWN)
    lease.end_stream()
    lease.give_back(UNKNOWN, 0)
    assert lease.tenure is None


def test_the_holder_takes_its_lease_again_under_the_same_number(case: Case) -> None:
    first = case.lease.take(ANNA, 1.0)
    assert (first.caller, first.through, first.number > 0) == (ANNA, 0, True)
    case.lease.delegate(Caller("anna", 11, through=99))
    case.clock.advance(0.5)
    again = case.lease.take(ANNA, 5.0, first.number)
    assert (again.number, again.through) == (first.number, 99)
    assert case.lease.left() == pytest.approx(5.0)
    case.clock.advance(5.0)
    after = case.lease.take(ANNA, 1.0)
    assert after.number != first.number
    assert after.through == 0


def test_a_stream_becomes_a_lease_with_a_number_and_not_the_other_way_round(case: Case) -> None:
    case.lease.stream(ANNA)
    assert case.lease.tenure == Tenure(ANNA, case.clock.monotonic() + 1.0, 0, 0)
    case.lease.stream(BERT)  # does not take what another client has
    assert case.lease.tenure is not None
    assert case.lease.tenure.caller == ANNA
    held = case.lease.take(ANNA, 1.0)
    assert held.number > 0
    case.lease.stream(ANNA)
    assert case.lease.tenure == held


def test_renewing(case: Case) -> None:
    held = case.lease.take(ANNA, 1.0)
    renewed = case.lease.renew(ANNA, 3.0, held.number)
    assert (renewed.caller, renewed.number) == (ANNA, held.number)
    assert case.lease.left() == pytest.approx(3.0)
    for boot in (10, 12):
        with pytest.raises(CommandHeld, match=r"anna commands this robot for another 3\.0 s"):
            case.lease.renew(Caller("other", boot), 1.0, held.number)
    for number in (held.number - 1, held.number + 1, None):
        with pytest.raises(LeaseLost):
            case.lease.renew(ANNA, 1.0, number)
    case.lease.give_back(ANNA, held.number)
    with pytest.raises(LeaseLost):
        case.lease.renew(ANNA, 1.0, held.number)


def test_who_may_command_while_a_service_commands_for_the_holder(case: Case) -> None:
    case.lease.take(ANNA, 2.0)
    case.lease.delegate(Caller("anna", 11, through=99))
    for caller in (ANNA, MODEL, Caller("model service", 99, through=5)):
        case.lease.check(caller)
    for caller in (BERT, UNKNOWN, Caller("bert", 22, through=99), Caller("bert", 22, through=5)):
        with pytest.raises(CommandHeld):
            case.lease.check(caller)
    case.clock.advance(2.0)
    for caller in (ANNA, BERT, UNKNOWN):
        case.lease.check(caller)
    with pytest.raises(LeaseLost, match="The lease of anna has ended"):
        case.lease.check_stream(MODEL)
    case.lease.check_stream(BERT)
    case.lease.delegate(BERT)
    case.lease.check_stream(MODEL)  # the service is not tied to the lease that ended


def test_who_queries_through_the_service_that_streams(case: Case) -> None:
    case.lease.stream(MODEL)
    case.lease.check(Caller("bert", 22, through=99))
    for caller in (BERT, UNKNOWN, Caller("bert", 22, through=98)):
        with pytest.raises(CommandHeld):
            case.lease.check(caller)
    before = case.lease.tenure
    case.lease.delegate(Caller("bert", 22, through=99))  # it commands in its own name
    assert case.lease.tenure == before


def test_only_a_stream_is_ended_with_the_mode(case: Case) -> None:
    case.lease.stream(ANNA)
    case.lease.end_stream()
    assert case.lease.left() == 0.0
    case.lease.end_stream()
    held = case.lease.take(ANNA, 2.0)
    case.lease.end_stream()
    assert case.lease.tenure == held
    case.lease.stream(ANNA)
    with case.lease._lock:
        case.lease.end_stream()
    assert case.lease.tenure == held
    case.lease.end_stream()
    case.lease.take(ANNA, 1.0, held.number)  # no call keeps the lock


def test_giving_back_what_another_client_has(case: Case) -> None:
    held = case.lease.take(ANNA, 2.0)
    for other in (BERT, UNKNOWN, Caller("anna", 10)):
        with pytest.raises(CommandHeld):
            case.lease.give_back(other, held.number)
        assert case.lease.tenure == held
    case.lease.give_back(ANNA, held.number)
    assert case.lease.tenure is None
    assert case.lease._tenure.caller == ANNA  # whose lease ended is still known


def sample(cycle: int, boot: int = 7) -> Sample:
    return Sample(boot=boot, cycle=cycle, source="can", complete=True, values={}, age={}, valid={})


@pytest.mark.parametrize(
    ("cycle", "boot", "waited", "age"),
    [
        (1000, 7, 0.0, 0.0),
        (900, 7, 0.25, 0.75),
        (1100, 7, 0.0, -0.5),
        (1199, 7, 0.0, -0.995),
        (1200, 7, 0.0, math.inf),
        (1000, 6, 0.0, math.inf),
    ],
)
def test_the_age_of_a_cycle(cycle: int, boot: int, waited: float, age: float) -> None:
    """200 cycles per second."""
    assert age_of(cycle, boot, sample(1000), waited, 200.0) == pytest.approx(age)


@pytest.mark.parametrize(
    ("boot", "cycle", "age", "text"),
    [
        (7, 5, 1.0, None),
        (7, 5, -0.5, None),
        (7, 5, 1.01, "newest sample was 1.0 s old"),
        (7, 5, 2.26, "newest sample was 2.3 s old"),
        (7, 5, math.inf, "there was no cycle 5 in the last 1 s"),
        (0, 5, 2.0, "does not name its sender's newest sample"),
        (6, 5, 2.0, "another run of the HAL"),
        (8, 5, 2.0, "another run of the HAL"),
    ],
)
def test_requests_that_are_late(boot: int, cycle: int, age: float, text: str | None) -> None:
    caller = Caller("anna", 11, hal_boot=boot, cycle=cycle)
    if text is None:
        refuse_late(caller, 7, age)
    else:
        with pytest.raises(TooLate, match=text):
            refuse_late(caller, 7, age)


@pytest.mark.parametrize(("rate", "kept"), [(200.0, 400), (0.5, 2), (10.2, 21)])
def test_cycles_of_two_seconds_are_kept(rate: float, kept: int) -> None:
    clock = ManualClock()
    cycles = Cycles(rate, 5, clock)
    for cycle in range(1, 1001):
        cycles.note(cycle, clock.monotonic())
    cycles.check(Caller("", 1, hal_boot=5, cycle=1001 - kept))
    for cycle in (1000 - kept, 1001):
        with pytest.raises(TooLate):
            cycles.check(Caller("", 1, hal_boot=5, cycle=cycle))
    clock.advance(WITHIN)
    cycles.check(Caller("", 1, hal_boot=5, cycle=1000))
    clock.advance(0.001)
    with pytest.raises(TooLate):
        cycles.check(Caller("", 1, hal_boot=5, cycle=1000))


class Heard:
    """What a model service has heard of the holder."""

    def __init__(self) -> None:
        self.arrival: Arrival[Holder] | None = None

    def last(self) -> Arrival[Holder] | None:
        return self.arrival


class Model:
    def __init__(self) -> None:
        self.clock, self.heard, self.newest = ManualClock(), Heard(), Arrival(sample(500), 1000.0)
        self.permission = Permission(99, lambda: self.newest, self.heard, 100.0, self.clock)  # type: ignore[arg-type]

    def hear(self, name: str, boot: int, through: int = 0, left: float = 5.0) -> None:
        self.heard.arrival = Arrival(Holder(name=name, holder=boot, through=through, left=left), self.clock.monotonic())


@pytest.mark.parametrize(
    ("holder", "left", "waited", "is_valid"),
    [(11, 5.0, 2.5, True), (11, 5.0, 2.51, False), (11, 1.0, 0.99, True), (11, 1.0, 1.0, False), (0, 5.0, 0.0, False)],
)
def test_how_long_a_holder_is_believed(holder: int, left: float, waited: float, is_valid: bool) -> None:
    model = Model()
    assert model.permission._valid_holder() is None
    model.hear("anna", holder, left=left)
    model.clock.advance(waited)
    assert (model.permission._valid_holder() is not None) is is_valid
    if is_valid:
        model.permission.check(ANNA)
        for other in (BERT, UNKNOWN):
            with pytest.raises(CommandHeld, match="anna commands this robot"):
                model.permission.check(other)
    else:
        model.permission.check(BERT)


def test_anyone_directs_a_service_that_commands_itself() -> None:
    model = Model()
    model.hear("model service", 99)
    model.permission.check(BERT)
    model.permission.check(UNKNOWN)
    model.hear("nameless", 0)
    model.permission.check(UNKNOWN)


@pytest.mark.parametrize(
    ("cycle", "waited", "is_late"), [(500, 1.0, False), (500, 1.01, True), (450, 0.5, False), (449, 0.5, True)]
)
def test_a_request_that_may_move_the_robot_is_at_most_1_s_old(cycle: int, waited: float, is_late: bool) -> None:
    """100 cycles per second."""
    model = Model()
    model.clock.advance(waited)
    caller = Caller("anna", 11, hal_boot=7, cycle=cycle)
    if is_late:
        with pytest.raises(TooLate, match=r"1\.0 s old"):
            model.permission.may_move(caller)
    else:
        model.permission.may_move(caller)
    model.newest = None  # type: ignore[assignment]
    with pytest.raises(TooLate, match="another run of the HAL"):
        model.permission.may_move(caller)


def test_when_the_controller_is_disengaged() -> None:
    model = Model()
    permission = model.permission
    permission.begin(ANNA)
    assert permission.name == "model service, engaged by anna"
    for name, boot, through, text in (
        ("anna", 11, 0, ""),
        ("model service", 99, 0, ""),
        ("bert", 22, 0, "bert commands the robot now, so the controller was disengaged."),
        ("anna", 11, 99, ""),
        ("anna", 11, 0, "The lease of anna has ended, so the controller was disengaged."),
        ("bert", 22, 99, ""),  # the HAL lets the service command for this client
    ):
        model.hear(name, boot, through)
        assert permission.ended() == text
    permission.begin(BERT)
    model.hear("bert", 22)
    assert permission.ended() == ""
    model.heard.arrival = None
    assert permission.ended() == ""


def test_a_query_on_behalf_of_a_caller() -> None:
    model = Model()
    caller = Caller("anna", 11, 0, 3, 4)
    assert model.permission.on_behalf(caller) == Caller("anna", 11, 99, 7, 500)
    model.newest = None  # type: ignore[assignment]
    assert model.permission.on_behalf(caller) == Caller("anna", 11, 99, 0, 0)
    assert model.permission.engaged_by == Caller()


class Robot:
    """A robot that notes its commands."""

    def __init__(self) -> None:
        self.commands: list[tuple[list[float], int]] = []

    def command(self, values: np.ndarray, cycle: int) -> None:
        if values[0] < 0:
            raise CommandRefused("negative")
        self.commands.append((values.tolist(), cycle))


def test_commands_are_for_this_signal_this_run_and_from_the_holder(case: Case) -> None:
    robot = Robot()
    commands = Commands(robot, "q", 7, case.lease)  # type: ignore[arg-type]

    def follow(signal: str = "q", boot: int = 11, hal_boot: int = 7, value: float = 1.0, name: str = "anna") -> None:
        message = Command(name=name, boot=boot, signal=signal, values=np.array([value]), cycle=5, hal_boot=hal_boot)
        commands.follow(message)

    assert commands.sender == 0
    for changes, error, text in (
        ({"signal": "p"}, CommandRefused, "A command of 'p' was refused. This robot takes 'q'"),
        ({"hal_boot": 6}, CommandRefused, "another run of the HAL"),
        ({"hal_boot": 8}, CommandRefused, "another run of the HAL"),
        ({"boot": 0}, CommandHeld, "without its sender's `boot`"),
        ({"value": -1.0}, CommandRefused, "negative"),
    ):
        with pytest.raises(error, match=text):
            follow(**changes)  # type: ignore[arg-type]
    assert (robot.commands, commands.sender, case.lease.tenure) == ([], 0, None)  # a refused command takes no lease
    follow(name="x" * 500)
    assert (robot.commands, commands.sender) == ([([1.0], 5)], 11)
    assert case.lease.tenure is not None
    assert len(case.lease.tenure.caller.name) == LONGEST_NAME
    with pytest.raises(CommandHeld):
        follow(boot=22)
    assert commands.sender == 11


class Link:
    """A HAL that answers, or does not."""

    def __init__(self) -> None:
        self.held_lease: ClientLease | None = None
        self.error: Exception | None = None
        self.asked: list[tuple[str, str, Mapping[str, Any] | None]] = []

    def ask(self, service: str, verb: str, arguments: Mapping[str, Any] | None = None, timeout: float = 0.0) -> Any:
        self.asked.append((service, verb, arguments))
        if self.error is not None:
            raise self.error
        return {}


def test_a_lease_is_asked_of_the_hal_and_ends_a_length_after_the_request(monkeypatch: pytest.MonkeyPatch) -> None:
    link, now = Link(), [50.0]
    monkeypatch.setattr("services.command.client_lease.time.monotonic", lambda: now[0])
    with ClientLease(link, 30.0) as lease:
        assert link.asked == [("hal", "lease", {"seconds": 30.0, "number": lease._number, "new": True})]
        assert (lease._number > 0, lease._end, link.held_lease) == (True, 80.0, lease)
        now[0] = 79.9
        lease.check()
        now[0] = 80.0
        with pytest.raises(LeaseLost, match=r"no longer commands the robot: the lease was not renewed for 30 s\."):
            lease.check()
        now[0] = 60.0
        with pytest.raises(LeaseLost):  # a lost lease stays lost
            lease.check()
    assert link.asked[-1] == ("hal", "release", {"number": lease._number})
    assert link.held_lease is None


@pytest.mark.parametrize(
    ("error", "is_lost"),
    [(NoAnswer("no answer"), False), (TooLate("late"), False), (LeaseLost("gone"), True), (ValueError("odd"), True)],
)
@pytest.mark.long
def test_errors_that_end_a_lease_at_once_and_those_that_do_not(error: Exception, is_lost: bool) -> None:
    link = Link()
    with ClientLease(link, 0.6) as lease:
        link.error = error
        time.sleep(0.25)
        assert (lease.text != "") is is_lost
        assert lease._renewal_fault == ("" if is_lost else str(error))
        assert link.asked[1][2] == {"seconds": 0.6, "number": lease._number}
        link.error = None
        if not is_lost:
            time.sleep(0.25)
            assert lease._renewal_fault == ""
            assert lease.text == ""


def test_a_lease_that_cannot_be_released_expires_by_itself(caplog: pytest.LogCaptureFixture) -> None:
    link = Link()
    with ClientLease(link, 5.0):
        link.error = ServiceError("odd")
    assert "expires by itself: odd" in caplog.text
    assert client_lease.RELEASE_TIMEOUT == 1.0
    assert set(NEEDS_LEASE) == {"hal", "model"}
