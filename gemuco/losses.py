"""What is asked of a prediction: terms that add up to a loss (paper, II-H and III-B).

A term says what is wanted (`Match("joint_position")`). Bound to a body schema, a target and the present, it becomes a
function of predictions: every signal of the layout in standard deviations, shape (candidates, size), to losses
(candidates,) and their gradients (candidates, size).

Units: `Match` and `StayNear` measure in standard deviations of the training data. `StaySmall` does too, but from the
physical zero and not from the mean. `TorqueBalance` measures in N m (or N for sliding joints).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from gemuco.errors import NotFinite, NotObservable
from gemuco.kernels import Curvature, Layer

if TYPE_CHECKING:
    from gemuco.schema import BodySchema

Values = Mapping[str, np.ndarray]
Bound = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Predictions [standard deviations], (candidates, size) -> losses (candidates,), gradients (candidates, size)."""

TINY = 1e-9


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
            target: Signal -> reference [its unit].
            now: Signal -> measured value [its unit]; NaN where nothing was measured.
        """
        ...


@dataclass(frozen=True, slots=True)
class Match:
    """weight * ||x - target||: reach the reference of a signal."""

    signal: str
    weight: float = 1.0

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals whose prediction the loss depends on."""
        return (self.signal,)

    def bind(self, schema: "BodySchema", target: Values, now: Values) -> Bound:
        """See `Term.bind`; nothing is asked where the target is NaN."""
        if self.signal not in target:
            raise NotObservable(f"Nothing was asked of '{self.signal}', but the loss wants to match it; give a target.")
        return _norm(schema, self.signal, np.asarray(target[self.signal], float), self.weight)


@dataclass(frozen=True, slots=True)
class StayNear:
    """weight * ||x - value||: keep a signal where it is now, or at a given value [its unit]."""

    signal: str
    weight: float = 1.0
    value: tuple[float, ...] | None = None

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals whose prediction the loss depends on."""
        return (self.signal,)

    def bind(self, schema: "BodySchema", target: Values, now: Values) -> Bound:
        """See `Term.bind`; nothing is asked where the present is not known."""
        size = schema.layout.signal(self.signal).size
        near = self.value if self.value is not None else now.get(self.signal, np.full(size, np.nan))
        return _norm(schema, self.signal, np.asarray(near, float), self.weight)


@dataclass(frozen=True, slots=True)
class StaySmall:
    """weight * ||x / std||: keep a signal near its physical zero."""

    signal: str
    weight: float = 1.0

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals whose prediction the loss depends on."""
        return (self.signal,)

    def bind(self, schema: "BodySchema", target: Values, now: Values) -> Bound:
        """See `Term.bind`."""
        return _norm(schema, self.signal, np.zeros(schema.layout.signal(self.signal).size), self.weight)


