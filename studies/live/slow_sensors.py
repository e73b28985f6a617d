"""Sensors that are read less often than others: right ones that are hidden in motion, and lies that are found.

    python -m studies.live.slow_sensors [--plays 10] [--seconds 60]

A made-up body on the bench has two drives, which are read in every cycle, and eight values of a DBC file that come
every 0.1 s, each message at another time. It moves at a steady speed between random places, judged by the test for lies
of the model service in simulated time. The model is of the same body without a bus, so only the times differ. In half
of the plays one value or a drive is off by 0.3 standard deviations from the middle on.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from gemuco.schema import BodySchema
from gemuco.trust.config import TrustConfig
from hal.by_signal import Numbers, Truths
from hal.clock import ManualClock
from hal.config import RobotConfig
from services.learning import collector, trainer
from services.model.estimation import Freshness
from services.model.trust_loop import Trust
from services.wire.messages import Sample
from services.wire.streams import Arrival
from simulators.nodes.canopen.spec import EDS_FOLDER
from simulators.robots.bench import hardware
from simulators.robots.bench.made_up import BenchBody

CYCLE, PERIOD = 0.02, 0.1
"""The drives and the messages are read at these intervals [s]."""
SPEEDS = (0.2, 0.5, 1.0, 2.0)
"""Speeds of the drives [rad/s], whose range is 1 rad."""
LIE = 0.3
"""Size of a lie [standard deviations of the element]."""
MESSAGES, OF_EACH = 4, 2
DBC = 'VERSION ""\nBU_: Car\n' + "".join(
    f"BO_ {256 + number} Message{number}: 8 Car\n"
    + "".join(f' SG_ Force{number}{place} : {24 * place}|24@1- (0.0001,0) [-100|100] "N" Car\n' for place in range(2))
    for number in range(MESSAGES)
)
ROBOT = """
robot: slow_sensors
signals:
  joint_position: {unit: rad, elements: [a, b]}
  force: {unit: N, elements: ELEMENTS, stale_after: 0.4}
command: {signal: joint_position}
limits: {joint_position: {low: -0.5, high: 0.5, rate: 1.0, acceleration: 4.0}}
rates: {hal: 50}
buses: {can0: {interface: virtual, channel: slow_sensors}}
kinds:
  drive: {driver: cia402, settings: {eds: servo_drive.eds, counts_per_turn: 4096, gear: 50}}
  car: {driver: dbc, settings: {dbc: car.dbc, periods: PERIODS, quantities: QUANTITIES}}
devices:
  drive_a: {kind: drive, bus: can0, node: 1, element: joint_position.a}
  drive_b: {kind: drive, bus: can0, node: 2, element: joint_position.b}
  car: {kind: car, bus: can0, node: 91, elements: SERVED}
simulator: simulators.robots.bench:body
collect: {samples: 1500, rate: 10}
model: {structure: {threshold_out: 0.5, threshold_in: 0.5}}
"""


def robot_in(folder: Path) -> RobotConfig:
    """Return the robot; its DBC file is written into a folder."""
    (folder / "car.dbc").write_text(DBC)
    (folder / "servo_drive.eds").write_bytes((EDS_FOLDER / "servo_drive.eds").read_bytes())
    names = [f"{number}{place}" for number in range(MESSAGES) for place in range(OF_EACH)]
    text = ROBOT.replace("ELEMENTS", str([f"f{name}" for name in names]))
    text = text.replace("PERIODS", str({f"Message{number}": PERIOD for number in range(MESSAGES)}))
    sources = {f"q{name}": {"signal": f"Message{name[0]}.Force{name}"} for name in names}
    text = text.replace("QUANTITIES", str(sources)).replace(
        "SERVED", str({f"q{name}": f"force.f{name}" for name in names})
    )
    return RobotConfig.model_validate(yaml.safe_load(text) | {"folder": folder})


def learned(robot: RobotConfig) -> BodySchema:
    """Return a model of the robot, learned without a bus."""
    return trainer.train(robot, collector.collect_direct(robot, None, 0).dataset, 0, lambda share, text: None).schema


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one play.

    Attributes:
        hidden: Right elements that were hidden at some time.
        seconds: Time for which any right element was hidden [s].
        delay: Time from the beginning of a lie until it was hidden [s]; infinite without one, or if it was not.
    """

    hidden: frozenset[str]
    seconds: float
    delay: float


