"""Everything that a story is played with."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hal.config import RobotConfig
from services.client import Client
from services.demo.actor import Actor
from services.model.control_config import ControlConfig


@dataclass(frozen=True, slots=True)
class Scene:
    """Everything that a story is played with.

    Attributes:
        robot: The robot, with the rates that this machine keeps.
        control: Its settings of control.
        client: Client of the robot.
        actor: Program that moves the robot.
        report: Called with a line of text per event.
        seed: Seed of the simulated actual robot.
        picture: Plot of the story (PNG).
    """

    robot: RobotConfig
    control: ControlConfig
    client: Client
    actor: Actor
    report: Callable[[str], None]
    seed: int
    picture: Path
