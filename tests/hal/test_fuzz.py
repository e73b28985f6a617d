"""Random frames at the HAL with every kind of device, random bytes at every parser; `make faults` sends more."""

import itertools
import random

import pytest
from device_kinds import KINDS
from fuzz import fuzz
from hal_bench import ROBOTS

from hal.finding.book import Book, Frame
from hal.finding.decode import describe
from hal.protocols import analog, cia301, cia402, cia406, dbc, mit, sdo
from hal.protocols.error_frames import error_frame
from hal.protocols.mit import Layout, Ranges

FRAMES = 8400
BYTES = 20_000


@pytest.mark.parametrize("kind", KINDS, ids=str)
@pytest.mark.long
def test_random_frames_raise_nothing_move_nothing_and_enable_nothing(kind):
    assert fuzz(kind, FRAMES) == FRAMES


def payloads(seed):
    """Random bytes of every length that a frame can have, and some that it cannot."""
    draw = random.Random(seed)
    return [draw.randbytes(draw.choice((*range(9), 12, 64))) for _ in range(BYTES)]


RANGES = Ranges(12.5, 45.0, 18.0, 500.0, 5.0)
PARSERS = {
    "heartbeat": cia301.nmt_state,
    "emergency": cia301.emergency,
    "emergency code": lambda data: cia301.describe_emergency(int.from_bytes(data[:2]), len(data), data[2:]),
    "statusword": lambda data: cia402.state(int.from_bytes(data[:2])),
    "mode": lambda data: cia402.describe_mode(int.from_bytes(data[:1], signed=True)),
    "modes": lambda data: cia402.describe_modes(int.from_bytes(data[:4])),
    "velocity unit": lambda data: cia402.velocity_unit(int.from_bytes(data[:4])),
    "unit": lambda data: analog.unit(int.from_bytes(data[:4])),
    "cell status": lambda data: analog.describe_status(int.from_bytes(data[:1])),
    "encoder alarms": lambda data: cia406.describe_alarms(int.from_bytes(data[:2])),
    "error frame": lambda data: error_frame(int.from_bytes(data[:4]), data),
    "MIT command": lambda data: mit.parse_command(data, RANGES),
    "MIT register": lambda data: mit.parse_register(data, 5),
    **{
        f"MIT answer of {layout}": lambda data, layout=layout: mit.parse_answer(data, layout, RANGES)
        for layout in Layout
    },
}


@pytest.mark.parametrize("parse", PARSERS.values(), ids=PARSERS)
def test_a_parser_takes_any_bytes(parse):
    for data in payloads(1):
        parse(data)
        parse(bytearray(data))


def test_an_upload_takes_any_answer_and_ends():
    upload, started = sdo.Upload(0x1008, 0), 0
    for data in payloads(2):
        upload.answer(data)
        upload.answer(bytes([data[0] if data else 0]) + upload.request[1:4] + data[4:8].ljust(4, b"\0"))
        if upload.is_done:
            upload, started = sdo.Upload(0x1008, 0), started + 1
    assert started > 100


@pytest.mark.parametrize("name", ["odrive_cansimple", "load_cell"])
def test_a_dbc_reader_takes_any_bytes_of_its_length(name):
    file = dbc.load(ROBOTS / "dbc" / f"{name}.dbc")
    readers = [
        dbc.SignalReader(message, [s.name for s in message.signals]) for message in file.messages if message.signals
    ]
    draw = random.Random(3)
    for reader in itertools.islice(itertools.cycle(readers), BYTES):
        found = reader.read(draw.randbytes(reader.size))
        assert found is None or len(found) == len(reader.names)


def test_any_frame_can_be_put_into_words():
    draw, book = random.Random(4), Book()
    for data in payloads(4):
        frame = Frame(
            0.0, draw.randrange(0x800), data[:8], draw.random() < 0.1, draw.random() < 0.1, draw.random() < 0.1
        )
        assert describe(frame, book).kind
