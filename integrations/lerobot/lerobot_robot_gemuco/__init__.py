"""A robot of gemuco in LeRobot."""

from lerobot_robot_gemuco.config_gemuco import GemucoConfig
from lerobot_robot_gemuco.gemuco import Gemuco
from lerobot_robot_gemuco.processor import UnknownProcessorStep

__all__ = ["Gemuco", "GemucoConfig", "UnknownProcessorStep"]
