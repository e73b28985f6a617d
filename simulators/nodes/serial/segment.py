"""One serial line with all the simulated servos on it, behind a pseudo-terminal."""

import contextlib
import fcntl
import os
import select
import threading
import time
import tty
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType

from hal.config import BusConfig
from hal.line.port import path_of
from simulators.nodes.canopen.spec import NodeSpec
from simulators.nodes.plant import Plant
from simulators.nodes.serial import dynamixel, feetech
from simulators.nodes.serial.dynamixel import DynamixelNode
from simulators.nodes.serial.feetech import FeetechNode
from simulators.nodes.serial.node import SerialConstants, SerialNode

TICK = 0.005
"""Servos are advanced at this interval [s]."""
_MAKES: dict[str, tuple[ModuleType, type[SerialNode], int]] = {
    "feetech": (feetech, FeetechNode, 2),
    "dynamixel": (dynamixel, DynamixelNode, 4),
}
"""Make -> its module, its node, and the number of bytes of address and size in a request for several servos."""


class LineSegment:
    """The servos of one line. A servo that is silent keeps those silent that answer a common request after it."""

    def __init__(self, name: str, specs: Sequence[NodeSpec], plant: Plant, config: BusConfig) -> None:
        """Make the servos; there is no terminal yet.

        Raises:
            ValueError: A node is no servo of a serial line, or the servos are of two makes.
        """
        self.name = name
        self.lock = threading.Lock()
        """Lock of every thread that uses the nodes."""
        self.counters = {"received": 0, "sent": 0, "lost": 0, "reopened": 0}
        makes = set()
        for spec in specs:
            if not isinstance(spec.constants, SerialConstants):
                raise ValueError(f"Node '{spec.name}' is no servo of a serial line, and bus '{name}' is one.")
            makes.add(spec.constants.make)
        if len(makes) > 1:
            raise ValueError(f"Line '{name}' has servos of {' and '.join(sorted(makes))}; give each make its own.")
        self._make = makes.pop() if makes else "feetech"
        self._protocol, kind, self._head = _MAKES[self._make]
        self.nodes: dict[str, SerialNode] = {spec.name: kind(spec, plant) for spec in specs}
        self._by_id = {node.spec.node: node for node in self.nodes.values()}
        self._path = path_of(config.interface, config.channel)
        self._per_byte = 10 / config.bitrate if config.options.get("bit_timing") else 0.0
        self._received = bytearray()
        self._master = self._slave = -1
        self._guard: int | None = None

    def open(self, now: float) -> None:
        """Make the terminal and its link, and switch the servos on.

        Raises:
            OSError: Another program serves this channel.
        """
        self._path.parent.mkdir(parents=True, exist_ok=True)
        guard = os.open(f"{self._path}.lock", os.O_CREAT | os.O_RDWR, 0o600)
        try:
            fcntl.flock(guard, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(guard)
            raise OSError(f"another program serves '{self._path}'") from None
        self._guard = guard
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        link = Path(f"{self._path}.new")
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(self._slave))
        link.replace(self._path)
        with self.lock:
            for node in self.nodes.values():
                node.power_up(now)

    def close(self) -> None:
        """Remove the terminal. Safe to call twice."""
        if self._guard is None:
            return
        with contextlib.suppress(OSError):
            if self._path.readlink() == Path(os.ttyname(self._slave)):
                self._path.unlink()
        os.close(self._master)
        os.close(self._slave)
        os.close(self._guard)
        self._guard = None

    def answer(self, now: float) -> None:
        """Take every packet that waits, and answer."""
        with self.lock:
            self._take(0.0, lambda: now)

    def tick(self, now: float) -> None:
        """Let time pass for every servo."""
        with self.lock:
            for node in self.nodes.values():
                node.tick(now)

    def serve(self, monotonic: Callable[[], float], is_running: Callable[[], bool]) -> None:
        """Answer and tick in real time until stopped."""
        due = monotonic()
        while is_running():
            ready, _, _ = select.select([self._master], [], [], max(due - monotonic(), 0.0))
            if ready:
                with self.lock:
                    self._take(0.0, monotonic)
            if monotonic() >= due:
                self.tick(monotonic())
                due = max(due + TICK, monotonic())

    def _take(self, timeout: float, clock: Callable[[], float]) -> None:
        while True:
            try:
                chunk = os.read(self._master, 4096)
            except (BlockingIOError, OSError):
                return
            if not chunk:
                return
            self._received += chunk
            for identifier, instruction, parameters in self._protocol.packets(self._received):
                self.counters["received"] += 1
                self._handle(identifier, instruction, parameters, clock())

    def _handle(self, identifier: int, instruction: int, parameters: bytes, now: float) -> None:
        protocol = self._protocol
        for node in self.nodes.values():
            if isinstance(node, DynamixelNode):
                node.heard(now)
        if instruction == protocol.SYNC_READ:
            self._sync_read(parameters, now)
        elif instruction == protocol.SYNC_WRITE:
            self._sync_write(parameters, now)
        elif identifier == protocol.BROADCAST:
            for number in sorted(self._by_id):
                self._reply(self._by_id[number], instruction, parameters, True, now)
        elif identifier in self._by_id:
            self._reply(self._by_id[identifier], instruction, parameters, False, now)

    def _sync_read(self, parameters: bytes, now: float) -> None:
        head, numbers = parameters[: self._head], parameters[self._head :]
        for number in numbers:
            node = self._by_id.get(number)
            if node is None or not self._reply(node, self._protocol.SYNC_READ, head, True, now):
                return

    def _sync_write(self, parameters: bytes, now: float) -> None:
        half = self._head // 2
        address = parameters[:half]
        size = int.from_bytes(parameters[half : self._head], "little")
        rest = parameters[self._head :]
        for start in range(0, len(rest) - size, size + 1):
            node = self._by_id.get(rest[start])
            if node is not None and not node.is_deaf(now):
                node.answer(self._protocol.SYNC_WRITE, address + rest[start + 1 : start + 1 + size], True, now)

    def _reply(self, node: SerialNode, instruction: int, parameters: bytes, is_broadcast: bool, now: float) -> bool:
        """Let a servo answer, and return whether it did."""
        if node.is_deaf(now):
            return False
        packet = node.answer(instruction, parameters, is_broadcast, now)
        if packet is None or node.is_muted:
            return False
        if self._per_byte:
            time.sleep(self._per_byte * len(packet))
        try:
            os.write(self._master, packet)
        except OSError:
            self.counters["lost"] += 1
            return False
        self.counters["sent"] += 1
        return True
