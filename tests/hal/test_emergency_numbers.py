"""Emergency stop of the safety bench in numbers: how long it waits for drives and cycles, and what it reports."""

import threading

import pytest
from hal_bench import description as muscles
from safety_bench import PERIOD, SafetyBench

from hal.clock import ManualClock, SystemClock
from hal.config import BusConfig, RobotConfig
from hal.device import DeviceState
from hal.fleet import build
from hal.safety.emergency import EmergencyStop, Requests
from hal.wire.bus import Bus


class Ticking(ManualClock):
    """A clock that moves while it is waited for, with a call at each step."""

    def __init__(self, turn=lambda: None):
        super().__init__()
        self.turn, self.naps = turn, []

    def sleep_until(self, deadline):
        self.naps.append(deadline - self.monotonic())
        self.advance(max(deadline - self.monotonic(), 0.0))
        self.turn()


def stop(turn=lambda joints, cycles: None, period=PERIOD, buses=()):
    """Result, joints and duration [s] of an emergency stop of two deaf drives; `turn` is called every half period."""
    cycles = [0]
    clock = Ticking(lambda: turn(bench.joints, cycles))
    bench = SafetyBench("position")
    for joint in bench.joints:
        joint._clock, joint.is_deaf, joint.state = clock, True, DeviceState.ENABLED
    emergency = EmergencyStop(bench.config, bench.joints, buses, clock, period)
    begun = clock.monotonic()
    result = emergency.watch(Requests(begun), lambda: cycles[0])
    return result, bench.joints, clock.monotonic() - begun


def count(joints, cycles):
    cycles[0] += 1


def test_drives_have_one_second_to_stop():
    result, joints, duration = stop(count)
    assert duration == pytest.approx(1.0, abs=0.003)
    assert not result.is_complete
    assert [drive.text for drive in result.devices] == ["is still enabled; cut the power"] * 2
    assert result.text == ""
    assert joints[0].asked == []


@pytest.mark.parametrize(("period", "patience"), [(0.005, 0.03), (0.02, 0.06)])
def test_a_cycle_that_does_not_turn_is_stuck_after_three_periods(period, patience):
    """And after 0.03 s at least: then the requests are repeated here."""
    times = []

    def turn(joints, cycles):
        times.append((joints[0]._clock.monotonic() - 1000.0, "quick_stop" in joints[0].asked))

    result, joints, _ = stop(turn, period)
    first = next(time for time, is_asked in times if is_asked)
    assert patience < first < patience + 1.5 * period
    assert "The HAL's cycle is stuck" in result.text
    assert joints[0].asked[:2] == ["quick_stop", "idle"]


def test_drives_that_stop_are_waited_for_no_longer():
    def turn(joints, cycles):
        cycles[0] += 1
        joints[0].state = DeviceState.READY
        if cycles[0] == 40:
            joints[1].state = DeviceState.FAULT

    result, _, duration = stop(turn, 0.004)
    assert result.is_complete
    assert duration == pytest.approx(0.08, abs=0.003)
    assert [drive.text for drive in result.devices] == [
        "stopped and without power after 2 ms",
        "stopped and without power after 80 ms",
    ]


@pytest.mark.parametrize(
    ("state", "has_power", "text"),
    [
        (DeviceState.SILENT, False, "did not answer (silent); cut the power"),
        (DeviceState.STOPPING, True, "is still stopping; cut the power"),
        (DeviceState.FAULT, True, "is still under power, in fault; cut the power"),
    ],
)
def test_reactions_in_words(state, has_power, text, monkeypatch):
    monkeypatch.setattr("safety_bench.Joint.has_power", property(lambda joint: has_power), raising=False)

    def turn(joints, cycles):
        cycles[0] += 1
        joints[0].state = state

    result, _, _ = stop(turn)
    assert (result.devices[0].has_stopped, result.devices[0].text) == (False, text)


def test_the_first_reason_of_a_stop_stays_until_it_is_reset():
    bench = SafetyBench("position")
    emergency = EmergencyStop(bench.config, bench.joints, (), ManualClock(), PERIOD)
    emergency.latch("first")
    emergency.latch("second")
    assert emergency.latched == "first"
    emergency.unlatch()
    assert emergency.latched == ""


def test_requests_run_at_once_and_one_per_name():
    requests, never, count = Requests(0.0), threading.Event(), []
    for _ in range(3):
        requests.start("stuck", lambda: count.append("stuck") or never.wait(5.0))
        requests.start("quick", lambda: count.append("quick"))
        requests.join(0.02)
    never.set()
    requests.join(1.0)
    assert count.count("stuck") == 1
    assert count.count("quick") == 3
    assert not requests._threads["stuck"].is_alive()
    requests.start("broken", lambda: 1 / 0)
    requests.join(1.0)


@pytest.mark.parametrize("is_silent", [False, True])
def test_on_a_bus_only_a_measurement_after_the_request_shows_that_a_drive_has_stopped(is_silent):
    def turn(joints, cycles):
        cycles[0] += 1
        for joint in joints:
            joint.state, joint.is_silent = DeviceState.READY, is_silent

    bus = Bus("can0", BusConfig(interface="virtual", channel="estop"), SystemClock())
    result, _, duration = stop(turn, buses=[bus])
    assert result.is_complete is not is_silent
    assert (duration > 0.9) is is_silent


def test_a_drive_that_did_not_stop_is_logged_as_critical(caplog):
    def turn(joints, cycles):
        cycles[0] += 1
        joints[0].state = DeviceState.READY

    stop(turn)
    assert [entry.levelname for entry in caplog.records] == ["WARNING", "CRITICAL"]


def test_drives_on_a_bus_that_is_gone():
    """Neither the state of a device nor old measurements count where nothing can be received."""
    config, clock = RobotConfig.model_validate(muscles()), Ticking()
    buses, devices = build(config, SystemClock())
    drives = [device for device in devices if device.commands]
    emergency = EmergencyStop(config, drives, buses, clock, PERIOD)
    result = emergency.watch(Requests(clock.monotonic()), lambda: int(clock.monotonic() * 1000))
    assert [(drive.has_stopped, drive.text) for drive in result.devices] == [
        (False, "cannot be reached, bus 'can0' is gone; cut the power"),
        (False, "cannot be reached, bus 'can1' is gone; cut the power"),
    ]
