"""Measured values that cannot be: outside of what is possible, jumping, frozen; and when they are trusted again."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from safety_bench import JOINTS, LIMITS, SafetyBench, description

from hal.clock import ManualClock
from hal.config import RobotConfig, load_robot
from hal.errors import ConfigError
from hal.fleet import build
from hal.safety.plausibility import Plausibility
from hal.safety.possible import possible
from hal.sample import Assembler

ROBOTS = Path(__file__).resolve().parents[2] / "robots"
PERIOD = 0.01
ONE = {
    "robot": "one",
    "signals": {
        "joint_position": {"unit": "rad", "elements": ["elbow"]},
        "cell": {"unit": "N", "elements": ["elbow"]},
        "far_position": {"unit": "rad", "elements": ["tool"]},
    },
    "command": {"signal": "joint_position"},
    "limits": {
        "joint_position": {"low": -1.0, "high": 1.0, "rate": 2.0},
        "cell": {"soft_high": 200, "trip_high": 400},
        "far_position": {"low": -1.0, "high": 1.0},
    },
    "rates": {"hal": 1 / PERIOD},
}


class Quantities:
    """What a device would say of its elements."""

    commands, command_quantity = ("joint_position.elbow",), "position"
    served = {"position": "joint_position.elbow", "force": "cell.elbow"}  # noqa: RUF012


class Other:
    commands, command_quantity = (), ""
    served = {"position": "far_position.tool"}  # noqa: RUF012


class Watched:
    """The check of three elements, fed one cycle after the other: joint [rad], load cell [N], another joint [rad]."""

    def __init__(self, quantity="position", **plausible):
        body = {**ONE, "signals": {name: dict(signal) for name, signal in ONE["signals"].items()}}
        for name, values in plausible.items():
            body["signals"][name]["plausible"] = values
        config = RobotConfig.model_validate(body)
        drive = Quantities()
        drive.command_quantity = quantity
        self.check = Plausibility.of(config, tuple(config.signals), [drive, Other()])
        self.now = 10.0
        self.values = np.array([0.1, 50.0, 0.2])

    def feed(self, joint=None, cell=None, far=None, set_point=None, wait=PERIOD):
        """A cycle with new values; those that are not given flicker by a bit. Returns whether each is usable."""
        self.now += wait
        flicker = np.copysign([1e-6, 1e-3, 1e-6], (-1) ** round(self.now / PERIOD))
        given = [np.nan if value is None else value for value in (joint, cell, far)]
        self.values = np.where(np.isnan(given), self.values + flicker, given)
        self.check.command(None if set_point is None else np.array([set_point]))
        return self.check.check(self.values, np.full(3, self.now), np.ones(3, bool)).tolist()

    def cycles_until_trusted(self, index, most=2000, **values):
        return next(count for count in range(1, most) if self.feed(**values)[index])


@pytest.fixture
def watched():
    watched = Watched()
    for _ in range(5):
        assert watched.feed() == [True, True, True]
    return watched


@pytest.mark.parametrize(("name", "index", "value"), [("cell", 1, -50.0), ("cell", 1, 900.0), ("far", 2, 3.5)])
def test_a_value_that_cannot_be_is_invalid_and_says_why_and_comes_back(watched, name, index, value):
    for _ in range(3):
        assert not watched.feed(**{name: value})[index]
    (text,) = watched.check.texts().values()
    assert "possible is" in text and text.endswith("?")
    assert watched.cycles_until_trusted(index, **{name: 50.0 if index == 1 else 0.2}) <= 2
    assert not watched.check.texts()


def test_a_jump_of_a_drives_encoder_beyond_its_speed_is_invalid_while_it_stays(watched):
    assert watched.feed(joint=0.35) == [False, True, True]
    assert "jumped from 0.1" in watched.check.texts()["joint_position.elbow"]
    cycles = watched.cycles_until_trusted(0)
    assert cycles * PERIOD == pytest.approx(5.0, abs=0.05), "it may have been wrong before: it comes back by itself"


def test_a_single_wrong_value_costs_one_cycle(watched):
    assert not watched.feed(joint=0.9)[0]
    assert watched.feed(joint=0.1)[0]


def test_a_value_that_went_away_and_came_back_is_measured_again_after_half_a_second(watched):
    watched.feed(joint=0.9)
    for _ in range(50):
        assert not watched.feed()[0]
    assert not watched.feed(joint=0.1)[0]
    assert watched.cycles_until_trusted(0) * PERIOD == pytest.approx(0.5, abs=0.03)


def test_values_at_random_places_are_hardly_ever_believed_and_then_nearly_right(watched):
    rng = np.random.default_rng(1)
    believed = []
    for _ in range(500):
        value = rng.uniform(-1.0, 1.0)
        if watched.feed(joint=value)[0]:
            believed.append(value)
    assert len(believed) <= 3
    assert all(abs(value - 0.1) < 1.0 * 8.0 * PERIOD * 4 for value in believed)


def test_the_fastest_possible_motion_is_no_jump(watched):
    position = 0.1
    for step in itertools.chain([7.9 * PERIOD] * 10, [-7.9 * PERIOD] * 10):
        position += step
        assert watched.feed(joint=position)[0]


def test_after_a_pause_a_value_may_be_anywhere(watched):
    assert watched.feed(joint=0.9, wait=1.0)[0]


def test_a_load_that_leaps_must_be_confirmed_by_the_next_measurement(watched):
    assert not watched.feed(cell=300.0)[1], "one wrong byte"
    assert watched.feed(cell=50.0)[1]
    assert not watched.feed(cell=300.0)[1], "a muscle that tears, or a blow"
    assert watched.feed(cell=301.0)[1]
    assert not watched.feed(cell=50.0, wait=0.1)[1], "after a pause too"
    assert watched.feed(cell=50.1)[1]


def test_what_does_not_change_by_a_bit_while_commanded_to_move_is_frozen(watched):
    for count in range(60):
        usable = watched.feed(cell=50.0, set_point=0.1 + 0.02 * count)
    assert usable == [True, False, True]
    assert "without a change of any bit" in watched.check.texts()["cell.elbow"]
    assert watched.feed(cell=50.01, set_point=1.2) == [True, True, True]


def test_an_element_of_another_name_is_judged_by_half_of_all_commanded_ones(watched):
    for count in range(60):
        usable = watched.feed(far=0.2, set_point=0.1 + 0.02 * count)
    assert usable == [True, True, False]


@pytest.mark.parametrize("set_point", [None, 0.1])
def test_at_rest_nothing_is_frozen(watched, set_point):
    for _ in range(300):
        assert all(watched.feed(joint=0.1, cell=50.0, far=0.2, set_point=set_point))


def test_a_cell_without_load_may_stand_still(watched):
    watched.feed(cell=0.0)
    for count in range(60):
        usable = watched.feed(cell=0.0, set_point=0.1 + 0.02 * count)
    assert usable[1]


def test_a_velocity_command_moves_the_position_too_and_an_effort_says_nothing():
    for quantity, is_frozen in (("velocity", True), ("effort", False)):
        watched = Watched(quantity)
        for _ in range(200):
            usable = watched.feed(joint=0.1, set_point=0.5)
        assert usable[0] is not is_frozen


def test_reset_forgets_what_was_frozen_but_not_a_jump(watched):
    for count in range(60):
        watched.feed(cell=50.0, joint=0.1 if count < 50 else 0.9, set_point=0.1 + 0.02 * count)
    assert watched.feed(cell=50.0) == [False, False, True]
    watched.check.reset()
    assert watched.feed(cell=50.0) == [False, True, True]


def test_a_device_that_was_opened_or_homed_begins_anew():
    bench = SafetyBench("position")
    bench.cycle(3)
    bench.joints[0].position = 1.5
    bench.cycle(3)
    assert bench.sample.valid["joint_position"].tolist() == [False, True]
    bench.joints[0].origin += 1
    bench.cycle()
    assert bench.sample.valid["joint_position"].all()
    assert not bench.robot.health()["implausible"]
    bench.joints[0].position = 0.5
    bench.cycle()
    assert not bench.sample.valid["joint_position"][0]


def test_the_robot_file_has_the_last_word():
    free = {"low": -np.inf, "high": np.inf, "rate": np.inf, "frozen_after": np.inf}
    watched = Watched(joint_position=free, cell={"low": 5.0, "frozen_after": 1.0})
    watched.feed()
    assert watched.feed(joint=50.0, cell=4.0) == [True, False, True]
    for count in range(90):
        usable = watched.feed(joint=50.0, cell=50.0, set_point=0.1 + 0.02 * count)
    assert usable == [True, True, True]


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"low": [1, 2]}, "signals.joint_position.plausible.low has 2 values, the signal has 1"),
        ({"low": 2, "high": 1}, "low must be below high"),
        ({"high": float("nan")}, "must be a number"),
        ({"rate": 0}, "greater than 0"),
        ({"highest": 1}, "Extra inputs"),
    ],
)
def test_what_cannot_be_meant_is_refused(values, text):
    with pytest.raises(ValueError, match=text):
        Watched(joint_position=values)


def test_only_what_devices_measure_can_be_plausible():
    body = {**ONE, "signals": {**ONE["signals"], "tip": {"unit": "m", "elements": ["x"], "source": "vision"}}}
    body["signals"]["tip"]["plausible"] = {"low": 0}
    with pytest.raises(ValueError, match="no device measures this signal"):
        RobotConfig.model_validate(body)


@pytest.mark.parametrize("robot", ["musashi_arm", "pr2_duster", "kxr_humanoid"])
def test_it_is_on_in_the_robots_that_come_along(robot):
    config = load_robot(ROBOTS / f"{robot}.yaml")
    _, devices = build(config, ManualClock(), {})
    bounds = possible(config, config.measured, devices)
    assert np.isfinite(bounds.low).all() and np.isfinite(bounds.high).all(), bounds
    is_position = np.array(["position" in name or "length" in name for name in bounds.names])
    assert np.isfinite(bounds.rate[is_position]).all()
    assert (bounds.frozen_after < 1.0).all()
    for index, name in enumerate(bounds.names):
        signal, _, element = name.partition(".")
        low, high = config.bounds(signal)
        place = config.signals[signal].elements.index(element)
        assert np.isinf(low[place]) or bounds.low[index] < low[place]
        assert np.isinf(high[place]) or bounds.high[index] > high[place]


@pytest.mark.parametrize(
    ("quantity", "limits", "low"),
    [
        ("force", {"soft_high": 200, "trip_high": 400}, -8.0),  # a wire pulls: 2 % of the load that stops
        ("force", {"soft_high": 200}, -8.0),
        ("force", {"trip_high": 400, "soft_high": 200, "trip_low": 0.5}, -8.0),  # this trip can act as it is
        ("force", {"trip_high": 400, "soft_high": 200, "trip_low": -100}, -500.0),
        ("effort", {"trip_high": 400, "soft_high": 200}, -800.0),  # a torque has two directions
    ],
)
def test_the_bounds_of_a_load(monkeypatch, quantity, limits, low):
    monkeypatch.setattr(Quantities, "served", {"position": "joint_position.elbow", quantity: "cell.elbow"})
    config = RobotConfig.model_validate({**ONE, "limits": {**ONE["limits"], "cell": limits}})
    bounds = possible(config, ("cell",), [Quantities(), Other()])
    assert (bounds.low[0], bounds.high[0]) == (low, 800.0)
    assert bounds.rate[0] == 0.25 * 400 / PERIOD / 2  # a quarter of it in two cycles
    assert bounds.return_after[0] == 0.0


def test_what_is_not_plausible_still_trips_the_robot():
    limits = {**LIMITS["position"], "joint_temperature": {"trip_high": 80}}
    bench = SafetyBench("position", limits=limits, signals={
        **description()["signals"],
        "joint_temperature": {"unit": "degC", "elements": list(JOINTS), "plausible": {"high": 60}},
    }).enable()  # fmt: skip
    bench.joints[0].temperature = 70.0
    bench.cycle(2)
    assert bench.robot.mode == "hold"
    assert not bench.sample.valid["joint_temperature"][0]
    assert np.isnan(bench.sample.values["joint_temperature"][0])
    assert (
        "'joint_temperature.shoulder' read 70, possible is"
        in bench.robot.health()["implausible"]["joint_temperature.shoulder"]
    )
    bench.joints[0].temperature = 90.0
    bench.cycle(2)
    assert "over its trip limit" in bench.robot.fault_text


def test_a_soft_limit_says_that_it_cannot_act_without_a_plausible_load():
    limits = {**LIMITS["position"], "joint_effort": {"soft_high": 5.0, "trip_high": 8.0}}
    bench = SafetyBench("position", limits=limits).enable()
    for joint in bench.joints:
        joint.move = lambda duration, joint=joint: setattr(joint, "effort", -20.0)
    bench.joints[1].move = lambda duration: None
    bench.robot._limiter._trips._bounds.clear()  # a load so far beyond its trip would stop the robot at once
    bench.cycle(2)
    assert "effort limit cannot act without a valid effort of shoulder" in bench.robot.health()["limits"]


def test_a_computed_signal_does_not_use_what_is_not_plausible():
    body = description(signals={
        **description()["signals"],
        "double": {"unit": "rad", "elements": ["x"], "computed": {
            "by": "hal.computed:center_of_pressure", "from": "joint_temperature",
            "settings": {"points": [[1.0], [2.0]]}}},
        "joint_temperature": {"unit": "degC", "elements": list(JOINTS), "plausible": {"high": 60}},
    })  # fmt: skip
    bench = SafetyBench("position")
    assembler = Assembler(RobotConfig.model_validate(body), bench.joints)
    assert assembler.assemble(bench.clock.monotonic())[2]["double"].all()
    bench.joints[0].temperature = 70.0
    bench.clock.advance(0.01)
    assert not assembler.assemble(bench.clock.monotonic())[2]["double"].any()
    assert assembler.heard["joint_temperature"][0] == 70.0


def test_a_wrong_number_of_following_errors_is_refused():
    with pytest.raises((ConfigError, ValueError), match="following_error has 3 values"):
        SafetyBench("position", command={"signal": "joint_position", "following_error": [1, 2, 3]})
