"""`gemuco inspect`: lies in measured tables are printed, and the tables are written without them."""

import csv
import re
import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

from gemuco import TrainConfig, fit, save
from gemuco.trust.inspection import Lie
from services.cli import app
from services.verbs.inspect import _Lies

SECONDS, RATE, LIES_FROM, LIES_UNTIL = 40, 10, 15, 25
UNITS = {"joint": "rad", "cable": "m", "tension": "N"}
DESCRIPTION = """
recording: arm
episodes: ["arm_*.csv"]
signals:
  joint: {unit: rad, columns: [q1, q2]}
  cable: {unit: m, written_in: mm, columns: [c1, c2, c3]}
  tension: {unit: N, columns: [f1, f2]}
"""


def samples(seed, seconds=SECONDS):
    """Return joints [rad], cables [m] and tensions [N] of a body whose signals are linear in two joints."""
    random, t = np.random.default_rng(seed), np.arange(0.0, seconds, 1.0 / RATE)[:, None]
    joint = sum(np.sin(random.uniform(0.5, 2.5, 2) * t + random.uniform(0.0, 6.0, 2)) for _ in range(3))
    cable = 0.3 + joint @ [[0.04, -0.03, 0.01], [0.0, 0.025, -0.035]]
    tension = 40.0 + joint @ [[8.0, 3.0], [-2.0, 6.0]]
    true = {"joint": joint, "cable": cable, "tension": tension}
    noise = {"joint": 0.004, "cable": 2e-4, "tension": 0.1}
    return {name: value + random.normal(0.0, noise[name], value.shape) for name, value in true.items()}


