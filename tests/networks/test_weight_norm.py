"""Weight-normalised layers against those of PyTorch, and that they can be pickled, saved and copied."""

from __future__ import annotations

import copy
import io
import pickle

import pytest
import torch
from torch import nn

from snarfcli.networks import WeightNormLinear


def pair(bias=True, dtype=torch.float32):
    """Return a layer and PyTorch's from the same start."""
    torch.manual_seed(0)
    layer = nn.Linear(5, 3, bias=bias, dtype=dtype)
    return WeightNormLinear(layer), nn.utils.parametrizations.weight_norm(copy.deepcopy(layer))


@pytest.mark.parametrize("bias", [True, False])
def test_values_and_gradients_have_the_bits_of_pytorchs(bias):
    ours, theirs = pair(bias)
    points = torch.randn(7, 5)
    with torch.no_grad():
        for layer in (ours, theirs):
            layer.get_parameter("parametrizations.weight.original0").mul_(1.7)
    assert torch.equal(ours.weight, theirs.weight)
    assert torch.equal(ours(points), theirs(points))
    for layer in (ours, theirs):
        layer(points).square().sum().backward()
    wanted = dict(theirs.named_parameters())
    assert list(wanted) == [name for name, _ in ours.named_parameters()]  # optimisers' states go by this order
    for name, parameter in ours.named_parameters():
        assert torch.equal(parameter.grad, wanted[name].grad)


def test_gradients_of_slopes():
    ours, _ = pair(dtype=torch.float64)
    points = torch.randn(4, 5, dtype=torch.float64, requires_grad=True)
    names = [name for name, _ in ours.named_parameters()]

    def values(*parameters):
        return torch.func.functional_call(ours, dict(zip(names, parameters, strict=True)), points).sin()

    def slopes(*parameters):
        return torch.autograd.grad(values(*parameters).sum(), points, create_graph=True)[0]

    assert torch.autograd.gradcheck(values, tuple(ours.parameters()))
    assert torch.autograd.gradcheck(slopes, tuple(ours.parameters()))


def test_states_are_exchanged_with_pytorchs():
    ours, theirs = pair()
    other, _ = pair()
    with torch.no_grad():
        for parameter in theirs.parameters():
            parameter.add_(0.3)
    assert list(ours.state_dict()) == list(theirs.state_dict())
    ours.load_state_dict(theirs.state_dict())
    assert torch.equal(ours.weight, theirs.weight)
    theirs.load_state_dict(other.state_dict())
    assert torch.equal(theirs.weight, other.weight)


def test_the_given_layer_is_left_as_it_is():
    layer = nn.Linear(5, 3)
    weight, bias = layer.weight.detach().clone(), layer.bias.detach().clone()
    ours = WeightNormLinear(layer)
    assert isinstance(ours, nn.Linear)
    torch.testing.assert_close(ours.weight, weight)
    assert repr(ours).splitlines()[1].strip() == "in_features=5, out_features=3, bias=True"
    with torch.no_grad():
        for parameter in ours.parameters():
            parameter.zero_()
    assert torch.equal(layer.weight, weight)
    assert torch.equal(layer.bias, bias)


def saved_whole(module):
    buffer = io.BytesIO()
    torch.save(module, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=False)


@pytest.mark.parametrize("again", [copy.deepcopy, lambda module: pickle.loads(pickle.dumps(module)), saved_whole])
def test_it_is_copied_pickled_and_saved_whole(again):
    ours, _ = pair()
    network = nn.Sequential(ours, nn.Softplus(), WeightNormLinear(nn.Linear(3, 2)))
    points = torch.randn(7, 5)
    other = again(network)
    assert torch.equal(other(points), network(points))
    with torch.no_grad():
        ours.direction.neg_()
    assert not torch.equal(other(points), network(points))
