"""The fully connected network: native kernels against the readable version, gradients against finite differences."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
import torch

from snarfcli.native.library import native_library
from snarfcli.networks.perceptron import (
    ACTIVATIONS,
    perceptron,
    perceptron_backward,
    perceptron_reference,
    run_perceptron,
)
from snarfcli.precision import matmul_precision

TILE = 128  # csrc/cpu/network_task.h

# inputs E, extras X, width, depth, outputs O, layers that take the inputs again, layer that takes the extras, activation
NETWORKS = {
    "quick": (27, 16, 64, 3, 1, (), 2, "relu"),
    "paper": (3, 8, 40, 4, 1, (2,), 3, "softplus"),
    "weights": (3, 0, 33, 3, 24, (), None, "softplus"),
    "one layer": (5, 2, 0, 0, 3, (), 0, "relu"),
    "skip and extras in one layer": (7, 3, 20, 2, 2, (1,), 1, "relu"),
}


def made(name: str, count: int, dtype: torch.dtype = torch.float32, seed: int = 0):
    """Return the arguments of a network on `count` points."""
    inputs, extra, width, depth, outputs, skips, conditioned, activation = NETWORKS[name]
    generator = torch.Generator().manual_seed(seed)
    weights, biases, takes_first, takes_extras = [], [], [], []
    for layer in range(depth + 1):
        takes_first.append(int(layer == 0 or layer in skips))
        takes_extras.append(int(layer == conditioned))
        columns = (width if layer else 0) + inputs * takes_first[-1] + extra * takes_extras[-1]
        rows = width if layer < depth else outputs
        weights.append((2 / columns) ** 0.5 * torch.randn(rows, columns, generator=generator, dtype=torch.float64))
        biases.append(0.1 * torch.randn(rows, generator=generator, dtype=torch.float64))
    first = torch.randn(count, inputs, generator=generator, dtype=torch.float64)
    extras = torch.randn(count, extra, generator=generator, dtype=torch.float64) if extra else None
    tensors = [first, extras, weights, biases]
    cast = [t if t is None else [x.to(dtype) for x in t] if isinstance(t, list) else t.to(dtype) for t in tensors]
    return (*cast, takes_first, takes_extras, ACTIVATIONS[activation], 100.0)


def leaves(arguments):
    first, extras, weights, biases, *_ = arguments
    found = [first, *([] if extras is None else [extras]), *weights, *biases]
    return [tensor.requires_grad_() for tensor in found]


def outputs_and_gradients(function, arguments, gradient):
    inputs = leaves(arguments)
    out = function(*arguments)
    out = out[0] if isinstance(out, tuple) else out
    return out, torch.autograd.grad(out, inputs, gradient.to(out))


@pytest.mark.parametrize("count", [1, TILE - 1, TILE, TILE + 1, 5 * TILE + 3])
@pytest.mark.parametrize("name", NETWORKS)
def test_native_values_and_gradients_are_those_of_the_reference(name, count):
    assert native_library() is not None
    gradient = torch.randn(count, NETWORKS[name][4], generator=torch.Generator().manual_seed(1))
    out, gradients = outputs_and_gradients(perceptron, made(name, count), gradient)
    wanted, wanted_gradients = outputs_and_gradients(perceptron_reference, made(name, count, torch.float64), gradient)
    assert out.dtype == torch.float32
    # float32 sums of up to 80 terms; the softplus and its slope are accurate to 4e-6
    torch.testing.assert_close(out.double(), wanted, rtol=1e-5, atol=2e-5)
    for one, other in zip(gradients, wanted_gradients, strict=True):
        assert (one - other).norm() <= 2e-5 * other.norm() + 1e-12


def test_no_points():
    out, gradients = outputs_and_gradients(perceptron, made("quick", 0), torch.zeros(0, 1))
    assert out.shape == (0, 1)
    assert gradients[0].shape == (0, 27)
    assert all(not gradient.any() for gradient in gradients)


@pytest.mark.parametrize("name", NETWORKS)
def test_the_result_does_not_depend_on_the_number_of_threads(name):
    gradient = torch.randn(9 * TILE, NETWORKS[name][4], generator=torch.Generator().manual_seed(1))
    before = torch.get_num_threads()
    found = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            out, gradients = outputs_and_gradients(perceptron, made(name, 9 * TILE), gradient)
            found.append([out, *gradients])
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(one, two) for one, two in zip(found[0], other, strict=True))


@pytest.mark.parametrize("name", ["quick", "skip and extras in one layer"])
def test_strided_inputs(name):
    arguments = made(name, 40)
    spread = [torch.stack([tensor, tensor], -1)[..., 0] for tensor in arguments[:2]]
    assert not spread[0].is_contiguous()
    torch.testing.assert_close(perceptron(*spread, *arguments[2:])[0], perceptron(*arguments)[0], rtol=0, atol=0)


def test_what_is_not_a_number_stays_so():
    arguments = made("quick", 3)
    arguments[0][1] = torch.nan
    out = perceptron(*arguments)[0]
    assert out.isnan()[:, 0].tolist() == [False, True, False]


@pytest.mark.parametrize("name", NETWORKS)
def test_gradients_are_those_of_finite_differences(name):
    first, extras, weights, biases, *settings = made(name, 4, torch.float64)
    settings[-1] = 3.0  # a softplus smooth enough for finite differences
    count = len(weights)
    given = [tensor.requires_grad_() for tensor in (first, *([] if extras is None else [extras]), *weights, *biases)]

    def run(*tensors):
        rest = list(tensors[1:])
        more = None if extras is None else rest.pop(0)
        return perceptron(tensors[0], more, rest[:count], rest[count:], *settings)[0]

    assert torch.autograd.gradcheck(run, given)


@pytest.mark.parametrize("name", ["quick", "weights"])
def test_operator_contract(name):
    arguments = made(name, 5)
    torch.library.opcheck(perceptron, arguments, test_utils=("test_schema", "test_autograd_registration"))
    leaves(arguments)
    torch.library.opcheck(perceptron, arguments, test_utils=("test_schema", "test_autograd_registration"))
    out, saved = perceptron(*arguments)
    detached = [
        [x.detach() for x in t] if isinstance(t, list) and isinstance(t[0], torch.Tensor) else t for t in arguments[2:4]
    ]
    tensors = [None if t is None else t.detach() for t in arguments[:2]]
    backward = (torch.ones_like(out), saved.detach(), *tensors, *detached, *arguments[4:], True, arguments[1] is not None)
    torch.library.opcheck(perceptron_backward, backward, test_utils=("test_schema", "test_faketensor"))


SCRIPT = """
import json, sys, torch
sys.path[:0] = [PATHS]
from test_perceptron import NETWORKS, made, outputs_and_gradients, perceptron
from snarfcli.native.library import instruction_set
out = {"set": instruction_set()}
for name in NETWORKS:
    gradient = torch.randn(200, NETWORKS[name][4], generator=torch.Generator().manual_seed(1))
    values, gradients = outputs_and_gradients(perceptron, made(name, 200), gradient)
    out[name] = [float(values.double().sum()), *(float(g.double().norm()) for g in gradients)]
