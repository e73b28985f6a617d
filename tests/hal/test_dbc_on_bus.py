"""A servo and a load cell by their DBC files against simulated ones: what is measured, commanded, told and refused."""

import math
import re
import struct
import threading

import numpy as np
import pytest
from dbc_bench import axis, dbc_bench, description, follow, opened, position, turns

from hal.config import RobotConfig
from hal.errors import CommandRefused, ConfigError
from hal.robot import open_robot
from simulators.nodes.odrive import DRV_FAULT, ESTOP_REQUESTED, WATCHDOG_TIMER_EXPIRED

AXIS = 3 << 5
HEARTBEAT, ESTIMATES, INPUT_POSITION, SET_STATE = AXIS | 0x01, AXIS | 0x09, AXIS | 0x0C, AXIS | 0x07


@pytest.fixture
def bench():
    bench = opened(dbc_bench())
    yield bench
    bench.close()


@pytest.fixture
def make():
    made = []

    def one(*arguments, **settings):
        bench = dbc_bench(*arguments, **settings)
        made.append(bench)
        return opened(bench)

    yield one
    for bench in made:
        bench.close()


def sent_by_hal(bench, identifier):
    """Data of the frames with an identifier that have passed since the last look."""
    found = []
    while (message := bench.wires["can0"].recv(0)) is not None:
        if message.arbitration_id == identifier and not message.is_remote_frame:
            found.append(bytes(message.data))
    return found


def ready(bench):
    return bench.device("elbow_axis")["state"] == "ready"


def test_measures_in_si_units(bench):
    bench.world.break_part("set:wire_force.elbow:-123.456")
    sample, applied = bench.cycle(4)
    assert sample.complete
    assert sample.values["joint_position"] == pytest.approx(0.6, abs=1e-6)  # rad
    assert sample.values["joint_velocity"] == pytest.approx(0.0, abs=1e-6)  # rad/s
    assert sample.values["wire_force"] == pytest.approx(-123.456, abs=1e-3)  # N
    assert all(valid.all() for valid in sample.valid.values())
    assert applied.mode == "off"


def test_an_identity_is_asked_for(bench):
    devices = {device.name: device for device in bench.robot._devices}
    assert devices["elbow_axis"].identity == f"dbc:odrive_cansimple-{axis(bench).spec.serial:X}"
    assert devices["elbow_cell"].identity == ""


def test_enables_without_a_jump_and_holds(bench):
    """The simulated axis follows its last set-point when its loop closes: one that is elsewhere would be seen."""
    axis(bench).input[3] = turns(-1.5)
    bench.enable()
    bench.cycle(40)
    assert bench.robot.mode == "hold"
    assert axis(bench).condition == "closed loop control"
    assert position(bench) == pytest.approx(0.6, abs=1e-4)  # rad


def test_the_set_point_before_the_loop_closes_is_where_the_axis_is(bench):
    sent_by_hal(bench, INPUT_POSITION)
    bench.robot.enable()
    while axis(bench).condition != "closed loop control":
        before = sent_by_hal(bench, INPUT_POSITION)
        bench.cycle()
    assert struct.unpack("<fhh", before[-1]) == pytest.approx((turns(0.6), 0, 0), abs=1e-5)


def test_follows_and_comes_to_hold_and_off(bench):
    bench.enable()
    follow(bench, 1.0, 150)
    assert bench.robot.mode == "follow"
    assert position(bench) == pytest.approx(1.0, abs=2e-3)  # rad
    bench.cycle(25)
    assert bench.robot.mode == "hold"
    bench.cycle(160)
    assert bench.robot.mode == "off"
    assert axis(bench).condition == "idle"


@pytest.mark.parametrize("mode", ["velocity", "effort"])
def test_other_modes_start_from_nothing_and_follow(make, mode):
    bench = make(mode)
    axis(bench).input[1] = 0.5  # left over from somebody else
    axis(bench).input[2] = 3.0
    bench.enable()
    bench.cycle(20)
    assert position(bench) == pytest.approx(0.6, abs=2e-3)  # rad
    follow(bench, 0.5, 60)
    assert axis(bench).control_mode == {"velocity": 2, "effort": 1}[mode]
    if mode == "velocity":
        assert axis(bench)._rotor.velocity == pytest.approx(0.5, abs=0.01)  # rad/s
    else:
        assert axis(bench).torque * 8.0 == pytest.approx(0.5, rel=1e-5)  # N m at the joint
    assert bench.sample.values[f"joint_{mode}"] == pytest.approx(0.5, abs=0.02)


