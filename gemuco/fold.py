"""A route and its terms made one: the problem that compiled searches solve (`gemuco.compiled.problem`).

Every term but the caller's own is a norm of something linear in the prediction, and a prediction is linear in the last
layer of the network and in what moves. So the terms are multiplied into the last layer and what is given into the
first, once per solve, and the search then looks at differences only.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from gemuco.compiled.chain import Packed, pack
from gemuco.compiled.problem import POSTURE, STD, STIFFNESS, TORQUE, Balance, Problem
from gemuco.kernels import Chain, Layer
from gemuco.losses import Bound, Norm
from gemuco.torque import Balanced

if TYPE_CHECKING:
    from gemuco.schema import BodySchema


class Lines(NamedTuple):
    """A route as straight lines and a net: x = direct^T p + constant, but x[outputs] = net(p) for what is inferred.

    Attributes:
        chain: net, from p to `outputs`.
        outputs: Elements of the layout that it infers.
        free: Elements of the layout that p is, in its order; empty where p is no signal (z).
        known: Every element of the layout that is given [standard deviations], shape (size,); 0 elsewhere.
        low: Bounds of p, shape (n,).
        high: Shape (n,).
    """

    chain: Chain
    outputs: np.ndarray
    free: np.ndarray
    known: np.ndarray
    low: np.ndarray
    high: np.ndarray


def latent_lines(schema: "BodySchema") -> Lines:
    """Usage (e): p is z, and every x_out is decoded from it."""
    decoder = schema.weights.decoder
    far = np.full(len(decoder[0].matrix), np.inf)
    nowhere, nothing = np.zeros(0, int), np.zeros(schema.layout.size)
    return Lines(decoder, schema.out_index, nowhere, nothing, -far, far)


def input_lines(
    schema: "BodySchema",
    base: np.ndarray,
    columns: np.ndarray,
    free: np.ndarray,
    inferred: np.ndarray,
    known: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
) -> Lines:
    """Usage (f): p is some inputs of the network, and the network infers x_out.

    Args:
        schema: The body schema.
        base: Input of the network, shape (inputs,), as it is where p is 0.
        columns: Where p lies in it, shape (n,).
        free: Where p lies in the layout, shape (n,).
        inferred: Which elements of x_out the network says, truth values, shape (out_size,).
        known: Every element of the layout that is given [standard deviations], shape (size,).
        low: Bounds of p, shape (n,).
        high: Shape (n,).
    """
    chain, outputs = schema.weights.whole, schema.out_index[inferred]
    begin, end = chain[0], chain[-1]
    still = base.astype(begin.matrix.dtype)
    still[columns] = 0.0
    rest = known.copy()
    rest[free] = rest[outputs] = 0.0
    first = Layer(begin.matrix[columns], begin.offset + still @ begin.matrix, begin.activation)
    last = Layer(end.matrix[:, inferred], end.offset[inferred], end.activation)
    return Lines((first, *chain[1:-1], last), outputs, free, rest, low, high)


def fitting(lines: Lines, data: np.ndarray) -> Problem:
    """How far x is from data (paper, eq. state-loss), shape (size,) [standard deviations]; NaN where none is given."""
    given = np.flatnonzero(np.isfinite(data))
    rows = np.eye(len(data))[given]
    none = no_balance()
    return _problem(lines, rows, data[given], np.array([0, len(given)]), np.ones(1), none, 0)


def fold(lines: Lines, bounds: Sequence[Bound], held: np.ndarray) -> Problem | None:
    """The problem of a route and its terms; None if a term is the caller's own, or two of them balance torques.

    Args:
        lines: The route.
        bounds: The terms.
        held: What predictions must equal [standard deviations], shape (size,); NaN where free.
    """
    norms = [bound for bound in bounds if isinstance(bound, Norm)]
    balances = [bound for bound in bounds if isinstance(bound, Balanced)]
    if len(norms) + len(balances) < len(bounds) or len(balances) > 1:
        return None
    size = len(lines.known)
    parts = [norm.difference.rows(size) for norm in norms]
    ends = np.cumsum([0, *(len(wanted) for _, wanted in parts)])
    weights = np.array([norm.weight for norm in norms], float)
    balance = no_balance()
    for bound in balances:
        fed = [bound.f] if bound.posture is not None else [bound.f, bound.theta]
        first = int(ends[-1])
        second = -1 if bound.posture is not None else first + bound.f.stop - bound.f.start
        parts += [(np.eye(size)[span], np.zeros(span.stop - span.start)) for span in fed]
        balance = _balance(bound, (first, second))
    index = np.flatnonzero(np.isfinite(held))
    parts.append((np.eye(size)[index], held[index]))
    rows, wanted = (np.concatenate(column) for column in zip(*parts, strict=True))
    return _problem(lines, rows, wanted, ends, weights, balance, len(index))


def _problem(
    lines: Lines,
    rows: np.ndarray,
    wanted: np.ndarray,
    ends: np.ndarray,
    weights: np.ndarray,
    balance: Balance,
    held: int,
) -> Problem:
    last = lines.chain[-1]
    dtype = np.float32
    out = rows[:, lines.outputs].T.astype(dtype)
    chain = (*lines.chain[:-1], Layer(last.matrix @ out, last.offset @ out, last.activation))
    direct = np.zeros((len(lines.low) + 1, len(rows)), dtype)
    if len(lines.free):
        direct[:-1] = rows[:, lines.free].T
    direct[-1] = rows @ lines.known - wanted
    limits = np.stack([lines.low, lines.high]).astype(dtype)
    return Problem(pack(chain), direct, ends, weights, balance, held, limits)


def no_balance() -> Balance:
    """Torque balance of nothing."""
    none = np.zeros((0, 3), np.float32)
    chain = Packed(np.zeros(0, np.float32), np.zeros((0, 5), np.int64))
    return Balance(chain, none, none, none, np.zeros(0, np.int64), (-1, -1), 0.0)


def _balance(bound: Balanced, rows: tuple[int, int]) -> Balance:
    muscles = bound.muscles
    posture = bound.mean if bound.posture is None else bound.posture
    base = muscles.base.astype(np.float32)
    base[muscles.theta] = (posture - bound.mean) / bound.std
    joints = np.zeros((len(bound.mean), 3 + len(bound.mean)), np.float32)
    joints[:, STD], joints[:, POSTURE] = muscles.theta_std, base[muscles.theta]
    joints[:, TORQUE] = bound.torques(posture[None])[0]
    lines = np.stack([muscles.f_std, muscles.f_mean, muscles.l_std], axis=1).astype(np.float32)
    places = np.concatenate([muscles.theta, muscles.f])
    return Balance(muscles.packed, base[None], joints, lines, places, rows, float(bound.weight))


def around(problem: Problem, bound: Balanced, x: np.ndarray) -> Problem:
    """The problem with its torque as it is near a prediction, shape (size,) [standard deviations]."""
    posture = (x[bound.theta] * bound.std + bound.mean)[None]
    torque = bound.torques(posture)
    joints = problem.balance.joints.copy()
    joints[:, TORQUE], joints[:, POSTURE] = torque[0], x[bound.theta]
    joints[:, STIFFNESS:] = bound.stiffness(posture, torque)[0] * bound.std
    return problem._replace(balance=problem.balance._replace(joints=joints))
