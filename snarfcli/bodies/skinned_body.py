"""Bodies of any kind as skeleton, vertices and weights: SMPL-format files, our bodies, smplx's models, plain arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from snarfcli.bodies.body import Body
from snarfcli.bodies.model_files import load_body
from snarfcli.bodies.skeleton import SMPL_JOINT_NAMES, SMPLH_JOINT_NAMES, SMPLX_JOINT_NAMES, Skeleton, legs_apart_pose
from snarfcli.texts import one_line

__all__ = ["SkinnedBody", "as_skinned_body"]

# Where a body has each array: our names, those of files in SMPL's format, and those of the package smplx.
_KEYS = {
    "vertices": ("vertices", "v_template"),
    "weights": ("weights", "lbs_weights"),
    "joints": ("joints", "J_regressor", "joint_regressor"),
    "parents": ("parents", "kintree_table"),
}
_SHAPES = {"vertices": "[V, 3]", "weights": "[V, J]", "joints": "[J, 3] (or J_regressor [J, V])", "parents": "[J]"}
# Parents of the joints that SMPL, SMPL-H and SMPL-X have in common, up to the wrists.
_SMPL_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
_NAMES_OF_SMPL = {len(names): names for names in (SMPL_JOINT_NAMES, SMPLH_JOINT_NAMES, SMPLX_JOINT_NAMES)}
_SUM_TOLERANCE = 1e-2  # four weights per vertex, stored as float16


@dataclass(frozen=True, eq=False)
class SkinnedBody:
    """A body in its rest pose."""

    skeleton: Skeleton
    """Joint tree; its canonical pose has the legs apart if the body has hips."""
    vertices: Tensor
    """[V, 3], rest pose, metres."""
    weights: Tensor
    """[V, J], skinning weights, rows sum to 1."""


def as_skinned_body(body: object, betas: Tensor | Sequence[float] | None = None) -> SkinnedBody:
    """Return skeleton, vertices and weights of a body of any kind, as float32 or float64; pose correctives are left out.

    Args:
        body: path of a file in SMPL's format; a `Body`; or a mapping or an object with vertices [V, 3] (or v_template),
            weights [V, J] (or lbs_weights), joints [J, 3] (or J_regressor [J, V]) and parents [J] (or kintree_table), such as
            a model of the package smplx. `joint_names` are optional.
        betas: [S], shape parameters, for a body that has shape directions.

    Raises:
        ValueError: an array is missing, or a shape, a number or a parent is not valid.
        UserError: the file cannot be read.
    """
    if isinstance(body, str | Path):
        body = load_body(body)
    if isinstance(body, Body):
        shape = None if betas is None else torch.as_tensor(betas)
        return SkinnedBody(body.skeleton(shape), body.shaped(shape)[0], _normalised(body.weights))
    found = {name: _find(body, keys) for name, keys in _KEYS.items()}
    missing = [name for name, value in found.items() if value is None]
    if missing:
        wanted = ", ".join(f"{name} {shape}" for name, shape in _SHAPES.items())
        raise ValueError(f"body: wanted {wanted}, got a {type(body).__name__} without {', '.join(missing)}")
    vertices = _numbers("vertices", found["vertices"], None)
    weights = _numbers("weights", found["weights"], vertices)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not len(vertices):
        raise ValueError(f"vertices: wanted shape [V, 3], at least one, got {list(vertices.shape)}")
    if weights.ndim != 2 or len(weights) != len(vertices) or not weights.shape[1]:
        raise ValueError(f"weights: wanted shape [{len(vertices)}, J], one row per vertex, got {list(weights.shape)}")
    count = weights.shape[1]
    parents = _parents(found["parents"], count)
    vertices = _shaped(body, vertices, betas)
    joints = _numbers("joints", found["joints"], vertices)
    if tuple(joints.shape) == (count, len(vertices)) and len(vertices) != 3:
        joints = joints @ vertices
    if tuple(joints.shape) != (count, 3):
        raise ValueError(f"joints: wanted shape [{count}, 3], one per column of weights, got {list(joints.shape)}")
    names = _names(_find(body, ("joint_names", "names")), parents)
    pose = legs_apart_pose(names, joints.dtype).to(joints.device)
    return SkinnedBody(Skeleton(names, parents, joints, pose), vertices, _normalised(weights))


def _find(body: object, keys: Sequence[str]) -> Any:
    """Return what a mapping or an object has by the first of several names that it knows, or None."""
    get = body.get if isinstance(body, Mapping) else lambda key: getattr(body, key, None)
    return next((value for value in map(get, keys) if value is not None), None)


def _numbers(name: str, value: Any, like: Tensor | None) -> Tensor:
    """Return an array, a list or a sparse matrix of a body as a tensor like another one, at first float32 or float64."""
    if hasattr(value, "toarray"):
        value = value.toarray()
    try:
        tensor = torch.as_tensor(value).detach()
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"{name}: wanted an array of numbers, got a {type(value).__name__}") from None
    tensor = tensor.to(like) if like is not None else tensor if tensor.dtype == torch.float64 else tensor.float()
    if not bool(tensor.isfinite().all()):
        raise ValueError(f"{name}: wanted finite numbers, got NaN or infinite ones")
    return tensor


def _shaped(body: object, vertices: Tensor, betas: Tensor | Sequence[float] | None) -> Tensor:
    """Return the vertices with the shape that `betas` says, for a body that has SMPL's shape directions."""
    if betas is None:
        return vertices
    directions = _find(body, ("shapedirs",))
    if directions is None:
        raise ValueError("betas: wanted none for a body without shapedirs")
    betas, directions = _numbers("betas", betas, vertices), _numbers("shapedirs", directions, vertices)
    if betas.ndim != 1 or directions.shape[:2] != vertices.shape or len(betas) > directions.shape[-1]:
        raise ValueError(f"betas: wanted at most as many as shapedirs {list(directions.shape)} has, got {list(betas.shape)}")
    return vertices + directions[..., : len(betas)] @ betas


