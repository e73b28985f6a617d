"""Torque balance of muscles (paper, III-B): the muscle Jacobian G = dl/dtheta, had by differentiating the network."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gemuco.errors import NotFinite, NotObservable, SchemaError
from gemuco.kernels import Curvature, Layer
from gemuco.losses import TINY, Bound, Values, check_weight

if TYPE_CHECKING:
    from gemuco.schema import BodySchema

POSTURES = ("reference", "predicted")
STEP = 1e-5
"""Change of a posture [rad] by which the caller's torque is differentiated."""


@dataclass(frozen=True, slots=True)
class TorqueBalance:
    """weight * ||tau_ext + G^T f||: muscle tensions that hold a posture.

    G is taken at the predicted tensions, and at the reference posture (control: the posture is decided) or at the
    predicted one (simulation: it is what is sought).

    Attributes:
        torque: Posture [rad], shape (joints,) -> tau_ext, the joint torque that the muscles must supply [N m], shape
            (joints,): what gravity asks, minus what an external force F does already, gravity(theta) - J^T F.
        weight: Loss per N m.
        position: theta, rad.
        tension: f, N.
        length: l, m.
        at: `reference` or `predicted`.
    """

    torque: Callable[[np.ndarray], np.ndarray]
    weight: float = 0.01
    position: str = "joint_position"
    tension: str = "muscle_tension"
    length: str = "muscle_length"
    at: str = "reference"

    def __post_init__(self) -> None:
        check_weight(self.weight, "TorqueBalance")
        if self.at not in POSTURES:
            raise SchemaError(f"Torque is balanced at the posture {' or '.join(POSTURES)}, not at '{self.at}'.")

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals whose prediction the loss depends on."""
        return (self.tension,) if self.at == "reference" else (self.position, self.tension)

    def bind(self, schema: "BodySchema", target: Values, now: Values) -> Bound:
        """See `Term.bind`."""
        muscles = MuscleModel(schema, self)
        if self.at == "predicted":
            return self._free(schema, muscles)
        if self.position not in target or not np.isfinite(target[self.position]).all():
            raise NotFinite(f"Torque balance needs a whole reference of '{self.position}'; some of it is missing.")
        schema.layout.join({self.position: target[self.position]})
        posture = np.asarray(target[self.position], float)
        return self._fixed(schema, muscles, posture)

    def _fixed(self, schema: "BodySchema", muscles: "MuscleModel", posture: np.ndarray) -> Bound:
        theta, f = schema.layout.slice(self.position), schema.layout.slice(self.tension)
        normalised = (posture - schema.scaler.mean[theta]) / schema.scaler.std[theta]
        torque = self._torque(posture)[None]

        def bound(x: np.ndarray, slope: bool = True) -> tuple[np.ndarray, np.ndarray]:
            postures = np.repeat(normalised[None], len(x), axis=0)
            missing = muscles.missing(postures, x[:, f], torque)
            gradient = np.zeros_like(x)
            if slope:
                gradient[:, f] = self.weight * missing.slopes()[1]
            return self.weight * missing.norm, gradient

        return bound

    def _free(self, schema: "BodySchema", muscles: "MuscleModel") -> Bound:
        theta, f = schema.layout.slice(self.position), schema.layout.slice(self.tension)
        mean, std = schema.scaler.mean[theta], schema.scaler.std[theta]

        def bound(x: np.ndarray, slope: bool = True) -> tuple[np.ndarray, np.ndarray]:
            postures = x[:, theta] * std + mean
            torques = np.stack([self._torque(posture) for posture in postures])
            missing = muscles.missing(x[:, theta], x[:, f], torques)
            gradient = np.zeros_like(x)
            if slope:
                by_posture, by_tension = missing.slopes()
                gradient[:, f] = self.weight * by_tension
                gradient[:, theta] = self.weight * (by_posture + self._slope(postures, torques, missing.way) * std)
            return self.weight * missing.norm, gradient

        return bound

    def _torque(self, posture: np.ndarray) -> np.ndarray:
        return np.asarray(self.torque(posture), float)

    def _slope(self, postures: np.ndarray, torques: np.ndarray, way: np.ndarray) -> np.ndarray:
        """Gradient of way . torque(posture) [N m/rad], shape (candidates, joints), by differences."""
        slope = np.empty_like(postures)
        for joint in range(postures.shape[1]):
            moved = postures.copy()
            moved[:, joint] += STEP
            change = np.stack([self._torque(posture) for posture in moved]) - torques
            slope[:, joint] = np.einsum("ij,ij->i", way, change) / STEP
        return slope


class MuscleModel:
    """The muscles as the network knows them under the mask (position, tension)."""

    __slots__ = ("_base", "_chain", "_f_mean", "f", "f_std", "l_std", "theta", "theta_std")

    def __init__(self, schema: "BodySchema", names: TorqueBalance) -> None:
        """Prepare the network.

        Raises:
            NotObservable: The schema does not infer length from position and tension.
        """
        layout, scaler = schema.layout, schema.scaler
        theta, f, length = (layout.slice(n) for n in (names.position, names.tension, names.length))
        mask = frozenset({names.position, names.tension})
        if mask not in schema.masks or names.length not in schema.x_out:
            raise NotObservable(
                f"Torque balance differentiates '{names.length}' by '{names.position}', but this schema does not infer "
                f"it from '{names.position}' and '{names.tension}'; see the masks that structure determination found."
            )
        dtype = schema.weights.encoder[0].matrix.dtype
        self._base = schema.network_input(np.zeros(layout.size), mask).astype(dtype)
        self.theta = _columns(schema.in_index, theta)
        self.f = _columns(schema.in_index, f)
        last = schema.weights.decoder[-1]
        columns = _columns(schema.out_index, length)
        last = Layer(np.ascontiguousarray(last.matrix[:, columns]), last.offset[columns], last.activation)
        self._chain = (*schema.weights.whole[:-1], last)
        self.theta_std, self.f_std, self.l_std = (scaler.std[s].astype(dtype) for s in (theta, f, length))
        self._f_mean = scaler.mean[f].astype(dtype)

    def missing(self, posture: np.ndarray, tension: np.ndarray, torque: np.ndarray) -> "Missing":
        """What the muscles lack, torque + G^T f.

        Args:
            posture: theta [standard deviations], shape (candidates, joints).
            tension: f [standard deviations], shape (candidates, muscles).
            torque: tau_ext [N m], shape (candidates or 1, joints).
        """
        muscles = self._at(posture, tension)
        rest = torque.astype(self._base.dtype) + muscles.gradient[:, self.theta] / self.theta_std
        norm = np.sqrt(np.einsum("ij,ij->i", rest, rest))
        return Missing(norm, rest / np.maximum(norm, TINY)[:, None], self, muscles)

    def torque(self, posture: np.ndarray, tension: np.ndarray) -> np.ndarray:
        """G^T f [N m], shape (candidates, joints), of postures and tensions [standard deviations]."""
        return self._at(posture, tension).gradient[:, self.theta] / self.theta_std

    def _at(self, posture: np.ndarray, tension: np.ndarray) -> Curvature:
        inputs = np.repeat(self._base[None], len(tension), axis=0)
        inputs[:, self.theta] = posture
        inputs[:, self.f] = tension
        w = (inputs[:, self.f] * self.f_std + self._f_mean) * self.l_std
        return Curvature(self._chain, inputs, w)


@dataclass(frozen=True, slots=True)
class Missing:
    """What the muscles lack to hold a posture.

    Attributes:
        norm: ||torque + G^T f|| [N m], shape (candidates,).
        way: Its gradient with respect to torque, shape (candidates, joints).
        model: The muscles.
        at: Their network where it was asked.
    """

    norm: np.ndarray
    way: np.ndarray
    model: MuscleModel
    at: Curvature

    def slopes(self) -> tuple[np.ndarray, np.ndarray]:
        """Gradients of the norm with respect to theta and to f [N m per standard deviation], torque held constant."""
        model = self.model
        tangent = np.zeros_like(self.at.gradient)
        tangent[:, model.theta] = self.way / model.theta_std
        pushed, bent = self.at.mixed(tangent)
        return bent[:, model.theta], model.f_std * model.l_std * pushed + bent[:, model.f]


def _columns(index: np.ndarray, span: slice) -> np.ndarray:
    """Where the elements of a span of the layout lie among those of an index."""
    return np.flatnonzero((index >= span.start) & (index < span.stop))
