"""The paper's experiments on the PR2 with a duster (section III-A), in simulation and on the actual variant."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hal.config import load_robot
from services.model.artifacts import robot_file
from services.show import Tell
from studies.paper.body import JOINTS
from studies.paper.pr2.actual import MODELS, Actual, actual
from studies.paper.pr2.arm import TIP
from studies.paper.pr2.figures import draw
from studies.paper.pr2.simulated import CASES, POINTS, RECOGNISERS, WAYS, Simulated, simulate
from studies.paper.report import Report, Row, adder
from studies.paper.runs import Run, between, each_seed

ROBOT = "pr2_duster"
PAPER_ESTIMATE = {"(1)": "52.2", "(2)": "25.9"}
PAPER_CONTROL = {"p": ("31.5", "22.6"), "p by gradient": ("31.5", "22.6"), "W": ("19.2", "207")}
"""Update -> the paper's error during it, and afterwards at the other posture [mm]; its p is by gradient."""
CONTROL_BARS = {"p, then W (default)": 6.0, "p": 15.0}
SAME_POSTURE_BAR, OTHERS_BAR, ESTIMATE_BAR, ORDER_BAR = 15.0, 25.0, 12.0, 0.95


@dataclass(frozen=True, slots=True)
class Outcome:
    """One seed of both experiments."""

    simulated: Simulated
    actual: Actual


def _of_seed(run: Run, tell: Tell) -> Outcome:
    simulated = simulate(run, between(tell, 0.0, 0.7))
    return Outcome(simulated, actual(run, simulated.schema, between(tell, 0.7, 1.0)))


def reproduce(seeds: Sequence[int], folder: Path, progress: Tell, fresh: bool) -> Report:
    """Run both experiments; see `studies.paper.Experiment`."""
    robot = load_robot(robot_file(ROBOT))
    outcomes = each_seed(robot, seeds, folder, progress, fresh, _of_seed)
    draw(folder, [outcome.simulated for outcome in outcomes], [outcome.actual for outcome in outcomes])
    return summary(seeds, outcomes)


def summary(seeds: Sequence[int], outcomes: Sequence[Outcome]) -> Report:
    """Return every figure beside the paper's."""
    report = Report(ROBOT, tuple(seeds))
    _add_structure(report, outcomes)
    _add_simulated(report, outcomes)
    _add_actual(report, outcomes)
    return report


def _add_structure(report: Report, outcomes: Sequence[Outcome]) -> None:
    row = adder(report, outcomes)
    row("L of joint_position (an output if below 0.15)", "", "above 0.15", lambda o: o.simulated.fact("L_i")[JOINTS])
    row("L of tool_tip_position", "", "below 0.15", lambda o: o.simulated.fact("L_i")[TIP])
    outputs = "seeds whose only output is tool_tip_position, only mask joint_position"
    right = [
        o.simulated.schema.x_out == (TIP,) and o.simulated.schema.masks == (frozenset({JOINTS}),) for o in outcomes
    ]
    report.add(Row(outputs, "%", "100", tuple(100.0 * is_right for is_right in right)))
    row("tool tip by the model, fresh samples, p of the grasp", "mm", "", lambda o: 1e3 * o.simulated.held_out)
    row("R^2 of l on p", "", "", lambda o: o.simulated.order.length, ORDER_BAR, "higher")
    row("R^2 of phi on p", "", "", lambda o: o.simulated.order.angle, ORDER_BAR, "higher")
    for length in outcomes[0].simulated.order.spread:
        row(
            f"distance of p between 0 and 60 deg, l = {length} mm",
            "",
            "grows with l",
            lambda o, length=length: o.simulated.order.spread[length],
        )


def _add_simulated(report: Report, outcomes: Sequence[Outcome]) -> None:
    row = adder(report, outcomes)
    for case in CASES:
        for name in RECOGNISERS:
            row(
                f"estimate {case} after {POINTS} points, p by {name}",
                "mm",
                PAPER_ESTIMATE.get(case, ""),
                lambda o, key=(case, name): o.simulated.estimated[key].mean(POINTS),
                ESTIMATE_BAR if name == "ekf" and case in PAPER_ESTIMATE else None,
            )
    row("control, first point", "mm", "240", lambda o: 1e3 * o.simulated.controlled["p"].course.errors[0])
    for way in WAYS:
        paper = PAPER_CONTROL.get(way, ("", ""))
        is_asked = way in CONTROL_BARS
        row(
            f"control after {POINTS} points, update {way}",
            "mm",
            paper[0],
            lambda o, way=way: o.simulated.controlled[way].course.mean(POINTS),
            CONTROL_BARS.get(way),
        )
        row(
            f"at the other posture, update {way}",
            "mm",
            paper[1],
            lambda o, way=way: o.simulated.controlled[way].elsewhere.mean(),
            SAME_POSTURE_BAR if is_asked else None,
        )
        row(
            f"model under the other grasps, update {way}",
            "mm",
            "",
            lambda o, way=way: 1e3 * o.simulated.controlled[way].others,
            OTHERS_BAR if is_asked else None,
        )


def _add_actual(report: Report, outcomes: Sequence[Outcome]) -> None:
    row = adder(report, outcomes)
    row("actual: samples for fine-tuning", "", "1500", lambda o: o.actual.samples)
    for model in MODELS:
        row(
            f"actual: tool tip by {model}, best p of every grasp",
            "mm",
            "",
            lambda o, model=model: 1e3 * float(np.mean(list(o.actual.errors[model].values()))),
        )
    for model in MODELS:
        row(
            f"actual: control by {model}, after {POINTS} points",
            "mm",
            "",
            lambda o, model=model: 1e3 * float(o.actual.controlled[model][POINTS : o.actual.change].mean()),
        )
    row("actual: control, first point", "mm", "1000", lambda o: 1e3 * o.actual.course.errors[0])
    row(f"actual: after {POINTS} points", "mm", "150", lambda o: o.actual.course.mean(POINTS, o.actual.change))
    row(
        "actual: right after the tool was changed", "mm", "500", lambda o: 1e3 * o.actual.course.errors[o.actual.change]
    )
    row(f"actual: {POINTS} points later", "mm", "200", lambda o: o.actual.course.mean(o.actual.change + POINTS))
