"""The paper's experiments on the humanoid with tools (section III-C), in simulation and on the actual variant."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hal.config import load_robot
from services.model.artifacts import robot_file
from services.model.model_config import collect_config
from services.show import Progress
from studies.paper.kxr.actual import FOLLOWING, MODELS, Actual, actual
from studies.paper.kxr.figures import draw
from studies.paper.kxr.robot import CENTER
from studies.paper.kxr.simulated import (
    AFTER,
    CASES,
    KNOWING,
    LEADS,
    RUNS,
    SAMPLES,
    SEQUENCE,
    SETTLED,
    STEPS,
    TOOLS,
    Simulated,
    mask_errors,
    simulate,
)
from studies.paper.kxr.trials import Trial, order, steps_until
from studies.paper.report import Report, adder
from studies.paper.runs import Run, between, each_seed

ROBOT = "kxr_humanoid"
PAPER_MASKS = ("1110", "1101", "1011", "0111", "1010", "1100", "1001", "1000")
"""Feasible masks of the paper in the order joints, center of gravity, tip, pixel."""
SIGNAL_BAR, ORDER_BAR, TIP_BAR, CENTER_BAR = 0.15, 0.98, 12.0, 15.0
RECOGNITION = {
    "A: joints, center of gravity": "not in 35",
    "B: and pixel": "35",
    "C: and tip": "15",
}
SAMPLES_BAR, SHARE_BAR = 3.0, 89.0
LIMIT = "limit (perfect model)"


@dataclass(frozen=True, slots=True)
class Outcome:
    """One seed of both experiments."""

    simulated: Simulated
    actual: Actual


def _of_seed(run: Run, progress: Progress) -> Outcome:
    simulated = simulate(run, between(progress, 0.0, 0.9))
    return Outcome(simulated, actual(run, simulated.schema, between(progress, 0.9, 1.0)))


def reproduce(seeds: Sequence[int], folder: Path, progress: Progress, fresh: bool) -> Report:
    """Run both experiments; see `studies.paper.Experiment`."""
    robot = load_robot(robot_file(ROBOT))
    outcomes = each_seed(robot, seeds, folder, progress, fresh, _of_seed)
    report = Report(ROBOT, tuple(seeds))
    _add_structure(report, outcomes)
    _add_recognition(report, outcomes)
    bounds = collect_config(robot).constraints[CENTER].bounds(2, CENTER)
    _add_control(report, outcomes, bounds)
    _add_actual(report, outcomes)
    draw(folder, [outcome.simulated for outcome in outcomes], [outcome.actual for outcome in outcomes])
    return report


def _add_structure(report: Report, outcomes: Sequence[Outcome]) -> None:
    row = adder(report, [outcome.simulated for outcome in outcomes])
    for signal in outcomes[0].simulated.schema.layout.names:
        error = lambda o, signal=signal: o.schema.manifest["L_i"][signal]
        row(f"L of {signal}", error, paper="below 0.15", bar=SIGNAL_BAR)
    paper = set(PAPER_MASKS)
    row("the paper's 8 masks that are feasible", lambda o: len(_feasible(o) & paper), "", "8", 7.5, "higher")
    row("other masks that are feasible", lambda o: len(_feasible(o) - paper), paper="0")
    row("of these 0110 (center of gravity, tip)", lambda o: len(_feasible(o) & {"0110"}), paper="0")
    for mask in ("0111", "0110", "0011", "0101"):
        side = "below 0.15" if mask == "0111" else "above 0.15"
        row(f"L of mask {mask}", lambda o, mask=mask: mask_errors(o.schema).get(mask, np.nan), paper=side)
    row("R^2 of p on weight and length", lambda o: order(o.schema.biases, TOOLS), bar=ORDER_BAR, better="higher")


def _feasible(outcome: Simulated) -> set[str]:
    schema = outcome.schema
    return {"".join("01"[name in mask] for name in schema.layout.names) for mask in schema.masks}


def _add_recognition(report: Report, outcomes: Sequence[Outcome]) -> None:
    row = adder(report, [outcome.simulated.needed for outcome in outcomes])
    hard, *easy = RECOGNITION
    for case in easy:
        row(f"recognised, {case}, samples", lambda o, c=case: _needed(o[c, "ekf"]), "", RECOGNITION[case], SAMPLES_BAR)
    row(f"recognised in {SAMPLES}, {hard}", lambda o: _recognised(o[hard, "ekf"]), "%", "0", SHARE_BAR, "higher")
    row(f"recognised, {hard}, samples", lambda o: _needed(o[hard, "ekf"]))
    for case, paper in RECOGNITION.items():
        row(f"p by gauss_newton, {case}, samples", lambda o, c=case: _needed(o[c, "gauss_newton"]))
        row(f"p by gradient, {case}, samples", lambda o, c=case: _needed(o[c, "gradient"]), paper=paper)
        row(f"p by gradient, {case}, recognised", lambda o, c=case: _recognised(o[c, "gradient"]), "%")
    report.note(
        f"Recognised: p is nearest to the p of {AFTER} of all tools and within 20 % of the way from the first p, and "
        f"stays so up to sample {SAMPLES}; a run in which it is not counts as {SAMPLES + 1}. {RUNS} runs per seed."
    )


def _needed(samples: np.ndarray) -> float:
    """Return the mean over the runs of the samples until recognition, shape (runs,)."""
    return float(np.minimum(samples, SAMPLES + 1).mean())


def _recognised(samples: np.ndarray) -> float:
    """Return the share [%] of the runs, shape (runs,), in which the tool was recognised."""
    return 100.0 * float(np.isfinite(samples).mean())


def _add_control(report: Report, outcomes: Sequence[Outcome], bounds: tuple[np.ndarray, np.ndarray]) -> None:
    row = adder(report, [{**outcome.simulated.controlled, LIMIT: outcome.simulated.limit} for outcome in outcomes])
    for index, tool in enumerate(SEQUENCE):
        begin, after = index * STEPS, slice(index * STEPS + SETTLED, (index + 1) * STEPS)
        whole = slice(begin, (index + 1) * STEPS)
        row(f"{tool}: tip, first step, {KNOWING}", lambda o, at=begin: 1e3 * o[KNOWING].tips[at], "mm")
        steps = lambda o, at=whole: min(steps_until(1e3 * o[KNOWING].tips[at], TIP_BAR), STEPS)
        row(f"{tool}: steps until the tip's average of 5 stays below {TIP_BAR:g} mm", steps, bar=SETTLED + 0.5)
        for update in outcomes[0].simulated.controlled:
            tip, center = (TIP_BAR, CENTER_BAR) if update == KNOWING else (None, None)
            off_tip = lambda o, update=update, at=after: 1e3 * o[update].tips[at].mean()
            row(f"{tool}: tip after {SETTLED} steps, {update}", off_tip, "mm", bar=tip)
            off_center = lambda o, update=update, at=after: 1e3 * o[update].off_center[at].mean()
            row(f"{tool}: center of gravity after {SETTLED} steps, {update}", off_center, "mm", bar=center)
        limit = lambda o, at=after: 1e3 * o[LIMIT].off_center[at].mean()
        row(f"{tool}: center of gravity, {LIMIT}", limit, "mm")
    share = "center of gravity inside collect.constraints, steps with a known tool"
    row(share, lambda o: 100.0 * _inside(o[KNOWING], bounds), "%", bar=99.0, better="higher")


def _inside(trial: Trial, bounds: tuple[np.ndarray, np.ndarray]) -> float:
    """Return the share of steps with a known tool in which the center of gravity is within bounds [m]."""
    known = np.arange(len(trial.tips)) % STEPS > 0
    inside = np.all((trial.centers >= bounds[0]) & (trial.centers <= bounds[1]), axis=1)
    return float(inside[known].mean())


def _add_actual(report: Report, outcomes: Sequence[Outcome]) -> None:
    row = adder(report, [outcome.actual for outcome in outcomes])
    row("actual: samples for fine-tuning", lambda o: o.samples, paper="480")
    row("actual: R^2 of p on weight and length", lambda o: order(o.schema.biases, TOOLS))
    for tool in LEADS:
        row(f"actual: {tool} recognised, samples", lambda o, tool=tool: min(o.needed[tool], SAMPLES + 1))
    for case in CASES:
        row(f"actual: recognised in {SAMPLES}, {case}", lambda o, c=case: _recognised(o.recognised[c]), "%")
        row(f"actual: recognised, {case}, samples", lambda o, c=case: _needed(o.recognised[c]))
    papers = dict(zip(MODELS, ("largest", "smaller", "smallest"), strict=True))
    for model in (*MODELS, FOLLOWING):
        error = lambda o, model=model: 1e3 * o.controlled[model].tips.mean()
        row(f"actual: tip at {AFTER}, {model}", error, "mm", papers.get(model, ""))
