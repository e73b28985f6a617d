"""Break the robot in every way there is, with many seeds, and look whether a rule of the robot was broken.

    python tests/hal/campaign.py --seeds 8 --json runs/faults.json
    python tests/hal/campaign.py --repeat 123456789 --only "wrong byte"

Every run of this program draws new seeds, and prints them.

Robot, nodes and wire run in lockstep, so that the times are those of the bus and not of this machine; the faults of a
whole process (killed, frozen) run in real time on the hub.
"""

import argparse
import json
import logging
import random
import secrets
import statistics
import sys
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from campaign_faults import FAULTS, GOES_ON, STOPS, Fault
from campaign_processes import WATCH, break_master
from rich.console import Console
from rich.table import Table
from wire_bench import PERIOD, WireBench

from hal.errors import CommandRefused

REST = np.array([0.30, 0.25])
"""Lengths [m] about which the robot moves."""
PROCESSES: dict[str, float | None] = {
    "HAL process killed": None,
    "HAL process frozen for 0.3 s": 0.3,
    "HAL process frozen for 3 s": 3.0,
}
"""Fault -> how long [s] the process stands still; for ever, if None."""
LONGEST_NOTICE = 200
"""Cycles that a fault lasts at least."""


@dataclass
class Outcome:
    """What one run has shown.

    Attributes:
        fault: Its name.
        seed: Of this run.
        noticed: Time [s] from the beginning of the fault until the HAL knew; None if it never did.
        stopped: Time [s] until the robot was not in `hold` or `follow` any more; None if it went on.
        reason: Why it stopped, in its own words.
        violated: Rule -> how it was broken first.
        recovered: Whether the robot followed commands again, without a restart, after reset and enable.
    """

    fault: str
    seed: int
    noticed: float | None = None
    stopped: float | None = None
    reason: str = ""
    violated: dict[str, str] = field(default_factory=dict)
    recovered: bool = False


class Run:
    """One fault on one robot."""

    def __init__(self, fault: Fault, seed: int) -> None:
        self.fault = fault
        self.chance = random.Random(f"{fault.name} {seed}")
        self.bench = WireBench(seed)
        self.outcome = Outcome(fault.name, seed)
        self.victim: tuple[str, int, int] = ("", 0, 0)
        self.name = ""
        self.before: dict[str, int] = {}
        self._speed = self.chance.uniform(0.5, 6.0)
        self._way = np.array([self.chance.uniform(0.0, 0.25) for _ in REST])
        self._begun = 0.0

    def counts(self) -> dict[str, int]:
        """Everything that the HAL counts, over all buses and devices."""
        health = self.bench.robot.health()
        counts = {"incomplete": health["incomplete"]}
        for part in (*health["buses"].values(), *health["devices"].values()):
            for name, count in part["counters"].items():
                counts[name] = counts.get(name, 0) + count
        return counts

    def play(self) -> Outcome:
        """Open, enable, move, break, look, mend, and try again."""
        bench, outcome = self.bench, self.outcome
        with bench.referee as referee:
            try:
                bench.open()
                bench.cycle()
                bench.until(lambda: bench.sample.complete, "a whole sample")
                bench.enable()
                self._move(self.chance.randint(5, 60))
                self._break()
                self._recover()
            except (AssertionError, CommandRefused) as error:
                outcome.violated["recovery"] = str(error)[:300]
            finally:
                bench.close()
            outcome.violated.update(referee.violations)
        return outcome

    def moves_far(self) -> None:
        """Move both muscles over most of their range from now on."""
        self._speed, self._way = 2.0, np.array([0.15, 0.12])

    def _goal(self) -> np.ndarray:
        """A wave that is at times faster, and further, than the limits allow [m], shape (2,)."""
        return REST + self._way * np.sin(self._speed * self.bench.world.time)

    def _move(self, cycles: int) -> None:
        for _ in range(cycles):
            self.bench.ask(self._goal())
            self.bench.cycle()

    def _break(self) -> None:
        bench, outcome, fault = self.bench, self.outcome, self.fault
        start = bench.clock.monotonic()
        fault.begin(self)
        if fault.bar is not None and bench.clock.monotonic() > start:
            start = bench.clock.monotonic() - PERIOD  # the HAL can notice from its first cycle on
        for _ in range(LONGEST_NOTICE + self.chance.randrange(50)):
            self._move(1)
            passed = bench.clock.monotonic() - start
            if outcome.noticed is None and fault.is_noticed is not None and fault.is_noticed(self):
                outcome.noticed = round(passed, 6)
            if outcome.stopped is None and bench.robot.mode not in ("hold", "follow"):
                outcome.stopped = round(passed, 6)
                outcome.reason = bench.robot.fault_text
        self._judge()
        if bench.robot.mode in ("off", "fault"):
            self._insist()

    def _insist(self) -> None:
        """Reset and enable while the fault is still there: the robot may refuse or stop again, and may not jump."""
        bench = self.bench
        try:
            bench.robot.reset()
            bench.cycle(20)
            bench.referee.was_asked = True
            bench.robot.enable()
        except CommandRefused:
            return
        self._move(60)

    def _judge(self) -> None:
        outcome, fault = self.outcome, self.fault
        if fault.bar is not None and (outcome.noticed is None or outcome.noticed > fault.bar + 1e-6):
            outcome.violated["bar"] = f"noticed after {outcome.noticed} s, at most {fault.bar:g} s are allowed"
        if fault.reaction == STOPS and outcome.stopped is None:
            outcome.violated["reaction"] = "the robot did not stop"
        if fault.reaction == GOES_ON and outcome.stopped is not None:
            outcome.violated["reaction"] = f"the robot stopped: {self.bench.robot.fault_text}"

    def _recover(self) -> None:
        """End the fault; then reset and enable must do, with the same robot in the same process."""
        bench = self.bench
        self.fault.end(self)
        bench.cycle(5)
        bench.until(self._is_settled, "settling after the fault")
        if bench.robot.mode in ("off", "fault"):
            bench.robot.reset()
            bench.until(self._is_ready, "ready after reset")
            bench.enable()
        for _ in range(300):
            bench.ask(REST)
            bench.cycle()
        assert bench.robot.mode == "follow", f"mode {bench.robot.mode}: {bench.robot.fault_text}"
        np.testing.assert_allclose(bench.world.length, REST, atol=1e-5)
        self.outcome.recovered = True

    def _is_ready(self) -> bool:
        """Every device is ready, and has said where it is since: one that was just opened has not."""
        bench = self.bench
        is_known = all(valid.all() for valid in bench.sample.valid.values())
        return bench.states() == {"ready"} and bench.sample.complete and is_known

    def _is_settled(self) -> bool:
        bench = self.bench
        calm = bench.robot.mode in ("off", "fault", "hold", "follow")
        return calm and bench.sample.complete and bench.states() <= {"ready", "enabled", "fault"}


