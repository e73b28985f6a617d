from pathlib import Path

import pytest

from gemuco import Thresholds, TrainConfig, UpdateConfig
from hal.config import RobotConfig, load_robot
from hal.errors import ConfigError
from services.learning.trainer import train_config
from services.model.model_config import collect_config, model_config

ROBOT = Path(__file__).parents[2] / "robots" / "musashi_arm.yaml"


def robot(**sections: object) -> RobotConfig:
    shipped = load_robot(ROBOT)
    return shipped.model_copy(update=sections)


def test_shipped_sections_are_understood() -> None:
    shipped = load_robot(ROBOT)
    model = model_config(shipped)
    assert model.control is not None
    assert model.control.target == "joint_position"
    assert collect_config(shipped).motion.endswith(":random_motion")


@pytest.mark.parametrize(
    ("section", "content", "sentence"),
    [
        ("model", {"netwrok": {}}, "unknown key 'netwrok'. Known keys there: signals, fuse, network, structure"),
        (
            "model",
            {"update": {"windows": 3}},
            "unknown key 'update.windows'. Known keys there: what, bias_method, window",
        ),
        ("model", {"update": {"window": 0}}, "update.window: Input should be greater than or equal to 1"),
        (
            "model",
            {"control": {"target": "elbow"}},
            "model.control.target 'elbow' is not a signal of the model. Known: joint_position",
        ),
        ("collect", {}, "has no 'collect' section"),
    ],
)
def test_a_mistake_is_one_sentence(section: str, content: dict, sentence: str) -> None:
    read = model_config if section == "model" else collect_config
    with pytest.raises(ConfigError) as caught:
        read(robot(**{section: content}))
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_robot_without_control_is_only_observed() -> None:
    assert model_config(robot(model={})).control is None


def test_training_has_the_defaults_of_the_library() -> None:
    ours = train_config(model_config(robot(model={})), TrainConfig().epochs, TrainConfig().seed)
    assert ours == TrainConfig()


def test_the_update_has_the_defaults_of_the_library() -> None:
    ours = model_config(robot(model={})).update.model_dump(exclude={"interval"})
    assert UpdateConfig(**ours) == UpdateConfig()


def test_structure_has_the_thresholds_of_the_library() -> None:
    ours = model_config(robot(model={})).structure
    assert Thresholds(ours.threshold_out, ours.threshold_in, ours.measure, ours.over) == Thresholds()