print(json.dumps(out))
"""


@pytest.mark.parametrize("wanted", ["baseline", "avx2", "avx512"])
def test_every_instruction_set_gives_the_same(wanted):
    script = SCRIPT.replace("PATHS", repr(os.path.dirname(__file__)))
    environment = os.environ | {"SNARF_INSTRUCTION_SET": wanted}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    if found.pop("set") != wanted:
        pytest.skip(f"this library or processor has no {wanted}")
    for name, values in found.items():
        gradient = torch.randn(200, NETWORKS[name][4], generator=torch.Generator().manual_seed(1))
        out, gradients = outputs_and_gradients(perceptron_reference, made(name, 200, torch.float64), gradient)
        assert values == pytest.approx([float(out.detach().sum()), *(float(g.norm()) for g in gradients)], rel=2e-5, abs=2e-4)


@pytest.mark.parametrize(
    ("precision", "width", "is_native"), [("highest", 128, True), ("medium", 128, False), ("medium", 64, True)]
)
def test_wide_layers_are_left_to_pytorch_where_it_multiplies_in_bfloat16(monkeypatch, precision, width, is_native):
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True, raising=False)
    weights = [torch.rand(width, 3, requires_grad=True), torch.rand(1, width)]
    with matmul_precision(precision):
        out = run_perceptron(torch.rand(4, 3), None, weights, [torch.zeros(width), torch.zeros(1)], [1, 0], [0, 0], 1, 100.0)
    assert ("snarf_perceptron" in type(out.grad_fn).__name__) == is_native
