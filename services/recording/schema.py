"""Form of messages in a recording: JSON, and a JSON Schema that names every element and its unit.

A number that was not measured is absent, and viewers draw a gap: JSON has no NaN, and Foxglove's schema reader supports
neither null nor a union of types. When a file is read, an absent number becomes NaN again, and an absent age infinite
(never measured). All other numbers are read exactly.
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
"""An absent number of these fields has this value; of all other fields it is NaN."""
UNITS = {"age": "s", "contribution": "1", "left": "s"}
"""These fields have a unit of their own instead of the signal's."""
TYPES: dict[Any, str] = {int: "integer", float: "number", bool: "boolean", str: "string"}
_encoder = msgspec.json.Encoder()
_decoder = msgspec.json.Decoder()


class OtherLayout(MessageError):
    """A signal of a message is not in the catalogue, or has another size there.

    Attributes:
        signal: Name of the signal.
        size: Number of the signal's elements in the message.
    """

    def __init__(self, signal: str, size: int) -> None:
        super().__init__(f"Signal '{signal}' with {size} elements is not in the catalogue.")
        self.signal, self.size = signal, size


@dataclass(frozen=True)
class CatalogueSignal:
    """Signal in a catalogue: its unit, empty if not known, and its elements in order."""

    unit: str
    elements: tuple[str, ...]


@dataclass(frozen=True)
class Catalogue:
    """Signals of a robot, by name."""

    signals: Mapping[str, CatalogueSignal]

    @classmethod
    def of_robot(cls, robot: RobotConfig) -> Self:
        """Make the catalogue of a robot file."""
        return cls({name: CatalogueSignal(s.unit, tuple(s.elements)) for name, s in robot.signals.items()})

    @classmethod
    def of_description(cls, description: Mapping[str, Any]) -> Self:
        """Make the catalogue of a HAL's answer to `describe`.

        Raises:
            MessageError: The answer lacks signals.
        """
        try:
            signals = {
                str(name): CatalogueSignal(str(signal["unit"]), tuple(str(element) for element in signal["elements"]))
                for name, signal in description["signals"].items()
            }
        except (KeyError, TypeError, AttributeError):
            raise MessageError("The description lacks signals with units and elements.") from None
        return cls(signals)

    @classmethod
    def of_schema(cls, schema: Mapping[str, Any]) -> Self:
        """Make the catalogue of a schema that `Form` made.

        Raises:
            MessageError: `Form` did not make it.
        """
        return cls.of_description({"signals": schema.get("x-signals", {})})

    def plain(self) -> dict[str, Any]:
        """Return the catalogue as plain data for JSON."""
        return {name: {"unit": s.unit, "elements": list(s.elements)} for name, s in self.signals.items()}

    def with_unknown(self, signal: str, size: int) -> "Catalogue":
        """Return the catalogue with one more signal, whose elements have numbers for names."""
        elements = tuple(f"element_{number}" for number in range(1, size + 1))
        return Catalogue({**self.signals, signal: CatalogueSignal("", elements)})


Convert = Callable[[Any, dict[str, Any]], Any]


