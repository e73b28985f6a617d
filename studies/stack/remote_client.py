"""Time of a question through the client, beside a bare zenoh query with the same bytes; and of importing the client.

    python -m studies.stack.remote_client [--questions 1000] [--router]

The model service of a light robot runs in one process, a bare queryable that answers the same bytes in another; both
are asked in turn, so that other load on the machine slows both. `--router`: all of it through a router.
"""

import argparse
import multiprocessing
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path

import msgpack
import numpy as np
import zenoh

from services.client import Client
from services.errors import NotAllowed, ServiceUnavailable
from services.wire.session import CLIENT, endpoint, open_session
from studies.stack import light_model, light_robot

RATE = 50.0
KEY = "bare/echo"
BARE = "bare zenoh query, the same bytes"
VERB = "Client.estimate(values, hide): 3 signals"
READ = "Client.estimate(): the newest published"


def echo(robot: str, connect: tuple[str, ...], answer: bytes) -> None:
    """Answer always with the same bytes, in a separate process, in place of a recorder."""
    session = open_session(robot, "recorder", connect)

    def reply(query: zenoh.Query) -> None:
        with query:
            query.reply(KEY, answer)

    session.declare_queryable(KEY, reply)
    while True:
        time.sleep(1.0)


def ask_bare(session: zenoh.Session, question: bytes) -> None:
    """Query the echo and read its answer."""
    for reply in session.get(KEY, payload=question, timeout=10.0):
        if reply.ok is not None:
            reply.ok.payload.to_bytes()


def timed(ask: Callable[[], object]) -> float:
    """Return the time of one call [s]."""
    begun = time.perf_counter()
    ask()
    return time.perf_counter() - begun


def line(what: str, times: list[float]) -> str:
    """Return a line of the table; times in s."""
    p50, p99 = (1e3 * float(np.percentile(times, q)) for q in (50, 99))
    return f"{what:44s} p50 {p50:7.2f} ms   p99 {p99:7.2f} ms"


def imports(rounds: int = 7) -> dict[str, float]:
    """Return the median wall time [s] of each import, in interpreters of their own, in turn."""
    statements = ("import numpy, zenoh", "import services.client")
    times: dict[str, list[float]] = {statement: [] for statement in statements}
    for _ in range(rounds):
        for statement in statements:
            program = f"import time; begun = time.perf_counter(); {statement}; print(time.perf_counter() - begun)"
            done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
            times[statement].append(float(done.stdout))
    return {statement: statistics.median(values) for statement, values in times.items()}


def measure(client: Client, connect: tuple[str, ...], questions: int) -> dict[str, list[float]]:
    """Ask both in turn; return question -> times [s]."""
    while client.estimate(timeout=60.0) is None:
        pass
    schema = client.describe("model", timeout=60.0)["signals"]
    values = {name: [0.1] * len(one["elements"]) for name, one in schema.items()}
    asked = {"values": values, "hide": ["joint_position"]}
    question = msgpack.packb(asked)
    answer = msgpack.packb({"ok": client.ask("model", "estimate", asked, 60.0)})
    child = multiprocessing.get_context("spawn").Process(target=echo, args=(client.robot, connect, answer), daemon=True)
    child.start()
    places = connect or (endpoint(client.robot, "recorder"),)  # the client connects to the recorder by itself otherwise
    times: dict[str, list[float]] = {BARE: [], VERB: [], READ: []}
    with when_there(client.robot, places) as bare:
        while not any(reply.ok for reply in bare.get(KEY, payload=question, timeout=1.0)):
            time.sleep(0.05)
        for _ in range(questions):
            times[BARE].append(timed(lambda: ask_bare(bare, question)))
            times[VERB].append(timed(lambda: client.estimate(values, ["joint_position"])))
            times[READ].append(timed(client.estimate))
    child.kill()
    return times


def when_there(robot: str, places: tuple[str, ...]) -> zenoh.Session:
    """Open a session with a process that may still be starting, within 20 s."""
    deadline = time.monotonic() + 20.0
    while True:
        try:
            return open_session(robot, CLIENT, places)
        except (ServiceUnavailable, NotAllowed):  # on a busy machine its port is there before it answers
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)


@contextmanager
def robot_and_client(through_router: bool) -> Iterator[tuple[Client, tuple[str, ...]]]:
    """Yield a client of a light robot in a process of its own, and the endpoints of its router."""
    robot = f"remote_{os.getpid()}"
    with tempfile.TemporaryDirectory() as folder:
        file = light_robot.write(Path(folder), robot, RATE, with_bus=False)
        light_model.make(file, Path(folder) / "model")
        where = f"unixsock-stream/{folder}/router" if through_router else ""
        settings = (
            f'{{mode: "router", listen: {{endpoints: ["{where}"]}}, scouting: {{multicast: {{enabled: false}}}}}}'
        )
        with zenoh.open(zenoh.Config.from_json5(settings)) if where else nullcontext():
            process = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "studies.stack.in_process",
                    str(file),
                    f"--model={folder}/model",
                    f"--connect={where}",
                ]
            )
            try:
                connect = (where,) if where else ()
                with Client(robot, connect) as client:
                    yield client, connect
            finally:
                process.terminate()
                process.wait(60.0)


def main() -> None:
    """Start the robot, measure, end it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--questions", type=int, default=1000)
    parser.add_argument("--router", action="store_true")
    asked = parser.parse_args()
    for statement, seconds in imports().items():
        print(f"{statement:44s} {1e3 * seconds:.0f} ms")
    with robot_and_client(asked.router) as (client, connect):
        for what, times in measure(client, connect, asked.questions).items():
            print(line(what, times))
        time.sleep(max(0.0, 20.0 - asked.questions * 0.005))
        for seconds in (1.0, 60.0):
            rows = len(client.history(seconds).stamp_ns)
            took = [timed(partial(client.history, seconds)) for _ in range(20)]
            print(line(f"Client.history({seconds:g}): {rows} rows", took))


if __name__ == "__main__":
    main()
