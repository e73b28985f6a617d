"""Recordings of other hands: whatever stands in a file, the reader answers in one sentence."""

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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


BAD_PARTS = (None, "x", [], {}, [[]], -1, True, 10**400, "\ud800")


def parts_of(content: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Places in a JSON value; of a list only the first."""
    yield place
    inner = (
        content.items() if isinstance(content, dict) else enumerate(content[:1]) if isinstance(content, list) else ()
    )
    for key, part in inner:
        yield from parts_of(part, (*place, key))


def with_part(content: Any, place: tuple[Any, ...], bad: Any) -> Any:
    """The value with another part at a place."""
    if not place:
        return bad
    changed = copy.copy(content)
    changed[place[0]] = with_part(content[place[0]], place[1:], bad)
    return changed


@pytest.mark.long
@pytest.mark.parametrize("where", ["schema", "message"])
def test_any_part_of_a_schema_or_message_may_be_wrong(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever stands in one place is read, or refused in a sentence."""
    wanted, bad, seen = "gemuco.Sample", None, b""
    make, put = file.Writer.register_schema, file.Writer.add_message

    def register_schema(self: Any, name: str, kind: str, data: bytes) -> int:
        nonlocal seen
        if name == wanted and where == "schema":
            seen, data = data, data if bad is None else bad
        return make(self, name, kind, data)

    def add_message(self: Any, channel: int, log: int, data: bytes, *rest: Any) -> None:
        nonlocal seen
        if where == "message" and data.startswith(b'{"type":"sample"'):
            seen, data = data, data if bad is None else bad
        put(self, channel, log, data, *rest)

    monkeypatch.setattr(file.Writer, "register_schema", register_schema)
    monkeypatch.setattr(file.Writer, "add_message", add_message)
    list(read(record(tmp_path / "whole.mcap", "arm", 1)))
    whole, refused = json.loads(seen), 0
    every = 5 if where == "schema" else 1  # most of its parts are words for people
    for number, place in enumerate(list(parts_of(whole))[::every]):
        for kind, part in enumerate(BAD_PARTS):
            bad = json.dumps(with_part(whole, place, part)).encode()
            files = record(tmp_path / f"{number}_{kind}.mcap", "arm", 1)
            try:
                list(read(files))
            except ServiceError as error:
                refused += 1
                assert "\n" not in str(error)
    assert refused > 20


def test_a_whole_one_is_read(tmp_path: Path) -> None:
    files = record(tmp_path / "run.mcap", "arm", 3)
    assert len(list(read(files))) == 9
    assert json.dumps(facts_of(files)[0].catalogue.plain())
    export(files, tmp_path / "tables", "csv")
    assert {path.suffix for path in (tmp_path / "tables").iterdir()} == {".csv"}
