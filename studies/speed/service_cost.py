"""What the running service costs beside its loops: messages, memory, and a question from elsewhere.

python -m studies.speed.service_cost
"""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import msgpack
import numpy as np

from hal.config import load_robot
from services.wire import messages
from services.wire.messages import Sample
from studies.speed import highest_rate
from studies.speed.table import Row, faster
from studies.stack import way_through
from studies.stack.publish import examples
from studies.stack.remote_client import BARE, VERB, measure, robot_and_client

ROBOT = Path("robots/musashi_arm.yaml")
QUESTIONS = 400
RUNNING = """
import sys
from gemuco.warm import warm
import services.model.gemuco_service
if sys.argv[1] == "torch":
    import torch
warm(is_service=True)
print(int(open("/proc/self/statm").read().split()[1]) * 4096 / 1e6)
"""


def codec() -> Row:
    """A sample as it is published, and the same content as lists of numbers."""
    sample, _ = examples(load_robot(ROBOT))
    parts = ("values", "age", "valid")

    def ours() -> Sample:
        return messages.decode(messages.encode(sample), Sample)

    def lists() -> dict[str, dict[str, np.ndarray]]:
        told = {part: {name: one.tolist() for name, one in getattr(sample, part).items()} for part in parts}
        told |= {"type": "sample", "v": 1, "stamp_ns": sample.stamp_ns, "cycle": 1, "source": "can", "complete": True}
        found = msgpack.unpackb(msgpack.packb(told))
        return {part: {name: np.array(one) for name, one in found[part].items()} for part in parts}

    return faster(
        "encode and decode a sample of 25 elements: value, age, valid",
        "msgpack with lists",
        ours,
        lists,
        4.0,
        "ours checks every field; lists check nothing",
    )


def memory() -> Row:
    """Resident memory of a process with the model service loaded and warm, and with torch beside it."""
    ours, theirs = (
        float(subprocess.run([sys.executable, "-c", RUNNING, way],
                             capture_output=True, text=True, check=True).stdout)
        for way in ("plain", "torch")
    )  # fmt: skip
    return Row("memory of the service's process", "the same with torch", ours, theirs, "MB", theirs / ours, 2.0)


def question() -> Row:
    """Median of an estimate asked for by a client beyond that of a bare query with the same bytes."""
    with robot_and_client(False) as (client, connect):
        times = measure(client, connect, QUESTIONS)
    ours, bare = (1e3 * float(np.median(times[what])) for what in (VERB, BARE))
    return Row(
        "an estimate asked for by a remote client, beyond a bare query", "zenoh query, same bytes", ours, bare, "ms",
        ours - bare, 0.15, is_most=True, note="the difference is compared",
    )  # fmt: skip


def rows() -> Iterator[Row]:
    """All of them."""
    yield codec()
    yield memory()
    yield question()
    yield way_through.row()
    yield from highest_rate.rows()


def main() -> None:
    for row in rows():
        figures = f"{row.ours:9.2f} {row.theirs:9.2f} {row.unit}  {row.value:6.2f} (bar {row.bar:g})"
        print(f"{row.what:60s} {figures}  {row.note}")


if __name__ == "__main__":
    main()
