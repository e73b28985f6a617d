"""Bodies, their data, and the questions that every method answers on the same rows."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gemuco import TrainConfig

Rows = Mapping[str, np.ndarray]
"""Signal -> samples [its unit], shape (n, size)."""


class MissingData(Exception):
    """Recordings that a row of the table needs are not on this machine."""


@dataclass(frozen=True, slots=True)
class Trial:
    """Data of one seed or fold.

    Attributes:
        train: Condition -> episodes to learn from.
        test: Condition -> rows to be judged.
    """

    train: Mapping[str, Sequence[Rows]]
    test: Mapping[str, Rows]

    def learned(self, name: str) -> np.ndarray:
        """Return a signal of all training rows [its unit], shape (n, size)."""
        return np.concatenate([episode[name] for episodes in self.train.values() for episode in episodes])

    def judged(self, name: str) -> np.ndarray:
        """Return a signal of all test rows [its unit], shape (n, size)."""
        return np.concatenate([rows[name] for rows in self.test.values()])


@dataclass(frozen=True, slots=True)
class Bar:
    """Largest error that is good enough.

    Attributes:
        kind: `best`: a multiple of the best peer; `gaussian_process`: a multiple of that peer; `at most`: an error;
            `if ridge`: an error, if ridge regression reaches it; `at least`: a score, where more is better, that is not
            below the best peer's either.
        value: The multiple, or the error in the question's unit or in standard deviations.
        in_std: Whether errors in standard deviations are compared, instead of errors in the shown unit.
    """

    kind: str
    value: float
    in_std: bool = False

    @property
    def is_score(self) -> bool:
        """Whether more is better."""
        return self.kind == "at least"

    def is_met(self, figure: float, limit: float) -> bool:
        """Whether a figure is good enough; NaN never is."""
        return figure >= limit if self.is_score else figure <= limit

    def limit(self, errors: Mapping[str, float]) -> float | None:
        """Return the error or score that is just good enough, given those of the peers; None if there is no bar."""
        if self.kind == "at most":
            return self.value
        if self.kind == "at least":
            return max(self.value, *errors.values()) if errors else None
        if self.kind == "if ridge":
            return self.value if errors.get("ridge", np.inf) <= self.value else None
        if self.kind == "gaussian_process":
            return self.value * errors[self.kind] if self.kind in errors else None
        return self.value * min(errors.values()) if errors else None

    def __str__(self) -> str:
        unit = " std" if self.in_std else ""
        if self.kind == "at most":
            return f"<= {self.value:g}{unit}"
        if self.is_score:
            return f">= best peer, {self.value:g}"
        if self.kind == "if ridge":
            return f"<= {self.value:g}{unit} if ridge is"
        return f"<= {self.value:g} x {'GP' if self.kind == 'gaussian_process' else 'best peer'}"


@dataclass(frozen=True, slots=True)
class Question:
    """A missing signal and the signals from which it is estimated.

    Attributes:
        name: Words for the table.
        target: The missing signal.
        given: Measured signals; all others are missing too.
        shown: Unit of the table.
        scale: Factor from the signal's unit to the shown one.
        bar: Required error.
        elements: Elements of the target that are judged; all if empty.
    """

    name: str
    target: str
    given: tuple[str, ...]
    shown: str
    scale: float
    bar: Bar
    elements: tuple[int, ...] = ()

    def judge(self, trial: Trial, prediction: np.ndarray) -> tuple[float, float]:
        """Return the error of a prediction [unit of the target], shape (n, size).

        Returns:
            The norm over the elements, mean over the rows [shown unit], and the root mean square over rows and elements
            [standard deviations of the training rows]. NaN if a row has no prediction.
        """
        which = list(self.elements) or slice(None)
        miss = (prediction - trial.judged(self.target))[:, which]
        spread = trial.learned(self.target)[:, which].std(axis=0)
        size = float(np.linalg.norm(miss, axis=1).mean())
        return self.scale * size, float(np.sqrt(np.mean((miss / spread) ** 2)))


@dataclass(frozen=True, slots=True)
class Body:
    """A body, its data, and the settings with which the model is trained on it.

    Attributes:
        name: Words for the table; `--rows` selects by it.
        units: Signal -> unit.
        trial: Seed -> data; raises `MissingData` if they are not on this machine.
        questions: Rows of the table.
        settings: Seed -> settings of the training.
        settings_name: Words for the settings.
        masks: Feasible masks, all of which one model serves; None: determined from the data (`gemuco.learn`).
        outputs: Signals to infer; None: all, or those determined.
    """

    name: str
    units: Mapping[str, str]
    trial: Callable[[int], Trial]
    questions: Sequence[Question]
    settings: Callable[[int], TrainConfig]
    settings_name: str
    masks: Sequence[Sequence[str]] | None = None
    outputs: Sequence[str] | None = None
