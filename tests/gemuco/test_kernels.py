import numpy as np
import pytest
import torch
from torch_network import MODULES, Network

from gemuco.errors import SchemaError
from gemuco.layers import ACTIVATIONS, Curvature, pull, push, run, trace
from gemuco.learning.network import first_weights

INPUTS, OUTPUTS, SAMPLES = 9, 6, 4


@pytest.fixture(params=sorted(ACTIVATIONS))
def network(request):
    torch.manual_seed(3)
    return Network(INPUTS, OUTPUTS, (20, 10), 5, request.param)


@pytest.fixture
def x():
    return np.random.default_rng(1).standard_normal((SAMPLES, INPUTS)).astype(np.float32)


@pytest.fixture
def seed():
    return np.random.default_rng(2).standard_normal((SAMPLES, OUTPUTS)).astype(np.float32)


def test_forward_agrees_with_torch(network, x):
    weights = network.weights()
    wanted = network(torch.from_numpy(x)).detach().numpy()
    np.testing.assert_allclose(run(weights.whole, x), wanted, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(run(weights.decoder, run(weights.encoder, x[0])), wanted[0], rtol=1e-5, atol=1e-6)


@pytest.mark.filterwarnings("error")
def test_what_was_not_measured_stays_unknown_without_a_warning(network, x):
    x[1, 2] = np.nan
    found = run(network.weights().whole, x)
    assert np.isnan(found[1]).all()
    assert np.isfinite(np.delete(found, 1, axis=0)).all()


def test_backward_agrees_with_torch(network, x, seed):
    weights = network.weights()
    given = torch.from_numpy(x).requires_grad_()
    (network(given) * torch.from_numpy(seed)).sum().backward()
    values = trace(weights.whole, x)
    np.testing.assert_allclose(pull(weights.whole, values, seed), given.grad.numpy(), rtol=1e-5, atol=1e-6)


def test_second_derivatives_agree_with_torch(network, x, seed):
    weights = network.weights().astype(np.float64)
    network, x, seed = network.double(), x.astype(np.float64), seed.astype(np.float64)
    tangent = np.random.default_rng(5).standard_normal(x.shape)
    curvature = Curvature(weights.whole, x, seed)
    pushed, mixed = curvature.mixed(tangent)
    given = torch.from_numpy(x).requires_grad_()
    output = (network(given) * torch.from_numpy(seed)).sum()
    (first,) = torch.autograd.grad(output, given, create_graph=True)
    (second,) = torch.autograd.grad((first * torch.from_numpy(tangent)).sum(), given)
    np.testing.assert_allclose(curvature.gradient, first.detach().numpy(), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(mixed, second.numpy(), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(pushed, push(weights.whole, trace(weights.whole, x), tangent), rtol=1e-9, atol=1e-12)


def test_second_derivative_agrees_with_finite_differences(network, x, seed):
    chain = network.weights().astype(np.float64).whole
    x, seed = x.astype(np.float64), seed.astype(np.float64)
    tangent = np.random.default_rng(5).standard_normal(x.shape)
    _, mixed = Curvature(chain, x, seed).mixed(tangent)
    step = 1e-6
    for column in range(INPUTS):
        moved = np.zeros_like(x)
        moved[:, column] = step
        rise = [np.sum(Curvature(chain, x + s * moved, seed).gradient * tangent, axis=1) for s in (1, -1)]
        np.testing.assert_allclose(mixed[:, column], (rise[0] - rise[1]) / (2 * step), rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("name", sorted(ACTIVATIONS))
def test_slope_and_bend_agree_with_finite_differences(name):
    activation, step = ACTIVATIONS[name], 1e-5
    x = np.array([-30.0, -3.0, -0.7, -0.1, 0.2, 0.9, 4.0, 30.0])

    def value(at):
        y = at.copy()
        activation.apply(y)
        return y

    slope = activation.slope(value(x))
    np.testing.assert_allclose(slope, (value(x + step) - value(x - step)) / (2 * step), rtol=1e-6, atol=1e-9)
    rise = activation.slope(value(x + step)) - activation.slope(value(x - step))
    np.testing.assert_allclose(activation.bend(value(x), slope), rise / (2 * step), rtol=1e-6, atol=1e-9)
    single = x.astype(np.float32)
    activation.apply(single)
    assert single.dtype == np.float32
    assert np.isfinite(single).all()


@pytest.mark.parametrize("seed", [0, 1, 812, 2**31 + 5, 2**32 + 7])
@pytest.mark.parametrize(("inputs", "hidden"), [(1, ()), (25, (200, 30)), (61, (300,))])
def test_the_first_weights_are_those_of_torch(seed, inputs, hidden):
    torch.manual_seed(seed)
    theirs = Network(inputs, OUTPUTS, hidden, 15, "relu").weights()
    ours = first_weights(seed, inputs, OUTPUTS, hidden, 15, "relu")
    assert [layer.activation for layer in ours.whole] == [layer.activation for layer in theirs.whole]
    for own, other in zip(ours.arrays(), theirs.arrays(), strict=True):
        assert own.dtype == other.dtype == np.float32
        np.testing.assert_allclose(own, other, rtol=0.0, atol=1e-7)


def test_every_activation_is_known_to_torch_and_numpy():
    assert set(MODULES) == set(ACTIVATIONS)
    with pytest.raises(SchemaError, match=r"'swish' is not known\. Known activations: tanh, sigmoid, relu"):
        first_weights(0, INPUTS, OUTPUTS, (20,), 5, "swish")
