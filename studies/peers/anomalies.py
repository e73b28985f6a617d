"""Healthy and broken bodies: cut muscles of simulated arms, and faults that are put into recordings of real robots.

Faults of recordings are put into held-out rows, of which the unchanged ones are the healthy rows.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from gemuco import TrainConfig
from hal import registry
from services.learning.playground import CollectionStopped, DirectPlayground
from simulators.direct import direct_robot
from simulators.muscle_world import MuscleWorld
from simulators.muscles import Elastic
from simulators.robots.musashi_arm.body import make_body
from studies.peers import recordings
from studies.peers.question import Bar, Rows, Trial
from studies.peers.robots import robot_of

RATE = 10.0
"""Rate of the samples of an arm [Hz]."""
LIVED, HEALTHY, CUT = 600.0, 120.0, 30.0
"""Lengths of recordings of an arm: to learn from, to be judged healthy, and with a cut muscle [s]."""
CUT_AFTER, SETTLED = 1.0, 1.0
"""Time of the cut, and from there to the first sample that counts [s]."""
ARMS = 1000
"""Offset of the number of an arm; no other study uses these."""
WINDOW = 30
"""Samples of a window of an arm's motion: 3 s."""
OFFSET, SCALE = 0.05, 0.8
"""Faults of recordings: an offset in standard deviations, and the factor of a sensor that reads too little."""
MOST = 1000
"""Largest number of rows that are judged, evenly spaced."""


@dataclass(frozen=True, slots=True)
class Watched:
    """Data of one seed or fold.

    Attributes:
        train: Healthy episodes to learn from.
        healthy: Healthy rows to be judged.
        broken: Fault -> rows to be judged.
    """

    train: Sequence[Rows]
    healthy: Rows
    broken: Mapping[str, Rows]


@dataclass(frozen=True, slots=True)
class Fault:
    """One row of the table: a body with one kind of fault.

    Attributes:
        name: Words for the table.
        units: Signal -> unit.
        watched: Seed -> data.
        bar: Required area under the ROC curve, mean over the faults.
        windows: Numbers of successive samples whose mean score is judged, one row of the table each.
    """

    name: str
    units: Mapping[str, str]
    watched: Callable[[int], Watched]
    bar: Bar
    windows: Sequence[int] = (1,)

    def settings(self, seed: int) -> TrainConfig:
        """Return the settings of the training: the defaults."""
        return TrainConfig(seed=seed)


def window_name(window: int) -> str:
    """Return the words for a row of the table."""
    return "single samples" if window == 1 else f"means of {window} samples"


def area(broken: np.ndarray, healthy: np.ndarray, window: int = 1) -> float:
    """Return the area under the ROC curve: how often a score of a broken body exceeds that of a healthy one.

    Scores are means over a window of samples. The area is NaN if a score is.
    """
    if not (np.isfinite(broken).all() and np.isfinite(healthy).all()):
        return float("nan")
    broken, healthy = (np.convolve(scores, np.full(window, 1.0 / window), "valid") for scores in (broken, healthy))
    ordered = np.sort(healthy)
    below = np.searchsorted(ordered, broken, side="left")
    not_above = np.searchsorted(ordered, broken, side="right")
    return float(np.mean(below + not_above) / (2.0 * len(ordered)))


def arm(seed: int, motion: int, duration: float, muscle: str) -> dict[str, np.ndarray]:
    """Record random motion of a muscle-driven arm whose parameters are drawn from the seed.

    Its wires run 7 to 10 mm beside the designer's; stiffness, friction, zeros and noise vary more than those of the
    actual arms of the simulator.

    Args:
        seed: Number of the arm.
        motion: Seed of the motion.
        duration: Length [s].
        muscle: Muscle that is cut after `CUT_AFTER`; empty: none.

    Returns:
        Signal -> samples [its unit], shape (n, size); fewer if the robot file's limits stopped the arm.
    """
    robot, random = robot_of("musashi_arm"), np.random.default_rng([seed, 31])
    body = make_body("actual", ARMS + seed)
    assert body.friction is not None
    size = len(body.slack)
    body = replace(
        body,
        elastic=Elastic(20.0 * random.uniform(0.5, 1.5, size), 120.0 * random.uniform(0.5, 1.2, size)),
        friction=replace(
            body.friction,
            wire=body.friction.wire * random.uniform(0.5, 2.0, size),
            guide=body.friction.guide * random.uniform(0.5, 1.5, size),
        ),
        slack=body.slack + random.normal(0.0, 0.003, size),
        noise={name: deviation * random.uniform(1.0, 3.0) for name, deviation in body.noise.items()},
    )
    world = MuscleWorld(body, 10_000 * seed + motion)
    rows: list[Mapping[str, np.ndarray]] = []
    with direct_robot(robot, world) as device:
        place = DirectPlayground(device, RATE)
        left = muscle
        for command, hold in registry.load_object(robot.collect["motion"])(robot, 1000 * motion + seed):
            if left and place.elapsed() >= CUT_AFTER:
                world.break_part(f"muscle_cut:{left}")
                left = ""
            if place.elapsed() >= duration:
                break
            try:
                rows.extend(dict(sample) for sample in place.play(command, hold))
            except CollectionStopped:
                break
    return {name: np.array([row[name] for row in rows]) for name in robot.signals}


