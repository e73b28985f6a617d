"""What is asked of predictions: terms bound to one schema, and told the references of every solve."""

from collections.abc import Mapping, Sequence

import numpy as np

from gemuco.schema import BodySchema
from gemuco.search.losses import Hold, Lasting, Term
from gemuco.search.norms import Bound, Norm
from gemuco.search.torque import Balanced


class Asked:
    """Terms and a schema. What depends on these alone is made at the first `read` and then kept.

    Attributes:
        schema: Whose predictions.
        wishes: The terms that have a weight.
        holds: Those that are met exactly.
        needed: The signals that they are about, sorted.
        bounds: The wishes as functions of predictions, as the last `read` left them.
        held: What predictions must equal [standard deviations], shape (size,); NaN where free.
        is_lasting: Whether nothing but numbers differs from one `read` to the next; a term of the caller's own may be
            anything each time.
    """

    def __init__(self, schema: BodySchema, terms: Sequence[Term | Hold]) -> None:
        self.schema = schema
        self.wishes = tuple(term for term in terms if not isinstance(term, Hold))
        self.holds = tuple(term for term in terms if isinstance(term, Hold))
        self.needed = tuple(sorted({name for term in terms for name in signals_of(term)}))
        self.bounds: tuple[Bound, ...] = ()
        self.held = np.full(schema.layout.size, np.nan)
        self.is_lasting = False
        self._lasting: list[tuple[Lasting, Bound]] = []

    def read(self, target: Mapping[str, np.ndarray], now: Mapping[str, np.ndarray]) -> None:
        """Take the references and the present of a solve.

        Args:
            target: Signal -> reference [its unit], shape (n,).
            now: Signal -> present value [its unit], shape (n,).

        Raises:
            WrongSize: An array does not have its signal's size.
            NotFinite: What needs a number has none.
            NotObservable: A term lacks its reference, or cannot work with this schema.
        """
        schema = self.schema
        if self.holds:
            self.held = merged(schema, [hold.wanted(schema, target) for hold in self.holds])
        if self.is_lasting:
            for wish, bound in self._lasting:
                wish.renew(bound, schema, target, now)
            return
        self.bounds = tuple(wish.bind(schema, target, now) for wish in self.wishes)
        pairs = zip(self.wishes, self.bounds, strict=True)
        self._lasting = [(w, b) for w, b in pairs if isinstance(w, Lasting) and isinstance(b, Norm | Balanced)]
        self.is_lasting = len(self._lasting) == len(self.wishes)

    def pattern(self) -> bytes:
        """Which rows of the wishes and which elements of the layout have a number to meet."""
        norms = [bound.difference.asked.tobytes() for bound in self.bounds if isinstance(bound, Norm)]
        return b"".join([*norms, np.isfinite(self.held).tobytes()])


def signals_of(term: Term | Hold) -> tuple[str, ...]:
    """The signals that a term is about."""
    return (term.signal,) if isinstance(term, Hold) else term.signals


def merged(schema: BodySchema, parts: Sequence[np.ndarray]) -> np.ndarray:
    """What several holds hold together, shape (size,) [standard deviations]; NaN where free."""
    merged = np.full(schema.layout.size, np.nan)
    for part in parts:
        merged = np.where(np.isfinite(part), part, merged)
    return merged


def check_present(schema: BodySchema, now: Mapping[str, np.ndarray]) -> None:
    """Refuse present values that are none of this body's.

    Raises:
        UnknownSignal: A name is not in the layout.
        WrongSize: An array does not have its signal's size.
    """
    slices = schema.layout.slices
    if not isinstance(now, Mapping):
        schema.layout.join_one(now)
    for name, value in now.items():
        span = slices.get(name)
        if span is None or not isinstance(value, np.ndarray) or value.shape != (span.stop - span.start,):
            schema.layout.join_one(now)
            return
