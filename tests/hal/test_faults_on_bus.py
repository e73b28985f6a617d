"""What happens to the robot when a node, a frame or a whole bus misbehaves."""

import random
import struct

import can
import numpy as np
import pytest
from hal_bench import Bench

from hal.errors import CommandRefused


def is_moving(bench):
    return any(enabled for _, enabled in bench.world.drives.values())


def test_a_silent_encoder_is_invalid_within_50_ms_and_never_fresh_again(bench):
    bench.cycle(5)
    bench.rig.fault("sensor_silent elbow_encoder")
    ages, cycles = [], 0
    while bench.sample.valid["joint_position"][0]:
        bench.cycle()
        cycles += 1
        ages.append(bench.sample.age["joint_position"][0])
    assert cycles * bench.robot.period <= 0.05
    assert not bench.sample.complete
    assert np.isnan(bench.sample.values["joint_position"]).all()
    for _ in range(100):
        bench.cycle()
        ages.append(bench.sample.age["joint_position"][0])
        assert np.isnan(bench.sample.values["joint_position"]).all()
        assert not bench.sample.valid["joint_position"].any()
    assert np.all(np.diff(ages) > 0)
    assert bench.sample.valid["muscle_length"].all()


def test_a_silent_sensor_does_not_stop_the_robot(bench):
    bench.enable()
    bench.rig.fault("sensor_silent elbow_encoder")
    bench.cycle(60)
    assert bench.robot.mode == "hold"
    bench.until(lambda: "has not answered for" in bench.device("elbow_encoder")["text"], "silence")
    assert bench.device("elbow_encoder")["state"] == "silent"


def test_a_silent_node_is_not_waited_for(bench):
    bench.cycle(5)
    bench.rig.fault("node_silent elbow_encoder")
    bench.cycle(10)
    waited = []
    bench.clock.turn = lambda: (waited.append(1), bench.turn())
    bench.cycle(10)
    assert len(waited) <= 2 * 10
    assert all(node.node != 21 for bus in bench.buses.values() for node in bus._waiting)


def test_without_a_cell_the_tension_limit_says_that_it_cannot_act(bench):
    bench.enable()
    assert bench.robot.health()["limits"] == ""
    bench.rig.fault("node_silent biceps_cell")
    bench.cycle(10)
    assert bench.robot.health()["limits"] == "The tension limit cannot act without a valid tension of biceps."
    assert bench.robot.mode == "hold"


def test_an_overloaded_cell_is_invalid(bench):
    bench.world.tension[0] = 600.0
    bench.cycle(3)
    assert not bench.sample.valid["muscle_tension"][0]
    assert bench.sample.complete
    assert bench.device("biceps_cell")["text"]


@pytest.mark.parametrize("fault", ["node_silent", "sensor_silent"])
def test_a_silent_drive_stops_the_whole_group(bench, fault):
    bench.enable()
    bench.rig.fault(f"{fault} biceps_drive")
    cycles = 0
    while bench.robot.mode == "hold":
        bench.cycle()
        cycles += 1
    assert cycles * bench.robot.period < 0.2
    assert bench.robot.mode == "fault"
    assert "biceps_drive" in bench.robot.fault_text
    assert "silent" in bench.robot.fault_text
    bench.cycle(3)
    assert not bench.world.drives["muscle_length.triceps"][1]


def test_a_drive_that_reboots_while_enabled_is_commissioned_again_but_not_enabled(bench):
    bench.enable()
    bench.rig.fault("node_reboot biceps_drive")
    bench.cycle(2)
    assert bench.robot.mode == "fault"
    assert "reboot" in bench.robot.fault_text
    bench.until(lambda: bench.device("biceps_drive")["counters"]["commissioned"] == 2, "commissioning")
    bench.cycle(20)
    assert bench.device("biceps_drive")["state"] == "ready"
    assert bench.sample.valid["muscle_length"].all()
    assert bench.robot.mode == "fault"
    assert not is_moving(bench)
    bench.robot.reset()
    bench.enable()


def test_a_node_that_comes_back_is_commissioned_again(bench):
    bench.cycle(3)
    bench.rig.fault("node_silent elbow_encoder")
    bench.cycle(40)
    bench.rig.fault("node_back elbow_encoder")
    bench.until(lambda: bench.sample.valid["joint_position"].all(), "the encoder")
    assert bench.sample.complete


