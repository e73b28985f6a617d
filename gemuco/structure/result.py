"""Result of structure determination, and its report as text."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gemuco.masks import Mask, label
from gemuco.signals import Layout
from gemuco.structure.mask_judge import Thresholds

SHOWN = 40
"""The report's table has at most this many masks."""
WIDEST = 6
"""With more outputs, the table of masks has no column for each."""


@dataclass(frozen=True, slots=True)
class Structure:
    """Result of structure determination.

    Attributes:
        layout: All signals.
        x_in: Inputs, the union of the masks.
        x_out: Outputs.
        masks: Masks for the schema, the best first: the feasible ones, or the best of those above the threshold.
        L_i: Signal -> error when inferred from its best mask; infinite if no held-out sample has it.
        L_m: Mask -> error of x_out, for every mask that was measured.
        thresholds: Largest errors of outputs and of feasible masks.
        is_whole: Whether every mask was measured, or the search ended because nothing was left to measure.
        spread_i: Signal -> standard error of L_i over the splits; NaN with one split.
        spread_m: Mask -> standard error of L_m over the splits; NaN with one split.
        rms_i: Signal -> root mean square error when inferred from its best mask [its unit].
        rms_m: Listed mask -> root mean square error of every output that it lacks [its unit].
        best: Signal -> the mask that infers it best.
        splits: Number of times that other data were held out.
        open: Signals and masks whose errors are, within their spread, on either side of the threshold.
        poor: Signals that are outputs although L_i is not below the threshold.
        notes: Sentences on the data.
    """

    layout: Layout
    x_in: tuple[str, ...]
    x_out: tuple[str, ...]
    masks: tuple[Mask, ...]
    L_i: dict[str, float]
    L_m: dict[Mask, float]
    thresholds: Thresholds
    is_whole: bool = True
    spread_i: Mapping[str, float] = field(default_factory=dict)
    spread_m: Mapping[Mask, float] = field(default_factory=dict)
    rms_i: Mapping[str, float] = field(default_factory=dict)
    rms_m: Mapping[Mask, Mapping[str, float]] = field(default_factory=dict)
    best: Mapping[str, Mask] = field(default_factory=dict)
    splits: int = 1
    open: tuple[str | Mask, ...] = ()
    poor: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def feasible(self) -> tuple[Mask, ...]:
        """Measured masks below the threshold, the best first."""
        return tuple(sorted((m for m in self.L_m if self.L_m[m] < self.thresholds.into), key=lambda m: self.L_m[m]))

    @property
    def listed(self) -> tuple[Mask, ...]:
        """The masks of the report: those of the smallest errors, at most `SHOWN`."""
        return tuple(sorted(self.L_m, key=lambda m: self.L_m[m])[:SHOWN])

    @property
    def is_poor(self) -> bool:
        """Whether the outputs or the masks are above their thresholds."""
        return bool(self.poor) or not self.feasible

    @property
    def facts(self) -> dict[str, Any]:
        """The result as JSON values, for the manifest of a schema."""
        names = self.layout.names
        return {
            "L_i": dict(self.L_i),
            "L_i_spread": {name: value for name, value in self.spread_i.items() if np.isfinite(value)},
            "L_m": {label(m, names): self.L_m[m] for m in self.listed},
            "splits": self.splits,
            "poor": list(self.poor or (self.x_out if self.is_poor else ())),
        }

    @property
    def remarks(self) -> tuple[str, ...]:
        """Facts that the tables do not show, one sentence each."""
        return (*self._on_poor(), *self._on_open(), *self._on_signals(), *self._on_masks(), *self.notes)

    def _on_poor(self) -> list[str]:
        sentences: list[str] = []
        if self.poor:
            shown = " and ".join(f"'{name}' ({self.error_text(name)})" for name in self.poor)
            sentences.append(
                f"POOR: no L_i is below threshold_out {self.thresholds.out:g}. The model infers {shown} all the same. "
                "If such an error is acceptable, raise structure.threshold_out (Thresholds(out=...) in Python); "
                "otherwise add a sensor or more data."
            )
        if not self.feasible:
            least = self.L_m[self.masks[0]]
            sentences.append(
                f"POOR: no L_m is below threshold_in {self.thresholds.into:g}. The best masks are kept (L_m from "
                f"{least:.3f}). If such an error is acceptable, raise structure.threshold_in (Thresholds(into=...) in "
                "Python)."
            )
        return sentences

    def _on_open(self) -> list[str]:
        signals = [f"L_i of {item}" for item in self.open if isinstance(item, str)]
        masks = [item for item in self.open if not isinstance(item, str)]
        if len(masks) > 3:
            signals.append(f"L_m of {len(masks)} masks")
        else:
            signals += [f"L_m of {label(m, self.layout.names)}" for m in masks]
        if not signals:
            return []
        return [
            f"Undecided after {self.splits} splits: {', '.join(signals)} may be on either side of the threshold. More "
            "data decide it; the mean is used."
        ]

    def _on_signals(self) -> list[str]:
        sentences: list[str] = []
        for name in self.x_out:
            if all(name in m for m in self.masks):
                sentences.append(
                    f"'{name}' is an output, but every feasible mask contains it (without it no mask is below "
                    "threshold_in): when it is missing it is estimated by descent on z."
                )
        for name in self.layout.names:
            if name not in self.x_in and name not in self.x_out:
                sentences.append(f"'{name}' is neither input nor output: the model does not use it.")
        return sentences

    def _on_masks(self) -> list[str]:
        sentences: list[str] = []
        if len(self.masks) < len(self.feasible):
            sentences.append(
                f"{len(self.feasible)} of {len(self.L_m)} measured masks are feasible; the {len(self.masks)} that "
                "serve random sets of available signals best are kept."
            )
        if not self.is_whole:
            sentences.append("The search stopped at its budget: there may be feasible masks that it did not measure.")
        return sentences

    def error_text(self, name: str) -> str:
        """Return the error of a signal inferred from its best mask in its unit and in per cent of its spread."""
        percent = f"{100.0 * self.thresholds.share(self.L_i[name]):.0f} % of its standard deviation"
        if name not in self.rms_i:
            return percent
        return f"{with_unit(self.rms_i[name], self.layout.signal(name).unit)}, {percent}"

    def report(self, width: int | None = None) -> str:
        """Return the errors and the result as tables of text.

        Args:
            width: The table of masks has no errors of single signals if it would have longer lines than this.
        """
        times = f"{self.splits} splits" if self.splits > 1 else "one split"
        unit = "mean squared error" if self.thresholds.measure == "mse" else "root mean square error"
        masks = _table(self._mask_rows())
        if width is not None and max(map(len, masks)) > width:
            masks = _table(self._mask_rows(is_brief=True))
        lines = [
            f"Errors on held-out data of {times}: L is the {unit} in standard deviations, +- its standard error.",
            "Beside it: the root mean square error in per cent of the standard deviation, and in the signal's unit.",
            "",
            *_table(self._signal_rows()),
            "",
            *masks,
        ]
        if len(self.listed) < len(self.L_m):
            lines.append(f"and {len(self.L_m) - len(self.listed)} more")
        return "\n".join(
            [*lines, "", f"x_in  = {', '.join(self.x_in)}", f"x_out = {', '.join(self.x_out)}", *self.remarks]
        )

    def _signal_rows(self) -> list[list[str]]:
        rows = [["signal", "L_i", "", "% std", "rms error", f"output if below {self.thresholds.out:g}", "best from"]]
        for name, value in self.L_i.items():
            answer = "yes" if name in self.x_out else "no"
            rms = with_unit(self.rms_i[name], self.layout.signal(name).unit) if name in self.rms_i else ""
            source = self.best.get(name, frozenset())
            others = set(self.L_i) - {name}
            best = "all others" if source == others else label(source, self.layout.names)
            answer = "poor" if name in self.poor else answer
            rows.append([name, *self._numbers(value, self.spread_i.get(name, np.nan)), rms, answer, best])
        return rows

    def _mask_rows(self, is_brief: bool = False) -> list[list[str]]:
        is_brief |= len(self.x_out) > WIDEST
        outputs = [] if is_brief else [self.layout.signal(name) for name in self.x_out]
        heads = [f"{signal.name} [{signal.unit}]" for signal in outputs] if self.rms_m else []
        rows = [["mask", "L_m", "", "% std", *heads, f"feasible if below {self.thresholds.into:g}"]]
        for m in self.listed:
            answer = "yes" if self.L_m[m] < self.thresholds.into else "poor" if m in self.masks else "no"
            errors = self.rms_m.get(m, {})
            cells = [f"{errors[s.name]:.3g}" if s.name in errors else "given" for s in outputs] if heads else []
            numbers = self._numbers(self.L_m[m], self.spread_m.get(m, np.nan))
            rows.append([label(m, self.layout.names), *numbers, *cells, answer])
        return rows

    def _numbers(self, value: float, spread: float) -> list[str]:
        margin = f"+- {_number(spread)}" if np.isfinite(spread) else ""
        return [_number(value), margin, f"{100.0 * self.thresholds.share(value):.0f}"]


def with_unit(value: float, unit: str) -> str:
    """Return a number with its unit; the unit 1 is not written."""
    return f"{value:.3g}" if unit == "1" else f"{value:.3g} {unit}"


def _number(value: float) -> str:
    return f"{value:.4f}" if value < 0.01 else f"{value:.3f}"


def _table(rows: list[list[str]]) -> list[str]:
    """Return aligned lines of cells; names and answers are aligned to the left."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    is_text = [column == 0 or head.startswith(("output", "feasible", "best")) for column, head in enumerate(rows[0])]
    lines = []
    for row in rows:
        cells = [
            text.ljust(width) if left else text.rjust(width)
            for text, width, left in zip(row, widths, is_text, strict=True)
        ]
        lines.append("  ".join(cell for cell, width in zip(cells, widths, strict=True) if width).rstrip())
    return lines
