import numpy as np
import pytest

from gemuco import TrainConfig, estimate, fit
from gemuco.checkpoint import load, save
from gemuco.compiled.chain import first as inputs_of
from gemuco.compiled.chain import forward, pack, push_all, space
from gemuco.layers import pull, push, run, trace
from gemuco.learning.soap import Soap
from gemuco.linear import LinearPath, basis

SMALL = TrainConfig(hidden=(20,), latent=6, epochs=30, batch=50)
UNITS = {"motor": "rad", "joint": "rad"}
GEAR = np.array([[0.5, 0.1], [-0.2, 0.8]])


def encoders(count: int, seed: int, reach: float = 1.0) -> dict[str, np.ndarray]:
    """A body that is linear: a joint encoder behind a coupled gear."""
    motor = np.random.default_rng(seed).uniform(-reach, reach, (count, 2))
    return {"motor": motor, "joint": motor @ GEAR + 0.3}


@pytest.fixture(scope="module")
def schema():
    episodes = [encoders(100, seed) for seed in range(6)]
    return fit(episodes, SMALL, [{"motor"}, {"joint"}, {"motor", "joint"}], units=UNITS)[0]


def test_a_linear_body_goes_on_along_the_line(schema):
    inside, outside = encoders(50, 100), encoders(50, 101, reach=10.0)
    for values, tolerance in ((inside, 0.002), (outside, 0.05)):  # rad
        found = estimate(schema, {"motor": values["motor"]})["joint"]
        assert np.abs(found.value - values["joint"]).max() < tolerance


def test_a_stored_path_is_the_same(schema, tmp_path):
    save(schema, tmp_path / "model")
    again, values = load(tmp_path / "model"), encoders(5, 7)
    given = {"joint": values["joint"]}
    np.testing.assert_array_equal(estimate(again, given)["motor"].value, estimate(schema, given)["motor"].value)


def test_the_folded_chain_is_the_network_and_has_its_derivatives(schema):
    mask = frozenset({"motor"})
    x = schema.normalise(encoders(1, 3))
    inputs, chain = schema.network_input(x, mask), schema.chain(mask)
    np.testing.assert_allclose(run(chain, inputs), run(schema.weights.whole, inputs), atol=1e-5)
    assert any(layer.straight for layer in chain)
    exact = tuple(
        layer._replace(matrix=layer.matrix.astype(float), offset=layer.offset.astype(float)) for layer in chain
    )
    point, step = inputs.astype(float), 1e-5
    moves = step * np.eye(inputs.shape[1])
    slope = np.stack([(run(exact, point + move) - run(exact, point - move))[0] / (2.0 * step) for move in moves])
    values = trace(exact, point)
    np.testing.assert_allclose(
        np.stack([push(exact, values, move[None] / step)[0] for move in moves]), slope, atol=1e-8
    )
    pulled = [pull(exact, values, row[None])[0] for row in np.eye(slope.shape[1])]
    np.testing.assert_allclose(np.stack(pulled, axis=1), slope, atol=1e-8)
    packed = pack(chain)
    memory = space(packed, 1)
    inputs_of(packed, memory, 1)[:] = inputs
    forward(packed, memory, 1)
    np.testing.assert_allclose(push_all(packed, memory, 1, 0), slope, atol=1e-5)


def test_every_mask_has_its_own_regression():
    random = np.random.default_rng(0)
    x = random.standard_normal((400, 3))
    y = x @ np.array([[1.0, 0.0], [0.0, 2.0], [0.0, 0.0]]) + 0.1
    path = LinearPath.fit(x, y, 2)
    whole, part = (path.direct(np.array(gate), np.zeros(2))[:-1] for gate in ([1.0, 1.0, 1.0], [1.0, 0.0, 1.0]))
    np.testing.assert_allclose(whole, [[1.0, 0.0], [0.0, 2.0], [0.0, 0.0], [0.1, 0.1]], atol=1e-3)
    np.testing.assert_allclose(part[0], [1.0, 0.0], atol=0.3)
    assert not part[1].any()


