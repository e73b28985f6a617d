"""Who commands: the lease by itself, on a clock that is moved by hand."""

import threading

import numpy as np
import pytest

from hal.clock import ManualClock
from services.command.lateness import WITHIN, Cycles, age_of
from services.command.lease import LONGEST, STREAM, Lease
from services.errors import BadArguments, CommandHeld, LeaseLost, TooLate
from services.wire.caller import UNKNOWN, Caller
from services.wire.messages import Sample
from services.wire.plain_text import plain, shown

ANNA, BERT = Caller("anna@ws1 (pid 7)", 11), Caller("bert@ws2 (pid 8)", 22)
MODEL = Caller("model service, engaged by anna", 99)


class Case:
    def __init__(self) -> None:
        self.clock = ManualClock()
        self.lease = Lease(self.clock)


@pytest.fixture
def case() -> Case:
    return Case()


def test_a_second_caller_is_refused_with_the_holders_name(case: Case) -> None:
    case.lease.take(ANNA, 2.0)
    for refused in (case.lease.check, case.lease.check_stream, lambda who: case.lease.take(who, 1.0)):
        with pytest.raises(CommandHeld, match=r"anna@ws1 \(pid 7\) commands this robot for another 2\.0 s"):
            refused(BERT)
    case.lease.check(ANNA)
    case.lease.check_stream(ANNA)
    with pytest.raises(CommandHeld, match="anna"):
        case.lease.check(UNKNOWN)


def test_it_runs_out_and_the_next_one_may_take_it(case: Case) -> None:
    case.lease.take(ANNA, 2.0)
    case.clock.advance(1.999)
    with pytest.raises(CommandHeld):
        case.lease.take(BERT, 1.0)
    case.clock.advance(0.001)
    assert case.lease.tenure is None
    assert case.lease.left() == 0.0
    case.clock.advance(0.5)
    assert case.lease.left() == 0.0
    case.lease.take(BERT, 1.0)
    with pytest.raises(CommandHeld, match="bert"):
        case.lease.check(ANNA)


def test_a_program_that_was_restarted_is_another_one(case: Case) -> None:
    case.lease.take(ANNA, 2.0)
    with pytest.raises(CommandHeld, match="anna"):
        case.lease.take(Caller(ANNA.name, 12), 2.0)


def test_a_renewal_goes_on_with_the_lease_that_was_taken_and_with_no_other(case: Case) -> None:
    held = case.lease.take(ANNA, 1.0)
    case.clock.advance(0.9)
    case.lease.renew(ANNA, 1.0, held.number)
    case.clock.advance(0.9)
    case.lease.check(ANNA)
    case.clock.advance(0.2)
    with pytest.raises(LeaseLost, match="not renewed in time, or the HAL was restarted"):
        case.lease.renew(ANNA, 1.0, held.number)
    again = case.lease.take(ANNA, 1.0)
    assert again.number != held.number
    with pytest.raises(LeaseLost):
        case.lease.renew(ANNA, 1.0, held.number)
    with pytest.raises(CommandHeld, match="anna"):
        case.lease.renew(BERT, 1.0, again.number)
    with pytest.raises(LeaseLost):
        Lease(case.clock).renew(ANNA, 1.0, again.number)  # that of a HAL that was restarted


@pytest.mark.parametrize(
    "seconds", [0, -1, 0.1, LONGEST + 1, float("nan"), float("inf"), True, None, "5", [1.0], 2**63, {}]
)
def test_what_is_no_time_for_a_lease_is_refused(case: Case, seconds: object) -> None:
    with pytest.raises(BadArguments, match=r"A lease has a length of 0\.2 to 60 s"):
        case.lease.take(ANNA, seconds)
    held = case.lease.take(ANNA, 1)
    with pytest.raises(BadArguments):
        case.lease.renew(ANNA, seconds, held.number)


def test_who_does_not_tell_its_boot_may_only_do_what_needs_no_lease(case: Case) -> None:
    with pytest.raises(BadArguments, match="`boot`"):
        case.lease.take(UNKNOWN, 1.0)
    with pytest.raises(CommandHeld, match="`boot`"):
        case.lease.check_stream(UNKNOWN)
    case.lease.check(UNKNOWN)


