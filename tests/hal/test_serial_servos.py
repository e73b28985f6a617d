"""Servos on a serial line, in real time: measure, move, fall silent, come back, lie about nothing."""

import math
import os
import pty
import select
import threading
import time
import tty

import numpy as np
import pytest
from serial_bench import NAMES, SETTINGS, SerialBench, path, robot_file

from hal.clock import SystemClock
from hal.config import BusConfig
from hal.errors import CommandRefused, ConfigError
from hal.fleet import build
from hal.line import SerialLine
from hal.registry import DRIVERS
from hal.robot import open_robot

by_make = pytest.mark.parametrize("make", SETTINGS)
GOAL = np.array([0.5, -0.4, 0.3])
STEP = 2 * math.pi / 4096


def test_every_serial_driver_is_tested_here():
    serial = {name for name, where in DRIVERS.items() if "serial" in where}
    assert serial == set(SETTINGS)


@by_make
@pytest.mark.long
def test_measures_in_si_units_in_the_right_direction_and_moves(make):
    with SerialBench(make) as bench:
        bench.settle()
        for value in (0.6, -0.7):
            for index, name in enumerate(NAMES):
                bench.set(name, value + 0.1 * index)
            in_time = []
            for _ in range(20):
                bench.cycle()
                in_time.append(bench.sample.complete and (bench.sample.age["joint_position"] < 0.02).all())
            assert np.mean(in_time) >= 0.8, "a busy machine holds up the servos now and then"
            assert bench.positions == pytest.approx(bench.truth, abs=STEP)
        for name in NAMES:
            bench.set(name, 0.0)
        bench.cycle(20)
        bench.enable()
        bench.cycle(25, GOAL)
        assert (np.sign(bench.sample.values["joint_velocity"]) == np.sign(GOAL)).all()
        bench.cycle(100, GOAL)
        assert bench.truth == pytest.approx(GOAL, abs=0.01)
        assert bench.positions == pytest.approx(bench.truth, abs=STEP)
        health = bench.robot.health()
        assert health["incomplete"] <= 0.1 * health["cycles"]  # a busy machine holds up the servos now and then


@by_make
@pytest.mark.long
def test_enabling_does_not_move_a_joint(make):
    """Feetech's goal is that of before, and Dynamixel's turn may change, when the torque is switched on."""
    with SerialBench(make) as bench:
        bench.settle()
        for value in (1.2, -1.1):
            for name in NAMES:
                bench.set(name, value)
            bench.cycle(10)
            before = bench.truth.copy()
            bench.enable()
            furthest = 0.0
            for _ in range(60):
                bench.cycle()
                furthest = max(furthest, float(np.abs(bench.truth - before).max()))
            assert furthest < 0.01
            bench.robot.disable()
            bench.until(lambda: bench.states() == {"ready"}, "disabling")


@by_make
@pytest.mark.long
def test_a_silent_servo_is_stale_alone_and_comes_back(make):
    """Servos answer in a chain, which a silent one breaks; the others must be measured all the same."""
    with SerialBench(make, robot_file(make, {"silent_after": 0.15})) as bench:
        bench.settle()
        bench.rig.fault("node_silent pan_servo")  # the first in the chain
        bench.cycle(12)
        assert bench.sample.valid["joint_position"].tolist() == [False, True, True]
        assert math.isnan(bench.positions[0])
        bench.cycle(20)
        assert bench.health("pan")["state"] == "silent"
        assert bench.health("lift")["state"] == "ready"
        ages = []
        for _ in range(100):
            bench.cycle()
            assert bench.sample.valid["joint_position"].tolist() == [False, True, True]
            ages.append(bench.sample.age["joint_position"][1:].max())
        assert np.quantile(ages, 0.95) < 0.03, "a busy machine is late now and then"
        with pytest.raises(CommandRefused, match="pan"):
            bench.robot.enable()
        bench.rig.fault("node_back pan_servo")
        bench.settle()
        assert bench.positions == pytest.approx(bench.truth, abs=STEP)
        assert bench.health("pan")["counters"]["commissioned"] >= 2


