"""The simulation experiments on the humanoid (paper, III-C): the nominal robot and its six tools."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from gemuco.adaption.config import UpdateConfig
from gemuco.masks import all_masks, label
from gemuco.schema import BodySchema
from services.learning.collector import collect_direct
from services.learning.trainer import train
from services.model.control_config import ControlConfig
from services.model.model_config import model_config
from services.show import Progress
from studies.paper.body import JOINTS
from studies.paper.kxr.robot import (
    CENTER,
    PIXEL,
    TIP,
    Standing,
    designed,
    inverse,
    random_targets,
    safe_postures,
)
from studies.paper.kxr.trials import Trial, follow, follow_blindly, recognise, samples_until
from studies.paper.runs import Run, between

NOMINAL = "nominal"
TOOLS = {
    f"{size}_{weight}": (length, mass)
    for (size, length), (weight, mass) in product(
        (("short", 176.0), ("long", 236.0)), (("light", 40.0), ("middle", 80.0), ("heavy", 120.0))
    )
}
"""Length [mm] and weight [g] of every tool; p is to be ordered by them, and the model does not see them."""
CASES = {
    "A: joints, center of gravity": (JOINTS, CENTER),
    "B: and pixel": (JOINTS, CENTER, PIXEL),
    "C: and tip": (JOINTS, CENTER, TIP, PIXEL),
}
BEFORE, AFTER = "short_middle", "long_middle"
UPDATES = {
    "ekf": UpdateConfig(what="bias"),
    "gauss_newton": UpdateConfig(what="bias", bias_method="gauss_newton"),
    "gradient": UpdateConfig(what="bias", bias_method="gradient", minimum=1, window=10),
}
"""Updates of p; the first is the default, the last the paper's."""
KNOWING, GRADIENT, BLIND, LIGHT = "p by ekf", "p by gradient", "p not updated", "p by ekf, weight 0.01"
"""Updates during control; the last has the paper's weight of the center of gravity."""
LEADS = ("long_light", "short_heavy")
"""Tools whose recognition the paper draws."""
RUNS, SAMPLES = 10, 35
SEQUENCE = ("long_light", "long_heavy", "short_heavy")
STEPS = 30
"""Number of control steps with each tool."""
SETTLED = 10
"""Number of steps after a change of the tool until the error is to be small."""
PAPER_WEIGHT = 0.01
FRESH = 1000
"""Offset of the seed in trials."""


@dataclass(frozen=True, slots=True)
class Simulated:
    """One seed of the simulation experiments.

    Attributes:
        schema: As trained.
        needed: (case, update) -> samples until the tool is recognised, shape (runs,).
        paths: (case, update) -> p along the first run, shape (samples + 1, bias_size).
        leads: Label -> path of p to a tool with all sensors.
        controlled: Update -> trial of control.
        limit: Trial of a perfect model of the robot.
    """

    schema: BodySchema
    needed: Mapping[tuple[str, str], np.ndarray]
    paths: Mapping[tuple[str, str], np.ndarray]
    leads: Mapping[str, np.ndarray]
    controlled: Mapping[str, Trial]
    limit: Trial


def simulate(run: Run, progress: Progress) -> Simulated:
    """Collect, train, and run every trial of one seed."""
    robot, seed = run.robot, run.seed
    progress(0.0, "collecting")
    data = run.cached("nominal", lambda: collect_direct(robot, NOMINAL, seed).dataset)
    schema = run.cached("nominal_model", lambda: train(robot, data, seed, between(progress, 0.2, 0.7)).schema)
    progress(0.7, "recognising tools")
    needed, paths = recognitions(run, schema, NOMINAL, UPDATES)
    progress(0.85, "reaching targets while tools change")
    controlled, limit = _controls(run, schema)
    return Simulated(schema, needed, paths, leads(run, schema, NOMINAL), controlled, limit)


def samples_of(run: Run, variant: str, condition: str, chance: int) -> list[Mapping[str, np.ndarray]]:
    """Measure random postures with a tool."""
    body = Standing(run.robot, variant, run.seed, condition)
    random = np.random.default_rng([FRESH + run.seed, chance])
    return [dict(body.go(posture)) for posture in safe_postures(run.robot, condition, SAMPLES, random)]


def leads(run: Run, schema: BodySchema, variant: str) -> dict[str, np.ndarray]:
    """Return label -> path of p to two tools with all sensors."""
    start = schema.under(BEFORE)
    return {
        f"to {tool}, {name}": recognise(start, samples_of(run, variant, tool, 50), (JOINTS, CENTER, TIP, PIXEL), update)
        for tool in LEADS
        for name, update in UPDATES.items()
        if name != "gauss_newton"
    }


def recognitions(
    run: Run, schema: BodySchema, variant: str, updates: Iterable[str]
) -> tuple[dict[tuple[str, str], np.ndarray], dict[tuple[str, str], np.ndarray]]:
    """Return the samples until long_middle is recognised in every case, and p along the first run of each."""
    needed: dict[tuple[str, str], list[float]] = {key: [] for key in product(CASES, updates)}
    paths: dict[tuple[str, str], np.ndarray] = {}
    for chance in range(RUNS):
        samples = samples_of(run, variant, AFTER, chance)
        for case, update in needed:
            path = recognise(schema.under(BEFORE), samples, CASES[case], UPDATES[update])
            needed[case, update].append(samples_until(path, schema, AFTER))
            paths.setdefault((case, update), path)
    return {key: np.array(values) for key, values in needed.items()}, paths


def _controls(run: Run, schema: BodySchema) -> tuple[dict[str, Trial], Trial]:
    robot = run.robot
    random = np.random.default_rng([FRESH + run.seed, 100])
    targets = np.concatenate([random_targets(robot, tool, STEPS, random) for tool in SEQUENCE])
    changes = {index * STEPS: tool for index, tool in enumerate(SEQUENCE)}
    control = control_of(run)
    trials = {
        KNOWING: (control, UPDATES["ekf"]),
        GRADIENT: (control, UPDATES["gradient"]),
        BLIND: (control, None),
        LIGHT: (with_weight(control, PAPER_WEIGHT), UPDATES["ekf"]),
    }
    controlled = {}
    for name, (config, update) in trials.items():
        body = Standing(robot, NOMINAL, run.seed, SEQUENCE[0])
        controlled[name] = follow(robot, body, schema.under(SEQUENCE[0]), config, targets, update, changes)
    parts = []
    for index, tool in changes.items():
        mine = targets[index : index + STEPS]
        commands = inverse(robot, designed(robot, tool), mine)
        parts.append(follow_blindly(Standing(robot, NOMINAL, run.seed, tool), mine, commands))
    limit = Trial(*(np.concatenate(part) for part in zip(*((p.tips, p.centers, p.biases) for p in parts), strict=True)))
    return controlled, limit


def mask_errors(schema: BodySchema) -> dict[str, float]:
    """Return L_m by mask, written as in the paper: 0 or 1 for joints, center of gravity, tip and pixel."""
    names = schema.layout.names
    by_label = {label(mask, names): "".join("01"[name in mask] for name in names) for mask in all_masks(names)}
    return {by_label[name]: value for name, value in schema.manifest["L_m"].items()}


def control_of(run: Run) -> ControlConfig:
    """Return the robot file's control section."""
    control = model_config(run.robot).control
    assert control is not None
    return control


def with_weight(control: ControlConfig, weight: float) -> ControlConfig:
    """Return the same with another weight of the center of gravity."""
    terms = tuple(
        term.model_copy(update={"weight": weight}) if term.match == CENTER else term for term in control.terms
    )
    return control.model_copy(update={"terms": terms})
