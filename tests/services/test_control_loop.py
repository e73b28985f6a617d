import numpy as np
import pytest
from arm_model import arm, fresh, small_model

from gemuco.estimation import estimate
from gemuco.intervals.sureness import SURE, UNKNOWN, Sureness
from hal.clock import ManualClock
from services.errors import NotEngaged, TargetRefused
from services.model.control_loop import BUMP, Control
from services.model.estimation import Estimation, Freshness
from services.model.gemuco_service import ModelSolver
from services.model.living_model import LivingModel
from services.model.model_config import model_config
from services.wire.messages import Applied, Command, Sample, Target
from services.wire.streams import Arrival

PERIOD = 0.02


class Bench:
    """The controller between a HAL that is only a mode and a newest sample, and a list of commands."""

    def __init__(self, unknown: str = "slow", edge: float = np.inf) -> None:
        robot = arm()
        config = model_config(robot).control
        assert config is not None
        config = config.model_copy(update={"unknown": unknown})
        self.clock = ManualClock()
        self.newest: Arrival[Sample] | None = fresh(3, self.clock.monotonic(), cycle=10)
        self.mode = "off"
        self.enabled = 0
        self.sent: list[Command] = []
        freshness = Freshness(robot, lambda: self.newest, self.clock)
        self.estimation = Estimation(freshness, small_model, lambda _: None, self.clock)
        solver = ModelSolver(LivingModel(small_model()), robot, config)
        self.control = Control(
            robot, config, lambda: self.newest, self.applied, self.estimation, solver, self.sent.append, self.clock,
            lambda values: SURE if values[3] <= edge else Sureness(UNKNOWN, "too far"),
        )  # fmt: skip
        self.estimation.tick()

    def applied(self) -> Applied:
        nothing = np.full(10, np.nan)
        return Applied(
            cycle=1, mode=self.mode, signal="muscle_length", desired=nothing, values=nothing, limited_by=[], sender=0
        )

    def enable(self) -> None:
        self.enabled += 1
        self.mode = "hold"

    def turn(self, count: int = 1) -> None:
        for _ in range(count):
            self.clock.advance(PERIOD)
            cycle = self.newest.message.cycle + 4 if self.newest else 1
            self.newest = fresh(3, self.clock.monotonic(), cycle=cycle)
            self.estimation.tick()
            self.control.tick()


def test_nothing_is_sent_without_being_engaged() -> None:
    bench = Bench()
    bench.mode = "hold"
    bench.control.set_target(Target(signal="joint_position", values=np.array([0, 0, 0, -0.6, 0.0])))
    bench.turn(5)
    assert bench.sent == []
    assert bench.enabled == 0


def test_engaging_enables_and_starts_where_the_servos_are() -> None:
    bench = Bench()
    bench.control.engage(bench.enable)
    bench.turn()
    assert bench.enabled == 1
    first = bench.sent[0]
    assert bench.newest is not None
    np.testing.assert_allclose(first.values, bench.newest.message.values["muscle_length"], atol=1e-9)
    assert first.cycle == bench.newest.message.cycle
    assert first.hal_boot == bench.newest.message.boot


def test_the_reference_reaches_the_target_at_the_robot_files_speed() -> None:
    bench = Bench()
    bench.control.engage(bench.enable)
    bench.turn()
    start = np.array(bench.control.facts()["reference"])
    target = np.clip(start + 0.5, *arm().bounds("joint_position"))
    bench.control.set_target(Target(signal="joint_position", values=target))
    bench.turn(5)
    moved = np.abs(np.array(bench.control.facts()["reference"]) - start).max()
    assert moved == pytest.approx(5 * PERIOD * 1.0, rel=1e-6)  # 1 rad/s
    bench.turn(40)
    np.testing.assert_array_equal(bench.control.facts()["reference"], target)


@pytest.mark.long
def test_the_settled_command_is_what_the_model_says_of_the_posture() -> None:
    bench = Bench()
    bench.control.engage(bench.enable)
    bench.turn(round(10 * BUMP / PERIOD))
    assert bench.newest is not None
    posture = bench.newest.message.values["joint_position"]
    schema = small_model()
    settled = bench.sent[-1].values
    found = estimate(schema, {"muscle_length": settled, "muscle_tension": np.full(10, 50.0)})["joint_position"].value
    assert np.isfinite(found).all()
    assert np.ptp([command.values for command in bench.sent[-5:]], axis=0).max() < 1e-4  # m
    assert np.abs(settled - bench.newest.message.values["muscle_length"]).max() < 0.05  # m
    assert posture.shape == found.shape


@pytest.mark.parametrize("why", ["old sample", "enabling", "no sample"])
def test_nothing_is_sent_while_that_would_not_be_safe(why: str) -> None:
    bench = Bench()
    bench.control.engage(bench.enable)
    if why == "enabling":
        bench.mode = "enabling"
    elif why == "no sample":
        bench.newest = None
    else:
        bench.clock.advance(0.11)
    bench.control.tick()
    assert bench.sent == []
    assert bench.control.engaged
    assert bench.control.counters["waited"] == 1


