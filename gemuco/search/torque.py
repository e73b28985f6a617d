"""Torque balance of muscles (paper, III-B): the muscle Jacobian G = dl/dtheta is the derivative of the network."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from gemuco.compiled.chain import pack, turned
from gemuco.errors import NotFinite, NotObservable, SchemaError
from gemuco.layers import Curvature
from gemuco.schema import BodySchema
from gemuco.search.losses import Values, check_weight
from gemuco.search.norms import TINY

POSTURES = ("reference", "predicted")
STEP = 1e-5
"""The derivative of the user's torque is a difference over this change of a joint angle [rad]."""


@dataclass(frozen=True, slots=True)
class TorqueBalance:
    """weight * ||tau_ext + G^T f||: muscle tensions that hold a posture.

    G is computed at the predicted tensions and at the reference posture (control, where the posture is given) or the
    predicted posture (simulation, where the posture is searched).

    Attributes:
        torque: Posture [rad], shape (joints,) -> tau_ext [N m], shape (joints,), the joint torque that the muscles must
            supply: gravity(theta) - J^T F, with an external force F.
        weight: Loss per N m.
        position: Signal of theta [rad].
        tension: Signal of f [N].
        length: Signal of l [m].
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
        """Signals whose predictions the loss depends on."""
        return (self.tension,) if self.at == "reference" else (self.position, self.tension)

    def bind(self, schema: BodySchema, target: Values, now: Values) -> "TorqueNorm":
        """Bind the term; see `Term.bind`."""
        muscles = muscle_model(schema, self)
        theta, f = schema.layout.slice(self.position), schema.layout.slice(self.tension)
        mean, std = schema.scaler.mean[theta], schema.scaler.std[theta]
        posture = None if self.at == "predicted" else np.empty(len(mean))
        bound = TorqueNorm(muscles, theta, f, mean, std, self.torque, self.weight, posture)
        self.renew(bound, schema, target, now)
        return bound

    def renew(self, bound: "TorqueNorm", schema: BodySchema, target: Values, now: Values) -> None:
        """Use another reference; see `LastingTerm.renew`. A predicted posture needs no reference."""
        if bound.posture is None:
            return
        if self.position not in target or not np.isfinite(target[self.position]).all():
            raise NotFinite(f"Torque balance needs a reference of every element of '{self.position}'.")
        if np.shape(target[self.position]) != bound.posture.shape:
            schema.layout.join_one({self.position: target[self.position]})
        bound.posture[:] = target[self.position]


@dataclass(frozen=True, slots=True)
class TorqueNorm:
    """Torque balance bound to a schema; a `Bound` that compiled searches support (`gemuco.search.fold`).

    Attributes:
        muscles: Model of the muscles.
        theta: Slice of the posture in the layout.
        f: Slice of the tension in the layout.
        mean: Mean of the posture [rad], shape (joints,).
        std: Standard deviation of the posture [rad], shape (joints,).
        torque: Posture [rad] -> tau_ext [N m].
        weight: Loss per N m.
        posture: The reference posture [rad], shape (joints,); None if torque is balanced at the predicted posture.
    """

    muscles: "MuscleModel"
    theta: slice
    f: slice
    mean: np.ndarray
    std: np.ndarray
    torque: Callable[[np.ndarray], np.ndarray]
    weight: float
    posture: np.ndarray | None

    def __call__(self, x: np.ndarray, slope: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Return losses and gradients; see `Bound`."""
        postures = x[:, self.theta] * self.std + self.mean
        if self.posture is not None:
            postures = np.repeat(self.posture[None], len(x), axis=0)
        torques = self.torques(postures if self.posture is None else postures[:1])
        deficit = self.muscles.deficit((postures - self.mean) / self.std, x[:, self.f], torques)
        gradient = np.zeros_like(x)
        if slope:
            by_posture, by_tension = deficit.slopes()
            gradient[:, self.f] = self.weight * by_tension
            if self.posture is None:
                by_torque = np.einsum("ij,ijk->ik", deficit.gradient, self.stiffness(postures, torques))
                gradient[:, self.theta] = self.weight * (by_posture + by_torque * self.std)
        return self.weight * deficit.norm, gradient

    def torques(self, postures: np.ndarray) -> np.ndarray:
        """Return tau_ext at postures [N m], shape (n, joints)."""
        return np.stack([np.asarray(self.torque(posture), float) for posture in postures])

    def stiffness(self, postures: np.ndarray, torques: np.ndarray) -> np.ndarray:
        """Return d tau_ext / d theta [N m/rad], shape (n, joints, joints), by finite differences."""
        stiffness = np.empty((*torques.shape, postures.shape[1]))
        for joint in range(postures.shape[1]):
            moved = postures.copy()
            moved[:, joint] += STEP
            stiffness[:, :, joint] = (self.torques(moved) - torques) / STEP
        return stiffness


