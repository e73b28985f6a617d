"""A bench for nodes: one drive, one load cell and one encoder on a world of three springs, and a bare-frame master."""

import struct
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import can
import numpy as np

from hal.config import RobotConfig
from simulators.nodes.canopen.spec import CellConstants, DriveConstants, EncoderConstants, NodeSpec
from simulators.rig import Rig

DRIVE, CELL, ENCODER = 3, 13, 23
SPECS = [
    NodeSpec(
        "wire_drive",
        "can0",
        DRIVE,
        "muscle_length.wire",
        DriveConstants(direction=-1, zero=0.3, load="muscle_tension.wire"),
    ),
    NodeSpec("wire_cell", "can0", CELL, "muscle_tension.wire", CellConstants(unbalance=1.5)),
    NodeSpec("hinge_encoder", "can0", ENCODER, "joint_position.hinge", EncoderConstants()),
]


class SpringWorld:
    """First-order servo on a wire; tension and joint angle are what the test says."""

    def __init__(self) -> None:
        self.time = 0.0
        self.length, self.target, self.enabled = 0.3, 0.3, False
        self.tension, self.angle = 20.0, 0.5
        self.broken: list[str] = []
        self.is_closed = False

    def step(self, duration: float) -> None:
        if self.enabled:
            self.length += (self.target - self.length) * (1.0 - np.exp(-duration / 0.01))
        self.time += duration

    def measure(self) -> Mapping[str, np.ndarray]:
        return self.truth()

    def truth(self) -> Mapping[str, np.ndarray]:
        return {
            "joint_position": np.array([self.angle]),
            "muscle_tension": np.array([self.tension]),
            "muscle_length": np.array([self.length]),
        }

    def drive(self, element: str, target: float, enabled: bool) -> None:
        assert element == "muscle_length.wire"
        self.target, self.enabled = target, enabled

    def break_part(self, part: str) -> None:
        if part != "muscle_cut:wire":
            raise ValueError(f"'{part}' is not a part that can break. Known parts: muscle_cut:wire.")
        self.broken.append(part)

    def close(self) -> None:
        self.is_closed = True


def config(interface: str = "virtual", channel: str | None = None, **bus: object) -> RobotConfig:
    signals = {
        "joint_position": {"unit": "rad", "elements": ["hinge"]},
        "muscle_tension": {"unit": "N", "elements": ["wire"]},
        "muscle_length": {"unit": "m", "elements": ["wire"]},
    }
    channel = channel or f"bench_{uuid.uuid4().hex[:12]}"
    return RobotConfig.model_validate(
        {
            "robot": "bench",
            "signals": signals,
            "command": {"signal": "muscle_length"},
            "buses": {"can0": {"interface": interface, "channel": channel, **bus}},
        }
    )


class Bench:
    """Moves a rig by hand and speaks to its nodes in bare frames."""

    def __init__(self, specs: list[NodeSpec] = SPECS) -> None:
        self.config = config()
        self.world = SpringWorld()
        self.bus = can.Bus(interface="virtual", channel=self.config.buses["can0"].channel)
        self.rig = Rig(self.config, self.world, specs)
        self.heard: list[tuple[int, bytes]] = []
        self.step(0.0)

    def step(self, duration: float, pieces: int = 1) -> list[tuple[int, bytes]]:
        """Let time pass; the frames that came meanwhile."""
        heard = []
        for _ in range(pieces):
            self.rig.step(duration / pieces)
            while (message := self.bus.recv(0)) is not None:
                heard.append((message.arbitration_id, bytes(message.data)))
        self.heard += heard
        return heard

    def send(self, identifier: int, data: bytes = b"") -> list[tuple[int, bytes]]:
        """Send a frame; the frames that answer it."""
        self.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        return self.step(0.0)

    def sync(self) -> dict[int, bytes]:
        return dict(self.send(0x80))

    def nmt(self, command: int, node: int = 0) -> list[tuple[int, bytes]]:
        return self.send(0, bytes([command, node]))

    def sdo(self, node: int, request: bytes) -> bytes:
        answers = [data for identifier, data in self.send(0x600 + node, request) if identifier == 0x580 + node]
        assert len(answers) == 1
        return answers[0]

    def write(self, node: int, index: int, sub: int, form: str, value: float) -> int:
        """Expedited download; 0, or the abort code."""
        data = struct.pack("<" + form, value)
        head = struct.pack("<BHB", 0x23 | 4 - len(data) << 2, index, sub)
        answer = self.sdo(node, (head + data).ljust(8, b"\0"))
        return struct.unpack_from("<I", answer, 4)[0] if answer[0] == 0x80 else 0

    def read(self, node: int, index: int, sub: int, form: str) -> float:
        """Expedited upload."""
        answer = self.sdo(node, struct.pack("<BHB", 0x40, index, sub).ljust(8, b"\0"))
        assert answer[0] & 0xE0 == 0x40, answer.hex()
        return struct.unpack_from("<" + form, answer, 4)[0]

    def close(self) -> None:
        self.rig.stop()
        self.bus.shutdown()


@contextmanager
def bench(specs: list[NodeSpec] = SPECS) -> Iterator[Bench]:
    made = Bench(specs)
    try:
        yield made
    finally:
        made.close()
