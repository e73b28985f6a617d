"""A request: terms bound to a schema, with the references of the current search."""

from collections.abc import Mapping, Sequence

import numpy as np

from gemuco.errors import check_kind
from gemuco.schema import BodySchema
from gemuco.search.losses import Hold, LastingTerm, Term
from gemuco.search.norms import Bound, Norm
from gemuco.search.torque import TorqueNorm


class Request:
    """Terms and a schema. The first `read` binds the terms; later ones only write other numbers if that is possible.

    Attributes:
        schema: The schema that predicts.
        terms: The terms that have a weight.
        holds: The constraints.
        needed: Signals of all terms and constraints, sorted.
        bounds: The terms as functions of predictions, after the last `read`.
        held: Values of the constraints [standard deviations], shape (size,); NaN where free.
        is_lasting: Whether successive calls of `read` change numbers only; a user's own term may change in any way.
    """

    def __init__(self, schema: BodySchema, terms: Sequence[Term | Hold]) -> None:
        self.schema = schema
        self.terms = tuple(term for term in terms if not isinstance(term, Hold))
        self.holds = tuple(term for term in terms if isinstance(term, Hold))
        self.needed = tuple(sorted({name for term in terms for name in signals_of(term)}))
        self.bounds: tuple[Bound, ...] = ()
        self.held = np.full(schema.layout.size, np.nan)
        self.is_lasting = False
        self._lasting: list[tuple[LastingTerm, Bound]] = []

    def read(self, target: Mapping[str, np.ndarray], now: Mapping[str, np.ndarray]) -> None:
        """Set the references and present values of a search.

        Args:
            target: Signal -> reference [its unit], shape (n,).
            now: Signal -> present value [its unit], shape (n,).

        Raises:
            WrongSize: An array does not have its signal's size.
            NotFinite: A required number is missing.
            NotObservable: A term lacks its reference, or cannot work with this schema.
        """
        schema = self.schema
        if self.holds:
            self.held = merged(schema, [hold.value_of(schema, target) for hold in self.holds])
        if self.is_lasting:
            for term, bound in self._lasting:
                term.renew(bound, schema, target, now)
            return
        self.bounds = tuple(term.bind(schema, target, now) for term in self.terms)
        pairs = zip(self.terms, self.bounds, strict=True)
        self._lasting = [(t, b) for t, b in pairs if isinstance(t, LastingTerm) and isinstance(b, Norm | TorqueNorm)]
        self.is_lasting = len(self._lasting) == len(self.terms)

    def pattern(self) -> bytes:
        """Return a key that depends on which rows of the terms have a reference and which elements are held."""
        norms = [bound.difference.counts.tobytes() for bound in self.bounds if isinstance(bound, Norm)]
        return b"".join([*norms, np.isfinite(self.held).tobytes()])


def checked_terms(schema: BodySchema, terms: Sequence[Term | Hold]) -> tuple[Term | Hold, ...]:
    """Return terms after a check of their signals.

    Raises:
        WrongKind: The terms are not a sequence.
        UnknownSignal: The signal of a term is not in the layout.
    """
    check_kind("The terms", terms, (tuple, list), "a tuple of terms, such as (Match('joint_position'),)")
    for term in terms:
        for name in signals_of(term):
            schema.layout.slice(name)
    return tuple(terms)


def signals_of(term: Term | Hold) -> tuple[str, ...]:
    """Return the signals of a term."""
    return (term.signal,) if isinstance(term, Hold) else term.signals


def merged(schema: BodySchema, parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return the last finite value of each element, shape (size,) [standard deviations]; NaN where all are NaN."""
    merged = np.full(schema.layout.size, np.nan)
    for part in parts:
        merged = np.where(np.isfinite(part), part, merged)
    return merged