class Form:
    """Conversion of messages of one type to and from a recording of one robot.

    Attributes:
        schema: The JSON Schema.
        hints: Field of the record -> its type.
        by_signal: Whether the record has one signal, which all its arrays describe.
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
        self._converters = [(item.name, self._writer(item.name, self.hints[item.name])) for item in self._fields]
        self._required = frozenset(item.name for item in self._fields if item.required)
        self.schema = self._schema()

    def write(self, payload: bytes) -> tuple[bytes, dict[str, Any]]:
        """Return the JSON and the content of a message in wire form.

        Raises:
            OtherLayout: The catalogue lacks one of its signals.
            MessageError: The bytes are not such a message, or JSON cannot hold its values.
        """
        try:
            body = msgspec.msgpack.decode(payload)
            if body["type"] != self.record.TYPE or body["v"] != VERSION:
                raise MessageError(f"It is not a {self.record.TYPE} message of version {VERSION}.")
            if not self._required <= body.keys():
                raise MessageError(f"A {self.record.TYPE} message lacks '{min(self._required - body.keys())}'.")
            if self._is_of_signals:
                self._check(body)
            for name, convert in self._converters:
                if name in body and (converted := convert(body[name], body)) is not None:
                    body[name] = converted
                else:
                    body.pop(name, None)
            body.pop("elements", None)  # JSON names every element
            return _encoder.encode(body), body
        except MessageError:
            raise
        except (ValueError, TypeError, LookupError, AttributeError, struct.error, OverflowError, RecursionError,
                msgspec.MsgspecError) as error:  # fmt: skip
            raise MessageError(f"It is not a {self.record.TYPE} message: {error or type(error).__name__}.") from None

    def read(self, data: bytes) -> Message:
        """Return the message from its JSON.

        Raises:
            MessageError: The JSON was not made by `write`.
        """
        try:
            body = _decoder.decode(data)
            present = (item.name for item in self._fields if self._is_present(item.name, body))
            return self.record(**{name: self._read(name, body) for name in present})
        except (ValueError, TypeError, LookupError, AttributeError, OverflowError, RecursionError) as error:
            raise MessageError(f"It is not a recorded {self.record.TYPE} message: {error}.") from None

    def _is_present(self, name: str, body: dict[str, Any]) -> bool:
        return name in body or (self.hints[name] is float and name in self._required)

    def _writer(self, name: str, hint: Any) -> Convert:
        """Return the function that converts a field from its wire form to JSON; it returns None for an absent field."""
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
                return lambda value, body: {key: _map_of_numbers(inner, body) for key, inner in value.items()}
            if inner is str:
                return lambda value, _: {key: _checked(str, text) for key, text in value.items()}
            return lambda value, _: _checked(dict, value)
        if typing.get_origin(hint) is list:
            return lambda value, _: [_checked(str, text) for text in _checked(list, value)]
        return lambda value, _: _checked(hint, value)

    def _numbers(self, signal: str, data: bytes) -> dict[str, float]:
        if signal not in self._packed or len(data) != self._packed[signal][1].size:
            raise OtherLayout(_checked(str, signal), len(_checked(bytes, data)) // 8)
        elements, packed = self._packed[signal]
        return _named(elements, packed.unpack(data))

    def _check(self, body: dict[str, Any]) -> None:
        """Check that all parts of a message have the same signals, and that the catalogue holds them.

        Sizes are checked first, so that `OtherLayout` has the real size.
        """
        elements = Elements.of(_checked(dict, body["elements"]))
        record: Any = self.record
        for name, kind in record.BY_ELEMENT:
            count = len(_checked(bytes, body[name])) / kind.DTYPE.itemsize
            if count != elements.size:
                raise MessageError(f"{elements.size:g} elements are named, but '{name}' has {count:g}.")
        for signal, count in elements.counts.items():
            if signal not in self._packed or len(self._packed[signal][0]) != count:
                raise OtherLayout(signal, count)
        for name in record.BY_SIGNAL:
            if body[name].keys() != elements.counts.keys():
                raise MessageError(f"A {self.record.TYPE} message has other signals in '{name}' than in 'elements'.")

    def _of_numbers(self, data: bytes, body: dict[str, Any]) -> dict[str, dict[str, float]]:
        return self._split(struct.unpack(f"<{len(data) // 8}d", data), body, _named)

    def _of_truths(self, data: bytes, body: dict[str, Any]) -> dict[str, dict[str, bool]]:
        return self._split(data, body, _named_truths)

    def _split(self, values: Sequence[Any], body: dict[str, Any], named: Callable[..., dict[str, Any]]) -> Any:
        """Split the values of all elements by signal."""
        parts, start = {}, 0
        for signal in body["elements"]:
            elements = self._packed[signal][0]
            parts[signal] = named(elements, values[start : start + len(elements)])
            start += len(elements)
        return parts

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
        descriptions = _descriptions(self.record)
        properties: dict[str, Any] = {"type": {"const": self.record.TYPE, "type": "string"}}
        for item in self._fields:
            properties[item.name] = self._schema_of(item.name, self.hints[item.name])
            if item.name in descriptions:
                properties[item.name]["description"] = descriptions[item.name]
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
            return _object(
                {signal: {"type": TYPES[inner]} for signal in self.catalogue.signals} if inner in TYPES else {}
            )
        return {"type": TYPES[hint]} | ({"unit": UNITS[name]} if name in UNITS else {})

    def _elements(self, name: str, listed: CatalogueSignal) -> dict[str, Any]:
        if self._is_truth(name):
            return _object({element: {"type": "boolean"} for element in listed.elements})
        unit = UNITS.get(name, listed.unit)
        number = {"type": "number"} | ({"description": f"[{unit}]", "unit": unit} if unit else {})
        return _object(dict.fromkeys(listed.elements, number))


def _object(properties: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of an object; Foxglove refuses one without `properties`."""
    return {"type": "object", "properties": properties}


def _named(elements: Sequence[str], values: Sequence[float]) -> dict[str, float]:
    """Return the finite values by element."""
    total = sum(values)
    if total - total == 0.0:  # all finite
        return dict(zip(elements, values, strict=True))
    return {element: x for element, x in zip(elements, values, strict=True) if math.isfinite(x)}


def _named_truths(elements: Sequence[str], values: Sequence[int]) -> dict[str, bool]:
    return {element: byte != 0 for element, byte in zip(elements, values, strict=True)}


def _finite(value: Any, _: dict[str, Any]) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise MessageError(f"{value!r:.80} is not a number.")
    return value if math.isfinite(value) else None


def _map_of_numbers(value: Any, body: dict[str, Any]) -> dict[str, float]:
    return {key: number for key, entry in value.items() if (number := _finite(entry, body)) is not None}


def _list_of_numbers(value: Any, _: dict[str, Any]) -> list[float]:
    numbers: list[float] = np.frombuffer(value, "<f8").tolist()
    if not all(map(math.isfinite, numbers)):
        raise MessageError("A list without element names must have only finite numbers.")
    return numbers


def _checked(kind: type, value: Any) -> Any:
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise MessageError(f"{value!r:.80} is not of type {kind.__name__}.")
    return value


def _descriptions(record: type[Message]) -> dict[str, str]:
    """Return the sentence on each attribute from the docstrings of a record and of `Message`."""
    text = "\n".join(inspect.getdoc(kind) or "" for kind in (Message, record))
    entries = re.findall(r"^    (\w+): (.+(?:\n {8}.+)*)", text, re.MULTILINE)
    return {name: " ".join(sentence.split()) for name, sentence in entries}
