"""What is written into a recording: the schema tells the truth, viewers can read it, and nothing is lost on the way."""

import json
import math
from typing import Any

import jsonschema
import msgpack
import numpy as np
import pytest
from any_message import ARM, a_message
from hypothesis import given, settings
from hypothesis import strategies as st

from services.recording.schema import Catalogue, Form, OtherLayout
from services.recording.writer import CARRIED
from services.wire import keys, messages
from services.wire.messages import RECORDS, MessageError
from services.wire.records import Anomaly, Applied, Estimates, Message, Sample, Status, Target, Update


def through(message: Message, catalogue: Catalogue = ARM) -> tuple[Message, dict[str, Any], dict[str, Any]]:
    """Written and read back; the JSON, and the schema."""
    form = Form(type(message), catalogue)
    data, _ = form.write(messages.encode(message))
    again = Form(type(message), Catalogue.of_schema(json.loads(json.dumps(form.schema))))
    return again.read(data), json.loads(data), form.schema


@pytest.mark.parametrize("record", RECORDS.values(), ids=list(RECORDS))
def test_every_message_comes_back_as_it_was_and_fits_its_schema(record: type[Message]) -> None:
    for number in (0.1, -math.pi, 5e-324, 1.7976931348623157e308, 0.0, -0.0, 1e22):
        message = a_message(record, number)
        back, plain, schema = through(message)
        assert messages.encode(back) == messages.encode(message)
        jsonschema.Draft202012Validator.check_schema(schema)
        jsonschema.validate(plain, schema)


@settings(deadline=None, max_examples=40)
@given(st.floats(), st.floats(), st.floats())
def test_numbers_come_back_bit_by_bit_and_gaps_as_gaps(first: float, second: float, residual: float) -> None:
    message = Estimates(
        cycle=1, values={"joint_position": np.array([first, second])}, residual={"joint_position": residual},
        estimated={"joint_position": np.array([True, False])}, std={"joint_position": np.array([second, 0.0])},
        method={"joint_position": "mask"}, mask={"joint_position": "a+b"},
    )  # fmt: skip
    back, plain, schema = through(message)
    jsonschema.validate(plain, schema)
    assert isinstance(back, Estimates)
    for was, now in ((first, back.values["joint_position"][0]), (second, back.std["joint_position"][0])):
        assert now == was and math.copysign(1, now) == math.copysign(1, was) if math.isfinite(was) else math.isnan(now)
    assert back.residual["joint_position"] == residual or not math.isfinite(residual)
    assert "nan" not in json.dumps(plain).lower() and "null" not in json.dumps(plain)


def test_a_value_that_was_not_measured_is_absent_and_comes_back_as_it_was() -> None:
    sample = Sample(
        cycle=4, source="can", complete=False, values={"joint_position": np.array([0.5, math.nan])},
        age={"joint_position": np.array([0.001, math.inf])}, valid={"joint_position": np.array([True, False])},
    )  # fmt: skip
    back, plain, _ = through(sample)
    assert plain["values"] == {"joint_position": {"elbow": 0.5}}
    assert plain["age"] == {"joint_position": {"elbow": 0.001}}
    assert plain["valid"] == {"joint_position": {"elbow": True, "wrist": False}}
    assert messages.encode(back) == messages.encode(sample)


def test_scalars_that_are_no_numbers_are_absent() -> None:
    anomaly = Anomaly(cycle=1, score=math.nan, threshold=3.0, is_anomaly=False, blamed="", contribution={})
    back, plain, schema = through(anomaly)
    assert "score" not in plain and isinstance(back, Anomaly) and math.isnan(back.score)
    jsonschema.validate(plain, schema)
    status = Status(service="hal", state="running", loops={"hal": {"rate": 200.0, "late_p50": math.nan}})
    back, plain, schema = through(status)
    assert plain["loops"] == {"hal": {"rate": 200.0}}
    jsonschema.validate(plain, schema)


def test_the_schema_names_every_element_with_its_unit_and_says_what_fields_mean() -> None:
    schema = Form(Sample, ARM).schema
    values = schema["properties"]["values"]["properties"]
    assert list(values["joint_position"]["properties"]) == ["elbow", "wrist"]
    assert values["joint_position"]["properties"]["elbow"]["unit"] == "rad"
    assert schema["properties"]["age"]["properties"]["muscle_tension"]["properties"]["biceps"]["unit"] == "s"
    assert "HAL's cycle number" in schema["properties"]["cycle"]["description"]
    assert schema["properties"]["boot"]["description"].startswith("Random number")
    for wrong in ({"values": {"joint_position": {"elbow": "far"}}}, {"cycle": "first"}):
        _, plain, _ = through(a_message(Sample))
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(plain | wrong, schema)


