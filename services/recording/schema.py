"""What a message looks like in a recording: JSON, and a JSON Schema that names every element and its unit.

A number that was not measured is absent. JSON has no NaN, and Foxglove's reader of schemas knows neither null nor a
choice of types, so absence is what a schema can say truthfully and every viewer draws as a gap. Read back, an absent
number is NaN again, and an absent age is infinite: never measured. All other numbers are read back bit by bit.
"""

import inspect
import math
import re
import struct
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import msgspec
import numpy as np

from hal.config import RobotConfig
from services.wire.messages import VERSION, MessageError
from services.wire.records import Array, Elements, Message, Numbers, OfSignals, Truths

DIALECT = "https://json-schema.org/draft/2020-12/schema"
ABSENT = {"age": math.inf}
"""What an absent number of a field stands for, where that is not NaN."""
UNITS = {"age": "s", "contribution": "1", "left": "s"}
"""Units of fields that do not have the signal's."""
TYPES: dict[Any, str] = {int: "integer", float: "number", bool: "boolean", str: "string"}
_encoder = msgspec.json.Encoder()
_decoder = msgspec.json.Decoder()


class OtherLayout(MessageError):
    """A message has a signal that is not in the catalogue, or one of another size.

    Attributes:
        signal: Which.
        size: How many elements it has in the message.
    """

    def __init__(self, signal: str, size: int) -> None:
        super().__init__(f"Signal '{signal}' with {size} elements is not in the catalogue.")
        self.signal, self.size = signal, size


@dataclass(frozen=True)
class Listed:
    """A signal in a catalogue: its unit, empty if not known, and its elements in order."""

    unit: str
    elements: tuple[str, ...]


@dataclass(frozen=True)
class Catalogue:
    """The signals of a robot, by name."""

    signals: Mapping[str, Listed]

    @classmethod
    def of_robot(cls, robot: RobotConfig) -> Self:
        """Of a robot file."""
        return cls({name: Listed(one.unit, tuple(one.elements)) for name, one in robot.signals.items()})

    @classmethod
    def of_description(cls, told: Mapping[str, Any]) -> Self:
        """Of what a HAL answers to `describe`.

        Raises:
            MessageError: It tells no signals.
        """
        try:
            signals = {
                str(name): Listed(str(one["unit"]), tuple(str(element) for element in one["elements"]))
                for name, one in told["signals"].items()
            }
        except (KeyError, TypeError, AttributeError):
            raise MessageError("The description tells no signals with their units and elements.") from None
        return cls(signals)

    @classmethod
    def of_schema(cls, schema: Mapping[str, Any]) -> Self:
        """Of the schema that `Form` made."""
        listed = schema.get("x-signals", {})
        return cls({name: Listed(one["unit"], tuple(one["elements"])) for name, one in listed.items()})

    def plain(self) -> dict[str, Any]:
        """As JSON can carry it."""
        return {name: {"unit": one.unit, "elements": list(one.elements)} for name, one in self.signals.items()}

    def with_unknown(self, signal: str, size: int) -> "Catalogue":
        """The same and one signal more, of which only the number of elements is known."""
        elements = tuple(f"element_{number}" for number in range(1, size + 1))
        return Catalogue({**self.signals, signal: Listed("", elements)})


Convert = Callable[[Any, dict[str, Any]], Any]


