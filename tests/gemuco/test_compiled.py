"""Compiled code says what torch and the numpy kernels say, for every shape, activation and term, and compiles once."""

import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from muscle_arm import gravity
from torch_network import Network

from gemuco.compiled import descent, newton
from gemuco.compiled.chain import pack, unpack
from gemuco.compiled.learning import EQUAL, SQUARED, gradients, loss
from gemuco.layers import ACTIVATIONS, Layer
from gemuco.search.descent import DescentConfig, NewtonConfig, descend, minimise
from gemuco.search.fold import Lines, fold, linearised
from gemuco.search.losses import Match, StayNear, StaySmall
from gemuco.search.norms import total
from gemuco.search.routes import InputRoute, LatentRoute
from gemuco.search.torque import TorqueBalance

TARGET = {"joint_position": np.array([0.3, 0.9])}
NOW = {"muscle_length": np.full(5, 0.3), "muscle_tension": np.array([10.0, np.nan, 30.0, 40.0, 50.0])}
MASK = frozenset({"joint_position", "muscle_tension"})
TERMS = {
    "match": Match("joint_position", 2.0),
    "near": StayNear("muscle_tension", 0.5),
    "near a value": StayNear("muscle_tension", value=(20.0, 20.0, 20.0, 20.0, 20.0)),
    "small": StaySmall("muscle_tension", 0.1),
    "small in SI": StaySmall("muscle_tension", 0.1, unit="si"),
    "through a matrix": Match("joint_position", matrix=((1.0, 1.0), (0.0, -0.5), (2.0, 0.3)), value=(0.4, 0.1, 0.0)),
    "matrix in SI": Match("joint_position", 2.0, matrix=((1.0, 1.0),), value=(0.4,), unit="si"),
    "torque": TorqueBalance(gravity, weight=0.7),
    "torque of the prediction": TorqueBalance(gravity, weight=0.7, at="predicted"),
}
widths = st.integers(1, 40)
SHAPES = st.tuples(widths, st.lists(widths, min_size=0, max_size=3), widths, widths, st.integers(1, 30))


def way_of(schema, route):
    if route == "latent":
        return LatentRoute(schema)
    return InputRoute(schema, MASK, np.full(schema.layout.size, np.nan), schema.layout.names)


def bound_problem(schema, route, names):
    bounds = [TERMS[name].bind(schema, TARGET, NOW) for name in names]
    way = way_of(schema, route)
    folded = fold(way.lines, bounds, np.full(schema.layout.size, np.nan))
    assert folded is not None
    return way, bounds, folded.problem


def once(problem, point):
    """Loss and gradient of a point, had from two steps of plain descent: its first loss, and where it leads."""
    step = 1e-3
    start = point[None].astype(np.float32)
    free = problem._replace(bounds=np.array([[-np.inf], [np.inf]], np.float32).repeat(len(point), axis=1))
    _, _, losses = descent.descend(free, start, step, 1, 1)
    return losses[0], losses[1]


@settings(max_examples=25, deadline=None)
@given(SHAPES, st.sampled_from(sorted(ACTIVATIONS)), st.sampled_from([0.3, 1.0, np.inf]), st.integers(0, 99))
def test_every_shape_agrees_with_torch(shape, activation, straight, seed):
    inputs, hidden, latent, outputs, rows = shape
    torch.manual_seed(seed)
    network = Network(inputs, outputs, hidden, latent, activation)
    random = np.random.default_rng(seed)
    x = random.standard_normal((rows, inputs)).astype(np.float32)
    wanted = random.standard_normal((rows, outputs)).astype(np.float32)
    wanted[random.random(wanted.shape) < 0.2] = np.nan
    chain = pack(network.weights().whole)
    found_loss, by_weights, by_input = gradients(chain, x, wanted, EQUAL, np.float32(straight), True, True)
    given_x, there = torch.from_numpy(x).double().requires_grad_(), torch.from_numpy(np.isfinite(wanted))
    network = network.double()
    missed = torch.where(there, network(given_x) - torch.from_numpy(np.nan_to_num(wanted)), 0.0)
    if np.isinf(straight):
        each = missed**2
    else:
        each = 2.0 * torch.nn.functional.huber_loss(missed, torch.zeros_like(missed), reduction="none", delta=straight)
    truth = each.sum() / max(int(there.sum()), 1)
    truth.backward()
    assert found_loss == pytest.approx(truth.item(), rel=1e-5)
    assert loss(chain, x, wanted, EQUAL, np.float32(straight)) == found_loss
    flat = [g.numpy().ravel() for m in network.linear for g in (m.weight.grad.T, m.bias.grad)]
    for found, expected in ((by_weights, np.concatenate(flat)), (by_input, given_x.grad.numpy())):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5 * max(np.abs(expected).max(), 1e-3))
    for kept, layer in zip(unpack(chain)[::2], network.weights().whole, strict=True):
        np.testing.assert_array_equal(kept, layer.matrix.astype(np.float32))


