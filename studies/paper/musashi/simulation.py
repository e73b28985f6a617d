"""The body schema as a simulator of the arm (paper, III-B, figures d to f): what state wire lengths bring about."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gemuco.dataset import Dataset
from gemuco.schema import BodySchema
from gemuco.search.losses import Hold, Match, StaySmall, Term
from gemuco.search.torque import TorqueBalance
from gemuco.simulation import Simulator
from hal import registry
from hal.config import RobotConfig
from services.model.control_config import controller_of, terms_of
from services.model.model_config import model_config
from studies.paper.musashi.control import GRAVITY
from studies.paper.musashi.motion import LENGTH, POSITION, SENT, TENSION, signals

FORCE = "simulators.robots.musashi_arm:force_torque"
EVERY = 10
"""Every so many-th recorded sample is simulated: one a second."""
OURS, PAPER = "robot file's weights", "paper's weights"
BENT = np.array([0.0, 0.0, 0.0, -np.pi / 2, 0.0])
"""Elbow bent by 90 degrees [rad]."""
FORCED = np.array([np.nan, -np.pi / 6, np.nan, np.nan, np.nan])
"""The shoulder pitched forward by 30 degrees [rad]."""
FORCES = {"no force": (0.0, 0.0, 0.0), "-50 N in z": (0.0, 0.0, -50.0), "50 N in y": (0.0, 50.0, 0.0)}


def losses(robot: RobotConfig) -> dict[str, Sequence[Term | Hold]]:
    """The paper's loss for the simulator with the weights of the robot file, and with its own."""
    paper = (
        Match(LENGTH),
        StaySmall(TENSION, 0.1),
        TorqueBalance(registry.load(GRAVITY), 0.001, at="predicted"),
    )
    return {OURS: terms_of(model_config(robot).simulation), PAPER: paper}


@dataclass(frozen=True, slots=True)
class Course:
    """A simulated motion beside what the arm did.

    Attributes:
        time: [s], shape (n,).
        values: Signal -> what was simulated [its unit], shape (n, k).
        measured: Signal -> what was measured [its unit], shape (n, k).
    """

    time: np.ndarray
    values: Mapping[str, np.ndarray]
    measured: Mapping[str, np.ndarray]

    def errors(self, signal: str) -> np.ndarray:
        """Norm of the difference [its unit], shape (n,)."""
        return np.asarray(np.linalg.norm(self.values[signal] - self.measured[signal], axis=1))


def simulate(robot: RobotConfig, schema: BodySchema, recording: Dataset, terms: Sequence[Term | Hold]) -> Course:
    """Send the recorded commands to the model; it begins where the arm began and sees no more of it."""
    recorded = signals(recording)
    chosen = {name: values[::EVERY] for name, values in recorded.items()}
    simulator = Simulator(schema, terms, robot.command.signal)
    begin = {name: chosen[name][0] for name in schema.layout.names}
    found = [simulator.step(command, now=begin).values for command in chosen[SENT]]
    names = (POSITION, TENSION)
    values = {name: np.array([state[name] for state in found]) for name in names}
    return Course(np.arange(len(found), dtype=float), values, {name: chosen[name] for name in names})


def forced(robot: RobotConfig, schema: BodySchema) -> dict[str, dict[str, np.ndarray]]:
    """Figure (f): the bent arm under forces on its hand, and with its shoulder forced to a posture.

    Every search begins anew from the training data: from the last state, where the lengths fit, descent along the norms
    goes nowhere. Far from any motion that was learned, descent on z may answer with tensions below zero, which no
    muscle has.

    Returns:
        What was done -> signal -> simulated value [its unit], shape (k,).
    """
    control = model_config(robot).control
    if control is None:
        raise ValueError(f"Robot '{robot.robot}' is not controlled: its file has no model.control.")
    sent = controller_of(schema, robot, control).solve({POSITION: BENT}).command
    gravity, pushed = registry.load(GRAVITY), registry.load(FORCE)
    terms = losses(robot)[OURS]
    keep = [term for term in terms if not isinstance(term, TorqueBalance)]
    weight = next(term.weight for term in terms if isinstance(term, TorqueBalance))

    def balance(force: np.ndarray) -> TorqueBalance:
        return TorqueBalance(lambda q: gravity(q) - pushed(q, force), weight, at="predicted")

    found: dict[str, dict[str, np.ndarray]] = {}
    simulator = Simulator(schema, terms, robot.command.signal)
    for name, force in FORCES.items():
        simulator.constrain([*keep, balance(np.array(force))])
        simulator.restart()
        found[name] = simulator.step(sent).values
    for name, wish in (("pitch wished (paper)", Match(POSITION)), ("pitch held", Hold(POSITION))):
        simulator.constrain([*keep, wish])
        simulator.restart()
        found[name] = simulator.step(sent, {POSITION: FORCED}).values
    return found