@by_make
@pytest.mark.long
def test_a_pulled_adapter_stops_the_robot_and_is_opened_again(make):
    with SerialBench(make) as bench:
        bench.enable()
        bench.unplug()
        bench.cycle(15)
        assert bench.robot.mode == "fault"
        assert not bench.sample.valid["joint_position"].any()
        assert np.isnan(bench.positions).all()
        assert bench.line["state"] == "gone"
        assert bench.line["text"].endswith("again.")
        bench.cycle(60)
        bench.plug()
        bench.until(lambda: bench.line["state"] == "ok", "opening again")
        bench.settle()
        assert bench.robot.mode == "fault", "no drive is enabled by itself"
        assert not any(enabled for _, enabled in bench.world._servos.values())
        bench.robot.reset()
        bench.enable()


@by_make
@pytest.mark.long
def test_a_servo_that_lost_its_supply_for_a_moment_stays_off_and_is_named(make):
    with SerialBench(make) as bench:
        bench.enable()
        bench.cycle(10, GOAL)
        bench.rig.fault("node_reboot lift_servo")
        bench.cycle(30)
        assert bench.robot.mode == "fault"
        assert "lift" in bench.robot.fault_text
        bench.cycle(100)
        assert not any(enabled for _, enabled in bench.world._servos.values())


@by_make
@pytest.mark.long
def test_a_hot_servo_is_a_fault_that_only_reset_ends(make):
    with SerialBench(make) as bench:
        bench.enable()
        bench.rig.fault("emcy elbow_servo")
        bench.until(lambda: bench.robot.mode == "fault", "the fault")
        assert "too hot" in bench.health("elbow")["text"]
        assert "elbow" in bench.robot.fault_text
        bench.cycle(60)
        assert not any(enabled for _, enabled in bench.world._servos.values())
        with pytest.raises(CommandRefused):
            bench.robot.enable()
        if make == "feetech":  # it cools down; Dynamixel's error needs a reboot, which reset does
            with bench.memory("elbow") as node:
                node._error = 0
        bench.robot.reset()
        bench.until(lambda: bench.health("elbow")["state"] == "ready", "the reset")
        bench.enable()


@by_make
@pytest.mark.long
def test_an_emergency_stop_ends_without_power(make):
    with SerialBench(make) as bench:
        bench.enable()
        bench.cycle(20, GOAL)
        results = []
        stopping = threading.Thread(target=lambda: results.append(bench.robot.estop("a test")))
        stopping.start()
        bench.cycle(60)
        stopping.join()
        assert results[0].is_complete, results
        assert not any(enabled for _, enabled in bench.world._servos.values())
        for _ in range(50):  # repeated requests do not give it power again
            bench.robot._emergency.request()
            bench.cycle()
            assert not any(enabled for _, enabled in bench.world._servos.values())


@by_make
@pytest.mark.long
def test_the_cycle_stops_and_only_a_watchdog_stops_the_servo(make):
    with SerialBench(make) as bench:
        bench.enable()
        bench.cycle(10, GOAL)
        time.sleep(0.5)  # the HAL hangs
        if make == "feetech":
            assert bench.node("pan").is_on
            assert "no watchdog" in bench.health("pan")["text"]
            return
        assert bench.node("pan").table[98] == 0xFF
        still = bench.truth.copy()
        time.sleep(0.3)
        assert bench.truth == pytest.approx(still, abs=1e-6)
        bench.cycle(20)
        assert bench.robot.mode == "fault"
        bench.until(lambda: not bench.robot._actuators.are_powered, "switching off")
        bench.robot.reset()
        bench.settle()
        bench.enable()
        bench.cycle(60, GOAL)
        assert bench.truth == pytest.approx(GOAL, abs=0.1)


@pytest.mark.long
def test_the_watchdog_of_a_small_dynamixel_is_not_believed():
    with pytest.raises(ConfigError, match="reports to have stopped"):
        build(robot_file("dynamixel", {"model": "XL330-M288"}), SystemClock())
    config = robot_file("dynamixel", {"model": "XL330-M288", "allow_no_watchdog": True})
    robot = open_robot(config)
    assert "follows its last set-point" in robot._devices[0]._has_no_watchdog()


@by_make
@pytest.mark.long
def test_a_position_that_jumps_by_a_turn_is_no_measurement(make):
    with SerialBench(make) as bench:
        bench.settle()
        bench.set("pan", 5.0)
        bench.cycle(6)
        assert math.isnan(bench.positions[0])
        assert bench.health("pan")["state"] == "fault"
        assert "half a turn" in bench.health("pan")["text"]
        bench.set("pan", 0.0)
        bench.cycle(6)
        assert math.isnan(bench.positions[0])
        bench.robot.reset()
        bench.settle()
        assert bench.positions[0] == pytest.approx(0.0, abs=STEP)


