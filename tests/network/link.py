"""Two network namespaces joined by a link that is as bad as one likes: two TUN devices and a process between them.

The kernel of a small machine often has no netem; this needs only /dev/net/tun and the right to make namespaces. Run as
a program it is the process between: it opens both devices, prints `ready`, and takes one JSON map per line from stdin,
such as {"down": {"cut": true}, "up": {"delay": 0.05, "loss": 0.01}}; "down" is from the first namespace to the second.
Each line is answered by one with the counters of both directions.
"""

import contextlib
import ctypes
import fcntl
import heapq
import json
import os
import random
import selectors
import struct
import subprocess
import sys
import time
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Self

PREFIX = "gmn"
CLONE_NEWNET = 0x40000000
TUNSETIFF = 0x400454CA
IFF_TUN_NO_PI = 0x1001
MTU = 1400
QUEUE = 256 * 1024
"""Bytes that wait in each direction at most, as in a home router; more are dropped."""
REPEAT_EACH_SECOND = "net.ipv4.tcp_rto_max_ms=1000"
BURST = 64
PRIORITY = 60
"""SCHED_FIFO: above everything of the stack."""


def missing() -> str:
    """Why no such link can be made here; empty if it can."""
    if os.geteuid() != 0:
        return "namespaces need root"
    if subprocess.run(["sh", "-c", "command -v ip"], capture_output=True, check=False).returncode:
        return "no `ip` (package iproute2)"
    if not Path("/dev/net/tun").exists():
        return "no /dev/net/tun"
    name = f"{PREFIX}{os.getpid()}t"
    made = subprocess.run(["ip", "netns", "add", name], capture_output=True, text=True, check=False)
    if made.returncode:
        return f"no namespaces: {made.stderr.strip()}"
    subprocess.run(["ip", "netns", "delete", name], check=False)
    return ""


def sweep() -> None:
    """Delete namespaces of runs whose process is gone."""
    listed = subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=False).stdout
    for name in (line.split()[0] for line in listed.splitlines() if line.startswith(PREFIX)):
        pid = name.removeprefix(PREFIX)[:-1]
        if pid.isdigit() and not Path(f"/proc/{pid}").exists():
            subprocess.run(["ip", "netns", "delete", name], check=False)


@dataclass(slots=True)
class Way:
    """One direction: what is wrong with it, and what is on its way."""

    cut: bool = False
    delay: float = 0.0
    """[s]"""
    jitter: float = 0.0
    """Up to so much more delay [s], evenly spread; the order is kept."""
    loss: float = 0.0
    """Share of packets."""
    rate: float = 0.0
    """[bit/s]; 0 without limit."""
    twice: float = 0.0
    """Share of packets that come twice."""
    swapped: float = 0.0
    """Share of packets that come up to `lateness` later, after packets that were sent after them."""
    lateness: float = 0.03
    """[s]"""
    counters: dict[str, int] = field(default_factory=lambda: {"sent": 0, "bytes": 0, "lost": 0, "overflow": 0})
    waiting: list[tuple[float, int, bytes]] = field(default_factory=list)
    waiting_bytes: int = 0
    busy_until: float = 0.0
    last_due: float = 0.0
    number: int = 0

    def change(self, wanted: dict[str, Any]) -> None:
        for name, value in wanted.items():
            if name not in GOOD:
                raise ValueError(f"a way has no '{name}'")
            setattr(self, name, value)

    def take(self, packet: bytes, now: float, chance: random.Random) -> None:
        """A packet enters."""
        if self.cut or (self.loss and chance.random() < self.loss):
            self.counters["lost"] += 1
            return
        if self.waiting_bytes + len(packet) > QUEUE and self.rate:
            self.counters["overflow"] += 1
            return
        due = now
        if self.rate:
            self.busy_until = due = max(now, self.busy_until) + 8 * len(packet) / self.rate
        due += self.delay + (chance.random() * self.jitter if self.jitter else 0.0)
        self.last_due = due = max(due, self.last_due)
        if self.swapped and chance.random() < self.swapped:
            due += chance.random() * self.lateness
        for _ in range(2 if self.twice and chance.random() < self.twice else 1):
            self.number += 1
            self.waiting_bytes += len(packet)
            heapq.heappush(self.waiting, (due, self.number, packet))

    def give(self, now: float, device: int) -> None:
        """Packets whose time has come leave; those on their way when the link was cut are lost."""
        while self.waiting and self.waiting[0][0] <= now:
            packet = heapq.heappop(self.waiting)[2]
            self.waiting_bytes -= len(packet)
            if self.cut:
                self.counters["lost"] += 1
                continue
            self.counters["sent"] += 1
            self.counters["bytes"] += len(packet)
            try:
                os.write(device, packet)
            except OSError:  # the device is going down
                self.counters["lost"] += 1


