"""Cost of recording: CPU per message and bytes per hour beside plain msgpack, and the loss at kill -9.

`python -m studies.stack.recording` for the costs, `--kills 10` for kill -9 as well, `--hours 5` for the writer's memory
over five hours of commits. Times are CPU times of one process.
The messages are those of musashi_arm with random walks for values, which compress worse than sensors do.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from hal.config import RobotConfig, load_robot
from services.recording.file import RecordingFile
from services.recording.reading import read
from services.recording.schema import Catalogue
from services.recording.writer import RecordingWriter
from services.wire import keys, messages
from services.wire.records import Anomaly, Applied, Estimates, Sample
from services.wire.session import close_session, open_session
from services.wire.streams import Publisher
from studies.stack.processes import look

ROBOT = Path("robots/musashi_arm.yaml")
COMMIT_EVERY = 80
"""Number of ticks between two commits, 0.4 s at 200 Hz."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ticks", type=int, default=4000)
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--hours", type=int, default=0)
    options = parser.parse_args()
    robot = load_robot(ROBOT)
    walk = Walk(robot)
    ticks = [walk.tick(number) for number in range(options.ticks)]
    with tempfile.TemporaryDirectory() as folder:
        for name, write in (("JSON with schema", as_json), ("plain msgpack", as_msgpack)):
            seconds, size = write(robot, ticks, Path(folder) / "run.mcap")
            count = sum(map(len, ticks))
            per_hour = size / len(ticks) * 200 * 3600
            shares = [100 * rate * seconds / len(ticks) for rate in (200, 500)]
            print(
                f"{name:17} {1e6 * seconds / count:6.1f} us CPU per message, {shares[0]:5.2f} % of a core at 200 Hz, "
                f"{shares[1]:5.2f} % at 500 Hz, {per_hour / 1e9:.2f} GB/h at 200 Hz"
            )
            (Path(folder) / "run.mcap").unlink()
        for number in range(options.kills):
            print(f"kill -9, run {number + 1}: {1e3 * kill(robot, ticks, Path(folder) / f'{number}.mcap'):.0f} ms lost")
        for hour, resident in enumerate(memory(robot, ticks[0], Path(folder) / "long.mcap", options.hours), 1):
            print(f"memory of the writer's process after {hour} h: {resident:.1f} MB")


class Walk:
    """Messages of a robot whose values walk at random: sample, set-points, estimates, and every second tick anomaly."""

    def __init__(self, robot: RobotConfig) -> None:
        self._robot = robot
        self._random = np.random.default_rng(0)
        self._values = {name: self._random.normal(size=one.size) for name, one in robot.signals.items()}

    def tick(self, number: int) -> list[tuple[str, bytes]]:
        """Return keys and payloads of one tick."""
        for value in self._values.values():
            value += 1e-3 * self._random.normal(size=value.shape)
        name, values = self._robot.robot, {key: value.copy() for key, value in self._values.items()}
        head = {"stamp_ns": time.time_ns(), "seq": number, "boot": 1234567890123, "cycle": number}
        signal = self._robot.command.signal
        truths = {key: np.ones(value.shape, bool) for key, value in values.items()}
        made: list[tuple[str, messages.Message]] = [
            (keys.sample(name), Sample(
                **head, source="can", complete=True, values=values, valid=truths,
                age={key: 0.002 + 1e-4 * self._random.random(value.shape) for key, value in values.items()},
            )),
            (keys.applied(name), Applied(
                **head, mode="follow", signal=signal, desired=values[signal], values=values[signal] + 1e-5,
                limited_by=[], sender=5,
            )),
            (keys.estimate(name), Estimates(
                **head, values=values, estimated={key: ~value for key, value in truths.items()},
                std={key: np.zeros(value.shape) for key, value in values.items()},
                method=dict.fromkeys(values, "measured"), mask=dict.fromkeys(values, ""),
                residual=dict.fromkeys(values, 0.0),
            )),
        ]  # fmt: skip
        if number % 2 == 0:
            parts = {key: self._random.normal(size=value.shape) ** 2 for key, value in values.items()}
            anomaly = Anomaly(**head, score=3.0, threshold=9.0, is_anomaly=False, blamed="", contribution=parts)
            made.append((keys.anomaly(name), anomaly))
        return [(key, messages.encode(message)) for key, message in made]


Ticks = list[list[tuple[str, bytes]]]


def as_json(robot: RobotConfig, ticks: Ticks, path: Path) -> tuple[float, int]:
    """Return CPU time [s] and size [bytes] of a recording as the recorder writes it."""
    writer = RecordingWriter(path, robot.robot, Catalogue.of_robot(robot))
    writer.open(0)
    return _timed(path, ticks, lambda key, now, payload: writer.add(key, now, payload), writer.commit, writer.finish)


def as_msgpack(robot: RobotConfig, ticks: Ticks, path: Path) -> tuple[float, int]:
    """Return the same for the messages as they come from the network, without a schema; other tools cannot read it."""
    file = RecordingFile(path)
    return _timed(
        path, ticks, lambda key, now, payload: file.add(file.channel(key, "msgpack"), now, now, 0, payload),
        lambda _: file.commit(), lambda _: file.finish(),
    )  # fmt: skip


def _timed(
    path: Path,
    ticks: Ticks,
    add: Callable[[str, int, bytes], None],
    commit: Callable[[int], None],
    finish: Callable[[int], None],
) -> tuple[float, int]:
    begun = time.process_time()
    for number, tick in enumerate(ticks):
        for key, payload in tick:
            add(key, number, payload)
        if number % COMMIT_EVERY == 0:
            commit(number)
    finish(len(ticks))
    return time.process_time() - begun, path.stat().st_size


def memory(robot: RobotConfig, tick: list[tuple[str, bytes]], path: Path, hours: int) -> Iterator[float]:
    """Yield the resident memory [MB] at the end of every hour of commits, each with a tick in it."""
    writer = RecordingWriter(path, robot.robot, Catalogue.of_robot(robot))
    writer.open(0)
    now, pause_ns = 0, round(1e9 * COMMIT_EVERY / 200)
    for hour in range(1, hours + 1):
        while now < hour * 3600 * 10**9:
            for key, payload in tick:
                writer.add(key, now, payload)
            writer.commit(now)
            now += pause_ns
        yield look(os.getpid())["rss"]
    writer.finish(now)


def kill(robot: RobotConfig, ticks: Ticks, path: Path) -> float:
    """Return the time [s] before kill -9 whose messages are not in the file."""
    name = f"killed_{os.getpid()}"
    code = "import sys; from services.recording.recorder import run_recorder; run_recorder(sys.argv[1], sys.argv[2])"
    process = subprocess.Popen([sys.executable, "-c", code, name, str(path)])
    session = open_session(name, "hal")
    publisher = Publisher(session, keys.sample(name), Sample, 1)
    while not publisher.has_listener:
        time.sleep(0.01)
    until = time.monotonic() + 3.0 + np.random.default_rng().random()
    number = 0
    while (now := time.monotonic()) < until:
        for key, payload in ticks[number % len(ticks)]:
            message = messages.decode_any(payload)
            session.put(
                key.replace(robot.robot, name), messages.encode(message, stamp_ns=time.time_ns(), seq=number, boot=1)
            )
        number += 1
        time.sleep(max(0.0, now + 0.005 - time.monotonic()))
    killed = time.time_ns()
    process.send_signal(signal.SIGKILL)
    process.wait()
    close_session(session)
    newest = max(message.message.stamp_ns for message in read(path))
    return (killed - newest) * 1e-9


if __name__ == "__main__":
    main()