def test_a_drive_that_loses_its_supply_is_a_fault(bench):
    bench.enable()
    bench.rig.node("triceps_drive").state = type(bench.rig.node("triceps_drive").state).SWITCH_ON_DISABLED
    bench.cycle(3)
    assert bench.robot.mode == "fault"
    bench.cycle(50)
    assert not is_moving(bench)
    assert bench.robot.mode == "fault"


def test_an_emergency_of_a_drive_stops_the_group_until_reset(bench):
    bench.enable()
    bench.rig.fault("emcy biceps_drive")
    bench.cycle(3)
    assert bench.robot.mode == "fault"
    assert "biceps_drive" in bench.robot.fault_text
    assert bench.device("biceps_drive")["counters"]["emergencies"] == 1
    bench.cycle(100)
    assert bench.device("biceps_drive")["state"] == "fault"
    bench.robot.reset()
    bench.cycle(20)
    assert bench.device("biceps_drive")["state"] == "ready"
    assert not is_moving(bench)
    bench.enable()


def test_enabling_with_a_drive_in_fault_is_refused(bench):
    bench.cycle(2)
    bench.rig.fault("emcy biceps_drive")
    bench.cycle(3)
    with pytest.raises(CommandRefused, match="'biceps_drive' is fault"):
        bench.robot.enable()
    assert not is_moving(bench)


def test_an_emergency_of_a_sensor_makes_its_value_invalid(bench):
    bench.enable()
    bench.rig.fault("emcy elbow_encoder")
    bench.cycle(3)
    assert not bench.sample.valid["joint_position"].any()
    assert bench.robot.mode == "hold"
    assert bench.device("elbow_encoder")["state"] == "fault"
    bench.robot.disable()
    bench.cycle(4)
    bench.robot.reset()
    bench.cycle(2)
    assert bench.device("elbow_encoder")["state"] == "ready"
    assert "position error" in bench.device("elbow_encoder")["text"]
    assert not bench.sample.valid["joint_position"].any()


def test_a_frozen_cycle_stops_the_drives(bench):
    bench.enable()
    for _ in range(200):
        bench.pass_time()
    assert not is_moving(bench)
    bench.cycle(3)
    assert bench.robot.mode == "fault"


def test_frames_of_a_wrong_length_are_counted_and_change_nothing(bench):
    bench.cycle(3)
    before = {name: device["counters"]["malformed"] for name, device in bench.robot.health()["devices"].items()}
    for bus, cob in (("can0", 0x181), ("can0", 0x18B), ("can1", 0x195)):
        for length in (0, 1, 4, 7):
            bench.send(bus, cob, range(length))
    for data in (b"", bytes(2)):
        bench.send("can0", 0x701, data)
    bench.send("can0", 0x081, bytes(7))
    bench.cycle()
    counts = {name: device["counters"]["malformed"] for name, device in bench.robot.health()["devices"].items()}
    assert counts["biceps_drive"] - before["biceps_drive"] == 4 + 2 + 1
    assert counts["biceps_cell"] - before["biceps_cell"] == 4
    assert counts["elbow_encoder"] - before["elbow_encoder"] == 4
    np.testing.assert_allclose(bench.sample.values["muscle_length"], bench.world.length, atol=1e-6)


def test_remote_extended_error_and_unknown_frames_are_counted_and_ignored(bench):
    bench.cycle(3)
    bus, before = bench.buses["can0"], dict(bench.buses["can0"].counters)
    wire = bench.wires["can0"]
    wire.send(can.Message(arbitration_id=0x181, is_remote_frame=True, dlc=8, is_extended_id=False))
    wire.send(can.Message(arbitration_id=0x181, data=bytes(8), is_extended_id=True))
    wire.send(can.Message(arbitration_id=0x181, data=bytes(12), is_extended_id=False, is_fd=True))
    wire.send(can.Message(arbitration_id=0x123, data=bytes(8), is_extended_id=False))
    wire.send(can.Message(arbitration_id=0x20, is_error_frame=True, data=bytes(8)))
    bench.cycle()
    assert bus.counters["ignored"] - before["ignored"] == 2
    assert bus.counters["unknown"] - before["unknown"] == 2
    assert bus.counters["error_frames"] - before["error_frames"] == 1
    np.testing.assert_allclose(bench.sample.values["muscle_length"], bench.world.length, atol=1e-6)


