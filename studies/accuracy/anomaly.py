"""Detection of cut muscles on arms of fresh seeds: area under the ROC curve, delay, and false alarms.

    python -m studies.accuracy.anomaly [--seeds 911 912 913 914 915] [--fresh]

On each actual arm a model is trained on random motion; other motion sets what is normal; further motion is judged. Then
every muscle is cut in turn. The limit of the delays is the one that the healthy motion of all arms together exceeds at
most once per hour. A muscle pulls if its mean tension in the 3 s after the cut would have been above 30 N: the arm
makes the same motion with the muscle whole. Data and models are cached in runs/anomaly.
"""

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from gemuco.anomaly.healthy import learn_normal
from gemuco.anomaly.verdict import window_score
from gemuco.dataset import Dataset, Episode
from gemuco.learning.config import TrainConfig
from gemuco.learning.train import fit
from gemuco.normal.windows import area, at_most, correlation_time
from gemuco.schema import BodySchema
from hal.config import RobotConfig, load_robot
from services.model.living_model import layout_of
from services.show import Progress, progress
from studies.paper.musashi.anomaly import CUT_AFTER, SETTLED
from studies.paper.musashi.motion import LENGTH, POSITION, RATE, TENSION, record, signals
from studies.paper.runs import Run, each_seed

LIVED, NORMAL, HEALTHY, CUT = 400.0, 200.0, 600.0, 13.0
"""Lengths of recordings [s]: for training, for what is normal, for judging, and of a cut muscle."""
EPISODE = 100
"""Samples of an episode of the training data."""
WINDOWS = (1, 10, 30, 100)
"""Samples of a window; ten are a second."""
PULLS = 30.0
"""A muscle pulls above this tension [N]."""
EVENT = 100
"""Alarms less than this number of samples apart are one."""
WITHIN = 3.0
"""A cut must be found within this time [s]."""
MASKS = ((POSITION, TENSION), (TENSION, LENGTH))


@dataclass(frozen=True, slots=True)
class Outcome:
    """Scores of one arm, as shares of the limits of a healthy body.

    Attributes:
        healthy: Number of samples in a window -> shares of all windows that end at each sample.
        cut: The same of every cut muscle, from the first sample of its recording.
        pull: Muscle -> mean tension that it would have had in the time `WITHIN` after the cut [N].
        promised: Promised rate of false alarms per sample.
        bound: The rate that was expected at most with 95 % confidence, from the normal motion.
        time: Number of healthy samples that are worth one independent one.
    """

    healthy: Mapping[int, np.ndarray]
    cut: Mapping[str, Mapping[int, np.ndarray]]
    pull: Mapping[str, float]
    promised: float
    bound: float
    time: float


def rows_of(robot: RobotConfig, recording: Dataset) -> np.ndarray:
    """Return the samples of the model's signals [unit], shape (n, size)."""
    return np.concatenate([signals(recording)[name] for name in layout_of(robot).names], axis=1)


def train(robot: RobotConfig, lived: Dataset, seed: int) -> BodySchema:
    """Train a model of an arm on its own motion."""
    rows, layout = rows_of(robot, lived), layout_of(robot)
    parts = np.split(np.arange(len(rows)), range(EPISODE, len(rows), EPISODE))
    data = Dataset(layout, tuple(Episode("actual", layout.split(rows[part])) for part in parts))
    return fit(data, TrainConfig(seed=seed), MASKS)[0]


def shares(schema: BodySchema, rows: np.ndarray) -> dict[int, np.ndarray]:
    """Return number of samples -> shares of the limits of windows that end at each sample; NaN before the first."""
    x = schema.scaler.normalise(rows)
    result = {}
    for count in WINDOWS:
        values = np.full(len(x), np.nan)
        for end in range(count, len(x) + 1):
            values[end - 1] = window_score(schema, x[end - count : end])
        result[count] = values
    return result


