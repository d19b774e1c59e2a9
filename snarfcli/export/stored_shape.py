"""The shape of a character that is stored in another pose than the canonical one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from snarfcli.bodies.skinning import blend_transforms
from snarfcli.export.rig import Stance

__all__ = ["stored_transforms"]

# Weight of the stored pose itself relative to all poses of the clips. Measured on a body of capsules, rms and maximum: punching
# 0.16 and 1.3 mm, splits 1.4 and 13 mm; with weight 1 0.60 and 4.1, 1.8 and 15 mm; without a fit, with the vertices where the
# weights move them, 1.1 and 7.4, 2.3 and 18 mm.
_OWN_SHARE = 0.1


def stored_transforms(
    weights: NDArray, few: NDArray[np.float64], transforms: NDArray[np.float64], stance: Stance
) -> NDArray[np.float64]:
    """Return the transform of each vertex from the canonical shape to the stored one.

    Blended by skinning weights, a vertex between two bones is nearer to both than it should be, and linear blend skinning from
    the stored pose would not bring it back. So the vertex is placed where skinning from there fits the avatar's best, over the
    poses of clips and the stored pose (least squares). The best place is an affine function of the canonical one.

    Args:
        weights: [V, J], all weights.
        few: [V, J], weights of the character.
        transforms: [S, J, 4, 4] poses, canonical to posed, metres.
        stance: the stored pose.

    Returns:
        [V, 3, 4], metres.
    """
    back = np.linalg.inv(stance.from_canonical)
    exact, count = weights.astype(np.float64), len(weights)
    poses = [(one, 1 / len(transforms)) for one in transforms] + [(stance.from_canonical, _OWN_SHARE)]
    squares, products = np.zeros((count, 3, 3)), np.zeros((count, 3, 4))
    for pose, share in poses:
        wanted = blend_transforms(exact, pose[:, :3])
        moves = blend_transforms(few, (pose @ back)[:, :3])
        wanted[..., 3] -= moves[..., 3]
        turned = share * moves[..., :3].transpose(0, 2, 1)
        squares += turned @ moves[..., :3]
        products += turned @ wanted
    return np.asarray(np.linalg.solve(squares, products), dtype=np.float64)