def foxglove_can_read(schema: dict[str, Any]) -> None:
    """The rules of Foxglove's reader (packages/mcap-support/src/parseJsonSchema.ts), which refuses all else."""
    assert schema["type"] == "object"
    for field in schema["properties"].values():
        assert field["type"] in ("boolean", "string", "number", "integer", "object", "array"), field
        if field["type"] == "object":
            foxglove_can_read(field)
        elif field["type"] == "array":
            assert field["items"]["type"] in ("boolean", "string", "number", "integer")


@pytest.mark.parametrize("record", RECORDS.values(), ids=list(RECORDS))
def test_foxglove_can_read_every_schema(record: type[Message]) -> None:
    foxglove_can_read(Form(record, ARM).schema)


def test_every_key_that_carries_a_record_is_known() -> None:
    robot = "arm"
    nouns = [keys.sample, keys.vision, keys.truth, keys.applied, keys.command, keys.holder, keys.estimate,
             keys.anomaly, keys.update, keys.target]  # fmt: skip
    every = {noun(robot) for noun in nouns} | {keys.status(robot, service) for service in keys.SERVICES}
    assert {keys.robot_key(robot, rest) for rest in CARRIED} == every


def _body(record: type[Message]) -> dict[str, Any]:
    found: dict[str, Any] = msgpack.unpackb(messages.encode(a_message(record)))
    return found


@pytest.mark.parametrize(
    ("record", "changes"),
    [
        (Sample, {"cycle": "one"}),
        (Sample, {"cycle": True}),
        (Sample, {"complete": 1}),
        (Sample, {"values": [1, 2]}),
        (Sample, {"values": {"joint_position": [0.1, 0.2]}}),
        (Sample, {"v": 3}),
        (Sample, {"type": "applied"}),
        (Applied, {"limited_by": [3]}),
        (Applied, {"signal": 3}),
        (Anomaly, {"score": "high"}),
        (Estimates, {"method": {"joint_position": 3}}),
        (Update, {"bias": np.array([math.nan]).tobytes()}),
        (Update, {"bias": b"123"}),
        (Status, {"facts": {("a", "b"): 3}}),
        (Status, {"loops": {"hal": 3}}),
    ],
)
def test_what_is_no_such_message_is_told(record: type[Message], changes: dict[str, Any]) -> None:
    payload = msgpack.packb(_body(record) | changes)
    with pytest.raises(MessageError):
        Form(record, ARM).write(payload)


@settings(deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_told(payload: bytes) -> None:
    with pytest.raises(MessageError):
        Form(Sample, ARM).write(payload)


@pytest.mark.parametrize("record", [Sample, Applied, Target, Estimates], ids=lambda record: record.TYPE)
def test_truncated_messages_are_told(record: type[Message]) -> None:
    payload = messages.encode(a_message(record))
    for length in range(len(payload)):
        with pytest.raises(MessageError):
            Form(record, ARM).write(payload[:length])


def test_a_signal_that_nobody_described_gets_numbers_for_names() -> None:
    sample = a_message(Sample)
    with pytest.raises(OtherLayout) as report:
        Form(Sample, Catalogue({"muscle_tension": ARM.signals["muscle_tension"]})).write(messages.encode(sample))
    assert (report.value.signal, report.value.size) == ("joint_position", 2)
    back, plain, _ = through(sample, Catalogue({}).with_unknown("joint_position", 2).with_unknown("muscle_tension", 1))
    assert list(plain["values"]["joint_position"]) == ["element_1", "element_2"]
    assert messages.encode(back) == messages.encode(sample)


def test_fields_of_a_newer_sender_are_kept() -> None:
    data, _ = Form(Sample, ARM).write(msgpack.packb(_body(Sample) | {"temperature": 31.5, "raw": b"\1\2"}))
    assert json.loads(data)["temperature"] == 31.5
    assert isinstance(Form(Sample, ARM).read(data), Sample)


@pytest.mark.parametrize("field", ["age", "valid"])
def test_a_sample_that_does_not_agree_with_itself_is_not_recorded_as_one(field: str) -> None:
    body = msgpack.unpackb(messages.encode(a_message(Sample)))
    body[field] = body[field][:-8] if field == "age" else body[field][:-1]
    with pytest.raises(MessageError, match=f"3 elements are named, but '{field}' has 2"):
        Form(Sample, ARM).write(msgpack.packb(body))


@pytest.mark.parametrize("counts", [{"flood": 10**12}, {"flood": 10**12, "ebb": 3 - 10**12}, {"flood": 1e300}])
def test_elements_that_did_not_come_are_not_taken_for_a_new_signal(counts: dict[str, float]) -> None:
    body = _body(Sample) | {"elements": counts}
    with pytest.raises(MessageError) as report:
        Form(Sample, ARM).write(msgpack.packb(body))
    assert not isinstance(report.value, OtherLayout)  # it would be listed with a name for each element
