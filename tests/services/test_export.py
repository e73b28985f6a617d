import csv
import sys
from pathlib import Path

import numpy as np
import pytest
from any_message import ARM, a_message
from recorded_arm import a_sample, record

from services.errors import RecordingError
from services.recording import export as exporting
from services.recording.export import export, run_export
from services.recording.writer import Limits, RecordingWriter
from services.wire import keys, messages
from services.wire.records import Estimates, Sample, Status, Target, Update


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_table_per_key_with_a_column_per_element_and_its_unit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exporting, "ROWS", 7)
    files = record(tmp_path / "run.mcap", "arm", 50, limits=Limits(max_seconds=0.2))
    tables = export(files[::-1], tmp_path / "out", "csv")
    assert {path.name: rows for path, rows in tables.items()} == {
        "hal.sample.csv": 50, "hal.applied.csv": 50, "hal.command.csv": 50,
    }  # fmt: skip
    rows = _rows(tmp_path / "out" / "hal.sample.csv")
    for number, row in enumerate(rows):
        sample = a_sample(number)
        assert int(row["cycle"]) == number and row["source"] == "can" and row["complete"] == "True"
        assert int(row["stamp [ns]"]) == sample.stamp_ns < int(row["received [ns]"])
        for index, element in enumerate(("elbow", "wrist")):
            assert float(row[f"joint_position.{element} [rad]"]) == sample.values["joint_position"][index]
            assert float(row[f"age.joint_position.{element} [s]"]) == 0.001
            assert row[f"valid.joint_position.{element}"] == "True"
        assert float(row["muscle_tension.biceps [N]"]) == sample.values["muscle_tension"][0]
    applied = _rows(tmp_path / "out" / "hal.applied.csv")[3]
    assert (applied["mode"], applied["muscle_tension.biceps [N]"], applied["desired.muscle_tension.biceps [N]"]) == (
        "follow", "3.0", "3.0",
    )  # fmt: skip
    assert applied["limited_by"] == '["rate"]' and "joint_position.elbow [rad]" not in applied


def test_parquet_holds_the_same_numbers(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    files = record(tmp_path / "run.mcap", "arm", 50)
    tables = export(files, tmp_path / "out", "parquet")
    table = parquet.read_table(tmp_path / "out" / "hal.sample.parquet")
    assert tables[tmp_path / "out" / "hal.sample.parquet"] == table.num_rows == 50
    found = table.column("joint_position.wrist [rad]").to_numpy()
    np.testing.assert_array_equal(found, [a_sample(number).values["joint_position"][1] for number in range(50)])
    assert [str(table.schema.field(name).type) for name in ("stamp [ns]", "complete", "source")] == [
        "int64", "bool", "string",
    ]  # fmt: skip


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_every_kind_of_message_and_gaps_can_be_written(tmp_path: Path, form: str) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap", "arm", ARM)
    writer.open(0)
    sample = a_message(Sample)
    assert isinstance(sample, Sample)
    sample.values["joint_position"][1] = np.nan
    for seq in range(3):
        for key, message in (
            (keys.sample("arm"), sample), (keys.estimate("arm"), a_message(Estimates)),
            (keys.update("arm"), a_message(Update)), (keys.status("arm", "hal"), a_message(Status)),
            (keys.target("arm"), a_message(Target)),
            (keys.target("arm"), Target(signal="muscle_tension", values=np.array([1.0]))),
            (keys.vision("arm"), Sample(cycle=1, source="camera", complete=True, values={}, age={}, valid={})),
        ):  # fmt: skip
            writer.add(key, seq + 1, messages.encode(message, seq=seq))
    writer.finish(9)
    tables = export(writer.paths, tmp_path / "out", form)
    assert set(tables.values()) == {3}
    names = {path.name.rpartition(".")[0] for path in tables}
    assert names == {
        "hal.sample", "model.estimate", "model.update", "hal.status", "model.target", "model.target-2", "vision.sample",
    }  # fmt: skip
    if form == "csv":
        assert _rows(tmp_path / "out" / "hal.sample.csv")[0]["joint_position.wrist [rad]"] == ""
        assert _rows(tmp_path / "out" / "model.estimate.csv")[0]["method.joint_position"] == "mask"
        assert _rows(tmp_path / "out" / "hal.status.csv")[0]["loops"].startswith('{"hal": ')


def test_what_cannot_be_exported_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = record(tmp_path / "run.mcap", "arm", 10)
    with pytest.raises(RecordingError, match="'xls' is not a format of tables"):
        export(files, tmp_path / "out", "xls")
    run_export(files, tmp_path / "out", "csv")
    assert f"10 rows in {tmp_path / 'out' / 'hal.sample.csv'}" in capsys.readouterr().out
    with pytest.raises(RecordingError, match="they are not replaced"):
        export(files, tmp_path / "out", "csv")
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match=r"cannot be written|they are not replaced"):
        export(files, tmp_path / "file" / "out", "csv")


def test_without_pyarrow_parquet_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = record(tmp_path / "run.mcap", "arm", 10)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(RecordingError, match=r"pip install 'gemuco\[parquet\]'"):
        export(files, tmp_path / "out", "parquet")
