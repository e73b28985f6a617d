"""Simulated drives in MIT mode, against frames worked out by hand; no code of the driver is used."""

import math

import numpy as np
import pytest

from simulators.nodes.canopen.spec import NodeSpec
from simulators.nodes.mit_drive import MitConstants, MitDriveNode
from simulators.nodes.plant import Plant, Snapshot

ENTER, EXIT, CLEAR = (bytes.fromhex("FFFFFFFFFFFFFF") + bytes((last,)) for last in (0xFC, 0xFD, 0xFB))
ZERO = bytes.fromhex("7FFF7FF0000007FF")
MIT_MODE = bytes.fromhex("0500550A01000000")


class Wire:
    """One drive with id 5 on a joint that it turns, and what it sends."""

    def __init__(self, **constants):
        self.position = np.zeros(1)
        self.load = np.zeros(1)
        values = {"joint": self.position, "load": self.load}
        plant = Plant({"joint.a": ("joint", 0), "load.a": ("load", 0)}, Snapshot(0.0, values))
        self.sent = []
        spec = NodeSpec("drive", "can0", 5, "joint.a", MitConstants(**constants))
        self.node = MitDriveNode(spec, plant, self.sent)
        self.now = 0.0
        self.node.power_up(0.0)

    def ask(self, data, identifier=5):
        """What it answers: identifier and data."""
        self.sent.clear()
        self.node.routes()[identifier](data, self.now)
        return self.sent[-1] if self.sent else None

    def pass_time(self, duration):
        for _ in range(round(duration / 0.005)):
            target, enabled = self.node.servo
            if enabled:
                self.position[0] = target
            self.now += 0.005
            self.node.tick(self.now)

    def enter(self):
        if 0x7FF in self.node.routes():
            self.ask(MIT_MODE, 0x7FF)
        self.ask(ENTER)


def test_damiao_answers():
    wire = Wire()
    assert wire.ask(EXIT) == (0x15, bytes.fromhex("057FFF7FF7FF1E19"))  # driver 30, rotor 25 degrees
    wire.position[0] = 12.5
    wire.enter()
    assert wire.ask(ZERO)[1][:3] == bytes.fromhex("15FFFF")


@pytest.mark.parametrize(
    ("constants", "answer"),
    [
        ({"make": "t_motor"}, "057FFF7FF7FF4100"),
        ({"make": "t_motor", "is_long": False}, "057FFF7FF7FF"),
        ({"make": "mini_cheetah"}, "057FFF7FF7FF"),
    ],
)
def test_others_answer_under_zero(constants, answer):
    assert Wire(**constants).ask(EXIT) == (0, bytes.fromhex(answer))


def test_position_starts_again_at_the_other_end():
    wire = Wire(make="t_motor")
    wire.position[0] = 12.5 + 25 / 65535
    assert wire.ask(EXIT)[1][1:3] == bytes.fromhex("0000")


def test_a_spring_pulls():
    # kp 50: 409.5 -> 199h is 49.9 N m/rad; kd 2: 1638 = 666h; target 1 rad: 8A3Dh
    wire = Wire(load="load.a")
    wire.enter()
    wire.ask(bytes.fromhex("8A3D7FF1996667FF"))
    wire.pass_time(2.0)
    assert wire.position[0] == pytest.approx(1.0, abs=1e-3)
    wire.load[0] = 5.0
    wire.pass_time(2.0)
    assert wire.position[0] == pytest.approx(1.0 + 5.0 / 49.94, rel=1e-3)


def test_registers():
    wire = Wire()
    velocity = wire.ask(bytes.fromhex("0500331600000000"), 0x7FF)
    assert velocity == (0x15, bytes.fromhex("050033160000F041"))  # 30.0 as a float
    assert wire.ask(bytes.fromhex("05005509E8030000"), 0x7FF)[1] == bytes.fromhex("05005509E8030000")
    assert wire.ask(bytes.fromhex("0600330900000000"), 0x7FF) is None  # another drive's
    assert wire.ask(bytes.fromhex("0500CC0000000000"), 0x7FF)[1][0] == 5
    wire.node.power_up(1.0)
    assert wire.ask(bytes.fromhex("0500330900000000"), 0x7FF)[1] == bytes.fromhex("0500330900000000")


def test_its_watchdog_and_the_way_out():
    wire = Wire()
    wire.ask(bytes.fromhex("05005509E8030000"), 0x7FF)  # 1000 x 50 us
    wire.enter()
    wire.pass_time(0.045)
    assert wire.node.is_on
    wire.pass_time(0.01)
    assert not wire.node.is_on
    assert wire.ask(ENTER)[1][0] == 0xD5
    assert wire.ask(CLEAR)[1][0] == 0x05
    assert wire.ask(ENTER)[1][0] == 0x15


def test_only_mit_mode_moves_it():
    wire = Wire()
    wire.ask(ENTER)
    wire.ask(bytes.fromhex("8A3D7FF1996667FF"))
    wire.pass_time(0.5)
    assert wire.position[0] == 0.0


def test_it_gets_hot():
    wire = Wire(heating=1.0)
    wire.enter()
    wire.load[0] = 0.0
    wire.ask(bytes.fromhex("FFFF7FFFFF0007FF"))
    wire.pass_time(2.0)
    assert not wire.node.is_on
    assert wire.ask(EXIT)[1][0] == 0xC5


def test_wrong_frames_and_no_power():
    wire = Wire()
    assert wire.ask(b"\xff" * 7) is None
    wire.node.is_muted = True
    assert wire.ask(EXIT) is None
    wire.node.power_down()
    assert wire.ask(EXIT) is None
    assert wire.node.condition == "off"
    assert math.isclose(wire.node.servo[0], 0.0)