def test_an_effort_is_damped_when_the_robot_stops(make):
    bench = make("effort", odrive={"damping": 2.0}, stop={"behaviour": "damp"})
    bench.enable()
    follow(bench, 2.0, 40)
    speed = axis(bench)._rotor.velocity
    assert speed > 0.5  # rad/s
    bench.robot.stop("a test")
    bench.cycle(30)
    assert 0.0 < axis(bench)._rotor.velocity < 0.3 * speed
    assert axis(bench).torque < 0.0
    bench.until(lambda: bench.robot.mode == "off", "off", 200)


def test_a_fault_of_the_axis_stops_the_robot_and_is_told_in_words(bench):
    bench.enable()
    follow(bench, 0.8, 10)
    bench.rig.fault("emcy elbow_axis")
    bench.until(lambda: bench.robot.mode == "fault", "fault", 40)
    assert "drv fault (Heartbeat.Axis_Error)" in bench.robot.fault_text
    bench.until(lambda: bench.device("elbow_axis")["state"] == "fault", "its state", 40)
    assert axis(bench).condition == f"error {DRV_FAULT:X}h"
    with pytest.raises(CommandRefused, match="Reset"):
        bench.robot.enable()
    bench.robot.reset()
    bench.until(lambda: ready(bench), "reset", 80)
    bench.cycle(60)
    assert bench.robot.mode == "off"
    assert axis(bench).condition == "idle"
    bench.enable()


def test_an_axis_that_is_disarmed_is_not_enabled_by_anything_but_a_request(bench):
    bench.enable()
    bench.send("can0", SET_STATE, struct.pack("<II", 1, 0))
    bench.until(lambda: bench.robot.mode == "fault", "fault", 60)
    bench.cycle(100)
    assert axis(bench).condition == "idle"
    bench.robot.reset()
    bench.cycle(100)
    assert (bench.robot.mode, axis(bench).condition) == ("off", "idle")


def test_an_axis_that_somebody_else_enables_is_disabled(bench):
    bench.send("can0", SET_STATE, struct.pack("<II", 8, 0))
    bench.until(lambda: axis(bench).condition == "closed loop control", "somebody enabled it", 40)
    bench.until(lambda: axis(bench).condition == "idle", "disabled", 120)
    assert position(bench) == pytest.approx(0.6, abs=1e-3)  # rad


def test_a_silent_heartbeat_stops_the_robot_though_estimates_go_on(bench):
    bench.enable()
    follow(bench, 0.7, 5)
    node = axis(bench)
    del node._periods[node._heartbeat]
    cycles = 0
    while bench.robot.mode != "fault":
        follow(bench, 0.7, 1)
        cycles += 1
    assert cycles * 0.005 <= 0.35 + 0.11  # s: the timeout, and at most one beat before it
    assert "has sent no 'Heartbeat' for 0.35 s" in bench.robot.fault_text
    bench.until(lambda: axis(bench).condition == "idle", "disabled", 40)


def test_a_silent_axis_stops_the_robot_and_is_found_again(bench):
    bench.enable()
    bench.rig.fault("node_silent elbow_axis")
    cycles = 0
    while bench.robot.mode != "fault":
        bench.cycle()
        cycles += 1
    assert cycles * 0.005 <= 0.15 + 0.02  # s: silent_after
    assert not bench.sample.valid["joint_position"].any()
    bench.rig.fault("node_back elbow_axis")
    bench.until(lambda: ready(bench), "back", 4000)
    assert bench.device("elbow_axis")["counters"]["commissioned"] >= 2
    bench.robot.reset()
    bench.cycle(60)
    assert (bench.robot.mode, axis(bench).condition) == ("off", "idle")
    bench.until(lambda: ready(bench), "ready", 100)
    bench.enable()


def test_a_reboot_is_seen_and_the_axis_opened_anew(bench):
    bench.enable()
    boots = bench.device("elbow_axis")["counters"]["boots"]
    bench.rig.fault("node_reboot elbow_axis")
    bench.until(lambda: bench.robot.mode == "fault", "fault", 40)
    bench.until(lambda: ready(bench), "opened anew", 4000)
    assert bench.device("elbow_axis")["counters"]["boots"] == boots + 1
    bench.cycle(60)
    assert axis(bench).condition == "idle"


def test_the_watchdog_stops_the_axis_when_the_host_dies(bench):
    bench.enable()
    follow(bench, 2.0, 20)
    moved = position(bench)
    for _ in range(60):  # nobody cycles any more
        bench.rig.step(0.005)
    assert axis(bench).error == WATCHDOG_TIMER_EXPIRED
    assert not axis(bench).servo[1]
    assert position(bench) - moved < 2.0 * 0.2 + 0.1  # rad: on to the last set-point at most, and then no further
    bench.flush()
    bench.cycle(2)
    assert bench.robot.mode == "fault"
    bench.cycle(100)
    assert axis(bench).error == WATCHDOG_TIMER_EXPIRED  # what stopped an axis is left only by a reset
    assert "watchdog timer expired" in bench.device("elbow_axis")["text"]
    bench.robot.reset()
    bench.until(lambda: ready(bench), "reset", 80)


