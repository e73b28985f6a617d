import math
import struct

import pytest
from bench import CELL, ENCODER, bench

from simulators.nodes.canopen.objects import Abort
from simulators.nodes.canopen.spec import CellConstants, EncoderConstants, NodeSpec

ZERO = int.from_bytes(b"zero", "little")
TURN = 262_144


def cell_at(b, tension):
    """Integer process value and status after the tension has become this."""
    b.world.tension = tension
    b.step(0.005)
    return struct.unpack("<iB", b.sync()[0x180 + CELL])


def encoder_at(b, angle):
    """Position value and alarms after the joint has turned to this."""
    b.world.angle = angle
    b.step(0.005)
    return struct.unpack("<IH", b.sync()[0x180 + ENCODER])


@pytest.fixture
def b():
    with bench() as made:
        made.nmt(1)
        yield made


@pytest.mark.parametrize("tension", [-40.0, 0.0, 0.004, 123.456, 480.0])
def test_cell_tells_newton_with_its_decimal_digits(b, tension):
    assert cell_at(b, tension) == (pytest.approx((tension + 1.5) * 100, abs=0.6), 0)
    assert b.read(CELL, 0x6131, 1, "I") == 0x00210000
    assert b.read(CELL, 0x6130, 1, "f") == pytest.approx(tension + 1.5, abs=1e-3)
    assert b.read(CELL, 0x9100, 1, "i") == pytest.approx((tension + 1.5) * 4000, abs=1)


def test_cell_follows_other_decimal_digits(b):
    assert b.write(CELL, 0x6132, 1, "B", 4) == 0
    assert cell_at(b, 10.0)[0] == pytest.approx(115_000, abs=3)
    assert b.read(CELL, 0x7130, 1, "h") == 32_767


def test_zero_signature_tares_and_a_reboot_forgets(b):
    cell_at(b, 0.0)
    assert b.write(CELL, 0x6125, 1, "I", ZERO) == 0
    assert cell_at(b, 0.0) == (0, 0)
    assert cell_at(b, 50.0)[0] == 5000
    assert b.read(CELL, 0x6124, 1, "f") == pytest.approx(-1.5, abs=1e-3)
    b.rig.fault("node_reboot wire_cell")
    b.nmt(1)
    assert cell_at(b, 50.0)[0] == 5150


def test_cell_scaling_is_the_masters_to_set(b):
    b.write(CELL, 0x6126, 1, "f", 2.0 / 4000)
    b.write(CELL, 0x6127, 1, "f", 5.0)
    assert cell_at(b, 10.0)[0] == pytest.approx(2800, abs=1)


@pytest.mark.parametrize(("tension", "status"), [(600.0, 2), (-600.0, 4), (math.nan, 1)])
def test_cell_status_tells_what_is_not_a_measurement(b, tension, status):
    value, report = cell_at(b, tension)
    assert report == status
    assert abs(value) <= 50_000
    assert cell_at(b, 10.0) == (1150, 0)


def test_a_broken_cell_keeps_saying_so(b):
    b.rig.fault("emcy wire_cell")
    assert cell_at(b, 10.0)[1] == 1
    assert cell_at(b, 20.0)[1] == 1


def test_cell_that_is_switched_off_measures_nothing(b):
    b.write(CELL, 0x6112, 1, "B", 0)
    assert cell_at(b, 10.0)[1] == 1


@pytest.mark.parametrize("factor", [1e30, math.inf, math.nan])
def test_a_scaling_that_makes_no_sense_gives_no_measurement(b, factor):
    assert b.write(CELL, 0x6126, 1, "f", factor) == 0
    assert cell_at(b, 10.0)[1] == 1
    assert b.write(CELL, 0x6125, 1, "I", ZERO) == Abort.DEVICE_STATE


def test_the_widest_range_of_an_encoder_can_be_preset(b):
    for index, value in ((0x6001, 2**32 - 1), (0x6002, 2**32 - 1)):
        assert b.write(ENCODER, index, 0, "I", value) == 0
    assert b.write(ENCODER, 0x6000, 0, "H", 4) == 0
    for preset in (0, 2**31, 2**32 - 2):
        assert b.write(ENCODER, 0x6003, 0, "I", preset) == 0
        b.read(ENCODER, 0x6509, 0, "i")
        assert encoder_at(b, b.world.angle)[0] == preset


@pytest.mark.parametrize("angle", [-3.0, -0.5, 0.0, 1.0, 3.0])
def test_encoder_counts_from_its_zero(b, angle):
    assert encoder_at(b, angle) == (math.floor((angle + math.pi) / (2 * math.pi) * TURN), 0)


