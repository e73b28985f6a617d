"""The client's side of a lease, against the real lease without a network between them."""

import time
from collections.abc import Iterator, Mapping
from typing import Any

import pytest

from services.command.client_lease import NEEDS_LEASE, RENEWALS, SECONDS, ClientLease
from services.command.lease import Lease
from services.errors import BadArguments, CommandHeld, LeaseLost, NoAnswer
from services.wire.caller import Caller

ANNA, BERT = Caller("anna@ws1 (pid 7)", 11), Caller("bert@ws2 (pid 8)", 22)


class Line:
    """A client whose questions reach the lease at once, until the line is cut."""

    def __init__(self) -> None:
        self.lease = Lease()
        self.held_lease: ClientLease | None = None
        self.asked: list[tuple[float, str, Mapping[str, Any] | None, float | None]] = []
        self.is_cut = False

    def ask(self, service: str, verb: str, arguments: Mapping[str, Any] | None = None, timeout: float = -1.0) -> Any:
        assert service == "hal"
        self.asked.append((time.monotonic(), verb, arguments, timeout))
        if self.is_cut:
            raise NoAnswer("the cable is out")
        if verb == "release":
            self.lease.give_back(ANNA, (arguments or {})["number"])
            return None
        assert arguments is not None
        if arguments.get("new"):
            tenure = self.lease.take(ANNA, arguments["seconds"], arguments["number"])
        elif "number" in arguments:
            tenure = self.lease.renew(ANNA, arguments["seconds"], arguments["number"])
        else:
            tenure = self.lease.take(ANNA, arguments["seconds"])
        return {"number": tenure.number}


@pytest.fixture
def line() -> Iterator[Line]:
    line = Line()
    yield line
    line.is_cut = False


def test_a_lease_is_renewed_three_times_in_its_length_and_given_back(line: Line) -> None:
    with ClientLease(line, 0.3) as lease:
        assert line.held_lease is lease
        time.sleep(0.75)
        assert lease.text == ""
        lease.check()
        assert line.lease.tenure is not None
    assert line.held_lease is None
    assert line.lease.tenure is None
    verbs = [verb for _, verb, _, _ in line.asked]
    assert verbs == ["lease"] * verbs.count("lease") + ["release"]
    assert 5 <= verbs.count("lease") <= 8  # once at first, then every 0.1 s
    first, second = line.asked[:2]
    assert second[0] - first[0] == pytest.approx(0.1, abs=0.05)
    assert first[2] == {"seconds": 0.3, "number": lease._number, "new": True}
    assert second[2] is not None
    assert second[2]["number"] > 0
    assert second[3] == pytest.approx(0.1, abs=0.02)
    assert line.asked[-1][3] == 1.0


def test_a_lease_that_is_not_renewed_in_time_is_lost_for_good(line: Line) -> None:
    with ClientLease(line, 0.3) as lease:
        line.is_cut = True
        time.sleep(0.2)
        assert lease.text == ""  # it still runs
        time.sleep(0.15)
        assert "not renewed for 0.3 s" in lease.text
        assert "the cable is out" in lease.text
        line.is_cut = False
        time.sleep(0.15)
        with pytest.raises(LeaseLost, match="the cable is out"):
            lease.check()
    assert line.asked[-1][1] == "release"


def test_a_short_silence_is_no_loss(line: Line) -> None:
    with ClientLease(line, 0.6) as lease:
        line.is_cut = True
        time.sleep(0.3)
        line.is_cut = False
        time.sleep(0.5)
        assert lease.text == ""


def test_a_lease_of_another_client_is_not_taken(line: Line) -> None:
    line.lease.take(BERT, 5.0)
    with pytest.raises(CommandHeld, match="bert"), ClientLease(line, 0.3):
        raise AssertionError
    assert line.held_lease is None


def test_one_lease_is_enough(line: Line) -> None:
    with ClientLease(line, 5.0), pytest.raises(CommandHeld, match="already"), ClientLease(line, 5.0):
        raise AssertionError


def test_a_lease_that_the_hal_ended_is_lost_at_once(line: Line) -> None:
    with ClientLease(line, 0.6) as lease:
        line.lease.give_back(ANNA, lease._number)
        line.lease.take(BERT, 5.0)
        time.sleep(0.3)
        assert "bert" in lease.text
        with pytest.raises(LeaseLost):
            lease.check()


def test_when_the_hal_is_gone_the_context_ends_all_the_same(line: Line) -> None:
    with ClientLease(line, 0.3):
        line.is_cut = True
    assert line.held_lease is None


@pytest.mark.parametrize("seconds", [0.1, 61.0])
def test_a_time_that_is_not_allowed(line: Line, seconds: float) -> None:
    with pytest.raises(BadArguments), ClientLease(line, seconds):
        raise AssertionError


def test_the_default_is_3_s_and_only_verbs_that_may_move_the_robot_need_it(line: Line) -> None:
    assert (SECONDS, RENEWALS) == (3.0, 3)
    with ClientLease(line):
        assert line.lease.left() == pytest.approx(3.0, abs=0.5)
    verbs = {verb for names in NEEDS_LEASE.values() for verb in names}
    assert {"enable", "reset", "home", "target", "engage"} <= verbs
    assert not {"stop", "estop", "disable", "release"} & verbs