def write(path, rows, with_time):
    columns = [rows["joint"], 1e3 * rows["cable"], rows["tension"]]
    head = "q1,q2,c1,c2,c3,f1,f2"
    if with_time:
        columns.insert(0, np.arange(len(rows["joint"]))[:, None] / RATE)
        head = "t," + head
    np.savetxt(path, np.hstack(columns), "%.6f", ",", header=head, comments="")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Return a folder with a description and a model."""
    folder = tmp_path_factory.mktemp("inspect")
    masks = [("joint", "tension"), ("cable", "tension"), ("joint", "cable"), ("joint",), ("cable",)]
    data = [samples(seed, 90) for seed in range(3)]
    save(fit(data, TrainConfig(seed=0, epochs=20), masks, units=UNITS)[0], folder / "model")
    (folder / "arm.yaml").write_text(DESCRIPTION)
    (folder / "timed.yaml").write_text(DESCRIPTION + "time: {columns: t, gap: 0.5}\n")
    rows = samples(11)
    rows["cable"][LIES_FROM * RATE : LIES_UNTIL * RATE, 1] += 0.02
    for name, with_time in (("later_1.csv", True), ("plain.csv", False)):
        write(folder / name, rows, with_time)
    return folder


def run(folder, *words):
    result = CliRunner().invoke(app, ["inspect", *words, "--model", str(folder / "model")])
    return result.exit_code, " ".join(result.output.split())


def test_a_lie_is_printed_and_the_table_is_written_without_it(trained, tmp_path):
    code, text = run(
        trained, str(trained / "timed.yaml"), "--data", str(trained / "later_1.csv"), "--out", str(tmp_path)
    )
    assert code == 0
    assert "1 lie in 1 episode, 0.7 min at 10 rows per second." in text
    assert "│ later_1.csv │ 15.0 │" in text
    size = re.search(r"│ cable\.1 │ offset │ (\S+) m │", text)
    assert size is not None
    assert float(size[1]) == pytest.approx(0.02, rel=0.05)
    with (tmp_path / "000_later_1_csv.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[:4] == ["time [s]", "joint.0 [rad]", "joint.1 [rad]", "cable.0 [m]"]
    during = rows[LIES_FROM * RATE : LIES_UNTIL * RATE]
    assert all(row["estimated"] == "cable.1" for row in during)
    true = samples(11)["cable"][LIES_FROM * RATE : LIES_UNTIL * RATE, 1]
    assert np.abs([float(row["cable.1 [m]"]) for row in during] - true).max() < 0.002
    assert not any(row["estimated"] for row in rows[: (LIES_FROM - 1) * RATE])


@pytest.mark.long
def test_tables_without_a_time_need_their_rate(trained):
    words = (str(trained / "arm.yaml"), "--data", str(trained / "plain.csv"))
    code, text = run(trained, *words)
    assert (code, "give the rows per second with --rate." in text) == (1, True)
    assert run(trained, *words, "--rate", "10")[0] == 0


@pytest.mark.long
def test_a_folder_is_inspected_table_by_table(trained, tmp_path):
    for name in ("a.csv", "b.csv"):
        shutil.copy(trained / "later_1.csv", tmp_path / name)
    code, text = run(trained, str(trained / "timed.yaml"), "--data", str(tmp_path))
    assert code == 0
    assert "in 2 episodes" in text


@pytest.mark.parametrize(
    ("file", "data", "exit_code", "sentence"),
    [
        ("later_1.csv", "later_1.csv", 2, "holds data. Name the description that `gemuco train` used"),
        ("none.yaml", "later_1.csv", 2, "Name the description that `gemuco train` used."),
        ("robot.yaml", "later_1.csv", 2, "is no description of measured tables"),
        ("timed.yaml", "walk.mcap", 1, "is a recording of a robot; `gemuco export` writes it as a table."),
        ("timed.yaml", "nowhere", 1, "There is no file or folder"),
        ("timed.yaml", "nowhere.csv", 1, "Name the tables to inspect with --data."),
    ],
)
def test_a_wrong_file_is_refused_in_a_sentence(trained, file, data, exit_code, sentence):
    (trained / "walk.mcap").write_bytes(b"\x89MCAP0\r\n")
    (trained / "robot.yaml").write_text("robot: arm\n")
    code, text = run(trained, str(trained / file), "--data", str(trained / data))
    assert code == exit_code
    assert sentence in text


def test_tables_of_different_rates_are_not_mixed(trained, tmp_path):
    lines = (trained / "later_1.csv").read_text().splitlines()
    (tmp_path / "thin.csv").write_text("\n".join([lines[0], *lines[1::2]]) + "\n")
    words = [str(trained / "timed.yaml"), "--data", str(trained / "later_1.csv"), "--data", str(tmp_path / "thin.csv")]
    code, text = run(trained, *words)
    assert code == 1
    assert "The tables have 5 to 10 rows per second" in text


def a_lie(start, end, *elements, is_hidden=True):
    return Lie(elements, "element", "frozen", start, end, 0.3, is_hidden, "")


def test_a_lie_that_goes_on_in_the_next_episode_of_its_table_is_one():
    lies = _Lies(["a.csv", "a.csv", "a.csv", "b.csv", "b.csv"])
    lies.add(0, [a_lie(0.4, 1.0, "joint.0"), a_lie(0.1, 0.5, "joint.1")], 1.0)
    lies.add(1, [a_lie(0.0, 2.0, "joint.0"), a_lie(0.0, 2.0, "joint.1")], 2.0)  # joint.1 was right in between
    lies.add(2, [a_lie(0.0, 0.7, "joint.0"), a_lie(0.3, 1.0, "joint.1")], 1.0)
    lies.add(3, [a_lie(0.0, 1.0, "joint.1")], 1.0)  # another table
    lies.add(4, [a_lie(0.0, 1.0, "joint.1", is_hidden=False)], 1.0)
    rows = [(known.lie.elements[0], known.lie.start, known.lie.end, known.first, known.last) for known in lies.known]
    assert rows == [
        ("joint.0", 0.4, 0.7, 0, 2),
        ("joint.1", 0.1, 0.5, 0, 0),
        ("joint.1", 0.0, 2.0, 1, 1),
        ("joint.1", 0.3, 1.0, 2, 2),
        ("joint.1", 0.0, 1.0, 3, 3),
        ("joint.1", 0.0, 1.0, 4, 4),
    ]
    assert [lies._label(known) for known in lies.known[:2]] == ["a.csv, 0 to 2", "a.csv, 0"]


def test_a_table_of_one_episode_is_named_without_a_number():
    lies = _Lies(["a.csv", "b.csv"])
    lies.add(1, [a_lie(0.0, 1.0, "joint.1")], 1.0)
    assert lies._label(lies.known[0]) == "b.csv"
