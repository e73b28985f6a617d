from pathlib import Path

import pytest
import yaml
from hal_bench import description

from hal.calibration.units import ROBOT_UNITS
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
    ("changes", "report"),
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
def test_mistakes_are_told_in_one_sentence(written, changes, report):
    message = refused(written(**changes))
    assert report in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("unit", "report"),
    [
        ("deg", "'deg' is not an SI unit; write unit: rad, and written_in: deg beside its numbers in limits, stop"),
        ("degrees", "write unit: rad, and written_in: deg"),
        ("rpm", "write unit: rad/s, and written_in: rpm"),
        ("Nm", "the unit 'Nm' is written 'N m'"),
        ("Rad", "the unit 'Rad' is unknown; is it 'rad'? Known units: "),
        ("furlong", "the unit 'furlong' is unknown. Known units: "),
        (None, "a signal needs a unit, such as rad"),
    ],
)
def test_a_unit_is_one_of_a_list(written, unit, report):
    text = refused(written(**changed("signals", ["joint_position", "unit"], unit)))
    assert "signals.joint_position.unit: " in text and report in text
    assert "\n" not in text


def test_the_document_lists_every_unit():
    text = (MUSASHI.parents[1] / "docs" / "robots.md").read_text().replace("1 (no unit)", "1")
    assert f"is one of {', '.join(ROBOT_UNITS)}." in " ".join(text.split())


def test_a_number_without_a_unit_has_the_unit_one(written):
    assert (
        load_robot(written(**changed("signals", ["joint_position", "unit"], 1))).signals["joint_position"].unit == "1"
    )


def test_limits_and_stop_are_converted_where_they_are_written(written):
    limits = {
        "muscle_length": {"low": [100, 120.0], "high": 500, "rate": 50, "acceleration": 1000, "written_in": "mm"},
        "joint_position": {"trip_low": -90, "trip_high": 90.0, "written_in": "deg"},
        "muscle_tension": {"trip_high": 0.5, "written_in": "kN"},
    }
    stop = {"behaviour": "park", "park": [200, 300], "speed": 20, "written_in": "mm"}
    config = load_robot(written(limits=limits, stop=stop))
    length, joint = config.limits["muscle_length"], config.limits["joint_position"]
    assert (length.low, length.high, length.rate, length.acceleration) == ((0.1, 0.12), 0.5, 0.05, 1.0)
    assert (joint.trip_low, joint.trip_high) == (pytest.approx(-1.570796), pytest.approx(1.570796))
    assert config.limits["muscle_tension"].trip_high == 500.0
    assert (config.stop.park, config.stop.speed) == ((0.2, 0.3), 0.02)
    assert type(config).model_validate(config.model_dump(by_alias=True)) == config  # nothing is converted twice


@pytest.mark.parametrize(
    ("signal", "unit", "report"),
    [
        (
            "joint_position",
            "mm",
            "limits: joint_position: 'mm' cannot be converted to 'rad'; to 'rad' can be converted",
        ),
        ("joint_position", "degree", "the unit 'degree' is written 'deg'"),
        ("muscle_tension", "deg", "'deg' cannot be converted to 'N'; to 'N' can be converted: mN, kN, kgf"),
    ],
)
def test_numbers_in_a_unit_that_does_not_fit(written, signal, unit, report):
    assert report in refused(written(limits={signal: {"trip_high": 1.0, "written_in": unit}}))
    assert "stop" in refused(written(stop={"behaviour": "park", "park": [1, 1], "speed": 1, "written_in": "deg"}))


def test_what_is_plausible_is_converted_too_but_not_its_time(written):
    plausible = {"low": -180, "high": 180.0, "rate": 360, "frozen_after": 2.0, "written_in": "deg"}
    config = load_robot(written(**changed("signals", ["joint_position", "plausible"], plausible)))
    converted = config.signals["joint_position"].plausible
    assert (converted.low, converted.rate) == (pytest.approx(-3.141593), pytest.approx(6.283185))
    assert converted.frozen_after == 2.0
