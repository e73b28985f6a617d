"""The body schema as a simulator of the arm (paper, III-B, figures d to f): from wire lengths to states."""

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
"""Recorded samples per simulated one: one a second is simulated."""
OURS, PAPER = "robot file's weights", "paper's weights"
BENT = np.array([0.0, 0.0, 0.0, -np.pi / 2, 0.0])
"""Elbow bent by 90 degrees [rad]."""
FORCED = np.array([np.nan, -np.pi / 6, np.nan, np.nan, np.nan])
"""The shoulder pitched forward by 30 degrees [rad]."""
FORCES = {"no force": (0.0, 0.0, 0.0), "-50 N in z": (0.0, 0.0, -50.0), "50 N in y": (0.0, 50.0, 0.0)}


def losses(robot: RobotConfig) -> dict[str, Sequence[Term | Hold]]:
    """Return the paper's loss for the simulator, with the weights of the robot file and with its own."""
    paper = (
        Match(LENGTH),
        StaySmall(TENSION, 0.1),
        TorqueBalance(registry.load_object(GRAVITY), 0.001, at="predicted"),
    )
    return {OURS: terms_of(model_config(robot).simulation), PAPER: paper}


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A simulated motion beside the measured one.

    Attributes:
        time: [s], shape (n,).
        values: Signal -> simulated values [its unit], shape (n, k).
        measured: Signal -> measured values [its unit], shape (n, k).
    """

    time: np.ndarray
    values: Mapping[str, np.ndarray]
    measured: Mapping[str, np.ndarray]

    def errors(self, signal: str) -> np.ndarray:
        """Return the norm of the difference [its unit], shape (n,)."""
        return np.asarray(np.linalg.norm(self.values[signal] - self.measured[signal], axis=1))


def simulate(robot: RobotConfig, schema: BodySchema, recording: Dataset, terms: Sequence[Term | Hold]) -> Trajectory:
    """Send the recorded commands to the model, which starts at the arm's first state and sees no later one."""
    recorded = signals(recording)
    chosen = {name: values[::EVERY] for name, values in recorded.items()}
    simulator = Simulator(schema, terms, robot.command.signal)
    begin = {name: chosen[name][0] for name in schema.layout.names}
    states = [simulator.step(command, now=begin).values for command in chosen[SENT]]
    names = (POSITION, TENSION)
    values = {name: np.array([state[name] for state in states]) for name in names}
    return Trajectory(np.arange(len(states), dtype=float), values, {name: chosen[name] for name in names})


def forced(robot: RobotConfig, schema: BodySchema) -> dict[str, dict[str, np.ndarray]]:
    """Simulate figure (f): the bent arm under forces on its hand, and with its shoulder forced to a posture.

    Every search begins at the training data: at the last state, where the lengths fit, descent along the norms does not
    move. Far from the learned motion, descent on z may end at tensions below zero, which no muscle has.

    Returns:
        Force or posture -> signal -> simulated value [its unit], shape (k,).
    """
    control = model_config(robot).control
    if control is None:
        raise ValueError(f"Robot '{robot.robot}' has no `model.control` in its file.")
    sent = controller_of(schema, robot, control).solve({POSITION: BENT}).command
    gravity, pushed = registry.load_object(GRAVITY), registry.load_object(FORCE)
    terms = losses(robot)[OURS]
    keep = [term for term in terms if not isinstance(term, TorqueBalance)]
    weight = next(term.weight for term in terms if isinstance(term, TorqueBalance))

    def balance(force: np.ndarray) -> TorqueBalance:
        return TorqueBalance(lambda q: gravity(q) - pushed(q, force), weight, at="predicted")

    states: dict[str, dict[str, np.ndarray]] = {}
    simulator = Simulator(schema, terms, robot.command.signal)
    for name, force in FORCES.items():
        simulator.constrain([*keep, balance(np.array(force))])
        simulator.restart()
        states[name] = simulator.step(sent).values
    for name, wish in (("pitch wished (paper)", Match(POSITION)), ("pitch held", Hold(POSITION))):
        simulator.constrain([*keep, wish])
        simulator.restart()
        states[name] = simulator.step(sent, {POSITION: FORCED}).values
    return states
