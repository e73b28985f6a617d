"""A request: terms bound to one schema, which take the references of every solve."""

from collections.abc import Mapping, Sequence

import numpy as np

from gemuco.errors import check_kind
from gemuco.schema import BodySchema
from gemuco.search.losses import Hold, LastingTerm, Term
from gemuco.search.norms import Bound, Norm
from gemuco.search.torque import TorqueNorm


class Request:
    """Terms and a schema. What depends on these alone is made at the first `read` and then kept.

    Attributes:
        schema: The schema that predicts.
        terms: The terms that have a weight.
        holds: The terms that are met exactly.
        needed: The signals of all of them, sorted.
        bounds: The weighted terms as functions of predictions, as the last `read` left them.
        held: Values that predictions must equal [standard deviations], shape (size,); NaN where free.
        is_lasting: Whether nothing but numbers differs from one `read` to the next; a term of the caller's own may
            differ in any way.
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
        """Take the references and the present values of a solve.

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
        """Return a key of the rows of the terms and the elements of the layout that have a reference."""
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
    """Merge partly known vectors, later ones first, shape (size,) [standard deviations]; NaN where all are NaN."""
    merged = np.full(schema.layout.size, np.nan)
    for part in parts:
        merged = np.where(np.isfinite(part), part, merged)
    return merged
