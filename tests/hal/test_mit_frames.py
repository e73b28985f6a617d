"""Drives in MIT mode frame by frame: requests until an answer, powering on and off, faults, and registers of Damiao.

DM4310: 12.5 rad, 30 rad/s, 10 N m. AK80-9: 12.5 rad, 50 rad/s, 18 N m. Zero is 7FFFh in 16 bits and 7FFh in 12 bits.
"""

import math
import struct

import pytest
from mit_wire import CLEAR, DAMIAO, DISABLED, ENABLED, ENTER, EXIT, QUANTITIES, REGISTERS, REST, T_MOTOR, TOO_HOT, Wire

from hal.device import DeviceState
from hal.drivers.mit.drive import MitDrive
from hal.errors import ConfigError, DeviceRefused, DeviceSilent, WrongDevice
from hal.protocols.mit import Register


def test_numbers_of_nodes():
    for settings, highest in ((T_MOTOR, 0xFF), (DAMIAO, 0x7FE)):
        for node in (1, highest):
            Wire(settings, node, master_id=0x20)
        for node in (0, highest + 1):
            with pytest.raises(ConfigError, match=f"between 1 and {highest}"):
                Wire(settings, node, master_id=0x20)


def test_identifiers_of_answers():
    assert Wire(DAMIAO, 5).device._reply_id == 21
    assert Wire(T_MOTOR, 5).device._reply_id == 0
    assert Wire(T_MOTOR, 5, master_id=7).device._reply_id == 7
    assert Wire(DAMIAO, 5, master_id=0).device._reply_id == 0


def test_drives_under_one_identifier_are_distinguished_by_their_first_byte():
    """A Damiao drive sends four bits of its id, one of T-Motor eight."""
    bus = Wire(T_MOTOR, 0x02).bus
    other = Wire(T_MOTOR, 0x12, bus)
    other.ready()
    other.answer(position=0xBFFF)
    assert other.device.read().values[0] == pytest.approx(6.25, abs=1e-3)
    unknown = bus.counters["unknown"]
    other.hear(bytes((0x13, *range(7))))
    other.hear(b"")
    assert bus.counters["unknown"] == unknown + 2
    bus = Wire(DAMIAO, 0x02, master_id=0x40).bus
    Wire(DAMIAO, 0x03, bus, master_id=0x40)
    Wire(DAMIAO, 0x0A, bus, master_id=0x40)
    with pytest.raises(ConfigError, match="answer under 040h with the id 2h"):
        Wire(DAMIAO, 0x12, bus, master_id=0x40)
    with pytest.raises(ConfigError, match="identifier 040h"):
        Wire(T_MOTOR, 0x03, bus, master_id=0x40)


def test_quantities_and_traffic():
    cheetah = {**T_MOTOR, "motor": "mini-cheetah"}
    for settings, count, size in ((DAMIAO, 5, 8), (T_MOTOR, 4, 8), (cheetah, 2, 7)):
        parsed = MitDrive.Settings.model_validate(settings)
        assert MitDrive.quantities(parsed) == QUANTITIES[:count]
        assert MitDrive.traffic(parsed, 200.0) == ((8, 200.0), (size, 200.0))
    effort = MitDrive.Settings.model_validate({**T_MOTOR, "mode": "effort"})
    assert MitDrive.quantities(effort) == ("effort", "position", "velocity", "temperature")


@pytest.mark.parametrize(("answers_after", "frames"), [(1, 1), (2, 2), (4, 4), (5, 4)])
def test_a_drive_is_requested_to_power_off_four_times(answers_after, frames):
    wire = Wire(T_MOTOR)
    wire.answers_after = answers_after
    if frames < answers_after:
        with pytest.raises(DeviceSilent, match="does not answer under 000h"):
            wire.device._knock()
    else:
        wire.device._knock()
    assert wire.frames() == [EXIT] * frames


