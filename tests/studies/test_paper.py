import json
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from gemuco.dataset import Dataset, Episode
from gemuco.signals import Layout, Signal
from hal.config import load_robot
from services.errors import BadArguments
from services.show import Tell
from studies.paper import experiment, figures
from studies.paper.report import Report, Row
from studies.paper.runs import Run, RunKilled, each_seed, open_run

ROBOT = Path(__file__).parents[2] / "robots" / "musashi_arm.yaml"


def test_a_row_compares_its_mean_with_the_bar():
    lower = Row("tip error", "mm", "52.2", (10.0, 13.0), bar=12.0)
    assert lower.reached
    assert lower.cells() == ("tip error", "52.2 mm", "11.5 ± 1.5 mm", "< 12 mm", "yes")
    assert Row("R2", "", "", (0.9,), bar=0.95, better="higher").reached is False
    assert Row("L", "", "0.012", (0.02,)).reached is None
    with pytest.raises(ValueError, match="one value per seed"):
        Row("nothing", "mm", "", ())


def test_a_report_is_saved_for_people_and_programs(tmp_path):
    report = Report("pr2", range(2))
    report.add(Row("tip error", "mm", "52.2", (10.0, 13.0), bar=12.0))
    report.note("The tip hangs 100 mm below.")
    report.save(tmp_path)
    told = (tmp_path / "report.md").read_text()
    assert "| tip error | 52.2 mm | 11.5 ± 1.5 mm | < 12 mm | yes |" in told
    assert told.strip().endswith("The tip hangs 100 mm below.")
    saved = json.loads((tmp_path / "report.json").read_text())
    assert saved["rows"][0]["reached"] is True
    assert saved["rows"][0]["values"] == [10.0, 13.0]
    assert report.table().row_count == 1


def test_what_was_collected_is_used_again_until_something_changes(tmp_path):
    robot = load_robot(ROBOT)
    calls = []
    layout = Layout((Signal("a", 1, "rad"),))

    def make() -> Dataset:
        calls.append(1)
        return Dataset(layout, (Episode("", {"a": np.zeros((3, 1))}),))

    run = open_run(robot, tmp_path, 0)
    assert len(run.dataset("nominal", make, samples=3)) == 3
    run.dataset("nominal", make, samples=3)
    assert len(calls) == 1
    run.dataset("nominal", make, samples=4)
    assert len(calls) == 2
    other = robot.model_copy(update={"collect": {**robot.collect, "rate": 5}})
    open_run(other, tmp_path, 0).dataset("nominal", make, samples=4)
    assert len(calls) == 3
    (tmp_path / "seed_0" / "nominal.npz").write_bytes(b"damaged")
    open_run(other, tmp_path, 0).dataset("nominal", make, samples=4)
    assert len(calls) == 4
    open_run(other, tmp_path, 0, fresh=True).dataset("nominal", make, samples=4)
    assert len(calls) == 5


def test_unknown_experiments_are_one_sentence():
    with pytest.raises(BadArguments, match=r"no experiments 'pr3'\. Known: pr2, musashi, kxr"):
        experiment("pr3")


def test_every_kind_of_figure_can_be_drawn(tmp_path):
    random = np.random.default_rng(0)
    with figures.picture(tmp_path / "all.png", "everything", columns=2, rows=2) as axes:
        biases = {f"tool {i}": random.normal(size=3) for i in range(4)}
        figures.bias_map(axes[0], biases, {"trajectory": random.normal(size=(9, 3))})
        figures.over_steps(axes[1], {"update p": random.random((3, 9)), "update W": random.random(9)}, "mm", bar=0.5)
        figures.bars(axes[2], {"before": {"a": (1.0, 2.0), "b": (3.0,)}, "after": {"a": (1.0,)}}, "rad")
        score = random.random(9) + 1
        figures.score_over_time(axes[3], np.arange(9.0), {"arm": score}, 1.5, {"cut": (3.0, 5.0)})
    assert (tmp_path / "all.png").stat().st_size > 10_000


def test_two_components_are_enough_for_a_p_of_one_number(tmp_path):
    with figures.picture(tmp_path / "one.png", "one number") as axes:
        figures.bias_map(axes[0], {"light": np.array([-1.0]), "heavy": np.array([1.0])})
    assert (tmp_path / "one.png").exists()


def _counts(run: Run, tell: Tell) -> tuple[int, int]:
    tell(0.0, "counting")
    if run.robot.robot == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if run.robot.robot == "broken":
        if run.seed:
            tell(0.5, "patient")
            while True:
                tell(0.5, "waiting")
        raise FileNotFoundError("of seed 0")
    deadline = time.monotonic() + 30.0
    while not (run.folder / "heard").exists():
        assert time.monotonic() < deadline, "nobody heard it"
        time.sleep(0.01)
    return run.seed, os.getpid()


@pytest.mark.long
def test_seeds_run_side_by_side_and_are_told_of(tmp_path):
    told: list[str] = []

    def hear(share: float, text: str) -> None:
        assert 0.0 <= share <= 1.0
        told.append(text)
        (tmp_path / f"seed_{text[5]}" / "heard").touch()

    found = each_seed(load_robot(ROBOT), [3, 1, 2], tmp_path, hear, False, _counts)
    assert [seed for seed, _ in found] == [3, 1, 2]
    assert os.getpid() not in {process for _, process in found}
    assert sorted(told) == ["seed 1: counting", "seed 2: counting", "seed 3: counting"]


@pytest.mark.long
def test_an_experiment_that_fails_ends_those_of_the_other_seeds(tmp_path):
    robot = load_robot(ROBOT).model_copy(update={"robot": "broken"})
    with pytest.raises(FileNotFoundError, match="of seed 0"):
        each_seed(robot, [0, 1], tmp_path, lambda share, text: None, False, _counts)


@pytest.mark.long
def test_a_process_that_is_killed_is_told_in_a_sentence(tmp_path):
    robot = load_robot(ROBOT).model_copy(update={"robot": "killed"})
    with pytest.raises(RunKilled, match="was killed"):
        each_seed(robot, [0, 1], tmp_path, lambda share, text: None, False, _counts)
