"""Other programs on the robot's network: ten clients, one that plays messages again, and one that floods.

    python -m studies.stack.soak.others watch ROBOT ROUTER
    python -m studies.stack.soak.others replay ROBOT ROUTER
    python -m studies.stack.soak.others flood ROBOT ROUTER

Each runs until it is ended and then prints its counts as JSON.
"""

import json
import os
import random
import signal
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import zenoh

from hal.errors import HalError
from services.client import Client
from services.errors import ServiceError
from services.wire import keys, messages
from services.wire.session import CLIENT, close_session, open_session

MEMORY = 6.0
"""The replayer plays each message at once and after this time [s]."""
PLAYED = ("hal/sample", "hal/command", "hal/applied", "hal/holder", "model/estimate", "model/target")
SENDERS = 20
"""The flood comes in the name of this number of clients."""


class Watchers:
    """Ten clients with sessions of their own: seven read, one is slow, one asks, one comes and goes."""

    def __init__(self, robot: str, router: str) -> None:
        self.counts: Counter[str] = Counter(backwards=0)
        self._robot, self._router = robot, router
        jobs: list[Callable[[Client], None]] = [
            *4 * [lambda client: self._read("estimates", client)],
            *2 * [lambda client: self._read("sensors", client)],
            lambda client: self._read("health", client),
            lambda client: self._read("slow", client),
            self._ask,
            self._visit,
        ]
        for number, job in enumerate(jobs):
            threading.Thread(target=self._run, args=(job, f"client {number}"), daemon=True).start()

    def _run(self, job: Callable[[Client], None], name: str) -> None:
        while True:
            try:
                with Client(self._robot, (self._router,), name) as client:
                    while True:
                        job(client)
                        if job == self._visit:
                            break
            except (ServiceError, HalError) as error:  # while a process is dead
                self.counts[type(error).__name__] += 1
                time.sleep(0.5)

    def _read(self, kind: str, client: Client) -> None:
        """Read messages until one does not come."""
        iterator: Iterator[Any] = client.estimates()
        if kind in ("sensors", "health"):
            iterator = client.sensors() if kind == "sensors" else client.health()
        before = None
        for message in iterator:
            self.counts[kind] += 1
            stamp = getattr(message, "stamp_ns", None)
            self.counts["backwards"] += before is not None and stamp is not None and stamp <= before
            before = stamp
            if kind == "slow":
                time.sleep(1.0)

    def _ask(self, client: Client) -> None:
        """Ask two verbs, twice a second."""
        client.describe("model")
        client.history(2.0)
        self.counts["answers"] += 2
        time.sleep(0.5)

    def _visit(self, client: Client) -> None:
        """Read one second of estimates; the caller ends the session."""
        until = time.monotonic() + 1.0
        for _ in client.estimates():
            if time.monotonic() > until:
                break
        self.counts["visits"] += 1


class Replayer:
    """Player of everything that it has heard, byte for byte, at once and `MEMORY` later."""

    def __init__(self, robot: str, router: str) -> None:
        self.counts: Counter[str] = Counter()
        self._session = open_session(robot, CLIENT, (router,))
        self._memory: deque[tuple[float, str, bytes]] = deque()
        self._subscribers = [
            self._session.declare_subscriber(
                f"gemuco/{robot}/{key}", self._hear, allowed_origin=zenoh.Locality.REMOTE
            )
            for key in PLAYED
        ]  # fmt: skip

    def _hear(self, sample: zenoh.Sample) -> None:
        now, key, data = time.monotonic(), str(sample.key_expr), sample.payload.to_bytes()
        self._memory.append((now, key, data))
        self._session.put(key, data)
        self.counts["played"] += 1
        while self._memory[0][0] < now - MEMORY:
            _, key, data = self._memory.popleft()
            self._session.put(key, data)
            self.counts["played"] += 1

    def close(self) -> None:
        """Leave the network."""
        close_session(self._session)


class Flood:
    """Sender of commands, targets and random bytes in the name of many clients, as fast as it can."""

    def __init__(self, robot: str, router: str) -> None:
        self.counts: Counter[str] = Counter()
        self._session = open_session(robot, CLIENT, (router,))
        now, zeros, chance = time.time_ns(), np.zeros(2), random.Random(0)
        self._lots = []
        for boot in range(100, 100 + SENDERS):
            header = {"boot": boot, "seq": 7}
            command = messages.Command(signal="motor_position", values=zeros, cycle=1, hal_boot=1, stamp_ns=now)
            target = messages.Target(signal="joint_position", values=zeros, cycle=1, hal_boot=1, stamp_ns=now)
            self._lots.append((keys.command(robot), messages.encode(command, **header)))
            self._lots.append((keys.target(robot), messages.encode(target, **header)))
            self._lots.append((keys.command(robot), chance.randbytes(200)))
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while not self._session.is_closed():
            for lot in self._lots:
                self._session.put(*lot)
            self.counts["sent"] += len(self._lots)

    def close(self) -> None:
        """Leave the network."""
        close_session(self._session)


def main(kind: str, robot: str, router: str) -> None:
    """Run one of the programs until SIGTERM."""
    end = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: end.set())
    os.nice(10)
    programs: dict[str, type[Watchers | Replayer | Flood]] = {"watch": Watchers, "replay": Replayer, "flood": Flood}
    program = programs[kind](robot, router)
    end.wait()
    print(json.dumps(program.counts), flush=True)
    os._exit(0)  # its clients' threads never end


if __name__ == "__main__":
    main(*sys.argv[1:])