def test_bus_off_while_enabled_is_a_fault(bench):
    bench.enable()
    bench.wires["can1"].send(can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8)))
    bench.flush_errors("can1")
    bench.cycle()
    assert bench.robot.mode == "fault"
    assert "bus-off" in bench.robot.fault_text


@pytest.mark.long
def test_a_bus_whose_peers_are_gone_reopens_and_its_nodes_work_again(bench):
    bench.enable()
    bench.powered = False
    bench.cycle(60)
    assert bench.robot.mode == "fault"
    bench.until(lambda: bench.buses["can0"].counters["opened"] > 1, "reopening")
    assert bench.buses["can0"].state == "gone"
    assert not bench.sample.valid["muscle_length"].any()
    bench.powered = True
    bench.until(lambda: bench.sample.complete, "the nodes")
    bench.cycle(5)
    assert bench.robot.mode == "fault"
    assert not is_moving(bench)
    bench.until(lambda: bench.states() <= {"ready", "fault"}, "commissioning")
    bench.robot.reset()
    bench.until(lambda: bench.states() == {"ready"}, "reset")
    bench.enable()


def test_a_robot_whose_nodes_are_off_starts_degraded_and_goes_on():
    bench = Bench(powered=False)
    try:
        bench.open()
        bench.cycle(5)
        assert not bench.sample.complete
        assert not any(valid.any() for valid in bench.sample.valid.values())
        assert bench.states() == {"silent"}
        with pytest.raises(CommandRefused):
            bench.robot.enable()
        bench.powered = True
        bench.until(lambda: bench.states() == {"ready"} and bench.sample.complete, "the nodes")
        bench.enable()
    finally:
        bench.close()


def test_a_handler_that_raises_does_not_end_the_receive_thread(bench, caplog):
    bench.cycle(2)
    bench.buses["can0"].subscribe(0x321, lambda data, received: 1 / 0)
    bench.send("can0", 0x321, b"x")
    bench.cycle(2)
    assert bench.buses["can0"].counters["broken_handlers"] == 1
    assert bench.sample.complete
    assert "ZeroDivisionError" in caplog.text


def test_stray_sdo_answers_are_not_taken_for_the_awaited_ones(bench):
    bench.cycle(2)
    for _ in range(50):
        bench.send("can0", 0x581, struct.pack("<BHBI", 0x43, 0x1018, 1, 0xDEAD))
    bench.rig.fault("node_reboot biceps_drive")
    bench.until(lambda: bench.device("biceps_drive")["counters"]["commissioned"] == 2, "commissioning")
    assert bench.device("biceps_drive")["counters"]["failed_openings"] == 0


def test_random_frames_raise_nothing_and_move_nothing(bench, caplog):
    bench.cycle(3)
    before = bench.world.length.copy()
    chance = random.Random(7)
    known = [base + node for base in (0x80, 0x180, 0x280, 0x580, 0x700) for node in (1, 2, 11, 12, 21)]
    for number in range(50_000):
        bus = bench.buses[chance.choice(("can0", "can1"))]
        identifier = chance.choice(known) if chance.random() < 0.7 else chance.randrange(0x800)
        if identifier == 0x7FE:
            continue
        message = can.Message(
            arbitration_id=identifier,
            data=chance.randbytes(chance.randrange(9)),
            is_extended_id=chance.random() < 0.05,
            is_error_frame=chance.random() < 0.02,
            is_remote_frame=False,
        )
        bus._handle(message, bench.clock.monotonic())
        if number % 500 == 0:
            bench.cycle()
            assert bench.applied.mode == "off"
    bench.cycle(3)
    np.testing.assert_array_equal(bench.world.length, before)
    assert not is_moving(bench)
    assert all(bus.counters["broken_handlers"] == 0 for bus in bench.buses.values())
    bench.until(lambda: bench.states() <= {"ready", "fault"}, "recovery")
    bench.robot.reset()
    bench.until(lambda: bench.states() == {"ready"} and bench.sample.complete, "reset")
    bench.enable()