def test_who_streams_commands_while_nobody_does_commands_for_as_long_as_it_goes_on(case: Case) -> None:
    for _ in range(20):
        case.lease.check_stream(ANNA)
        case.lease.stream(ANNA)
        case.clock.advance(0.9 * STREAM)
        with pytest.raises(CommandHeld, match="anna"):
            case.lease.check_stream(BERT)
    case.clock.advance(0.1 * STREAM)
    case.lease.check_stream(BERT)


def test_a_stream_ends_with_the_mode_in_which_it_is_followed_and_a_lease_does_not(case: Case) -> None:
    case.lease.stream(ANNA)
    case.lease.end_stream()
    case.lease.check(BERT)
    case.lease.take(ANNA, 1.0)
    case.lease.stream(ANNA)
    case.lease.end_stream()
    with pytest.raises(CommandHeld):
        case.lease.check(BERT)


def test_a_stream_does_not_make_a_lease_longer(case: Case) -> None:
    case.lease.take(ANNA, 1.0)
    case.clock.advance(0.9)
    case.lease.stream(ANNA)
    assert case.lease.left() == pytest.approx(0.1)


def test_a_service_commands_for_the_holder_and_no_longer_than_that(case: Case) -> None:
    case.lease.take(ANNA, 1.0)
    with pytest.raises(CommandHeld, match="anna"):
        case.lease.check_stream(MODEL)
    case.lease.delegate(Caller(ANNA.name, ANNA.boot, through=MODEL.boot))
    case.lease.check_stream(MODEL)
    with pytest.raises(CommandHeld, match="anna"):
        case.lease.take(MODEL, 1.0)  # through a lease is not to have it
    with pytest.raises(CommandHeld, match="anna"):
        case.lease.delegate(Caller(BERT.name, BERT.boot, through=MODEL.boot))
    case.clock.advance(1.0)
    with pytest.raises(LeaseLost, match="The lease of anna"):
        case.lease.check_stream(MODEL)
    case.lease.check(BERT)


def test_after_a_lease_was_given_back_the_service_is_to_be_engaged_anew(case: Case) -> None:
    held = case.lease.take(ANNA, 5.0)
    case.lease.delegate(Caller(ANNA.name, ANNA.boot, through=MODEL.boot))
    with pytest.raises(CommandHeld):
        case.lease.give_back(BERT, held.number)
    case.lease.check_stream(MODEL)
    case.lease.give_back(ANNA, held.number)
    with pytest.raises(LeaseLost):
        case.lease.check_stream(MODEL)
    case.lease.delegate(Caller(BERT.name, BERT.boot, through=MODEL.boot))  # nobody commands: for whoever asks
    case.lease.check_stream(MODEL)


def test_the_boot_that_is_published_neither_ends_a_lease_nor_takes_it(case: Case) -> None:
    held = case.lease.take(ANNA, 5.0)
    thief = Caller("thief", ANNA.boot)
    for number in (0, None, 1, held.number + 1, str(held.number), float(held.number) + 0.5):
        with pytest.raises(CommandHeld, match="anna"):
            case.lease.give_back(thief, number)
    for number in (0, 1, held.number ^ 1):
        with pytest.raises(CommandHeld, match="anna"):
            case.lease.take(thief, 60.0, number)
        with pytest.raises(LeaseLost):
            case.lease.renew(thief, 60.0, number)
    assert case.lease.tenure == held


def test_a_request_whose_answer_was_lost_is_repeated_with_its_number(case: Case) -> None:
    first = case.lease.take(ANNA, 2.0, 77)
    case.clock.advance(1.0)
    again = case.lease.take(ANNA, 2.0, 77)
    assert (first.number, again.number, case.lease.left()) == (77, 77, pytest.approx(2.0))
    for wrong in (-1, 1 << 53, True, 7.0, "77", None):
        with pytest.raises(BadArguments, match="The number of a lease is a whole number"):
            case.lease.take(ANNA, 2.0, wrong)
    case.lease.give_back(ANNA, 77)
    case.lease.give_back(ANNA, 77)  # its answer was lost too
    assert case.lease.tenure is None


def test_while_the_model_commands_by_itself_whoever_asks_it_is_answered(case: Case) -> None:
    case.lease.stream(MODEL)
    case.lease.check(Caller(BERT.name, BERT.boot, through=MODEL.boot))
    with pytest.raises(CommandHeld, match="model service, engaged by anna"):
        case.lease.check(BERT)