@pytest.mark.parametrize(
    ("serial", "identity"),
    [
        ("78 56 34 12", "damiao:12345678"),
        ("01 00 00 00", "damiao:00000001"),
        ("00 00 00 00", None),
        ("FF FF FF FF", None),
    ],
)
def test_the_serial_number_is_the_identity(serial, identity):
    wire = Wire(DAMIAO)
    wire.registers[15] = bytes.fromhex(serial)
    assert wire.device._identify() == (identity or f"mit:{wire.bus.name}:1:DM4310")
    assert wire.frames()[:2] == [REST, EXIT]


def test_a_drive_without_registers_is_known_by_its_place():
    wire = Wire(T_MOTOR, 3)
    assert wire.device._identify() == f"mit:{wire.bus.name}:3:AK80-9"
    wire.bus.needs_sync = True
    with pytest.raises(DeviceRefused, match="identifier 0"):
        wire.device._identify()
    wire = Wire(T_MOTOR, 3, master_id=4)
    wire.bus.needs_sync = True
    wire.device._identify()


def test_commissioning_of_a_damiao_drive():
    """Ranges are read and compared; MIT mode (1) and 3000 * 50 us are written to registers 10 and 9 and read back."""
    wire = Wire(DAMIAO)
    wire.registers |= {9: bytes(4), 10: bytes(4)}
    wire.device.missed = 5
    wire.device.enable()
    wire.device._commission()
    assert (wire.device.missed, wire.device._enable_requested) == (0, False)
    assert [frame.hex(" ") if isinstance(frame, bytes) else frame for frame in wire.frames()] == [
        *[EXIT] * 6,
        "01 00 33 15 00 00 00 00",
        "01 00 33 16 00 00 00 00",
        "01 00 33 17 00 00 00 00",
        "01 00 55 0a 01 00 00 00",
        "01 00 33 0a 00 00 00 00",
        "01 00 55 09 b8 0b 00 00",
        "01 00 33 09 00 00 00 00",
    ]


@pytest.mark.parametrize(("register", "name"), [(21, "position"), (22, "velocity"), (23, "effort")])
def test_another_range_is_another_motor(register, name):
    wire = Wire(DAMIAO)
    (value,) = struct.unpack("<f", REGISTERS[register])
    for factor, is_same in ((1.0005, True), (0.9995, True), (1.002, False), (0.998, False)):
        wire.registers[register] = struct.pack("<f", value * factor)
        if is_same:
            wire.device._commission()
        else:
            with pytest.raises(WrongDevice, match=f"has a {name} range of"):
                wire.device._commission()
        checks = {check.what: check.is_good for check in wire.device.inspect()}
        assert checks == {"watchdog": True, "control mode": True} | {
            f"{one} range": one != name or is_same for one in ("position", "velocity", "effort")
        }


@pytest.mark.parametrize(("register", "what"), [(9, "watchdog"), (10, "control mode")])
def test_inspection_compares_mode_and_watchdog(register, what):
    wire = Wire(DAMIAO)
    for value in (int.from_bytes(REGISTERS[register], "little") + change for change in (-1, 1)):
        wire.registers[register] = value.to_bytes(4, "little")
        assert [check.what for check in wire.device.inspect() if not check.is_good] == [what]
    assert "after 0.15005 s" in wire.device.inspect()[0].text or register == 10


def test_a_register_that_keeps_its_value_is_refused():
    wire = Wire(DAMIAO)
    client = wire.device._registers
    send = wire.bus.send
    wire.bus.send = lambda frame: send(frame) if frame.data[2] != 0x55 else wire.hear(frame.data)
    with pytest.raises(DeviceRefused, match="TIMEOUT reads back 3000 after writing 7"):
        client.write(Register.TIMEOUT, 7)


def test_a_register_is_requested_four_times():
    wire = Wire(DAMIAO)
    del wire.registers[15]
    with pytest.raises(DeviceSilent, match="register SERIAL"):
        wire.device._registers.read(Register.SERIAL)
    assert wire.frames() == [bytes.fromhex("01 00 33 0F 00 00 00 00")] * 4
    assert wire.device._registers.pending is None


