"""Settings of a robot of gemuco in LeRobot."""

from dataclasses import dataclass, field

from lerobot.robots.config import RobotConfig


@RobotConfig.register_subclass("gemuco")
@dataclass(kw_only=True)
class GemucoConfig(RobotConfig):
    """Settings of `--robot.type=gemuco`.

    Attributes:
        robot: Name of the robot whose services run.
        connect: Endpoints, such as a router's `tcp/192.168.7.1:7447`, and role files; none on the robot's own computer.
        signals: Signals of the observation; all of the robot if empty.
        moves: Whether actions are sent. Without it the robot is only observed, and no lease is taken.
        timeout: The services are waited for this long [s].
    """

    robot: str
    connect: list[str] = field(default_factory=list)
    signals: list[str] = field(default_factory=list)
    moves: bool = True
    timeout: float = 10.0
