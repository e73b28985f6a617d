"""Cut muscles: how often a right sensor is hidden after a wire of the muscle-driven arm was cut.

    python -m studies.accuracy.cut_muscles [--seeds 1 2 3] [--rests 1.5] [--stalls]

The model is that of `studies.accuracy.lies`; it has seen no cut. Each seed is one recording of random motion per
muscle, whose wire is cut after 40 s. The arm goes on moving as commanded for 8 s: with a muscle less it leaves the
postures and tensions that were learned. Right are the sensors of the joints and of all other muscles; tension and
length of the cut one contradict them. The robot of the demo stops when the first of these is hidden. With `--rests` the
arm gets no new command from this time [s] before the cut on, and comes to rest. With `--stalls` most samples are
missing from two seconds before the cut on, and all of them for up to 0.6 s again and again, as on a slow machine.
"""

import argparse
import math
import pickle
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from gemuco.schema import BodySchema
from gemuco.trust.monitor import TrustMonitor
from hal.config import RobotConfig, load_robot
from studies.accuracy.lies import PART, body_of
from studies.bodies.actual_arms import record
from studies.bodies.lying_robots import ARM, RATE, TENSION

CACHE = Path("runs/cut_muscles")
BEFORE, AFTER = 40.0, 8.0
"""Times [s] before and after the cut."""
STALLS_FROM, STALLS, LONGEST, KEPT = BEFORE - 2.0, 0.3, 6, 4
"""From this time [s] on, a stall of at most `LONGEST` blocks begins in this share of the blocks; of the others this
number of samples is there."""
AT_FIRST = 1.0
"""What is hidden within this time [s] of the first verdict counts as what was hidden at first."""


def recording(robot: RobotConfig, muscle: str, seed: int, rests: float | None) -> dict[str, np.ndarray]:
    """Return signal -> samples (count, n) [unit], from runs/cut_muscles if it was made before.

    Args:
        robot: The robot.
        muscle: The muscle that is cut.
        seed: Seed of the motion.
        rests: The arm gets no new command from this time [s] before the cut on; None if it goes on moving.
    """
    file = CACHE / f"{muscle}_{seed}{'' if rests is None else f'_{rests:g}'}.pkl"
    if not file.exists():
        cut = f"muscle_cut:{muscle}"
        still = math.inf if rests is None else BEFORE - rests
        rows = record(robot, ARM, seed, float(RATE), BEFORE + AFTER, cut, breaks_at=BEFORE, rests_at=still)
        CACHE.mkdir(parents=True, exist_ok=True)
        file.write_bytes(pickle.dumps(rows))
    return dict(pickle.loads(file.read_bytes()))


def blocks(samples: np.ndarray, seed: int | None) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the number of each block and its samples; with a seed, with the stalls of a slow machine."""
    rng, stalled = np.random.default_rng(seed), 0
    for number in range(len(samples) // PART):
        block = samples[number * PART : (number + 1) * PART]
        if seed is not None and number >= 10.0 * STALLS_FROM:
            if stalled == 0 and rng.random() < STALLS:
                stalled = int(rng.integers(1, LONGEST + 1))
            if stalled > 0:
                stalled -= 1
                continue
            block = block[np.sort(rng.choice(len(block), KEPT, replace=False))]
        yield number, block


def play(schema: BodySchema, rows: dict[str, np.ndarray], stalls: int | None) -> list[tuple[float, set[str]]]:
    """Return the times [s] after the cut at which other elements were hidden than before, and all that were hidden.

    Args:
        schema: The model.
        rows: The recording.
        stalls: Seed of the stalls; None without.
    """
    samples, monitor, result = schema.scaler.normalise(schema.layout.join(rows)), TrustMonitor(schema), []
    before: frozenset[int] = frozenset()
    for number, block in blocks(samples, stalls):
        monitor.add(block, number / 10.0)
        if monitor.hidden != before:
            before, time = monitor.hidden, round((number + 1) / 10.0 - BEFORE, 1)
            result.append((time, {schema.layout.element(element) for element in before}))
    return [(time, names) for time, names in result if time > 0.0]


def row_of(muscle: str, plays: Sequence[list[tuple[float, set[str]]]]) -> tuple[str, ...]:
    """Return a row of the table: how many cuts were noticed, how soon, and after how many a right sensor was hidden."""
    noticed = [verdicts for verdicts in plays if verdicts]
    delays = [verdicts[0][0] for verdicts in noticed]
    first = sum(any(_right(names, muscle) for at, names in v if at <= v[0][0] + AT_FIRST) for v in noticed)
    later = sum(any(_right(names, muscle) for _, names in v) for v in noticed)
    delay = f"{np.median(delays):.1f} s" if delays else "-"
    return muscle, f"{len(noticed)} of {len(plays)}", delay, str(first), str(later)


def _right(names: set[str], muscle: str) -> set[str]:
    return {name for name in names if name.partition(".")[2] != muscle}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--rests", type=float, help="time [s] before the cut without a new command")
    parser.add_argument("--stalls", action="store_true", help="with the stalls of a slow machine")
    arguments = parser.parse_args()
    robot, schema = load_robot(Path("robots/musashi_arm.yaml")), body_of("musashi_arm").schema
    table = Table("muscle", "noticed", "median", "right sensor hidden at first", "right sensor hidden within 8 s")
    for muscle in robot.signals[TENSION].elements:
        plays = [
            play(schema, recording(robot, muscle, seed, arguments.rests), seed if arguments.stalls else None)
            for seed in arguments.seeds
        ]
        table.add_row(*row_of(muscle, plays))
        Console().print(f"{muscle}: " + "; ".join(str(p[:3]) for p in plays), style="dim")
    Console().print(table)
