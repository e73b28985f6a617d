"""Random frames at a whole HAL: bytes of chance, and frames of its own nodes that were changed.

    python tests/hal/fuzz.py --frames 1000000

What must hold: no handler raises, the cycle never raises, nothing is enabled by itself, what is disabled does not move,
what is enabled stays where it is, no value is valid that is not finite, memory stays bounded, and afterwards the HAL
works as before. A well-formed frame under a node's own identifier is that node's word, whoever sent it: a robot that is
off gets such frames too, and may believe what they measure; one that is enabled gets all others.
"""

import argparse
import contextlib
import random
import resource
import sys
import time

import can
import numpy as np
from conformance_stage import LockStage
from device_kinds import KINDS, NAME

from hal.errors import CommandRefused
from simulators.rig import Rig
from simulators.wire_faults import FaultyWire

PER_CYCLE = 50
SENTINEL = 0x7FE
MEMORY = 64_000
"""Growth of the process that a run may cause [kB]."""
STILL = 0.01
"""What an enabled drive may settle by [rad]."""


class FuzzStage(LockStage):
    """The nodes do not hear what is made up: it is the HAL that is put to the test."""

    def __init__(self, kind):
        config = kind.config()
        super().__init__(kind, config)
        near = config.buses["can0"]
        far = near.model_copy(update={"channel": f"{near.channel}_far"})
        self.rig = Rig(config.model_copy(update={"buses": {"can0": far}}), self.world, kind.hardware())
        self.wire = FaultyWire(
            can.Bus(interface="virtual", channel=near.channel), can.Bus(interface="virtual", channel=far.channel)
        )
        inner = self.rig.step
        self.rig.step = lambda duration: self._exchange(inner, duration)

    def _exchange(self, step, duration):
        self.wire.to_nodes(0.0)
        step(duration)
        self.wire.to_hal(0.0)

    def close(self):
        super().close()
        self.wire.close()


