"""Linear blend skinning, pointwise and blended once per grid node."""

from __future__ import annotations

from typing import overload

import torch
from torch import Tensor
from torch.nn import functional as F

from snarfcli.deformer.blending import blend
from snarfcli.precision import matmul_precision

__all__ = ["blend_transforms", "blended_matrices", "inverse_skin", "moved_vectors", "skin"]

_TINY = 1e-30  # length of a moved normal that counts as zero; those of transforms with small scales are short


@overload
def skin(
    canonical: Tensor, weights: Tensor, bone_transforms: Tensor, *, directions: None = None, normals: None = None
) -> Tensor: ...


@overload
def skin(
    canonical: Tensor,
    weights: Tensor,
    bone_transforms: Tensor,
    *,
    directions: Tensor | None = None,
    normals: Tensor | None = None,
) -> Tensor | tuple[Tensor, ...]: ...


def skin(
    canonical: Tensor,
    weights: Tensor,
    bone_transforms: Tensor,
    *,
    directions: Tensor | None = None,
    normals: Tensor | None = None,
) -> Tensor | tuple[Tensor, ...]:
    """Move canonical points into the posed frame by linear blend skinning.

    Leading dimensions, such as those of poses, are broadcast: [N, 3] and [N, J] with [B, J, 4, 4] give [B, N, 3]. The result is
    exact also under autocast and where the caller allows TF32, which then applies to the gradient only.

    Args:
        canonical: [..., N, 3], points, canonical frame, metres.
        weights: [..., N, J], skinning weights, non-negative, rows sum to 1.
        bone_transforms: [..., J, 4, 4], canonical to posed, metres.
        directions: [..., N, 3], a vector at each point, such as a tangent; moved by the blended 3x3.
        normals: [..., N, 3], a normal at each point; moved by the inverse transpose of the blended 3x3 and normalised. As usual
            the derivative of the weights is left out, in both.

    Returns:
        Posed points, [..., N, 3], metres; with `directions` or `normals` a tuple of the points and of these, in this order.

    Raises:
        ValueError: a shape or device does not fit; the message names the argument, what was wanted and what came.
        TypeError: a dtype is not float32 or float64, or the dtypes differ.

    Source: SNARF Eq. 4.
    """
    _check(weights, bone_transforms, canonical=canonical, directions=directions, normals=normals)
    with torch.autocast(canonical.device.type, enabled=False):
        blended = _blend_rows(weights, bone_transforms, 3)
        posed = _turn(blended, canonical) + blended[..., 3]
        vectors = moved_vectors(blended, directions, normals)
    return (posed, *vectors) if vectors else posed


def moved_vectors(jacobian: Tensor, directions: Tensor | None, normals: Tensor | None) -> list[Tensor]:
    """Return those of `directions` and `normals` [..., 3] that are given, moved by the 3x3 of `jacobian` [..., 3, 3 or 4].

    Directions are multiplied by it, normals by its inverse transpose and normalised.
    """
    results = []
    if directions is not None:
        results.append(_turn(jacobian, directions))
    if normals is not None:
        cofactors, determinant = _cofactors(jacobian)
        turned = torch.stack([(row * normals).sum(-1) for row in cofactors], -1)
        results.append(F.normalize(torch.where(determinant < 0, -turned, turned), dim=-1, eps=_TINY))
    return results


def inverse_skin(posed: Tensor, weights: Tensor, bone_transforms: Tensor, least_determinant: float = 0.0) -> Tensor:
    """Move posed points back into the canonical frame by linear blend skinning with given weights: the inverse of `skin`.

    The weights are those of the canonical points. To find points without knowing their weights, see `find_correspondences`.

    Args:
        posed: [..., N, 3], points, posed frame, metres.
        weights: [..., N, J], skinning weights, rows sum to 1.
        bone_transforms: [..., J, 4, 4], canonical to posed, metres.
        least_determinant: the determinant of the blended 3x3 is kept at least this far from zero, so that points near a blend
            without inverse, such as that of opposite rotations, go far away but stay finite. With 0 they may become infinite
            or NaN.

    Returns:
        Canonical points, [..., N, 3], metres; leading dimensions are broadcast.

    Raises:
        ValueError, TypeError: as `skin`.

    Source: SNARF Eq. 4, solved for x at fixed w.
    """
    _check(weights, bone_transforms, posed=posed)
    with torch.autocast(posed.device.type, enabled=False):
        blended = _blend_rows(weights, bone_transforms, 3)
        columns, determinant = _cofactors(blended)
        if least_determinant > 0:
            least = torch.where(determinant < 0, -least_determinant, least_determinant)
            determinant = torch.where(determinant.abs() < least_determinant, least, determinant)
        x, y, z = (posed - blended[..., 3])[..., None].unbind(-2)
        return (columns[0] * x + columns[1] * y + columns[2] * z) / determinant


def blended_matrices(weights: Tensor, bone_transforms: Tensor) -> Tensor:
    """Blend the bone transforms at points: the matrix that moves each of them. Exact as `skin`.

    Args:
        weights: [..., N, J], skinning weights, rows sum to 1.
        bone_transforms: [..., J, 4, 4], canonical to posed, metres.

    Returns:
        [..., N, 4, 4]; leading dimensions are broadcast.

    Raises:
        ValueError, TypeError: as `skin`.
    """
    _check(weights, bone_transforms)
    with torch.autocast(weights.device.type, enabled=False):
        return _blend_rows(weights, bone_transforms, 4)


