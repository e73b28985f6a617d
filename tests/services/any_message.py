"""One message of every type, of an arm with three elements, for the tests of recordings."""

import time
import typing
from typing import Any

import numpy as np

from services.recording.schema import Catalogue, CatalogueSignal
from services.wire.messages import VERSION
from services.wire.records import Array, Message, Numbers, Truths

ARM = Catalogue(
    {"joint_position": CatalogueSignal("rad", ("elbow", "wrist")), "muscle_tension": CatalogueSignal("N", ("biceps",))}
)
BY_SIGNAL = {"joint_position": 2, "muscle_tension": 1}


def a_message(record: type[Message], number: float = 0.1) -> Message:
    """One of every type, its arrays filled with a number."""
    arrays = {name: np.full(size, number) for name, size in BY_SIGNAL.items()}
    truths = {name: np.arange(size) == 0 for name, size in BY_SIGNAL.items()}
    fields: dict[str, Any] = {"stamp_ns": time.time_ns(), "seq": 7, "boot": 2**53 - 1, "v": VERSION}
    hints = typing.get_type_hints(record) | dict(getattr(record, "BY_ELEMENT", ()))
    for name, hint in hints.items():
        if name in (*fields, "elements") or typing.get_origin(hint) is typing.ClassVar:
            continue
        if name == "signal":
            fields[name] = "joint_position"
        elif hint == Array:
            fields[name] = np.full(2, 0.25 if name == "bias" else number)
        elif hint is Numbers:
            fields[name] = arrays
        elif hint is Truths:
            fields[name] = truths
        elif hint == dict[str, float]:
            fields[name] = dict.fromkeys(BY_SIGNAL, number)
        elif hint == dict[str, str]:
            fields[name] = dict.fromkeys(BY_SIGNAL, "mask")
        elif hint == dict[str, dict[str, float]]:
            fields[name] = {"hal": {"rate": 200.0, "late_p99": 0.5}}
        elif hint == list[str]:
            fields[name] = ["range"]
        elif typing.get_origin(hint) is dict:
            fields[name] = {"devices": {"drive": {"text": "", "age": 0.5}}, "list": [1, None, True]}
        else:
            fields[name] = hint(number) if hint is float else hint(3) if hint is int else hint("x")
    return record(**fields)