def test_what_a_watchdog_stopped_while_the_host_was_frozen_is_not_cleared_by_itself(bench):
    """The robot finds out by itself that it was frozen, and lets go before it hears what its drives say."""
    bench.enable()
    for _ in range(60):
        bench.rig.step(0.005)
    bench.robot.disable()
    bench.flush()
    bench.cycle(100)
    assert axis(bench).error == WATCHDOG_TIMER_EXPIRED
    bench.until(lambda: bench.robot.mode == "fault", "fault", 400)
    bench.robot.reset()
    bench.until(lambda: ready(bench), "reset", 80)


def test_a_watchdog_that_ran_out_at_rest_is_no_fault(bench):
    for _ in range(60):
        bench.rig.step(0.005)
    assert axis(bench).error == WATCHDOG_TIMER_EXPIRED
    bench.flush()
    bench.until(lambda: not axis(bench).error, "cleared", 10)
    bench.until(lambda: ready(bench), "ready", 60)
    bench.enable()
    assert bench.device("elbow_axis")["counters"]["watchdog_expired"] >= 1


def test_an_emergency_stop_brakes_before_it_lets_go(bench):
    bench.enable()
    follow(bench, 2.0, 60)
    speed = axis(bench)._rotor.velocity
    assert speed > 1.0  # rad/s
    stopping = threading.Thread(target=bench.robot.estop, args=("a test",))
    stopping.start()
    bench.until(lambda: not stopping.is_alive(), "stopped")
    assert axis(bench).condition == "idle"
    assert abs(axis(bench)._rotor.velocity) < 0.1  # rad/s
    assert bench.robot.mode == "fault"
    assert axis(bench).error == 0


def test_an_axis_that_does_not_obey_is_sent_an_estop(bench):
    bench.enable()
    node = axis(bench)
    node._request = lambda data: None
    node.routes_changed()
    bench.robot._modes.halt(bench.clock.monotonic())
    bench.until(lambda: node.error == ESTOP_REQUESTED, "estop", 300)
    assert not node.servo[1]


@pytest.mark.parametrize("size", [0, 1, 4, 7])
def test_frames_of_another_length_are_dropped_and_counted(bench, size):
    bench.enable()
    before = bench.device("elbow_axis")["counters"]["malformed"]
    for identifier in (HEARTBEAT, ESTIMATES):
        bench.send("can0", identifier, struct.pack("<ff", 99.0, 99.0)[:size])
    sample, _ = bench.cycle(2)
    assert bench.device("elbow_axis")["counters"]["malformed"] == before + 2
    assert sample.values["joint_position"] == pytest.approx(0.6, abs=1e-3)  # rad
    assert bench.robot.mode == "hold"


def test_two_axes_under_one_node_id_are_told(bench):
    bench.enable()
    for _ in range(240):
        if bench.robot.mode == "fault":
            break
        bench.send("can0", ESTIMATES, struct.pack("<ff", turns(0.6), 0.0))
        follow(bench, 0.6, 1)
        bench.cycle()
    assert "Do two devices have this node id" in bench.robot.fault_text


def test_no_number_is_no_value(bench):
    bench.send("can0", ESTIMATES, struct.pack("<ff", math.nan, math.inf))
    bench.flush()
    values, _, valid = bench.robot._assembler.assemble(bench.clock.monotonic())
    assert not valid["joint_position"].any()
    assert not valid["joint_velocity"].any()
    assert np.isnan(values["joint_velocity"]).all()


def test_a_cell_in_error_has_no_value_and_says_why(bench):
    bench.rig.fault("emcy elbow_cell")
    sample, _ = bench.cycle(2)
    assert not sample.valid["wire_force"].any()
    assert "sensor broken (Force.Status)" in bench.device("elbow_cell")["text"]
    assert bench.robot.mode == "off"


def test_a_cell_is_tared(bench):
    bench.world.break_part("set:wire_force.elbow:5")
    bench.cycle(2)
    next(device for device in bench.robot._devices if device.name == "elbow_cell").tare()
    sample, _ = bench.cycle(3)
    assert sample.values["wire_force"] == pytest.approx(0.0, abs=1e-3)  # N


def test_zero_and_gain_of_a_cell_and_direction_of_an_axis(make):
    changes = {"cell_settings": {"zero": -4.0, "gain": 2.0}, "odrive": {"direction": -1}}
    bench = make(cell={"unbalance": 3.0}, constants={"direction": -1}, **changes)
    sample, _ = bench.cycle(2)
    assert sample.values["wire_force"] == pytest.approx(2.0, abs=1e-3)  # N: 2 * 3 - 4
    assert sample.values["joint_position"] == pytest.approx(0.6, abs=1e-6)  # rad
    bench.enable()
    follow(bench, 0.7, 60)
    assert position(bench) == pytest.approx(0.7, abs=2e-3)  # rad


