"""SMPL-format bodies: shape blend shapes, pose correctives and linear blend skinning."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from snarfcli.bodies.kinematics import axis_angle_to_matrix, forward_kinematics
from snarfcli.bodies.skeleton import SMPL_JOINT_NAMES, Skeleton, legs_apart_pose
from snarfcli.errors import UserError
from snarfcli.files import read_npz

__all__ = ["Body", "PosedBody", "builtin_body", "load_body"]

_BUILTIN_FILE = Path(__file__).with_name("body_cc0.npz")
_REQUIRED_KEYS = ("v_template", "f", "weights", "J_regressor", "kintree_table", "shapedirs", "posedirs")


@dataclass(frozen=True)
class PosedBody:
    """A body in B poses."""

    vertices: Tensor
    """[B, V, 3] posed vertices, metres."""
    joints: Tensor
    """[B, J, 3] posed joints, metres."""
    posed_from_rest: Tensor
    """[B, J, 4, 4] bone transforms from the shaped rest pose."""


@dataclass(frozen=True, eq=False)
class Body:
    """An SMPL-format body (Loper et al., SMPL, SIGGRAPH Asia 2015, section 3).

    The rest pose is a T-pose, y up, facing +z, left is +x, metres.
    """

    v_template: Tensor
    """[V, 3] vertices of the mean shape in the rest pose."""
    faces: Tensor
    """[F, 3] int64 triangles, outward."""
    weights: Tensor
    """[V, J] linear blend skinning weights, rows sum to 1."""
    parents: tuple[int, ...]
    """J parents, -1 for the root; a parent comes before its children."""
    joint_names: tuple[str, ...]
    """J joint names."""
    joint_regressor: Tensor
    """[J, V] joints of a shaped rest body from its vertices."""
    shapedirs: Tensor
    """[V, 3, S] vertex offsets per unit of each shape parameter (beta)."""
    posedirs: Tensor
    """[V, 3, 9 (J - 1)] vertex offsets per entry of R_j - I, j = 1 .. J - 1, row major."""

    @property
    def num_joints(self) -> int:
        """J, the number of joints."""
        return len(self.parents)

    @property
    def num_betas(self) -> int:
        """S, the number of shape parameters."""
        return self.shapedirs.shape[-1]

    def to(self, *args: Any, **kwargs: Any) -> Body:
        """Move every floating tensor as `Tensor.to` does; `faces` only changes device."""
        moved = {f.name: getattr(self, f.name) for f in fields(self) if isinstance(getattr(self, f.name), Tensor)}
        moved = {name: value.to(*args, **kwargs) for name, value in moved.items()}
        moved["faces"] = self.faces.to(moved["weights"].device)
        return replace(self, **moved)

    def shaped(self, betas: Tensor | np.ndarray | None = None) -> tuple[Tensor, Tensor]:
        """Return the rest pose of one shape.

        Args:
            betas: [S'] shape parameters, S' at most S; the mean shape without them.

        Returns:
            v_shaped [V, 3] and joints_rest [J, 3], metres (SMPL Eq. 8 and 10).

        Raises:
            ValueError: betas is not a vector, or is longer than the body has shape parameters.
        """
        v_shaped = self.v_template
        if betas is not None:
            betas = torch.as_tensor(betas).to(v_shaped)
            if betas.ndim != 1 or len(betas) > self.num_betas:
                raise ValueError(f"betas: wanted at most {self.num_betas} values [S], got shape {list(betas.shape)}")
            v_shaped = v_shaped + self.shapedirs[..., : len(betas)] @ betas
        return v_shaped, self.joint_regressor @ v_shaped

    def pose(
        self,
        pose: Tensor | np.ndarray,
        betas: Tensor | np.ndarray | None = None,
        translation: Tensor | np.ndarray | None = None,
    ) -> PosedBody:
        """Pose the body (SMPL Eq. 2, 5 and 6): shape, pose correctives, linear blend skinning.

        Args:
            pose: [B, J, 3] axis-angle, radians, global orientation included.
            betas: [S'] shape parameters, the same in every pose; the mean shape without them.
            translation: [B, 3] metres, none by default.

        Returns:
            Vertices, joints and bone transforms in the body's dtype and on its device.

        Raises:
            ValueError: a shape does not match; the message names the argument.
        """
        pose = torch.as_tensor(pose).to(self.v_template)
        if translation is not None:
            translation = torch.as_tensor(translation).to(self.v_template)
        v_shaped, joints_rest = self.shaped(betas)
        joints, posed_from_rest = forward_kinematics(pose, joints_rest, self.parents, translation)
        batch = pose.shape[0]
        feature = axis_angle_to_matrix(pose[:, 1:]) - torch.eye(3, dtype=pose.dtype, device=pose.device)
        offsets = feature.reshape(batch, -1) @ self.posedirs.reshape(-1, self.posedirs.shape[-1]).T
        v_rest = v_shaped + offsets.reshape(batch, -1, 3)
        rows = posed_from_rest[:, :, :3].reshape(batch, self.num_joints, 12)
        blended = (self.weights @ rows).reshape(batch, -1, 3, 4)
        vertices = (blended[..., :3] @ v_rest[..., None]).squeeze(-1) + blended[..., 3]
        return PosedBody(vertices, joints, posed_from_rest)

    def skeleton(self, betas: Tensor | np.ndarray | None = None) -> Skeleton:
        """Return the joint tree of one shape, with SNARF's canonical pose: T-pose, legs 30 degrees outwards."""
        joints_rest = self.shaped(betas)[1]
        pose = legs_apart_pose(self.joint_names, joints_rest.dtype).to(joints_rest.device)
        return Skeleton(self.joint_names, self.parents, joints_rest, pose)


def load_body(path: str | Path, *, dtype: torch.dtype = torch.float32) -> Body:
    """Read an SMPL-format body from an `.npz` file.

    Args:
        path: file with the arrays v_template, f, weights, J_regressor, kintree_table, shapedirs and posedirs, named and
            shaped as in SMPL; `joint_names` is optional.
        dtype: float32 or float64.

    Raises:
        UserError: the file is missing, damaged or of another kind, lacks an array, or its shapes do not fit together.
    """
    path = Path(path)
    if path.suffix.lower() == ".pkl":
        raise UserError(f"body {path} is a pickle, which is not read; give an SMPL-format .npz file")
    arrays = read_npz(path, "body")
    missing = [key for key in _REQUIRED_KEYS if key not in arrays]
    if missing:
        raise UserError(f"body {path} lacks {', '.join(missing)}; an SMPL-format body has {', '.join(_REQUIRED_KEYS)}")
    for key in _REQUIRED_KEYS:
        if arrays[key].dtype.kind not in "fiu" or not np.isfinite(arrays[key]).all():
            raise UserError(f"body {path}: {key} must hold finite numbers; copy or download the file again")
    vertices, joints = (arrays["v_template"].shape + (0,))[0], (arrays["weights"].shape + (0, 0))[1]
    wanted = {
        "v_template": (vertices, 3),
        "f": (arrays["f"].shape[0] if arrays["f"].ndim else 0, 3),
        "weights": (vertices, joints),
        "J_regressor": (joints, vertices),
        "kintree_table": (2, joints),
        "shapedirs": (vertices, 3, (arrays["shapedirs"].shape + (0, 0, 0))[2]),
        "posedirs": (vertices, 3, 9 * (joints - 1)),
    }
    for key, shape in wanted.items():
        if arrays[key].shape != shape:
            raise UserError(f"body {path}: {key} has shape {list(arrays[key].shape)}, wanted {list(shape)}")
    parents = arrays["kintree_table"][0].astype(np.int64)
    parents = tuple(int(p) for p in np.where(parents == 2**32 - 1, -1, parents))  # SMPL stores -1 as uint32
    if not parents or parents[0] != -1 or any(not 0 <= p < j for j, p in enumerate(parents) if j):
        raise UserError(f"body {path}: kintree_table must name each joint's parent before the joint itself, root first")
    faces = arrays["f"].astype(np.int64)
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= vertices:
        raise UserError(f"body {path}: f must hold triangles of vertex numbers from 0 to {vertices - 1}")
    names = tuple(str(name) for name in arrays["joint_names"].ravel()) if "joint_names" in arrays else ()
    if len(names) != joints:
        names = SMPL_JOINT_NAMES if joints == len(SMPL_JOINT_NAMES) else tuple(f"joint_{j}" for j in range(joints))

    def tensor(key: str) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(arrays[key])).to(dtype)

    return Body(
        v_template=tensor("v_template"),
        faces=torch.from_numpy(faces),
        weights=tensor("weights"),
        parents=parents,
        joint_names=names,
        joint_regressor=tensor("J_regressor"),
        shapedirs=tensor("shapedirs"),
        posedirs=tensor("posedirs"),
    )


@lru_cache(maxsize=2)
def builtin_body(dtype: torch.dtype = torch.float32) -> Body:
    """Return the body that comes with the package: 24 joints, 6890 vertices, closed surface, 10 shape parameters.

    Derived only from MakeHuman's CC0 data by `tools/make_body.py`, and itself CC0-1.0. It has the numbers of vertices
    and faces of SMPL's body, but it is not SMPL's mesh. Read once and shared: do not write into its tensors.
    """
    return load_body(_BUILTIN_FILE, dtype=dtype)