@pytest.mark.parametrize("route", ["latent", "input"])
@pytest.mark.parametrize("name", TERMS)
def test_every_term_is_what_it_is_in_numpy(schema, route, name):
    """The same loss, and a step of descent leads to the same loss, so the gradient is the same."""
    way, bounds, problem = bound_problem(schema, route, [name])
    random = np.random.default_rng(3)
    for _ in range(5):
        point = random.uniform(-1.0, 1.0, problem.bounds.shape[1]).astype(np.float32)
        x, back = way.predict(point[None])
        loss, slope = total(bounds, x.astype(float))
        way_down = back(slope.astype(np.float32))[0]
        there = total(bounds, way.predict((point - np.float32(1e-3) * way_down)[None])[0].astype(float))[0][0]
        if name == "torque of the prediction":
            problem = linearised(problem, bounds[0], x[0])
        begun, after = once(problem, point)
        assert begun == pytest.approx(loss[0], rel=1e-5)
        assert after == pytest.approx(there, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("route", ["latent", "input"])
def test_gradient_agrees_with_finite_differences(schema, route):
    names = ["match", "small", "near", "torque"]
    _, _, problem = bound_problem(schema, route, names)
    point = np.random.default_rng(5).uniform(-1.0, 1.0, problem.bounds.shape[1]).astype(np.float32)
    begun, after = once(problem, point)
    square = 0.0
    for i in range(len(point)):
        move = np.zeros_like(point)
        move[i] = 1e-2
        square += ((once(problem, point + move)[0] - once(problem, point - move)[0]) / 2e-2) ** 2
    assert begun - after == pytest.approx(1e-3 * square, rel=0.03)  # what a short step of descent gains


@pytest.mark.parametrize("route", ["latent", "input"])
@pytest.mark.parametrize("names", [["match", "small"], ["match", "small", "near"], ["match", "small", "torque"]])
def test_descent_ends_where_the_numpy_one_does(schema, route, names):
    way, bounds, problem = bound_problem(schema, route, names)

    def objective(points, slope):
        x, back = way.predict(points)
        loss, gradient = total(bounds, x, slope)
        return loss, back(gradient) if slope else gradient

    starts = np.random.default_rng(7).uniform(-1.0, 1.0, (3, problem.bounds.shape[1])).astype(np.float32)
    config = DescentConfig(0.3, 10, 12)
    plain = descend(objective, starts, config, *problem.bounds)
    assert minimise(problem, starts, config).loss == pytest.approx(plain.loss, rel=1e-3)


@pytest.mark.parametrize("route", ["latent", "input"])
@pytest.mark.parametrize("names", [["match", "small"], ["match", "small", "near"], ["match", "small", "torque"]])
def test_second_order_is_never_above_a_hundred_steps_of_descent(schema, route, names):
    _, _, problem = bound_problem(schema, route, names)
    random = np.random.default_rng(8)
    for _ in range(5):
        start = random.uniform(-1.0, 1.0, (1, problem.bounds.shape[1])).astype(np.float32)
        found = minimise(problem, start, NewtonConfig())
        assert found.loss <= 1.02 * minimise(problem, start, DescentConfig(0.3, 20, 100)).loss + 1e-3
        assert np.all(np.diff(found.losses) <= 0.0)
        assert np.all((found.point >= problem.bounds[0]) & (found.point <= problem.bounds[1]))


def test_a_straight_problem_is_solved_within_its_bounds():
    """min ||p - (3, 0.5)|| with |p| < 1 is (1, 0.5); a row that is held at 0.2 comes before."""
    layers = (Layer(np.eye(2, dtype=np.float32), np.zeros(2, np.float32), "linear"),)
    lines = Lines(layers, np.array([0, 1]), np.zeros(0, int), np.zeros(2), -np.ones(2), np.ones(2))
    folded = fold(lines, [], np.array([np.nan, np.nan]))
    assert folded is not None
    wanted = folded.problem._replace(
        chain=pack((Layer(np.eye(2, dtype=np.float32), np.zeros(2, np.float32), "linear"),)),
        direct=np.array([[0.0, 0.0], [0.0, 0.0], [-3.0, -0.5]], np.float32),
        ends=np.array([0, 2]),
        weights=np.ones(1),
    )
    found = minimise(wanted, np.zeros((1, 2)), NewtonConfig())
    assert found.point == pytest.approx([1.0, 0.5], abs=1e-4)
    held = wanted._replace(
        direct=wanted.direct + np.array([[0], [0], [1]], np.float32) * [0, 0.3], ends=np.array([0, 1])
    )
    held = held._replace(held=1, direct=held.direct.astype(np.float32))
    assert minimise(held, np.zeros((1, 2)), NewtonConfig()).point == pytest.approx([1.0, 0.2], abs=1e-4)


def test_time_that_is_up_ends_the_search_with_the_best_so_far(schema):
    _, _, problem = bound_problem(schema, "latent", ["match", "small", "torque"])
    start = np.random.default_rng(9).uniform(-1.0, 1.0, (1, problem.bounds.shape[1]))
    found = minimise(problem, start, NewtonConfig(), until=time.monotonic() - 1.0)
    assert found.is_late
    assert found.loss == pytest.approx(found.losses[0], rel=1e-5)
    assert not minimise(problem, start, NewtonConfig(), until=time.monotonic() + 60.0).is_late
    assert newton.monotonic() == pytest.approx(time.monotonic(), abs=1.0)


def test_what_is_no_number_is_not_hidden():
    layers = tuple(Layer(np.ones((2, 2), np.float32), np.zeros(2, np.float32), name) for name in ("tanh", "linear"))
    x = np.array([[np.nan, 0.0], [1e30, 0.0]], np.float32)
    begun, _, _ = gradients(pack(layers), x, np.zeros((2, 2), np.float32), EQUAL, SQUARED, False, True)
    assert np.isnan(begun)


ALL_WAYS = """
import numpy as np
from gemuco import warm
from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.adapt import adapt
from gemuco.anomaly import score as anomaly
from gemuco.estimation import estimate
from gemuco.compiled import bank, batch, chain, descent, inference, innovation, learning, newton, score
from gemuco.controller import Controller
from gemuco.search.losses import Match, StaySmall
warm.warm(is_service=True)
used = (newton.search, inference.infer, bank.see, innovation.innovations, learning.gradients, chain.output)
used = (*used, batch.under_masks, learning.loss, score.deviation)
before = [len(one.signatures) for one in used]
body = warm.body().under("other")
whole = {name: np.full(size, 0.1) for name, (size, _) in warm.SIGNALS.items()}
for absent in whole:
    estimate(body, {name: value for name, value in whole.items() if name != absent})
    estimate(body, {absent: whole[absent]})
for route in ("latent", "input"):
    Controller(body, (Match("position"), StaySmall("tension")), "tension", route).solve({"position": np.zeros(1)})
for what in ("weights", "bias", "both", "bias_then_weights"):
    for method in ("ekf", "gauss_newton", "gradient"):
        body = adapt(body, [whole] * 12, UpdateConfig(what=what, bias_method=method, minimum=1))
    estimate(body, {"length": whole["length"]})
anomaly.score(body, whole)
after = [len(one.signatures) for one in used]
import sys
assert before == after == [1] * len(used), (before, after)
assert not descent.descend.signatures
assert "torch" not in sys.modules
"""


COMPILER = """
import sys
sys.modules["torch"] = None  # the image of the services compiles everything without it
import numba
import numpy as np
from pathlib import Path
from gemuco import warm

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6

@numba.njit
def twice(x):
    return x + x

warm.warm()
before = resident()
warm.warm(is_service=True)
after = resident()
assert after < before - 20.0, (before, after)
assert twice(2.5) == 5.0 and twice(np.ones(2))[0] == 2.0
assert resident() > after
"""


def test_the_compiler_gives_its_memory_back_and_comes_again_when_it_is_needed():
    done = subprocess.run([sys.executable, "-c", COMPILER], capture_output=True, text=True, timeout=110)
    assert not done.returncode, done.stderr


@pytest.mark.slow
def test_nothing_is_left_to_compile_after_the_warm_up():
    done = subprocess.run([sys.executable, "-c", ALL_WAYS], capture_output=True, text=True, timeout=110)
    assert not done.returncode, done.stderr
