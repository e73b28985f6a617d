"""The model service's rules for who may direct it, and the intake of targets."""

from collections.abc import Iterator

import numpy as np
import pytest
import zenoh
from small_arm import eventually

from hal.clock import ManualClock
from services.command.intake import DEPTH, Intake
from services.command.permission import HEARD_WITHIN, Permission
from services.errors import CommandHeld, TooLate
from services.wire import keys, messages
from services.wire.caller import Caller
from services.wire.messages import Holder, Sample, Target
from services.wire.session import close_session, open_session
from services.wire.streams import Arrival, Publisher, Reader

MODEL, HAL, ANNA, BERT = 1000, 7, 11, 22
RATE = 100.0


@pytest.fixture
def session(robot: str) -> Iterator[zenoh.Session]:
    opened = open_session(robot, "client")
    yield opened
    close_session(opened)


class Told:
    """A model service that hears of the holder, and has a sample."""

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        self.clock = ManualClock()
        self._heard = Reader(session, keys.holder(robot), Holder, self.clock)
        self._says = Publisher(session, keys.holder(robot), Holder, HAL)
        self.fresh: Arrival[Sample] | None = None
        self.permission = Permission(MODEL, lambda: self.fresh, self._heard, RATE, self.clock)

    def sample(self, cycle: int) -> None:
        sample = Sample(boot=HAL, cycle=cycle, source="can", complete=True, values={}, age={}, valid={})
        self.fresh = Arrival(sample, self.clock.monotonic())

    def holder(self, name: str, boot: int, through: int = 0, left: float = 5.0) -> None:
        before = self._heard.last()
        self._says.put(Holder(name=name, holder=boot, through=through, left=left))
        eventually(lambda: self._heard.last() not in (None, before))


@pytest.fixture
def report(session: zenoh.Session, robot: str) -> Told:
    return Told(session, robot)


def anna(cycle: int = 500) -> Caller:
    return Caller("anna", ANNA, 0, HAL, cycle)


def test_while_nobody_commands_anybody_may(report: Told) -> None:
    report.permission.check(Caller())
    report.holder("", 0, left=0.0)
    report.permission.check(Caller())


def test_while_somebody_commands_only_that_one_may(report: Told) -> None:
    report.holder("anna", ANNA)
    report.permission.check(anna())
    for other in (Caller("bert", BERT), Caller()):
        with pytest.raises(CommandHeld, match="anna commands this robot"):
            report.permission.check(other)


def test_while_the_model_itself_commands_anybody_may(report: Told) -> None:
    report.holder("model service", MODEL)
    report.permission.check(Caller("bert", BERT))


@pytest.mark.parametrize(("left", "waited"), [(5.0, HEARD_WITHIN + 0.01), (1.0, 1.01)])
def test_what_the_hal_told_is_believed_for_as_long_as_it_holds(report: Told, left: float, waited: float) -> None:
    report.holder("anna", ANNA, left=left)
    report.clock.advance(waited - 0.02)
    with pytest.raises(CommandHeld):
        report.permission.check(Caller("bert", BERT))
    report.clock.advance(0.02)
    report.permission.check(Caller("bert", BERT))


def test_what_moves_the_robot_is_done_at_once_or_never(report: Told) -> None:
    with pytest.raises(TooLate):
        report.permission.may_move(anna())
    report.sample(500)
    report.permission.may_move(anna(500))
    report.permission.may_move(anna(401))
    for caller in (anna(399), Caller("anna", ANNA), Caller("anna", ANNA, 0, HAL + 1, 500), anna(700)):
        with pytest.raises(TooLate):
            report.permission.may_move(caller)
    report.clock.advance(1.01)
    with pytest.raises(TooLate, match=r"1\.0 s old"):
        report.permission.may_move(anna(500))


def test_a_published_target_is_judged_by_who_sent_it(report: Told) -> None:
    report.sample(500)
    report.holder("anna", ANNA)
    report.permission.may_set(Target(boot=ANNA, cycle=499, hal_boot=HAL, signal="s", values=np.zeros(1)))
    with pytest.raises(CommandHeld):
        report.permission.may_set(Target(boot=BERT, cycle=499, hal_boot=HAL, signal="s", values=np.zeros(1)))
    with pytest.raises(TooLate):
        report.permission.may_set(Target(boot=ANNA, cycle=300, hal_boot=HAL, signal="s", values=np.zeros(1)))


def test_the_controller_lets_go_with_the_lease_that_it_was_engaged_under(report: Told) -> None:
    report.permission.begin(anna())
    assert report.permission.ended() == "", "the HAL has not told yet"
    report.holder("anna", ANNA, through=MODEL)
    assert report.permission.ended() == ""
    assert "engaged by anna" in report.permission.name
    report.clock.advance(HEARD_WITHIN + 0.01)
    assert report.permission.ended() == "The lease of anna has ended, so the controller was disengaged."
    report.permission.begin(anna())
    assert report.permission.ended() == "", "engaged anew"


def test_the_controller_lets_go_when_somebody_else_commands(report: Told) -> None:
    report.permission.begin(anna())
    report.holder("model service", MODEL)
    assert report.permission.ended() == ""
    report.holder("bert", BERT)
    assert report.permission.ended() == "bert commands the robot now, so the controller was disengaged."


def test_it_asks_the_hal_for_whoever_asked_it_with_what_it_has_seen_itself(report: Told) -> None:
    report.sample(640)
    assert report.permission.on_behalf(anna(500)) == Caller("anna", ANNA, MODEL, HAL, 640)


def test_targets_come_in_their_order_and_what_is_none_is_counted(session: zenoh.Session, robot: str) -> None:
    targets: list[Target] = []
    intake = Intake(session, keys.target(robot), Target, targets.append)
    good = [messages.encode(Target(boot=ANNA, signal="s", values=np.array([float(n)])), seq=n) for n in range(3)]
    for payload in (good[0], b"", b"\xc1 no msgpack", good[1], good[1][:-3], good[2]):
        session.put(keys.target(robot), payload)
    session.put("gemuco/**", good[0])
    eventually(lambda: intake.take() or (intake.counters["accepted"], intake.counters["malformed"]) == (3, 4))
    assert [float(target.values[0]) for target in targets] == [0.0, 1.0, 2.0]


def test_of_too_many_targets_the_newest_are_kept(session: zenoh.Session, robot: str) -> None:
    targets: list[Target] = []
    intake = Intake(session, keys.target(robot), Target, targets.append)
    last = 3 * DEPTH
    for number in range(last + 1):
        session.put(keys.target(robot), messages.encode(Target(signal="s", values=np.array([float(number)]))))
    intake.take()  # the session's own puts have arrived when they return
    assert [float(target.values[0]) for target in targets] == list(range(last + 1 - DEPTH, last + 1))
