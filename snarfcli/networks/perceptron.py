"""A fully connected network as a torch.library operator.

On a CPU the native library evaluates it, forward and backward (csrc/cpu/training.cpp), in float32; everywhere else, and in
other dtypes, the readable version does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import List  # noqa: UP035

import torch
from torch import Tensor
from torch.nn import functional as F

from snarfcli.native import cpu_networks
from snarfcli.native.backend import choose_backend

__all__ = ["ACTIVATIONS", "perceptron", "perceptron_reference", "run_perceptron"]

ACTIVATIONS = {"relu": 1, "softplus": 2}
"""Numbers of the activations in the native library."""

_ROUND_NUMBER = 512  # multiple of rows in training: oneDNN compiles its matrix products again for every new size
_WIDE = 96  # layers of 64 are faster natively also where PyTorch multiplies in bfloat16 (benchmarks/bm_training.py)


def perceptron_reference(
    first: Tensor,
    extras: Tensor | None,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    takes_first: Sequence[int],
    takes_extras: Sequence[int],
    activation: int,
    sharpness: float,
) -> Tensor:
    """The readable version of `perceptron`, without what the gradient needs."""
    h = None
    for index, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        parts = [] if h is None else [h]
        if takes_first[index]:
            parts.append(first)
        if takes_extras[index] and extras is not None:
            parts.append(extras)
        blocks = weight.split([part.shape[1] for part in parts], 1)
        h = F.linear(parts[0], blocks[0], bias)  # a sum of products: joining wide inputs takes longer
        for part, block in zip(parts[1:], blocks[1:], strict=True):
            h = h + part @ block.T
        if index + 1 < len(weights):
            h = F.relu(h) if activation == ACTIVATIONS["relu"] else F.softplus(h, beta=sharpness)
    assert h is not None
    return h


def run_perceptron(
    first: Tensor,
    extras: Tensor | None,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    takes_first: Sequence[int],
    takes_extras: Sequence[int],
    activation: int,
    sharpness: float,
) -> Tensor:
    """Evaluate a network with gradients: by the native operator in float32 on a CPU, else layer by layer in PyTorch.

    Wide layers with ReLU are left to PyTorch where lower precision is allowed and the processor multiplies bfloat16 numbers.

    Arguments and result: as those of `perceptron`.
    """
    settings = (takes_first, takes_extras, activation, sharpness)
    is_float32_on_cpu = first.device.type == "cpu" and first.dtype == weights[0].dtype == torch.float32
    if is_float32_on_cpu and not _is_faster_in_pytorch(weights, activation) and choose_backend("auto") == "native":
        return perceptron(first, extras, list(weights), list(biases), *settings)[0]
    extra = -len(first) % _ROUND_NUMBER if is_float32_on_cpu and torch.is_grad_enabled() else 0
    if not extra:
        return perceptron_reference(first, extras, weights, biases, *settings)
    padded = [None if given is None else F.pad(given, (0, 0, 0, extra)) for given in (first, extras)]
    assert padded[0] is not None
    return perceptron_reference(padded[0], padded[1], weights, biases, *settings)[: len(first)]


def _is_faster_in_pytorch(weights: Sequence[Tensor], activation: int) -> bool:
    """Return whether PyTorch multiplies in bfloat16: a step with layers of 128 then takes three quarters of the native time.

    With softplus, which PyTorch evaluates slowly, the native operator is faster all the same.
    """
    is_narrow = max(len(weight) for weight in weights) < _WIDE
    if is_narrow or activation != ACTIVATIONS["relu"] or torch.get_float32_matmul_precision() == "highest":
        return False
    is_supported = getattr(torch.cpu, "_is_avx512_bf16_supported", None)  # no public name
    return is_supported is not None and bool(is_supported())


@torch.library.custom_op("snarf::perceptron", mutates_args=())
def perceptron(
    first: Tensor,
    extras: Tensor | None,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    takes_first: Sequence[int],
    takes_extras: Sequence[int],
    activation: int,
    sharpness: float,
) -> tuple[Tensor, Tensor]:
    """Evaluate a fully connected network.

    Args:
        first: [N, E], inputs of the first layer, and of others that `takes_first` names.
        extras: [N, X], inputs of the layers that `takes_extras` names, or None.
        weights: [outputs, inputs] of each layer; columns for the layer before, then `first`, then `extras`.
        biases: [outputs] of each layer.
        takes_first: 1 for each layer that takes `first`, 0 for others; the first layer must.
        takes_extras: the same for `extras`.
        activation: of all layers but the last, see `ACTIVATIONS`.
        sharpness: of the softplus.

    Returns:
        The outputs [N, O], and the activations that the gradient needs, in an order of the implementation's choice.
    """
    return perceptron_reference(
        first, extras, weights, biases, takes_first, takes_extras, activation, sharpness
    ), first.new_empty(0)


@perceptron.register_kernel("cpu")
def _(first, extras, weights, biases, takes_first, takes_extras, activation, sharpness):
    if first.dtype == torch.float32 and choose_backend("auto") == "native":
        return cpu_networks.perceptron(first, extras, weights, biases, takes_first, takes_extras, activation, sharpness)
    out = perceptron_reference(first, extras, weights, biases, takes_first, takes_extras, activation, sharpness)
    return out, first.new_empty(0)


@perceptron.register_fake
def _(first, extras, weights, biases, takes_first, takes_extras, activation, sharpness):
    return first.new_empty(len(first), len(biases[-1])), first.new_empty(torch.library.get_ctx().new_dynamic_size())


def _backward_reference(gradient, first, extras, weights, biases, *settings, wants):
    def run(first, extras, weights, biases):
        return perceptron_reference(first, extras, weights, biases, *settings)

    given = first.new_empty(len(first), 0) if extras is None else extras
    back = torch.func.vjp(run, first, given, list(weights), list(biases))[1]
    v_first, v_extras, v_weights, v_biases = back(gradient)
    # an operator's results may share no memory, as gradients by parts of a concatenation do
    v_first = v_first.clone() if wants[0] else first.new_empty(0)
    v_extras = v_extras.clone() if wants[1] and extras is not None else first.new_empty(0)
    return v_first, v_extras, [v.clone() for v in v_weights], [v.clone() for v in v_biases]


@torch.library.custom_op("snarf::perceptron_backward", mutates_args=())
def perceptron_backward(
    gradient: Tensor,
    saved: Tensor,
    first: Tensor,
    extras: Tensor | None,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    takes_first: Sequence[int],
    takes_extras: Sequence[int],
    activation: int,
    sharpness: float,
    wants_first: bool,
    wants_extras: bool,
) -> tuple[Tensor, Tensor, List[Tensor], List[Tensor]]:  # noqa: UP006  # PyTorch 2.6 knows no other as a result
    """Return the gradients of a loss by `first` and `extras`, empty where not wanted, by weights and by biases."""
    settings = (takes_first, takes_extras, activation, sharpness)
    return _backward_reference(gradient, first, extras, weights, biases, *settings, wants=(wants_first, wants_extras))


@perceptron_backward.register_kernel("cpu")
def _(
    gradient, saved, first, extras, weights, biases, takes_first, takes_extras, activation, sharpness, wants_first, wants_extras
):
    settings = (takes_first, takes_extras, activation, sharpness)
    if first.dtype == torch.float32 and choose_backend("auto") == "native":
        return cpu_networks.perceptron_backward(
            gradient, saved, first, extras, weights, biases, *settings, wants_first, wants_extras
        )
    return _backward_reference(gradient, first, extras, weights, biases, *settings, wants=(wants_first, wants_extras))


@perceptron_backward.register_fake
def _(
    gradient, saved, first, extras, weights, biases, takes_first, takes_extras, activation, sharpness, wants_first, wants_extras
):
    v_first = torch.empty_like(first) if wants_first else first.new_empty(0)
    v_extras = torch.empty_like(extras) if wants_extras and extras is not None else first.new_empty(0)
    return v_first, v_extras, [torch.empty_like(w) for w in weights], [torch.empty_like(b) for b in biases]


def _perceptron_context(ctx, inputs, output):
    first, extras, weights, biases, *ctx.settings = inputs
    ctx.count = len(weights)
    ctx.has_extras = extras is not None
    ctx.save_for_backward(output[1], first, *([extras] if ctx.has_extras else []), *weights, *biases)
    ctx.mark_non_differentiable(output[1])
    ctx.set_materialize_grads(False)  # no zeros for the activations, which are many


def _perceptron_gradient(ctx, gradient, _):
    if gradient is None:
        nothing = [None] * ctx.count
        return None, None, nothing, nothing, None, None, None, None
    saved, first, *rest = ctx.saved_tensors
    extras = rest.pop(0) if ctx.has_extras else None
    weights, biases = rest[: ctx.count], rest[ctx.count :]
    wants = ctx.needs_input_grad[0], ctx.needs_input_grad[1]
    v_first, v_extras, v_weights, v_biases = perceptron_backward(
        gradient, saved, first, extras, weights, biases, *ctx.settings, *wants
    )
    return v_first if wants[0] else None, v_extras if wants[1] else None, v_weights, v_biases, None, None, None, None


perceptron.register_autograd(_perceptron_gradient, setup_context=_perceptron_context)
