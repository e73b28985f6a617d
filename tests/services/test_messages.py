from collections.abc import Mapping
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.wire import keys, messages
from services.wire.messages import (
    MAX_BYTES,
    Anomaly,
    Applied,
    Command,
    Estimates,
    Holder,
    Message,
    MessageError,
    Sample,
    Status,
    Target,
    Update,
)  # fmt: skip

VALUES = {"joint_position": np.array([0.1, np.nan]), "muscle_tension": np.array([1.0])}
TRUTH = {"joint_position": np.array([True, False]), "muscle_tension": np.array([True])}
AGES = {"joint_position": np.array([0.001, np.inf]), "muscle_tension": np.array([0.0])}
EXAMPLES: list[Message] = [
    Sample(stamp_ns=5, seq=3, boot=2**53, cycle=7, source="can", complete=True, values=VALUES, age=AGES, valid=TRUTH),
    Command(signal="muscle_length", values=np.arange(3.0), cycle=7, hal_boot=11),
    Applied(
        cycle=7, mode="follow", signal="muscle_length", desired=np.arange(3.0), values=np.full(3, np.nan),
        limited_by=["rate"], sender=4,
    ),
    Estimates(
        cycle=-1, values=VALUES, estimated=TRUTH, std=VALUES,
        method={"joint_position": "mask", "muscle_tension": "measured"},
        mask={"joint_position": "muscle_length+muscle_tension", "muscle_tension": ""},
        residual={"joint_position": 0.5, "muscle_tension": 0.0},
    ),
    Anomaly(
        cycle=1, score=float("nan"), threshold=3.0, is_anomaly=False, blamed="muscle_tension.biceps",
        contribution=VALUES,
    ),
    Update(active=True, model_version=2, window=20, dropped=3, loss=0.25),
    Target(signal="joint_position", values=np.zeros(5)),
    Status(service="hal", state="running", loops={"hal": {"rate": 200.0}}, facts={"buses": {"can0": [1, "ok", None]}}),
    Holder(name="anna@ws1 (pid 7)", holder=2**52, through=9, left=0.5),
]  # fmt: skip


def _same(left: object, right: object) -> bool:
    if isinstance(left, Mapping) and isinstance(right, Mapping):
        return left.keys() == right.keys() and all(_same(left[key], right[key]) for key in left)
    if isinstance(left, np.ndarray | float) and isinstance(right, np.ndarray | float):
        return np.array_equal(left, right, equal_nan=True)
    return left == right


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: message.TYPE)
def test_every_message_comes_back(message: Message) -> None:
    for back in (
        messages.decode(messages.encode(message), type(message)),
        messages.decode_any(messages.encode(message)),
    ):
        assert type(back) is type(message)
        assert back.v == messages.VERSION
        for name in set(message.__struct_fields__) - {"v"}:
            assert _same(getattr(message, name), getattr(back, name)), name


def test_there_is_an_example_of_every_message() -> None:
    assert {message.TYPE for message in EXAMPLES} == set(messages.RECORDS)


def test_the_type_on_the_wire_is_the_record_s() -> None:
    for message in EXAMPLES:
        assert msgpack.unpackb(messages.encode(message))["type"] == message.TYPE


@pytest.mark.parametrize(("wire", "read"), [(b"\0\1\1", [False, True, True]), (b"\0\2\xff", [False, True, True])])
def test_any_byte_but_zero_is_true(wire: bytes, read: list[bool]) -> None:
    body = msgpack.unpackb(messages.encode(EXAMPLES[0])) | {"valid": wire}
    valid = messages.decode(msgpack.packb(body), Sample).valid.flat
    assert valid.dtype == bool
    assert valid.tolist() == read
    assert valid.sum() == 2


def test_numpy_scalars_travel_as_numbers() -> None:
    status = Status(
        service="hal", state="running", facts={"n": np.int64(3), "x": [np.float32(0.5)], "ok": np.bool_(True)}
    )
    assert messages.decode(messages.encode(status), Status).facts == {"n": 3, "x": [0.5], "ok": True}


def test_header_replaces_sequence_and_boot() -> None:
    back = messages.decode(messages.encode(EXAMPLES[5], seq=9, boot=8), Update)
    assert (back.seq, back.boot) == (9, 8)


def _command(**change: object) -> bytes:
    body = msgpack.unpackb(messages.encode(EXAMPLES[1]))
    return msgpack.packb({name: value for name, value in (body | change).items() if value is not None})


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "not msgpack"),
        (b"\xc1", "not msgpack"),
        (b"\x81\xa1a", "not msgpack"),
        (b"\x91" * 5000, "not msgpack"),
        (msgpack.packb({1: 2}), "got None"),
        (msgpack.packb({"type": "command", "v": 2, 1: 2}), "malformed: Expected `str`"),
        (msgpack.packb([1, 2]), "got list"),
        (msgpack.packb({}), "got None"),
        (messages.encode(EXAMPLES[6]), "got 'target'"),
        (_command(v=3), "has version 3; this program reads 2"),
        (_command(v=None), "has version 0; this program reads 2"),
        (_command(values=None), "missing required field `values`"),
        (_command(values=[1.0, 2.0]), r"Expected a binary of little-endian float64 - at `\$.values`"),
        (_command(values=b"1234567"), "Expected a binary of little-endian float64"),
        (_command(signal=3), r"Expected `str`, got `int` - at `\$.signal`"),
        (_command(cycle=True), "Expected `int`, got `bool`"),
        (_command(cycle=1.0), "Expected `int`, got `float`"),
        (b"\x00" * (MAX_BYTES + 1), "over the limit"),
    ],
)
def test_what_is_no_command_says_why(data: bytes, says: str) -> None:
    with pytest.raises(MessageError, match=says):
        messages.decode(data, Command)


