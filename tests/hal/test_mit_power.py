"""Drives in MIT mode frame by frame: powering on and off, stops, and what is lost with the power."""

import numpy as np
import pytest
from mit_wire import BRAKE, DAMIAO, DISABLED, ENABLED, ENTER, EXIT, REST, T_MOTOR, Wire

from hal.device import DeviceState


def test_a_quick_stop_brakes_for_03_s_and_powers_off():
    wire = Wire(DAMIAO).ready()
    wire.device.quick_stop()  # without power there is nothing to brake
    wire.device.idle()
    assert wire.frames() == [EXIT]
    wire.state = ENABLED
    wire.answer()
    wire.device.quick_stop()
    for _ in range(62):
        wire.device.idle()
    assert wire.frames() == [BRAKE] * 60 + [REST, EXIT]
    wire.device.quick_stop()
    wire.device.disable()
    wire.device.idle()
    wire.device.idle()
    assert wire.frames() == [EXIT, EXIT]


def test_a_drive_that_is_not_commissioned_gets_nothing():
    wire = Wire(DAMIAO)
    assert not wire.device._drives()
    assert wire.device._fault() == ""
    wire.device.idle()
    wire.device.apply(np.array([0.5]))
    wire.device.damp()
    assert wire.frames() == []


def test_power_on_of_damiao():
    """The watchdog is read, then there is no torque before and after the request of power."""
    wire = Wire(DAMIAO).ready()
    device = wire.device
    device.apply(np.array([0.5]))
    assert wire.frames() == [EXIT]
    device.enable()
    ask = bytes.fromhex("01 00 33 09 00 00 00 00")
    device.apply(np.array([0.5]))
    assert wire.frames() == [ask, REST]
    wire.state = ENABLED
    device.apply(np.array([0.5]))
    assert wire.frames() == [ENTER, REST]
    device.apply(np.array([0.5]))
    # 0.5 rad: 34078 of 65535; stiffness 40 of 500: 328 of 4095; damping 2 of 5
    assert wire.frames() == ["85 1E 7F F1 48 66 67 FF"]
    assert device.health().state is DeviceState.ENABLED
    device.damp()
    assert wire.frames() == [BRAKE]
    wire.state = DISABLED
    wire.answer()
    device.apply(np.array([0.5]))
    assert wire.frames() == [EXIT]
    assert "powered off by itself" in device.health().text
    device.enable()
    device.disable()
    device.apply(np.array([0.5]))
    assert wire.frames() == [EXIT]


def test_a_drive_that_forgot_its_watchdog_is_not_powered_on():
    wire = Wire(DAMIAO).ready()
    wire.registers[9] = bytes(4)
    wire.device.enable()
    for _ in range(3):
        wire.device.apply(np.array([0.5]))
    assert ENTER not in wire.frames()
    assert "lost its watchdog setting" in wire.device.health().text
    assert not wire.device._enable_requested


def test_t_motor_has_power_after_six_answers():
    """It does not report its state."""
    wire = Wire(T_MOTOR).ready()
    device = wire.device
    for _ in range(7):
        device.idle()
    wire.frames()
    device.enable()
    device.apply(np.array([0.5]))
    assert wire.frames() == [REST]
    device.apply(np.array([0.5]))
    assert wire.frames() == [ENTER, REST]
    assert not device._drives()
    while not device._drives():
        device.apply(np.array([0.5]))
        assert set(wire.frames()) <= {ENTER, REST}
    assert device.health().state is DeviceState.ENABLED
    assert "has no watchdog" in device.health().text
    device.apply(np.array([0.5]))
    device.disable()
    wire.frames()
    wire.answers_after = 999
    device.idle()
    device.idle()
    assert wire.frames() == [REST, EXIT]
    assert device.health().state is DeviceState.ENABLED
    for answers in range(1, 7):
        wire.answer()
        assert device._drives() is (answers < 6)


@pytest.mark.parametrize("reason", ["_latched", "_is_wrapped"])
def test_a_fault_ends_the_wish_to_move(reason):
    wire = Wire(DAMIAO).ready()
    wire.device.enable()
    setattr(wire.device, reason, 0xC)
    wire.device.apply(np.array([0.5]))
    assert not wire.device._enable_requested
    assert wire.frames() == [EXIT]


@pytest.mark.parametrize(("missed", "is_lost"), [(30, False), (31, True)])
def test_a_drive_that_was_silent_is_commissioned_again(missed, is_lost):
    """0.15 s are 30 cycles."""
    wire = Wire(DAMIAO).ready()
    wire.device.enable()
    wire.device.missed = missed
    wire.answer()
    assert wire.device.is_commissioned is not is_lost
    assert wire.device._enable_requested is not is_lost
    assert ("was silent and answers again" in wire.device.health().text) is is_lost


def test_inspection_of_a_drive_without_registers():
    checks = Wire(T_MOTOR).device.inspect()
    assert [(check.what, check.is_good) for check in checks] == [("watchdog", False), ("ranges", True)]
