"""What every kind of device that moves something must do: start without a jump, follow, stop, and stay off after."""

import math

import numpy as np
import pytest
from conformance_stage import LockStage
from device_kinds import ACTUATORS, KINDS, NAME

from hal.config import RobotConfig
from hal.errors import CommandRefused, ConfigError
from hal.robot import open_robot

STILL = 0.005
"""A drive that is enabled may settle by so much [rad]."""
ARRIVED = 0.03
"""A drive with a spring for a controller is not nearer to its set-point than this [rad]."""


@pytest.fixture
def stage(request):
    stage = LockStage(request.param).open()
    stage.settle()
    yield stage
    stage.close()


every_actuator = pytest.mark.parametrize("stage", ACTUATORS, ids=str, indirect=True)
FORWARD = {"position": 0.2, "velocity": 0.4, "effort": 2.0}
"""What is asked for to move towards greater positions: a way from here, or a value."""


def place(stage):
    return float(stage.world.truth()["thing_position"][0])


def forward(stage, cycles):
    """Command a motion towards greater positions; the set-point."""
    quantity = stage.kind.commanded
    goal = FORWARD[quantity] + (place(stage) if quantity == "position" else 0.0)
    stage.follow(goal, cycles)
    return goal


def let_go(stage):
    stage.robot.disable()
    stage.until(lambda: stage.robot.mode == "off", "letting go")
    stage.until(lambda: not stage.is_powered, "being without power")


@every_actuator
@pytest.mark.long
def test_enabling_does_not_move_following_does_and_an_old_command_is_forgotten(stage):
    start = place(stage)
    stage.cycle(50)
    assert not stage.is_powered, "it was enabled by itself"
    with pytest.raises(CommandRefused):
        stage.robot.command(np.array([0.1]), stage.sample.cycle)
    stage.enable()
    stage.cycle(20)
    assert place(stage) == pytest.approx(start, abs=STILL)
    goal = forward(stage, 60)
    if stage.kind.commanded == "position":
        assert place(stage) == pytest.approx(goal, abs=ARRIVED)
    else:
        assert place(stage) > start + 0.05
    let_go(stage)
    stage.world.break_part(f"set:thing_position.one:{start - 0.3}")
    stage.cycle(50)
    assert not stage.is_powered
    there = place(stage)
    stage.enable()
    stage.cycle(30)
    assert place(stage) == pytest.approx(there, abs=STILL), "it went on with what was asked for before"


@every_actuator
@pytest.mark.long
def test_set_points_are_clipped_and_what_is_no_number_is_refused(stage):
    stage.enable()
    for bad in (math.nan, math.inf):
        with pytest.raises(CommandRefused):
            stage.robot.command(np.array([bad]), stage.sample.cycle)
    low, high = stage.kind.limits["low"], stage.kind.limits["high"]
    stage.follow(50.0 * high, 30)
    assert low <= float(stage.applied.values[0]) <= high
    if stage.kind.commanded == "position":
        stage.follow(50.0 * high, 120)
        assert place(stage) <= high + ARRIVED
    else:
        assert stage.applied.limited_by


@every_actuator
@pytest.mark.long
def test_a_fault_ends_in_no_power_until_reset_and_enable(stage):
    stage.enable()
    forward(stage, 10)
    stage.rig.fault(f"emcy {NAME}")
    cycles = 0
    while stage.robot.mode in ("hold", "follow"):
        stage.cycle()
        cycles += 1
        assert cycles < 20, "the fault is not noticed"
    stage.until(lambda: not stage.is_powered, "being without power")
    stage.cycle(100)
    assert not stage.is_powered
    assert stage.robot.mode == "fault"
    assert stage.refuses_to_enable()
    stage.rig.fault(f"node_back {NAME}")
    stage.cycle(20)
    stage.robot.reset()
    stage.until(lambda: stage.is_ready, "being ready after the reset")
    stage.cycle(50)
    assert not stage.is_powered
    stage.enable_again()


@every_actuator
@pytest.mark.long
def test_a_reboot_while_enabled_ends_in_no_power(stage):
    stage.enable()
    stage.rig.fault(f"node_reboot {NAME}")
    stage.cycle(30)
    assert not stage.is_powered
    if stage.kind.tells_state:
        assert stage.robot.mode == "fault"
        stage.robot.reset()
    else:
        let_go(stage)
    stage.cycle(50)
    assert not stage.is_powered
    stage.enable_again()


@every_actuator
@pytest.mark.long
def test_a_quick_stop_ends_in_rest_without_power(stage):
    stage.enable()
    forward(stage, 15)
    stage.robot._devices[0].quick_stop()
    stage.cycle(100)
    rest = place(stage)
    stage.cycle(20)
    assert place(stage) == pytest.approx(rest, abs=1e-6)
    assert not stage.is_powered
    assert stage.robot.mode in ("off", "fault")


@every_actuator
@pytest.mark.long
def test_it_stops_by_itself_when_the_hal_falls_silent_or_says_that_it_cannot(stage):
    stage.enable()
    forward(stage, 5)
    if math.isinf(stage.kind.watchdog):
        assert "no watchdog" in stage.health["text"]
        return
    for _ in range(round(stage.kind.watchdog / 0.01)):
        stage.pass_time()
    assert not stage.is_powered
    rest = place(stage)
    stage.pass_time(0.1)
    assert place(stage) == rest


@pytest.mark.parametrize("kind", [kind for kind in ACTUATORS if math.isinf(kind.watchdog)], ids=str)
def test_a_drive_without_a_watchdog_is_refused_unless_that_is_allowed(kind):
    body = kind.description({"interface": "virtual", "channel": "conformance_refused"})
    settings = {key: value for key, value in kind.settings.items() if key != "allow_no_watchdog"}
    body["kinds"]["thing"]["settings"] = settings
    with pytest.raises(ConfigError, match="watchdog"):
        open_robot(RobotConfig.model_validate(body))


@pytest.mark.parametrize("stage", [kind for kind in ACTUATORS if kind.driver == "mit"], ids=str, indirect=True)
def test_one_that_can_damp_does_not_jump_when_it_is_asked_to(stage):
    device = stage.robot._devices[0]
    assert device.can_damp
    stage.enable()
    start = place(stage)
    for _ in range(20):
        device.damp()
        stage.pass_time()
    assert place(stage) == pytest.approx(start, abs=STILL)


def test_there_is_an_actuator_for_every_quantity_that_can_be_commanded():
    assert {kind.commanded for kind in KINDS if kind.commanded} == {"position", "velocity", "effort"}