@by_make
@pytest.mark.long
def test_limits_beyond_those_of_the_servo_are_refused(make):
    config = robot_file(make, limits={"joint_position": {"low": -1.5, "high": 1.5, "rate": 3.0}})
    with SerialBench(make, config, lowest=1800, highest=2300) as bench:
        bench.cycle(40)
        text = bench.health("pan")["text"]
        assert "-0.3804 to 0.3866" in text and "-1.5 to 1.5" in text
        with pytest.raises(CommandRefused):
            bench.robot.enable()


@pytest.mark.long
def test_another_model_is_refused():
    with SerialBench("dynamixel", robot_file("dynamixel", {"model": "XM540-W270"})) as bench:
        bench.cycle(30)
        assert "is a XM430-W350, the robot file says XM540-W270" in bench.health("pan")["text"]


@by_make
@pytest.mark.long
def test_a_mode_that_is_wrong_is_written_once_and_kept(make):
    with SerialBench(make, robot_file(make, {"silent_after": 0.15})) as bench:
        with bench.memory("pan") as node:
            node.table[11 if make == "dynamixel" else 33] = 1
        bench.rig.fault("node_reboot pan_servo")
        bench.cycle(5)
        bench.rig.fault("node_silent pan_servo")
        bench.cycle(40)
        bench.rig.fault("node_back pan_servo")
        bench.settle()
        assert bench.node("pan").table[11 if make == "dynamixel" else 33] == (3 if make == "dynamixel" else 0)
        assert bench.node("pan").table[9 if make == "dynamixel" else 7] == 0
        if make == "feetech":
            assert bench.node("pan").table[55] == 1, "the memory is locked again"


@by_make
@pytest.mark.long
def test_noise_on_the_line_is_counted_and_no_measurement(make):
    with SerialBench(make) as bench:
        bench.settle()
        for name in NAMES:
            bench.set(name, 0.4)
        bench.cycle(10)
        segment = bench.rig._segments["arm"]
        draw = np.random.default_rng(3)
        for _ in range(60):
            os.write(segment._master, draw.bytes(int(draw.integers(1, 40))))
            bench.cycle()
            valid = bench.sample.valid["joint_position"]
            assert bench.positions[valid] == pytest.approx(0.4, abs=2 * STEP)
        bench.cycle(10)
        bench.settle()
        assert bench.positions == pytest.approx(0.4, abs=2 * STEP)


@by_make
@pytest.mark.long
def test_a_drive_current_or_load_has_the_sign_of_its_direction(make):
    force = "load" if make == "feetech" else "current"
    config = robot_file(make, quantities=("position", force, "voltage", "temperature"))
    with SerialBench(make, config) as bench:
        bench.enable()
        assert bench.sample.values["joint_voltage"] == pytest.approx(7.4 if make == "feetech" else 11.9, abs=0.05)
        assert (bench.sample.values["joint_temperature"] > 20).all()
        seen = np.zeros(3)
        for _ in range(30):
            bench.cycle(1, GOAL)
            measured = bench.sample.values[f"joint_{force}"]
            seen = np.where(np.abs(measured) > np.abs(seen), measured, seen)
        assert (np.sign(seen) == np.sign(GOAL)).all()


def test_effort_needs_a_torque_constant_and_a_current_sensor():
    for settings, sentence in (
        ({"mode": "effort"}, "torque_constant"),
        ({"model": "XL430-W250", "torque_constant": 1.0}, "no current sensor"),
        ({"max_current": 1.0, "mode": "velocity"}, "max_current"),
        ({"model": "AX-12"}, "Known: XL430-W250"),
    ):
        with pytest.raises(ConfigError, match=sentence):
            build(robot_file("dynamixel", settings), SystemClock())
    with pytest.raises(ConfigError, match="no watchdog"):
        build(robot_file("feetech", {"allow_no_watchdog": False}), SystemClock())