def _norm(schema: "BodySchema", signal: str, value: np.ndarray, weight: float) -> Bound:
    span = schema.layout.slice(signal)
    schema.layout.join({signal: value})
    wanted = (value - schema.scaler.mean[span]) / schema.scaler.std[span]
    asked = np.isfinite(wanted)
    wanted = np.where(asked, wanted, 0.0)

    def bound(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        difference = (x[:, span] - wanted) * asked
        norm = np.sqrt(np.einsum("ij,ij->i", difference, difference))
        gradient = np.zeros_like(x)
        gradient[:, span] = difference * (weight / np.maximum(norm, TINY))[:, None]
        return weight * norm, gradient

    return bound


@dataclass(frozen=True, slots=True)
class TorqueBalance:
    """weight * ||tau + G^T f||: muscle tensions that hold the reference posture.

    G = dl/dtheta is the muscle Jacobian at the reference posture and the predicted tensions, had by differentiating the
    network under the mask (theta, f).

    Attributes:
        gravity: Posture [rad], shape (joints,) -> joint torque that the muscles must supply [N m], shape (joints,).
        weight: Loss per N m.
        position: theta, rad.
        tension: f, N.
        length: l, m.
    """

    gravity: Callable[[np.ndarray], np.ndarray]
    weight: float = 0.01
    position: str = "joint_position"
    tension: str = "muscle_tension"
    length: str = "muscle_length"

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals whose prediction the loss depends on."""
        return (self.tension,)

    def bind(self, schema: "BodySchema", target: Values, now: Values) -> Bound:
        """See `Term.bind`."""
        if self.position not in target or not np.isfinite(target[self.position]).all():
            raise NotFinite(f"Torque balance needs a whole reference of '{self.position}'; some of it is missing.")
        muscles = MuscleModel(schema, np.asarray(target[self.position], float), self)
        torque = np.asarray(self.gravity(np.asarray(target[self.position], float)), float)
        span = schema.layout.slice(self.tension)

        def bound(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            losses, part = muscles.imbalance(x[:, span], torque)
            gradient = np.zeros_like(x)
            gradient[:, span] = self.weight * part
            return self.weight * losses, gradient

        return bound


class MuscleModel:
    """The muscles at one posture, as the network knows them."""

    __slots__ = ("_base", "_chain", "_f", "_f_mean", "_f_std", "_l_std", "_theta", "_theta_std")

    def __init__(self, schema: "BodySchema", posture: np.ndarray, names: TorqueBalance) -> None:
        """Prepare the network under the mask (position, tension) at a posture [rad], shape (joints,).

        Raises:
            NotObservable: The schema does not infer length from position and tension.
        """
        mask = frozenset({names.position, names.tension})
        if mask not in schema.masks or names.length not in schema.x_out:
            raise NotObservable(
                f"Torque balance differentiates '{names.length}' by '{names.position}', but this schema does not infer "
                f"it from '{names.position}' and '{names.tension}'; see the masks that structure determination found."
            )
        layout, scaler = schema.layout, schema.scaler
        theta, f, length = (layout.slice(n) for n in (names.position, names.tension, names.length))
        known = np.zeros(layout.size)
        known[theta] = (posture - scaler.mean[theta]) / scaler.std[theta]
        self._base = schema.network_input(known, mask).astype(schema.weights.encoder[0].matrix.dtype)
        self._theta = _columns(schema.in_index, theta)
        self._f = _columns(schema.in_index, f)
        last = schema.weights.decoder[-1]
        columns = _columns(schema.out_index, length)
        last = Layer(np.ascontiguousarray(last.matrix[:, columns]), last.offset[columns], False)
        self._chain = (*schema.weights.whole[:-1], last)
        dtype = self._base.dtype
        self._theta_std, self._f_std, self._l_std = (scaler.std[s].astype(dtype) for s in (theta, f, length))
        self._f_mean = scaler.mean[f].astype(dtype)

    def imbalance(self, tension: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """||torque + G^T f|| and its gradient.

        Args:
            tension: f [standard deviations], shape (candidates, muscles).
            torque: tau [N m], shape (joints,).

        Returns:
            Norms [N m], shape (candidates,), and gradients with respect to f [N m per standard deviation].
        """
        muscles = self._at(tension)
        rest = torque.astype(self._base.dtype) + muscles.gradient[:, self._theta] / self._theta_std
        norm = np.sqrt(np.einsum("ij,ij->i", rest, rest))
        tangent = np.zeros_like(muscles.gradient)
        tangent[:, self._theta] = rest / (np.maximum(norm, TINY)[:, None] * self._theta_std)
        pushed, bent = muscles.mixed(tangent)
        return norm, self._f_std * self._l_std * pushed + bent[:, self._f]

    def torque(self, tension: np.ndarray) -> np.ndarray:
        """G^T f [N m], shape (candidates, joints), of tensions [standard deviations]."""
        return self._at(tension).gradient[:, self._theta] / self._theta_std

    def _at(self, tension: np.ndarray) -> Curvature:
        inputs = np.repeat(self._base[None], len(tension), axis=0)
        inputs[:, self._f] = tension
        w = (inputs[:, self._f] * self._f_std + self._f_mean) * self._l_std
        return Curvature(self._chain, inputs, w)


def _columns(index: np.ndarray, span: slice) -> np.ndarray:
    """Where the elements of a span of the layout lie among those of an index."""
    return np.flatnonzero((index >= span.start) & (index < span.stop))