def device_in(namespace: str) -> int:
    """Make a TUN device in a namespace, and come back."""
    libc = ctypes.CDLL(None, use_errno=True)
    home = os.open("/proc/self/ns/net", os.O_RDONLY)
    away = os.open(f"/run/netns/{namespace}", os.O_RDONLY)
    try:
        if libc.setns(away, CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), f"setns to {namespace}")
        device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH", b"wire", IFF_TUN_NO_PI))
        if libc.setns(home, CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), "setns back home")
        return device
    finally:
        os.close(home)
        os.close(away)


def forward(first: str, second: str, seed: int) -> None:
    """The process between two namespaces; ends with stdin."""
    devices = {"down": device_in(first), "up": device_in(second)}
    ends = {"down": devices["up"], "up": devices["down"]}
    ways = {name: Way() for name in devices}
    chance = random.Random(seed)
    selector = selectors.DefaultSelector()
    for name, device in devices.items():
        selector.register(device, selectors.EVENT_READ, name)
    selector.register(sys.stdin.fileno(), selectors.EVENT_READ, "")
    with contextlib.suppress(OSError):  # or whatever else the machine does would be part of the link
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    print("ready", flush=True)
    rest = b""
    while True:
        due = min((way.waiting[0][0] for way in ways.values() if way.waiting), default=None)
        wait = None if due is None else max(0.0, due - time.monotonic())
        for key, _ in selector.select(wait):
            if not key.data:
                heard = os.read(key.fd, 65536)
                if not heard:
                    return
                *lines, rest = (rest + heard).split(b"\n")
                for line in lines:
                    for name, wanted in json.loads(line).items():
                        ways[name].change(wanted)
                    report = {name: way.counters for name, way in ways.items()}
                    print(json.dumps({"at": time.monotonic(), **report}), flush=True)
                continue
            for _ in range(BURST):
                try:
                    packet = os.read(key.fd, 65536)
                except OSError:
                    break
                ways[key.data].take(packet, time.monotonic(), chance)
        now = time.monotonic()
        for name, way in ways.items():
            way.give(now, ends[name])


class Link:
    """Namespaces `first` (address 10.77.0.1) and `second` (10.77.0.2) and the link between, as a context manager."""

    ADDRESS: ClassVar = {"first": "10.77.0.1", "second": "10.77.0.2"}

    def __init__(self, seed: int = 0) -> None:
        self.first, self.second = f"{PREFIX}{os.getpid()}a", f"{PREFIX}{os.getpid()}b"
        self._seed = seed
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        sweep()
        try:
            for name in (self.first, self.second):
                _ip("netns", "add", name)
                _ip("-n", name, "link", "set", "lo", "up")
                _settle(name)
            self._process = subprocess.Popen(
                [sys.executable, __file__, self.first, self.second, str(self._seed)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
            )  # fmt: skip
            if self._line() != "ready":
                raise RuntimeError("The link's process did not start.")
            for name, here, there in (
                (self.first, self.ADDRESS["first"], self.ADDRESS["second"]),
                (self.second, self.ADDRESS["second"], self.ADDRESS["first"]),
            ):
                _ip("-n", name, "address", "add", here, "peer", there, "dev", "wire")
                _ip("-n", name, "link", "set", "dev", "wire", "mtu", str(MTU), "txqueuelen", "200", "up")
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
        for name in (self.first, self.second):
            subprocess.run(["ip", "netns", "delete", name], capture_output=True, check=False)

    @property
    def pid(self) -> int:
        """Of the process between."""
        assert self._process is not None
        return self._process.pid

    def set(self, down: dict[str, Any] | None = None, up: dict[str, Any] | None = None) -> float:
        """Change one direction or both; returns when it was done [monotonic s]."""
        return float(self.ask(({"down": down} if down else {}) | ({"up": up} if up else {}))["at"])

    def both(self, **wanted: Any) -> float:
        """Change both directions alike; see `set`."""
        return self.set(wanted, wanted)

    def heal(self) -> float:
        """Make the link good again; see `set`."""
        plain = Way()
        good = {one.name: getattr(plain, one.name) for one in fields(Way) if one.name in GOOD}
        return self.set(good, good)

    def ask(self, wanted: dict[str, Any]) -> dict[str, Any]:
        """Send a change, possibly an empty one; returns the counters."""
        assert self._process is not None
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(wanted) + "\n")
        self._process.stdin.flush()
        return dict(json.loads(self._line()))

    def _line(self) -> str:
        assert self._process is not None
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


GOOD = ("cut", "delay", "jitter", "loss", "rate", "twice", "swapped", "lateness")


def inside(namespace: str, *command: str) -> list[str]:
    """The command line that runs a program in a namespace."""
    return ["ip", "netns", "exec", namespace, *command]


def _settle(namespace: str) -> None:
    """Have the kernel (6.15 and later) repeat each second what nobody confirms, as docs/network.md asks."""
    subprocess.run(inside(namespace, "sysctl", "-qw", REPEAT_EACH_SECOND), capture_output=True, check=False)


def _ip(*words: str) -> None:
    done = subprocess.run(["ip", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"`ip {' '.join(words)}` failed: {done.stderr.strip()}")


if __name__ == "__main__":
    forward(sys.argv[1], sys.argv[2], int(sys.argv[3]))