def test_single_wrong_rows_do_not_turn_the_line():
    random = np.random.default_rng(1)
    x = random.standard_normal((400, 1))
    code = 2.0 * x + 0.01 * random.standard_normal((400, 1))
    code[::50] += 30.0
    path = LinearPath.fit(x, code, 1)
    np.testing.assert_allclose(path.direct(np.ones(1), np.zeros(1))[:2, 0], [2.0, 0.0], atol=0.02)


def test_the_basis_restores_what_has_few_components():
    random = np.random.default_rng(2)
    y = random.standard_normal((200, 2)) @ random.standard_normal((2, 5)) + 1.0
    mean, components = basis(y, 2)
    np.testing.assert_allclose((y - mean) @ components.T @ components + mean, y, atol=1e-9)


def test_soap_crosses_a_narrow_valley(schema):
    chain = pack(schema.weights.whole)
    goal = chain.flat.copy()
    numbers, scale = np.zeros_like(goal), np.geomspace(1.0, 1e-2, len(goal)).astype(np.float32)
    optimiser = Soap(chain)
    for _ in range(300):
        optimiser.move(numbers, scale * (numbers - goal), 0.02)
    assert np.abs(numbers - goal).mean() < 0.1 * np.abs(goal).mean()
    assert optimiser.time == 300
    assert all(np.isfinite(array).all() for array in optimiser.state().values())


def _followers(random: np.random.Generator, rows: int) -> np.ndarray:
    """Return inputs of which the second and the third follow the first with little play, as in one recorded motion."""
    first = np.cumsum(random.normal(size=rows)) / 20.0
    return np.stack([first, first + 0.02 * random.normal(size=rows), -first + 0.02 * random.normal(size=rows)], axis=1)


@pytest.mark.parametrize("seed", range(3))
def test_inputs_that_only_go_together_in_the_data_are_left_out_beyond_it(seed):
    random = np.random.default_rng(seed)
    x = _followers(random, 2000)
    y = 0.7 * x[:, :1] + 0.2 + 0.003 * np.sin(9.0 * x[:, 1:2] + np.arange(2000)[:, None] / 300.0)
    path = LinearPath.fit(x, y, 1)
    few = path.by_few(np.ones(3), 0)
    assert few[0] == pytest.approx(0.7, abs=0.01) and few[-1] == pytest.approx(0.2, abs=0.01)
    assert np.array_equal(few[1:3], [0.0, 0.0])
    assert np.all(path.map(np.ones(3))[1:3] != 0.0)


@pytest.mark.parametrize("late", [False, True])
def test_an_input_that_is_needed_is_kept_also_if_it_moves_in_one_part_of_the_data_only(late):
    random, rows = np.random.default_rng(4), 2000
    x = random.normal(size=(rows, 4))
    if late:
        x[: rows * 4 // 5, 3] = 0.0
    weights = np.array([0.8, -0.5, 0.3, 0.25])
    path = LinearPath.fit(x, x @ weights[:, None] + 0.01 * random.normal(size=(rows, 1)), 1)
    assert path.by_few(np.ones(4), 0)[:-1] == pytest.approx(weights, abs=0.01)
    assert path.by_few(np.array([1.0, 1.0, 0.0, 1.0]), 0)[2] == 0.0


def test_an_element_is_the_same_by_few_inputs_whatever_the_code():
    """Elements of x_out are mixtures of the code, which may be shorter."""
    random = np.random.default_rng(5)
    x = random.normal(size=(1000, 3))
    y = np.stack([x[:, 0], x[:, 0] * 2.0, x[:, 1] - 0.5], axis=1)
    for width in (2, 3):
        path = LinearPath.fit(x, y, width)
        lines = np.stack([path.by_few(np.ones(3), element) for element in range(3)], axis=1)
        assert lines == pytest.approx(np.array([[1, 2, 0], [0, 0, 1], [0, 0, 0], [0, 0, -0.5]], float), abs=1e-3)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("rows", [2, 4, 5, 30])
def test_few_samples_and_an_input_that_rests_give_a_line(rows):
    x = np.random.default_rng(6).normal(size=(rows, 3))
    x[:, 1] = 0.5
    line = LinearPath.fit(x, 2.0 * x[:, :1], 1).by_few(np.ones(3), 0)
    assert np.isfinite(line).all() and line[1] == 0.0
    if rows >= 5:
        assert line == pytest.approx([2.0, 0.0, 0.0, 0.0], abs=1e-3)