def test_long_identifiers(make):
    bench = make(constants={"is_extended": True}, odrive={"extended": True})
    sample, _ = bench.cycle(4)
    assert sample.values["joint_position"] == pytest.approx(0.6, abs=1e-6)  # rad
    bench.enable()
    follow(bench, 0.8, 80)
    assert position(bench) == pytest.approx(0.8, abs=2e-3)  # rad


def test_messages_that_do_not_come_are_told(make):
    bench = dbc_bench(constants={"encoder": 0.0}).open()
    try:
        assert "sends no 'Get_Encoder_Estimates'" in bench.device("elbow_axis")["text"]
        assert bench.device("elbow_axis")["state"] == "opening"
    finally:
        bench.close()


def test_what_the_doctor_sees(bench):
    found = {}
    axis_device = next(device for device in bench.robot._devices if device.name == "elbow_axis")
    bench.while_time_passes(lambda: found.update({check.what: check for check in axis_device.inspect()}))
    assert found["watchdog"].is_good
    assert found["message 'Heartbeat'"].is_good
    axis(bench)._periods[axis(bench)._heartbeat] = 0.3
    bench.while_time_passes(lambda: found.update({check.what: check for check in axis_device.inspect()}))
    every = re.fullmatch(r"It comes every ([\d.]+) s, but `periods` has 0.1 s\..*", found["message 'Heartbeat'"].text)
    assert every and float(every[1]) == pytest.approx(0.3, abs=0.01), "its period within a cycle of the HAL"


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"heartbeat": {"message": "Hartbeat", "timeout": 1.0}}, "no message 'Hartbeat'. Did you mean Heartbeat"),
        (
            {"state": {"signal": "Heartbeat.State", "ready": [1], "enabled": [8]}},
            "Message 'Heartbeat' .* has no signal 'State'. Did you mean Axis_State",
        ),
        (
            {"state": {"signal": "Heartbeat.Axis_State", "ready": ["IDLE"], "enabled": ["CLOSED_LOOP"]}},
            "has no value 'CLOSED_LOOP'. Did you mean CLOSED_LOOP_CONTROL",
        ),
        ({"periods": {"Get_Velocity": 0.1}}, "no message 'Get_Velocity'"),
        ({"watchdog": None}, "a DBC file has no watchdog"),
        ({"watchdog": {"timeout": 0.1, "fed_by": ["Heartbeat"]}}, "none of them is sent in every cycle"),
        ({"watchdog": {"timeout": 0.01, "fed_by": ["Set_Input_Pos"]}}, "less than 3 cycles"),
        ({"silent_after": 0.015}, "silent_after is 0.015 s, but 'Get_Encoder_Estimates' comes every 0.01 s"),
        ({"dbc": "dbc/odrive.dbc"}, "There is no DBC file"),
        ({"dbc": "eds/servo_drive.eds"}, "not a DBC file"),
        ({"gear": 0.0}, "gear"),
        ({"mode": "torque"}, "mode"),
        ({"enable": []}, "enable"),
        ({"damping": 1.0}, "damping needs an effort command"),
        ({"reset": [{"send": "Clear_Errors", "until": {"signal": "Heartbeat.Axis_Error"}}]}, "either `equals`"),
        ({"reset": [{}]}, "a step needs `send`"),
        ({"error": {"signal": "Heartbeat.Axis_Error", "good": False}}, "put the name in quotes"),
        ({"voltage_limit": 3}, "unknown key 'voltage_limit'. Known keys there: .*gear"),
    ],
)
def test_a_robot_file_that_names_what_is_not_there_is_refused(changes, sentence):
    with pytest.raises(ConfigError, match=sentence):
        open_robot(RobotConfig.model_validate(description(odrive=changes)))


def test_a_servo_may_go_without_a_watchdog_if_the_robot_file_says_so():
    changes = {"watchdog": None, "allow_no_watchdog": True}
    devices = {d.name: d for d in open_robot(RobotConfig.model_validate(description(odrive=changes)))._devices}
    assert not devices["elbow_axis"]._check_watchdog().is_good


def test_a_node_id_beyond_the_identifiers_is_refused():
    body = description()
    body["devices"]["elbow_axis"]["node"] = 64
    with pytest.raises(ConfigError, match=r"node id 64 gives .* the identifier 8\w\wh.* largest node id is 63"):
        open_robot(RobotConfig.model_validate(body))
    body["devices"]["elbow_axis"]["node"] = 63
    with pytest.raises(ConfigError, match="63 is for axes that have none yet"):
        open_robot(RobotConfig.model_validate(body))
