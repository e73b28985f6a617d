"""Pictures of the Musashi experiments, after the paper's figure: (a) to (f)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from hal.config import RobotConfig
from services.learning.plots import plot_structure
from studies.paper.figures import bars, picture, score_over_time
from studies.paper.musashi import simulation
from studies.paper.musashi.control import OURS
from studies.paper.musashi.model import decay
from studies.paper.musashi.motion import POSITION, RATE, TENSION
from studies.paper.musashi.seed import AFTER, BEFORE, STORY, STORY_MUSCLE, Outcome

COLORS = {BEFORE: "tab:orange", AFTER: "tab:blue"}
SMOOTH = 50
"""Number of samples over which drawn errors are averaged."""


def draw(outcomes: Sequence[Outcome], robot: RobotConfig, folder: Path) -> None:
    """Draw all pictures; those of a single arm show the first seed."""
    first = outcomes[0]
    plot_structure(first.structure, folder / "structure.png")
    _update(outcomes, folder / "a_online_update.png")
    _story(first, folder / "b_anomaly.png")
    _control(outcomes, folder / "c_control.png")
    _motion(first, robot, folder / "d_simulated_motion.png")
    _simulation_errors(outcomes, folder / "e_simulation_errors.png")
    _forced(first, robot, folder / "f_forced.png")


def _smooth(values: np.ndarray) -> np.ndarray:
    return np.convolve(values, np.ones(SMOOTH) / SMOOTH, mode="valid")


def _update(outcomes: Sequence[Outcome], path: Path) -> None:
    with picture(path, "Joint error with hidden encoders, 5 s averages and fits") as (axis,):
        for outcome in outcomes:
            half = SMOOTH // 2
            smooth = _smooth(outcome.learning)
            time = outcome.time[half : half + len(smooth)]
            (line,) = axis.plot(time, smooth, linewidth=0.7, alpha=0.6, label=f"arm {outcome.seed}")
            fit = decay(outcome.time, outcome.learning).at(outcome.time)
            axis.plot(outcome.time, fit, color=line.get_color(), linewidth=2)
            axis.plot(0.0, outcome.unchanged.mean(), "o", color=line.get_color(), clip_on=False)
        axis.axhline(0.15, color="0.4", linestyle="--", linewidth=1, label="to reach")
        axis.set_xlabel("time [s]; dots: the model as trained, on the same motion")
        axis.set_ylabel("error [rad], norm of five joints")
        axis.set_ylim(bottom=0.0)
        axis.legend(fontsize=8, ncols=2)
        axis.grid(color="0.93")


def _story(outcome: Outcome, path: Path) -> None:
    loaded, cut, end = STORY
    with picture(path, f"Heavy object from {loaded:.0f} s, {STORY_MUSCLE} cut at {cut:.0f} s", rows=2) as (
        upper,
        lower,
    ):
        time = np.arange(1, len(outcome.story[BEFORE]) + 1) / RATE
        for name in (BEFORE, AFTER):
            label = f"{name} the online update"
            upper.plot(time, outcome.story[name], linewidth=1, color=COLORS[name], label=label)
        upper.set_ylabel("joint error [rad]")
        upper.set_xlabel("time [s]")
        upper.set_ylim(bottom=0.0)
        spans = {"heavy object": (loaded, cut), "and a muscle cut": (cut, end)}
        scores = {f"{name} the online update": outcome.scores[name] for name in (BEFORE, AFTER)}
        score_over_time(lower, time, scores, outcome.threshold, spans)
        for line, name in zip(lower.get_lines(), (BEFORE, AFTER), strict=False):
            line.set_color(COLORS[name])
        lower.legend(fontsize=8)
        for moment in (loaded, cut):
            upper.axvline(moment, color="0.4", linestyle=":")
        upper.legend(fontsize=8)
        upper.grid(color="0.93")


def _control(outcomes: Sequence[Outcome], path: Path) -> None:
    with picture(path, "Control error, 5 targets (dots) from 5 starts each") as (axis,):
        for index, outcome in enumerate(outcomes):
            for side, name in ((-0.2, BEFORE), (0.2, AFTER)):
                missed = outcome.control[OURS][name]
                label = f"{name} the online update" if index == 0 else None
                mean, spread = float(np.nanmean(missed)), float(np.nanstd(missed))
                axis.bar(index + side, mean, 0.4, yerr=spread, capsize=2, color=COLORS[name], alpha=0.7, label=label)
                targets = np.nanmean(missed, axis=1)
                axis.plot(np.full(len(targets), index + side), targets, ".", color="black", markersize=4)
        axis.set_xticks(range(len(outcomes)), [f"arm {outcome.seed}" for outcome in outcomes])
        axis.set_ylabel("error [rad], norm of five joints")
        axis.legend(fontsize=8)
        axis.grid(axis="y", color="0.93")


def _motion(outcome: Outcome, robot: RobotConfig, path: Path) -> None:
    """Draw simulated and measured joint positions and tensions."""
    motions = outcome.motions[simulation.OURS]
    joints, muscles = robot.signals[POSITION].elements, robot.signals[TENSION].elements
    chosen = [(POSITION, index) for index in (0, 1, 3)] + [(TENSION, index) for index in (0, 6, 8)]
    with picture(path, f"The arm and the model as its simulator (arm {outcome.seed})", columns=3, rows=2) as axes:
        for axis, (signal, index) in zip(axes, chosen, strict=True):
            axis.plot(motions[AFTER].time, motions[AFTER].measured[signal][:, index], color="black", label="arm")
            for name in (BEFORE, AFTER):
                values = motions[name].values[signal][:, index]
                axis.plot(motions[name].time, values, linewidth=1, color=COLORS[name], label=f"simulated, {name}")
            element, unit = (joints[index], "rad") if signal == POSITION else (muscles[index], "N")
            axis.set_ylabel(f"{element} [{unit}]")
            axis.set_xlabel("time [s]")
            axis.legend(fontsize=7)


def _simulation_errors(outcomes: Sequence[Outcome], path: Path) -> None:
    with picture(path, "Simulation: mean error over two minutes of random motion", columns=2) as axes:
        for axis, (signal, unit) in zip(axes, ((POSITION, "rad"), (TENSION, "N")), strict=True):
            groups = {
                loss: {
                    name: [float(o.motions[loss][name].errors(signal).mean()) for o in outcomes]
                    for name in (BEFORE, AFTER)
                }
                for loss in (simulation.OURS, simulation.PAPER)
            }
            bars(axis, groups, unit)
            axis.set_title(signal)


def _forced(outcome: Outcome, robot: RobotConfig, path: Path) -> None:
    signals = ((POSITION, "joint position [rad]"), (TENSION, "muscle tension [N]"))
    with picture(path, f"The bent arm pushed and forced (arm {outcome.seed}, after the update)", rows=2) as axes:
        for axis, (signal, label) in zip(axes, signals, strict=True):
            _grouped(axis, outcome, signal, robot.signals[signal].elements)
            axis.set_ylabel(label)


def _grouped(axis: Axes, outcome: Outcome, signal: str, elements: Sequence[str]) -> None:
    width = 0.8 / len(outcome.forced)
    for index, (name, state) in enumerate(outcome.forced.items()):
        axis.bar(np.arange(len(elements)) + (index - 2) * width, state[signal], width, label=name)
    axis.set_xticks(range(len(elements)), list(elements), fontsize=7, rotation=20)
    axis.legend(fontsize=7)
    axis.grid(axis="y", color="0.93")
