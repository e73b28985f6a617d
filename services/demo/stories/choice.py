"""The story that fits a robot: each with its stages, how it is played, and its picture."""

from collections.abc import Callable
from dataclasses import dataclass

from hal.config import RobotConfig
from hal.errors import ConfigError
from services.demo.stories import arm_story, device_story, muscle_story, tool_story
from services.demo.stories.scene import Scene
from services.demo.timeline import Timeline
from services.model import artifacts
from services.model.control_config import ControlConfig
from services.model.living_model import load_model
from services.model.model_config import model_config


@dataclass(frozen=True, slots=True)
class Story:
    """A story that `gemuco demo` can play.

    Attributes:
        names: Names of its stages.
        fits: Whether it can be played with a robot.
        watched: Returns the signal that is lost, whose estimates the remote client prints.
        play: Plays it; returns a function that draws the picture.
    """

    names: tuple[str, ...]
    fits: Callable[[RobotConfig, ControlConfig | None], bool]
    watched: Callable[[RobotConfig, ControlConfig], str]
    play: Callable[[Scene], Callable[[], None]]


def _timeline(scene: Scene, signal: str, hide: list[str]) -> Timeline:
    robot = scene.robot
    sizes = robot.signals[signal].size, robot.signals[robot.command.signal].size
    return Timeline(scene.client, signal, *sizes, hide)


def _play_tools(scene: Scene) -> Callable[[], None]:
    from services.demo.stories import tool_plot

    robot, target = scene.robot, scene.control.target
    schema = load_model(robot, artifacts.model_folder(robot.robot))
    with _timeline(scene, target, list(robot.seen)) as timeline:
        marks = tool_story.ToolStory(
            robot, scene.client, timeline, scene.seed, scene.actor, scene.report, schema
        ).play()
    return lambda: tool_plot.plot(robot, target, schema, timeline, marks, scene.picture)


def _play_arm(scene: Scene) -> Callable[[], None]:
    from services.demo.stories import arm_plot

    target, (seen,) = scene.control.target, scene.robot.seen
    with _timeline(scene, target, [target]) as joints, _timeline(scene, seen, [seen]) as tip:
        marks = arm_story.ArmStory(scene, joints, tip).play()
    return lambda: arm_plot.plot(scene.robot, target, joints, tip, marks, scene.picture)


def _play_muscles(scene: Scene) -> Callable[[], None]:
    from services.demo.stories import muscle_plot

    robot, target = scene.robot, scene.control.target
    with _timeline(scene, target, [target]) as timeline:
        story = muscle_story.MuscleStory(robot, scene.client, timeline, scene.seed, scene.actor, scene.report)
        marks = story.play()
    return lambda: muscle_plot.plot(robot, timeline, marks, scene.picture)


def _play_devices(scene: Scene) -> Callable[[], None]:
    from services.demo.stories import device_plot

    marks = device_story.lost_device(scene.robot)
    with _timeline(scene, marks.signal, [marks.signal]) as timeline:
        device_story.DeviceStory(scene, timeline, marks).play()
    return lambda: device_plot.plot(scene.robot, timeline, marks, scene.picture)


def _target(robot: RobotConfig, control: ControlConfig) -> str:
    return control.target


STORIES = (
    Story(tool_story.NAMES, tool_story.fits, _target, _play_tools),
    Story(arm_story.NAMES, arm_story.fits, _target, _play_arm),
    Story(muscle_story.NAMES, muscle_story.fits, _target, _play_muscles),
    Story(
        device_story.NAMES, device_story.fits, lambda robot, _: device_story.lost_device(robot).signal, _play_devices
    ),
)
"""The stories, the one that shows most first."""


def story_of(robot: RobotConfig) -> Story:
    """Return the first story that fits a robot.

    Raises:
        ConfigError: No story fits.
    """
    control = model_config(robot).control
    for story in STORIES:
        if story.fits(robot, control):
            return story
    raise ConfigError(
        f"There is no story for '{robot.robot}': it needs a camera and conditions, or a camera and encoders apart from "
        f"its drives, or a muscle {muscle_story.MUSCLE} to cut, or a device beside the one that is lost, and "
        "`model.control` with the commanded signal as its target."
    )