def _parents(value: Any, count: int) -> tuple[int, ...]:
    """Return the parents of the joints; a root has -1, None, itself, or SMPL's -1 as an unsigned number."""
    try:
        table = value.tolist() if hasattr(value, "tolist") else list(value)
        table = table[0] if table and isinstance(table[0], list) else table  # SMPL's kintree_table has two rows
        parents = [-1 if one in (joint, None) or not 0 <= one < 2**31 else one for joint, one in enumerate(table)]
        is_tree = all(parent == int(parent) < joint for joint, parent in enumerate(parents)) and parents[:1] == [-1]
    except (TypeError, ValueError):
        raise ValueError(f"parents: wanted {count} whole numbers, got a {type(value).__name__} of others") from None
    if len(parents) != count:
        raise ValueError(f"parents: wanted {count}, one per column of weights, got {len(parents)}")
    if not is_tree:
        shown = one_line(str(table), 200)
        raise ValueError(f"parents: wanted -1 for the root and each parent before its children, got {shown}")
    return tuple(map(int, parents))


def _names(names: Any, parents: tuple[int, ...]) -> tuple[str, ...]:
    """Return the names of the joints: as given, or those of SMPL if the tree is SMPL's."""
    if names is not None:
        given = tuple(str(name) for name in names)
        if len(given) != len(parents):
            raise ValueError(f"joint_names: wanted {len(parents)}, got {len(given)}")
        return given
    if len(parents) in _NAMES_OF_SMPL and parents[: len(_SMPL_PARENTS)] == _SMPL_PARENTS:
        return _NAMES_OF_SMPL[len(parents)]
    return tuple(f"joint_{joint}" for joint in range(len(parents)))


def _normalised(weights: Tensor) -> Tensor:
    """Return weights whose rows sum to 1 exactly."""
    sums = weights.double().sum(1, keepdim=True)
    if bool((weights < 0).any()) or bool(((sums - 1).abs() > _SUM_TOLERANCE).any()):
        raise ValueError(
            f"weights: wanted 0 or more and a sum of 1 per vertex, got {float(weights.min()):g} or more and sums "
            f"from {float(sums.min()):g} to {float(sums.max()):g}"
        )
    return (weights.double() / sums).to(weights)
