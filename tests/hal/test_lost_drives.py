"""A drive that runs although the HAL has lost it must come to rest, whether or not it can be configured again."""

import pytest
from wire_bench import WireBench


@pytest.fixture
def bench():
    bench = WireBench().open()
    bench.enable()
    yield bench
    bench.close()


def lose(bench, *identifiers):
    for wire in bench.faulty.values():
        wire.lost = frozenset(identifiers)


def test_a_drive_without_a_heartbeat_is_taken_out_of_operation_though_it_answers_no_request(bench):
    lose(bench, 0x701, 0x581)
    bench.cycle(30)
    assert bench.robot.mode == "fault"
    bench.cycle(60)
    assert bench.world.enabled == []
    assert bench.rig.node("biceps_drive").condition == "pre_operational"
    lose(bench)
    bench.until(lambda: bench.states() <= {"ready", "fault"}, "being configured again")
    bench.robot.reset()
    bench.enable()


def test_a_drive_that_was_lost_when_the_robot_was_reset_is_reset_when_it_returns(bench):
    """The HAL stood still: the drive tripped for want of its heartbeat, and answers again after the reset only."""
    lose(bench, 0x701, 0x181, 0x581)
    bench.rig.fault("emcy biceps_drive")
    bench.cycle(30)
    assert bench.robot.mode == "fault"
    bench.robot.reset()
    bench.cycle(2)
    lose(bench)
    bench.until(lambda: bench.states() == {"ready"}, "the fault's reset")
    bench.enable()


def test_a_drive_that_is_taken_for_rebooted_by_a_forged_heartbeat_comes_to_rest(bench):
    lose(bench, 0x581)
    bench.faulty["can0"].say(0x701, b"\x7f")
    bench.cycle(80)
    assert bench.robot.mode == "fault"
    assert bench.world.enabled == []


def test_a_second_drive_with_the_same_node_id_is_told_and_neither_is_enabled(bench):
    before = bench.world.stray.copy()
    bench.rig.fault("node_back stray_drive")
    bench.cycle(100)
    assert bench.robot.mode == "fault"
    assert bench.world.enabled == []
    assert (bench.world.stray == before).all()
