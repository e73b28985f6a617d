import os
from pathlib import Path

import numpy as np
import pytest

from gemuco.errors import DatasetError
from hal.config import load_robot
from hal.errors import ConfigError
from services.measured.description import is_description, load_measured
from services.measured.reading import read_measured

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("GEMUCO_DATA", ROOT.parent / "shared" / "data"))
HEAD = "recording: rig\nepisodes: '*.csv'\n"
SIGNALS = "signals:\n  angle: {unit: rad, written_in: deg, columns: 'a{0..1}'}\n  load: {unit: N, columns: load}\n"


def describe(folder: Path, text: str = HEAD + SIGNALS) -> Path:
    path = folder / "rig.yaml"
    path.write_text(text)
    return path


def table(folder: Path, *lines: str, name: str = "one.csv") -> None:
    (folder / name).write_text("\n".join(("a0,a1,load,t", *lines)) + "\n")


def test_columns_are_gathered_and_converted(tmp_path):
    table(tmp_path, "180,0,1,0.0", "90,,nan,0.1")
    config = load_measured(describe(tmp_path))
    data = read_measured(config, tmp_path)
    assert data.layout.signal("angle").elements == ("a0", "a1")
    assert data.layout.signal("angle").unit == "rad"
    np.testing.assert_allclose(data.rows(), [[np.pi, 0.0, 1.0], [np.pi / 2, np.nan, np.nan]])
    assert data.conditions == ("rig",)


def test_files_in_a_folder_without_header_are_one_episode_each(tmp_path):
    for index, rows in enumerate((3, 2)):
        folder = tmp_path / f"run_{index}"
        folder.mkdir()
        np.savetxt(folder / "state.csv", np.arange(2.0 * rows).reshape(rows, 2), delimiter=";")
        np.savetxt(folder / "input.csv", np.arange(1.0 * rows)[: rows - index], delimiter=";")
    text = (
        "recording: rig\nepisodes: run_*\nheader: false\nseparator: ';'\nconditions: {run_0: light, 'run_*': heavy}\n"
    )
    text += (
        "signals:\n  x: {unit: m, file: state.csv, columns: '{0..1}'}\n  f: {unit: N, file: input.csv, columns: 0}\n"
    )
    with pytest.raises(DatasetError, match=r"different numbers of rows: state\.csv 2, input\.csv 1.*cut_to_shortest"):
        read_measured(load_measured(describe(tmp_path, text)), tmp_path)
    data = read_measured(load_measured(describe(tmp_path, text + "cut_to_shortest: true\n")), tmp_path)
    assert [len(e.values["x"]) for e in data.episodes] == [3, 1]
    assert [e.condition for e in data.episodes] == ["light", "heavy"]


def test_a_pause_or_a_step_back_begins_an_episode(tmp_path):
    table(tmp_path, *(f"0,0,0,{t}" for t in (0.0, 0.1, 5.0, 5.1, 5.2, 1.0)))
    config = load_measured(describe(tmp_path, HEAD + SIGNALS + "time: {columns: t, gap: 1.0}\n"))
    assert [len(e.values["load"]) for e in read_measured(config, tmp_path).episodes] == [2, 3, 1]


def test_repetitions_become_one_episode(tmp_path):
    for index in range(4):
        table(tmp_path, *["0,0,0,0"] * (index + 1), name=f"{index}.csv")
    text = HEAD + SIGNALS + "together: [['1.csv', '3.csv']]\n"
    data = read_measured(load_measured(describe(tmp_path, text)), tmp_path)
    assert [len(e.values["load"]) for e in data.episodes] == [6, 1, 3]
    with pytest.raises(DatasetError, match="match seven do not exist"):
        read_measured(load_measured(describe(tmp_path, text.replace("'1.csv', '3.csv'", "seven"))), tmp_path)


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        ((), r"one\.csv' is empty"),
        (
            ("1,2,3,0", "1,2", "1", "1,2,3,0"),
            r"line 3 has 2 columns; the header has 4\. Is the separator ','.*2 of 4 rows",
        ),
        (("1,2,many,0",), r"line 2, column 'load': 'many' is not a number\. An empty cell means"),
    ],
)
def test_bad_rows_are_one_sentence(tmp_path, lines, sentence):
    table(tmp_path, *lines)
    with pytest.raises(DatasetError, match=sentence):
        read_measured(load_measured(describe(tmp_path)), tmp_path)


def test_missing_columns_and_files_are_one_sentence(tmp_path):
    config = load_measured(describe(tmp_path))
    with pytest.raises(DatasetError, match=r"Nothing in '.*' matches '\*\.csv'\. Is this the folder"):
        read_measured(config, tmp_path)
    (tmp_path / "one.csv").write_text("a0,a1\n1,2\n")
    with pytest.raises(DatasetError, match=r"no column 'load'\. Columns: a0, a1"):
        read_measured(config, tmp_path)
    (tmp_path / "one.csv").write_bytes(b"PK\x03\x04\x00\x00\x01")
    with pytest.raises(DatasetError, match="is not a text file"):
        read_measured(config, tmp_path)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (HEAD + "signals: {a: {unit: deg, columns: x}}", "'deg' is not the unit of the model; write unit: rad and"),
        (
            HEAD + "signals: {a: {unit: N, written_in: deg, columns: x}}",
            "'deg' cannot be converted to 'N'; to 'N' can be converted: mN, kN",
        ),
        (HEAD + "signals: {a: {unit: N, colums: x}}", "unknown key 'signals.a.colums'. Known keys there: columns"),
        (HEAD, "'signals' is missing; a description needs recording, episodes and signals"),
        (HEAD + "signals: {a: x}", "signals.a: a signal needs a unit, such as {unit: rad, columns: q}"),
        (HEAD + SIGNALS + "conditions: [light]", "'conditions' is a mapping, such as {\"run_1*\": light"),
        ("nothing", "is not a description of data"),
        ("a: [", "is not YAML"),
    ],
)
def test_a_wrong_description_is_one_sentence(tmp_path, text, sentence):
    with pytest.raises(ConfigError) as raised:
        load_measured(describe(tmp_path, text))
    assert sentence in str(raised.value)


def test_descriptions_and_robots_are_told_apart():
    assert is_description(ROOT / "examples" / "joint_capsule.yaml")
    robot = ROOT / "robots" / "musashi_arm.yaml"
    assert load_robot(robot)
    assert not is_description(robot)
    assert not is_description(ROOT / "robots" / "none.yaml")


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings in {DATA}; name their folder in GEMUCO_DATA")
@pytest.mark.parametrize(("name", "samples", "episodes"), [("joint_capsule", 1263, 1), ("schunk_arm", 18720, 20)])
def test_shipped_descriptions_fit_the_recordings(name, samples, episodes):
    data = read_measured(load_measured(ROOT / "examples" / f"{name}.yaml"), DATA / name)
    assert (len(data), len(data.episodes)) == (samples, episodes)
    assert np.isfinite(data.rows()).all()


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings in {DATA}; name their folder in GEMUCO_DATA")
def test_repeated_trajectories_of_a_recording_are_found():
    notes = {
        name: " ".join(read_measured(load_measured(ROOT / "examples" / f"{name}.yaml"), DATA / name).repetitions())
        for name in ("schunk_arm", "joint_capsule")
    }
    assert "its 20 episodes are 6 motions (15 episodes are nearly equal)" in notes["schunk_arm"]
    assert "The path of joint_effort is the same everywhere" in notes["schunk_arm"]
    assert notes["joint_capsule"] == ""
