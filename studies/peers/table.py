"""The tables: every method on every row, the bar, and whether it is met."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from studies.peers.question import Bar

OURS = "gemuco"


@dataclass(frozen=True, slots=True)
class Figures:
    """Errors of one method on one row, over seeds or folds.

    Attributes:
        unit: Errors in the shown unit.
        std: Errors in standard deviations of the training rows; empty for scores.
    """

    unit: tuple[float, ...]
    std: tuple[float, ...] = ()

    def mean(self, in_std: bool) -> float:
        """Return the mean over the seeds; NaN if a seed has no figure."""
        values = self.std if in_std else self.unit
        return float(np.mean(values)) if values else float("nan")

    def text(self) -> str:
        """Return mean and spread in both units."""
        if not np.isfinite(self.mean(False)):
            return "no estimate"
        text = f"{self.mean(False):.3g} ± {np.std(self.unit):.1g}"
        return text + (f" ({self.mean(True):.3g} ± {np.std(self.std):.1g})" if self.std else "")


@dataclass(frozen=True, slots=True)
class Row:
    """One row.

    Attributes:
        body: The body and what is held out.
        question: The missing signal and the given ones.
        shown: Unit.
        bar: Required error.
        peers: Peer -> figures.
        ours: Figures of the model; None if it was not run.
        settings: Settings of its training, in words.
        seconds: Mean duration of its training [s].
        refusal: Words with which it refused the data.
    """

    body: str
    question: str
    shown: str
    bar: Bar
    peers: Mapping[str, Figures]
    ours: Figures | None
    settings: str = ""
    seconds: float = float("nan")
    refusal: str = ""

    @property
    def best(self) -> str:
        """The peer with the best mean in the bar's unit; empty without peers."""
        means = self._means()
        choose = max if self.bar.is_score else min
        return choose(means, key=lambda name: means[name]) if means else ""

    @property
    def limit(self) -> float | None:
        """The figure that is just good enough, in the bar's unit."""
        return self.bar.limit(self._means())

    @property
    def ratio(self) -> float:
        """Figure of the model as a multiple of the best peer's."""
        if self.ours is None or not self.best:
            return float("nan")
        return self.ours.mean(self.bar.in_std) / self.peers[self.best].mean(self.bar.in_std)

    @property
    def is_met(self) -> bool | None:
        """Whether the model meets the bar; None without a bar or without its figures. No estimate never meets it."""
        if self.limit is None or self.ours is None:
            return None
        return self.bar.is_met(self.ours.mean(self.bar.in_std), self.limit)

    def _means(self) -> dict[str, float]:
        means = {name: figures.mean(self.bar.in_std) for name, figures in self.peers.items()}
        return {name: value for name, value in means.items() if np.isfinite(value)}

    def record(self) -> dict[str, Any]:
        """Return the row as plain data; None where there is no figure."""
        judged = {"bar": str(self.bar), "best": self.best, "limit": self.limit, "ratio": self.ratio}
        record: dict[str, Any] = _plain({**asdict(self), **judged, "is_met": self.is_met})
        return record


def _plain(value: Any) -> Any:
    """Return plain data with None in place of NaN, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def verdict(row: Row) -> str:
    """Return `met`, `NOT met`, or a dash."""
    return {True: "met", False: "**NOT met**", None: "-"}[row.is_met]


def verdicts(rows: Sequence[Row]) -> str:
    """Return a table of Markdown: best peer, the model, the bar and the verdict; refusals of the model below it."""
    lines = ["| body | missing signal | unit | best peer | gemuco | ratio | bar | verdict | trained [s] |"]
    lines.append("|" + "---|" * 9)
    for row in rows:
        best = f"{row.best} {row.peers[row.best].text()}" if row.best else "-"
        limit = "" if row.limit is None else f" = {row.limit:.3g}"
        cells = (row.body, row.question, row.shown, best, _ours(row), f"{row.ratio:.2f}", f"{row.bar}{limit}")
        lines.append("| " + " | ".join((*cells, verdict(row), f"{row.seconds:.0f} ({row.settings})")) + " |")
    refusals = dict.fromkeys(f"{row.body}: {row.refusal}" for row in rows if row.refusal)
    return "\n".join([*lines, *([""] if refusals else []), *refusals])


def figures(rows: Sequence[Row], methods: Sequence[str]) -> str:
    """Return a table of Markdown with the figures of every method; empty without rows."""
    if not rows:
        return ""
    lines = ["| body | missing signal | unit | " + " | ".join(methods) + " | gemuco |"]
    lines.append("|" + "---|" * (4 + len(methods)))
    for row in rows:
        texts = [row.peers[name].text() if name in row.peers else "-" for name in methods]
        lines.append("| " + " | ".join((row.body, row.question, row.shown, *texts, _ours(row))) + " |")
    return "\n".join(lines)


def _ours(row: Row) -> str:
    return "-" if row.ours is None else row.ours.text()


def summary(rows: Sequence[Row]) -> str:
    """Return the number of rows that meet their bars."""
    judged = [row.is_met for row in rows if row.is_met is not None]
    return f"{sum(judged)} of {len(judged)} rows with a bar meet it."
