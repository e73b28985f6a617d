"""Frames of a CANopen node one by one: process data at the wrong time, heartbeats, emergencies, torque and mode."""

import can
import pytest
from drive_bench import HOMING, JointBench

BOOT_UP, OPERATIONAL, STOPPED = bytearray([0x00]), bytearray([0x05]), bytearray([0x04])
PDO = bytearray(6)


@pytest.fixture
def joint():
    bench = JointBench("csp", quantities=("position",)).open()
    bench.cycle(3)
    yield bench
    bench.close()


def test_the_third_process_data_after_a_boot_up_is_that_of_another_node(joint):
    drive, now = joint.drive, joint.clock.monotonic()
    beat, pdo = drive._bus.subscriber(0x705), drive._bus.subscriber(0x185)
    boots = drive.health().counters["boots"]
    beat(BOOT_UP, now)
    assert not drive.is_commissioned
    for _ in range(2):
        pdo(PDO, now)
        assert drive._fault() == ""
    pdo(PDO, now)
    assert "two devices" in drive._fault()
    assert drive.health().counters["boots"] == boots + 1
    drive.reset()
    assert drive._fault() == ""


def test_process_data_of_a_node_that_was_lost_otherwise_is_not_counted(joint):
    drive, now = joint.drive, joint.clock.monotonic()
    drive._bus.subscriber(0x705)(STOPPED, now)
    assert not drive.is_commissioned
    for _ in range(10):
        drive._bus.subscriber(0x185)(PDO, now)
    assert drive._fault() == ""


def test_heartbeats_and_emergencies_of_a_wrong_length_are_counted(joint):
    drive, now = joint.drive, joint.clock.monotonic()
    before = drive.health().counters["malformed"]
    for identifier, data in ((0x705, bytearray(2)), (0x085, bytearray(7)), (0x185, bytearray(5))):
        drive._bus.subscriber(identifier)(data, now)
    assert drive.health().counters["malformed"] == before + 3
    assert drive.is_commissioned
    drive._bus.subscriber(0x705)(OPERATIONAL, now)
    assert drive.is_commissioned


@pytest.fixture
def wire(joint):
    bus = can.Bus(interface="virtual", channel=joint.config.buses["can0"].channel)
    yield bus
    bus.shutdown()


def halts(wire):
    """Requests of pre-operational (NMT command 80h) to the node since the last call."""
    count = 0
    while (message := wire.recv(0)) is not None:
        count += message.arbitration_id == 0x000 and bytes(message.data) == bytes((0x80, 5))
    return count


def test_a_node_that_was_lost_and_is_operational_is_taken_out_of_operation(joint, wire):
    now = joint.clock.monotonic()
    beat = joint.drive._bus.subscriber(0x705)
    beat(OPERATIONAL, now)
    assert halts(wire) == 0
    beat(STOPPED, now)
    assert halts(wire) == 1
    beat(OPERATIONAL, now)
    assert halts(wire) == 1


def test_after_a_boot_up_not_before_its_process_data_are_counted(joint, wire):
    now = joint.clock.monotonic()
    beat, pdo = joint.drive._bus.subscriber(0x705), joint.drive._bus.subscriber(0x185)
    beat(BOOT_UP, now)
    beat(OPERATIONAL, now)
    for _ in range(2):
        pdo(PDO, now)
        beat(OPERATIONAL, now)
    assert halts(wire) == 0
    pdo(PDO, now)
    assert halts(wire) == 1
    beat(OPERATIONAL, now)
    assert halts(wire) == 1


def test_an_emergency_is_logged_once_until_it_changes(joint, caplog):
    """Error code 2310h or 4210h, error register, five bytes of the maker."""
    emergency, now = joint.drive._bus.subscriber(0x085), joint.clock.monotonic()
    logged = []
    for second, data in enumerate(("10 23 03", "10 23 03", "10 42 09", "00 00 00", "10 42 09")):
        caplog.clear()
        emergency(bytearray.fromhex(data) + bytes(5), now + second)  # one line per second at most
        logged.append(len(caplog.records))
    assert logged == [1, 0, 1, 0, 1]
    assert joint.drive.health().counters["emergencies"] == 4


def test_the_rated_torque_is_in_thousandths_of_a_newton_metre():
    bench = JointBench("csp", quantities=("position", "effort")).open()
    try:
        assert bench.objects[0x6076, 0] == 200
        assert bench.drive._units.effort == pytest.approx(0.01)  # N m per thousandth of 0.2 N m times 50
    finally:
        bench.close()


def test_the_mode_is_read_behind_a_temperature_in_the_same_frame():
    bench = JointBench("csp", quantities=("position", "temperature"), homing=HOMING).open()
    try:
        bench.cycle(41)
        assert bench.drive._actual_mode == 8  # cyclic synchronous position
        assert bench.value("temperature") == pytest.approx(25.0, abs=0.5)  # degrees Celsius
    finally:
        bench.close()
