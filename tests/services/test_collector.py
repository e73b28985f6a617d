"""Collecting: condition by condition, within constraints, from postures, and what is refused before anything moves."""

from pathlib import Path

import numpy as np
import pytest
import small_hand
import yaml
from small_hand import OUT_OF_SIGHT, config, gravity_of, tip_of
from typer.testing import CliRunner

from gemuco.checkpoint import load
from hal.errors import ConfigError
from services.cli import app
from services.learning.collector import Request, collect_direct
from services.learning.motion import NowhereToGo, minimum_jerk, random_postures
from services.learning.playground import CollectionStopped
from services.learning.postures import BadPostures

LOW, HIGH = np.array([-1.0, -1.5]), np.array([1.0, 1.5])


def collected(robot=None, *conditions, samples=None, seed=0, **wanted):
    return collect_direct(robot or config(), None, seed, Request(conditions, samples, **wanted)).dataset


def test_every_condition_is_recorded_and_told_in_its_episodes() -> None:
    dataset = collected()
    assert dataset.conditions == ("short", "long")
    assert dataset.layout.names == ("joint_position", "center_of_gravity", "tool_tip_position")
    assert [int((dataset.condition_of_rows() == index).sum()) for index in (0, 1)] == [60, 60]
    for episode in dataset.episodes:
        position = episode.values["joint_position"]
        expected = tip_of(position, small_hand.TOOLS[episode.condition])
        np.testing.assert_allclose(episode.values["tool_tip_position"], np.where(
            expected[:, 1:] > OUT_OF_SIGHT, expected, np.nan), atol=1e-9)  # fmt: skip
        gravity = gravity_of(position, small_hand.TOOLS[episode.condition])
        np.testing.assert_allclose(episode.values["center_of_gravity"], gravity, atol=1e-9)


@pytest.mark.parametrize(
    ("hal", "lives", "cycles"), [(500.0, 0.1, 100.0), (50.0, 0.1, 50.0), (100.0, 0.1, 100.0), (500.0, 0.02, 500.0)]
)
def test_a_fast_robot_is_recorded_in_fewer_cycles_than_it_has(monkeypatch, hal, lives, cycles) -> None:
    """But not in so few that its commands expire."""
    rates = []
    direct = small_hand.simulator.direct
    monkeypatch.setattr(
        small_hand.simulator, "direct", lambda robot, *rest: rates.append(robot.rates.hal) or direct(robot, *rest)
    )
    robot = config()
    command = robot.command.model_copy(update={"time_to_live": lives})
    robot = robot.model_copy(update={"rates": robot.rates.model_copy(update={"hal": hal}), "command": command})
    assert len(collected(robot, "long", samples=20)) == 20
    assert rates == [cycles]


def test_a_condition_named_twice_is_recorded_once() -> None:
    dataset = collect_direct(config(), None, 0, Request(("long", "short", "long"), 20)).dataset
    assert dataset.conditions == ("long", "short")
    assert len(dataset) == 40


def test_values_that_the_camera_misses_are_kept_and_the_rest_is_whole() -> None:
    rows = collected(None, "long", samples=300)
    tip = np.concatenate([episode.values["tool_tip_position"] for episode in rows.episodes])
    position = np.concatenate([episode.values["joint_position"] for episode in rows.episodes])
    assert 0 < np.isnan(tip).any(axis=1).sum() < len(tip)
    assert np.isfinite(position).all()


def test_random_motion_keeps_the_constraints_on_the_way_and_the_limits() -> None:
    rows = collected(None, "long", samples=400)
    gravity = np.concatenate([episode.values["center_of_gravity"] for episode in rows.episodes])
    position = np.concatenate([episode.values["joint_position"] for episode in rows.episodes])
    assert (np.abs(gravity) <= np.array([0.051, 0.031])).all()
    assert ((position >= LOW) & (position <= HIGH)).all()
    assert (position.max(axis=0) - position.min(axis=0) > 0.4).all(), "it goes about"
    free = random_postures(config(collect={"speed": 2.0}), small_config(), "long", 0)
    commands = np.array([command for (command, _), _ in zip(free(np.zeros(2)), range(2000), strict=False)])
    outside = np.abs(gravity_of(commands, small_hand.TOOLS["long"])) > np.array([0.05, 0.03])
    assert outside.any(), "without constraints it would go outside"


