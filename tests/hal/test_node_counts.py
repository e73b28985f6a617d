"""How many frames a CANopen node may send at the wrong time before it is taken for two nodes under one id."""

import pytest
from drive_bench import JointBench

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