def _blend_rows(weights: Tensor, bone_transforms: Tensor, rows: int) -> Tensor:
    """Return the upper rows of the blended transforms, [..., N, rows, 4]."""
    bones = bone_transforms[..., :rows, :].flatten(-2)
    leading = torch.broadcast_shapes(weights.shape[:-2], bones.shape[:-2])
    weights = weights.expand(*leading, *weights.shape[-2:])  # without this, weights shared by all poses take twice as long
    if torch.compiler.is_compiling():  # which cannot change the precision of a matrix product, and joins these two
        blended = (weights[..., None] * bones[..., None, :, :]).sum(-2)
    else:
        with matmul_precision("highest"):
            blended = weights @ bones
    return blended.unflatten(-1, (rows, 4))


def _turn(blended: Tensor, vectors: Tensor) -> Tensor:
    """Apply the 3x3 part of blended transforms [..., 3, 4] to vectors [..., 3]."""
    x, y, z = vectors[..., None].unbind(-2)
    # Column by column: the same bits as a batched product of 3x3 matrices, in a third of the time.
    return blended[..., 0] * x + blended[..., 1] * y + blended[..., 2] * z


def _cofactors(blended: Tensor) -> tuple[list[Tensor], Tensor]:
    """Return what the 3x3 part A of blended transforms [..., 3, 4] is inverted with.

    Returns:
        The columns of det(A) A^-1, which are the rows of det(A) A^-T, three times [..., 3]; and det(A), [..., 1].
    """
    a, b, c = blended[..., :3].unbind(-2)
    columns = [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)]
    return columns, (a * columns[0]).sum(-1, keepdim=True)


def _check(weights: Tensor, bone_transforms: Tensor, **points: Tensor | None) -> None:
    """Raise ValueError or TypeError if weights, transforms and what stands at the points, [..., N, 3] each, do not fit."""
    given = {name: tensor for name, tensor in points.items() if tensor is not None}
    tensors = {**given, "weights": weights, "bone_transforms": bone_transforms}
    first, reference = next(iter(tensors.items()))
    if reference.ndim < 2 or (first != "weights" and reference.shape[-1] != 3):
        raise ValueError(f"{first}: wanted shape [..., N, {'J' if first == 'weights' else 3}], got {list(reference.shape)}")
    count, leading = reference.shape[-2], ()
    if weights.ndim < 2 or weights.shape[-2] != count or not weights.shape[-1]:
        raise ValueError(f"weights: wanted shape [..., {count}, J] and at least one bone, got {list(weights.shape)}")
    bones = weights.shape[-1]
    ends = {"weights": (count, bones), "bone_transforms": (bones, 4, 4)}
    for name, tensor in tensors.items():
        end = ends.get(name, (count, 3))
        own = tensor.shape[: -len(end)]
        both = range(-min(len(own), len(leading)), 0)
        fits = all(own[axis] == leading[axis] or 1 in (own[axis], leading[axis]) for axis in both)
        if tensor.ndim < len(end) or tensor.shape[-len(end) :] != end or not fits:
            raise ValueError(f"{name}: wanted shape {[*leading, *end]} to fit the others, got {list(tensor.shape)}")
        leading = torch.broadcast_shapes(leading, own)
        if tensor.dtype not in (torch.float32, torch.float64):
            raise TypeError(f"{name}: wanted float32 or float64, got {tensor.dtype}")
        if tensor.dtype != reference.dtype:
            raise TypeError(f"{name}: wanted the dtype of {first}, {reference.dtype}, got {tensor.dtype}")
        if tensor.device != reference.device:
            raise ValueError(f"{name}: wanted the device of {first}, {reference.device}, got {tensor.device}")


def blend_transforms(
    skinning_weights: Tensor, bone_transforms: Tensor, active_cells: Tensor | None = None, backend: str = "auto"
) -> Tensor:
    """Blend the bone transforms once per grid node and pose.

    Args:
        skinning_weights: [D, H, W, J] at the grid nodes, or [B, D, H, W, J], those of each pose.
        bone_transforms: [B, J, 4, 4], canonical to posed.
        active_cells: [D-1, H-1, W-1], bool; other nodes than their corners may get zeros. None for all.
        backend: "auto", "native" or "reference".

    Returns:
        The upper three rows of the blended transforms, flattened: [B, D * H * W, 12].

    Source: Fast-SNARF Eq. 13.
    """
    bones = bone_transforms[:, :, :3].reshape(*bone_transforms.shape[:2], 12)
    if skinning_weights.ndim == 4:
        return blend(skinning_weights, bones, active_cells, backend)
    if not len(bones):
        return blend(skinning_weights.sum(0), bones, active_cells, backend)  # nothing, of the right shape
    poses = zip(skinning_weights, bones.split(1), strict=True)
    return torch.cat([blend(weights, pose, active_cells, backend) for weights, pose in poses])
