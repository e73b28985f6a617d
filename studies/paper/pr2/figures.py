"""Figures of the experiments on the PR2, after the paper's figure of them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from studies.paper import figures
from studies.paper.pr2.actual import MODELS, Actual
from studies.paper.pr2.simulated import CASES, RECOGNISERS, UPDATES, Simulated


def draw(folder: Path, simulated: Sequence[Simulated], actual: Sequence[Actual]) -> None:
    """Write every figure; maps of p are those of the first seed, curves are of all seeds."""
    _maps(folder / "bias_map.png", simulated[0], actual[0])
    _estimation(folder / "estimation.png", simulated)
    _control(folder / "control.png", simulated)
    _transitions(folder / "actual.png", actual)


def _maps(path: Path, simulated: Simulated, actual: Actual) -> None:
    with figures.picture(path, "p of every grasp, and its paths during updates", columns=2) as (left, right):
        shown = [(case, name) for case in ("(1)", "(2)") for name in ("ekf", "gradient")]
        paths = {f"{case} {name}": simulated.estimated[case, name].biases for case, name in shown}
        figures.bias_map(left, simulated.schema.biases, paths)
        left.set_title("simulation: normal duster")
        flexible = {name: p for name, p in actual.schema.biases.items() if name not in simulated.schema.biases}
        biases, change = actual.trial.biases, actual.change
        figures.bias_map(right, flexible, {"(1) start": biases[:change], "(2) tool changed": biases[change:]})
        right.set_title("actual: flexible duster")


def _estimation(path: Path, simulated: Sequence[Simulated]) -> None:
    with figures.picture(path, "Error of the estimated tool tip while p is updated", columns=2, rows=2) as axes:
        for axis, (case, (believed, held)) in zip(axes, CASES.items(), strict=True):
            curves = {
                name: np.stack([1e3 * seed.estimated[case, name].errors for seed in simulated]) for name in RECOGNISERS
            }
            figures.over_steps(axis, curves, "mm", "data points", bar=12.0)
            trained = "" if held in simulated[0].schema.biases else " (never trained)"
            axis.set_title(f"{case}: {believed} is believed, {held} is held{trained}")


def _control(path: Path, simulated: Sequence[Simulated]) -> None:
    with figures.picture(path, "Control error of the tool tip", columns=2) as (left, right):
        while_updated = {
            update: np.stack([1e3 * seed.controlled[update].trial.errors for seed in simulated]) for update in UPDATES
        }
        figures.over_steps(left, while_updated, "mm", "data points")
        left.set_title("while the model is updated")
        after = {
            update: np.stack([1e3 * seed.controlled[update].elsewhere.errors for seed in simulated])
            for update in UPDATES
        }
        figures.over_steps(right, after, "mm", "points of the motion")
        right.set_title("afterwards, at the other posture")


def _transitions(path: Path, actual: Sequence[Actual]) -> None:
    with figures.picture(path, "The actual arm with the flexible duster", columns=2) as (left, right):
        curves = {model: np.stack([1e3 * seed.controlled[model] for seed in actual]) for model in MODELS}
        figures.over_steps(left, curves, "mm", "data points")
        left.axvline(actual[0].change + 0.5, color="0.4", linestyle=":", label="the tool is changed")
        left.legend(fontsize=8)
        left.set_title("control, the models updated but for the geometry")
        groups = {
            grasp: {model: [1e3 * seed.errors[model][grasp] for seed in actual] for model in MODELS}
            for grasp in actual[0].errors["geometry"]
        }
        figures.bars(right, groups, "mm")
        right.set_title("tool tip on samples that were not learned from")