def samples(robot: RobotConfig, seed: int, speed: float, seconds: float) -> Iterator[tuple[float, dict, dict]]:
    """Yield the time [s], values and ages of each sample of a play."""
    random = np.random.default_rng(seed)
    world = BenchBody(robot, hardware(robot), seed)
    place, goal = np.zeros(2), np.zeros(2)
    phase = np.repeat(random.uniform(0.0, PERIOD, MESSAGES), OF_EACH)
    held, at = np.full(MESSAGES * OF_EACH, np.nan), np.full(MESSAGES * OF_EACH, -np.inf)
    for cycle in range(round(seconds / CYCLE)):
        time = CYCLE * (cycle + 1)
        goal = np.where(np.abs(goal - place) < 1e-9, random.uniform(-0.45, 0.45, 2), goal)
        place = place + np.clip(goal - place, -speed * CYCLE, speed * CYCLE)
        for element, target in zip(robot.signals["joint_position"].elements, place.tolist(), strict=True):
            world.drive(f"joint_position.{element}", target, True)
        world.step(CYCLE)
        values = world.measure()
        is_sent = np.floor((time + phase) / PERIOD) > np.floor((time - CYCLE + phase) / PERIOD)
        held, at = np.where(is_sent, values["force"], held), np.where(is_sent, time, at)
        yield time, {"joint_position": values["joint_position"], "force": held.copy()}, {
            "joint_position": np.zeros(2), "force": time - at,
        }  # fmt: skip


def play(
    robot: RobotConfig, schema: BodySchema, seed: int, speed: float, seconds: float = 60.0, lie: str = ""
) -> Outcome:
    """Play; after half of the time the element `lie` (`force.f00`), if there is one, is off by `LIE`."""
    clock, newest = ManualClock(), list[Arrival[Sample]]()
    freshness = Freshness(robot, lambda: newest[0] if newest else None, clock)
    trust = Trust(robot, freshness, lambda: schema, TrustConfig(), clock)
    signal, _, element = lie.partition(".")
    hidden, wrong, delay = set[str](), 0.0, np.inf
    for time, values, age in samples(robot, seed, speed, seconds):
        if lie and time > 0.5 * seconds:
            index = robot.signals[signal].elements.index(element)
            values[signal][index] += LIE * schema.scaler.std[schema.layout.slice(signal)][index]
        valid = Truths.of({name: np.isfinite(value) for name, value in values.items()})
        measured, ages = Numbers.of(values), Numbers.of(age)
        sample = Sample(
            cycle=round(time / CYCLE), boot=1, source="can", complete=True, values=measured, age=ages, valid=valid
        )
        newest[:] = [Arrival(sample, clock.monotonic())]
        trust.tick()
        clock.advance(CYCLE)
        distrusted = set(freshness.distrust.reasons)
        if lie in distrusted and time > 0.5 * seconds:
            delay = min(delay, time - 0.5 * seconds)
        right = distrusted - ({lie} if time > 0.5 * seconds else set())
        hidden |= right
        wrong += CYCLE * bool(right)
    return Outcome(frozenset(hidden), wrong, delay)


def main() -> None:
    """Play, and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--plays", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=60.0)
    given = parser.parse_args()
    table = Table("speed [rad/s]", "plays without a lie: with a right one hidden", "for [s] in all", "lies found",
                  "median [s]", "latest [s]", "with a right one hidden")  # fmt: skip
    with TemporaryDirectory() as folder:
        robot = robot_in(Path(folder))
        schema = learned(robot)
        elements = robot.element_names()
        for speed in SPEEDS:
            healthy = [play(robot, schema, seed, speed, given.seconds) for seed in range(given.plays)]
            lies = [
                play(robot, schema, seed, speed, given.seconds, elements[seed % len(elements)])
                for seed in range(given.plays)
            ]
            delay = np.array([one.delay for one in lies])
            table.add_row(
                f"{speed:g}",
                f"{sum(bool(one.hidden) for one in healthy)} of {given.plays}",
                f"{sum(one.seconds for one in healthy):.1f}",
                f"{np.isfinite(delay).sum()} of {given.plays}",
                f"{np.median(delay):.2f}",
                f"{delay.max():.2f}",
                f"{sum(bool(one.hidden) for one in lies)} of {given.plays}",
            )
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