def test_the_answer_to_another_register_is_not_taken():
    wire = Wire(DAMIAO)
    client = wire.device._registers
    wire.registers = {}
    client.ask(Register.TIMEOUT)
    assert client.is_watching is None
    wire.hear(bytes.fromhex("01 00 33 0A B8 0B 00 00"))
    assert client.is_watching is None
    wire.hear(bytes.fromhex("01 00 33 09 B7 0B 00 00"))
    assert client.is_watching is False
    client.ask(Register.TIMEOUT)
    wire.hear(bytes.fromhex("01 00 33 09 B8 0B 00 00"))
    assert client.is_watching is True


@pytest.mark.parametrize(("watch_time", "is_enough"), [(0.03, True), (0.0299, False)])
def test_a_watchdog_outlasts_two_lost_frames(watch_time, is_enough):
    if is_enough:
        Wire(DAMIAO, rate=100.0, watch_time=watch_time)
    else:
        with pytest.raises(ConfigError, match="one lost frame would stop it"):
            Wire(DAMIAO, rate=100.0, watch_time=watch_time)


def test_a_drive_that_stays_enabled_is_not_opened():
    wire = Wire(DAMIAO)
    wire.state = ENABLED
    with pytest.raises(DeviceRefused, match="stays enabled"):
        wire.device._commission()


def test_closing_powers_off_and_then_switches_the_watchdog_off():
    wire = Wire(DAMIAO)
    wire.device._release()
    assert wire.frames()[:7] == [REST, *[EXIT] * 6]
    assert wire.registers[9] == bytes(4)
    wire.registers[9] = REGISTERS[9]
    wire.state = ENABLED
    wire.device._release()
    assert wire.registers[9] == REGISTERS[9]  # it keeps the motor that does not let go from going on for ever
    silent = Wire(T_MOTOR)
    silent.answers_after = 99
    silent.device._release()
    assert silent.frames() == [REST, *[EXIT] * 4]


def test_measured_values_in_si():
    wire = Wire(DAMIAO).ready()
    wire.answer(0xBFFF, 0x400, 0xC00, (0x28, 0x1E), received=3.0)
    reading = wire.device.read()
    expected = [0xBFFF / 65535 * 25 - 12.5, 0x400 / 4095 * 60 - 30, 0xC00 / 4095 * 20 - 10, 0x1E, 0x28]
    assert reading.values == pytest.approx(expected)  # rad, rad/s, N m, rotor and driver [degrees Celsius]
    assert reading.received.tolist() == [3.0] * 5
    motor = Wire(T_MOTOR).ready()
    motor.answer(0xBFFF, 0x400, 0xC00, (0x41, 0x00))
    expected = [0xBFFF / 65535 * 25 - 12.5, 0x400 / 4095 * 100 - 50, 0xC00 / 4095 * 36 - 18, 0x41 - 40]
    assert motor.device.read().values == pytest.approx(expected)


@pytest.mark.parametrize("place", [1, 2])
@pytest.mark.parametrize(("counts", "is_known"), [(0, False), (1, True), (4094, True), (4095, False)])
def test_velocities_and_efforts_at_the_ends_are_not_known(place, counts, is_known):
    wire = Wire(DAMIAO).ready()
    wire.answer(**{("velocity", "effort")[place - 1]: counts})
    assert math.isfinite(wire.device.read().values[place]) is is_known


@pytest.mark.parametrize(("counts", "is_known"), [(0, False), (1, True), (65534, True), (65535, False)])
def test_positions_at_the_ends_are_not_known(counts, is_known):
    wire = Wire(DAMIAO)
    wire.device.is_commissioned, wire.device.missed = True, 0
    wire.answer(counts)
    assert math.isfinite(wire.device.read().values[0]) is is_known