@pytest.mark.long
def test_effort_is_torque_at_the_joint():
    config = robot_file("dynamixel", {"torque_constant": 1.8, "gear": 2.0}, quantities=("position", "effort"))
    robot = open_robot(config)
    pan, lift, _ = robot._devices
    # 100 counts of 2.69 mA at 1.8 N m/A, behind a gear of 2; the second turns the other way
    assert pan._per_effort * 100 == pytest.approx(0.269 * 1.8 * 2)
    assert lift._per_effort * 100 == pytest.approx(-0.269 * 1.8 * 2)


def test_devices_on_the_wrong_wire_and_makes_on_one_line_are_refused():
    can = {"arm": {"interface": "virtual", "channel": "x"}}
    with pytest.raises(ConfigError, match="is for a serial line, and the interface of bus 'arm' is 'virtual'"):
        build(robot_file("feetech", buses=can), SystemClock())
    body = robot_file("feetech").model_dump(by_alias=True)
    kinds = {
        "servo": {"driver": "feetech", "settings": SETTINGS["feetech"]},
        "other": {"driver": "dynamixel", "settings": SETTINGS["dynamixel"]},
    }
    devices = dict(body["devices"])
    devices["lift_servo"] = {**devices["lift_servo"], "kind": "other"}
    with pytest.raises(ConfigError, match="do not understand each other"):
        build(robot_file("feetech", kinds=kinds, devices=devices), SystemClock())
    fd = {"arm": {"interface": "pty", "channel": "/nowhere/x", "data_bitrate": 2_000_000}}
    with pytest.raises(ConfigError, match=r"buses\.arm\.data_bitrate is for CAN FD, and 'pty' is a serial line"):
        build(robot_file("feetech", buses=fd), SystemClock())


def test_too_many_bytes_for_the_line_are_refused_before_it_opens():
    buses = {"arm": {"interface": "pty", "channel": "/nowhere/x", "bitrate": 57600}}
    with pytest.raises(ConfigError, match="would carry too much"):
        build(robot_file("feetech", buses=buses), SystemClock())


def test_a_line_that_is_not_there_says_so():
    line = SerialLine("arm", BusConfig(interface="serial", channel="/dev/ttyNONE"), SystemClock())
    line.open()
    assert line.health()["state"] == "gone"
    assert "There is no '/dev/ttyNONE'. Is the adapter plugged in?" in line.text
    line.close()


@pytest.mark.long
def test_two_programs_cannot_serve_or_use_one_line():
    with SerialBench("feetech") as bench:
        bench.settle()
        second = open_robot(bench.config)
        second.open()
        try:
            second.cycle()
            assert second.health()["buses"]["arm"]["state"] == "gone"
        finally:
            second.close()
        bench.cycle(5)
        assert bench.is_measured
        other = SerialBench("feetech", bench.config)
        with pytest.raises(Exception, match="another program serves"):
            other.plug()
        bench.cycle(5)
        assert bench.is_measured


@by_make
@pytest.mark.long
def test_an_adapter_that_returns_what_it_sends_changes_nothing(make):
    """Two wires on one: every byte that is sent is received, too."""
    config = robot_file(make)
    with SerialBench(make, config) as plain:
        inner = path(plain).resolve()
        master, slave = pty.openpty()
        tty.setraw(slave)
        plain.robot.close()
        outer = config.model_copy(
            update={"buses": {"arm": config.buses["arm"].model_copy(update={"channel": os.ttyname(slave)})}}
        )
        servo = os.open(inner, os.O_RDWR | os.O_NOCTTY)
        ends = threading.Event()

        def carry(source, *targets):
            while not ends.is_set():
                if select.select([source], [], [], 0.1)[0]:
                    data = os.read(source, 4096)
                    for target in targets:
                        os.write(target, data)

        threads = [
            threading.Thread(target=carry, args=(master, master, servo), daemon=True),
            threading.Thread(target=carry, args=(servo, master), daemon=True),
        ]
        for thread in threads:
            thread.start()
        plain.robot = open_robot(outer)
        plain.robot.open()
        try:
            plain.enable()
            plain.cycle(80, GOAL)
            assert plain.truth == pytest.approx(GOAL, abs=0.02)
            assert plain.positions == pytest.approx(plain.truth, abs=STEP)
            assert plain.line["counters"]["echoes"] > 50 or make == "dynamixel"
        finally:
            plain.robot.close()
            ends.set()
            for thread in threads:
                thread.join()
            for file in (master, slave, servo):
                os.close(file)
