"""Place the skins of a glTF file in the world: find the matrix that `read_gltf` calls `world_from_bind`."""

from __future__ import annotations

from collections.abc import Mapping, Set

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.formats.gltf_skin import Skin

__all__ = ["placed_skins"]

# Shares of the skeleton's size. Files hold float32; transforms that agree were measured to differ by about 1e-6.
_TOLERANCE = 1e-3
_ROUNDING = 1e-5


def placed_skins(
    skins: Mapping[int, Skin], here: Mapping[int, NDArray[np.float64]], hidden: Set[int] = frozenset()
) -> tuple[dict[int, NDArray[np.float64]], dict[int, NDArray[np.float64]]]:
    """Bring skins that share joints into one frame, which is the world if that is known.

    Args:
        skins: skins by index, the most important first.
        here: [4, 4] per node, transform from the node to the world by default.
        hidden: joints whose place by default says nothing, since their scale is 0.

    Returns:
        world_from_bind: [4, 4] per skin that agrees with the skins before it.
        rest: [4, 4] per joint, transform from the joint at rest to the world.
    """
    world_from_bind: dict[int, NDArray[np.float64]] = {}
    rest: dict[int, NDArray[np.float64]] = {}
    for number, skin in skins.items():
        bind = np.linalg.inv(skin.inverse_bind)
        points = _probe_points(bind)
        shared = [i for i, joint in enumerate(skin.joints) if joint in rest]
        if shared:
            wanted = np.stack([rest[skin.joints[i]] for i in shared]) @ skin.inverse_bind[shared]
            if not _agree(wanted, points):
                continue
            world = wanted[0]
        else:
            seen = [i for i, joint in enumerate(skin.joints) if joint not in hidden] or list(range(len(skin.joints)))
            wanted = np.stack([here[skin.joints[i]] for i in seen]) @ skin.inverse_bind[seen]
            world = wanted[0] if _agree(wanted, points) else _upright(wanted)
        if _agree(np.stack([world, np.eye(4)]), points, _ROUNDING):
            world = np.eye(4)  # leaves the stored vertices bitwise unchanged
        world_from_bind[number] = world
        for joint, matrix in zip(skin.joints, world @ bind, strict=True):
            rest.setdefault(joint, matrix)
    return world_from_bind, rest


def _probe_points(bind: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return test points [P, 3]: two affine maps that move them equally count as equal for this skeleton."""
    origins = bind[:: 1 + len(bind) // 64, :3, 3]
    size = np.ptp(origins, axis=0).max()
    return np.concatenate([origins, origins[0] + (size or 1.0) * np.eye(3)])


def _agree(matrices: NDArray[np.floating], points: NDArray[np.floating], tolerance: float = _TOLERANCE) -> bool:
    """Return whether the affine matrices [K, 4, 4] move the points [P, 3] equally, up to a share of the skeleton's size."""
    lowest = highest = points @ matrices[0, :3, :3].T + matrices[0, :3, 3]
    size = np.ptp(lowest, axis=0).max()
    for matrix in matrices[1:]:
        moved = points @ matrix[:3, :3].T + matrix[:3, 3]
        lowest, highest = np.minimum(lowest, moved), np.maximum(highest, moved)
    return bool((highest - lowest).max() <= tolerance * size)


def _upright(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix [4, 4] with the joints' scale and the nearest rotation by quarter turns.

    These hardly depend on the pose of the nodes.

    Args:
        matrices: [J, 4, 4], world from bind frame, as each joint has it.
    """
    linear = matrices[:, :3, :3]
    scale = float(np.median(np.cbrt(np.abs(np.linalg.det(linear)))))
    turns = Rotation.create_group("O").as_matrix()
    best = np.einsum("kab,jab->k", turns, linear / (scale or 1.0)).argmax()
    world = np.eye(4)
    world[:3, :3] = np.round(turns[best]) * (1.0 if abs(scale - 1) < _TOLERANCE else scale)
    return world
