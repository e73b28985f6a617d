"""Recordings of other hands: whatever stands in a file, the reader answers in one sentence."""

import json
from pathlib import Path

import pytest
from recorded_arm import record

from services.errors import ServiceError
from services.recording import file
from services.recording.export import export
from services.recording.reading import facts_of, read

DEEP = b"[" * 100_000
CASES = {
    "schema is no JSON": ("schema", b"{"),
    "schema is nested deeply": ("schema", DEEP),
    "schema is a list": ("schema", b"[]"),
    "schema is no text": ("schema", b"\xff\xfe"),
    "schema is empty": ("schema", b""),
    "signals are a list": ("schema", b'{"x-signals": []}'),
    "signals have no unit": ("schema", b'{"x-signals": {"joint_position": {"elements": ["a"]}}}'),
    "elements are a number": ("schema", b'{"x-signals": {"joint_position": {"unit": "rad", "elements": 3}}}'),
    "robot is nested deeply": ("facts", DEEP),
    "robot is a list": ("facts", b"[]"),
    "robot is no JSON": ("facts", b"{"),
    "robot has no signals": ("facts", b"{}"),
    "message is nested deeply": ("message", DEEP),
    "message is a list": ("message", b"[]"),
    "message is a number": ("message", b"1"),
}


@pytest.mark.parametrize("case", CASES.values(), ids=list(CASES))
def test_what_is_malformed_is_one_sentence(
    case: tuple[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where, bad = case
    writer = file.Writer
    if where == "schema":
        make = writer.register_schema
        monkeypatch.setattr(writer, "register_schema", lambda self, name, kind, _: make(self, name, kind, bad))
    elif where == "facts":
        add = writer.add_metadata
        monkeypatch.setattr(
            writer, "add_metadata", lambda self, name, facts: add(self, name, _with(facts, bad.decode()))
        )
    else:
        put = writer.add_message
        monkeypatch.setattr(
            writer, "add_message", lambda self, channel, log, _, *rest: put(self, channel, log, bad, *rest)
        )
    files = record(tmp_path / "run.mcap", "arm", 3)
    with pytest.raises(ServiceError) as caught:
        for found in facts_of(files):
            _ = found.catalogue
        list(read(files))
    assert "\n" not in str(caught.value) and str(caught.value).endswith(".")
    if where != "facts":  # tables need no facts of the robot
        with pytest.raises(ServiceError):
            export(files, tmp_path / "tables", "csv")
    assert not (tmp_path / "tables").exists() or not list((tmp_path / "tables").iterdir()), "no table that looks whole"


def _with(facts: dict[str, str], bad: str) -> dict[str, str]:
    return facts | {"describe": bad} if "describe" in facts else facts


def test_a_whole_one_is_read(tmp_path: Path) -> None:
    files = record(tmp_path / "run.mcap", "arm", 3)
    assert len(list(read(files))) == 9
    assert json.dumps(facts_of(files)[0].catalogue.plain())
    export(files, tmp_path / "tables", "csv")
    assert {path.suffix for path in (tmp_path / "tables").iterdir()} == {".csv"}
