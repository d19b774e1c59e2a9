"""Pose codes of points that see the parts of a pose by different shares, as a torch.library operator."""

from __future__ import annotations

import torch
from torch import Tensor

from snarfcli.native import cpu_networks
from snarfcli.native.backend import choose_backend

__all__ = ["pose_code", "pose_code_reference", "run_pose_code"]


def run_pose_code(seen: Tensor, codes: Tensor, pose: Tensor) -> Tensor:
    """Return the pose code of each point: by the native operator in float32 on a CPU, else by PyTorch.

    Arguments and result: as those of `pose_code`. No gradient reaches `seen`.
    """
    is_native = codes.device.type == "cpu" and seen.dtype == codes.dtype == torch.float32
    run = pose_code if is_native and choose_backend("auto") == "native" else pose_code_reference
    return run(seen.detach(), codes, pose)


def pose_code_reference(seen: Tensor, codes: Tensor, pose: Tensor) -> Tensor:
    """The readable version of `pose_code`."""
    every = (seen @ codes.transpose(0, 1).flatten(1)).unflatten(1, (len(codes), -1))  # for all poses: a small product
    return every.gather(1, pose[:, None, None].expand(-1, 1, every.shape[2]))[:, 0]


@torch.library.custom_op("snarf::pose_code", mutates_args=())
def pose_code(seen: Tensor, codes: Tensor, pose: Tensor) -> Tensor:
    """Return the pose code of each point, the sum of the parts that it sees, [N, K].

    Args:
        seen: [N, P], share of each part at each point.
        codes: [B, P, K], code of each part in each pose.
        pose: [N], index of each point's pose, 0 to B - 1.

    No gradient reaches `seen`.
    """
    return pose_code_reference(seen, codes, pose).contiguous()


@pose_code.register_kernel("cpu")
def _(seen, codes, pose):
    if seen.dtype == codes.dtype == torch.float32 and choose_backend("auto") == "native":
        return cpu_networks.pose_codes(seen, codes, pose)
    return pose_code_reference(seen, codes, pose).contiguous()


@pose_code.register_fake
def _(seen, codes, pose):
    return codes.new_empty(len(seen), codes.shape[2])


def _backward_reference(gradient: Tensor, seen: Tensor, pose: Tensor, poses: int) -> Tensor:
    products = seen[:, :, None] * gradient[:, None]
    return products.new_zeros(poses, *products.shape[1:]).index_add(0, pose, products)


@torch.library.custom_op("snarf::pose_code_backward", mutates_args=())
def pose_code_backward(gradient: Tensor, seen: Tensor, pose: Tensor, poses: int) -> Tensor:
    """Return the gradient of a loss by the codes of `poses` poses, from that by `pose_code`'s result."""
    return _backward_reference(gradient, seen, pose, poses)


@pose_code_backward.register_kernel("cpu")
def _(gradient, seen, pose, poses):
    if seen.dtype == gradient.dtype == torch.float32 and choose_backend("auto") == "native":
        return cpu_networks.pose_codes_backward(gradient, seen, pose, poses)
    return _backward_reference(gradient, seen, pose, poses)


@pose_code_backward.register_fake
def _(gradient, seen, pose, poses):
    return gradient.new_empty(poses, seen.shape[1], gradient.shape[1])


def _remember(ctx, inputs, output):
    seen, codes, pose = inputs
    ctx.save_for_backward(seen, pose)
    ctx.poses = len(codes)


pose_code.register_autograd(
    lambda ctx, gradient: (None, pose_code_backward(gradient, *ctx.saved_tensors, ctx.poses), None), setup_context=_remember
)
