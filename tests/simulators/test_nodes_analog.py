import math
import struct

import pytest
from bench import bench

from simulators.nodes.canopen.analog_input import AnalogConstants
from simulators.nodes.canopen.spec import CellConstants, NodeSpec

AMPLIFIER = 33
FORCE = "muscle_tension.wire"


def amplifier(**constants):
    return bench([NodeSpec("amplifier", "can0", AMPLIFIER, FORCE, AnalogConstants(**constants))])


def at(b, tension):
    b.world.tension = tension
    b.step(0.005)


@pytest.mark.parametrize(("tension", "counts"), [(0.0, 0), (250.0, 8192), (-250.0, -8192), (999.0, 32735)])
def test_sixteen_bits_fill_the_sixteen_bit_object(tension, counts):
    with amplifier() as b:
        at(b, tension)
        assert b.read(AMPLIFIER, 0x6401, 1, "h") == counts
        assert b.read(AMPLIFIER, 0x6402, 1, "i") == counts << 16
        assert b.read(AMPLIFIER, 0x6403, 1, "f") == pytest.approx(tension / 100, abs=1e-3)  # V
        assert b.read(AMPLIFIER, 0x2120, 0, "H") == 0


def test_fewer_bits_are_shifted_to_the_left():
    with amplifier(bits=12) as b:
        at(b, 500.0)
        assert b.read(AMPLIFIER, 0x6401, 1, "h") == 1024 << 4
        assert b.read(AMPLIFIER, 0x6402, 1, "i") == 1024 << 20
        at(b, 2000.0)
        assert b.read(AMPLIFIER, 0x6401, 1, "h") == 2047 << 4


def test_more_bits_than_the_object_has_lose_the_lowest():
    with amplifier(bits=24) as b:
        at(b, 500.03)
        assert b.read(AMPLIFIER, 0x6401, 1, "h") == 16384
        assert b.read(AMPLIFIER, 0x6402, 1, "i") == round(500.03 / 1000 * 2**23) << 8


@pytest.mark.parametrize(("tension", "counts"), [(2000.0, 32767), (-2000.0, -32768), (math.nan, -32768)])
def test_beyond_full_scale(tension, counts):
    with amplifier() as b:
        at(b, tension)
        assert b.read(AMPLIFIER, 0x6401, 1, "h") == counts
        assert b.read(AMPLIFIER, 0x2120, 0, "H") == 0x0004


def test_every_cell_has_its_channel():
    with amplifier(more=(FORCE,), unbalance=3.0) as b:
        at(b, 100.0)
        assert [b.read(AMPLIFIER, 0x6401, channel, "h") for channel in (1, 2, 3)] == [3375, 3375, 0]


def test_nothing_is_sent_on_an_event_before_the_interrupt_is_enabled():
    with amplifier() as b:
        b.nmt(1)
        b.write(AMPLIFIER, 0x1801, 5, "H", 10)
        at(b, 500.0)
        assert 0x280 + AMPLIFIER not in dict(b.step(0.05, pieces=10))
        assert b.write(AMPLIFIER, 0x6423, 0, "B", 1) == 0
        assert dict(b.step(0.05, pieces=10))[0x280 + AMPLIFIER] == struct.pack("<4h", 16384, 0, 0, 0)


def test_a_broken_converter_reads_its_lower_end_and_says_so():
    with amplifier() as b:
        at(b, 500.0)
        b.rig.fault("emcy amplifier")
        assert b.read(AMPLIFIER, 0x6401, 1, "h") == -32768
        assert b.read(AMPLIFIER, 0x2120, 0, "H") & 0x0020


def test_a_measuring_amplifier_of_several_channels():
    constants = CellConstants(unbalance=1.5, more=(FORCE,))
    with bench([NodeSpec("cells", "can0", AMPLIFIER, FORCE, constants)]) as b:
        at(b, 10.0)
        assert [b.read(AMPLIFIER, 0x9130, channel, "i") for channel in (1, 2, 3)] == [1150, 1150, 0]
        assert [b.read(AMPLIFIER, 0x6150, channel, "B") for channel in (1, 2, 3)] == [0, 0, 1]
        assert b.write(AMPLIFIER, 0x6125, 2, "I", int.from_bytes(b"zero", "little")) == 0
        at(b, 10.0)
        assert [b.read(AMPLIFIER, 0x9130, channel, "i") for channel in (1, 2)] == [1150, 0]
        assert b.read(AMPLIFIER, 0x7100, 1, "h") == 32_767
        assert b.read(AMPLIFIER, 0x9100, 1, "i") == 46_000


def test_a_measuring_amplifier_in_another_unit():
    constants = CellConstants(unit=0x03210000, unit_size=1000.0, decimal_digits=5)
    with bench([NodeSpec("cells", "can0", AMPLIFIER, FORCE, constants)]) as b:
        at(b, 123.4)
        assert b.read(AMPLIFIER, 0x6131, 1, "I") == 0x03210000
        assert b.read(AMPLIFIER, 0x6130, 1, "f") == pytest.approx(0.1234, rel=1e-3)  # kN
        assert b.read(AMPLIFIER, 0x9130, 1, "i") == 12_340