def small_config(**changes):
    from services.model.model_config import collect_config

    return collect_config(config(collect={"speed": 2.0, "hold": 0.2, "rate": 10} | changes))


def test_the_same_seed_is_the_same_motion_and_a_condition_has_its_own() -> None:
    first, again, other = (collected(seed=seed, samples=30).rows() for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    assert not np.array_equal(first[:30, :2], first[30:, :2])


def test_a_way_begins_and_ends_at_rest_and_is_no_faster_than_asked() -> None:
    start, goal = np.array([0.0, 0.5]), np.array([1.0, 0.3])
    points = np.vstack([start, minimum_jerk(start, goal, 0.8, 0.02)])
    speed = np.abs(np.diff(points, axis=0)).max(axis=1) / 0.02
    np.testing.assert_allclose(points[-1], goal)
    assert 0.75 < speed.max() <= 0.8
    assert max(speed[0], speed[-1]) < 0.01


def test_a_start_outside_of_the_constraints_may_come_in_but_go_no_further_out() -> None:
    robot = config()
    collect = small_config(
        forecast="small_hand:forecast",
        constraints={"center_of_gravity": {"low": [-0.05, -0.03], "high": [0.05, 0.03]}},
    )
    start = np.array([1.0, 0.6])
    tool = small_hand.TOOLS["long"]
    before = gravity_of(start[None], tool)[0]
    assert before[1] > 0.031
    moves = random_postures(robot, collect, "long", 1)(start)
    path = []
    for command, duration in moves:
        path.append(command)
        if duration == collect.hold:
            break
    found = gravity_of(np.array(path), tool)
    assert (found[:, 1] <= before[1] + 1e-9).all()
    assert (np.abs(found[-1]) <= np.array([0.05, 0.03])).all()


@pytest.mark.parametrize(
    ("collect", "error", "report"),
    [
        ({"constraints": {"center_of_gravity": {"low": [0.9, 0.9]}}}, NowhereToGo, "center_of_gravity refused 100%"),
        ({"forecast": None}, ConfigError, "'constraints' need a 'forecast'"),
        ({"constraints": {"gravity": {"low": 0}}}, ConfigError, "constraints.gravity is not a signal"),
        ({"constraints": {"tool_tip_position": {"low": [0, 0, 0]}}}, ConfigError, "has 3 values, the signal has 2"),
        ({"constraints": {"foot_force": {"low": 1.0}}}, ConfigError, "collect.constraints need foot_force of shape"),
        ({"motion": "small_hand:move"}, ConfigError, "with 'motion', speed, hold"),
        ({"sped": 1.0}, ConfigError, "unknown key 'sped'"),
    ],
)
def test_a_collect_section_that_cannot_be_followed_is_told_in_a_sentence(collect, error, report) -> None:
    robot = config(collect=config().collect | collect)
    with pytest.raises(error) as caught:
        collected(robot)
    assert report in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_not_known_is_told_with_what_is() -> None:
    with pytest.raises(ConfigError, match=r"no condition 'middle'. Known conditions: short, long"):
        collected(None, "middle")
    with pytest.raises(ConfigError, match=r"no variant 'best'. Known variants: nominal, actual"):
        collect_direct(config(), "best")
    with pytest.raises(ConfigError, match=r"no condition 'huge'. Known conditions: short, long"):
        collected(config(conditions=["short", "huge"]))
    with pytest.raises(ConfigError, match=r"no 'collect' section"):
        collected(config(collect={}))
    with pytest.raises(ConfigError, match=r"needs limits.joint_position with low and high"):
        collected(config(limits={}))


def test_samples_that_never_count_end_the_collection() -> None:
    limits = config().model_dump()["limits"] | {"center_of_gravity": {"low": [0.5, 0.5], "high": [0.6, 0.6]}}
    with pytest.raises(CollectionStopped, match=r"No sample was usable for 30 s: center_of_gravity.x is"):
        collected(config(limits=limits))


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "taught.csv"
    path.write_text(text)
    return path


def test_taught_postures_are_played_once_each_in_order(tmp_path: Path) -> None:
    path = written(tmp_path, "elbow,shoulder,hold\n0.5,0.1,1.0\n\n-0.5,0.4,2.0\n")
    rows = collected(None, "short", postures=path).rows()[:, :2]
    assert np.abs(rows - [0.1, 0.5]).max(axis=1).min() < 1e-6
    at_last = (np.abs(rows - [0.4, -0.5]).max(axis=1) < 1e-6).sum()
    assert 19 <= at_last <= 21, "2 s at 10 Hz"
    np.testing.assert_allclose(rows[-1], [0.4, -0.5], atol=1e-6)


def test_without_a_hold_column_the_robot_files_hold_counts(tmp_path: Path) -> None:
    path = written(tmp_path, "shoulder,elbow\n0.1,0.1\n0.2,0.2\n")
    short = len(collected(None, "short", postures=path))
    robot = config(collect=config().collect | {"hold": 2.0})
    assert len(collected(robot, "short", postures=path)) == pytest.approx(short + 36, abs=2)
    assert len(collected(robot, "short", postures=path, samples=7)) == 7


@pytest.mark.parametrize(
    ("text", "report"),
    [
        ("", "must name shoulder, elbow, each once, and may name hold; it names nothing"),
        ("shoulder,elbo\n0,0\n", "it names shoulder, elbo."),
        ("shoulder,elbow,elbow\n0,0,0\n", "each once"),
        ("shoulder,elbow\n", "holds no posture, only a header"),
        ("shoulder,elbow\n0.1\n", "line 2: 1 values under 2 names"),
        ("shoulder,elbow\n0.1,0.2\n0.1,left\n", "line 3: elbow is 'left', which is not a number"),
        ("shoulder,elbow\n0.1,nan\n", "elbow of nan rad is outside of its limits"),
        (
            "shoulder,elbow\n0.1,0.2\n0.1,1.6\n",
            "line 3: elbow of 1.6 rad is outside of its limits, -1.5 to 1.5. The robot did not move",
        ),
        ("shoulder,elbow,hold\n0.1,0.2,-1\n", "hold is -1; it must be a time"),
    ],
)
def test_bad_postures_are_refused_before_anything_moves(tmp_path: Path, text: str, report: str) -> None:
    with pytest.raises(BadPostures) as caught:
        collected(None, "short", postures=written(tmp_path, text))
    assert report in str(caught.value)


def test_a_file_of_postures_that_cannot_be_read_is_told(tmp_path: Path) -> None:
    with pytest.raises(BadPostures, match="cannot be read"):
        collected(None, "short", postures=tmp_path / "none.csv")
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(BadPostures, match="cannot be read"):
        collected(None, "short", postures=binary)


@pytest.mark.slow
def test_from_the_command_line_to_a_model_that_knows_every_condition(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = config().model | {
        "network": {"hidden": [12], "latent": 4, "bias": 2},
        "structure": {"threshold_out": 0.9, "threshold_in": 0.9, "epochs": 10},
        "training": {"epochs": 3, "batch": 25, "rate": 0.02},
    }
    robot = tmp_path / "small_hand.yaml"
    robot.write_text(yaml.safe_dump(small_hand.description("small_hand") | {"model": model}))
    monkeypatch.chdir(tmp_path)

    def gemuco(*words: str) -> tuple[int, str]:
        report = CliRunner().invoke(app, words)
        return report.exit_code, report.output.replace("\n", " ")

    code, report = gemuco("collect", str(robot), "--condition", "short", "--condition", "long", "--samples", "150")
    assert (code, "300 samples in runs/small_hand/data.npz" in report) == (0, True), report
    code, report = gemuco("train", str(robot))
    assert code == 0, report
    assert tuple(load(tmp_path / "runs" / "small_hand" / "model").biases) == ("short", "long")
    code, report = gemuco("collect", str(robot), "--condition", "middle")
    assert (code, "has no condition 'middle'. Known conditions: short, long" in report) == (2, True), report
