"""Structure determination (paper, II-E): which signals can be inferred, and from which masks."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from gemuco.dataset import Dataset
from gemuco.errors import NotEnoughData, SchemaError
from gemuco.masks import Mask, all_masks, label
from gemuco.signals import Layout
from gemuco.train import Progress, TrainConfig, fit

MAX_SIGNALS = 10
"""Every mask is tried, and there are 2^n - 1 of them."""


@dataclass(frozen=True, slots=True)
class Thresholds:
    """When something counts as inferable.

    Attributes:
        out: A signal whose L_i is below is an output (the paper's C^out).
        into: A mask whose L_m is below is feasible (the paper's C^in).
        measure: `mse` (mean squared error in standard deviations) or `rmse` (its root). The paper leaves it open; its
            figures for the muscle-driven arm fit `mse`.
        over: L_m over the `masked` outputs only, or over `all`. The paper's own figures need `masked`: what a network
            is given it also gives back, and that would dilute the error of what it must infer.
    """

    out: float = 0.15
    into: float = 0.15
    measure: str = "mse"
    over: str = "masked"

    def __post_init__(self) -> None:
        for name, value, known in (
            ("measure", self.measure, ("mse", "rmse")),
            ("over", self.over, ("masked", "all")),
        ):
            if value not in known:
                raise SchemaError(f"Structure {name} '{value}' is not known. Known: {', '.join(known)}.")


@dataclass(frozen=True, slots=True)
class Structure:
    """What was determined.

    Attributes:
        layout: The signals it is about.
        x_in: Inputs, the union of the feasible masks.
        x_out: Outputs.
        masks: Feasible masks, the best first.
        L_i: Signal -> error when inferred from all others.
        L_m: Mask -> error of x_out.
        thresholds: What the errors were compared with.
    """

    layout: Layout
    x_in: tuple[str, ...]
    x_out: tuple[str, ...]
    masks: tuple[Mask, ...]
    L_i: dict[str, float]
    L_m: dict[Mask, float]
    thresholds: Thresholds

    def report(self) -> str:
        """A table for people."""
        width = max([len(label(m, self.layout.names)) for m in self.L_m] + [len(n) for n in self.L_i])
        unit = "mean squared error" if self.thresholds.measure == "mse" else "root mean square error"
        lines = [f"Errors on held-out data: {unit} in standard deviations.", ""]
        lines.append(f"{'inferred from all others':<{width}}  {'L_i':>7}  output if below {self.thresholds.out:g}")
        for name, value in self.L_i.items():
            lines.append(f"{name:<{width}}  {value:7.3f}  {'yes' if name in self.x_out else 'no'}")
        lines += ["", f"{'mask':<{width}}  {'L_m':>7}  feasible if below {self.thresholds.into:g}"]
        for m, value in sorted(self.L_m.items(), key=lambda item: item[1]):
            lines.append(f"{label(m, self.layout.names):<{width}}  {value:7.3f}  {'yes' if m in self.masks else 'no'}")
        lines += ["", f"x_in  = {', '.join(self.x_in)}", f"x_out = {', '.join(self.x_out)}"]
        return "\n".join(lines)


def determine(
    dataset: Dataset, config: TrainConfig, thresholds: Thresholds | None = None, progress: Progress | None = None
) -> Structure:
    """Train once under all masks, measure each on held-out episodes, and keep what can be inferred.

    Raises:
        NotEnoughData: Too few samples, or no signal or mask is below its threshold.
    """
    thresholds = thresholds or Thresholds()
    layout = dataset.layout
    names = layout.names
    if not 2 <= len(names) <= MAX_SIGNALS:
        raise NotEnoughData(f"Structure determination handles 2 to {MAX_SIGNALS} signals; there are {len(names)}.")
    schema, _ = fit(dataset, config, all_masks(names), progress, title="structure")
    held = dataset.split(config.held_out, config.seed)[1].rows()
    x = schema.scaler.normalise(held)
    x = x[np.isfinite(x).all(axis=1)]
    if not len(x):
        raise NotEnoughData("No held-out sample has every signal; structure determination needs some that do.")
    squared = {m: (schema.infer(x, m) - x) ** 2 for m in all_masks(names)}

    def error(m: Mask, judged: Iterable[str]) -> float:
        mse = float(squared[m][:, layout.indices(judged)].mean())
        return mse if thresholds.measure == "mse" else float(np.sqrt(mse))

    L_i = {name: error(frozenset(names) - {name}, [name]) for name in names}
    x_out = tuple(name for name in names if L_i[name] < thresholds.out)
    if not x_out:
        raise NotEnoughData(
            f"No signal can be inferred from the others (smallest L_i {min(L_i.values()):.3f}, threshold "
            f"{thresholds.out:g}); collect more data or raise the threshold."
        )
    L_m: dict[Mask, float] = {}
    for m in all_masks(names):
        if not set(x_out) <= m:
            L_m[m] = error(m, set(x_out) - m if thresholds.over == "masked" else x_out)
    masks = tuple(sorted((m for m in L_m if L_m[m] < thresholds.into), key=lambda m: L_m[m]))
    if not masks:
        raise NotEnoughData(
            f"No mask is enough to infer x_out (smallest L_m {min(L_m.values()):.3f}, threshold {thresholds.into:g}); "
            "collect more data or raise the threshold."
        )
    x_in = tuple(name for name in names if any(name in m for m in masks))
    return Structure(layout, x_in, x_out, masks, L_i, L_m, thresholds)


def for_structure(config: TrainConfig) -> TrainConfig:
    """The same training, shortened: structure needs errors to one digit, the model needs all it can get."""
    return replace(config, epochs=max(1, config.epochs // 3))
