"""The paper's descent of estimation, control and simulation beside the same descent in torch eager, one thread each.

    python -m studies.speed.solvers

Twenty step sizes times thirty iterations, on z (e) and on x_in (f), from the same start to the same loss; and with the
torque balance of muscles, a derivative of a derivative. Ours are whole calls: references and given values are written
into the folded problem each time.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import torch

from gemuco.compiled.problem import Problem
from gemuco.schema import BodySchema
from gemuco.search.descent import Descent, DescentConfig, NewtonConfig, minimise
from gemuco.search.fold import fold
from gemuco.search.losses import Match, StayNear, StaySmall, Term
from gemuco.search.request import Request
from gemuco.search.routes import InputRoute, LatentRoute
from gemuco.search.torque import TorqueBalance
from studies.speed.bodies import body, modules
from studies.speed.table import Row, faster, show

PAPER = DescentConfig(gamma_max=0.2, candidates=20, iterations=30)
TARGET = {"joint_position": np.array([0.3, -0.2, 0.4, 0.1, -0.3])}
TERMS: tuple[Term, ...] = (
    Match("joint_position"),
    StaySmall("muscle_tension", 0.1),
    StayNear("muscle_length", 0.2, value=(0.0,) * 10),
)
TORQUE = np.array([1.0, -2.0, 0.5, 1.0, 0.2])
BALANCE = TorqueBalance(lambda _: TORQUE, weight=0.3)
MASK = frozenset({"joint_position", "muscle_tension"})
Loss = Callable[[torch.Tensor], torch.Tensor]


class Ours:
    """One problem, solved by the library."""

    def __init__(self, schema: BodySchema, route: str, terms: tuple[Term, ...]) -> None:
        self.request = Request(schema, terms)
        self.request.read(TARGET, {})
        self.given = np.full(schema.layout.size, np.nan)
        if route == "f":
            self.given[schema.layout.slice("joint_position")] = TARGET["joint_position"]
        names = schema.layout.names
        self.route = LatentRoute(schema) if route == "e" else InputRoute(schema, MASK, self.given, names)
        folded = fold(self.route.lines, self.request.bounds, self.request.held)
        assert folded is not None
        self.folded, limits = folded, folded.problem.bounds
        limits[:] = np.array([[-np.inf], [np.inf]])
        self.start = np.random.default_rng(4).uniform(-0.5, 0.5, (1, limits.shape[1])).astype(np.float32)

    def fold(self) -> Problem:
        """Return the problem as at the beginning of every solve."""
        self.request.read(TARGET, {})
        self.route.set_inputs(self.given)
        self.folded.fill(self.request.held)
        return self.folded.problem

    def solve(self, config: DescentConfig | NewtonConfig) -> Descent:
        """Solve the problem once."""
        return minimise(self.fold(), self.start, config)


def torch_loss(schema: BodySchema, route: str, with_torque: bool) -> Loss:
    """Return the same loss of points, shape (n, size), as a user would write it."""
    encoder, decoder = modules(schema)
    for parameter in (*encoder.parameters(), *decoder.parameters()):
        parameter.requires_grad_(False)
    target = torch.from_numpy(TARGET["joint_position"].astype(np.float32))
    torque = torch.from_numpy(TORQUE.astype(np.float32))
    mask = torch.tensor([1.0, 1.0, 0.0])

    def whole(posture: torch.Tensor, tension: torch.Tensor) -> torch.Tensor:
        rest = [torch.zeros(len(tension), 10), mask.expand(len(tension), 3)]
        return decoder(encoder(torch.cat([posture, tension, *rest], dim=1)))

    def loss(points: torch.Tensor) -> torch.Tensor:
        if route == "e":
            x = decoder(points)
            posture, tension, length = x[:, :5], x[:, 5:15], x[:, 15:]
        else:
            posture, tension = target.expand(len(points), 5), points
            length = whole(posture, tension)[:, 15:]
        total = (posture - target).norm(dim=1) + 0.1 * tension.norm(dim=1) + 0.2 * length.norm(dim=1)
        if with_torque:
            theta = target.expand(len(points), 5).clone().requires_grad_()
            pulled = (whole(theta, tension)[:, 15:] * tension).sum()
            (lever,) = torch.autograd.grad(pulled, theta, create_graph=torch.is_grad_enabled())
            total = total + 0.3 * (torque + lever).norm(dim=1)
        return total

    return loss


def torch_descent(loss: Loss, start: np.ndarray, needs_graph: bool) -> float:
    """Run the paper's descent in torch and return the loss at its end."""
    gammas = torch.linspace(0.0, PAPER.gamma_max, PAPER.candidates)[:, None]
    points = torch.from_numpy(start)
    for iteration in range(PAPER.iterations + 1):
        with torch.enable_grad() if needs_graph else torch.no_grad():
            losses = loss(points).detach()
        chosen = int(losses.argmin())
        if iteration == PAPER.iterations:
            break
        if iteration and chosen == 0:
            gammas = gammas / (PAPER.candidates - 1)
        best = points[chosen : chosen + 1].detach().clone().requires_grad_()
        (slope,) = torch.autograd.grad(loss(best).sum(), best)
        points = (best - gammas * slope).detach()
    return float(losses[chosen])


def rows() -> Iterator[Row]:
    """Measure every descent; the notes say how far the default search gets, which is another algorithm."""
    torch.set_num_threads(1)
    yield _descent(50, "e", TERMS, 30.0)
    yield _descent(200, "e", TERMS, 9.0)
    yield _descent(200, "f", TERMS, 9.0)
    yield _descent(200, "e", (*TERMS, BALANCE), 8.0)


def _descent(hidden: int, route: str, terms: tuple[Term, ...], bar: float) -> Row:
    schema = body((hidden, hidden))
    ours = Ours(schema, route, terms)
    with_torque = BALANCE in terms
    loss = torch_loss(schema, route, with_torque)
    mine, theirs = ours.solve(PAPER).loss, torch_descent(loss, ours.start, with_torque)
    if abs(mine - theirs) > 0.02 * theirs:
        raise ArithmeticError(f"Ours ends at {mine:.5f}, torch at {theirs:.5f}: they do not solve the same problem.")
    row = faster(
        f"{'descent with torque balance' if with_torque else 'descent'} 20 x 30, hidden {hidden} ({route})",
        "torch eager" + (", double backward" if with_torque else ""),
        lambda: ours.solve(PAPER),
        lambda: torch_descent(loss, ours.start, with_torque),
        bar,
    )
    losses = ours.solve(NewtonConfig()).losses
    steps = next((index for index, loss in enumerate(losses) if loss <= mine), len(losses) - 1)
    note = f"both end at {mine:.4f}; the default search is there after {steps} steps and ends at {losses[-1]:.4f}"
    return replace(row, note=note)


if __name__ == "__main__":
    show(rows())
