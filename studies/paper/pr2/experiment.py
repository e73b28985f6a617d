"""The paper's experiments on the PR2 with a duster (section III-A), in simulation and on the actual variant."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hal.config import load_robot
from services.model.artifacts import robot_file
from services.show import Progress
from studies.paper.body import JOINTS
from studies.paper.pr2.actual import MODELS, Actual, actual
from studies.paper.pr2.arm import TIP
from studies.paper.pr2.figures import draw
from studies.paper.pr2.simulated import CASES, POINTS, RECOGNISERS, UPDATES, Simulated, simulate
from studies.paper.report import Report, adder
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


def _of_seed(run: Run, progress: Progress) -> Outcome:
    simulated = simulate(run, between(progress, 0.0, 0.7))
    return Outcome(simulated, actual(run, simulated.schema, between(progress, 0.7, 1.0)))


def reproduce(seeds: Sequence[int], folder: Path, progress: Progress, fresh: bool) -> Report:
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
    row = adder(report, [outcome.simulated for outcome in outcomes])
    row("L of joint_position (an output if below 0.15)", lambda o: o.fact("L_i")[JOINTS], paper="above 0.15")
    row("L of tool_tip_position", lambda o: o.fact("L_i")[TIP], paper="below 0.15")
    row("seeds whose only output is tool_tip_position, only mask joint_position", _has_one_mask, "%", "100")
    row("tool tip by the model, fresh samples, p of the grasp", lambda o: 1e3 * o.held_out, "mm")
    row("R^2 of l on p", lambda o: o.order.length, bar=ORDER_BAR, better="higher")
    row("R^2 of phi on p", lambda o: o.order.angle, bar=ORDER_BAR, better="higher")
    for length in outcomes[0].simulated.order.spread:
        name = f"distance of p between 0 and 60 deg, l = {length} mm"
        row(name, lambda o, length=length: o.order.spread[length], paper="grows with l")


def _has_one_mask(outcome: Simulated) -> float:
    return 100.0 * (outcome.schema.x_out == (TIP,) and outcome.schema.masks == (frozenset({JOINTS}),))


def _add_simulated(report: Report, outcomes: Sequence[Outcome]) -> None:
    row = adder(report, [outcome.simulated for outcome in outcomes])
    for case in CASES:
        paper = PAPER_ESTIMATE.get(case, "")
        for name in RECOGNISERS:
            bar = ESTIMATE_BAR if name == "ekf" and paper else None
            figure = lambda o, key=(case, name): o.estimated[key].mean(POINTS)
            row(f"estimate {case} after {POINTS} points, p by {name}", figure, "mm", paper, bar)
    row("control, first point", lambda o: 1e3 * o.controlled["p"].trial.errors[0], "mm", "240")
    for update in UPDATES:
        during, afterwards = PAPER_CONTROL.get(update, ("", ""))
        same, others = (SAME_POSTURE_BAR, OTHERS_BAR) if update in CONTROL_BARS else (None, None)
        control = lambda o, update=update: o.controlled[update].trial.mean(POINTS)
        row(f"control after {POINTS} points, update {update}", control, "mm", during, CONTROL_BARS.get(update))
        elsewhere = lambda o, update=update: o.controlled[update].elsewhere.mean()
        row(f"at the other posture, update {update}", elsewhere, "mm", afterwards, same)
        row(
            f"model under the other grasps, update {update}",
            lambda o, update=update: 1e3 * o.controlled[update].others,
            "mm",
            "",
            others,
        )


def _add_actual(report: Report, outcomes: Sequence[Outcome]) -> None:
    row = adder(report, [outcome.actual for outcome in outcomes])
    row("actual: samples for fine-tuning", lambda o: o.samples, paper="1500")
    for model in MODELS:
        error = lambda o, model=model: 1e3 * np.mean(list(o.errors[model].values()))
        row(f"actual: tool tip by {model}, best p of every grasp", error, "mm")
    for model in MODELS:
        error = lambda o, model=model: 1e3 * o.controlled[model][POINTS : o.change].mean()
        row(f"actual: control by {model}, after {POINTS} points", error, "mm")
    row("actual: control, first point", lambda o: 1e3 * o.trial.errors[0], "mm", "1000")
    row(f"actual: after {POINTS} points", lambda o: o.trial.mean(POINTS, o.change), "mm", "150")
    row("actual: right after the tool was changed", lambda o: 1e3 * o.trial.errors[o.change], "mm", "500")
    row(f"actual: {POINTS} points later", lambda o: o.trial.mean(o.change + POINTS), "mm", "200")
