"""Results of an experiment beside those of the paper and the bars to reach."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from rich.table import Table

Outcome = TypeVar("Outcome")
Adder = Callable[..., None]
COLUMNS = ("what", "paper", "ours", "to reach", "reached")


@dataclass(frozen=True, slots=True)
class Row:
    """One figure, measured once per seed.

    Attributes:
        name: The measured quantity.
        unit: Unit of ours, of the bar and of the paper's figure; empty for a share or a count.
        paper: The paper's figure, as it writes it; empty if it has none.
        values: One value per seed [unit].
        bar: Limit to reach [unit]; None without a limit.
        better: Side of the bar on which a figure is good.
    """

    name: str
    unit: str
    paper: str
    values: tuple[float, ...]
    bar: float | None = None
    better: Literal["lower", "higher"] = "lower"

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", tuple(float(value) for value in self.values))
        if not self.values:
            raise ValueError(f"Row '{self.name}' needs one value per seed; it was given none.")

    @property
    def mean(self) -> float:
        """Mean over the seeds."""
        return float(np.mean(self.values))

    @property
    def spread(self) -> float:
        """Standard deviation over the seeds."""
        return float(np.std(self.values))

    @property
    def reached(self) -> bool | None:
        """Whether the mean is on the right side of the bar; None without a bar."""
        if self.bar is None:
            return None
        return bool(self.mean < self.bar if self.better == "lower" else self.mean > self.bar)

    def cells(self) -> tuple[str, ...]:
        """Return the cells of a table in the order of `COLUMNS`."""
        ours = f"{self.mean:.3g} {self.unit}".strip()
        if len(self.values) > 1:
            ours = f"{self.mean:.3g} ± {self.spread:.2g} {self.unit}".strip()
        bar = "-"
        if self.bar is not None:
            bar = f"{'<' if self.better == 'lower' else '>'} {self.bar:g} {self.unit}".strip()
        paper = f"{self.paper} {self.unit}".strip() if self.paper else "-"
        return self.name, paper, ours, bar, {None: "-", True: "yes", False: "NO"}[self.reached]


@dataclass(slots=True)
class Report:
    """All figures of one robot's experiments.

    Attributes:
        robot: The robot's name.
        seeds: The seeds, in the order of every row's values.
        rows: The rows in order.
        notes: Sentences below the table.
    """

    robot: str
    seeds: Sequence[int] = ()
    rows: list[Row] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, row: Row) -> None:
        """Add a row."""
        self.rows.append(row)

    def note(self, sentence: str) -> None:
        """Add a sentence below the table."""
        self.notes.append(sentence)

    def table(self) -> Table:
        """Return the table for the terminal."""
        count = f", {len(self.seeds)} seeds: mean ± standard deviation" if self.seeds else ""
        table = Table(title=f"{self.robot}{count}", title_justify="left", caption="\n".join(self.notes) or None)
        for column in COLUMNS:
            table.add_column(column, justify="left" if column == "what" else "right")
        for row in self.rows:
            style = {None: "", True: "green", False: "red"}[row.reached]
            table.add_row(*row.cells()[:-1], f"[{style}]{row.cells()[-1]}[/]" if style else row.cells()[-1])
        return table

    def markdown(self) -> str:
        """Return the same table for a document."""
        lines = ["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"]
        lines += ["| " + " | ".join(row.cells()) + " |" for row in self.rows]
        return "\n".join([*lines, *(f"\n{note}" for note in self.notes)]) + "\n"

    def save(self, folder: Path) -> None:
        """Write report.md and report.json."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "report.md").write_text(self.markdown())
        rows = [{**asdict(row), "mean": row.mean, "spread": row.spread, "reached": row.reached} for row in self.rows]
        content = {"robot": self.robot, "seeds": list(self.seeds), "rows": rows, "notes": self.notes}
        (folder / "report.json").write_text(json.dumps(content, indent=2) + "\n")


def adder(report: Report, outcomes: Sequence[Outcome]) -> Adder:
    """Return a function that adds a row, computed from every seed's outcome."""

    def add(
        name: str,
        figure: Callable[[Outcome], float],
        unit: str = "",
        paper: str = "",
        bar: float | None = None,
        better: Literal["lower", "higher"] = "lower",
    ) -> None:
        report.add(Row(name, unit, paper, tuple(figure(outcome) for outcome in outcomes), bar, better))

    return add
