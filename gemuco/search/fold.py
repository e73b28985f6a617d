"""The problem that compiled searches solve (`gemuco.compiled.problem`), folded from a route and its terms.

Every term, except a user's own, is a norm of a linear function of the prediction. The prediction is linear in the
output of the last hidden layer and in the searched point. So the terms are multiplied into the last layer and the fixed
inputs into the first, and the search evaluates only the differences of the terms. References and fixed inputs change a
few rows of the result: a controller folds a problem once and writes these rows before every search.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from gemuco.compiled.chain import NARROW, PLACE, WIDE, Packed, pack
from gemuco.compiled.problem import POSTURE, STD, STIFFNESS, TORQUE, Balance, Problem
from gemuco.layers import Chain, Layer
from gemuco.masks import Mask
from gemuco.schema import BodySchema
from gemuco.search.norms import Bound, Norm
from gemuco.search.torque import TorqueNorm


class Lines(NamedTuple):
    """A route as a linear part and a network of the point p: x = direct^T p + constants, but x[outputs] = network(p).

    The fixed inputs are in `constants` and in the offset of the first layer, and may change from search to search.

    Attributes:
        chain: The network, from p to `outputs`.
        outputs: Elements of the layout that the network infers.
        free: Elements of the layout that make up p, in its order; empty if p is z.
        constants: Fixed inputs of the layout [standard deviations], shape (size,); 0 elsewhere.
        low: Lower bounds of p, shape (n,).
        high: Upper bounds of p, shape (n,).
    """

    chain: Chain
    outputs: np.ndarray
    free: np.ndarray
    constants: np.ndarray
    low: np.ndarray
    high: np.ndarray


def latent_lines(schema: BodySchema) -> Lines:
    """Return the lines of usage (e): p is z, and every x_out is decoded from it."""
    decoder = schema.weights.decoder
    far = np.full(len(decoder[0].matrix), np.inf)
    return Lines(decoder, schema.out_index, np.zeros(0, int), np.zeros(schema.layout.size), -far, far)


def input_lines(
    schema: BodySchema,
    mask: Mask,
    base: np.ndarray,
    columns: np.ndarray,
    free: np.ndarray,
    inferred: np.ndarray,
    constants: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
) -> Lines:
    """Return the lines of usage (f): p is a part of the network input, and the network infers x_out.

    Args:
        schema: The body schema.
        mask: Signals of the network input.
        base: Network input, in which p is replaced, shape (inputs,).
        columns: Positions of p in the input, shape (n,).
        free: Positions of p in the layout, shape (n,).
        inferred: Whether the network infers each element of x_out, shape (out_size,).
        constants: Fixed inputs of the layout [standard deviations], shape (size,).
        low: Lower bounds of p, shape (n,).
        high: Upper bounds of p, shape (n,).
    """
    chain, outputs = schema.chain(mask), schema.out_index[inferred]
    begin, end = chain[0], chain[-1]
    first = begin._replace(matrix=begin.matrix[columns], offset=np.empty_like(begin.offset))
    last = end._replace(matrix=end.matrix[:, inferred], offset=end.offset[inferred])
    lines = Lines((first, *chain[1:-1], last), outputs, free, np.zeros(len(constants)), low, high)
    set_inputs(lines, begin, base, columns, constants)
    return lines


def set_inputs(lines: Lines, begin: Layer, base: np.ndarray, columns: np.ndarray, constants: np.ndarray) -> None:
    """Write fixed inputs into the lines of usage (f).

    Args:
        lines: The result of `input_lines`.
        begin: First layer of the network.
        base: See `input_lines`.
        columns: See `input_lines`.
        constants: See `input_lines`.
    """
    fixed = base.astype(begin.matrix.dtype)
    fixed[columns] = 0.0
    np.add(begin.offset, fixed @ begin.matrix, out=lines.chain[0].offset)
    lines.constants[:] = constants
    lines.constants[lines.free] = 0.0
    lines.constants[lines.outputs] = 0.0


def fitting(lines: Lines, data: np.ndarray) -> Problem:
    """Return the problem of fitting x to data, shape (size,) [standard deviations]; NaN where unknown."""
    measured = np.flatnonzero(np.isfinite(data))
    rows = np.eye(len(data))[measured]
    return _problem(lines, rows, data[measured], np.array([0, len(measured)]), np.ones(1), _no_balance(), 0)


class FoldedProblem:
    """The problem of a route and its terms, folded once; `fill` writes the numbers of a search into it.

    Attributes:
        problem: Argument of `gemuco.search.descent.minimise`.
        moving: The term that balances torque at the predicted posture; None if there is none.
    """

    def __init__(self, lines: Lines, bounds: Sequence[Bound], held: np.ndarray) -> None:
        """Fold these terms; see `fold`."""
        self._lines = lines
        self._norms = [bound for bound in bounds if isinstance(bound, Norm)]
        self._torque = next((bound for bound in bounds if isinstance(bound, TorqueNorm)), None)
        self.moving = self._torque if self._torque is not None and self._torque.posture is None else None
        size = len(lines.constants)
        rows = [norm.difference.rows(size)[0] for norm in self._norms]
        ends = np.cumsum([0, *map(len, rows)])
        weights = np.array([norm.weight for norm in self._norms], float)
        balance = _no_balance()
        if (bound := self._torque) is not None:
            spans = [bound.f] if bound.posture is not None else [bound.f, bound.theta]
            first = int(ends[-1])
            second = -1 if bound.posture is not None else first + bound.f.stop - bound.f.start
            rows += [np.eye(size)[span] for span in spans]
            balance = _balance(bound, (first, second))
        self._index = np.flatnonzero(np.isfinite(held))
        rows.append(np.eye(size)[self._index])
        self._rows = np.concatenate(rows)
        self._reference = np.zeros(len(self._rows))
        self._slots = [slice(begin, end) for begin, end in pairwise(ends)]
        self.problem = _problem(lines, self._rows, self._reference, ends, weights, balance, len(self._index))
        wide, narrow, place = self.problem.chain.form[0, [WIDE, NARROW, PLACE]]
        self._offset = self.problem.chain.flat[place + wide * narrow : place + (wide + 1) * narrow]
        self.fill(held)

    def fill(self, held: np.ndarray) -> None:
        """Write fixed inputs, references and held values into the problem, for the same elements as before.

        Args:
            held: Values of the constraints [standard deviations], shape (size,); NaN where free.
        """
        for slot, norm in zip(self._slots, self._norms, strict=True):
            difference = norm.difference
            self._reference[slot] = difference.reference[difference.counts]
        if len(self._index):
            self._reference[-len(self._index) :] = held[self._index]
        np.subtract(
            self._rows @ self._lines.constants, self._reference, out=self.problem.direct[-1], casting="same_kind"
        )
        if len(self._lines.chain) > 1:  # a single layer contains the terms
            self._offset[:] = self._lines.chain[0].offset
        if self._torque is not None and self._torque.posture is not None:
            _set_posture(self.problem.balance, self._torque, self._torque.posture)


def fold(lines: Lines, bounds: Sequence[Bound], held: np.ndarray) -> FoldedProblem | None:
    """Fold a route and its terms; None if a term is a user's own, or if two terms balance torque.

    Args:
        lines: The route.
        bounds: The terms.
        held: Values of the constraints [standard deviations], shape (size,); NaN where free.
    """
    balances = [bound for bound in bounds if isinstance(bound, TorqueNorm)]
    if len(balances) > 1 or not all(isinstance(bound, Norm | TorqueNorm) for bound in bounds):
        return None
    return FoldedProblem(lines, bounds, held)


def _problem(
    lines: Lines,
    rows: np.ndarray,
    reference: np.ndarray,
    ends: np.ndarray,
    weights: np.ndarray,
    balance: Balance,
    held: int,
) -> Problem:
    last = lines.chain[-1]
    dtype = np.float32
    out = rows[:, lines.outputs].T.astype(dtype)
    chain = (*lines.chain[:-1], last._replace(matrix=last.matrix @ out, offset=last.offset @ out))
    direct = np.zeros((len(lines.low) + 1, len(rows)), dtype)
    if len(lines.free):
        direct[:-1] = rows[:, lines.free].T
    direct[-1] = rows @ lines.constants - reference
    limits = np.stack([lines.low, lines.high]).astype(dtype)
    return Problem(pack(chain), direct, ends, weights, balance, held, limits)


def _no_balance() -> Balance:
    """Return a torque balance without joints."""
    empty = np.zeros((0, 3), np.float32)
    chain = Packed(np.zeros(0, np.float32), np.zeros((0, 6), np.int64))
    return Balance(chain, chain.flat, empty, empty, (-1, -1), 0.0)


def _balance(bound: TorqueNorm, rows: tuple[int, int]) -> Balance:
    muscles = bound.muscles
    joints = np.zeros((len(bound.mean), 3 + len(bound.mean)), np.float32)
    joints[:, STD] = muscles.theta_std
    lines = np.stack([muscles.f_std, muscles.f_mean, muscles.l_std], axis=1).astype(np.float32)
    balance = Balance(muscles.packed, muscles.back, joints, lines, rows, float(bound.weight))
    if bound.posture is None:
        _set_posture(balance, bound, bound.mean)
    return balance


def _set_posture(balance: Balance, bound: TorqueNorm, posture: np.ndarray) -> None:
    """Write the posture at which torque is balanced [rad], shape (joints,)."""
    balance.joints[:, POSTURE] = (posture - bound.mean) / bound.std
    balance.joints[:, TORQUE] = bound.torques(posture[None])[0]


def linearised(problem: Problem, bound: TorqueNorm, x: np.ndarray) -> Problem:
    """Return the problem with torque linearised at a prediction, shape (size,) [standard deviations]."""
    posture = (x[bound.theta] * bound.std + bound.mean)[None]
    torque = bound.torques(posture)
    joints = problem.balance.joints.copy()
    joints[:, TORQUE], joints[:, POSTURE] = torque[0], x[bound.theta]
    joints[:, STIFFNESS:] = bound.stiffness(posture, torque)[0] * bound.std
    return problem._replace(balance=problem.balance._replace(joints=joints))
