"""All Musashi experiments of one seed: one training, one actual arm."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from gemuco.dataset import Dataset
from gemuco.schema import BodySchema
from gemuco.structure.determination import Structure
from services.learning.trainer import train
from services.show import Progress
from studies.paper.musashi import anomaly, control, model, simulation
from studies.paper.musashi.motion import TENSION, record
from studies.paper.runs import Run, between

LIVED, NORMAL, FRESH, CUT = 600.0, 240.0, 120.0, 30.0
"""Lengths of recordings [s]: for the update, for normal errors, for judging, and with a cut muscle."""
STORY = (60.0, 120.0, 180.0)
"""Figure (b): times [s] at which the healthy part, the heavy object and the cut muscle end."""
STORY_MUSCLE = "biceps"
STARTS = {control.OURS: control.STARTS, control.WEIGHTS: 1}
"""Number of starts per target."""
HELD = (1.0, 5.0, 10.0)
"""Times over which anomaly scores are averaged [s]."""
BEFORE, AFTER = "before", "after"
HEAVY = ((0.0, "heavy_object"),)

Pair = Mapping[str, np.ndarray]
"""`before` and `after` the online update -> values."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Results of one seed.

    Attributes:
        seed: Of training and arm.
        structure: Structure of the geometric data.
        time: Time of every sample of the online update [s], shape (n,).
        learning: Error of the estimate before each was learned from [rad], shape (n,).
        unchanged: Errors of the model as trained on the same samples [rad], shape (n,).
        fresh: Errors of the estimate on fresh random motion [rad].
        heavy: The same with a heavy object in the hand [rad].
        areas: Muscle -> area under the ROC curve of its cut, before and after.
        areas_held: The same after the update, of scores averaged over a time [s].
        story: Errors of the estimate [rad] while the arm is healthy, loaded, and cut.
        scores: Anomaly scores then.
        threshold: Threshold of the scores after the update.
        control: Weights -> errors [rad], shape (targets, starts), before and after.
        motions: Loss -> simulated motion, before and after.
        forced: Figure (f), after the update; see `simulation.forced`.
    """

    seed: int
    structure: Structure
    time: np.ndarray
    learning: np.ndarray
    unchanged: np.ndarray
    fresh: Pair
    heavy: Pair
    areas: Mapping[str, Mapping[str, float]]
    areas_held: Mapping[float, Mapping[str, float]]
    story: Pair
    scores: Pair
    threshold: float
    control: Mapping[str, Pair]
    motions: Mapping[str, Mapping[str, simulation.Trajectory]]
    forced: Mapping[str, Mapping[str, np.ndarray]]


def run_seed(run: Run, progress: Progress) -> Outcome:
    """Train, move the actual arm, learn from it, and judge the models before and after."""
    robot, seed = run.robot, run.seed
    progress(0.0, "drawing states of the geometric model")
    data = run.cached("geometric", lambda: model.geometric_data(robot, seed))
    before = run.cached("nominal_model", lambda: train(robot, data, seed, between(progress, 0.0, 0.2)).schema)
    progress(0.2, "moving the actual arm")
    lived = _recorded(run, "lived", 100, LIVED)
    progress(0.4, "learning from it")
    learned = model.learn(robot, before, lived, seed)
    normal = _recorded(run, "normal", 200, NORMAL)
    schemas = {
        BEFORE: anomaly.with_normal(before, normal),
        AFTER: anomaly.with_normal(learned.schema, normal),
    }
    progress(0.5, "moving it with a heavy object and cut muscles")
    motion, loaded = _recorded(run, "fresh", 300, FRESH), _recorded(run, "heavy", 400, FRESH, HEAVY)
    story = _story(run)
    cut = _cuts(run)
    progress(0.7, "controlling and simulating it")

    def both(measure: Callable[[BodySchema, Dataset], np.ndarray], recording: Dataset) -> dict[str, np.ndarray]:
        return {name: measure(schema, recording) for name, schema in schemas.items()}

    return Outcome(
        seed=seed,
        structure=model.structure_of(robot, before),
        time=learned.time,
        learning=learned.errors,
        unchanged=model.recorded_errors(before, lived),
        fresh=both(model.recorded_errors, motion),
        heavy=both(model.recorded_errors, loaded),
        areas={name: anomaly.areas(schema, [motion, loaded], cut) for name, schema in schemas.items()},
        areas_held={over: anomaly.areas(schemas[AFTER], [motion, loaded], cut, over) for over in HELD},
        story=both(model.recorded_errors, story),
        scores=both(anomaly.scores, story),
        threshold=getattr(schemas[AFTER].normal, "threshold", float("nan")),
        control={
            name: {
                which: control.errors(robot, schema, seed, config, STARTS[name]) for which, schema in schemas.items()
            }
            for name, config in control.controls(robot).items()
        },
        motions={
            name: {which: simulation.simulate(robot, schema, motion, terms) for which, schema in schemas.items()}
            for name, terms in simulation.losses(robot).items()
        },
        forced=simulation.forced(robot, schemas[AFTER]),
    )


def _recorded(run: Run, name: str, motion: int, duration: float, parts: tuple[tuple[float, str], ...] = ()) -> Dataset:
    """Return random motion of the run's arm; every name has its own motion."""
    seed = 1000 * motion + run.seed
    broken = [list(part) for part in parts]
    return run.cached(
        name,
        lambda: record(run.robot, run.seed, seed, duration, parts),
        motion=seed,
        duration=duration,
        broken=broken,
    )


def _story(run: Run) -> Dataset:
    healthy, loaded, end = STORY
    parts = ((healthy, "heavy_object"), (loaded, f"muscle_cut:{STORY_MUSCLE}"))
    return _recorded(run, "story", 500, end, parts)


def _cuts(run: Run) -> dict[str, Dataset]:
    """Return muscle -> motion after its cut."""
    cuts = {}
    for index, muscle in enumerate(run.robot.signals[TENSION].elements):
        parts = ((anomaly.CUT_AFTER, f"muscle_cut:{muscle}"),)
        whole = _recorded(run, f"cut_{muscle}", 600 + index, CUT, parts)
        cuts[muscle] = anomaly.since_cut(whole)
    return cuts
