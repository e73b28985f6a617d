"""Terms that add up to a loss of predictions (paper, II-H, II-I and III).

A term such as `Match("joint_position")` is one aim. `bind` combines it with a body schema, the references of a search
and the present values. The result is a function of predictions: it maps every signal of the layout [standard
deviations], shape (candidates, size), to losses (candidates,) and their gradients (candidates, size). A new term is a
class with `signals` and `bind`.

Units: the paper adds metres, radians and newtons and does not say how. Here `Match`, `StayNear` and `StaySmall` measure
in standard deviations of the training data (`unit="std"`), so that a weight means the same for every signal, or in the
signal's own unit (`unit="si"`). `StaySmall` measures from the physical zero, not from the mean. `TorqueBalance` (in
`gemuco.search.torque`) measures in N m. `Hold` has no weight: it is satisfied exactly.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from gemuco.errors import NotFinite, NotObservable, SchemaError, WrongSize, described
from gemuco.schema import BodySchema
from gemuco.search.norms import Bound, Difference, Norm

Values = Mapping[str, np.ndarray]
UNITS = ("std", "si")


class Term(Protocol):
    """One part of a loss."""

    @property
    def signals(self) -> tuple[str, ...]:
        """Signals whose predictions the loss depends on."""
        ...

    def bind(self, schema: BodySchema, target: Values, now: Values) -> Bound:
        """Return the loss as a function of predictions, see `Bound`.

        Args:
            schema: The schema that predicts.
            target: Signal -> reference [its unit].
            now: Signal -> measured value [its unit]; NaN where nothing was measured.
        """
        ...


@runtime_checkable
class LastingTerm(Term, Protocol):
    """A term whose bound form can be used again with other references and present values."""

    def renew(self, bound: Bound, schema: BodySchema, target: Values, now: Values) -> None:
        """Write other references and present values into the result of `bind`, which raises the same errors."""
        ...


class _OneSignal:
    """A term of one signal."""

    __slots__ = ()
    signal: str

    @property
    def signals(self) -> tuple[str, ...]:
        """Signals whose predictions the loss depends on."""
        return (self.signal,)


@dataclass(frozen=True, slots=True)
class Match(_OneSignal):
    """weight * ||A x - reference||: reach the reference of a signal.

    Attributes:
        signal: The predicted signal.
        weight: Loss per unit of the norm.
        matrix: Rows of A, which acts on the signal in its own unit; the identity if not given.
        value: A constant reference, such as (0, 0) for the center of gravity; the target if not given.
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

    def reference(self, target: Values) -> np.ndarray:
        """Return the reference of A x [its unit], shape (rows,).

        Raises:
            NotObservable: There is neither a value nor a target.
        """
        if self.value is not None:
            return np.asarray(self.value, float)
        if self.signal not in target:
            raise NotObservable(f"The loss matches '{self.signal}', but it has no reference; give a target.")
        return _numbers(self.signal, target[self.signal])

    def bind(self, schema: BodySchema, target: Values, now: Values) -> Norm:
        """Bind the term; see `Term.bind`. Elements whose reference is NaN have no loss."""
        return Norm(self.difference(schema, target), self.weight)

    def renew(self, bound: Norm, schema: BodySchema, target: Values, now: Values) -> None:
        """Use other references; see `LastingTerm.renew`."""
        if self.value is None:
            bound.difference.take(self.reference(target))

    def difference(self, schema: BodySchema, target: Values) -> Difference:
        """Return A x - reference as a function of predictions."""
        return Difference.of(schema, self.signal, self.matrix, self.unit).take(self.reference(target))


@dataclass(frozen=True, slots=True)
class StayNear(_OneSignal):
    """weight * ||x - near||: keep a signal near a posture, such as 0.3 ||theta - theta_orig||.

    Attributes:
        signal: The predicted signal.
        weight: Loss per unit of the norm.
        value: The posture. If not given, it is the target of the signal; without a target, the present value.
        unit: `std` or `si`.
    """

    signal: str
    weight: float = 1.0
    value: tuple[float, ...] | None = None
    unit: str = "std"

    def __post_init__(self) -> None:
        _check(self)
        _freeze_value(self)

    def bind(self, schema: BodySchema, target: Values, now: Values) -> Norm:
        """Bind the term; see `Term.bind`. Elements whose posture is unknown have no loss."""
        near = Difference.of(schema, self.signal, None, self.unit)
        return Norm(near.take(self.reference(schema, target, now)), self.weight)

    def renew(self, bound: Norm, schema: BodySchema, target: Values, now: Values) -> None:
        """Use other references; see `LastingTerm.renew`."""
        if self.value is None:
            bound.difference.take(self.reference(schema, target, now))

    def reference(self, schema: BodySchema, target: Values, now: Values) -> np.ndarray:
        """Return the posture [unit of the signal], shape (n,); NaN where unknown."""
        if self.value is not None:
            return np.asarray(self.value, float)
        unknown = np.full(schema.layout.signal(self.signal).size, np.nan)
        return _numbers(self.signal, target.get(self.signal, now.get(self.signal, unknown)))


@dataclass(frozen=True, slots=True)
class StaySmall(_OneSignal):
    """weight * ||x||: keep a signal near its physical zero."""

    signal: str
    weight: float = 1.0
    unit: str = "std"

    def __post_init__(self) -> None:
        _check(self)

    def bind(self, schema: BodySchema, target: Values, now: Values) -> Norm:
        """Bind the term; see `Term.bind`."""
        zero = np.zeros(schema.layout.signal(self.signal).size)
        return Norm(Difference.of(schema, self.signal, None, self.unit).take(zero), self.weight)

    def renew(self, bound: Norm, schema: BodySchema, target: Values, now: Values) -> None:
        """Do nothing: the reference is always zero."""


@dataclass(frozen=True, slots=True)
class Hold:
    """A constraint: a signal has this value in every prediction, whatever the weights of the terms.

    A signal in the route's mask is given to the network and not searched. For a predicted signal the search considers
    only points whose prediction has this value.

    Attributes:
        signal: The held signal.
        value: Value [its unit], NaN for free elements; the target of the signal if not given.
    """

    signal: str
    value: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        _freeze_value(self)

    def value_of(self, schema: BodySchema, target: Values) -> np.ndarray:
        """Return every element of the layout [standard deviations], shape (size,); NaN where it is free.

        Raises:
            NotObservable: There is neither a value nor a reference.
            NotFinite: No element is held.
        """
        if self.value is None and self.signal not in target:
            raise NotObservable(f"'{self.signal}' is to be held, but has no value; give a value or a reference.")
        value = _numbers(self.signal, self.value if self.value is not None else target[self.signal])
        x = schema.normalise({self.signal: value})
        if not np.isfinite(x).any():
            raise NotFinite(f"'{self.signal}' is to be held, but no element of its value is a number.")
        return x


def _numbers(signal: str, value: object) -> np.ndarray:
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        raise WrongSize(f"The reference of '{signal}' needs numbers, not {described(value)}.") from None
    if array.ndim != 1:
        raise WrongSize(f"The reference of '{signal}' has shape {array.shape}; it is one array, of shape (n,).")
    return array


def check_weight(weight: float, what: str) -> None:
    """Refuse a weight that is negative, infinite or not a number.

    Raises:
        SchemaError: The weight is refused.
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
