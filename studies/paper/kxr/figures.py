"""Figures of the experiments on the humanoid, after the paper's figures of them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from studies.paper import figures
from studies.paper.kxr.actual import FOLLOWING, MODELS, Actual
from studies.paper.kxr.simulated import (
    AFTER,
    BLIND,
    CASES,
    GRADIENT,
    KNOWING,
    SEQUENCE,
    STEPS,
    TOOLS,
    Simulated,
    mask_errors,
)
from studies.paper.kxr.trials import smoothed

SHOWN = ("ekf", "gradient")
THRESHOLD = 0.15


def draw(folder: Path, simulated: Sequence[Simulated], actual: Sequence[Actual]) -> None:
    """Write every figure; maps of p are those of the first seed, curves are of all seeds."""
    _structure(folder / "structure.png", simulated)
    _maps(folder / "bias_map.png", simulated[0])
    _control(folder / "control.png", simulated)
    _actual(folder / "actual.png", actual)


def _structure(path: Path, simulated: Sequence[Simulated]) -> None:
    with figures.picture(path, "Structure: errors on held-out data, all seeds", columns=2) as (left, right):
        outputs = {
            name: [seed.schema.manifest["L_i"][name] for seed in simulated] for name in simulated[0].schema.layout.names
        }
        _bars(left, outputs, "L_i: each signal from all others")
        masks = [mask_errors(seed.schema) for seed in simulated]
        ordered = sorted(masks[0], key=lambda mask: float(np.mean([errors[mask] for errors in masks])))
        _bars(right, {mask: [errors[mask] for errors in masks] for mask in ordered}, "L_m: masked signals, by mask")
        right.set_ylabel("joints, center of gravity, tip, pixel")


def _bars(axis: Axes, values: dict[str, list[float]], title: str) -> None:
    means = [float(np.mean(v)) for v in values.values()]
    places = np.arange(len(values))
    axis.barh(
        places,
        means,
        xerr=[np.std(v) for v in values.values()],
        color=["tab:green" if mean < THRESHOLD else "0.6" for mean in means],
        ecolor="0.3",
        capsize=2,
    )
    axis.axvline(THRESHOLD, color="tab:red", linestyle="--", linewidth=1)
    axis.set_yticks(places, list(values), fontsize=9)
    axis.invert_yaxis()
    axis.set_xlabel("root mean square error [standard deviations]")
    axis.set_title(title, fontsize=10)


def _maps(path: Path, first: Simulated) -> None:
    biases = {name: first.schema.biases[name] for name in TOOLS}
    with figures.picture(path, "p of every tool, and its paths during updates", columns=2, rows=2) as axes:
        for axis, update in zip(axes, SHOWN, strict=False):
            steps = {f"short2long-{case[0]}": first.paths[case, update] for case in CASES}
            figures.bias_map(axis, biases, steps)
            axis.set_title(f"short_middle to {AFTER}, p by {update}", fontsize=10)
        figures.bias_map(axes[2], biases, first.leads)
        axes[2].set_title("to two tools, all sensors", fontsize=10)
        figures.bias_map(axes[3], biases, {update: first.controlled[update].biases for update in (KNOWING, GRADIENT)})
        axes[3].set_title(f"while controlled: {', '.join(SEQUENCE)}", fontsize=10)


def _control(path: Path, simulated: Sequence[Simulated]) -> None:
    updates = (BLIND, KNOWING, GRADIENT)
    with figures.picture(path, "Targets reached while tools change, all seeds", columns=2, rows=2) as axes:
        for row, (smooth, title) in enumerate(((False, "raw"), (True, "average of 5 steps"))):
            tips = {update: _curves([seed.controlled[update].tips for seed in simulated], smooth) for update in updates}
            figures.over_steps(axes[2 * row], tips, "mm", bar=12.0)
            axes[2 * row].set_title(f"tool tip, {title}", fontsize=10)
            centers = {
                update: _curves([seed.controlled[update].off_center for seed in simulated], smooth)
                for update in updates
            }
            centers["perfect model"] = _curves([seed.limit.off_center for seed in simulated], smooth)
            figures.over_steps(axes[2 * row + 1], centers, "mm", bar=15.0)
            axes[2 * row + 1].set_title(f"center of gravity, {title}", fontsize=10)
        for axis in axes:
            low, high = axis.get_ylim()
            axis.set_ylim(low - 0.1 * (high - low), high)
            for index, tool in enumerate(SEQUENCE):
                axis.axvline(index * STEPS + 0.5, color="0.5", linestyle=":", linewidth=1)
                axis.annotate(
                    tool, (index * STEPS + 1.5, 0.015), xycoords=("data", "axes fraction"), fontsize=8, color="0.3"
                )


def _curves(errors: Sequence[np.ndarray], smooth: bool) -> np.ndarray:
    return np.stack([1e3 * (smoothed(trial) if smooth else trial) for trial in errors])


def _actual(path: Path, actual: Sequence[Actual]) -> None:
    with figures.picture(path, "The actual robot", columns=2) as (left, right):
        figures.bias_map(left, {name: actual[0].schema.biases[name] for name in TOOLS}, actual[0].leads)
        left.set_title("p after fine-tuning, and its paths to two tools", fontsize=10)
        groups = {
            name: {
                model: [1e3 * getattr(seed.controlled[model], part).mean() for seed in actual]
                for model in (*MODELS, FOLLOWING)
            }
            for name, part in (("tool tip", "tips"), ("center of gravity", "off_center"))
        }
        figures.bars(right, groups, "mm")
        right.set_title(f"targets at {AFTER}, all seeds", fontsize=10)