class MuscleModel:
    """The part of the network that infers l from theta and f, under the mask (position, tension)."""

    __slots__ = ("back", "chain", "f", "f_mean", "f_std", "l_std", "packed", "theta", "theta_std")

    def __init__(self, schema: BodySchema, names: TorqueBalance) -> None:
        """Extract the part from the network.

        Raises:
            NotObservable: The schema does not infer length from position and tension.
        """
        layout, scaler = schema.layout, schema.scaler
        theta, f, length = (layout.slice(n) for n in (names.position, names.tension, names.length))
        mask = frozenset({names.position, names.tension})
        if mask not in schema.masks or names.length not in schema.x_out:
            raise NotObservable(
                f"Torque balance differentiates '{names.length}' by '{names.position}', but this schema does not infer "
                f"it from '{names.position}' and '{names.tension}'; see its feasible masks."
            )
        begin, *between, end = schema.chain(mask)
        dtype = begin.matrix.dtype
        base = schema.network_input(np.zeros(layout.size), mask).astype(dtype)
        joints, muscles, lengths = (
            _columns(index, span)
            for index, span in ((schema.in_index, theta), (schema.in_index, f), (schema.out_index, length))
        )
        inputs = np.concatenate([joints, muscles])
        self.theta, self.f = slice(0, len(joints)), slice(len(joints), len(inputs))
        first = begin._replace(matrix=begin.matrix[inputs], offset=begin.offset + base @ begin.matrix)
        last = end._replace(matrix=np.ascontiguousarray(end.matrix[:, lengths]), offset=end.offset[lengths])
        self.chain = (first, *between, last)
        self.packed = pack(self.chain)
        self.back = turned(self.packed)
        self.theta_std, self.f_std, self.l_std = (scaler.std[s].astype(dtype) for s in (theta, f, length))
        self.f_mean = scaler.mean[f].astype(dtype)

    def deficit(self, posture: np.ndarray, tension: np.ndarray, torque: np.ndarray) -> "Deficit":
        """Return the missing torque, torque + G^T f.

        Args:
            posture: theta [standard deviations], shape (candidates, joints).
            tension: f [standard deviations], shape (candidates, muscles).
            torque: tau_ext [N m], shape (candidates or 1, joints).
        """
        muscles = self._at(posture, tension)
        missing = torque.astype(self.f_std.dtype) + muscles.gradient[:, self.theta] / self.theta_std
        norm = np.sqrt(np.einsum("ij,ij->i", missing, missing))
        return Deficit(norm, missing / np.maximum(norm, TINY)[:, None], self, muscles)

    def torque(self, posture: np.ndarray, tension: np.ndarray) -> np.ndarray:
        """Return G^T f [N m], shape (candidates, joints), of postures and tensions [standard deviations]."""
        return self._at(posture, tension).gradient[:, self.theta] / self.theta_std

    def _at(self, posture: np.ndarray, tension: np.ndarray) -> Curvature:
        inputs = np.concatenate([posture, tension], axis=1).astype(self.f_std.dtype)
        w = (inputs[:, self.f] * self.f_std + self.f_mean) * self.l_std
        return Curvature(self.chain, inputs, w)


@lru_cache(maxsize=4)
def muscle_model(schema: BodySchema, names: TorqueBalance) -> MuscleModel:
    """Return the muscle model of a schema, from a cache: to make a model takes longer than a search.

    Raises:
        NotObservable: The schema does not infer length from position and tension.
    """
    return MuscleModel(schema, names)


@dataclass(frozen=True, slots=True)
class Deficit:
    """Torque that is missing to hold a posture.

    Attributes:
        norm: ||torque + G^T f|| [N m], shape (candidates,).
        gradient: Gradient of the norm with respect to torque, shape (candidates, joints).
        model: Model of the muscles.
        at: Derivatives of the model's network at the candidates.
    """

    norm: np.ndarray
    gradient: np.ndarray
    model: MuscleModel
    at: Curvature

    def slopes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the gradients of the norm by theta and by f [N m per standard deviation] at constant torque."""
        model = self.model
        tangent = np.zeros_like(self.at.gradient)
        tangent[:, model.theta] = self.gradient / model.theta_std
        pushed, bent = self.at.mixed(tangent)
        return bent[:, model.theta], model.f_std * model.l_std * pushed + bent[:, model.f]


def _columns(index: np.ndarray, span: slice) -> np.ndarray:
    """Return the positions in an index at which the elements of a slice of the layout are."""
    return np.flatnonzero((index >= span.start) & (index < span.stop))