def cut_muscles(record: Callable[..., dict[str, np.ndarray]], share: float, seed: int) -> Watched:
    """Record one arm, healthy and with each muscle cut; `record` is `arm` or its cached form.

    Args:
        record: `arm` or its cached form.
        share: Share of the healthy motion that is learned from.
        seed: Number of the arm.
    """
    first = round((CUT_AFTER + SETTLED) * RATE)
    broken = {}
    for index, muscle in enumerate(robot_of("musashi_arm").signals["muscle_tension"].elements):
        rows = record(seed, 3 + index, CUT, muscle)
        broken[muscle] = {name: values[first:] for name, values in rows.items()}
    lived = record(seed, 1, LIVED, "")
    learned = {name: values[: round(share * len(values))] for name, values in lived.items()}
    return Watched([learned], record(seed, 2, HEALTHY, ""), broken)


def _put(trial: Trial, faults: Mapping[str, Callable[[Rows], Rows]]) -> Watched:
    """Put faults into the held-out rows of a recording."""
    ((_, episodes),), ((_, whole),) = trial.train.items(), trial.test.items()
    every = max(1, -(-len(next(iter(whole.values()))) // MOST))
    rows = {name: values[::every] for name, values in whole.items()}
    return Watched(episodes, rows, {name: fault(rows) for name, fault in faults.items()})


def frozen(signal: str, rows: Rows) -> Rows:
    """Return rows in which a signal keeps its first value."""
    return {**rows, signal: np.repeat(rows[signal][:1], len(rows[signal]), axis=0)}


def shifted(signal: str, element: int, offset: float, rows: Rows) -> Rows:
    """Return rows with an offset of one element [unit]."""
    values = rows[signal].copy()
    values[:, element] += offset
    return {**rows, signal: values}


def scaled(signal: str, element: int, factor: float, rows: Rows) -> Rows:
    """Return rows with one element multiplied."""
    values = rows[signal].copy()
    values[:, element] *= factor
    return {**rows, signal: values}


def _boards(seed: int) -> Watched:
    faults = {board: partial(frozen, board) for board in recordings.BOARDS}
    return _put(recordings.capsule(seed), faults)


def _encoders(seed: int) -> Watched:
    trial = recordings.kuka_blocks(tuple(recordings.KUKA_UNITS), slice(6), seed)
    spread = trial.learned(recordings.SECOND).std(axis=0)
    faults = {f"axis {k + 1}": partial(shifted, recordings.SECOND, k, OFFSET * spread[k]) for k in range(3)}
    return _put(trial, faults)


def _torques(seed: int) -> Watched:
    faults = {f"joint {k + 1}": partial(scaled, recordings.EFFORT, k, SCALE) for k in range(6)}
    return _put(recordings.schunk(seed), faults)


def _pressures(seed: int) -> Watched:
    faults = {f"muscle {k + 1}": partial(scaled, recordings.PRESSURE, k, SCALE) for k in range(8)}
    return _put(recordings.pam(seed), faults)


@cache
def faults(record: Callable[..., dict[str, np.ndarray]]) -> tuple[Fault, ...]:
    """Return every row; `record` is `arm` or its cached form."""
    robot = robot_of("musashi_arm")
    best = Bar("at least", 0.5)
    return (
        *(
            Fault(
                f"simulated muscle arm, a cut muscle, {share * LIVED:.0f} s learned",
                {name: robot.signals[name].unit for name in robot.signals},
                partial(cut_muscles, record, share),
                bar,
                (1, WINDOW),
            )
            for share, bar in ((1.0, Bar("at least", 0.92)), (0.2, best))
        ),
        Fault("joint_capsule, a frozen board", recordings.CAPSULE_UNITS, _boards, best),
        Fault(f"kuka_kr300, second encoder off by {OFFSET:g} std", recordings.KUKA_UNITS, _encoders, best),
        Fault(f"schunk_arm, a torque times {SCALE:g}", recordings.SCHUNK_UNITS, _torques, best),
        Fault(f"pam_arm, a pressure times {SCALE:g}", recordings.PAM_UNITS, _pressures, best),
    )
