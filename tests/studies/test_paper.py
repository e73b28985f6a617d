import json
import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gemuco.dataset import Dataset, Episode
from gemuco.signals import Layout, Signal
from hal.config import load_robot
from services.cli import app
from services.errors import BadArguments
from services.show import Progress
from studies.paper import experiment, figures, runs
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
    page = (tmp_path / "report.md").read_text()
    assert "| tip error | 52.2 mm | 11.5 ± 1.5 mm | < 12 mm | yes |" in page
    assert page.strip().endswith("The tip hangs 100 mm below.")
    saved = json.loads((tmp_path / "report.json").read_text())
    assert saved["rows"][0]["reached"] is True
    assert saved["rows"][0]["values"] == [10.0, 13.0]
    assert report.table().row_count == 1


def test_results_are_cached_until_the_robot_file_or_a_setting_changes(tmp_path):
    robot = load_robot(ROBOT)
    calls = []
    layout = Layout((Signal("a", 1, "rad"),))

    def make() -> Dataset:
        calls.append(1)
        return Dataset(layout, (Episode("", {"a": np.zeros((3, 1))}),))

    run = open_run(robot, tmp_path, 0)
    assert len(run.cached("nominal", make, samples=3)) == 3
    assert len(run.cached("nominal", make, samples=3)) == 3
    assert len(calls) == 1
    run.cached("nominal", make, samples=4)
    assert len(calls) == 2
    other = robot.model_copy(update={"collect": {**robot.collect, "rate": 5}})
    open_run(other, tmp_path, 0).cached("nominal", make, samples=4)
    assert len(calls) == 3
    open_run(other, tmp_path, 0, fresh=True).cached("nominal", make, samples=4)
    assert len(calls) == 4


def test_unknown_experiments_are_one_sentence():
    with pytest.raises(BadArguments, match=r"no experiments 'pr3'\. Known: pr2, musashi, kxr"):
        experiment("pr3")


def test_experiments_that_are_not_installed_are_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "studies.paper", None)
    result = CliRunner().invoke(app, ["reproduce", "kxr"])
    assert result.exit_code == 2
    assert "'studies.paper:experiment' cannot be loaded" in result.output
    assert "Traceback" not in result.output


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


def _seed_and_process(run: Run, progress: Progress) -> tuple[int, int]:
    if run.robot.robot == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    progress(0.5, "counting")
    if run.robot.robot == "broken" and run.seed == 0:
        raise FileNotFoundError("of seed 0")
    return run.seed, os.getpid()


def _each_seed(robot: str, seeds: list[int], folder: Path, progress: Progress) -> list[tuple[int, int]]:
    config = load_robot(ROBOT).model_copy(update={"robot": robot})
    return each_seed(config, seeds, folder, progress, False, _seed_and_process)


@pytest.mark.slow
def test_results_are_in_the_order_of_the_seeds_and_progress_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "cpu_count", lambda: 2)
    reports: list[tuple[float, str]] = []
    results = _each_seed("arm", [3, 1, 2], tmp_path, lambda share, text: reports.append((share, text)))
    assert [seed for seed, _ in results] == [3, 1, 2]
    assert os.getpid() not in {process for _, process in results}
    assert sorted(text for _, text in reports) == ["seed 1: counting", "seed 2: counting", "seed 3: counting"]
    assert max(share for share, _ in reports) == pytest.approx(0.5)


@pytest.mark.long
def test_an_error_in_one_seed_is_raised(tmp_path):
    with pytest.raises(FileNotFoundError, match="of seed 0"):
        _each_seed("broken", [0, 1], tmp_path, lambda share, text: None)


@pytest.mark.slow
def test_a_killed_process_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "cpu_count", lambda: 2)
    with pytest.raises(RunKilled, match="was killed"):
        _each_seed("killed", [0, 1], tmp_path, lambda share, text: None)