def test_a_service_that_was_engaged_without_a_lease_gives_way_to_the_next_one(case: Case) -> None:
    case.lease.delegate(Caller(ANNA.name, ANNA.boot, through=MODEL.boot))  # one request, as of `gemuco query engage`
    case.lease.stream(MODEL)
    tenure = case.lease.take(BERT, 2.0)
    assert (tenure.caller, tenure.through) == (BERT, 0)
    with pytest.raises(CommandHeld, match="bert"):
        case.lease.check_stream(MODEL)
    case.lease.stream(MODEL)  # what was on its way does not take it back
    assert case.lease.tenure == tenure
    with pytest.raises(CommandHeld, match="bert"):
        case.lease.take(ANNA, 1.0)


def test_a_client_that_streams_by_itself_does_not_give_way(case: Case) -> None:
    case.lease.delegate(Caller(ANNA.name, ANNA.boot, through=MODEL.boot))
    case.lease.stream(ANNA)
    with pytest.raises(CommandHeld, match="anna"):
        case.lease.take(BERT, 2.0)


def test_of_many_who_take_it_at_once_one_has_it() -> None:
    lease, refused, start = Lease(), [], threading.Barrier(16)

    def take(boot: int) -> None:
        start.wait()
        try:
            lease.take(Caller("", boot), 30.0)
        except CommandHeld as error:
            refused.append(str(error))

    threads = [threading.Thread(target=take, args=(boot,)) for boot in range(1, 17)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(refused) == 15
    assert lease.tenure is not None
    assert all(f"client {lease.tenure.caller.boot} commands" in text for text in refused)


def test_a_stream_does_not_wait_for_who_holds_the_lock(case: Case) -> None:
    with case.lease._lock:
        case.lease.check_stream(ANNA)
        case.lease.stream(ANNA)
        case.lease.end_stream()
    assert case.lease.tenure is None
    case.lease.stream(ANNA)
    assert case.lease.tenure is not None


class TestWhatMayMoveIsAskedNow:
    def test_by_the_hal_on_its_own_clock(self) -> None:
        clock = ManualClock()
        cycles = Cycles(200.0, 5, clock)

        def ask(cycle: int, hal_boot: int = 5) -> None:
            cycles.check(Caller("", 1, hal_boot=hal_boot, cycle=cycle))

        with pytest.raises(TooLate):
            ask(0)
        for cycle in range(1, 1001):
            clock.advance(0.005)
            cycles.note(cycle, clock.monotonic())
        ask(1000)
        ask(1000 - round((WITHIN - 0.01) / 0.005))
        with pytest.raises(TooLate, match=r"was 1\.2 s old when the request arrived"):
            ask(1000 - 240)
        for cycle in (1001, 10**9, -5, 1, 2**64 - 1, -(2**63)):
            with pytest.raises(TooLate, match="there was no cycle"):
                ask(cycle)
        with pytest.raises(TooLate, match="another run of the HAL"):
            ask(1000, 6)
        with pytest.raises(TooLate, match="does not name its sender's newest sample"):
            cycles.check(UNKNOWN)
        clock.advance(3.0)  # the HAL was frozen: what waited meanwhile is old, though no cycle has been
        with pytest.raises(TooLate, match=r"was 3\.0 s old"):
            ask(1000)

    def test_by_others_by_the_newest_sample_that_they_have(self) -> None:
        newest = Sample(cycle=1000, boot=7, source="can", complete=True, values={}, age={}, valid={})
        assert age_of(1000, newest.boot, newest, 0.02, 200.0) == pytest.approx(0.02)
        assert age_of(800, newest.boot, newest, 0.02, 200.0) == pytest.approx(1.02)
        assert age_of(1002, newest.boot, newest, 0.02, 200.0) == pytest.approx(0.01)
        assert np.isinf(age_of(2000, newest.boot, newest, 0.02, 200.0))
        assert np.isinf(age_of(1000, newest.boot + 1, newest, 0.02, 200.0))


def test_what_others_write_is_one_short_line_in_a_log() -> None:
    assert plain("an\x1b[31mna\nERROR all is lost\r\u202e") == "an?[31mna?ERROR all is lost??"
    assert len(plain("x" * 10_000)) == 300
    nested: list[object] = []
    for _ in range(100_000):
        nested = [nested]
    assert shown(nested) == "something of type list"
    while nested:
        nested = nested.pop()  # type: ignore[assignment]
    assert shown("a\n" * 100) == f"'{'a?' * 28}a...'"
