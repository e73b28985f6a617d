"""What is asked of a prediction: terms that add up to a loss (paper, II-H, II-I and III).

A term says what is wanted (`Match("joint_position")`). Bound to a body schema, the references of this solve and the
present, it becomes a function of predictions: every signal of the layout in standard deviations, shape
(candidates, size), to losses (candidates,) and their gradients (candidates, size). A new term is a class with
`signals` and `bind`.

Units: the paper adds metres, radians and newtons and does not say how. Here `Match`, `StayNear` and `StaySmall` measure
in standard deviations of the training data (`unit="std"`), so that one weight means the same for every signal, or in
the signal's own unit (`unit="si"`). `StaySmall` measures from the physical zero either way, not from the mean.
`TorqueBalance` (in `gemuco.torque`) measures in N m. `Hold` has no weight: it is met exactly.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from gemuco.errors import NotFinite, NotObservable, SchemaError, WrongSize

if TYPE_CHECKING:
    from gemuco.schema import BodySchema

Values = Mapping[str, np.ndarray]


class Bound(Protocol):
    """A term bound to a schema, references and the present: a function of predictions."""

    def __call__(self, x: np.ndarray, slope: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Losses, shape (candidates,), and their gradients, shape (candidates, size).

        Args:
            x: Predictions [standard deviations], shape (candidates, size).
            slope: Whether gradients are wanted; they may be anything if not.
        """
        ...


TINY = 1e-9
UNITS = ("std", "si")


class Term(Protocol):
    """One wish."""

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals whose prediction the loss depends on."""
        ...

    def bind(self, schema: "BodySchema", target: Values, now: Values) -> Bound:
        """The wish as a function of predictions.

        Args:
            schema: Whose predictions.
            target: Signal -> reference of this solve [its unit].
            now: Signal -> measured value [its unit]; NaN where nothing was measured.
        """
        ...


@dataclass(frozen=True, slots=True)
class Match:
    """weight * ||A x - reference||: reach the reference of a signal.

    Attributes:
        signal: What to predict.
        weight: Loss per unit of the norm.
        matrix: Rows of A, which acts on the signal in its own unit; the signal itself if not given.
        value: A reference that is always the same, such as (0, 0) for the center of gravity; else the target's.
        unit: `std`: every row of A x in its own standard deviation; `si`: in the unit of A x.
    """

    signal: str
    weight: float = 1.0
    matrix: tuple[tuple[float, ...], ...] | None = None
    value: tuple[float, ...] | None = None
    unit: str = "std"

    def __post_init__(self) -> None:
        _check(self)
        if self.matrix is not None:
            object.__setattr__(self, "matrix", tuple(tuple(float(a) for a in row) for row in self.matrix))
        _freeze_value(self)

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals whose prediction the loss depends on."""
        return (self.signal,)

    def reference(self, target: Values) -> np.ndarray:
        """What A x shall be [its unit], shape (rows,).

        Raises:
            NotObservable: There is neither a value nor a target.
        """
        if self.value is not None:
            return np.asarray(self.value, float)
        if self.signal not in target:
            raise NotObservable(f"Nothing was asked of '{self.signal}', but the loss wants to match it; give a target.")
        return _numbers(self.signal, target[self.signal])

    def bind(self, schema: "BodySchema", target: Values, now: Values) -> Bound:
        """See `Term.bind`; nothing is asked where the reference is NaN."""
        return self.difference(schema, target).norm(self.weight)

    def difference(self, schema: "BodySchema", target: Values) -> "Difference":
        """A x - reference as a function of predictions."""
        return Difference.of(schema, self.signal, self.reference(target), self.matrix, self.unit)


@dataclass(frozen=True, slots=True)
class StayNear:
    """weight * ||x - near||: keep a signal near a posture, such as 0.3 ||theta - theta_orig||.

    Attributes:
        signal: What to keep.
        weight: Loss per unit of the norm.
        value: Where; if not given, the reference of this solve, and without one where the signal is now.
        unit: `std` or `si`.
    """

    signal: str
    weight: float = 1.0
    value: tuple[float, ...] | None = None
    unit: str = "std"

    def __post_init__(self) -> None:
        _check(self)
        _freeze_value(self)

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals whose prediction the loss depends on."""
        return (self.signal,)

    def bind(self, schema: "BodySchema", target: Values, now: Values) -> Bound:
        """See `Term.bind`; nothing is asked where it is not known what to stay near."""
        near = self.reference(schema, target, now)
        return Difference.of(schema, self.signal, near, None, self.unit).norm(self.weight)

    def reference(self, schema: "BodySchema", target: Values, now: Values) -> np.ndarray:
        """What to stay near [its unit], shape (n,); NaN where that is not known."""
        if self.value is not None:
            return np.asarray(self.value, float)
        unknown = np.full(schema.layout.signal(self.signal).size, np.nan)
        return _numbers(self.signal, target.get(self.signal, now.get(self.signal, unknown)))


@dataclass(frozen=True, slots=True)
class StaySmall:
    """weight * ||x||: keep a signal near its physical zero."""

    signal: str
    weight: float = 1.0
    unit: str = "std"

    def __post_init__(self) -> None:
        _check(self)

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals whose prediction the loss depends on."""
        return (self.signal,)

    def bind(self, schema: "BodySchema", target: Values, now: Values) -> Bound:
        """See `Term.bind`."""
        zero = np.zeros(schema.layout.signal(self.signal).size)
        return Difference.of(schema, self.signal, zero, None, self.unit).norm(self.weight)


