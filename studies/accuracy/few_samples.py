"""Few samples of the actual body: the online update, `adapt` on a list, and fine-tuning, and how far their std is true.

    python -m studies.accuracy.few_samples [--seeds 5]

Errors are measured on other motion of the same body (Musashi: joint error with all encoders hidden, norm of five
joints; KXR: other random postures). Coverage is the share of single errors within two of the expected standard
deviations, over all masks and the outputs that they do not contain. Data and first models are those of `gemuco
reproduce` and are cached with them.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from gemuco.adaption.adapt import adapt
from gemuco.dataset import Dataset, Episode
from gemuco.layers import run as predict
from gemuco.learning.accuracy import bias_of
from gemuco.learning.tune import fine_tune
from gemuco.schema import BodySchema
from hal.config import RobotConfig, load_robot
from services.learning.collector import collect_direct
from services.learning.trainer import FINE_TUNING_RATE, train, train_config
from services.model.artifacts import robot_file
from services.model.living_model import layout_of
from services.model.model_config import model_config
from studies.paper.kxr.robot import Standing, safe_postures
from studies.paper.kxr.simulated import TOOLS
from studies.paper.musashi import model
from studies.paper.musashi.motion import RATE, record
from studies.paper.musashi.seed import FRESH, LIVED
from studies.paper.runs import Run, open_run

RARE, COUNT = 5.0, 120
"""Time between rare samples [s], and their number."""
FEW = (5, 9, 30, COUNT)
"""Numbers of samples in a list."""
ROWS = 100
QUICK = 100.0
"""Rate of the fastest recording of `ROWS` samples [Hz]."""
POSTURES = 100, 60
"""Number of random postures per tool of the actual humanoid, to learn from and to judge."""

Figures = dict[str, list[float]]
"""Name of a figure -> its value for every seed."""


def musashi(run: Run, figures: Figures) -> None:
    """Measure the online update, lists and fine-tuning on one actual arm."""
    robot, seed = run.robot, run.seed
    silent = lambda *_: None
    data = run.cached("geometric", lambda: model.geometric_data(robot, seed))
    before = run.cached("nominal_model", lambda: train(robot, data, seed, silent).schema)
    lived = _recorded(run, "lived", 100, LIVED)
    fresh = _signals(robot, _recorded(run, "fresh", 300, FRESH))
    _note(figures, "joint error before, rad", float(model.recorded_errors(before, fresh).mean()))
    rows = _signals(robot, lived).rows()
    rare = _dataset(robot, rows[:: round(RARE * RATE)][:COUNT])
    learned = model.learn(robot, before, rare, seed).schema
    _judge(figures, f"online, {COUNT} samples {RARE:g} s apart", learned, fresh)
    often = model.learn(robot, before, lived, seed).schema
    _judge(figures, f"online, {LIVED:g} s at {RATE:g} Hz", often, fresh)
    for count in FEW:
        samples = [before.layout.split(row) for row in rare.rows()[:count]]
        _judge(figures, f"list of {count} samples {RARE:g} s apart", adapt(before, samples), fresh)
    quick = _signals(robot, _recorded(run, "quick", 700, 6.0, QUICK)).rows()[-ROWS:]
    recordings = {
        f"{RARE:g} s apart": rare.rows()[:ROWS],
        "1 s apart": rows[:: round(RATE)][:ROWS],
        f"at {RATE:g} Hz": rows[1000 : 1000 + ROWS],
        f"at {QUICK:g} Hz": quick,
    }
    for name, part in recordings.items():
        tuned = _tuned(run, before, _dataset(robot, part))
        _judge(figures, f"fine-tuned on {ROWS} rows {name}", tuned, fresh)


def kxr(run: Run, figures: Figures) -> None:
    """Measure the coverage after fine-tuning on one actual humanoid."""
    robot, seed = run.robot, run.seed
    data = run.cached("nominal", lambda: collect_direct(robot, "nominal", seed).dataset)
    before = run.cached("nominal_model", lambda: train(robot, data, seed, lambda *_: None).schema)
    learned, judged = run.cached("few_postures", lambda: _postures(run), postures=list(POSTURES))
    one = learned.episodes[1]
    share = ROWS // len(TOOLS) + 1
    spread = tuple(Episode(e.condition, {n: rows[:share] for n, rows in e.values.items()}) for e in learned.episodes)
    for name, episodes in (("of one tool", (one,)), ("of six tools", spread)):
        known = {episode.condition for episode in episodes}
        fresh = Dataset(judged.layout, tuple(e for e in judged.episodes if e.condition in known))
        tuned = _tuned(run, before, Dataset(learned.layout, episodes))
        _note(figures, f"KXR, fine-tuned on {ROWS} postures {name}: coverage", coverage(tuned, fresh))


def coverage(schema: BodySchema, fresh: Dataset) -> float:
    """Return the share of errors within two expected standard deviations; see the head of this file."""
    rows, names = fresh.rows(), list(schema.biases)
    x = schema.scaler.normalise(rows)
    owner = np.array([names.index(c) if c in names else 0 for c in fresh.conditions])[fresh.condition_of_rows()]
    p = bias_of(schema, owner)
    scale, inside = schema.scaler.std[schema.out_index], []
    for mask in schema.masks:
        usable = np.isfinite(x[:, schema.layout.indices(mask)]).all(axis=1)
        prediction = predict(schema.weights.whole, schema.network_input(x[usable], mask, p[usable]))
        errors = np.abs(prediction - x[usable][:, schema.out_index]) * scale
        for name, span in schema.out_layout.slices.items():
            if name not in mask:
                part = errors[:, span]
                inside.append(np.mean((part <= 2.0 * schema.errors["mask", mask][span])[np.isfinite(part)]))
    return float(np.mean(inside))


def _judge(figures: Figures, name: str, schema: BodySchema, fresh: Dataset) -> None:
    _note(figures, f"{name}: joint error, rad", float(model.recorded_errors(schema, fresh).mean()))
    _note(figures, f"{name}: coverage", coverage(schema, fresh))


def _note(figures: Figures, name: str, value: float) -> None:
    figures.setdefault(name, []).append(value)


def _tuned(run: Run, before: BodySchema, data: Dataset) -> BodySchema:
    """Return the model fine-tuned with the settings of `gemuco train --from`."""
    settings = model_config(run.robot)
    config = train_config(settings, settings.training.epochs, run.seed)
    return fine_tune(before, data, replace(config, rate=FINE_TUNING_RATE * config.rate))[0]


def _recorded(run: Run, name: str, motion: int, duration: float, rate: float = RATE) -> Dataset:
    """Return random motion of the run's arm; the first two are those of `gemuco reproduce musashi`."""
    seed = 1000 * motion + run.seed
    settings = {} if rate == RATE else {"rate": rate}
    return run.cached(
        name,
        lambda: record(run.robot, run.seed, seed, duration, rate=rate),
        motion=seed,
        duration=duration,
        broken=[],
        **settings,
    )


