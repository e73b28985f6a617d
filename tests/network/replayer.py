"""Plays what it has heard on a robot's keys again, byte for byte, some seconds later and once more at once.

    python replayer.py ROBOT CONNECT SECONDS

It stands for a network that delivers twice and late, and for someone with a recording. Prints `ready` when its memory
is SECONDS long and it plays, and ends with stdin; then it prints how many messages it has played.
"""

import os
import sys
import time
from collections import deque

import zenoh

from services.wire.session import close_session, open_session

KEYS = ("hal/sample", "hal/command", "hal/applied", "vision/sample", "model/target")


def main(robot: str, connect: str, seconds: str) -> None:
    os.nice(19)
    session = open_session(robot, "client", [connect])
    memory: deque[tuple[float, str, bytes]] = deque()
    played = [0]

    def heard(sample: zenoh.Sample) -> None:
        now, key, data = time.monotonic(), str(sample.key_expr), sample.payload.to_bytes()
        memory.append((now, key, data))
        while memory[0][0] < now - float(seconds):
            _, *old = memory.popleft()
            session.put(*old)
            session.put(key, data)
            played[0] += 2

    kept = [
        session.declare_subscriber(f"gemuco/{robot}/{key}", heard, allowed_origin=zenoh.Locality.REMOTE) for key in KEYS
    ]
    time.sleep(float(seconds))
    print("ready", flush=True)
    sys.stdin.read()
    print(played[0], flush=True)
    kept.clear()
    close_session(session)


if __name__ == "__main__":
    main(*sys.argv[1:])
