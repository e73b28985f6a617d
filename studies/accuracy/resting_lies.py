"""Sensors that drift while the robot rests: how large the error is when it is found, and which element is hidden.

    python -m studies.accuracy.resting_lies [--robots kxr_humanoid pr2_duster musashi_arm kuka] [--seeds 10]

The robots, models and sizes are those of `studies.accuracy.lies`. After 20 s of motion the robot stops at its posture
for 60 s, with the noise that its sensors have in motion. After 5 s an element drawn by the seed begins to drift by 0.3
or 1 standard error of the healthy prediction per second. The other method is the same ridge regression. The seeds also
rest without a drift; every verdict there is wrong.
"""

import argparse
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.table import Table

from gemuco.trust.config import BLOCK
from gemuco.trust.monitor import TrustMonitor
from studies.accuracy.lies import BEFORE, PART, RATE, Body, body_of, ridge_errors, under
from studies.bodies.lying_robots import BODIES

PACES = (0.3, 1.0)
"""Paces of a drift [standard errors of the healthy prediction per second]."""
REST, BEGIN = 60, 5
"""The robot rests for the first duration [s]; a drift begins after the second one."""
SMOOTH = 11
"""Sensor noise is what a mean over this number of samples takes away."""


def rest(rows: np.ndarray, seed: int) -> np.ndarray:
    """Return rows that move for `BEFORE` seconds and then rest with the noise of the motion."""
    smooth = np.apply_along_axis(np.convolve, 0, rows, np.full(SMOOTH, 1.0 / SMOOTH), "valid")
    cut = SMOOTH // 2
    noise = (rows[cut:-cut] - smooth)[np.random.default_rng(seed).permutation(len(smooth))]
    begin = BEFORE * RATE
    times = np.arange(REST * RATE) % len(noise)
    return np.concatenate([rows[:begin], smooth[begin - cut] + noise[times]])


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one rest.

    Attributes:
        size: Error at which a sensor was hidden [standard errors of the healthy prediction]; infinite if none was.
        alone: Whether it was the one that drifts, alone.
        named: Whether it was hidden alone or with one other.
        is_wrong: Whether a sensor was hidden before the drift.
        ridge: Error at which ridge regression has an alarm; 0 if it had one before the drift.
    """

    size: float
    alone: bool
    named: bool
    is_wrong: bool
    ridge: float


def play(body: Body, pace: float, seed: int) -> Outcome:
    """Play one rest, with a drift of a pace [standard errors of the healthy prediction per second]."""
    draw = np.random.default_rng([seed, 4])
    condition = str(draw.choice(list(body.motion)))
    schema, whole = under(body.schema, condition), body.motion[condition]
    start, index = int(draw.integers(0, len(whole) - BEFORE * RATE - SMOOTH)), int(draw.integers(len(body.columns)))
    rows, element = rest(whole[start : start + BEFORE * RATE + SMOOTH], seed), int(body.columns[index])
    drift = np.maximum(np.arange(len(rows)) / RATE - BEFORE - BEGIN, 0.0) * pace
    rows[:, element] += drift * body.error[index]
    monitor, size, hidden, is_wrong = TrustMonitor(schema), np.inf, frozenset[int](), False
    for number in range(len(rows) // PART):
        monitor.add(rows[number * PART : (number + 1) * PART], (number + 1) * BLOCK)
        now = float(drift[(number + 1) * PART - 1])
        is_wrong |= bool(monitor.hidden) and now == 0.0
        if monitor.hidden and np.isinf(size):
            size, hidden = now, monitor.hidden
    alarm = np.flatnonzero((np.abs(ridge_errors(body.ridge, rows[:, body.columns])) > body.limit).any(axis=1))
    ridge = float(drift[(alarm[0] + 1) * PART - 1]) if len(alarm) else np.inf
    return Outcome(size, hidden == {element}, element in hidden and len(hidden) <= 2, is_wrong, ridge)


def _at(sizes: list[float]) -> str:
    """Return the median, and the largest size at which nine of ten are found."""
    middle, most = np.quantile(sizes, [0.5, 0.9], method="higher")
    return f"{middle:.1f}, {most:.1f}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", default=list(BODIES), choices=list(BODIES))
    parser.add_argument("--seeds", type=int, default=10)
    options = parser.parse_args()
    console = Console(width=160)
    table = Table(
        "robot", "drift [1/s]", "n", "at (median, 90 %)", "found", "alone", "in a pair", "ridge at", "wrong at rest"
    )
    for name in options.robots:
        body = body_of(name)
        wrong = sum(play(body, 0.0, 2000 + seed).is_wrong for seed in range(options.seeds))
        for pace in PACES:
            played = [play(body, pace, 1000 + seed) for seed in range(options.seeds)]
            verdicts = np.array([[np.isfinite(one.size), one.alone, one.named] for one in played])
            table.add_row(
                name, f"{pace:g}", str(len(played)), _at([one.size for one in played]),
                *(f"{share:.0%}" for share in verdicts.mean(axis=0)),
                _at([one.ridge for one in played]), f"{wrong} of {options.seeds}",
            )  # fmt: skip
    console.print(table)