def run_seed(run: Run, report: Progress) -> Outcome:
    """Record one arm, train its model and judge it."""
    robot, seed = run.robot, run.seed

    def recorded(name: str, motion: int, duration: float, cut: str = "") -> Dataset:
        parts = ((CUT_AFTER, f"muscle_cut:{cut}"),) if cut else ()
        chance = 1000 * motion + seed

        def make() -> Dataset:
            return record(robot, seed, chance, duration, parts)

        return run.cached(name, make, motion=chance, duration=duration)

    report(0.0, "moving")
    lived, normal = recorded("lived", 700, LIVED), recorded("normal", 701, NORMAL)
    healthy = recorded("healthy", 702, HEALTHY)
    muscles = robot.signals[TENSION].elements
    cuts = {muscle: recorded(f"cut_{muscle}", 710 + index, CUT, muscle) for index, muscle in enumerate(muscles)}
    report(0.5, "training")
    schema = run.cached("schema", lambda: train(robot, lived, seed))
    rows = rows_of(robot, normal)
    learned = learn_normal(schema, rows, training=(rows_of(robot, lived), np.zeros((len(rows_of(robot, lived)), 0))))
    schema = schema.with_normal(learned)
    report(0.8, "judging")
    pulled = {}
    for index, muscle in enumerate(muscles):
        whole = signals(recorded(f"whole_{muscle}", 710 + index, CUT_AFTER + WITHIN))
        pulled[muscle] = float(whole[TENSION][round(CUT_AFTER * RATE) :, index].mean())
    scores = shares(schema, rows_of(robot, healthy))
    return Outcome(
        healthy=scores,
        cut={muscle: shares(schema, rows_of(robot, recording)) for muscle, recording in cuts.items()},
        pull=pulled,
        promised=learned.false_alarm,
        bound=learned.bound,
        time=correlation_time(np.log(scores[1])),
    )


def events(alarms: np.ndarray) -> int:
    """Return the number of alarms that are at least `EVENT` samples apart, of truth values, shape (n,)."""
    place = np.flatnonzero(alarms)
    return int(len(place) > 0) + int((np.diff(place) >= EVENT).sum())


def hourly(outcomes: list[Outcome], count: int) -> float:
    """Return the limit that windows of `count` samples of all healthy arms exceed at most once per hour."""
    scores = [outcome.healthy[count] for outcome in outcomes]
    hours = sum(len(values) for values in scores) / RATE / 3600.0
    for limit in np.geomspace(0.3, 10.0, 700):
        if sum(events(values > limit) for values in scores) <= max(1.0, hours):
            return float(limit)
    return float("inf")


def delays(outcomes: Mapping[int, Outcome], console: Console) -> None:
    """Print the delay of every window at one false alarm per hour."""
    table = Table("window", "limit", f"muscles that pull found within {WITHIN:g} s", "median delay", "later")
    cut = round(CUT_AFTER * RATE)
    for count in WINDOWS:
        limit = hourly(list(outcomes.values()), count)
        after: dict[str, float] = {}
        for seed, outcome in outcomes.items():
            for muscle, scores in outcome.cut.items():
                if outcome.pull[muscle] >= PULLS:
                    above = np.flatnonzero(scores[count][cut:] > limit)
                    name = f"{seed} {muscle} ({outcome.pull[muscle]:.0f} N)"
                    after[name] = (above[0] + 1) / RATE if len(above) else np.inf
        late = [name for name, delay in after.items() if delay > WITHIN]
        which = ", ".join(late) if len(late) <= 5 else f"{len(late)} muscles"
        row = f"{len(after) - len(late)} of {len(after)}", f"{np.median(list(after.values())):.1f} s", which
        table.add_row(f"{count / RATE:g} s", f"{limit:.2f}", *row)
    console.print(table)


def show(outcomes: Mapping[int, Outcome], console: Console) -> None:
    """Print the tables."""
    start = round((CUT_AFTER + SETTLED) * RATE)
    table = Table("arm", *(f"AUROC {count / RATE:g} s" for count in WINDOWS), "worst muscle (1 sample)", "false alarms")
    means = []
    for seed, outcome in outcomes.items():
        areas = {
            count: [
                area(scores[count][max(start, count) :], outcome.healthy[count][count:])
                for scores in outcome.cut.values()
            ]
            for count in WINDOWS
        }
        means.append([np.mean(areas[count]) for count in WINDOWS])
        observed = float((outcome.healthy[1] > 1.0).mean())
        bound = at_most(observed, len(outcome.healthy[1]) / outcome.time)
        alarms = (
            f"{outcome.promised:.2%} promised (at most {outcome.bound:.1%}), {observed:.2%} seen (at most {bound:.1%})"
        )
        table.add_row(str(seed), *(f"{mean:.3f}" for mean in means[-1]), f"{min(areas[1]):.3f}", alarms)
    table.add_row("mean", *(f"{mean:.3f}" for mean in np.mean(means, axis=0)), "", "")
    console.print(table)
    delays(outcomes, console)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[911, 912, 913, 914, 915])
    parser.add_argument("--fresh", action="store_true", help="empty the cache first")
    options = parser.parse_args()
    arm = load_robot(Path("robots/musashi_arm.yaml"))
    with progress("anomaly") as bar:
        results = each_seed(arm, options.seeds, Path("runs/anomaly"), bar, options.fresh, run_seed)
    show(dict(zip(options.seeds, results, strict=True)), Console(width=150))
