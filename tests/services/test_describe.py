"""A description drafted from the data alone, from which `gemuco train` reads them again."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gemuco.errors import DatasetError
from services.cli import app
from services.measured.column_groups import Column, grouped, unit_in
from services.measured.description import load_measured
from services.measured.draft import MARK, draft
from services.measured.reading import read_measured

DATA = Path(os.environ.get("GEMUCO_DATA", Path(__file__).parents[3] / "shared" / "data"))
ROWS = 200


def table(folder: Path, head: str, name: str = "run.csv", separator: str = ",", rows: int = ROWS) -> Path:
    """Write a column for each name: t and i are a time and a counter, dead is constant, others are random."""
    random = np.random.default_rng(len(name))
    lines = [head]
    for row in range(rows):
        special = {"t": f"{0.02 * row:.2f}", "i": str(row), "dead": "5.0", "mode": "walk"}
        names = [part.split(" ")[0] for part in head.split(separator)]
        lines.append(separator.join(special.get(part, f"{random.normal():.5f}") for part in names))
    path = folder / name
    path.write_text("\n".join(lines) + "\n")
    return path


def groups_of(*labels: str) -> dict[str, tuple[list[str], str | None]]:
    columns = [Column(None, label, np.random.default_rng(0).normal(size=9)) for label in labels]
    return {group.name: ([c.label for c in group.columns], group.unit) for group in grouped(columns, "run")}


@pytest.mark.parametrize(
    ("labels", "signals"),
    [
        (["q0", "q1", "q2", "load"], {"q": (["q0", "q1", "q2"], "rad"), "load": (["load"], None)}),
        (
            ["a0_d0", "a0_d1", "a1_d0", "a1_d1"],
            {"a0_d": (["a0_d0", "a0_d1"], None), "a1_d": (["a1_d0", "a1_d1"], None)},
        ),
        (["rpy_x_deg", "rpy_y_deg"], {"rpy": (["rpy_x_deg", "rpy_y_deg"], "deg")}),
        (["tcp_x [mm]", "tcp_y [mm]"], {"tcp": (["tcp_x [mm]", "tcp_y [mm]"], "mm")}),
        (["j.a [rad]", "j.b [rad]", "f.a [N]"], {"j": (["j.a [rad]", "j.b [rad]"], "rad"), "f_a": (["f.a [N]"], "N")}),
        (["hip_torque", "knee_torque"], {"torque": (["hip_torque", "knee_torque"], "N m")}),
        (["voltage_v"], {"voltage": (["voltage_v"], "V")}),
        (["link_a", "link_v"], {"link": (["link_a", "link_v"], None)}),
        (["battery_a", "battery_v"], {"battery_a": (["battery_a"], "A"), "battery_v": (["battery_v"], "V")}),
        (["motor_rpm", "motor_a"], {"motor_rpm": (["motor_rpm"], "rpm"), "motor_a": (["motor_a"], "A")}),
        (["bus_a", "bus_b"], {"bus": (["bus_a", "bus_b"], None)}),
        (["current_a", "current_b", "current_c"], {"current": (["current_a", "current_b", "current_c"], "A")}),
    ],
)
def test_columns_are_grouped_by_their_names(labels, signals):
    assert groups_of(*labels) == signals


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("angle [deg]", ("angle", "deg")),
        ("velocity (rad/s)", ("velocity", "rad/s")),
        ("m_torque_Nm", ("m_torque", "N m")),
        ("act_vel_deg_per_s", ("act_vel", "deg/s")),
        ("yaw_rate_radps", ("yaw_rate", "rad/s")),
        ("acc_x_mps2", ("acc_x", "m/s^2")),
        ("gps_speed_mps", ("gps_speed", "m/s")),
        ("wheel_fl_kmh", ("wheel_fl", "km/h")),
        ("position[0]", ("position[0]", None)),
        ("arm", ("arm", None)),
    ],
)
def test_a_unit_is_read_from_a_name(name, parts):
    assert unit_in(name) == parts


def test_large_angles_are_in_degrees():
    columns = [Column(None, f"q{k}", np.linspace(-90.0, 90.0, 9)) for k in range(2)]
    assert grouped(columns, "run")[0].unit == "deg"


def test_columns_without_names_are_divided_where_one_block_is_the_rate_of_another():
    t = np.linspace(0.0, 9.0, 500)
    q = [np.sin((k + 1) * t) for k in range(3)]
    rates = [np.gradient(x, t) for x in q]
    other = list(np.random.default_rng(0).normal(size=(3, 500)))
    columns = [Column(None, str(k), x) for k, x in enumerate([*q, *rates, *other])]
    names = [(group.name, len(group.columns)) for group in grouped(columns, "arm")]
    assert names == [("arm", 3), ("arm_rate", 3), ("arm_6", 3)]


def test_a_draft_is_read_as_it_is(tmp_path):
    table(tmp_path, "t,i,q0 [deg],q1 [deg],load,dead,mode")
    result = draft([tmp_path / "run.csv"])
    (tmp_path / "run.yaml").write_text(result.text())
    config = load_measured(tmp_path / "run.yaml")
    data = read_measured(config, tmp_path)
    assert [(s.name, s.size, s.unit) for s in data.layout.signals] == [("q", 2, "rad"), ("load", 1, "1")]
    assert len(data) == ROWS
    assert result.unknown == ["load"]
    assert MARK in result.text()
    assert config.time is not None and config.time.gap == 0.2
    assert result.unused == {
        "mode": "holds text",
        "i": "counts the rows",
        "dead": "never varies or was never measured",
    }


@pytest.mark.parametrize(("separator", "decimal"), [(";", ","), ("\t", "."), (" ", "."), ("|", ".")])
def test_the_form_of_a_text_file_is_guessed(tmp_path, separator, decimal):
    path = table(tmp_path, separator.join(("t", "q0", "q1", "f")), separator=separator)
    path.write_text(path.read_text().replace(".", decimal), encoding="utf-16")
    result = draft([path])
    assert (result.recording.style.separator, result.recording.style.decimal) == (separator, decimal)
    assert result.recording.style.header
    (tmp_path / "run.yaml").write_text(result.text())
    assert len(read_measured(load_measured(tmp_path / "run.yaml"), tmp_path)) == ROWS


@pytest.mark.parametrize(
    ("head", "scale", "start", "unit"),
    [("t [ms]", 1e3, 0.0, "ms"), ("t", 1e9, 1.7e9, "ns"), ("t", 1.0, 1.7e9, "s"), ("t", 1e3, 0.0, "ms")],
)
def test_the_unit_of_the_time_is_guessed(tmp_path, head, scale, start, unit):
    random = np.random.default_rng(0)
    rows = [f"{scale * (start + 0.05 * k):.0f},{random.normal()},{random.normal()}" for k in range(100)]
    if unit == "s":
        rows = [f"{start + 0.05 * k:.3f},{random.normal()},{random.normal()}" for k in range(100)]
    (tmp_path / "run.csv").write_text("\n".join((f"{head},a,b", *rows)))
    clock = draft([tmp_path / "run.csv"]).clock
    assert clock is not None
    assert clock.unit == unit
    assert clock.rate == pytest.approx(20.0, rel=1e-3)


def test_pauses_steps_back_and_repeated_stamps_are_counted(tmp_path):
    t = np.concatenate([np.arange(50), np.arange(80, 120), [119], np.arange(30)]) * 0.1
    values = np.random.default_rng(0).normal(size=(len(t), 2))
    lines = [f"{stamp:.1f},{a},{b}" for stamp, (a, b) in zip(t, values, strict=True)]
    (tmp_path / "run.csv").write_text("\n".join(("time,a,b", *lines)))
    clock = draft([tmp_path / "run.csv"]).clock
    assert (clock.pauses, clock.back, clock.repeated, round(clock.longest, 1)) == (1, 1, 1, 3.1)


def test_files_of_one_call_are_one_pattern_and_an_existing_draft_is_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    for name in ("run_1.csv", "run_2.csv", "other.csv"):
        table(tmp_path / "data", "t,q0,q1,f", name)
    runner = CliRunner()
    done = runner.invoke(app, ["describe", "data/run_1.csv", "data/run_2.csv"])
    assert done.exit_code == 0, done.output
    assert "Next: gemuco train data.yaml\n" in done.output
    config = load_measured(tmp_path / "data.yaml")
    assert config.episodes == ("data/run_*.csv",)
    assert len(read_measured(config, tmp_path).episodes) == 2
    (tmp_path / "here").mkdir()
    aside = runner.invoke(app, ["describe", "data", "--out", "here/data.yaml"])
    assert f"Next: gemuco train here/data.yaml --data {tmp_path / 'data'}\n" in aside.output
    assert load_measured(tmp_path / "here" / "data.yaml").episodes == ("*.csv",)
    again = runner.invoke(app, ["describe", "data/run_1.csv", "data/run_2.csv"])
    assert again.exit_code == 1
    assert "'data.yaml' exists already. Remove it, or name another file with --out." in again.output
    assert draft([tmp_path / "data"]).recording.patterns == ("*.csv",)


def test_an_archive_gives_episodes_and_a_long_recording_is_thinned_out(tmp_path):
    random = np.random.default_rng(0)
    path = tmp_path / "day.npz"
    np.savez(
        path,
        trial=np.repeat(np.arange(5), 10_000),
        joint_position=random.normal(size=(50_000, 3)),
        load=random.normal(size=(1, 50_000)),
        gains=np.array([1.0, 2.0]),
        p=np.zeros((2, 2, 2)),
    )
    result = draft([path])
    (tmp_path / "day.yaml").write_text(result.text())
    data = read_measured(load_measured(tmp_path / "day.yaml"), tmp_path)
    assert len(data.episodes) == 5
    assert len(data) == 25_000
    assert [(s.name, s.size, s.unit) for s in data.layout.signals] == [("joint_position", 3, "rad"), ("load", 1, "1")]
    assert [note.partition(": ")[2] for note in result.recording.notes] == [
        "gains left out, because the other columns have 50000 rows."
    ]


def test_parquet_is_read(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    pyarrow = pytest.importorskip("pyarrow")
    random = np.random.default_rng(0)
    states = [list(map(float, row)) for row in random.normal(size=(50, 2))]
    names = {"t": np.arange(50) * 0.1, "q": states, "f": [None, *random.normal(size=49)]}
    parquet.write_table(pyarrow.table(names), tmp_path / "run.parquet")
    result = draft([tmp_path / "run.parquet"])
    (tmp_path / "run.yaml").write_text(result.text())
    data = read_measured(load_measured(tmp_path / "run.yaml"), tmp_path)
    assert [(s.name, s.elements) for s in data.layout.signals] == [("q", ("q_0", "q_1")), ("f", ("f",))]
    assert np.isnan(data.rows()[0, 2])


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("none.csv", None, "There is no file or folder"),
        ("a.xlsx", b"PK", r"cannot be read as a table\. Save the sheet as CSV\."),
        ("a.csv", b"\x00\x01\x02", "is not a text file of separated values"),
        ("a.csv", b"", "is empty"),
        ("a.csv", b"x,y\n1,2\n1,2\n", "No column of .* is a signal: x never varies"),
        ("a.npz", b"broken", "is not a readable NumPy file"),
        ("a.yaml", b"robot: x", "is no table"),
    ],
)
def test_what_cannot_be_described_is_one_sentence(tmp_path, name, content, sentence):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(DatasetError, match=sentence):
        draft([tmp_path / name])


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings in {DATA}; name their folder in GEMUCO_DATA")
@pytest.mark.parametrize(
    ("place", "sizes", "rate"),
    [
        ("joint_capsule/output_whole_all.csv", [16, 16, 16, 16, 3, 3, 4], 9.3),
        ("schunk_arm", [6, 6, 6], 250.0),
        ("kuka_kr300", [6] * 9, 250.0),
        ("pam_arm", [4, 4, 8, 8], None),
    ],
)
def test_real_recordings_are_drafted_as_they_were_made(tmp_path, place, sizes, rate):
    result = draft([DATA / place])
    (tmp_path / "draft.yaml").write_text(result.text())
    data = read_measured(load_measured(tmp_path / "draft.yaml"), result.recording.folder)
    assert [signal.size for signal in data.layout.signals] == sizes
    assert rate is None if result.clock is None else result.clock.rate == pytest.approx(rate, rel=0.01)
    assert np.isfinite(data.rows()).all()


def test_a_name_that_yaml_would_change_is_quoted(tmp_path):
    table(tmp_path, "t,on,no_load: x,y")
    text = draft([tmp_path / "run.csv"]).text()
    assert json.dumps("on") in text
    (tmp_path / "run.yaml").write_text(text)
    assert len(read_measured(load_measured(tmp_path / "run.yaml"), tmp_path)) == ROWS