@dataclass(frozen=True, slots=True)
class Hold:
    """A signal is forced to a value: a condition that every prediction meets, not a wish that others can outweigh.

    Where the signal is an input of the route's mask it is given to the network and not searched for; where it is
    predicted, the search moves only along predictions that meet it.

    Attributes:
        signal: What is held.
        value: Where, NaN for elements that are free; the reference of this solve if not given.
    """

    signal: str
    value: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        _freeze_value(self)

    def wanted(self, schema: "BodySchema", target: Values) -> np.ndarray:
        """Every element of the layout [standard deviations], shape (size,); NaN where nothing is held.

        Raises:
            NotObservable: There is neither a value nor a reference.
            NotFinite: No element is held.
        """
        if self.value is None and self.signal not in target:
            raise NotObservable(f"'{self.signal}' shall be held, but nobody says where; give a value or a reference.")
        value = _numbers(self.signal, self.value if self.value is not None else target[self.signal])
        x = schema.normalise({self.signal: value})
        if not np.isfinite(x).any():
            raise NotFinite(f"'{self.signal}' shall be held, but no element of where is a number.")
        return x


@dataclass(frozen=True, slots=True)
class Difference:
    """M x - w of one signal's prediction [standard deviations]: scaled, and zero where nothing is asked.

    Attributes:
        span: Where the signal lies in the layout.
        matrix: M, shape (rows, n); None for one.
        wanted: w, shape (rows,).
        asked: Which rows count, shape (rows,).
    """

    span: slice
    matrix: np.ndarray | None
    wanted: np.ndarray
    asked: np.ndarray

    @classmethod
    def of(
        cls,
        schema: "BodySchema",
        signal: str,
        reference: np.ndarray,
        matrix: Sequence[Sequence[float]] | None,
        unit: str,
    ) -> "Difference":
        """From the signal's own unit.

        Raises:
            UnknownSignal: The signal is not in the layout.
            WrongSize: Reference and matrix do not fit the signal.
        """
        span = schema.layout.slice(signal)
        mean, std = schema.scaler.mean[span], schema.scaler.std[span]
        if matrix is None:
            schema.layout.join({signal: reference})
            scale = std if unit == "std" else np.ones_like(std)
            scaled = None if unit == "std" else np.diag(std)
            wanted = (reference - mean) / scale
        else:
            try:
                rows = np.array(matrix, float)
            except ValueError:
                rows = np.zeros(0)
            if rows.ndim != 2 or rows.shape[1] != len(std):
                raise WrongSize(f"The matrix of '{signal}' needs {len(std)} columns in every row.")
            if reference.shape != (len(rows),):
                raise WrongSize(
                    f"The matrix of '{signal}' has {len(rows)} rows, but its reference has shape {reference.shape}."
                )
            scale = np.maximum(np.sqrt(rows**2 @ std**2), TINY) if unit == "std" else np.ones(len(rows))
            scaled = rows * std / scale[:, None]
            wanted = (reference - rows @ mean) / scale
        asked = np.isfinite(wanted)
        return cls(span, scaled, np.where(asked, wanted, 0.0), asked)

    def at(self, x: np.ndarray) -> np.ndarray:
        """The difference at predictions, shape (candidates, size) -> (candidates, rows)."""
        part = x[:, self.span]
        return ((part if self.matrix is None else part @ self.matrix.T) - self.wanted) * self.asked

    def norm(self, weight: float) -> "Norm":
        """The loss weight * ||M x - w||."""
        return Norm(self, weight)

    def rows(self, size: int) -> tuple[np.ndarray, np.ndarray]:
        """What is asked as rows over the whole layout, shape (asked, size), and what they shall be, shape (asked,)."""
        found = np.zeros((len(self.wanted), size))
        found[:, self.span] = np.eye(len(self.wanted)) if self.matrix is None else self.matrix
        return found[self.asked], self.wanted[self.asked]


@dataclass(frozen=True, slots=True)
class Norm:
    """weight * ||M x - w|| of a prediction; a `Bound` that compiled searches know (`gemuco.fold`)."""

    difference: Difference
    weight: float

    def __call__(self, x: np.ndarray, slope: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """See `Bound`."""
        difference = self.difference.at(x)
        norm = np.sqrt(np.einsum("ij,ij->i", difference, difference))
        gradient = np.zeros_like(x)
        if slope:
            way = difference * (self.weight / np.maximum(norm, TINY))[:, None]
            matrix = self.difference.matrix
            gradient[:, self.difference.span] = way if matrix is None else way @ matrix
        return self.weight * norm, gradient


def total(bounds: Sequence[Bound], x: np.ndarray, slope: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Sum of bound terms and its gradient; nothing wanted loses nothing."""
    loss, gradient = np.zeros(len(x), x.dtype), np.zeros_like(x)
    for bound in bounds:
        part, way = bound(x, slope)
        loss = loss + part
        gradient = gradient + way
    return loss, gradient


def _numbers(signal: str, value: object) -> np.ndarray:
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        raise WrongSize(f"The reference of '{signal}' needs numbers; what was given are none.") from None
    if array.ndim != 1:
        raise WrongSize(f"The reference of '{signal}' has shape {array.shape}; it is one array, of shape (n,).")
    return array


def check_weight(weight: float, what: str) -> None:
    """Refuse a weight that would reward what it should punish.

    Raises:
        SchemaError: It is negative, infinite or no number.
    """
    if not (np.isfinite(weight) and weight >= 0.0):
        raise SchemaError(f"The weight of {what} is {weight}; it must be a finite number that is not negative.")


def _check(term: Match | StayNear | StaySmall) -> None:
    check_weight(term.weight, f"{type(term).__name__}('{term.signal}')")
    if term.unit not in UNITS:
        raise SchemaError(f"The unit of a term is {' or '.join(UNITS)}, not '{term.unit}'.")


def _freeze_value(term: Match | StayNear | Hold) -> None:
    if term.value is not None:
        object.__setattr__(term, "value", tuple(float(v) for v in np.ravel(term.value)))
