"""Read the skins of glTF files: their joints and inverse bind matrices.

Source: Khronos, glTF 2.0 specification, section 3.7.3 (skins).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snarfcli.formats.gltf_file import GltfFile
from snarfcli.formats.gltf_nodes import ShownMesh

__all__ = ["Skin", "check_transforms", "read_used_skins"]

_MAX_SKIN_JOINTS = 100_000  # of all skins together
_SKIN_COST = 20  # reading a skin takes as long as this number of joints, even if it has none


@dataclass(frozen=True, eq=False)
class Skin:
    """Joints that move a mesh."""

    joints: list[int]
    """J node indices."""
    inverse_bind: NDArray[np.float64]
    """[J, 4, 4], transforms from the frame in which the mesh is stored to the frame of each joint."""


def read_used_skins(file: GltfFile, meshes: list[ShownMesh]) -> dict[int, Skin]:
    """Read the skins that move a mesh, or all skins if there is no mesh, by index; skins with the most joints come first.

    Raises:
        UserError: a skin is damaged, or there are too many joints.
    """
    skins = file.items("skins")
    used = dict.fromkeys(mesh.skin for mesh in meshes if mesh.skin is not None) if meshes else range(len(skins))
    joints = [skins[skin].get("joints") for skin in used]
    counts = dict(zip(used, [len(found) if isinstance(found, list) else 0 for found in joints], strict=True))
    total = sum(counts.values())
    if total + _SKIN_COST * len(counts) > _MAX_SKIN_JOINTS:
        file.fail(f"has too many skins ({len(counts)} with {total} joints); join its meshes")
    return {number: _read_skin(file, number) for number in sorted(counts, key=lambda skin: -counts[skin])}


def _read_skin(file: GltfFile, number: int) -> Skin:
    skin, what = file.items("skins")[number], f"skin {number}"
    joints = skin.get("joints")
    if not isinstance(joints, list) or not joints:
        file.fail(f"{what} has no joints; export it again")
    joints = [file.checked_index(joint, "nodes", f"a joint of {what}") for joint in joints]
    if len(set(joints)) < len(joints):
        file.fail(f"{what} names a joint twice; export it again")
    matrices = np.tile(np.eye(4), (len(joints), 1, 1))
    accessor = file.index(skin, "inverseBindMatrices", "accessors", what)
    if accessor is not None:
        stored = file.accessor(accessor, ("MAT4",), f"inverse bind matrices of {what}")
        if len(stored) < len(joints):
            file.fail(f"{what}: wanted {len(joints)} inverse bind matrices, one per joint, got {len(stored)}; export it again")
        matrices = stored[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1).astype(np.float64)  # stored by columns
        matrices[:, 3] = 0.0, 0.0, 0.0, 1.0
    check_transforms(file, matrices, [f"{joint}" for joint in joints], f" in the inverse bind matrices of {what}")
    return Skin(joints, matrices)


def check_transforms(file: GltfFile, matrices: NDArray[np.float64], names: Iterable[str], where: str) -> None:
    """Raise UserError if matrices [..., J, 4, 4] are not finite or are singular.

    Args:
        file: the file, for the message.
        matrices: [..., J, 4, 4].
        names: J joint names, for the message.
        where: appended to the message, for example ` at rest`.
    """
    linear = matrices[..., :3, :3]
    size = np.sqrt((linear**2).sum((-1, -2)))
    # A rotation scaled by s has the determinant s^3 and the size s sqrt(3). Below 1e-9 of that it counts as singular.
    is_good = np.isfinite(matrices).all((-1, -2)) & (np.abs(np.linalg.det(linear)) > 1e-9 * size**3) & (size > 1e-12)
    if not is_good.all():
        joint = list(names)[int(np.argwhere(~is_good)[0][-1])]
        file.fail(f"joint {joint} has scale zero or too large numbers{where}; repair it or export it again")
