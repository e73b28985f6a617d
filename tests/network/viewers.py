"""Viewers of a robot through the router, all in one process: each a session of its own that wants everything.

    python viewers.py ROBOT CONNECT[,CONNECT...] HOW_MANY SECONDS

They share the endpoints or role files, because one person has a limited number of sessions. SECONDS is how long each
takes over a message. Prints `ready`, and ends with stdin. Viewers stand for other computers, whose work takes no
processor from the robot's: this one yields to everything else.
"""

import contextlib
import os
import sys
import time

import zenoh

from services.client import Client


def main(robot: str, connect: str, how_many: str, seconds: str) -> None:
    os.nice(19)

    def slowly(_: zenoh.Sample) -> None:
        time.sleep(float(seconds))

    with contextlib.ExitStack() as stack:
        kept, places = [], connect.split(",")
        for number in range(int(how_many)):
            client = stack.enter_context(Client(robot, [places[number % len(places)]], name=f"viewer {number}"))
            kept.append(client.session.declare_subscriber(f"gemuco/{robot}/**", slowly))
        print("ready", flush=True)
        sys.stdin.read()
        os._exit(0)


if __name__ == "__main__":
    main(*sys.argv[1:])
