"""Signals as bars, and a score as a sparkline, for a terminal."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from rich.text import Text

from services.watch.signal_rows import Kind, SignalRow
from services.wire.plain_text import plain

BLOCKS = " ▏▎▍▌▋▊▉█"
HEIGHTS = "▁▂▃▄▅▆▇█"
STATES = {
    "measured": "cyan", "estimated": "bold yellow", "distrusted": "bold magenta", "lost": "bold red", "old": "dim",
    "recovered": "bold green",
}  # fmt: skip
"""Each state of an element has this style."""
DECADES = 1.0
"""A sparkline shows scores from a tenth of the threshold to ten times the threshold."""


class Ranges:
    """Range of every element: the robot file's limits, or the values seen so far."""

    def __init__(self, limits: Mapping[str, tuple[float, float]]) -> None:
        """Prepare with lowest and highest value [its unit] of elements (`signal.element`)."""
        self._limits = dict(limits)
        self._seen: dict[str, tuple[float, float]] = {}

    def share(self, row: SignalRow) -> float:
        """Return the place of a value in its range, 0 to 1; NaN without a value."""
        if not math.isfinite(row.value):
            return math.nan
        low, high = self._limits.get(row.name, (math.nan, math.nan))
        if not (math.isfinite(low) and math.isfinite(high)):
            low, high = self._seen.get(row.name, (row.value, row.value))
            low, high = min(low, row.value), max(high, row.value)
            self._seen[row.name] = (low, high)
        return float(np.clip((row.value - low) / (high - low), 0.0, 1.0)) if high > low else 0.5


class States:
    """State of every element, with a memory: an element that is measured again is `recovered` for some seconds."""

    RECOVERED_FOR = 4.0
    """An element counts as recovered for this time [s]."""

    def __init__(self) -> None:
        self._missing_since: dict[str, float] = {}
        self._back: dict[str, tuple[float, float]] = {}

    def of(self, row: SignalRow, now: float) -> tuple[str, str]:
        """Return the state of an element at a time [s], and words on it."""
        if row.kind is Kind.MEASURED:
            since = self._missing_since.pop(row.name, None)
            if since is not None:
                self._back[row.name] = now, now - since
            at, missing = self._back.get(row.name, (-math.inf, 0.0))
            if now - at < self.RECOVERED_FOR:
                return "recovered", f"measured again after {missing:.1f} s"
            return "measured", ""
        if row.kind is Kind.OLD:
            return "old", "no longer published"
        self._missing_since.setdefault(row.name, now)
        if row.kind is Kind.MASKED:
            return "lost", "lost, not estimated"
        origin = f"estimated from {row.source}" if row.source else "estimated"
        if row.distrust:
            return "distrusted", f"{row.distrust}; {origin}"
        return "estimated", f"{origin}, {row.state}" if row.state in ("doubtful", "unknown") else origin


def bar(share: float, width: int, style: str) -> Text:
    """Return a horizontal bar that is filled up to a share, 0 to 1; an empty one for NaN."""
    if not math.isfinite(share):
        return Text("┄" * width, style="red")
    eighths = round(share * width * 8)
    full, rest = divmod(eighths, 8)
    filled = "█" * full + (BLOCKS[rest] if rest else "")
    return Text(filled, style=style) + Text("─" * (width - len(filled)), style="bright_black")


def strip(shares: Sequence[float], styles: Sequence[str]) -> Text:
    """Return one vertical bar of one character per element; a cross for NaN."""
    text = Text()
    for share, style in zip(shares, styles, strict=True):
        text.append(HEIGHTS[min(7, int(8 * share))] if math.isfinite(share) else "✕", style=style)
        text.append(" ")
    return text


def sparkline(scores: Sequence[tuple[float, bool]], width: int) -> Text:
    """Return the newest ratios of score to threshold on a logarithmic scale; a dot for NaN.

    Args:
        scores: Ratios, each with whether the normal score of this body is known; above 1 it is red then, else yellow.
        width: At most this number of letters.
    """
    text = Text()
    for ratio, is_known in scores[-width:]:
        if not math.isfinite(ratio):
            text.append("·", style="dim")
            continue
        height = (math.log10(max(ratio, 1e-9)) / DECADES + 1.0) / 2.0
        style = "green" if ratio <= 1.0 else "bold red" if is_known else "yellow"
        text.append(HEIGHTS[int(np.clip(8 * height, 0, 7))], style=style)
    return text


def number(row: SignalRow) -> str:
    """Return the value of an element, with its expected error if it is estimated."""
    if not math.isfinite(row.value):
        return "-"
    return f"{row.value:+.3f}" + (f" ± {row.std:.3f}" if math.isfinite(row.std) else "")


def element_line(row: SignalRow, share: float, state: tuple[str, str], off: float, room: int) -> Text:
    """Return the line of one element.

    Args:
        row: The element.
        share: Place of its value in its range, 0 to 1.
        state: State, and words on it.
        off: Distance of an estimate from the simulator's truth [its unit]; NaN if it is not known.
        room: Width of the bar.
    """
    style = STATES[state[0]]
    line = Text(f" {plain(row.element, 15):<15} ") + bar(share, room, style)
    line.append(f" {number(row):<16} ", style=style)
    if math.isfinite(off):
        line.append(f"wrong by {off:.3f}  ", style=style)
    return line.append(plain(state[1], 200), style=style)
