from pathlib import Path

import pytest
import yaml
from hal_bench import description

from hal.config import load_robot
from hal.errors import ConfigError

MUSASHI = Path(__file__).parents[2] / "robots" / "musashi_arm.yaml"


@pytest.fixture
def written(tmp_path):
    def write(**changes):
        body = {key: value for key, value in description(**changes).items() if key != "folder"}
        path = tmp_path / "bench.yaml"
        path.write_text(yaml.safe_dump(body, sort_keys=False))
        return path

    return write


def refused(path):
    with pytest.raises(ConfigError) as caught:
        load_robot(path)
    return str(caught.value)


def changed(section, path, value):
    body = description()[section]
    inner = body
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return {section: body}


def test_reads_the_musashi_arm():
    config = load_robot(MUSASHI)
    assert config.robot == "musashi_arm"
    assert [signal.size for signal in config.signals.values()] == [5, 10, 10]
    assert len(config.devices) == 25
    assert config.folder == MUSASHI.parent


def test_the_devices_settings_win_over_the_kinds(written):
    path = written(**changed("devices", ["biceps_drive", "settings"], {"gear": 7, "zero": 0.2}))
    settings = load_robot(path).settings_of("biceps_drive")
    assert settings["gear"] == 7
    assert settings["zero"] == 0.2
    assert settings["counts_per_turn"] == 4096


def test_bounds_are_infinite_where_not_stated(written):
    low, high = load_robot(written(limits={})).bounds("muscle_length")
    assert low.tolist() == [-float("inf")] * 2
    assert high.tolist() == [float("inf")] * 2


def test_a_missing_file_names_its_neighbours(written):
    path = written()
    assert "bench.yaml" in refused(path.with_name("bensch.yaml"))


@pytest.mark.parametrize("text", ["", "- a\n- b", "just words", "a: [", "\x00"])
def test_files_that_are_no_robot_are_refused(tmp_path, text):
    path = tmp_path / "odd.yaml"
    path.write_text(text)
    assert "odd.yaml" in refused(path)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"robbot": 1}, "unknown key 'robbot'. Known keys there: robot, description, signals"),
        (
            changed("devices", ["biceps_drive", "nod"], 3),
            "unknown key 'devices.biceps_drive.nod'. Known keys there: kind",
        ),
        (changed("command", ["signal"], "muscle_lenght"), "Known: joint_position, muscle_tension, muscle_length"),
        (changed("devices", ["biceps_drive", "bus"], "can7"), "Known buses: can0, can1"),
        (changed("devices", ["biceps_drive", "kind"], "motor"), "Known kinds: drive, cell, encoder"),
        (
            changed("devices", ["biceps_drive", "element"], "muscle_length.tibialis"),
            "Known elements: joint_position.elbow",
        ),
        (changed("devices", ["biceps_drive", "node"], 11), "both claim node 11"),
        (changed("devices", ["biceps_drive", "node"], 2048), "devices.biceps_drive.node"),
        (changed("devices", ["biceps_cell", "element"], "muscle_length.biceps"), "both claim element"),
        ({"limits": {"muscle_length": {"low": 0.5, "high": 0.1}}}, "low must be below high"),
        ({"limits": {"muscle_length": {"low": [0.1, 0.1, 0.1]}}}, "has 3 values, the signal has 2"),
        ({"limits": {"muscle_tension": {"soft_high": 300, "trip_high": 200}}}, "soft_high must be below trip_high"),
        ({"limits": {"muscle_length": {"low": float("nan")}}}, "limits.muscle_length"),
        ({"limits": {"speed": {"low": 0}}}, "limits.speed is not a signal"),
        ({"rates": {"hal": 0}}, "rates.hal"),
        ({"robot": "Bench Robot"}, "robot"),
    ],
)
def test_mistakes_are_told_in_one_sentence(written, changes, told):
    message = refused(written(**changes))
    assert told in message
    assert "\n" not in message
