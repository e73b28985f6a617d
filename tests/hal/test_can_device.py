"""What every device on a bus has: opening and closing, silence, and the calibration of this very device."""

import threading

import numpy as np
import pytest

from hal.calibration.line import Calibration
from hal.clock import SystemClock
from hal.config import BusConfig
from hal.device import DeviceState
from hal.drivers.can_device import CanDevice, DeviceSettings, Place
from hal.errors import DeviceRefused, DeviceSilent, WrongDevice
from hal.wire.bus import Bus


class Gripper(CanDevice):
    """The smallest driver."""

    kind, error, fault, drives = "gripper:7", None, "", False
    reboots = 0

    @classmethod
    def commanded(cls, settings):
        return "position"

    def _identify(self):
        return self.kind

    def _commission(self):
        self.steps.append(self.health().text)
        self._counters["boots"] += self.reboots
        if self.error:
            raise self.error

    def _release(self):
        self.steps.append("released")

    def _fault(self):
        return self.fault

    def _drives(self):
        return self.drives


def gripper(calibration=None, rate=200.0, **settings):
    bus = Bus("can0", BusConfig(interface="virtual", channel="can_device"), SystemClock())
    elements = {"position": "gripper.opening", "effort": "gripper.force"}
    place = Place("hand", elements, bus, 4, None, rate, calibration)
    device = Gripper(place, DeviceSettings.model_validate(settings))
    device.steps = []
    return device


def state(device):
    return device.health().state, device.health().text


def test_before_it_is_opened():
    device = gripper()
    assert (device.name, device.node) == ("hand", 4)
    assert (device.measures, device.commands) == (("gripper.opening", "gripper.force"), ("gripper.opening",))
    assert (device.command_quantity, device.missed, device.patience) == ("position", 1, 1)
    assert state(device) == (DeviceState.CLOSED, "Not opened yet.")
    assert np.isnan(device.read().values).all()
    assert np.isneginf(device.read().received).all()
    assert device.read().values.shape == device.read().received.shape == (2,)
    device._lose("it rebooted")  # a frame that comes although nothing was opened
    assert state(device) == (DeviceState.CLOSED, "Not opened yet.")
    device.close()
    assert device.steps == []
    assert device._bus.needs_sync is False
    assert device in device._bus._nodes


def test_opening_and_closing():
    device = gripper()
    device.open()
    assert device.steps == ["Being commissioned."]
    assert (device.identity, device.missed, state(device)) == ("gripper:7", 1, (DeviceState.READY, ""))
    assert device.health().counters == {
        "malformed": 0,
        "boots": 0,
        "emergencies": 0,
        "commissioned": 1,
        "failed_openings": 0,
    }
    device.missed = 9
    device._lose("it rebooted")
    assert state(device) == (DeviceState.OPENING, "it rebooted")
    device.open()
    assert (device.missed, device.health().counters["commissioned"]) == (9, 2)
    device.close()
    assert state(device) == (DeviceState.CLOSED, "Closed.")
    assert device.steps[-1] == "released"
    device._lose("it rebooted")
    assert state(device) == (DeviceState.CLOSED, "Closed.")
    device.close()
    assert device.steps.count("released") == 1


@pytest.mark.parametrize(
    ("error", "expected"), [(DeviceSilent("no answer"), DeviceState.SILENT), (DeviceRefused("no"), DeviceState.OPENING)]
)
def test_an_opening_that_fails(error, expected):
    device = gripper()
    device.open()
    device.error = error
    with pytest.raises(type(error)):
        device.open()
    assert not device.is_commissioned
    assert state(device) == (expected, str(error))
    assert device.health().counters["failed_openings"] == 1
    assert device.health().counters["commissioned"] == 1
    device.error = None
    device.open()  # the lock was released
    assert state(device) == (DeviceState.READY, "")


def test_a_reboot_while_it_is_commissioned():
    device = gripper()
    device.reboots = 1
    with pytest.raises(DeviceSilent, match="rebooted while it was being commissioned"):
        device.open()
    device.reboots = 0
    device.open()
    assert device.is_commissioned


def test_only_one_thread_opens_it():
    device = gripper()
    with device._opening:
        device.open()
    assert device.steps == []
    thread = threading.Thread(target=device.open)
    thread.start()
    thread.join()
    assert len(device.steps) == 1
    with device._opening:
        assert state(device) == (DeviceState.OPENING, "Being commissioned.")


@pytest.mark.parametrize(
    ("identity", "is_same"), [("gripper:7", True), ("gripper:6", False), ("gripper:8", False), ("", False)]
)
def test_a_calibration_belongs_to_one_device(identity, is_same):
    device = gripper(Calibration("gripper:7", {"zero": 0.1}))
    device.kind = identity
    if is_same:
        device.open()
    else:
        with pytest.raises(WrongDevice, match=identity or "a device without an identity"):
            device.open()
        assert device.steps == []


@pytest.mark.parametrize(
    ("rate", "silent_after", "cycles"), [(200.0, 0.15, 30), (200.0, 0.5, 100), (100.0, 0.15, 15), (10.0, 0.01, 1)]
)
def test_silence_is_a_number_of_cycles(rate, silent_after, cycles):
    device = gripper(rate=rate, silent_after=silent_after)
    device.open()
    device.missed = cycles
    assert device.is_heard
    assert state(device)[0] is DeviceState.READY
    device.missed = cycles + 1
    assert not device.is_heard
    found, text = state(device)
    assert found is DeviceState.SILENT
    assert f"has not answered for {cycles + 1} cycles" in text


@pytest.mark.parametrize(
    ("fault", "drives", "expected"), [("", True, False), ("hot", False, False), ("hot", True, True)]
)
def test_power_in_a_fault_is_that_of_the_drive(fault, drives, expected):
    device = gripper()
    device.open()
    device.fault, device.drives, device.missed = fault, drives, 0
    assert state(device) == ((DeviceState.FAULT, "hot") if fault else (DeviceState.READY, ""))
    assert device.has_power is expected
    device._running = lambda: (DeviceState.STOPPING, "")
    assert device.has_power is (expected or not fault)


def test_a_sensor_commands_nothing_and_has_no_motor():
    bus = Bus("can0", BusConfig(interface="virtual", channel="can_device"), SystemClock())
    device = CanDevice(Place("cell", {"force": "cell.force"}, bus, 4, None, 200.0), DeviceSettings())
    assert (device.commands, device.command_quantity) == ((), "")
    device.is_commissioned, device.missed, device._fault = True, 0, lambda: "hot"
    assert device.health().state is DeviceState.FAULT
    assert not device.has_power
    assert str(device._place) == "'cell' (node 4 on can0)"
    for hook in (device._identify, device._commission):
        with pytest.raises(NotImplementedError):
            hook()


def test_an_answer_ends_the_wait_of_the_cycle():
    device = gripper()
    device.open()
    device._bus.begin()
    assert device in device._bus._waiting
    device.missed = 3
    device._mark_answered()
    assert device.missed == 0
    assert device not in device._bus._waiting