def test_unknown_type_lists_the_known_ones() -> None:
    with pytest.raises(MessageError, match=r"no message type 'wish'. Known types: sample, command"):
        messages.decode_any(msgpack.packb({"type": "wish", "v": 2}))


def test_unknown_fields_are_ignored() -> None:
    assert messages.decode(_command(added_later=1), Command).cycle == 7


@settings(max_examples=300)
@given(st.integers(0, len(EXAMPLES) - 1), st.data())
def test_damaged_bytes_never_raise_anything_else(which: int, data: st.DataObject) -> None:
    wire = bytearray(messages.encode(EXAMPLES[which]))
    for _ in range(data.draw(st.integers(1, 4))):
        wire[data.draw(st.integers(0, len(wire) - 1))] = data.draw(st.integers(0, 255))
    try:
        messages.decode_any(bytes(wire))
    except MessageError as error:
        assert len(str(error)) < 400


def test_a_key_comes_apart_again() -> None:
    assert keys.parse(keys.verb("arm", "hal", "enable")) == ("arm", "hal", "do/enable")
    for bad in ("", "gemuco", "gemuco/arm", "gemuco/arm/hal/", "other/arm/hal/sample", "gemuco//hal/sample"):
        with pytest.raises(ValueError, match="not a gemuco key"):
            keys.parse(bad)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"valid": b""}, "Expected 3 elements in 'valid', found 0"),
        ({"age": bytes(16)}, "Expected 3 elements in 'age', found 2"),
        ({"age": bytes(25)}, "Expected a binary of little-endian float64"),
        ({"elements": {"joint_position": 2}}, "Expected 2 elements in 'values', found 3"),
        ({"elements": {}}, "Expected 0 elements in 'values', found 3"),
        ({"elements": {"joint_position": 3, "muscle_tension": 0}}, "number of elements, at least 1"),
        ({"elements": {"joint_position": [3]}}, "number of elements, at least 1"),
        ({"elements": {"joint_position": 2.5}}, "number of elements, at least 1"),
        ({"elements": {1: 3}}, "malformed"),
        ({"elements": ["joint_position", 3]}, "map from signal to its number of elements"),
    ],
)
def test_a_sample_that_does_not_agree_with_itself_is_none(change: dict[str, object], said: str) -> None:
    body = msgpack.unpackb(messages.encode(EXAMPLES[0])) | change
    with pytest.raises(MessageError, match=said):
        messages.decode(msgpack.packb(body), Sample)


def test_a_sample_that_does_not_tell_whose_its_elements_are_is_none() -> None:
    body = msgpack.unpackb(messages.encode(EXAMPLES[0]))
    del body["elements"]
    with pytest.raises(MessageError, match="Expected a map 'elements'"):
        messages.decode(msgpack.packb(body), Sample)


def test_a_message_is_as_it_was_after_it_was_sent() -> None:
    sample = EXAMPLES[0]
    before = sample.elements, sample.values, sample.valid
    first = messages.encode(sample)
    assert (sample.elements, sample.values, sample.valid) == before
    assert messages.encode(sample) == first


@pytest.mark.parametrize("field", ["method", "mask", "residual"])
def test_what_is_told_of_signals_is_told_of_all_of_them(field: str) -> None:
    body = msgpack.unpackb(messages.encode(EXAMPLES[3]))
    del body[field]["muscle_tension"]
    with pytest.raises(MessageError, match=f"the same signals in '{field}'"):
        messages.decode(msgpack.packb(body), Estimates)


@pytest.mark.parametrize(
    ("field", "content"),
    [("valid", {}), ("age", AGES | {"elbow": np.zeros(1)}), ("age", AGES | {"joint_position": np.zeros(3)})],
)
def test_a_sample_is_not_made_of_what_does_not_agree(field: str, content: object) -> None:
    parts: dict[str, Any] = {"values": VALUES, "age": AGES, "valid": TRUTH} | {field: content}
    with pytest.raises(ValueError, match=f"in '{field}'"):
        Sample(cycle=1, source="can", complete=True, **parts)


def test_the_order_of_signals_is_that_of_the_values() -> None:
    sample = Sample(
        cycle=1, source="can", complete=True, values=VALUES, age=dict(reversed(AGES.items())),
        valid=dict(reversed(TRUTH.items())),
    )  # fmt: skip
    assert sample.age.flat.tolist() == [*AGES["joint_position"], *AGES["muscle_tension"]]
    assert sample.valid.elements is sample.values.elements is sample.elements


def test_signals_of_the_same_sizes_are_the_same_object_in_every_message() -> None:
    first, second = (messages.decode(messages.encode(EXAMPLES[0]), Sample) for _ in range(2))
    assert first.elements is second.elements
    assert first.elements.counts == {"joint_position": 2, "muscle_tension": 1}
