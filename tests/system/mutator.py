"""Messages that are not what they should be."""

import random
from typing import Any

import msgpack
import numpy as np


class Mutator:
    """Makes messages that are not what they should be.

    Args:
        seed: Of all that is random; the same seed makes the same messages.
        templates: Well-formed messages of each type, as maps.
    """

    def __init__(self, seed: int, templates: dict[str, dict[str, Any]]) -> None:
        self.draw = random.Random(seed)
        self._templates = templates

    def message(self, kind: str) -> bytes:
        """One bad message in place of one of this type."""
        body = dict(self._templates[kind])
        make = self.draw.choice(
            (self._noise, self._cut, self._flipped, self._future, self._wrong_field, self._wrong_field, self._missing,
             self._deep, self._wrong_size, self._other_type, self._not_msgpack, self._oversized)
        )  # fmt: skip
        return make(body)

    def arguments(self) -> bytes:
        """Arguments of a verb that are none."""
        return self.message(self.draw.choice(list(self._templates)))

    def _noise(self, _: dict[str, Any]) -> bytes:
        return self.draw.randbytes(self.draw.choice((0, 1, 2, 7, 30, 300)))

    def _cut(self, body: dict[str, Any]) -> bytes:
        whole = msgpack.packb(body)
        return whole[: self.draw.randrange(len(whole))]

    def _flipped(self, body: dict[str, Any]) -> bytes:
        whole = bytearray(msgpack.packb(body))
        for _ in range(self.draw.randint(1, 8)):
            whole[self.draw.randrange(len(whole))] ^= 1 << self.draw.randrange(8)
        return bytes(whole)

    def _future(self, body: dict[str, Any]) -> bytes:
        return msgpack.packb(body | {"v": self.draw.choice((0, 1, 3, 99, -1, 2**63, 1.5, "1", None, [1], b"1", {}))})

    def _wrong_field(self, body: dict[str, Any]) -> bytes:
        return msgpack.packb(body | {self.draw.choice(list(body)): self.value()})

    def _missing(self, body: dict[str, Any]) -> bytes:
        body.pop(self.draw.choice(list(body)))
        return msgpack.packb(body)

    def _deep(self, body: dict[str, Any]) -> bytes:
        depth = self.draw.choice((50, 400, 600, 2000, 100_000))
        nested = b"\x91" * depth + b"\xc0" if self.draw.random() < 0.5 else b"\x81\xa1a" * depth + b"\xc0"
        if self.draw.random() < 0.3:
            return nested
        field = msgpack.packb(self.draw.choice(list(body)))
        return b"\x81" + field + nested if self.draw.random() < 0.5 else _with_raw(body, field, nested)

    def _wrong_size(self, body: dict[str, Any]) -> bytes:
        def other() -> bytes:
            size = self.draw.choice((0, 1, 2, 3, 5, 64))
            fill = self.draw.choice((0.0, np.nan, np.inf, -np.inf, 1e308, 5e-324, -1e9))
            return np.full(size, fill).tobytes()

        for name, value in list(body.items()):
            if isinstance(value, bytes):
                body[name] = other()
            elif isinstance(value, dict) and value and all(isinstance(one, bytes) for one in value.values()):
                body[name] = {key: other() if self.draw.random() < 0.7 else one for key, one in value.items()}
        body["type"] = self.draw.choice((body["type"], body["type"] + "x"))
        return msgpack.packb(body)

    def _other_type(self, _: dict[str, Any]) -> bytes:
        return msgpack.packb(self.draw.choice(list(self._templates.values())) | {"v": 3})

    def _not_msgpack(self, _: dict[str, Any]) -> bytes:
        return self.draw.choice(
            (b"\xc1", b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xffabc",
             b"\xc6\xff\xff\xff\xff", b"\x81\xa4type\xdd\x7f\xff\xff\xff", b"\x81\xa2\xff\xfe\x01", b"\x90",
             b'{"type": "sample", "v": 2}', b"\xc0",
             b"\x81\xc0\xc0", b"\xd4\x01\x02", b"\xd7\xff" + bytes(8), msgpack.packb({1: 2, None: 3}), b"\x80")
        )  # fmt: skip

    def _oversized(self, body: dict[str, Any]) -> bytes:
        if self.draw.random() < 0.9:  # mostly just long: a megabyte takes a millisecond
            return msgpack.packb(body | {self.draw.choice(list(body)): "x" * 20_000})
        return msgpack.packb(body | {"more": bytes(self.draw.choice((1 << 20, 5 << 20)))})

    def value(self) -> Any:
        """Anything but what it should be."""
        return self.draw.choice(
            (None, True, -1, 0, 2**63, -(2**63), 2**64 - 1, 1e308, float("nan"), float("inf"), "", "x" * 5000,
             "\x1b[2J\x07",
             "[red]no[/]", "../../etc", b"", b"123", bytes(8), [], [1, "a", None], {}, {"a": {"b": [1]}}, {"1": b"x"},
             {"joint_position": b"12345678"}, msgpack.ExtType(5, b"x"), msgpack.Timestamp(1, 2), [[[]]] * 50)
        )  # fmt: skip


def _with_raw(body: dict[str, Any], field: bytes, raw: bytes) -> bytes:
    """A message with one field's value replaced by bytes that msgpack would not make."""
    packer = msgpack.Packer()
    parts = [packer.pack_map_header(len(body))]
    for name, value in body.items():
        packed = msgpack.packb(name)
        parts += [packed, raw if packed == field else msgpack.packb(value)]
    return b"".join(parts)