class Form:
    """How messages of one type look in a recording of one robot, to and fro.

    Attributes:
        schema: The JSON Schema.
        hints: Field of the record -> its type.
        by_signal: Whether the record has one signal, which its arrays are of.
    """

    def __init__(self, record: type[Message], catalogue: Catalogue) -> None:
        self.record, self.catalogue = record, catalogue
        self._fields = [item for item in msgspec.structs.fields(record) if item.name != "elements"]
        self.hints = {item.name: item.type for item in self._fields} | dict(getattr(record, "BY_ELEMENT", ()))
        self._packed = {
            name: (listed.elements, struct.Struct(f"<{len(listed.elements)}d"))
            for name, listed in catalogue.signals.items()
        }
        self._is_of_signals = issubclass(record, OfSignals)
        self.by_signal = any(item.name == "signal" for item in self._fields)
        self._plan = [(item.name, self._writer(item.name, self.hints[item.name])) for item in self._fields]
        self._required = frozenset(item.name for item in self._fields if item.required)
        self.schema = self._schema()

    def write(self, payload: bytes) -> tuple[bytes, dict[str, Any]]:
        """The JSON of a message as it was on the wire, and its content.

        Raises:
            OtherLayout: The catalogue lacks one of its signals.
            MessageError: It is not such a message, or JSON cannot hold it.
        """
        try:
            body = msgspec.msgpack.decode(payload)
            if body["type"] != self.record.TYPE or body["v"] != VERSION:
                raise MessageError(f"It is no {self.record.TYPE} message of version {VERSION}.")
            if not self._required <= body.keys():
                raise MessageError(f"A {self.record.TYPE} message lacks '{min(self._required - body.keys())}'.")
            if self._is_of_signals:
                self._check(body)
            for name, write in self._plan:
                if name in body and (found := write(body[name], body)) is not None:
                    body[name] = found
                else:
                    body.pop(name, None)
            body.pop("elements", None)  # every element stands beside its name
            return _encoder.encode(body), body
        except MessageError:
            raise
        except (ValueError, TypeError, LookupError, AttributeError, struct.error, OverflowError, RecursionError,
                msgspec.MsgspecError) as error:  # fmt: skip
            raise MessageError(f"It is no {self.record.TYPE} message: {error or type(error).__name__}.") from None

    def read(self, data: bytes) -> Message:
        """The message again.

        Raises:
            MessageError: The JSON is not what `write` makes.
        """
        try:
            body = _decoder.decode(data)
            found = {item.name: self._read(item.name, body) for item in self._fields if self._is_there(item.name, body)}
            return self.record(**found)
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            raise MessageError(f"It is no recorded {self.record.TYPE} message: {error}.") from None

    def _is_there(self, name: str, body: dict[str, Any]) -> bool:
        return name in body or (self.hints[name] is float and name in self._required)

    def _writer(self, name: str, hint: Any) -> Convert:
        """What turns a field of the wire into JSON; None from it means that the field is absent."""
        if hint in (Numbers, Truths):
            return self._of_numbers if hint is Numbers else self._of_truths
        if hint == Array:
            if not self.by_signal:
                return _list_of_numbers
            return lambda value, body: {body["signal"]: self._numbers(body["signal"], value)}
        if hint is float:
            return _finite
        if typing.get_origin(hint) is dict:
            inner = typing.get_args(hint)[1]
            if inner is float:
                return _map_of_numbers
            if typing.get_origin(inner) is dict:
                return lambda value, body: {key: _map_of_numbers(one, body) for key, one in value.items()}
            if inner is str:
                return lambda value, _: {key: _checked(str, one) for key, one in value.items()}
            return lambda value, _: _checked(dict, value)
        if typing.get_origin(hint) is list:
            return lambda value, _: [_checked(str, one) for one in _checked(list, value)]
        return lambda value, _: _checked(hint, value)

    def _numbers(self, signal: str, data: bytes) -> dict[str, float]:
        if signal not in self._packed or len(data) != self._packed[signal][1].size:
            raise OtherLayout(_checked(str, signal), len(_checked(bytes, data)) // 8)
        elements, packed = self._packed[signal]
        return _named(elements, packed.unpack(data))

    def _check(self, body: dict[str, Any]) -> None:
        """Raise unless a message tells everything of the same signals, all of them in the catalogue.

        Sizes first: what `OtherLayout` tells is as much as really came.
        """
        elements = Elements.of(_checked(dict, body["elements"]))
        record: Any = self.record
        for name, kind in record.BY_ELEMENT:
            there = len(_checked(bytes, body[name])) / kind.DTYPE.itemsize
            if there != elements.size:
                raise MessageError(f"{elements.size:g} elements are named, and {there:g} are there in '{name}'.")
        for signal, count in elements.counts.items():
            if signal not in self._packed or len(self._packed[signal][0]) != count:
                raise OtherLayout(signal, count)
        for name in record.BY_SIGNAL:
            if body[name].keys() != elements.counts.keys():
                raise MessageError(f"A {self.record.TYPE} message names other signals in '{name}' than in 'elements'.")

    def _of_numbers(self, data: bytes, body: dict[str, Any]) -> dict[str, dict[str, float]]:
        return self._split(struct.unpack(f"<{len(data) // 8}d", data), body, _named)

    def _of_truths(self, data: bytes, body: dict[str, Any]) -> dict[str, dict[str, bool]]:
        return self._split(data, body, _named_truths)

    def _split(self, values: Sequence[Any], body: dict[str, Any], named: Callable[..., dict[str, Any]]) -> Any:
        """Parts of what is told of all signals, by signal."""
        found, start = {}, 0
        for signal in body["elements"]:
            elements = self._packed[signal][0]
            found[signal] = named(elements, values[start : start + len(elements)])
            start += len(elements)
        return found

    def _read(self, name: str, body: dict[str, Any]) -> Any:
        hint: Any = self.hints[name]
        value: Any = body.get(name)
        if hint in (Numbers, Truths):
            return {signal: self._array(name, signal, part) for signal, part in value.items()}
        if hint == Array:
            if not self.by_signal:
                return np.array(value, float)
            return self._array(name, body["signal"], value[body["signal"]])
        if hint is float:
            return math.nan if value is None else float(value)
        if typing.get_origin(hint) is dict:
            inner = typing.get_args(hint)[1]
            if inner is float:
                return dict.fromkeys(body.get("values", ()), math.nan) | value
        return value

    def _is_truth(self, name: str) -> bool:
        return self.hints[name] is Truths

    def _array(self, name: str, signal: str, part: dict[str, Any]) -> np.ndarray:
        elements = self.catalogue.signals[signal].elements
        if self._is_truth(name):
            return np.array([part[element] for element in elements], bool)
        absent = ABSENT.get(name, math.nan)
        return np.array([part.get(element, absent) for element in elements], float)

    def _schema(self) -> dict[str, Any]:
        told = _told(self.record)
        properties: dict[str, Any] = {"type": {"const": self.record.TYPE, "type": "string"}}
        for item in self._fields:
            properties[item.name] = self._schema_of(item.name, self.hints[item.name])
            if item.name in told:
                properties[item.name]["description"] = told[item.name]
        required = [
            item.name for item in self._fields if item.name in self._required and self.hints[item.name] is not float
        ]
        return {
            "$schema": DIALECT,
            "title": f"gemuco.{self.record.__name__}",
            "description": inspect.getdoc(self.record).split("\n")[0],  # type: ignore[union-attr]
            "type": "object",
            "properties": properties,
            "required": ["type", "v", *required],
            "x-signals": self.catalogue.plain(),
        }

    def _schema_of(self, name: str, hint: Any) -> dict[str, Any]:
        if hint == Array and not self.by_signal:
            return {"type": "array", "items": {"type": "number"}}
        origin, inner = typing.get_origin(hint), (typing.get_args(hint) or (None,))[-1]
        if hint in (Array, Numbers, Truths):
            return _object({signal: self._elements(name, listed) for signal, listed in self.catalogue.signals.items()})
        if origin is list:
            return {"type": "array", "items": {"type": TYPES[inner]}}
        if origin is dict:
            known = {signal: {"type": TYPES[inner]} for signal in self.catalogue.signals} if inner in TYPES else {}
            return _object(known)
        return {"type": TYPES[hint]} | ({"unit": UNITS[name]} if name in UNITS else {})

    def _elements(self, name: str, listed: Listed) -> dict[str, Any]:
        if self._is_truth(name):
            return _object({element: {"type": "boolean"} for element in listed.elements})
        unit = UNITS.get(name, listed.unit)
        one = {"type": "number"} | ({"description": f"[{unit}]", "unit": unit} if unit else {})
        return _object(dict.fromkeys(listed.elements, one))


def _object(properties: dict[str, Any]) -> dict[str, Any]:
    """Foxglove refuses an object without `properties`."""
    return {"type": "object", "properties": properties}


def _named(elements: Sequence[str], values: Sequence[float]) -> dict[str, float]:
    """The finite ones."""
    total = sum(values)
    if total - total == 0.0:  # all finite
        return dict(zip(elements, values, strict=True))
    return {element: x for element, x in zip(elements, values, strict=True) if math.isfinite(x)}


def _named_truths(elements: Sequence[str], values: Sequence[int]) -> dict[str, bool]:
    return {element: byte != 0 for element, byte in zip(elements, values, strict=True)}


def _finite(value: Any, _: dict[str, Any]) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise MessageError(f"{value!r:.80} is no number.")
    return value if math.isfinite(value) else None


def _map_of_numbers(value: Any, body: dict[str, Any]) -> dict[str, float]:
    return {key: found for key, one in value.items() if (found := _finite(one, body)) is not None}


def _list_of_numbers(value: Any, _: dict[str, Any]) -> list[float]:
    found: list[float] = np.frombuffer(value, "<f8").tolist()
    if not all(map(math.isfinite, found)):
        raise MessageError("A list without names cannot have a gap.")
    return found


def _checked(kind: type, value: Any) -> Any:
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise MessageError(f"{value!r:.80} is no {kind.__name__}.")
    return value


def _told(record: type[Message]) -> dict[str, str]:
    """What the docstrings of a record and of `Message` say of each attribute."""
    text = "\n".join(inspect.getdoc(kind) or "" for kind in (Message, record))
    found = re.findall(r"^    (\w+): (.+(?:\n {8}.+)*)", text, re.MULTILINE)
    return {name: " ".join(said.split()) for name, said in found}