def test_encoder_wraps_after_a_turn(b):
    below, above = encoder_at(b, math.pi - 0.001)[0], encoder_at(b, math.pi + 0.001)[0]
    assert above < 100 < TURN - 100 < below


def test_encoder_mounted_the_other_way():
    constants = EncoderConstants(counts_per_turn=4096, direction=-1, zero=math.pi)
    with bench([NodeSpec("hinge_encoder", "can0", ENCODER, "joint_position.hinge", constants)]) as b:
        b.nmt(1)
        assert encoder_at(b, math.pi - 2 * math.pi * 100.5 / 4096)[0] == 100
        assert b.read(ENCODER, 0x6501, 0, "I") == 4096


def test_multiturn_encoder():
    constants = EncoderConstants(counts_per_turn=1000, turns=16, zero=-8 * 2 * math.pi)
    with bench([NodeSpec("hinge_encoder", "can0", ENCODER, "joint_position.hinge", constants)]) as b:
        b.nmt(1)
        assert encoder_at(b, 2 * math.pi * 3.0005)[0] == 11_000
        assert b.read(ENCODER, 0x6502, 0, "H") == 16


def test_reversed_code_sequence(b):
    forward = encoder_at(b, 0.5)[0]
    assert b.write(ENCODER, 0x6000, 0, "H", 1) == 0
    assert encoder_at(b, 0.5)[0] == TURN - forward
    assert b.read(ENCODER, 0x6500, 0, "H") == 1


def test_scaling(b):
    b.write(ENCODER, 0x6001, 0, "I", 3600)
    b.write(ENCODER, 0x6002, 0, "I", 3600)
    unscaled = encoder_at(b, 0.5)[0]
    assert unscaled > 3600
    b.write(ENCODER, 0x6000, 0, "H", 4)
    assert encoder_at(b, 0.5)[0] == unscaled * 3600 // TURN


def test_preset_makes_the_position_now_the_preset_value(b):
    encoder_at(b, 0.5)
    assert b.write(ENCODER, 0x6003, 0, "I", 1000) == 0
    assert encoder_at(b, 0.5)[0] == 1000
    assert encoder_at(b, 0.5 + 2 * math.pi * 100 / TURN)[0] == pytest.approx(1100, abs=1)
    assert encoder_at(b, 0.5 - 2 * math.pi * 2000 / TURN)[0] == pytest.approx(TURN - 1000, abs=1)


def test_speed(b):
    encoder_at(b, 0.5)
    encoder_at(b, 0.5 + 2 * math.pi * 100 / TURN)
    assert b.read(ENCODER, 0x6030, 1, "h") == pytest.approx(100 / 0.005, rel=0.02)


def test_a_broken_encoder_raises_its_alarm_and_keeps_its_last_value(b):
    before, _ = encoder_at(b, 0.5)
    b.rig.fault("emcy hinge_encoder")
    assert encoder_at(b, 1.0) == (before, 1)


def test_an_angle_that_is_no_number_raises_the_alarm(b):
    before, _ = encoder_at(b, 0.5)
    assert encoder_at(b, math.nan) == (before, 1)


def test_constants_fit_what_the_objects_can_hold():
    spec = NodeSpec("x", "can0", 1, "muscle_tension.wire", CellConstants())
    assert spec.kind == "load_cell"
    assert spec.eds.exists()
    assert 0 <= spec.serial < 2**32


def test_an_encoder_that_was_scaled_before_delivery():
    constants = EncoderConstants(counts_per_turn=4096, turns=16, zero=0.0, scaled_to=3600)
    with bench([NodeSpec("hinge_encoder", "can0", ENCODER, "joint_position.hinge", constants)]) as b:
        b.nmt(1)
        assert encoder_at(b, math.pi + 4 * math.pi)[0] == 2 * 3600 + 1800
        assert b.read(ENCODER, 0x6000, 0, "H") == 4
        assert b.read(ENCODER, 0x6002, 0, "I") == 16 * 3600


def test_a_speed_in_another_unit():
    constants = EncoderConstants(speed_unit=(60, TURN))
    with bench([NodeSpec("hinge_encoder", "can0", ENCODER, "joint_position.hinge", constants)]) as b:
        b.nmt(1)
        encoder_at(b, 0.0)
        encoder_at(b, 0.005 * 10.0)
        assert b.read(ENCODER, 0x6030, 1, "h") == pytest.approx(10.0 * 60 / (2 * math.pi), abs=1.0)  # turns per minute