@pytest.mark.parametrize("mode", ["off", "stopping", "fault"])
def test_the_controller_lets_go_when_the_hal_does(mode: str) -> None:
    bench = Bench()
    bench.control.engage(bench.enable)
    bench.turn()
    bench.mode = mode
    bench.turn(3)
    assert not bench.control.engaged
    assert f"The HAL went to '{mode}'" in bench.control.text
    bench.mode = "hold"
    count = len(bench.sent)
    bench.turn(3)
    assert len(bench.sent) == count


def test_engaging_needs_a_fresh_sample() -> None:
    bench = Bench()
    bench.clock.advance(0.2)
    with pytest.raises(NotEngaged, match="No fresh sample comes from the HAL"):
        bench.control.engage(bench.enable)
    assert bench.enabled == 0


@pytest.mark.parametrize(
    ("signal", "values", "sentence"),
    [
        ("elbow", [0.0] * 5, "'elbow' is not a signal. Known: joint_position"),
        ("muscle_length", [0.1] * 10, "'muscle_length' is not controlled"),
        ("joint_position", [0.0] * 4, r"has 5 values \(shoulder_roll, .*\), not 4"),
        ("joint_position", [0, 0, 0, float("nan"), 0], "holds a value that is not a number"),
        ("joint_position", [0, 0, 0, -3.0, 0], "elbow_pitch of -3.000 rad is outside of its limits, -1.800 to -0.200"),
    ],
)
def test_a_target_that_cannot_be_is_refused_in_a_sentence(signal: str, values: list[float], sentence: str) -> None:
    bench = Bench()
    bench.control.engage(bench.enable)
    bench.turn()
    before = bench.control.facts()["target"]
    target = Target(signal=signal, values=np.array(values, float))
    with pytest.raises(TargetRefused, match=sentence):
        bench.control.set_target(target)
    with pytest.raises(TargetRefused, match=sentence):
        bench.control.try_target(target)
    assert bench.control.facts()["target"] == before
    assert bench.control.counters["refused_targets"] == 1


def test_a_solve_that_runs_out_of_time_sends_the_best_so_far_and_is_counted() -> None:
    robot = arm()
    config = model_config(robot).control
    assert config is not None
    solver = ModelSolver(LivingModel(small_model()), robot, config)
    target = {config.target: np.full(robot.signals[config.target].size, 0.1)}
    in_time = solver(target, {})
    assert solver.late == 0
    solver._within = -1.0
    solver._controller.restart()
    late = solver({config.target: target[config.target] + 0.01}, {})
    assert solver.late == 1
    assert late.shape == in_time.shape
    assert np.isfinite(late).all()


def test_another_model_is_used_at_once_and_a_reference_that_moves_keeps_the_layout() -> None:
    robot, living = arm(), LivingModel(small_model())
    config = model_config(robot).control
    assert config is not None
    solver = ModelSolver(living, robot, config)
    target = {config.target: np.full(robot.signals[config.target].size, 0.1)}
    solver(target, {})
    laid = list(solver._controller._search._setups.values())
    moved = {config.target: target[config.target] + 0.01}
    solver(moved, {})
    assert list(solver._controller._search._setups.values()) == laid
    arrays = [array * np.float32(1.02) for array in living.schema.weights.arrays()]
    living.swap(living.schema.with_weights(living.schema.weights.replaced(arrays)))
    before = solver._command
    after = solver(moved, {})
    assert solver._controller.schema is living.schema
    assert np.abs(after - before).max() > 0.0


@pytest.mark.parametrize("unknown", ["slow", "hold", "ignore"])
@pytest.mark.long
def test_where_the_body_is_unknown_the_reference_is_slow_or_holds_and_says_so(unknown: str) -> None:
    bench = Bench(unknown=unknown, edge=-0.8)
    bench.control.engage(bench.enable)
    bench.turn()
    start = np.array(bench.control.facts()["reference"])
    inside, outside = start.copy(), start.copy()
    inside[3], outside[3] = -0.9, -0.3
    bench.control.set_target(Target(signal="joint_position", values=inside))
    assert bench.control.facts()["text"] == ""
    bench.turn(100)
    np.testing.assert_array_equal(bench.control.facts()["reference"], inside)
    bench.control.set_target(Target(signal="joint_position", values=outside))
    assert ("The body is unknown at this target (too far)" in bench.control.facts()["text"]) == (unknown != "ignore")
    bench.turn(20)  # 0.4 s
    reference = bench.control.facts()["reference"][3]
    if unknown == "ignore":
        assert reference == pytest.approx(-0.5)
    elif unknown == "hold":
        assert -0.85 < reference <= -0.8
        assert bench.control.facts()["text"] == "The reference holds, because the body is unknown ahead: too far."
    else:
        assert -0.8 < reference < -0.7
        assert "The reference is slow" in bench.control.facts()["text"]
    bench.control.set_target(Target(signal="joint_position", values=inside))
    bench.turn(100)
    np.testing.assert_array_equal(bench.control.facts()["reference"], inside)
