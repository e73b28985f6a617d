"""The state machine of a bus by itself, and the error frames that feed it."""

import itertools

import pytest

from hal.protocols.error_frames import Controller, ErrorFrame, error_frame
from hal.wire.state import RECOVERY, WORRY, BusState, BusWatch

OPENED = "Open, but nothing was heard yet."


def frame(kind, detail=0, transmit=0, receive=0, more=()):
    data = bytearray([0, detail, 0, 0, 0, 0, transmit, receive])
    for place, value in more:
        data[place] = value
    return error_frame(kind, data)


@pytest.mark.parametrize(
    ("kind", "data", "controller", "report"),
    [
        (0x001, "", None, "could not send a frame in time"),
        (0x002, "1d", None, ""),
        (0x004, "0001", None, "receive buffer overflowed"),
        (0x004, "0002", None, "transmit buffer overflowed"),
        (0x004, "0004", Controller.WARNING, "counts many errors"),
        (0x004, "0008", Controller.WARNING, "counts many errors"),
        (0x004, "0010", Controller.PASSIVE, "error passive"),
        (0x004, "0020", Controller.PASSIVE, "error passive"),
        (0x004, "0028", Controller.PASSIVE, "error passive"),
        (0x004, "0040", Controller.ACTIVE, ""),
        (0x008, "000004", None, "bit stuffing was wrong"),
        (0x008, "00000a", None, "wrong form, a dominant bit could not be sent"),
        (0x008, "000000", None, "the protocol was violated"),
        (0x010, "0000000004", None, "wires (04h)"),
        (0x020, "", None, "No node acknowledges"),
        (0x040, "", Controller.OFF, "bus-off"),
        (0x0A8, "00000419", None, "No node acknowledges"),
        (0x080, "", None, "disturbed"),
        (0x100, "", Controller.ACTIVE, ""),
        (0x200, "0000000000000c00", Controller.ACTIVE, ""),
        (0x200, "0000000000006000", Controller.WARNING, "counts many errors"),
        (0x288, "00000200000000ff", Controller.PASSIVE, "wrong form"),
        (0x000, "", None, "class 0h"),
    ],
)
def test_error_frames_of_every_class(kind, data, controller, report):
    found = error_frame(kind, bytes.fromhex(data))
    assert found.controller is controller
    assert report in found.text
    assert bool(found.text) == bool(report)


def test_error_counters_are_told_where_the_frame_has_them():
    assert frame(0x204, 0x08, 96, 3).counters == (96, 3)
    assert frame(0x004, 0x08, 96, 3).counters == (96, 3)  # kernels before 6.0 do not set the class of the counters
    assert frame(0x004, 0x40).counters is None
    assert frame(0x080, 0, 5, 5).counters is None


def heard(at):
    return lambda watch: watch.heard(at)


def error(kind, at, detail=0):
    return lambda watch: watch.error(frame(kind, detail), at)


def opened(watch):
    watch.opened(OPENED)


def lost(watch):
    watch.lost("The adapter is gone.")


def worry(at):
    return lambda watch: watch.worry("The bus is loaded to 90%.", at)


THERE = (opened, heard(0.0))


@pytest.mark.parametrize(
    ("events", "state", "losses"),
    [
        ((), "gone", 0),
        ((opened,), "gone", 0),
        (THERE, "ok", 0),
        ((*THERE, lost), "gone", 1),
        ((*THERE, lost, opened), "gone", 1),
        ((*THERE, lost, opened, heard(2)), "ok", 1),
        ((*THERE, lost, heard(1), lost), "gone", 2),
        ((*THERE, error(0x20, 1)), "warning", 0),
        ((*THERE, error(0x20, 1), heard(1 + WORRY - 0.01)), "warning", 0),
        ((*THERE, error(0x20, 1), heard(1 + WORRY + 0.01)), "ok", 0),
        ((*THERE, error(0x20, 1), error(0x20, 1.9), heard(2.5)), "warning", 0),
        ((*THERE, error(0x04, 1, 0x08)), "warning", 0),
        ((*THERE, error(0x04, 1, 0x08), heard(1 + WORRY + 0.01)), "warning", 0),
        ((*THERE, error(0x04, 1, 0x20)), "passive", 0),
        ((*THERE, error(0x04, 1, 0x20), heard(1 + RECOVERY - 0.01)), "passive", 0),
        ((*THERE, error(0x04, 1, 0x20), heard(1 + RECOVERY + 0.01)), "ok", 0),
        ((*THERE, error(0x04, 1, 0x20), error(0x04, 2, 0x08)), "warning", 0),
        ((*THERE, error(0x04, 1, 0x20), error(0x04, 2, 0x40)), "ok", 0),
        ((*THERE, error(0x04, 1, 0x20), error(0x20, 2)), "passive", 0),
        ((*THERE, error(0x40, 1)), "bus-off", 1),
        ((*THERE, error(0x40, 1), error(0x20, 1.1)), "bus-off", 1),
        ((*THERE, error(0x40, 1), error(0x100, 1.1)), "ok", 1),
        ((*THERE, error(0x40, 1), heard(1.1)), "ok", 1),
        ((*THERE, error(0x40, 1), lost), "gone", 1),
        ((opened, error(0x40, 1)), "bus-off", 0),
        ((opened, error(0x40, 1), error(0x100, 2)), "gone", 0),
        ((*THERE, error(0x02, 1)), "ok", 0),
        ((*THERE, worry(1)), "warning", 0),
        ((*THERE, worry(1), heard(2.5)), "ok", 0),
        ((*THERE, worry(1), lost), "gone", 1),
        ((opened, worry(1)), "gone", 0),
    ],
)
def test_every_estimate_latency_the_states(events, state, losses):
    report = []
    watch = BusWatch(lambda state, text: report.append(state))
    for event in events:
        event(watch)
    assert watch.state == state
    assert watch.losses == losses
    assert bool(watch.text) == (watch.state is not BusState.OK)
    assert (report or ["gone"])[-1] == state
    assert all(one is not two for one, two in itertools.pairwise(report)), "a change to the same state"


def test_the_last_loss_is_told_after_the_bus_is_back():
    watch = BusWatch()
    for event in (*THERE, error(0x40, 1), heard(2)):
        event(watch)
    assert watch.lost_by.startswith("is bus-off. The controller is bus-off")


def test_the_counters_are_those_of_the_last_frame_that_had_some():
    watch = BusWatch()
    watch.opened(OPENED)
    watch.error(ErrorFrame(Controller.WARNING, "x", (100, 2)), 0.0)
    watch.error(ErrorFrame(None, "x", None), 0.1)
    assert watch.error_counters == (100, 2)
    watch.opened(OPENED)
    assert watch.error_counters is None