def _signals(robot: RobotConfig, recording: Dataset) -> Dataset:
    """Return a recording without the commands."""
    return recording.with_layout(layout_of(robot))


def _dataset(robot: RobotConfig, rows: np.ndarray) -> Dataset:
    return Dataset(layout_of(robot), (Episode("arm", layout_of(robot).split(rows)),))


def _postures(run: Run) -> tuple[Dataset, Dataset]:
    """Return random postures of the actual humanoid with every tool, to learn from and to judge."""
    layout, random = layout_of(run.robot), np.random.default_rng([run.seed, 900])
    parts: tuple[list[Episode], list[Episode]] = ([], [])
    for tool in TOOLS:
        body = Standing(run.robot, "actual", run.seed, tool)
        for episodes, count in zip(parts, POSTURES, strict=True):
            rows = [layout.join(body.go(posture)) for posture in safe_postures(run.robot, tool, count, random)]
            episodes.append(Episode(tool, layout.split(np.stack(rows))))
    return Dataset(layout, tuple(parts[0])), Dataset(layout, tuple(parts[1]))


STUDIES: Mapping[str, Callable[[Run, Figures], None]] = {"musashi_arm": musashi, "kxr_humanoid": kxr}


def measure(seeds: int, folder: Path) -> Iterator[tuple[str, int, Figures]]:
    """Yield robot, finished seeds and figures after every seed."""
    for name, study in STUDIES.items():
        figures: Figures = {}
        robot = load_robot(robot_file(name))
        for seed in range(seeds):
            study(open_run(robot, folder / name, seed), figures)
            yield name, seed + 1, figures


def main() -> None:
    parser = argparse.ArgumentParser(description="Few samples of the actual body")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("runs/reproduce"))
    arguments, console = parser.parse_args(), Console()
    done: dict[str, Figures] = {}
    for name, count, figures in measure(arguments.seeds, arguments.out):
        console.print(f"{name}: {count} of {arguments.seeds} seeds")
        done[name] = figures
    table = Table("figure", "mean", "std")
    for figures in done.values():
        for name, values in figures.items():
            table.add_row(name, f"{np.mean(values):.3g}", f"{np.std(values):.2g}")
    console.print(table)


if __name__ == "__main__":
    main()
