"""Contacts: how often a right sensor is hidden while a muscle-driven arm is pushed and knocked at the hand.

    python -m studies.accuracy.contacts [--seeds 11 12 13 14 15 16] [--minutes 5] [--free] [--learned 31 32]

The model is that of `studies.accuracy.lies`: neither it nor what is normal has seen a contact. Each seed is one
recording of random motion; one monitor judges all of them one after another, as a robot that goes on working. In 40 %
of the time a force of 5 to 30 N of any direction acts on the hand; three in ten pushes are knocks of about a tenth of a
second, the others are held for 0.5 to 8 s. `--free` has no contacts. `--learned` first learns what is normal from other
recordings without contacts, in place of 150 s.
"""

import argparse
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from gemuco.anomaly.healthy import learn_normal
from gemuco.schema import BodySchema
from gemuco.trust.monitor import TrustMonitor
from hal.config import load_robot
from simulators.robots.musashi_arm import force_torque
from studies.accuracy.lies import PART, body_of
from studies.bodies.actual_arms import record
from studies.bodies.lying_robots import ARM, RATE

CACHE = Path("runs/contacts")
KNOCKS = 0.3
"""Share of the pushes that are knocks."""
FORCE = (5.0, 30.0)
"""A push has a force in this range [N]."""
RAMP, HELD = (0.05, 1.0), (0.5, 8.0)
"""It grows, and is held, for times in these ranges [s]."""
KNOCK_RAMP, KNOCK_HELD = (0.02, 0.1), 0.05
"""The same of a knock."""
BETWEEN = (3.0, 10.0)
"""Time without a push [s]."""


@dataclass(frozen=True, slots=True)
class Push:
    """A force [N], shape (3,), that grows for `ramp`, is held, and falls again; times [s]."""

    start: float
    ramp: float
    held: float
    force: np.ndarray

    @property
    def end(self) -> float:
        """End of the push [s]."""
        return self.start + 2.0 * self.ramp + self.held

    def at(self, time: float) -> np.ndarray:
        """Return the force [N] at a time [s], shape (3,)."""
        return self.force * float(np.clip(min(time - self.start, self.end - time) / self.ramp, 0.0, 1.0))


def pushes(seed: int, duration: float) -> list[Push]:
    """Return the pushes of one recording of a length [s], in order."""
    draw, result, start = np.random.default_rng([seed, 99]), [], 5.0
    while start < duration - 10.0:
        is_knock = draw.random() < KNOCKS
        ramp = draw.uniform(*(KNOCK_RAMP if is_knock else RAMP))
        held = KNOCK_HELD if is_knock else draw.uniform(*HELD)
        way = draw.standard_normal(3)
        result.append(Push(start, ramp, held, draw.uniform(*FORCE) * way / np.linalg.norm(way)))
        start = result[-1].end + draw.uniform(*BETWEEN)
    return result


def force_at(plan: Sequence[Push], time: float) -> np.ndarray:
    """Return the force on the hand [N], shape (3,)."""
    return next((push.at(time) for push in plan if push.start <= time < push.end), np.zeros(3))


def recording(seed: int, duration: float, is_free: bool) -> dict[str, np.ndarray]:
    """Return signal -> samples (count, n) [unit], from runs/contacts if it was made before."""
    file = CACHE / f"{seed}_{duration:.0f}{'_free' if is_free else ''}.pkl"
    if not file.exists():
        plan = [] if is_free else pushes(seed, duration)
        rows = record(
            load_robot(Path("robots/musashi_arm.yaml")), ARM, seed, float(RATE), duration,
            contact=lambda time, position: force_torque(position, force_at(plan, time)),
        )  # fmt: skip
        CACHE.mkdir(parents=True, exist_ok=True)
        file.write_bytes(pickle.dumps(rows))
    return dict(pickle.loads(file.read_bytes()))


def model_of(learned: Sequence[int], duration: float) -> BodySchema:
    """Return the model; what is normal is learned from recordings without contacts of these seeds, if there are any."""
    schema = body_of("musashi_arm").schema
    if not learned:
        return schema
    rows = [schema.layout.join(recording(seed, duration, is_free=True))[::PART] for seed in learned]
    return schema.with_normal(learn_normal(schema, np.concatenate(rows)))


def judge(schema: BodySchema, seeds: Sequence[int], duration: float, is_free: bool) -> tuple[Table, str]:
    """Return a table of the wrong verdicts, and a sentence that counts them."""
    monitor, table = TrustMonitor(schema), Table("time", "seed", "force", "hidden", "kind")
    before: frozenset[int] = frozenset()
    blocks = hidden = verdicts = 0
    for seed in seeds:
        plan = [] if is_free else pushes(seed, duration)
        rows = schema.scaler.normalise(schema.layout.join(recording(seed, duration, is_free)))
        for number in range(len(rows) // PART):
            blocks += 1
            monitor.add(rows[number * PART : (number + 1) * PART], blocks / 10.0)
            if monitor.hidden - before:
                verdicts += 1
                force = max(np.linalg.norm(force_at(plan, (number - back) / 10.0)) for back in range(30))
                names = ", ".join(schema.layout.element(e) for e in sorted(monitor.hidden - before))
                kinds = ", ".join(finding.kind for finding in monitor.findings if finding.is_distrusted)
                table.add_row(f"{blocks / 10.0:.1f} s", str(seed), f"{force:.0f} N", names, kinds)
            before = monitor.hidden
            hidden += bool(before)
    return table, (
        f"{verdicts} wrong verdicts in {blocks / 600.0:.0f} min; something right was hidden for {hidden / 10.0:.0f} s."
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(11, 17)))
    parser.add_argument("--minutes", type=float, default=5.0, help="Length of each recording.")
    parser.add_argument("--free", action="store_true", help="Without contacts.")
    parser.add_argument("--learned", type=int, nargs="+", default=[], help="Seeds to learn what is normal from.")
    options = parser.parse_args()
    duration = 60.0 * options.minutes
    for part in judge(model_of(options.learned, duration), options.seeds, duration, options.free):
        Console(width=120).print(part)
