"""Time from a sample of the HAL to its estimate, at a client in another process.

    python -m studies.stack.estimate_latency [--seconds 20] [--rates estimation=500]

HAL and estimation run at the robot file's rates, both 200 Hz, unless others are given. The client notes when the
sample of a cycle arrives and when the first estimate from that cycle does. The difference is the time until the next
tick of the estimation, the tick, and one more way over the wire.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import zenoh
from rich.console import Console

from hal.config import load_robot
from services.client import Client
from services.process.supervisor import Supervisor
from services.wire import keys
from services.wire.messages import Estimates, Sample, decode
from studies.bodies.actual_arms import model
from studies.speed.table import Row, show
from studies.stack.driving import measures
from studies.stack.loops import stack, with_rates

ROBOT = Path("robots/musashi_arm.yaml")
SETTLING = 5.0
"""Time [s] in which the estimation loop learns when samples come."""


def differences(file: Path, seconds: float) -> np.ndarray:
    """Return the time [s] from the sample of each cycle to its estimate."""
    robot = load_robot(file)
    model(robot, Console(stderr=True))
    came: dict[str, dict[int, float]] = {"sample": {}, "estimates": {}}

    def note(record: type[Sample] | type[Estimates]) -> Callable[[zenoh.Sample], None]:
        def on_message(message: zenoh.Sample) -> None:
            now = time.perf_counter()
            came[record.TYPE].setdefault(decode(message.payload.to_bytes(), record).cycle, now)

        return on_message

    with Supervisor(Path("runs/estimate_latency")) as supervisor, Client(robot.robot) as client:
        for name, command in stack(file, False).items():
            supervisor.start(name, command)
        supervisor.wait_ready("serve", lambda: measures(client), 60)
        time.sleep(SETTLING)
        session = client.session
        readers = [
            session.declare_subscriber(keys.sample(robot.robot), note(Sample)),
            session.declare_subscriber(keys.estimate(robot.robot), note(Estimates)),
        ]
        time.sleep(seconds)
        for reader in readers:
            reader.undeclare()
    both = sorted(came["sample"].keys() & came["estimates"].keys())
    return np.array([came["estimates"][cycle] - came["sample"][cycle] for cycle in both])


def row(seconds: float = 20.0, rates: str = "") -> Row:
    """Measure the median."""
    with with_rates(ROBOT, rates) as file:
        took = 1e3 * differences(file, seconds)
    middle, late = float(np.median(took)), float(np.percentile(took, 99))
    return Row(
        f"sample to its estimate at a remote client{', ' if rates else ''}{rates}", "the sample at the same client",
        middle, 0.0, "ms", middle, 1.0, is_most=True, note=f"p99 {late:.2f} ms over {len(took)} cycles",
    )  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rates", default="", help="other rates than the robot file's: estimation=500")
    options = parser.parse_args()
    show([row(options.seconds, options.rates)])