@pytest.mark.parametrize(("first", "second", "is_wrapped"), [(1, 32768, False), (1, 32769, True), (60000, 20000, True)])
def test_a_jump_by_half_of_the_range_is_the_other_end(first, second, is_wrapped):
    wire = Wire(DAMIAO)
    wire.device.is_commissioned, wire.device.missed = True, 0
    wire.answer(first)
    assert wire.device.health().counters["wrapped"] == 0
    wire.answer(second)
    assert wire.device.health().counters["wrapped"] == int(is_wrapped)
    assert math.isnan(wire.device.read().values[0]) is is_wrapped
    assert ("turned beyond 12.5 rad" in wire.device._fault()) is is_wrapped
    wire.device.reset()
    assert wire.device._fault() == ""


def test_answers_of_a_wrong_length_and_frames_of_another_sender_are_counted():
    for settings, wrong in ((DAMIAO, (6, 7)), (T_MOTOR, (5, 7)), ({**T_MOTOR, "motor": "mini-cheetah"}, (5, 8))):
        wire = Wire(settings, quantities=("position", "velocity"))
        for count, size in enumerate(wrong, 1):
            wire.hear(bytes((1, *range(1, size))))
            assert wire.device.health().counters["malformed"] == count
    wire.bus.subscriber(1)(bytearray(8), 1.0)
    assert wire.device.health().counters["foreign"] == 1


def test_an_answer_without_a_temperature():
    """Older firmware of T-Motor."""
    wire = Wire(T_MOTOR).ready()
    wire.hear(bytes.fromhex("01 BF FF 7F F7 FF"))
    assert wire.device.read().values[0] == pytest.approx(6.25, abs=1e-3)
    assert math.isnan(wire.device.read().values[3])
    assert wire.device._fault() == ""


@pytest.mark.parametrize(("settings", "error"), [(DAMIAO, 0xC), (T_MOTOR, 1)])
def test_an_error_stays_until_it_is_reset(settings, error):
    wire = Wire(settings).ready()

    def report(number):
        wire.state = number << 4
        wire.answer(last=(0x28, number))

    assert wire.device._fault() == ""
    report(error)
    assert "too hot" in wire.device._fault()
    assert wire.device.health().state is DeviceState.FAULT
    report(0)
    assert "too hot" in wire.device._fault()
    wire.device.reset()
    assert wire.device._fault() == ""
    report(error)  # it is being cleared
    assert "too hot" in wire.device._fault()
    report(0)
    assert wire.device._fault() == ""


def test_damiao_states():
    wire = Wire(DAMIAO).ready()
    assert wire.device.can_damp
    assert (wire.device.health().state, wire.device.health().text) == (DeviceState.READY, "")
    for state, is_powered, is_fault in ((0, False, False), (1, True, False), (2, False, True), (8, False, True)):
        wire.device.reset()
        wire.state = state << 4
        wire.answer()
        assert (wire.device._drives(), bool(wire.device._fault())) == (is_powered, is_fault)


def test_a_fault_of_damiao_is_cleared_in_at_most_40_cycles():
    wire = Wire(DAMIAO).ready()
    wire.state = TOO_HOT
    wire.answer()
    wire.device.reset()
    for _ in range(45):
        wire.device.idle()
    assert wire.frames() == [CLEAR] * 40 + [EXIT] * 5
    wire.device.reset()
    wire.state = DISABLED
    wire.answer()
    wire.device.idle()
    wire.state = TOO_HOT
    wire.answer()
    wire.device.idle()  # a reset does not clear the next fault
    assert wire.frames() == [EXIT] * 2


def test_a_fault_of_t_motor_is_cleared_by_powering_on_for_two_frames():
    wire = Wire(T_MOTOR).ready()
    wire.answers_after = 999
    wire.answer(last=(0x28, 1))
    wire.device.reset()
    wire.device.idle()
    assert wire.frames() == [ENTER, REST, EXIT]