def play(faults: Iterable[Fault], seeds: Iterable[int]) -> list[Outcome]:
    """Every fault with every seed, one after the other."""
    seeds = tuple(seeds)
    return [Run(fault, seed).play() for fault in faults for seed in seeds]


def play_processes(seeds: Iterable[int], only: str = "") -> list[Outcome]:
    """Every fault of a whole process with every seed."""
    seeds = tuple(seeds)
    named = [(name, duration) for name, duration in PROCESSES.items() if only in name]
    return [break_master(Outcome(name, seed), duration) for name, duration in named for seed in seeds]


def milliseconds(times: list[float]) -> str:
    """Median and maximum of some times [s], told in ms."""
    return f"{statistics.median(times) * 1e3:.0f} / {max(times) * 1e3:.0f}" if times else "-"


def table(outcomes: list[Outcome]) -> Table:
    """One row per fault."""
    shown = Table(title=f"{len(outcomes)} runs")
    for column in ("fault", "runs", "noticed [ms]", "bar [ms]", "stopped", "after [ms]", "violated", "recovered"):
        shown.add_column(column, justify="left" if column in ("fault", "violated") else "right")
    bars = {fault.name: fault.bar for fault in FAULTS} | dict.fromkeys(PROCESSES, WATCH)
    for name in dict.fromkeys(outcome.fault for outcome in outcomes):
        rows = [outcome for outcome in outcomes if outcome.fault == name]
        stops = [row.stopped for row in rows if row.stopped is not None]
        bar = bars.get(name)
        shown.add_row(
            name,
            str(len(rows)),
            milliseconds([row.noticed for row in rows if row.noticed is not None]),
            f"{bar * 1e3:.0f}" if bar else "-",
            f"{len(stops)}",
            milliseconds(stops),
            ", ".join(sorted({rule for row in rows for rule in row.violated})) or "none",
            f"{sum(row.recovered for row in rows)}/{len(rows)}",
        )
    return shown


def main(arguments: list[str]) -> int:
    """The whole campaign; 0 if no rule was broken and every robot recovered."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=7, help="runs of every fault, with new seeds")
    parser.add_argument(
        "--repeat", type=int, nargs="+", metavar="SEED", help="the seeds of an earlier campaign instead"
    )
    parser.add_argument("--only", default="", help="faults whose name contains this")
    parser.add_argument("--json", type=Path, help="where every run is written to")
    options = parser.parse_args(arguments)
    logging.getLogger("hal").addHandler(logging.NullHandler())
    start = time.monotonic()
    seeds = options.repeat or [secrets.randbelow(10**9) for _ in range(options.seeds)]
    console = Console(width=140)
    console.print(f"Seeds: {' '.join(map(str, seeds))} (again with --repeat)", soft_wrap=True, highlight=False)
    outcomes = play([fault for fault in FAULTS if options.only in fault.name], seeds)
    outcomes += play_processes(seeds[:3], options.only)
    console.print(table(outcomes))
    broken = [outcome for outcome in outcomes if outcome.violated or not outcome.recovered]
    for outcome in broken:
        console.print(f"{outcome.fault}, seed {outcome.seed}: {outcome.violated}", markup=False)
    console.print(f"{len(broken)} of {len(outcomes)} runs broke a rule; {time.monotonic() - start:.0f} s.")
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps([asdict(outcome) for outcome in outcomes], indent=1))
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
