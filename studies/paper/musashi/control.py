"""Control of an actual arm (paper, III-B, figure c): five targets, each from five random postures."""

import numpy as np

from gemuco.schema import BodySchema
from hal.config import RobotConfig
from services.learning.playground import CollectionStopped
from services.model.control_config import ControlConfig, TermConfig, controller_of
from services.model.model_config import model_config
from studies.paper.musashi.motion import POSITION, TENSION, ActualArm, go

TARGETS, STARTS = 5, 5
INSIDE = 0.15
"""Postures keep this share of the range away from the limits, as in the demo."""
GRAVITY = "simulators.robots.musashi_arm:gravity_torque"
PAPER_TERMS = (
    TermConfig(match=POSITION),
    TermConfig(stay_small=TENSION, weight=1.0),
    TermConfig(torque_balance=GRAVITY, weight=0.01),
)
OURS, WEIGHTS = "robot file's weights", "paper's weights"


def controls(robot: RobotConfig) -> dict[str, ControlConfig]:
    """Return the robot file's control, and the same route with the paper's weights.

    Raises:
        ValueError: The robot file has no control section.
    """
    config = model_config(robot).control
    if config is None:
        raise ValueError(f"Robot '{robot.robot}' has no `model.control` in its file.")
    return {OURS: config, WEIGHTS: config.model_copy(update={"terms": PAPER_TERMS})}


def errors(robot: RobotConfig, schema: BodySchema, arm: int, config: ControlConfig, starts: int = STARTS) -> np.ndarray:
    """Return ||theta_ref - theta|| at rest [rad], shape (targets, starts); NaN where the limits stopped the arm.

    Each arm has its own targets and starts, the same for every schema; `starts` of them per target are tried.
    """
    random = np.random.default_rng([arm, 7])
    low, high = robot.bounds(POSITION)
    margin = INSIDE * (high - low)
    targets = random.uniform(low + margin, high - margin, (TARGETS, len(low)))
    begins = random.uniform(low + margin, high - margin, (TARGETS, STARTS, len(low)))
    missed = np.full((TARGETS, starts), np.nan)
    pairs = [(t, s) for t in range(TARGETS) for s in range(starts)]
    while pairs:
        controller = controller_of(schema, robot, config)
        with ActualArm(robot, arm) as body:
            reference = body.position()
            try:
                while pairs:
                    target, start = pairs.pop(0)
                    go(body, controller, reference, begins[target, start])
                    reached = go(body, controller, begins[target, start], targets[target])
                    missed[target, start] = np.linalg.norm(reached - targets[target])
                    reference = targets[target]
            except CollectionStopped:
                continue
    return missed