class Fuzzer:
    """Sends frames to one robot and looks at it after each cycle."""

    def __init__(self, stage, seed):
        self._stage = stage
        self._draw = random.Random(f"{stage.kind} {seed}")
        self._wire = stage.wires["can0"]
        self._heard, self._lengths = {}, {}
        self._is_gentle = False
        self.sent = 0
        self.powered = 0
        """Cycles in which the device was enabled."""

    def listen(self, cycles=12):
        """Learn what frames of this robot look like."""
        for _ in range(cycles):
            self._stage.cycle()
            while (message := self._wire.recv(0)) is not None:
                if message.arbitration_id != SENTINEL and not message.is_error_frame:
                    self._heard[message.arbitration_id] = bytes(message.data)
                    self._lengths.setdefault(message.arbitration_id, set()).add(len(message.data))

    def message(self):
        """One frame: of the robot's and changed, or made of chance."""
        draw = self._draw
        if draw.random() < 0.5:
            identifier = draw.choice(tuple(self._heard))
            data = self._changed(self._heard[identifier])
        elif draw.random() < 0.6:
            node = self._stage.kind.node
            identifier = draw.choice((draw.randrange(16) << 7 | node, node << 5 | draw.randrange(32), node + 16, 0))
            data = draw.randbytes(draw.randrange(9))
        else:
            identifier, data = draw.randrange(0x800), draw.randbytes(draw.randrange(9))
        if identifier == SENTINEL or (self._is_gentle and self._is_its_word(identifier, data)):
            return self.message()
        chance = draw.random()
        if chance < (0.0001 if self._is_gentle else 0.01):
            return can.Message(arbitration_id=draw.randrange(1 << 29), data=data, is_error_frame=True)
        if chance < 0.02:
            return can.Message(arbitration_id=identifier, is_remote_frame=True, dlc=len(data), is_extended_id=False)
        return can.Message(arbitration_id=identifier, data=data, is_extended_id=chance > 0.97)

    def _is_its_word(self, identifier, data):
        """Whether a node of this robot might have sent such a frame."""
        node = identifier & 0x7F
        is_emergency = identifier == 0x80 + node and len(data) == 8
        is_heartbeat = identifier == 0x700 + node and len(data) == 1
        return is_emergency or is_heartbeat or len(data) in self._lengths.get(identifier, ())

    def _changed(self, data):
        draw = self._draw
        kind = draw.randrange(5)
        if kind == 0:
            return data
        if kind == 1:
            return data[: draw.randrange(len(data) + 1)]
        if kind == 2:
            return (data + draw.randbytes(8))[: draw.randrange(len(data), 9)]
        if kind == 3:
            return draw.randbytes(len(data))
        place = draw.randrange(max(len(data), 1))
        return data[:place] + draw.randbytes(1) + data[place + 1 :] if data else data

    def cycle(self):
        """Some frames, one cycle, one look."""
        for _ in range(PER_CYCLE):
            self._stage.wire.pass_on(self.message())
        self.sent += PER_CYCLE
        self._stage.cycle()
        self._look()

    def _look(self):
        stage = self._stage
        assert stage.buses["can0"].counters["broken_handlers"] == 0, stage.buses["can0"].text
        for signal, valid in stage.sample.valid.items():
            assert np.isfinite(stage.sample.values[signal][valid]).all()
            limit = stage.config.signals[signal].stale_after
            assert (stage.sample.age[signal][valid] <= limit).all()

    def disabled(self, frames):
        """Fuzz a robot that is off: nothing moves, and nothing is ever enabled."""
        before = self._truth()
        for _ in range(frames // PER_CYCLE):
            self.cycle()
            assert not self._stage.is_powered, "enabled by a frame"
            assert self._stage.robot.mode in ("off", "fault")
        assert (self._truth() == before).all(), "moved by a frame"

    def enabled(self, frames):
        """Fuzz a robot that is enabled, and enabled again whenever that stopped it."""
        self._is_gentle = True
        for number in range(frames // PER_CYCLE):
            if number % 20 == 0 and self._stage.robot.mode in ("off", "fault"):
                self._try_to_enable()
                before = self._truth()
            self.cycle()
            self.powered += self._stage.is_powered
            assert np.abs(self._truth() - before).max() < STILL, "moved by a frame"
            self._hold()
        self._stage.robot.disable()

    def _hold(self):
        """A command that is alive in every cycle, to stay where it is."""
        stage = self._stage
        if stage.robot.mode in ("hold", "follow"):
            with contextlib.suppress(CommandRefused):
                stage.robot.command(stage.applied.values, stage.sample.cycle)

    def _try_to_enable(self):
        try:
            self._stage.robot.reset()
            self._stage.cycle()
            self._stage.robot.enable()
        except CommandRefused:
            return

    def mend(self):
        """After the fuzz: what a node was made to say of itself is forgotten, if need be by restarting it."""
        stage = self._stage
        stage.until(lambda: not stage.is_powered and stage.robot.mode in ("off", "fault"), "letting go")
        stage.cycle(200)
        if not stage.is_valid:
            stage.rig.fault(f"node_reboot {NAME}")
            stage.cycle(20)
        stage.until(stage.is_reset, "being reset")
        stage.until(lambda: stage.is_ready, "being ready again")

    def _truth(self):
        """Where whatever can move is, shape (n,)."""
        truth = self._stage.world.truth()
        return np.concatenate([truth[name] for name in ("thing_position", "mover_position") if name in truth])


def fuzz(kind, frames, seed=0):
    """Fuzz a robot with one kind of device, half of the frames while it is enabled; then use it."""
    stage = FuzzStage(kind).open()
    try:
        stage.settle()
        fuzzer = Fuzzer(stage, seed)
        fuzzer.listen()
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        fuzzer.disabled(frames // 2)
        fuzzer.mend()
        fuzzer.enabled(frames // 2)
        assert fuzzer.powered > frames // 2 // PER_CYCLE // 4, "hardly ever enabled"
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        assert grown < MEMORY, f"{grown} kB more memory"
        fuzzer.mend()
        stage.enable_again()
        return fuzzer.sent
    finally:
        stage.close()


def main(arguments):
    """Every kind of device."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=1_000_000, help="over all kinds of devices")
    options = parser.parse_args(arguments)
    start, sent = time.monotonic(), 0
    for kind in KINDS:
        sent += fuzz(kind, -(-options.frames // len(KINDS) // PER_CYCLE) * PER_CYCLE)
        print(f"{kind}: {sent} frames, nothing raised, nothing moved", flush=True)
    print(f"{sent} frames in {time.monotonic() - start:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
